"""Sigma points carried over one sampling interval by the equations of motion, compiled."""

import numpy as np
from numba import boolean, float64, int64, njit, void

from bampipe.estimate.signatures import DERIVATIVE, MEASURE


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

    The input runs linlate from ``u0`` to ``u1`` over the interval; held constant instead, it
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


@njit(
    void(float64[::1], int64, int64[::1], boolean[::1], float64[::1], float64[::1], float64[::1]),
    cache=True,
)
def place_parameters(point, nx, free, logarithmic, lower, upper, p):  # type: ignore[no-untyped-def]
    """Write the parameters of a sigma point into ``p``, clamped to their physical range."""
    for j in range(free.shape[0]):
        value = min(max(point[nx + j], lower[j]), upper[j])
        p[free[j]] = np.exp(value) if logarithmic[j] else value


@njit(
    void(
        DERIVATIVE,
        float64[::1],
        float64[:, ::1],
        float64,
        float64[::1],
        int64,
        float64[::1],
        int64[::1],
        boolean[::1],
        float64[::1],
        float64[::1],
        float64[::1],
        float64[::1],
        float64,
        int64,
        float64[:, ::1],
        float64[:, ::1],
    ),
    cache=True,
)
def propagate_points(  # type: ignore[no-untyped-def]
    derivative,
    mean,
    factor,
    reach,
    noise_sd,
    nx,
    p,
    free,
    logarithmic,
    lower,
    upper,
    u0,
    u1,
    dt,
    substeps,
    points,
    work,
):
    """Draw the sigma points of (state, parameters, process noise) and carry each over ``dt``.

    Args:
        derivative: f(x, u, p, w, dx).
        mean: (n,) state then free parameters; factor: (n, n) lower root of their covariance.
        reach: distance of the points, in standard deviations.
        noise_sd: (nw,) of the process noise, independent of the state: its root is diagonal,
            which is why the (n + nw) root never needs to be formed.
        nx: length of the state.
        p: (np + 1,) all parameters, then the time by which the inputs were sampled after the
            positions, s, at most a fraction of ``dt``; those in ``free`` are overwritten.
        free: (n - nx,) places of the estimated parameters in ``p``.
        logarithmic: (n - nx,) which of them are estimated as logarithms.
        lower, upper: (n - nx,) range of the estimated parameters, logarithms where so estimated.
        u0, u1: (nu,) input at both ends; dt: s; substeps: of the Runge-Kutta method.
        points: (1 + 2 (n + nw), n) result: the centre, then each pair of opposite points.
        work: (10, >= longest of the vectors) scratch.
    """
    n = mean.shape[0]
    nw = noise_sd.shape[0]
    w = work[6, :nw]
    x = work[7, :nx]
    nu = u0.shape[0]
    start = work[8, :nu]
    end = work[9, :nu]
    for row in range(points.shape[0]):
        pair = (row - 1) // 2
        distance = reach if row % 2 == 1 else -reach
        for i in range(nw):
            w[i] = 0.0
        if row == 0 or pair >= n:
            for i in range(n):
                points[row, i] = mean[i]
            if row > 0:
                w[pair - n] = distance * noise_sd[pair - n]
        else:
            for i in range(n):
                points[row, i] = mean[i] + distance * factor[i, pair]
        place_parameters(points[row], nx, free, logarithmic, lower, upper, p)
        for i in range(nx):
            x[i] = points[row, i]
        late = p[p.shape[0] - 1] / dt
        for i in range(nu):
            start[i] = u0[i] - late * (u1[i] - u0[i])
            end[i] = u1[i] - late * (u1[i] - u0[i])
        runge_kutta(derivative, x, start, end, p, w, dt, substeps, work)
        for i in range(nx):
            points[row, i] = x[i]


@njit(
    void(
        MEASURE,
        float64[::1],
        float64[:, ::1],
        float64,
        int64,
        float64[::1],
        int64[::1],
        boolean[::1],
        float64[::1],
        float64[::1],
        float64[::1],
        int64[::1],
        float64[:, ::1],
        float64[:, ::1],
    ),
    cache=True,
)
def measure_points(  # type: ignore[no-untyped-def]
    measure, mean, factor, reach, nx, p, free, logarithmic, lower, upper, u, observed, images, work
):
    """Draw sigma points of (state, parameters) afresh and take the measurement of each.

    Args:
        measure: h(x, u, p, y).
        mean, factor, reach, nx, p, free, logarithmic, lower, upper: as in `propagate_points`.
        u: (nu,) input at the time of the measurement.
        observed: (ny,) which elements of the model's measurement are used.
        images: (1 + 2 n, ny) result.
        work: (2, >= longest of the vectors) scratch.
    """
    n = mean.shape[0]
    point = work[0, :n]
    y = work[1]
    for row in range(1 + 2 * n):
        pair = (row - 1) // 2
        distance = reach if row % 2 == 1 else -reach
        for i in range(n):
            point[i] = mean[i]
            if row > 0:
                point[i] += distance * factor[i, pair]
        place_parameters(point, nx, free, logarithmic, lower, upper, p)
        measure(point[:nx], u, p, y)
        for i in range(observed.shape[0]):
            images[row, i] = y[observed[i]]
