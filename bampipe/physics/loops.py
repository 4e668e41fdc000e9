"""Loops of compiled functions over the samples of a trial."""

from numba import types

from bampipe.compiled import njit
from bampipe.model_functions import RESIDUAL

_V = types.float64[::1]
_M = types.float64[:, ::1]


@njit(types.void(RESIDUAL, _M, _M, _M, _M, _M, _V, _M), cache=True)
def residual_rows(residual, q, qd, qdd, z, u, p, out):  # type: ignore[no-untyped-def]
    """Write the residual of the inverse dynamics, row by row, into ``out`` (T, n_q)."""
    for i in range(len(q)):
        residual(q[i], qd[i], qdd[i], z[i], u[i], p, out[i])
