"""Output error: the parameters whose simulated motion is nearest to the measured positions.

A motion under measured forces drifts away from the recorded one, however right the parameters,
because the noise of the forces is integrated twice. Each trial is therefore cut into segments
with initial states of their own (multiple shooting, Bock 1983), short enough for the drift to
stay small, and Gauss and Newton's step eliminates the initial states segment by segment. Unlike the
inverse dynamics it needs no acceleration, and unlike the filter no noise levels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bampipe.errors import InputError

Array = NDArray[np.float64]

_SMALLEST_SHARE = 1e-3


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
    """

    p: Array
    covariance: Array
    rms: Array
    iterations: int
    converged: bool


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
        kept = np.abs(np.diag(upper)) > 1e-12 * np.max(np.abs(upper))
        basis = basis[:, kept]
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
            start.
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
        raise InputError(
            "the simulated motion grows without bound",
            where="output error",
            remedy="start from the parameters of `--method least-squares`",
        )
    weight = _weight(errors)
    converged, iterations = False, 0
    while iterations < most_iterations and not converged:
        iterations += 1
        linear = [
            _linearise(segment, x0, p, free, upper, step, weight)
            for segment, x0 in zip(segments, states, strict=True)
        ]
        parts = [item.projected for item in linear]
        move = _bounded(parts, p[free], lower, upper)
        cost, share = _cost(errors, weight), 1.0
        while True:
            moved = p.copy()
            moved[free] = np.clip(p[free] + share * move, lower, upper)
            tried = [
                x0 + share * _of_state(item, move) for x0, item in zip(states, linear, strict=True)
            ]
            new = _errors(segments, tried, moved)
            gained = cost - _cost(new, weight)
            if gained > 0.0 or share < _SMALLEST_SHARE:
                break
            share /= 2.0
        converged = not gained > 1e-8 * cost
        if gained > 0.0:
            p, states, errors = moved, tried, new
            weight = _weight(errors)
    linear = [
        _linearise(segment, x0, p, free, upper, step, weight)
        for segment, x0 in zip(segments, states, strict=True)
    ]
    return OutputError(
        p=p,
        covariance=_sandwich([item.projected for item in linear]),
        rms=1.0 / weight,
        iterations=iterations,
        converged=converged,
    )


def _errors(segments: Sequence[Segment], states: Sequence[Array], p: Array) -> list[Array]:
    return [s.q - s.simulate(x0, p) for s, x0 in zip(segments, states, strict=True)]


def _weight(errors: Sequence[Array]) -> Array:
    return np.asarray(1.0 / np.sqrt(np.mean(np.square(np.concatenate(errors)), axis=0)))


def _cost(errors: Sequence[Array], weight: Array) -> float:
    total = float(sum(np.sum(np.square(error * weight)) for error in errors))
    return total if np.isfinite(total) else np.inf


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
    for k, place in enumerate(free):
        moved = p.copy()
        size = step[k] if p[place] + step[k] <= upper[k] else -step[k]
        moved[place] += size
        by_parameter[:, k] = ((segment.simulate(x0, moved) - base) / size * weight).reshape(-1)
    return _Linear(((segment.q - base) * weight).reshape(-1), by_state, by_parameter)


def _of_state(linear: _Linear, move: Array) -> Array:
    """Change of the initial state that goes with a change of the parameters."""
    rest = linear.error - linear.by_parameter @ move
    return np.asarray(np.linalg.lstsq(linear.by_state, rest, rcond=1e-12)[0])


def _bounded(
    parts: Sequence[tuple[Array, Array]], value: Array, lower: Array, upper: Array
) -> Array:
    """Step of the parameters; those that would leave their range stop at the bound."""
    normal = np.sum([slope.T @ slope for _, slope in parts], axis=0)
    side = np.sum([slope.T @ error for error, slope in parts], axis=0)
    move, free = np.zeros(value.size), np.ones(value.size, dtype=bool)
    for _ in range(value.size):
        rest = side - normal[:, ~free] @ move[~free]
        move[free] = np.linalg.lstsq(normal[np.ix_(free, free)], rest[free], rcond=1e-14)[0]
        outside = free & ((value + move < lower) | (value + move > upper))
        if not outside.any():
            break
        move[outside] = np.clip(value + move, lower, upper)[outside] - value[outside]
        free &= ~outside
    return move


def _sandwich(parts: Sequence[tuple[Array, Array]]) -> Array:
    bread = np.sum([slope.T @ slope for _, slope in parts], axis=0)
    scores = np.array([slope.T @ error for error, slope in parts])
    inverse = np.linalg.pinv(bread, hermitian=True)
    count = len(parts)
    spread = scores.T @ scores * (count / max(count - scores.shape[1], 1))
    return np.asarray(inverse @ spread @ inverse)
