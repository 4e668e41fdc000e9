"""The command line: parses, calls, prints."""

from bampipe.cli.entry import main

__all__ = ["main"]
