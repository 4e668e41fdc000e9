"""Kalman filter and fixed-interval smoother of a motion driven by white noise.

The state is position and its derivatives; the highest of them is a random walk. With ``order`` 3
(position, velocity, acceleration) the jerk is white noise; with ``order`` 4 the jerk is constant
but for white noise on the snap. The discretisation is exact (Bar-Shalom, Li and Kirubarajan 2001,
section 6.2). Smoothing is that of Rauch, Tung and Striebel 1965 in the form of Bryson and Frazier
(Bierman 1977, section X.4), which needs no matrix inverse.

Inside, time is counted in samples and position in standard deviations of the measurement noise,
so that the one quantity left is the dimensionless ratio of process to measurement noise
``ratio`` = density * step**(2 order - 1) / noise_sd**2.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import factorial

import numpy as np
from numba import boolean, float64, types, void
from scipy.optimize import minimize_scalar

from bampipe.arrays import Array, Flags
from bampipe.compiled import njit, part
from bampipe.estimate.differentiation import Derivatives

ORDERS = (3, 4)
_SETTLED = 1e-10
"""Relative change of the gains from sample to sample below which they are constant."""

_V = float64[::1]
_M = float64[:, ::1]
_FLAGS = boolean[::1]


@lru_cache
def transition(order: int) -> tuple[Array, Array]:
    """Return transition matrix and process noise (ratio 1) of one sample, (order, order)."""
    step = np.zeros((order, order))
    noise = np.zeros((order, order))
    for i in range(order):
        for j in range(order):
            if j >= i:
                step[i, j] = 1.0 / factorial(j - i)
            a, b = order - 1 - i, order - 1 - j
            noise[i, j] = 1.0 / (factorial(a) * factorial(b) * (a + b + 1))
    return step, noise


def ratio_for(bandwidth_hz: float, order: int, rate_hz: float) -> float:
    """Return the ratio that gives ``bandwidth_hz``; inverse of `MotionModel.bandwidth_hz`."""
    return float((2.0 * np.pi * bandwidth_hz / rate_hz) ** (2 * order))


@part()
def _multiply_row(matrix, i, vector):  # type: ignore[no-untyped-def]
    """Row ``i`` of ``matrix`` (m, n) times ``vector`` (n,)."""
    total = 0.0
    for j in range(vector.shape[0]):
        total += matrix[i, j] * vector[j]
    return total


@part()
def _advance(x, step, work):  # type: ignore[no-untyped-def]
    """Replace ``x`` (n,) by ``step`` (n, n) times it."""
    for i in range(x.shape[0]):
        work[0, i] = _multiply_row(step, i, x)
    for i in range(x.shape[0]):
        x[i] = work[0, i]


@part()
def _advance_matrix(p, step, work):  # type: ignore[no-untyped-def]
    """Replace ``p`` (n, n), which is symmetric, by ``step`` (n, n) p step'."""
    n = p.shape[0]
    for i in range(n):
        for j in range(n):
            work[i, j] = _multiply_row(p, j, step[i])
    for i in range(n):
        for j in range(i + 1):
            p[i, j] = p[j, i] = _multiply_row(step, j, work[i])


_PASS = types.Tuple((_M, float64[:, :, ::1], _M, _V, _V))
"""The filter's results for the smoother, by sample: states (T, n), their covariances, gains (T, n),
innovations (T,) and their variances (T,)."""


@njit(_PASS(_V, _FLAGS, _M, _M, _V, _M))
def _filter(y, present, step, noise, x, p):  # type: ignore[no-untyped-def]
    """Run the filter from prior ``x``, ``p`` for the first sample and return what it passes.

    Once the gains have settled, they are kept until a sample is missing.
    """
    count, n = y.shape[0], x.shape[0]
    states, covariances, gains = np.empty((count, n)), np.empty((count, n, n)), np.zeros((count, n))
    innovations, spreads, work = np.zeros(count), np.ones(count), np.empty((n, n))
    settled = False
    for t in range(count):
        settled = settled and present[t]
        if t > 0:
            _advance(x, step, work)
        if settled:
            spreads[t] = spreads[t - 1]
            for i in range(n):
                gains[t, i] = gains[t - 1, i]
        else:
            if t > 0:
                _advance_matrix(p, step, work)
                p += noise
            if present[t]:
                spreads[t], settled = p[0, 0] + 1.0, t > 4 * n
                for i in range(n):
                    gains[t, i] = p[i, 0] / spreads[t]
                    settled &= abs(gains[t, i] - gains[t - 1, i]) < _SETTLED * abs(gains[t, i])
                for i in range(n):
                    for j in range(n):
                        p[i, j] -= gains[t, i] * gains[t, j] * spreads[t]
        if present[t]:
            innovations[t] = y[t] - x[0]
        for i in range(n):
            x[i] += gains[t, i] * innovations[t]
            states[t, i] = x[i]
            for j in range(n):
                covariances[t, i, j] = p[i, j]
    return states, covariances, gains, innovations, spreads


@njit(void(_FLAGS, _M, _PASS, _M))
def _smooth(present, back, passed, variances):  # type: ignore[no-untyped-def]
    """Turn the filtered states (T, n) into smoothed ones, in place; fill ``variances`` (T, n).

    ``back`` is the transposed transition matrix (n, n).
    """
    states, covariances, gains, innovations, spreads = passed
    n = states.shape[1]
    adjoint, pull = np.zeros(n), np.zeros(n)
    weight, work = np.zeros((n, n)), np.empty((n, n))
    for t in range(states.shape[0] - 1, -1, -1):
        p = covariances[t]
        for i in range(n):
            states[t, i] -= _multiply_row(p, i, adjoint)
            variance = p[i, i]
            for j in range(n):
                variance -= p[i, j] * _multiply_row(weight, j, p[i])
            variances[t, i] = max(variance, 0.0)
        if present[t]:
            # adjoint <- C' adjoint - H' v/S, weight <- C' weight C + H' H/S, with C = I - K H
            adjoint[0] -= _multiply_row(gains, t, adjoint) + innovations[t] / spreads[t]
            for i in range(n):
                pull[i] = _multiply_row(weight, i, gains[t])
            weight[0, 0] += _multiply_row(gains, t, pull) + 1.0 / spreads[t]
            for i in range(n):
                weight[i, 0] -= pull[i]
                weight[0, i] -= pull[i]
        # adjoint <- F' adjoint, weight <- F' weight F
        _advance(adjoint, back, work)
        _advance_matrix(weight, back, work)


def _prior(y: Array, order: int) -> tuple[Array, Array]:
    """Return a wide prior for the first state: ten times the largest difference of each order."""
    spread = [1e2]
    for k in range(1, order):
        steps = np.diff(y, n=k)
        spread.append(10.0 * (float(np.max(np.abs(steps))) if len(steps) else 0.0) + 2.0**k)
    start = np.zeros(order)
    start[0] = y[0]
    return start, np.diag(np.square(spread))


def _informed_prior(y: Array, present: Flags, step: Array, noise: Array) -> tuple[Array, Array]:
    """Return a prior for the first state from the samples themselves, ten times too wide.

    The filter runs backwards in time (odd derivatives change sign). Compared with a vague prior,
    this adds one per cent of information, but prevents the smoothed variances from being small
    differences of large numbers.
    """
    order = len(step)
    signs = (-1.0) ** np.arange(order)
    reverse, flags = np.ascontiguousarray(y[::-1]), np.ascontiguousarray(present[::-1])
    states, covariances, *_ = _filter(reverse, flags, step, noise, *_prior(reverse, order))
    return states[-1] * signs, 100.0 * covariances[-1] * np.outer(signs, signs)


@dataclass(frozen=True)
class MotionModel:
    """The motion model of one axis.

    Attributes:
        order: number of states: 3 white jerk, 4 white snap.
        noise_sd: standard deviation of the measurement noise, position units.
        ratio: process to measurement noise, dimensionless (see the module docstring).
        rate_hz: sampling rate, Hz.
    """

    order: int
    noise_sd: float
    ratio: float
    rate_hz: float

    @property
    def bandwidth_hz(self) -> float:
        """Half-amplitude frequency of the steady smoother, Hz.

        Its response is 1 / (1 + (w/w0)**(2 order)) with w0 = ratio**(1/(2 order)) rad per sample
        (the Wiener filter of an order-fold integrated white noise, sampling fast against w0).
        """
        return float(self.rate_hz / (2.0 * np.pi) * self.ratio ** (1.0 / (2 * self.order)))


def smooth(position: Array, model: MotionModel, present: Flags | None = None) -> Derivatives:
    """Return the motion behind ``position`` (T,), given all its samples.

    Args:
        position: samples on the uniform grid of ``model.rate_hz``.
        model: motion and noise.
        present: shape (T,), false where a sample is missing: ``position`` is ignored there, and the
            bands widen. The first sample must be present. By default all are.
    """
    order, count = model.order, len(position)
    present = np.ones(count, dtype=bool) if present is None else np.ascontiguousarray(present)
    step, noise = transition(order)
    y = (position - position[0]) / model.noise_sd
    start, spread = _informed_prior(y, present, step, model.ratio * noise)
    passed = _filter(y, present, step, model.ratio * noise, start, spread)
    variances = np.empty((count, order))
    _smooth(present, step.T.copy(), passed, variances)
    scale = model.noise_sd * model.rate_hz ** np.arange(3)
    x, sd = passed[0][:, :3] * scale, np.sqrt(variances[:, :3]) * scale
    return Derivatives(x[:, 0] + position[0], x[:, 1], x[:, 2], sd[:, 0], sd[:, 1], sd[:, 2])


_FINEST = 1e-8
"""Smallest noise relative to the travel: below it, rounding dominates a filter's variances."""


def maximum_likelihood(
    records: Sequence[tuple[Array, Flags]],
    rate_hz: float,
    resolution: float,
    *,
    order: int,
    bandwidth_limits_hz: tuple[float, float],
) -> tuple[MotionModel, float]:
    """Choose process and measurement noise of one axis by maximum likelihood.

    The measurement noise is at least that of quantisation, resolution²/12 (Widrow 1956), and larger
    if the innovations require it. Its best value for each ratio has a closed form, so that one
    search over the ratio finds both.

    Args:
        records: positions (T,) on the uniform grid and flags (T,) of the samples present, of
            trials that share sensor and kind of motion.
        rate_hz: sampling rate, Hz.
        resolution: step of the encoder, position units; 0 if unknown.
        order: 3 or 4.
        bandwidth_limits_hz: range of the smoother's bandwidth that is searched.

    Returns:
        The model, and the log likelihood of all innovations, up to a constant that is the same for
        all models.
    """
    step, noise = transition(order)
    # The log of a machine at rest may seem free of noise; use the resolution of the numbers then.
    travel = max((float(np.ptp(position)) for position, _ in records), default=0.0)
    quantum = max(resolution / np.sqrt(12.0), _FINEST * travel) if resolution > 0.0 else 0.0
    unit = quantum if quantum > 0.0 else float(np.std(np.diff(records[0][0]))) or 1.0
    scaled = [
        ((position - position[0]) / unit, np.ascontiguousarray(present))
        for position, present in records
    ]
    priors = [_prior(y, order) for y, _ in scaled]

    def score(log_ratio: float) -> tuple[float, float]:
        """Return -log likelihood and measurement noise variance in units."""
        logs = squares = 0.0
        count = 0
        for (y, present), (start, spread) in zip(scaled, priors, strict=True):
            ratio_noise = np.exp(log_ratio) * noise
            *_, off, scale = _filter(y, present, step, ratio_noise, start.copy(), spread.copy())
            late = np.flatnonzero(present[4 * order :]) + 4 * order
            logs += float(np.log(scale[late]).sum())
            squares += float((off[late] ** 2 / scale[late]).sum())
            count += late.size
        best = squares / max(count, 1)
        variance = max(best, 1.0) if quantum > 0.0 else max(best, 1e-30)
        return 0.5 * (logs + count * np.log(variance) + squares / variance), variance

    low, high = (float(np.log(ratio_for(b, order, rate_hz))) for b in bandwidth_limits_hz)
    grid = np.linspace(low, high, 9)
    coarse = [score(float(value))[0] for value in grid]
    best = int(np.argmin(coarse))
    around = (float(grid[max(best - 1, 0)]), float(grid[min(best + 1, len(grid) - 1)]))
    found = minimize_scalar(
        lambda value: score(float(value))[0], bounds=around, method="bounded",
        options={"xatol": 0.02},
    )  # fmt: skip
    log_ratio = float(found.x)
    total, variance = score(log_ratio)
    model = MotionModel(order, unit * float(np.sqrt(variance)), float(np.exp(log_ratio)), rate_hz)
    return model, -total
