"""Loops of compiled functions over the samples of a trial."""

import numpy as np
from numba import types

from bampipe.compiled import njit
from bampipe.physics.signatures import RESIDUAL

_V = types.float64[::1]
_M = types.float64[:, ::1]


@njit(_M(RESIDUAL, _M, _M, _M, _M, _M, _V), cache=True)
def residual_rows(residual, q, qd, qdd, z, u, p):  # type: ignore[no-untyped-def]
    """Residual of the inverse dynamics, row by row: (T, n_q)."""
    out = np.empty(q.shape)
    for i in range(len(q)):
        residual(q[i], qd[i], qdd[i], z[i], u[i], p, out[i])
    return out
