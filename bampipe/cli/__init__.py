"""The command line: parses, calls, prints."""

from bampipe.cli.app import main

__all__ = ["main"]
