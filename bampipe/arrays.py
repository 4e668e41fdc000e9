"""Kinds of arrays in signatures, whose docstrings state their shapes; and runs in a mask."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.integer[Any]]


def find_runs(chosen: Flags) -> tuple[Indices, Indices]:
    """Return the first sample, and the one after the last, of every run in a mask (T,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(np.int8)))
    return edges[::2], edges[1::2]
