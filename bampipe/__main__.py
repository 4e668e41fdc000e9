"""``python -m bampipe``."""

from bampipe.cli import main

main()
