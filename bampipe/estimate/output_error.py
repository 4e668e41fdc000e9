"""Output error: the parameters whose simulated motion is nearest to the measured positions.

A motion under measured forces drifts away from the recorded one, however right the parameters,
because the noise of the forces is integrated twice. Each trial is therefore cut into segments
with initial states of their own (multiple shooting, Bock 1983), short enough for the drift to
stay small, and Gauss and Newton's step eliminates the initial states segment by segment. Unlike the
inverse dynamics it needs no acceleration, and unlike the filter no noise levels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bampipe.errors import InputError
from bampipe.estimate.bounded import descend, invert_scaled

Array = NDArray[np.float64]

_TOLERANCE = 1e-8
"""Change of the logarithm of the position error below which the fit has converged."""
_STEPS = 4
"""With the equations of another model; one step is halved where it leads too far."""


@dataclass(frozen=True)
class Segment:
    """A stretch of a trial that is simulated from its own initial state.

    Attributes:
        simulate: (x0 (nx,), p (np,)) -> positions (T, n_q) at the samples.
        q: (T, n_q) measured positions; x0: (nx,) initial state to start from.
        x0_step: (nx,) differences for the slope by the initial state.
    """

    simulate: Callable[[Array, Array], Array]
    q: Array
    x0: Array
    x0_step: Array


@dataclass(frozen=True)
class OutputError:
    """What the fit found.

    Attributes:
        p: (np,) all parameters; covariance: (n_free, n_free) of the free ones.
        rms: (n_q,) position error that is left, rad or m.
        iterations: Gauss-Newton steps; converged: whether the last one gained nothing.
        at_bound: (n_free,) which parameters ended on a bound.
        normal, moment: by segment, (n_free, n_free) and (n_free,), its part of the normal equations
            at ``p``, initial states eliminated.
        reached: where the fit ended.
    """

    p: Array
    covariance: Array
    rms: Array
    normal: Array
    moment: Array
    iterations: int
    converged: bool
    at_bound: NDArray[np.bool_]
    reached: _Shot

    def moved_by(self, segments: Sequence[Segment]) -> Array:
        """How far segments of another model, of the same samples and parameters, move the fit.

        Returns:
            (n_free,) some Gauss-Newton steps, zero where they do not come closer than the fit.
        """
        here = self.reached
        other = replace(here, segments=segments, errors=_errors(segments, here.states, here.p))
        try:
            found = descend(other, here.lower, here.upper, _STEPS, _TOLERANCE).last
        except InputError:  # its motion grows without bound: further off than any
            found = here
        return found.value - here.value if found.cost < here.cost else np.zeros(here.free.size)


@dataclass(frozen=True)
class _Linear:
    """A segment linearised: error (T n_q,), slopes by initial state and by parameters."""

    error: Array
    by_state: Array
    by_parameter: Array

    @property
    def projected(self) -> tuple[Array, Array]:
        """Error and slope by the parameters, less what an initial state explains."""
        basis, upper = np.linalg.qr(self.by_state)
        determined = np.abs(np.diag(upper)) > 1e-12 * np.max(np.abs(upper))
        basis = basis[:, determined]
        both = np.column_stack([self.error, self.by_parameter])
        both = both - basis @ (basis.T @ both)
        return both[:, 0], both[:, 1:]


def fit_output(
    segments: Sequence[Segment],
    start: Array,
    free: NDArray[np.int64],
    lower: Array,
    upper: Array,
    step: Array,
    most_iterations: int = 15,
) -> OutputError:
    """Fit the free parameters and every segment's initial state.

    Each axis is weighted by the scatter of its own error. The covariance comes from the scatter of
    the segments' scores (sandwich), which holds although errors within a segment are far from
    white; segments are taken as independent.

    Args:
        segments: all of them, of all trials.
        start: (np,) parameters to start from; free: (n_free,) places of those to fit.
        lower, upper: (n_free,) bounds; step: (n_free,) differences for the slope.
        most_iterations: the most Gauss-Newton steps.

    Raises:
        InputError: fewer segments than parameters, or the model's motion is not finite at the
            start or beside a point that the fit reaches.
    """
    if len(segments) <= free.size:
        raise InputError(
            f"{len(segments)} segments are too few for {free.size} parameters",
            where="output error",
            remedy="record longer trials, or shorten the segments",
        )
    p = np.array(start, dtype=float)
    p[free] = np.clip(p[free], lower, upper)
    states = [segment.x0.copy() for segment in segments]
    errors = _errors(segments, states, p)
    if not all(np.isfinite(error).all() for error in errors):
        raise _runaway()
    first = _Shot(segments, free, lower, upper, step, p, states, errors)
    found = descend(first, lower, upper, most_iterations, _TOLERANCE)
    normal = np.array([slope.T @ slope for _, slope in found.last.projected])
    moment = np.array([slope.T @ error for error, slope in found.last.projected])
    return OutputError(
        p=found.last.p,
        covariance=_sandwich(normal, moment),
        rms=found.last.rms,
        normal=normal,
        moment=moment,
        iterations=found.iterations,
        converged=found.converged,
        at_bound=found.at_bound,
        reached=replace(found.last),  # without what it has kept for steps that are not taken
    )


@dataclass(frozen=True)
class _Shot:
    """All segments, simulated from ``states`` with parameters ``p``: what `descend` follows."""

    segments: Sequence[Segment]
    free: NDArray[np.int64]
    lower: Array
    upper: Array
    step: Array
    p: Array
    states: Sequence[Array]
    errors: Sequence[Array]

    @property
    def value(self) -> Array:
        return np.asarray(self.p[self.free])

    @cached_property
    def rms(self) -> Array:
        return np.asarray(np.sqrt(np.mean(np.square(np.concatenate(self.errors)), axis=0)))

    @property
    def cost(self) -> float:
        """Negative log likelihood a sample where each axis has its own unknown scatter."""
        return float(np.sum(np.log(np.maximum(self.rms, 1e-300))))

    @cached_property
    def linear(self) -> list[_Linear]:
        return [
            _linearise(segment, x0, self.p, self.free, self.upper, self.step, 1.0 / self.rms)
            for segment, x0 in zip(self.segments, self.states, strict=True)
        ]

    @cached_property
    def projected(self) -> list[tuple[Array, Array]]:
        return [item.projected for item in self.linear]

    def normal_equations(self) -> tuple[Array, Array]:
        return (
            np.sum([slope.T @ slope for _, slope in self.projected], axis=0),
            np.sum([slope.T @ error for error, slope in self.projected], axis=0),
        )

    def moved(self, value: Array, share: float) -> _Shot:
        p = self.p.copy()
        p[self.free] = value
        full_step = (value - self.value) / share
        states = [
            x0 + share * _of_state(item, full_step)
            for x0, item in zip(self.states, self.linear, strict=True)
        ]
        return replace(self, p=p, states=states, errors=_errors(self.segments, states, p))


def _runaway() -> InputError:
    return InputError(
        "the simulated motion grows without bound",
        where="output error",
        remedy="start from the parameters of `--method least-squares`",
    )


def _errors(segments: Sequence[Segment], states: Sequence[Array], p: Array) -> list[Array]:
    return [s.q - s.simulate(x0, p) for s, x0 in zip(segments, states, strict=True)]


def _linearise(
    segment: Segment, x0: Array, p: Array, free: NDArray[np.int64], upper: Array, step: Array,
    weight: Array,
) -> _Linear:  # fmt: skip
    """Error and slopes by differences, weighted, samples and axes in one column."""
    base = segment.simulate(x0, p)
    by_state = np.empty((base.size, x0.size))
    for k in range(x0.size):
        moved = x0.copy()
        moved[k] += segment.x0_step[k]
        by_state[:, k] = (
            (segment.simulate(moved, p) - base) / segment.x0_step[k] * weight
        ).reshape(-1)
    by_parameter = np.empty((base.size, free.size))
    for k, index in enumerate(free):
        moved = p.copy()
        size = step[k] if p[index] + step[k] <= upper[k] else -step[k]
        moved[index] += size
        by_parameter[:, k] = ((segment.simulate(x0, moved) - base) / size * weight).reshape(-1)
    error = ((segment.q - base) * weight).reshape(-1)
    if not all(np.isfinite(part).all() for part in (error, by_state, by_parameter)):
        raise _runaway()
    return _Linear(error, by_state, by_parameter)


def _of_state(linear: _Linear, move: Array) -> Array:
    """Change of the initial state that goes with a change of the parameters."""
    rest = linear.error - linear.by_parameter @ move
    return np.asarray(np.linalg.lstsq(linear.by_state, rest, rcond=1e-12)[0])


def _sandwich(normal: Array, scores: Array) -> Array:
    """Covariance from the scatter of the scores of the segments."""
    inverse = invert_scaled(normal.sum(axis=0))
    count = len(scores)
    spread = scores.T @ scores * (count / max(count - scores.shape[1], 1))
    return np.asarray(inverse @ spread @ inverse)
