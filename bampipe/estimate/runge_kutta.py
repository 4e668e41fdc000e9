"""One state carried over one sampling interval by the equations of motion, compiled."""

from numba import float64, int64, void

from bampipe.compiled import njit
from bampipe.model_functions import DERIVATIVE


@njit(
    void(
        DERIVATIVE,
        float64[::1],
        float64[::1],
        float64[::1],
        float64[::1],
        float64[::1],
        float64,
        int64,
        float64[:, ::1],
    ),
    cache=True,
)
def runge_kutta(derivative, x, u0, u1, p, w, dt, substeps, work):  # type: ignore[no-untyped-def]
    """Advance ``x`` in place by ``dt``: classical fourth order, eq 22 with k4 at x + delta k3.

    The input runs linearly from ``u0`` to ``u1`` over the interval; held constant instead, it
    would lag the motion by half a sample, which at human forces exceeds the sensor noise.

    Args:
        derivative: f(x, u, p, w, dx).
        x: (nx,) state.
        u0, u1: (nu,) input at both ends.
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
        for i in range(nu):
            u[i] = u0[i] + (u1[i] - u0[i]) * (step / substeps)
        derivative(x, u, p, w, k1)
        for i in range(nu):
            u[i] = u0[i] + (u1[i] - u0[i]) * ((step + 0.5) / substeps)
        for i in range(nx):
            probe[i] = x[i] + 0.5 * delta * k1[i]
        derivative(probe, u, p, w, k2)
        for i in range(nx):
            probe[i] = x[i] + 0.5 * delta * k2[i]
        derivative(probe, u, p, w, k3)
        for i in range(nu):
            u[i] = u0[i] + (u1[i] - u0[i]) * ((step + 1.0) / substeps)
        for i in range(nx):
            probe[i] = x[i] + delta * k3[i]
        derivative(probe, u, p, w, k4)
        for i in range(nx):
            x[i] += delta / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
