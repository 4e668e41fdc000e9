"""Kinds of arrays, as signatures name them; docstrings say their shapes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.integer[Any]]
