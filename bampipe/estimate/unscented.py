"""Augmented unscented Kalman filter: state and parameters together (section III-B).

The estimated vector is ``[x, theta]``: the state of the equations of motion and the parameters
that are estimated, which follow a random walk. Process noise ``w`` enters the equations of
motion and gets sigma points of its own; measurement noise is additive.

Physical range. A parameter whose lower bound is above zero (a mass, a speed) is estimated as its
logarithm: a sigma point can then not come near zero, where the motion would explode, and starts
five times too small and five times too large are alike. A parameter with a lower bound of zero
(a damping, a friction, the strength of an effect) is estimated as it is, because zero is a proper
value, where a logarithm has no end; the filter lets it pass through zero and `constrain` moves
the final estimate to the most likely one within the range. Clamping it on the way instead would
cut off every excursion to one side and settle at a positive value where the truth is zero. Other
bounds are kept all along, by clamping sigma points and mean.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bampipe.arrays import Array, Flags, Indices
from bampipe.estimate.propagation import Estimated
from bampipe.estimate.square_root import (
    DONE,
    INNOVATION_NOT_POSITIVE,
    NOT_FINITE,
    Levels,
    Samples,
    filter_square_root,
)

_REASONS = {
    NOT_FINITE: "the predicted motion grew without bound",
    INNOVATION_NOT_POSITIVE: "the covariance of the innovation lost positive definiteness",
}
ALPHA = (2.0 - 3.0**0.5) ** 0.5
"""Spread of the scaled sigma points (Van der Merwe 2004, with beta = 2 and kappa = 0): the smallest
that makes no weight in a covariance negative. That of the central point is zero with it, so that a
covariance is a sum of positive terms; with the usual 1e-3, rounding alone costs nine digits."""
_NOT_A_SPREAD = (
    "the spread of the parameters is not positive definite any more: priors far too wide, or"
    " parameters that cannot be distinguished"
)


class FilterFailure(ArithmeticError):
    """The filter lost the trial.

    Attributes:
        trial: index of the trial; sample: index of the sample; reason: what happened.
    """

    def __init__(self, trial: int, sample: int, reason: str) -> None:
        self.trial = trial
        self.sample = sample
        self.reason = reason
        super().__init__(f"trial {trial}, sample {sample}: {reason}")


@dataclass(frozen=True)
class FilterModel:
    """A model as the filter takes it.

    Attributes:
        functions: with the compiled functions ``derivative_rows`` and ``measure_rows``, of the
            kinds in `bampipe.model_functions`; for filterpy also ``derivative`` and ``measure``.
        n_states: length of x.
        parameters: (np + 1,) values of all parameters, then the timing of the inputs: the time by
            which they were sampled after the positions, s. Channels of one sample are never read at
            the same instant; unmodelled, 0.1 ms already biases a damping by ten of its standard
            deviations. Parameters that are not estimated stay as given.
        free: (nt,) places of the estimated parameters in ``parameters``.
        lower, upper: (nt,) physical range of the estimated parameters; infinite where none; see
            the module docstring on when it is kept.
        reads_parameters: whether the measurement depends on estimated parameters; where it does
            not, the filter need not work them out twice a step.
    """

    functions: Any
    n_states: int
    parameters: Array
    free: Indices
    lower: Array
    upper: Array
    reads_parameters: bool = True

    @cached_property
    def logarithmic(self) -> Flags:
        """(nt,) which parameters are estimated as logarithms."""
        return np.asarray(self.lower > 0.0)

    @cached_property
    def range(self) -> tuple[Array, Array]:
        """(nt,) and (nt,): the range that holds all along, on the scale of estimation."""
        log = self.logarithmic
        lower, upper = self.lower.astype(float), self.upper.astype(float)
        lower[lower == 0.0] = -np.inf
        lower[log], upper[log] = np.log(lower[log]), np.log(upper[log])
        return lower, upper

    def to_estimated(self, value: Array, sd: Array) -> tuple[Array, Array]:
        """Put physical parameters (nt,) and their sd (nt,) on the scale of estimation.

        A logarithm gets the sd of the log-normal distribution with that mean and sd.
        """
        log = self.logarithmic
        value = np.clip(np.asarray(value, dtype=float), self.lower, self.upper)
        sd = np.array(sd, dtype=float)
        sd[log] = np.sqrt(np.log1p(np.square(sd[log] / value[log])))
        value[log] = np.log(value[log])
        return value, sd

    def place_parameters(self, theta: Array, p: Array) -> None:
        """Write estimated parameters ``theta`` (nt,), clamped to their range, into all ``p``."""
        value = np.minimum(np.maximum(theta, self.range[0]), self.range[1])
        value[self.logarithmic] = np.exp(value[self.logarithmic])
        p[self.free] = value

    def to_physical(self, mean: Array) -> tuple[Array, Array]:
        """Return physical parameters and slopes of ``mean`` (..., nt), as estimated."""
        value, slope = np.array(mean, dtype=float), np.ones_like(mean)
        log = self.logarithmic
        # A filter that has lost the motion may be anywhere.
        with np.errstate(over="ignore"):
            value[..., log] = np.exp(value[..., log])
        slope[..., log] = value[..., log]
        return value, slope


@dataclass(frozen=True)
class FilterSettings:
    """Noise and numerical settings.

    Attributes:
        observed: (ny,) which elements of the model's measurement are in ``Trial.y``.
        reading_sd: (ny,) standard deviation of the measurement noise.
        noise_sd: (nw,) standard deviation of the process noise of one sample.
        walk_sd: (nt,) random walk of the parameters, per square root of a second.
        longest_step: longest Runge-Kutta step, s.
        stride: store the distribution of every so many samples.
    """

    observed: Indices
    reading_sd: Array
    noise_sd: Array
    walk_sd: Array
    longest_step: float = 1e-3
    stride: int = 1


@dataclass(frozen=True)
class Trial:
    """One continuous recording.

    Attributes:
        t: (T,) time, s, increasing.
        u: (T, nu) inputs of the model.
        y: (T, ny) readings, NaN where one is missing.
        x: (nx,) state at the first sample; x_sd: (nx,) its standard deviation.
        curvature: (T, nu) second time derivatives of the inputs, between which these run linearly
            from sample to sample, so that the inputs are cubic; None where they run straight.
    """

    t: Array
    u: Array
    y: Array
    x: Array
    x_sd: Array
    curvature: Array | None = None

    @property
    def input_curvature(self) -> Array:
        """(T, nu) second time derivatives of the inputs, zero where they run straight."""
        return np.zeros(self.u.shape) if self.curvature is None else self.curvature

    def first(self, samples: int) -> Trial:
        """The same with no more than so many samples."""
        return replace(
            self, t=self.t[:samples], u=self.u[:samples], y=self.y[:samples],
            curvature=None if self.curvature is None else self.curvature[:samples],
        )  # fmt: skip


@dataclass(frozen=True)
class Stored:
    """The filter's distribution at some times of one trial.

    Attributes:
        t: (R,) times, s: every ``stride``-th sample.
        mean: (R, n) state and parameters on the scale of estimation; covariance: (R, n, n).
    """

    t: Array
    mean: Array
    covariance: Array


@dataclass(frozen=True)
class FilteredTrial(Stored):
    """The filter's results on one trial.

    Attributes:
        innovation: (T, ny) reading minus prediction, NaN at the first sample and at gaps.
        innovation_sd: (T, ny) what the filter expects of it.
        nis: (T,) squared innovation in its own covariance (mean ny if the filter is consistent).
        log_likelihood: (T,) of each reading given those before.
    """

    innovation: Array
    innovation_sd: Array
    nis: Array
    log_likelihood: Array


@dataclass(frozen=True)
class FilterOutcome:
    """The filter's results on all trials.

    Attributes:
        theta: (nt,) parameters on the scale of estimation; covariance: (nt, nt) by the filter.
        trials: one entry for each trial, in order.
    """

    theta: Array
    covariance: Array
    trials: tuple[FilteredTrial, ...]


def filter_trials(
    model: FilterModel,
    trials: Sequence[Trial],
    theta: Array,
    covariance: Array,
    settings: FilterSettings,
) -> FilterOutcome:
    """Filter trials in sequence: each starts with its own state, the parameters carry over.

    Args:
        model: the compiled model.
        trials: at least one.
        theta: (nt,) parameters before the first trial, on the scale of estimation
            (`FilterModel.to_estimated`); covariance: (nt, nt).
        settings: noise and numerical settings.

    Raises:
        FilterFailure: the covariance lost positive definiteness or a number is not finite.
    """
    nx = model.n_states

    def filter_one(
        index: int, trial: Trial, theta: Array, covariance: Array
    ) -> tuple[FilteredTrial, Array, Array]:
        mean = np.concatenate([trial.x, theta])
        try:
            root = join_roots(trial.x_sd, covariance)
            filtered = run_kernel(model, settings, trial, mean, root, settings.stride)
        except FilterFailure as failure:
            raise FilterFailure(index, failure.sample, failure.reason) from None
        except ValueError as error:
            raise FilterFailure(index, 0, _NOT_A_SPREAD) from error
        return filtered, mean[nx:].copy(), (root @ root.T)[nx:, nx:]

    return in_sequence(filter_one, trials, np.clip(theta, *model.range), covariance)


def in_sequence(
    filter_one: Callable[[int, Trial, Array, Array], tuple[FilteredTrial, Array, Array]],
    trials: Sequence[Trial],
    theta: Array,
    covariance: Array,
) -> FilterOutcome:
    """Filter trials one after the other, the parameters carried over.

    Args:
        filter_one: filters the trial of a number from parameters (nt,) and their covariance
            (nt, nt); returns it and these after it.
        trials, theta, covariance: as in `filter_trials`.
    """
    theta, covariance = np.array(theta, dtype=float), np.array(covariance, dtype=float)
    found = []
    for index, trial in enumerate(trials):
        filtered, theta, covariance = filter_one(index, trial, theta, covariance)
        found.append(filtered)
    return FilterOutcome(theta, covariance, tuple(found))


def run_kernel(
    model: FilterModel,
    settings: FilterSettings,
    trial: Trial,
    mean: Array,
    root: Array,
    stride: int,
) -> FilteredTrial:
    """Filter consecutive samples, from the distribution at the first one.

    Args:
        model, settings: as in `filter_trials`.
        trial: the samples; its state is not read.
        mean: (n,) state and parameters at the first sample, overwritten with those at the last.
        root: (n, n) lower root of their covariance, likewise.
        stride: store the distribution of every so many samples.

    Raises:
        FilterFailure: of trial 0: the covariance lost positive definiteness or a number is not
            finite.
    """
    p, spread = _array(model.parameters), ALPHA**2 * (mean.size + settings.noise_sd.size)
    estimated = Estimated(
        model.n_states, p.size - 1, _array(model.free, np.int64),
        _array(model.logarithmic, np.bool_), *model.range, _array(settings.observed, np.int64),
        model.reads_parameters,
    )  # fmt: skip
    levels = Levels(
        _array(settings.noise_sd), _array(settings.walk_sd), _array(settings.reading_sd),
        spread, 0.5 / spread, float(settings.longest_step), int(stride),
    )  # fmt: skip
    samples = Samples(*map(_array, (trial.t, trial.u, trial.input_curvature, trial.y)))
    ended, sample, found = filter_square_root(
        model.functions.derivative_rows, model.functions.measure_rows, estimated, p, levels,
        samples, mean, root,
    )  # fmt: skip
    if ended != DONE:
        raise FilterFailure(0, sample, _REASONS[ended])
    return FilteredTrial(samples.t[::stride], *found)


def constrain(model: FilterModel, theta: Array, covariance: Array) -> Array:
    """Return the most likely parameters within the physical range.

    Those outside are put on their bound and the others follow by their covariance.

    Args:
        model: gives the range.
        theta: (nt,) on the scale of estimation; covariance: (nt, nt).
    """
    lower = np.where(model.logarithmic, model.range[0], model.lower)
    upper = model.range[1]
    held = np.zeros(theta.size, dtype=bool)
    value = theta
    for _ in range(theta.size):
        outside = ~held & ((value < lower) | (value > upper))
        if not outside.any():
            break
        held |= outside
        shift = np.clip(theta, lower, upper)[held] - theta[held]
        pull = np.linalg.lstsq(covariance[np.ix_(held, held)], shift, rcond=None)[0]
        value = theta + covariance[:, held] @ pull
        value[held] = np.clip(theta, lower, upper)[held]
    return np.asarray(value)


def _array(values: Any, kind: type = np.float64) -> NDArray[Any]:
    """Return ``values`` as compiled code takes them: table columns, for example, are read-only."""
    return np.require(values, dtype=kind, requirements=["C", "W"])


def join_roots(x_sd: Array, covariance: Array) -> Array:
    """Lower root (n, n) of the covariance of a state and of parameters that are independent of it.

    Zero variances give zero columns. Rounding may leave a covariance of nearly dependent variables
    a little short of definite: then a part in 10^12 is added to each variance.

    Args:
        x_sd: (nx,) standard deviations of the state; covariance: (nt, nt) of the parameters.

    Raises:
        ValueError: the matrix is not positive semidefinite.
    """
    nx, n = x_sd.size, x_sd.size + len(covariance)
    joint, root = np.zeros((2, n, n))
    joint[:nx, :nx], joint[nx:, nx:] = np.diag(np.square(x_sd)), covariance
    keep = np.ix_(*2 * [np.flatnonzero(np.diag(joint))])
    for added in (0.0, 1e-12):
        try:
            root[keep] = np.linalg.cholesky(joint[keep] + added * np.diag(np.diag(joint[keep])))
        except np.linalg.LinAlgError:
            continue
        return root
    raise ValueError("the starting covariance is not positive definite")
