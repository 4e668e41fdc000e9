"""Loaded by a Dask worker when it starts: its stages are the toys."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import install_toys

install_toys.install()
