"""Propagation of one state over one sampling interval by the equations of motion, compiled."""

from numba import float64, int64, void

from bampipe.compiled import njit, part
from bampipe.model_functions import DERIVATIVE

_V = float64[::1]


@part()
def _read_input(u0, u1, c0, c1, dt, share, u):  # type: ignore[no-untyped-def]
    """Write the input ``u`` (nu,) after a share of the interval."""
    rest = 1.0 - share
    before, after = rest * (rest * rest - 1.0), share * (share * share - 1.0)
    for i in range(u.shape[0]):
        u[i] = u0[i] + (u1[i] - u0[i]) * share + dt * dt / 6.0 * (c0[i] * before + c1[i] * after)


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
    nx = x.shape[0]
    nu = u0.shape[0]
    k1 = work[0, :nx]
    k2 = work[1, :nx]
    k3 = work[2, :nx]
    k4 = work[3, :nx]
    probe = work[4, :nx]
    u = work[5, :nu]
    delta = dt / substeps
    for step in range(substeps):
        _read_input(u0, u1, c0, c1, dt, step / substeps, u)
        derivative(x, u, p, w, k1)
        _read_input(u0, u1, c0, c1, dt, (step + 0.5) / substeps, u)
        for i in range(nx):
            probe[i] = x[i] + 0.5 * delta * k1[i]
        derivative(probe, u, p, w, k2)
        for i in range(nx):
            probe[i] = x[i] + 0.5 * delta * k2[i]
        derivative(probe, u, p, w, k3)
        _read_input(u0, u1, c0, c1, dt, (step + 1.0) / substeps, u)
        for i in range(nx):
            probe[i] = x[i] + delta * k3[i]
        derivative(probe, u, p, w, k4)
        for i in range(nx):
            x[i] += delta / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
