"""The parameters of one sigma point, put in their places, compiled."""

import numpy as np
from numba import boolean, float64, int64, void

from bampipe.compiled import njit


@njit(
    void(float64[::1], int64, int64[::1], boolean[::1], float64[::1], float64[::1], float64[::1]),
    cache=True,
)
def place_parameters(point, nx, free, logarithmic, lower, upper, p):  # type: ignore[no-untyped-def]
    """Write the parameters of a sigma point into ``p``, clamped to their physical range."""
    for j in range(free.shape[0]):
        value = min(max(point[nx + j], lower[j]), upper[j])
        p[free[j]] = np.exp(value) if logarithmic[j] else value
