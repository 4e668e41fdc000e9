"""Sigma points carried over one sampling interval by the equations of motion, compiled."""

import numpy as np
from numba import boolean, float64, int64, void
from numpy.typing import NDArray

from bampipe.compiled import njit
from bampipe.estimate.signatures import DERIVATIVE_ROWS, MEASURE_ROWS, ROWS


def scratch(nx: int, nu: int, p: NDArray[np.float64], nw: int) -> NDArray[np.float64]:
    """Scratch of `propagate_points` and `measure_points`, the parameters ``p`` in every row.

    Args:
        nx, nu, nw: lengths of state, input and process noise.
        p: (np,) all parameters, the timing of the inputs last.

    Returns:
        (9, width).
    """
    work = np.zeros((9, ROWS * max(2 * nx, nu, len(p), nw)))
    work[6, : ROWS * len(p)] = np.repeat(p, ROWS)
    return work


@njit(
    void(float64[::1], int64, float64, float64, float64[::1], int64, int64, int64, int64, int64),
    cache=True,
    fastmath={"contract"},
)
def _spread(out, offset, centre, reach, root, n, pairs, first, count, padded):  # type: ignore[no-untyped-def]
    """Write one coordinate of the sigma points ``first`` to ``first + count`` of all."""
    for r in range(padded):
        out[offset + r] = centre
    for row in range(first, min(first + count, n)):
        out[offset + row - first] = centre + reach * root[row]
    for row in range(max(first, pairs), min(first + count, pairs + n)):
        out[offset + row - first] = centre - reach * root[row - pairs]


@njit(
    void(
        float64[::1], float64[:, ::1], float64, int64, int64, int64[::1], boolean[::1],
        float64[::1], float64[::1], int64, int64, int64, float64[::1],
    ),
    cache=True,
    fastmath={"contract"},
)  # fmt: skip
def _place_rows(  # type: ignore[no-untyped-def]
    mean, factor, reach, nx, pairs, free, logarithmic, lower, upper, first, count, padded, q
):
    """Write the estimated parameters of sigma points into ``q``, within their range."""
    n = mean.shape[0]
    for j in range(free.shape[0]):
        at = free[j] * ROWS
        _spread(q, at, mean[nx + j], reach, factor[nx + j], n, pairs, first, count, padded)
        if lower[j] > -np.inf:
            for r in range(at, at + padded):
                q[r] = max(q[r], lower[j])
        if upper[j] < np.inf:
            for r in range(at, at + padded):
                q[r] = min(q[r], upper[j])
        if logarithmic[j]:
            for r in range(at, at + padded):
                q[r] = np.exp(q[r])


@njit(
    void(
        DERIVATIVE_ROWS, int64, int64, int64, float64, int64, float64[::1], float64[:, ::1]
    ),
    cache=True,
    fastmath={"contract"},
)  # fmt: skip
def _runge_kutta_rows(derivative, count, nx, nu, dt, substeps, slope, work):  # type: ignore[no-untyped-def]
    """Advance many states by ``dt``, as `bampipe.estimate.runge_kutta` advances one.

    Args:
        derivative: f(count, x, u, p, w, dx).
        count: of the rows; nx, nu: lengths of state and input.
        dt: s; substeps: number of steps.
        slope: (>= nu,) what the input gains over the interval.
        work: x, probe, sum, rate, u, start of the input, p, w: x in and out.
    """
    x, probe, total, rate = work[0], work[1], work[2], work[3]
    u, start, p, w = work[4], work[5], work[6], work[7]
    delta = dt / substeps
    for step in range(substeps):
        for stage in range(4):
            if stage == 0 or stage == 1 or stage == 3:
                share = (step + 0.5 * ((stage + 1) // 2)) / substeps
                for i in range(nu):
                    rise = slope[i] * share
                    for r in range(i * ROWS, i * ROWS + count):
                        u[r] = start[r] + rise
            derivative(count, x if stage == 0 else probe, u, p, w, rate)
            ahead = delta if stage == 2 else 0.5 * delta
            weight = delta / 3.0 if stage == 1 or stage == 2 else delta / 6.0
            for i in range(nx):
                if stage == 0:
                    for r in range(i * ROWS, i * ROWS + count):
                        total[r] = x[r] + weight * rate[r]
                        probe[r] = x[r] + ahead * rate[r]
                elif stage == 3:
                    for r in range(i * ROWS, i * ROWS + count):
                        x[r] = total[r] + weight * rate[r]
                else:
                    for r in range(i * ROWS, i * ROWS + count):
                        total[r] += weight * rate[r]
                        probe[r] = x[r] + ahead * rate[r]


@njit(
    void(
        DERIVATIVE_ROWS, float64[::1], float64[:, ::1], float64, float64[::1], int64, int64,
        int64[::1], boolean[::1], float64[::1], float64[::1], float64[::1],
        float64[::1], float64, int64, float64[:, ::1], float64[:, ::1],
    ),
    cache=True,
)  # fmt: skip
def propagate_points(  # type: ignore[no-untyped-def]
    derivative, mean, factor, reach, noise_sd, nx, timing, free, logarithmic, lower, upper,
    u0, u1, dt, substeps, points, work,
):  # fmt: skip
    """Draw the sigma points of (state, parameters, process noise) and carry each over ``dt``.

    Args:
        derivative: f(count, x, u, p, w, dx).
        mean: (n,) state then free parameters; factor: (n, n) lower root of their covariance.
        reach: distance of the points, in standard deviations.
        noise_sd: (nw,) of the process noise, independent of the state: its root is diagonal,
            which is why the (n + nw) root never needs to be formed.
        nx: length of the state.
        timing: place among the parameters of the time by which the inputs were sampled after
            the positions, s, at most a fraction of ``dt``.
        free: (n - nx,) places of the estimated parameters among all.
        logarithmic: (n - nx,) which of them are estimated as logarithms.
        lower, upper: (n - nx,) range of the estimated parameters, logarithms where so estimated.
        u0, u1: (nu,) input at both ends; dt: s; substeps: of the Runge-Kutta method.
        points: (nx, 1 + 2 (n + nw)) result, states only, for parameters stay: the points ahead
            of the mean along each column of the joint root, those behind it, the centre.
        work: from `scratch`, which has put the other parameters in place.
    """
    n = mean.shape[0]
    nw = noise_sd.shape[0]
    nu = u0.shape[0]
    pairs = n + nw
    rows = 1 + 2 * pairs
    x, start, q, w, slope = work[0], work[5], work[6], work[7], work[8]
    for i in range(nu):
        slope[i] = u1[i] - u0[i]
    for first in range(0, rows, ROWS):
        count = min(ROWS, rows - first)
        padded = (count + 3) // 4 * 4
        for i in range(nx):
            _spread(x, i * ROWS, mean[i], reach, factor[i], n, pairs, first, count, padded)
        _place_rows(
            mean, factor, reach, nx, pairs, free, logarithmic, lower, upper,
            first, count, padded, q,
        )  # fmt: skip
        for i in range(nw):
            for r in range(padded):
                w[i * ROWS + r] = 0.0
            for row in (n + i, pairs + n + i):
                if first <= row < first + count:
                    distance = reach if row < pairs else -reach
                    w[i * ROWS + row - first] = distance * noise_sd[i]
        for i in range(nu):
            for r in range(padded):
                start[i * ROWS + r] = u0[i] - q[timing * ROWS + r] * (slope[i] / dt)
        _runge_kutta_rows(derivative, padded, nx, nu, dt, substeps, slope, work)
        for i in range(nx):
            for r in range(count):
                points[i, first + r] = x[i * ROWS + r]


@njit(
    void(
        MEASURE_ROWS, float64[::1], float64[:, ::1], float64, int64, int64[::1],
        boolean[::1], float64[::1], float64[::1], float64[::1], int64[::1], boolean,
        float64[:, ::1], float64[:, ::1],
    ),
    cache=True,
)  # fmt: skip
def measure_points(  # type: ignore[no-untyped-def]
    measure,
    mean,
    factor,
    reach,
    nx,
    free,
    logarithmic,
    lower,
    upper,
    u,
    observed,
    reads_parameters,
    images,
    work,
):
    """Draw sigma points of (state, parameters) afresh and take the measurement of each.

    Args:
        measure: h(count, x, u, p, y).
        mean, factor, reach, nx, free, logarithmic, lower, upper: as in `propagate_points`.
        u: (nu,) input at the time of the measurement.
        observed: (ny,) which elements of the model's measurement are used.
        reads_parameters: whether h depends on estimated parameters.
        images: (ny, 1 + 2 n) result, in the order of `propagate_points`.
        work: from `scratch`.
    """
    n = mean.shape[0]
    rows = 1 + 2 * n
    x, y, inputs, q = work[0], work[1], work[4], work[6]
    for first in range(0, rows, ROWS):
        count = min(ROWS, rows - first)
        padded = (count + 3) // 4 * 4
        for i in range(nx):
            _spread(x, i * ROWS, mean[i], reach, factor[i], n, n, first, count, padded)
        if reads_parameters:
            _place_rows(
                mean, factor, reach, nx, n, free, logarithmic, lower, upper,
                first, count, padded, q,
            )  # fmt: skip
        for i in range(u.shape[0]):
            for r in range(padded):
                inputs[i * ROWS + r] = u[i]
        measure(padded, x, inputs, q, y)
        for i in range(observed.shape[0]):
            for r in range(count):
                images[i, first + r] = y[observed[i] * ROWS + r]
