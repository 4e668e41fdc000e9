"""Augmented unscented Kalman filter: state and parameters together (section III-B).

The estimated vector is ``[x, theta]``: the state of the equations of motion, and the estimated
parameters, which follow a random walk. Process noise ``w`` enters the equations of motion and has
sigma points of its own; measurement noise is additive.

Bounds. A parameter with a positive lower bound (a mass, a speed) is estimated as its logarithm, so
that no sigma point comes near zero, where the motion would diverge, and starts that are five times
too small or too large are equivalent. A parameter with the lower bound zero (a damping, a friction,
the strength of an effect) is estimated as it is, since zero is a proper value. The filter lets it
pass through zero, and `constrain` moves the final estimate to the most likely one within bounds:
clamping on the way would cut off every excursion to one side, so that an estimate would settle at a
positive value although the truth is zero. Other bounds always hold, by clamping sigma points and
mean.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bampipe.arrays import Array, Flags, Indices
from bampipe.estimate.bounded import invert_scaled, solve_bounded
from bampipe.estimate.propagation import Estimated
from bampipe.estimate.square_root import (
    DONE,
    INNOVATION_NOT_POSITIVE,
    NOT_FINITE,
    FilterSettings,
    filter_square_root,
)

_REASONS = {
    NOT_FINITE: "the predicted motion grew without bound",
    INNOVATION_NOT_POSITIVE: "the covariance of the innovation lost positive definiteness",
}
_NOT_A_SPREAD = (
    "the spread of the parameters is no longer positive definite: the priors are far too wide, or"
    " some parameters cannot be distinguished"
)


class FilterFailure(ArithmeticError):
    """The filter lost the motion of a trial.

    Attributes:
        sample: index of the sample; reason: what happened.
    """

    def __init__(self, sample: int, reason: str) -> None:
        self.sample, self.reason = sample, reason
        super().__init__(f"sample {sample}: {reason}")


@dataclass(frozen=True)
class FilterModel:
    """A model, as the filter uses it.

    Attributes:
        functions: holds the compiled functions ``derivative_rows`` and ``measure_rows``, of the
            kinds in `bampipe.model_functions`; for filterpy also ``derivative`` and ``measure``.
        n_states: length of x.
        parameters: (np + 1,) values of all parameters, then the input delay: the time by which the
            inputs were sampled after the positions, s. Channels of one sample are never read at
            the same instant; unmodelled, 0.1 ms already biases a damping by ten of its standard
            deviations. Parameters that are not estimated keep these values.
        free: (nt,) indices of the estimated parameters in ``parameters``.
        lower, upper: (nt,) bounds of the estimated parameters, infinite if there are none; see the
            module docstring.
        reads_parameters: whether the measurement depends on estimated parameters; otherwise the
            filter computes them only once per step.
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
        """(nt,) and (nt,): the bounds that always hold, on the scale of estimation."""
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
        p[self.free] = self.to_physical(np.clip(theta, *self.range))[0]

    def to_physical(self, mean: Array) -> tuple[Array, Array]:
        """Return the physical parameters for ``mean`` (..., nt), and their derivatives by it."""
        value, slope = np.array(mean, dtype=float), np.ones_like(mean)
        log = self.logarithmic
        # A filter that has lost the motion may diverge.
        with np.errstate(over="ignore"):
            value[..., log] = np.exp(value[..., log])
        slope[..., log] = value[..., log]
        return value, slope


@dataclass(frozen=True)
class Trial:
    """One continuous recording.

    Attributes:
        t: (T,) time, s, increasing.
        u: (T, nu) inputs of the model.
        y: (T, ny) readings, NaN where one is missing.
        x: (nx,) state at the first sample; x_sd: (nx,) its standard deviation.
        curvature: (T, nu) second time derivatives of the inputs, linear between samples, so that
            the inputs are cubic; None for inputs that are linear between samples.
    """

    t: Array
    u: Array
    y: Array
    x: Array
    x_sd: Array
    curvature: Array | None = None

    @property
    def input_curvature(self) -> Array:
        """(T, nu) second time derivatives of the inputs, zero for linear interpolation."""
        return np.zeros(self.u.shape) if self.curvature is None else self.curvature

    def first(self, samples: int) -> "Trial":
        """The trial, cut to at most so many samples."""
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
        innovation_sd: (T, ny) standard deviation that the filter expects of it.
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
    """Filter one or more trials: each has its own initial state, the parameters carry over.

    ``theta`` (nt,) and ``covariance`` (nt, nt) describe the parameters before the first trial, on
    the scale of estimation (`FilterModel.to_estimated`).

    Raises:
        FilterFailure: the covariance lost positive definiteness or a number is not finite.
    """
    nx = model.n_states

    def filter_one(
        trial: Trial, theta: Array, covariance: Array
    ) -> tuple[FilteredTrial, Array, Array]:
        mean = np.concatenate([trial.x, theta])
        try:
            root = join_roots(trial.x_sd, covariance)
        except ValueError as error:
            raise FilterFailure(0, _NOT_A_SPREAD) from error
        filtered = run_kernel(model, settings, trial, mean, root)
        return filtered, mean[nx:].copy(), (root @ root.T)[nx:, nx:]

    return in_sequence(filter_one, trials, np.clip(theta, *model.range), covariance)


def in_sequence(
    filter_one: Callable[[Trial, Array, Array], tuple[FilteredTrial, Array, Array]],
    trials: Sequence[Trial],
    theta: Array,
    covariance: Array,
) -> FilterOutcome:
    """Filter trials one after the other; each starts from the parameters of the one before.

    Args:
        filter_one: filters one trial, given the parameters (nt,) and their covariance (nt, nt);
            returns the filtered trial, and parameters and covariance after it.
        trials, theta, covariance: as in `filter_trials`.
    """
    theta, covariance = np.array(theta, dtype=float), np.array(covariance, dtype=float)
    found = []
    for trial in trials:
        filtered, theta, covariance = filter_one(trial, theta, covariance)
        found.append(filtered)
    return FilterOutcome(theta, covariance, tuple(found))


def run_kernel(
    model: FilterModel, settings: FilterSettings, trial: Trial, mean: Array, root: Array
) -> FilteredTrial:
    """Filter consecutive samples of ``trial``, whose initial state is not used.

    ``mean`` (n,), state and parameters, and ``root`` (n, n), the lower root of their covariance,
    are those at the first sample, and are overwritten with those at the last.

    Raises:
        FilterFailure: the covariance lost positive definiteness or a number is not finite.
    """
    p, (observed, *sds, longest_step, stride) = _array(model.parameters), settings
    estimated = Estimated(
        model.n_states, p.size - 1, _array(model.free, np.int64),
        _array(model.logarithmic, np.bool_), *model.range, _array(observed, np.int64),
        model.reads_parameters,
    )  # fmt: skip
    given = FilterSettings._make(
        (estimated.observed, *map(_array, sds), float(longest_step), int(stride))
    )
    samples = [*map(_array, (trial.t, trial.u, trial.input_curvature, trial.y))]
    ended, sample, found = filter_square_root(
        model.functions.derivative_rows, model.functions.measure_rows, estimated, p, given,
        *samples, mean, root,
    )  # fmt: skip
    if ended != DONE:
        raise FilterFailure(sample, _REASONS[ended])
    return FilteredTrial(samples[0][:: int(stride)], *found)


def constrain(model: FilterModel, theta: Array, covariance: Array) -> Array:
    """Return the most likely parameters (nt,) within their bounds, on the scale of estimation.

    Parameters outside are put on their bound; the others follow by the covariance (nt, nt).
    """
    lower, upper = np.where(model.logarithmic, model.range[0], model.lower), model.range[1]
    precision, nothing = invert_scaled(covariance), np.zeros(theta.size)
    change = solve_bounded(precision, nothing, lower - theta, upper - theta)
    return np.asarray(np.clip(theta + change, lower, upper))


def _array(values: Any, kind: type = np.float64) -> NDArray[Any]:
    """Return ``values`` as compiled code requires them: columns of tables are read-only."""
    return np.require(values, dtype=kind, requirements=["C", "W"])


def join_roots(x_sd: Array, covariance: Array) -> Array:
    """Lower root (n, n) of the joint covariance of a state and of independent parameters.

    The state has standard deviations (nx,), the parameters a covariance (nt, nt). Zero variances
    give zero columns. If rounding makes the covariance of nearly dependent variables indefinite, a
    part in 10^12 is added to each variance.

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
