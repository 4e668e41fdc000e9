"""Loops of compiled functions over the samples of a trial."""

import numpy as np
from numba import njit, types

from bampipe.physics.signatures import MEMORY_RATE, RESIDUAL

_V = types.float64[::1]
_M = types.float64[:, ::1]


@njit(_M(MEMORY_RATE, _M, _M, _M, _V, _V, _V, types.int64), cache=True)
def integrate_memory(rate, q, qd, u, p, t, z0, steps):  # type: ignore[no-untyped-def]
    """RK4 with ``steps`` substeps a sample; q (T, n_q), qd, u (T, n_u), t (T,) -> z (T, n_z)."""
    count, n = len(t), len(z0)
    out = np.empty((count, n))
    out[0] = z0
    z = z0.copy()
    k1, k2, k3, k4 = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for i in range(count - 1):
        h = (t[i + 1] - t[i]) / steps
        dq, dv, du = q[i + 1] - q[i], qd[i + 1] - qd[i], u[i + 1] - u[i]
        for s in range(steps):
            a, b, c = s / steps, (s + 0.5) / steps, (s + 1.0) / steps
            rate(q[i] + a * dq, qd[i] + a * dv, u[i] + a * du, p, z, k1)
            mid_q, mid_v, mid_u = q[i] + b * dq, qd[i] + b * dv, u[i] + b * du
            rate(mid_q, mid_v, mid_u, p, z + 0.5 * h * k1, k2)
            rate(mid_q, mid_v, mid_u, p, z + 0.5 * h * k2, k3)
            rate(q[i] + c * dq, qd[i] + c * dv, u[i] + c * du, p, z + h * k3, k4)
            z = z + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        out[i + 1] = z
    return out


@njit(_M(RESIDUAL, _M, _M, _M, _M, _M, _V), cache=True)
def residual_rows(residual, q, qd, qdd, z, u, p):  # type: ignore[no-untyped-def]
    """Residual of the inverse dynamics, row by row: (T, n_q)."""
    out = np.empty(q.shape)
    for i in range(len(q)):
        residual(q[i], qd[i], qdd[i], z[i], u[i], p, out[i])
    return out
