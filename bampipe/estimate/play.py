"""The play operator: the motion of a point that a loose coupling drags along.

After Krasnosel'skii and Pokrovskii 1989, Systems with Hysteresis. Input minus output is the stop
operator, an ideal spring that slips.
"""

import numpy as np

from bampipe.arrays import Array
from bampipe.compiled import njit


@njit("float64[:, ::1](float64[::1], float64[::1])")
def drag_along(x: Array, play: Array) -> Array:
    """Return positions (T, G) of points that stay within ``play`` (G,) of ``x`` (T,)."""
    out = np.empty((x.shape[0], play.shape[0]))
    for g in range(play.shape[0]):
        at = x[0]
        for t in range(x.shape[0]):
            at = min(max(at, x[t] - play[g]), x[t] + play[g])
            out[t, g] = at
    return out
