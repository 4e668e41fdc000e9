"""The unscented filter in its square-root form (section V-C), compiled.

A filter may be stopped and continued: ``mean`` and the root of the covariance go in as the
distribution at sample 0 and come out as that at the last sample, so that a filter fed sample by
sample computes what the batch filter computes.
"""

from typing import NamedTuple

import numpy as np
from numba import float64, int64, types

from bampipe.arrays import Array, Indices
from bampipe.compiled import njit, record_type
from bampipe.estimate.propagation import (
    ESTIMATED,
    allocate_points,
    measure_points,
    propagate_points,
)
from bampipe.estimate.triangular import (
    append_rows,
    condition,
    covariance_of,
    forward_substitute,
    padded,
    transpose,
)
from bampipe.model_functions import DERIVATIVE_ROWS, MEASURE_ROWS

DONE = 0
NOT_FINITE = 1
INNOVATION_NOT_POSITIVE = 2

_V = float64[::1]
_M = float64[:, ::1]


ALPHA = (2.0 - 3.0**0.5) ** 0.5
"""Spread of the scaled sigma points (Van der Merwe 2004, with beta = 2 and kappa = 0): the smallest
without negative weights in a covariance. The central weight is then zero, so that a covariance is a
sum of positive terms; with the usual 1e-3, rounding alone costs nine digits."""
_SPREAD = ALPHA**2


class FilterSettings(NamedTuple):
    """Noise levels and numerical settings.

    Attributes:
        observed: (ny,) indices of the model's measurements that ``Trial.y`` contains.
        reading_sd: (ny,) standard deviation of the measurement noise, which is additive.
        noise_sd: (nw,) standard deviation of the process noise of one sample.
        walk_sd: (nt,) random walk of the parameters, per square root of a second.
        longest_step: longest Runge-Kutta step, s.
        stride: number of samples from one stored distribution to the next.
    """

    observed: Indices
    reading_sd: Array
    noise_sd: Array
    walk_sd: Array
    longest_step: float = 1e-3
    stride: int = 1


@njit(
    types.Tuple((int64, int64, types.Tuple((_M, float64[:, :, ::1], _M, _M, _V, _V))))(
        DERIVATIVE_ROWS,
        MEASURE_ROWS,
        ESTIMATED,
        _V,
        record_type(FilterSettings, int64[::1], _V, _V, _V, float64, int64),
        *(_V, _M, _M, _M),
        _V,
        _M,
    ),
    fastmath={"contract"},
)
def filter_square_root(  # type: ignore[no-untyped-def]
    derivative, measure, estimated, p, settings, t, u, curvature, y, mean, factor
):
    """Filter one trial, propagating the lower root of the covariance.

    The prediction is a QR factorisation of the weighted deviations (Van der Merwe and Wan 2001),
    by differences and sums of opposite points. Parameters do not change, so that only the state is
    nonzero in the sums and in the points of the noise. The update rotates the joint root of
    measurement and state, so that it needs no downdate and cannot lose positive definiteness.
    Prediction and update are one function because they share all of their memory.

    Args:
        derivative: f(count, x, u, p, w, dx); measure: h(count, x, u, p, y).
        estimated, settings: the model and its noise.
        p: (np + 1,) all parameters, then the input delay.
        t: (T,) s; u: (T, nu) inputs; curvature: (T, nu) their second time derivatives.
        y: (T, ny) readings, NaN where one is missing.
        mean: (n,) state and parameters, in and out; factor: (n, n) lower root of their
            covariance, in and out.

    Returns:
        The reason for stopping, `DONE` if there was no fault, and the sample at which it stopped;
        then means (R, n) and covariances (R, n, n) of every ``settings.stride``-th sample,
        innovations (T, ny) and their standard deviations, nis (T,) and log likelihood (T,), NaN
        where there is no reading.
    """
    nx, observed = estimated.n_states, estimated.observed
    lower, upper = estimated.lower, estimated.upper
    noise_sd, walk_sd, reading_sd = settings.noise_sd, settings.walk_sd, settings.reading_sd
    n = mean.shape[0]
    nw = noise_sd.shape[0]
    ny = observed.shape[0]
    nt = n - nx
    # The squared distance of the sigma points, in variances. In a covariance the central one has no
    # weight, the others have equal ones.
    spread = _SPREAD * (n + nw)
    other, stride = 0.5 / spread, settings.stride
    reach = spread**0.5
    half = (0.5 * other) ** 0.5
    pairs = n + nw
    wide = padded(n)
    # States of the sigma points after an interval, and measurements of points drawn afresh.
    images, readings = np.empty((nx, 1 + 2 * pairs)), np.empty((ny, 1 + 2 * n))
    points = allocate_points(nx, u.shape[1], p, nw)
    # root is R = L^T, so that the rotated elements are contiguous; columns are deviations.
    root, columns = np.zeros((n, wide)), np.zeros((n, padded(pairs + nw)))
    reading_columns, gain = np.zeros((ny, padded(n + 1))), np.empty((ny, wide))
    # Noise of the readings given the state (a lower root), and readings along R^T.
    noise, cross = np.empty((ny, ny)), np.empty((ny, n))
    cosine, sine, whitened = np.empty((3, n + ny + 1))
    centre_image = 2 * nw * other
    size = t.shape[0]
    means, covariances = np.empty((-(-size // stride), n)), np.empty((-(-size // stride), n, n))
    innovations, innovation_sd = np.full((size, ny), np.nan), np.full((size, ny), np.nan)
    squares, likelihoods = np.full(size, np.nan), np.full(size, np.nan)
    found = means, covariances, innovations, innovation_sd, squares, likelihoods
    log_normal = 0.5 * ny * np.log(2.0 * np.pi)
    for i in range(n):
        for j in range(n):
            root[i, j] = factor[j, i] if i <= j else 0.0
    for i in range(n):
        means[0, i] = mean[i]
    covariance_of(root, covariances[0])
    for k in range(1, size):
        dt = t[k] - t[k - 1]
        substeps = max(1, int(np.ceil(dt / settings.longest_step - 1e-6)))
        propagate_points(
            derivative, estimated, mean, factor, reach, noise_sd, u[k - 1], u[k],
            curvature[k - 1], curvature[k], dt, substeps, images, points,
        )  # fmt: skip
        for i in range(nx):
            middle = images[i, 2 * pairs]
            total = 0.0
            for row in range(2 * pairs):
                total += images[i, row] - middle
            mean[i] = middle + other * total
            if not np.isfinite(mean[i]):
                return NOT_FINITE, k, found
            for pair in range(pairs):
                columns[i, pair] = half * (
                    images[i, pair] + images[i, pairs + pair] - 2.0 * mean[i]
                )
            for pair in range(n, pairs):
                columns[i, pairs + pair - n] = half * (images[i, pair] - images[i, pairs + pair])
            for j in range(n):
                root[i, j] = 0.0
        append_rows(root, nx, columns, columns.shape[1])
        for i in range(n):
            for pair in range(n, wide):
                columns[i, pair] = 0.0
            for pair in range(n):
                columns[i, pair] = (
                    half * (images[i, pair] - images[i, pairs + pair])
                    if i < nx
                    else (factor[i, pair] if pair <= i else 0.0)
                )
        for i in range(nx, n):
            for j in range(n):
                root[i, j] = walk_sd[i - nx] * dt**0.5 if i == j else 0.0
        # Columns of the state first; then the parameters' rows start from their random walk.
        append_rows(root, n, columns, wide)
        missing = False
        for i in range(ny):
            missing = missing or np.isnan(y[k, i])
        if not missing:
            transpose(root, factor)
            measure_points(measure, estimated, mean, factor, reach, u[k], readings, points)
            for i in range(ny):
                middle = readings[i, 2 * n]
                total = 0.0
                for row in range(2 * n):
                    total += readings[i, row] - middle
                predicted = middle + other * total
                innovations[k, i] = y[k, i] - predicted
                # A pair of opposite points splits into its sum, which only curvature moves,
                # and its difference, which is correlated with the state.
                for pair in range(n):
                    reading_columns[i, pair] = half * (
                        readings[i, pair] + readings[i, n + pair] - 2.0 * predicted
                    )
                    cross[i, pair] = half * (readings[i, pair] - readings[i, n + pair])
                for j in range(ny):
                    noise[i, j] = reading_sd[i] if i == j else 0.0
                reading_columns[i, n] = centre_image**0.5 * (middle - predicted)
            append_rows(noise, ny, reading_columns, reading_columns.shape[1])
            for i in range(ny):
                for j in range(i):
                    noise[i, j] = noise[j, i]
            condition(root, noise, cross, gain, cosine, sine)
            nis = 0.0
            log_likelihood = -log_normal
            for i in range(ny):
                whitened[i] = innovations[k, i]
                total = 0.0
                for j in range(i + 1):
                    total += noise[i, j] * noise[i, j]
                innovation_sd[k, i] = total**0.5
                if not noise[i, i] > 0.0:
                    return INNOVATION_NOT_POSITIVE, k, found
            forward_substitute(noise, ny, whitened)
            for i in range(ny):
                nis += whitened[i] ** 2
                log_likelihood -= np.log(noise[i, i])
                for j in range(n):
                    mean[j] += gain[i, j] * whitened[i]
            squares[k] = nis
            likelihoods[k] = log_likelihood - 0.5 * nis
            for j in range(nt):
                mean[nx + j] = min(max(mean[nx + j], lower[j]), upper[j])
        transpose(root, factor)
        if k % stride == 0:
            for i in range(n):
                means[k // stride, i] = mean[i]
            covariance_of(root, covariances[k // stride])
    for i in range(n):
        if not np.isfinite(mean[i]):
            return NOT_FINITE, size - 1, found
    return DONE, size - 1, found
