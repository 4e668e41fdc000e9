"""Loops of compiled functions over the samples of a trial."""

import numpy as np
from numba import njit, types

from bampipe.physics.signatures import MEMORY_RATE, RESIDUAL

_V = types.float64[::1]
_M = types.float64[:, ::1]


@njit(inline="always")
def _between(q, qd, u, i, share, motion):  # type: ignore[no-untyped-def]
    """Motion and inputs a share of the way from sample i to the next."""
    for source, target in ((q, motion[0]), (qd, motion[1]), (u, motion[2])):
        for j in range(len(target)):
            target[j] = source[i, j] + share * (source[i + 1, j] - source[i, j])


@njit(inline="always")
def _shift(z, h, k, out):  # type: ignore[no-untyped-def]
    for j in range(len(z)):
        out[j] = z[j] + h * k[j]


@njit(_M(MEMORY_RATE, _M, _M, _M, _V, _V, _V, types.int64), cache=True)
def integrate_memory(rate, q, qd, u, p, t, z0, steps):  # type: ignore[no-untyped-def]
    """RK4 with ``steps`` substeps a sample; q (T, n_q), qd, u (T, n_u), t (T,) -> z (T, n_z)."""
    count, n = len(t), len(z0)
    out = np.empty((count, n))
    out[0] = z0
    k1, k2, k3, k4 = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    z, at = z0.copy(), np.empty(n)
    motion = np.empty(q.shape[1]), np.empty(q.shape[1]), np.empty(u.shape[1])
    for i in range(count - 1):
        h = (t[i + 1] - t[i]) / steps
        for s in range(steps):
            _between(q, qd, u, i, s / steps, motion)
            rate(motion[0], motion[1], motion[2], p, z, k1)
            _between(q, qd, u, i, (s + 0.5) / steps, motion)
            _shift(z, 0.5 * h, k1, at)
            rate(motion[0], motion[1], motion[2], p, at, k2)
            _shift(z, 0.5 * h, k2, at)
            rate(motion[0], motion[1], motion[2], p, at, k3)
            _between(q, qd, u, i, (s + 1.0) / steps, motion)
            _shift(z, h, k3, at)
            rate(motion[0], motion[1], motion[2], p, at, k4)
            for j in range(n):
                z[j] += h / 6.0 * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j])
        out[i + 1] = z
    return out


@njit(_M(RESIDUAL, _M, _M, _M, _M, _M, _V), cache=True)
def residual_rows(residual, q, qd, qdd, z, u, p):  # type: ignore[no-untyped-def]
    """Residual of the inverse dynamics, row by row: (T, n_q)."""
    out = np.empty(q.shape)
    for i in range(len(q)):
        residual(q[i], qd[i], qdd[i], z[i], u[i], p, out[i])
    return out
