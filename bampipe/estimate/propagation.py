"""Propagation of sigma points over one sampling interval by the equations of motion, compiled."""

from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64

from bampipe.arrays import Array, Flags, Indices
from bampipe.compiled import part, record_type
from bampipe.model_functions import ROWS

_V = float64[::1]


class Estimated(NamedTuple):
    """Estimated parameters and measured outputs of a model, as kernels take them.

    Attributes:
        n_states: length nx of the state.
        timing: index among all parameters of the input delay, the time by which the inputs were
            sampled after the positions, s, at most a fraction of a sampling interval.
        free: (nt,) indices of the estimated parameters among all.
        logarithmic: (nt,) which of them are estimated as logarithms.
        lower, upper: (nt,) their range, logarithms where so estimated.
        observed: (ny,) which elements of the model's measurement are read.
        reads_parameters: whether the measurement depends on estimated parameters.
    """

    n_states: int
    timing: int
    free: Indices
    logarithmic: Flags
    lower: Array
    upper: Array
    observed: Indices
    reads_parameters: bool


ESTIMATED = record_type(
    Estimated, int64, int64, int64[::1], boolean[::1], _V, _V, int64[::1], boolean
)


X, PROBE, TOTAL, RATE, U, START, P, W, SLOPE, CURVE = range(10)
"""Rows of the workspace of sigma points: states, where the derivative is taken, the Runge-Kutta
sum, the derivative; inputs, and those at the start of the interval; all parameters; process noise;
and, once for all points, the increase of the input over the interval and a sixth of its second
derivatives at both ends, those at the start first, in units of the interval. In the others,
quantity i of point r is at [i*ROWS + r]. One matrix, because of separate arrays the compiler cannot
know how far apart they are, and checks it in every loop."""


@part()
def allocate_points(nx, nu, p, nw):  # type: ignore[no-untyped-def]
    """Return the workspace of `propagate_points` and `measure_points`, ``p`` in every row.

    Args:
        nx, nu, nw: lengths of state, input and process noise.
        p: (np,) all parameters, the input delay last.

    Returns:
        (10, width).
    """
    points = np.zeros((10, ROWS * max(2 * nx, nu, len(p), nw)))
    for i in range(len(p)):
        for r in range(i * ROWS, (i + 1) * ROWS):
            points[P, r] = p[i]
    return points


@part(fastmath={"contract"})
def _spread(out, offset, centre, reach, root, n, pairs, first, count, padded):  # type: ignore[no-untyped-def]
    """Write one coordinate of the sigma points ``first`` to ``first + count`` of all."""
    for r in range(padded):
        out[offset + r] = centre
    for row in range(first, min(first + count, n)):
        out[offset + row - first] = centre + reach * root[row]
    for row in range(max(first, pairs), min(first + count, pairs + n)):
        out[offset + row - first] = centre - reach * root[row - pairs]


@part(fastmath={"contract"})
def _spread_parameters(estimated, mean, factor, reach, pairs, first, count, padded, p):  # type: ignore[no-untyped-def]
    """Write the estimated parameters of sigma points into ``p``, within their range."""
    n, nx = mean.shape[0], estimated.n_states
    free, logarithmic = estimated.free, estimated.logarithmic
    lower, upper = estimated.lower, estimated.upper
    for j in range(free.shape[0]):
        at = free[j] * ROWS
        _spread(p, at, mean[nx + j], reach, factor[nx + j], n, pairs, first, count, padded)
        for r in range(at, at + padded):
            p[r] = min(max(p[r], lower[j]), upper[j])
        if logarithmic[j]:
            for r in range(at, at + padded):
                p[r] = np.exp(p[r])


@part(fastmath={"contract"})
def _runge_kutta_rows(derivative, count, nx, nu, dt, substeps, points):  # type: ignore[no-untyped-def]
    """Advance many states by ``dt``, as `bampipe.estimate.runge_kutta` advances one.

    Args:
        derivative: f(count, x, u, p, w, dx).
        count: of the rows; nx, nu: lengths of state and input.
        dt: s; substeps: number of steps.
        points: the states ``x`` are advanced in place.
    """
    x, probe, total, rate = points[X], points[PROBE], points[TOTAL], points[RATE]
    u, start, p, w = points[U], points[START], points[P], points[W]
    slope, curve = points[SLOPE], points[CURVE]
    delta = dt / substeps
    for step in range(substeps):
        for stage in range(4):
            if stage == 0 or stage == 1 or stage == 3:
                share = (step + 0.5 * ((stage + 1) // 2)) / substeps
                rest = 1.0 - share
                before, after = rest * (rest * rest - 1.0), share * (share * share - 1.0)
                for i in range(nu):
                    rise = slope[i] * share + curve[i] * before + curve[nu + i] * after
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


@part()
def propagate_points(  # type: ignore[no-untyped-def]
    derivative,
    estimated,
    mean,
    factor,
    reach,
    noise_sd,
    u0,
    u1,
    c0,
    c1,
    dt,
    substeps,
    images,
    points,
):
    """Draw the sigma points of (state, parameters, process noise) and carry each over ``dt``.

    Args:
        derivative: f(count, x, u, p, w, dx). estimated: see `Estimated`.
        mean: (n,) state then free parameters; factor: (n, n) lower root of their covariance.
        reach: distance of the points, in standard deviations.
        noise_sd: (nw,) of the process noise, independent of the state: its root is diagonal,
            which is why the (n + nw) root never needs to be formed.
        u0, u1: (nu,) input at both ends; c0, c1: (nu,) its second time derivative there, linear in
            between, so that the input is cubic, or straight if both are zero.
        dt: s; substeps: of the Runge-Kutta method.
        images: (nx, 1 + 2 (n + nw)) result, only the states, since parameters do not change: the
            points ahead of the mean along each column of the joint root, those behind, the centre.
        points: from `allocate_points`, which has put the other parameters in position.
    """
    n, nx = mean.shape[0], estimated.n_states
    nw, nu = noise_sd.shape[0], u0.shape[0]
    pairs = n + nw
    rows = 1 + 2 * pairs
    x, start, p, w = points[X], points[START], points[P], points[W]
    slope, curve = points[SLOPE], points[CURVE]
    timing = estimated.timing * ROWS
    sixth = dt * dt / 6.0
    for i in range(nu):
        slope[i] = u1[i] - u0[i]
        curve[i], curve[nu + i] = sixth * c0[i], sixth * c1[i]
    for first in range(0, rows, ROWS):
        count = min(ROWS, rows - first)
        padded = (count + 3) // 4 * 4
        for i in range(nx):
            _spread(x, i * ROWS, mean[i], reach, factor[i], n, pairs, first, count, padded)
        _spread_parameters(estimated, mean, factor, reach, pairs, first, count, padded, p)
        for i in range(nw):
            for r in range(padded):
                w[i * ROWS + r] = 0.0
            for row in (n + i, pairs + n + i):
                if first <= row < first + count:
                    distance = reach if row < pairs else -reach
                    w[i * ROWS + row - first] = distance * noise_sd[i]
        for i in range(nu):
            # The delayed input, to second order, on average over the interval.
            gain = 0.25 * (c0[i] + c1[i])
            for r in range(padded):
                late = p[timing + r]
                start[i * ROWS + r] = u0[i] - late * (slope[i] / dt - late * gain)
        _runge_kutta_rows(derivative, padded, nx, nu, dt, substeps, points)
        for i in range(nx):
            for r in range(count):
                images[i, first + r] = x[i * ROWS + r]


@part()
def measure_points(measure, estimated, mean, factor, reach, u, images, points):  # type: ignore[no-untyped-def]
    """Draw sigma points of (state, parameters) afresh and take the measurement of each.

    Args:
        measure: h(count, x, u, p, y).
        estimated, mean, factor, reach, points: as in `propagate_points`.
        u: (nu,) input at the time of the measurement.
        images: (ny, 1 + 2 n) result, in the order of `propagate_points`.
    """
    n, nx, observed = mean.shape[0], estimated.n_states, estimated.observed
    rows = 1 + 2 * n
    x, y, inputs, p = points[X], points[PROBE], points[U], points[P]
    for first in range(0, rows, ROWS):
        count = min(ROWS, rows - first)
        padded = (count + 3) // 4 * 4
        for i in range(nx):
            _spread(x, i * ROWS, mean[i], reach, factor[i], n, n, first, count, padded)
        if estimated.reads_parameters:
            _spread_parameters(estimated, mean, factor, reach, n, first, count, padded, p)
        for i in range(u.shape[0]):
            for r in range(padded):
                inputs[i * ROWS + r] = u[i]
        measure(padded, x, inputs, p, y)
        for i in range(observed.shape[0]):
            for r in range(count):
                images[i, first + r] = y[observed[i] * ROWS + r]
