"""Propagation of one state over one sampling interval by the equations of motion, compiled."""

from numba import float64, int64, void

from bampipe.compiled import njit
from bampipe.model_functions import DERIVATIVE

_V = float64[::1]


@njit(void(DERIVATIVE, *[_V] * 7, float64, int64, float64[:, ::1]))
def runge_kutta(derivative, x, u0, u1, c0, c1, p, w, dt, substeps, work):  # type: ignore[no-untyped-def]
    """Advance ``x`` in place by ``dt``: classical fourth order, eq 22 with k4 at x + delta k3.

    The input is a cubic from ``u0`` to ``u1`` over the interval, straight where its second
    derivatives are zero; held constant instead, it would lag the motion by half a sample, which at
    human forces exceeds the sensor noise.

    Args:
        derivative: f(x, u, p, w, dx).
        x: (nx,) state.
        u0, u1: (nu,) input at both ends; c0, c1: (nu,) its second time derivative there.
        p: (np,) parameters.
        w: (nw,) process noise, constant over the interval.
        dt: length of the interval, s.
        substeps: number n of steps of size delta = dt / n.
        work: (6, >= max(nx, nu)) scratch.
    """
    nx, nu, delta = x.shape[0], u0.shape[0], dt / substeps
    probe, u = work[4, :nx], work[5, :nu]
    for step in range(substeps):
        for stage in range(4):
            ahead = 0.5 * ((stage + 1) // 2)
            share = (step + ahead) / substeps
            rest = 1.0 - share
            before, after = rest * (rest * rest - 1.0), share * (share * share - 1.0)
            for i in range(nu):
                bend = dt * dt / 6.0 * (c0[i] * before + c1[i] * after)
                u[i] = u0[i] + (u1[i] - u0[i]) * share + bend
            for i in range(nx):
                probe[i] = x[i] + ahead * delta * work[stage - 1, i] if stage > 0 else x[i]
            derivative(probe, u, p, w, work[stage, :nx])
        for i in range(nx):
            total = work[0, i] + 2.0 * work[1, i] + 2.0 * work[2, i] + work[3, i]
            x[i] += delta / 6.0 * total
