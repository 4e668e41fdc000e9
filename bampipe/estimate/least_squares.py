"""Least squares on the inverse dynamics, with both sides of the equation filtered alike.

The residual of the inverse dynamics is a torque minus a sum of regressors. Velocities from encoders
are low-passed, forces are not, and the sign of a velocity has sharp edges: in a fit of the raw
signals, the mismatch would appear as physics. So the residual as a whole, and its slope by every
parameter, passes one zero-phase low-pass and is thinned to nearly independent samples, by trial.

This module depends only on arrays and callables.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bampipe.arrays import Array, Flags, Indices
from bampipe.errors import InputError
from bampipe.estimate.bounded import invert_scaled, solve_bounded
from bampipe.estimate.low_pass import Band
from bampipe.estimate.standstill import find_moving_samples

BLOCKS_A_PARAMETER = 3
"""Fewest blocks per parameter. With fewer, their scatter determines a standard deviation only to a
third: 95 % intervals covered 89 % of 320 parameters of independently simulated joints; with this
number, 93 % of 163 on other seeds."""
_LEAST_STEP = 1e-8
"""Finite difference relative to the parameter: half the digits of a number."""
_SMALLEST_SHARE = 1e-3
"""Fraction of a Gauss-Newton step at which its halving ends."""
_LARGEST = 1e100
"""A residual or slope above this has no finite square."""
Residual = Callable[[int, Array], Array]
"""residual(trial, p) -> (T, n_q): unfiltered residual of one trial for parameters p (np,)."""
Slopes = Callable[[int, Array], tuple[Sequence[int], Array]]
"""slopes(trial, p) -> numbers of the free parameters whose slopes need no finite differences, and
the unfiltered slopes of the residual by them (T, n_q, n)."""


class NotFinite(InputError):
    """The residual of a model is not a finite number."""


@dataclass(frozen=True)
class Stacked:
    """Residual and slopes of one trial after the low-pass.

    Attributes:
        residual: (K, n_q), N.m or N, zero where not used.
        slope: (K, n_q, n_free), its derivative by the free parameters, zero where not used.
        used: (K, n_q) which samples count.
    """

    residual: Array
    slope: Array
    used: Flags


@dataclass(frozen=True)
class Problem:
    """A least-squares problem: a model as a function that returns residuals.

    Attributes:
        residual: the unfiltered residual of a trial; see `Residual`.
        n_trials: number of trials.
        free: indices of the estimated parameters in p.
        lower, upper: (n_free,) their bounds.
        step: (n_free,) sizes of their finite differences; any size is exact if the residual is
            linear in the parameter.
        linear: whether the residual is linear in all of them.
        band: the low-pass.
        standstill: by trial, (T, n_q) whether an axis stands still; see `find_standstill`.
        precision: (n_free,) inverse variances of the priors, zero without a prior; known: (n_free,)
            their means.
        slopes: the slopes that need no finite differences; see `Slopes`.
        keep: stores linearised trials, which may exceed the memory in a long session.
        multiplied: (n_free,) axis whose measured force a parameter multiplies, as a torque constant
            multiplies a current, at most one parameter per axis; -1 for others, and for all by
            default. Because a small factor would leave a small residual without explaining
            anything, the likelihood is that of the measured force.
        parts: rows of a joined trial between which the low-pass restarts.
    """

    residual: Residual
    n_trials: int
    free: Indices
    lower: Array
    upper: Array
    step: Array
    linear: bool
    band: Band
    standstill: Sequence[Flags]
    precision: Array
    known: Array
    slopes: Slopes | None = None
    multiplied: Indices | None = None
    parts: Callable[[int], Sequence[slice]] = lambda trial: (slice(None),)
    keep: Callable[[Iterable[Stacked]], Sequence[Stacked]] = list


def residual_and_slopes(problem: Problem, trial: int, p: Array) -> tuple[Array, Array]:
    """Unfiltered residual of one trial (T, n_q) and its slopes (T, n_q, n_free) at ``p`` (np,).

    Slopes that the model does not supply are finite differences, forward, or backward at a bound.
    """
    base = problem.residual(trial, p)
    # Each slope is contiguous, since it is written and read alone.
    slopes = np.empty((problem.free.size, *base.T.shape)).transpose(2, 1, 0)
    given: Sequence[int] = ()
    if problem.slopes is not None:
        given, known = problem.slopes(trial, p)
        slopes[:, :, given] = known
    for k in sorted({*range(problem.free.size)} - {*given}):
        index, moved = problem.free[k], p.copy()
        # A replicate of an incomplete model can run far from any prior, where a step is rounding.
        step = max(problem.step[k], _LEAST_STEP * abs(p[index]))
        moved[index] += step
        if moved[index] > problem.upper[k]:
            moved[index] = p[index] - step
        slopes[:, :, k] = (problem.residual(trial, moved) - base) / (moved[index] - p[index])
    return base, slopes


def stacked_residual(problem: Problem, trial: int, p: Array) -> Stacked:
    """Low-pass and thin the residual of one trial and its slope by every free parameter.

    It is linearised at ``p`` (np,).
    """
    base, slopes = residual_and_slopes(problem, trial, p)
    count, n_q, n_free = slopes.shape
    # A body of a robot does not act on joints behind it: half of the columns are empty.
    axes, numbers = np.nonzero(slopes.any(axis=0))
    columns = np.empty((count, n_q + axes.size))
    columns[:, :n_q], columns[:, n_q:] = base, slopes[:, axes, numbers]
    rows = (columns[part] for part in problem.parts(trial))
    thin = np.concatenate(problem.band.thin_trials(rows, [*range(n_q), *map(int, axes)]))
    still = problem.standstill[trial]
    moving = (find_moving_samples(still[part], problem.band) for part in problem.parts(trial))
    used = np.concatenate([*moving])
    slope = np.zeros((len(thin), n_q, n_free))
    slope[:, axes, numbers] = thin[:, n_q:] * used[:, axes]
    return Stacked(thin[:, :n_q] * used, slope, used)


def minimise(
    problem: Problem,
    start: Array,
    trials: Sequence[int] | None = None,
    most_iterations: int = 30,
    *,
    tolerance: float = 1e-10,
) -> "Linearised":
    """Minimise the sum of squares, weighted by axis, over the free parameters within bounds.

    Each axis is weighted by the scatter of its own residual, iteratively. If the residual is
    nonlinear, Gauss-Newton steps are halved until the cost falls.

    Args:
        start: (np,) parameters to start from; trials: numbers of those to use, all by default.
        most_iterations: largest number of Gauss-Newton steps; 0 only linearises at ``start``.
        tolerance: change of the negative log likelihood per sample at which the descent ends.

    Raises:
        ValueError: fewer samples are clear of standstill than there are parameters to fit.
        NotFinite: the residual or its slope at ``start`` is not a finite number.
    """
    chosen = list(range(problem.n_trials)) if trials is None else list(trials)
    p = np.array(start, dtype=float)
    p[problem.free] = np.clip(p[problem.free], problem.lower, problem.upper)
    stacked = problem.keep(stacked_residual(problem, k, p) for k in chosen)
    for trial, s in zip(chosen, stacked, strict=True):
        _require_finite(problem, trial, s, p)
    if most_iterations and sum(int(s.used.sum()) for s in stacked) <= problem.free.size:
        raise ValueError("fewer samples clear of standstill than parameters")
    start_at = Linearised(problem, chosen, p, stacked)
    return descend(start_at, problem.lower, problem.upper, most_iterations, tolerance)


@dataclass(frozen=True)
class Linearised:
    """Trials linearised at parameters ``p``; the iterate of `descend`.

    Attributes:
        problem, trials: the model, and the numbers of the trials.
        p: (np,) parameters, including those not free; stacked: the trials, linearised there.
    """

    problem: Problem
    trials: Sequence[int]
    p: Array
    stacked: Sequence[Stacked]

    @property
    def value(self) -> Array:
        return np.asarray(self.p[self.problem.free])

    @property
    def cost(self) -> float:
        """Negative log likelihood per sample, with an unknown scatter of each axis."""
        count = np.sum([np.sum(s.used, axis=0) for s in self.stacked], axis=0)
        scatter = np.log(np.maximum(_scatter(self.stacked), 1e-300))
        off = self.value - self.problem.known
        prior = 0.5 * float(self.problem.precision @ off**2)
        # The change of variables from the measured force to the residual, once per sample.
        volume = sum(
            float(count[axis]) * np.log(max(abs(self.value[k]), 1e-300))
            for k, axis in _factors(self.problem)
        )
        return (float(np.sum(count * scatter)) + prior - volume) / max(float(np.mean(count)), 1.0)

    def normal_equations(self) -> tuple[Array, Array]:
        """Return slope^T slope (n, n) and minus slope^T residual (n,), weighted by axis."""
        weight = 1.0 / np.maximum(_scatter(self.stacked), 1e-300)
        n_free = self.problem.free.size
        precision = self.problem.precision
        normal, moment = np.diag(precision), precision * (self.problem.known - self.value)
        for s in as_measured(self.problem, self.p, self.stacked):
            slope = (s.slope * weight[None, :, None]).reshape(-1, n_free)
            normal += slope.T @ slope
            moment -= slope.T @ (s.residual * weight).reshape(-1)
        return normal, moment

    def moved(self, value: Array) -> "Linearised":
        """Return the trials linearised at the free parameters ``value``, (n_free,)."""
        p = self.p.copy()
        p[self.problem.free] = value
        if self.problem.linear:
            step = value - self.value
            stacked = self.problem.keep(
                Stacked(s.residual + s.slope @ step, s.slope, s.used) for s in self.stacked
            )
        else:
            stacked = self.problem.keep(stacked_residual(self.problem, k, p) for k in self.trials)
        return replace(self, p=p, stacked=stacked)


def descend(
    start: Linearised, lower: Array, upper: Array, most_iterations: int, tolerance: float = 1e-10
) -> Linearised:
    """Take Gauss-Newton steps within bounds (n,), each halved until the cost does not rise.

    The descent has converged if the cost changes by less than ``tolerance``.
    """
    at = start
    for _ in range(most_iterations):
        step = solve_bounded(*at.normal_equations(), lower - at.value, upper - at.value)
        share = 1.0
        while True:
            tried = at.moved(np.clip(at.value + share * step, lower, upper))
            gained = at.cost - tried.cost
            if gained >= 0.0 or share < _SMALLEST_SHARE:
                break
            share /= 2.0
        at = tried if gained >= 0.0 else at
        if not gained >= tolerance:
            break
    return at


def _factors(problem: Problem) -> list[tuple[int, int]]:
    """Indices of the free parameters that multiply the measurement, each with its axis."""
    if problem.multiplied is None:
        return []
    return [(k, int(axis)) for k, axis in enumerate(problem.multiplied) if axis >= 0]


def as_measured(problem: Problem, p: Array, stacked: Iterable[Stacked]) -> Iterator[Stacked]:
    """Yield trials with slopes of the residual divided by its axis' factor, times that factor.

    These slopes are zero along a proportional change of all parameters of an axis, whose scale the
    residual does not determine. The trials are linearised at ``p`` (np,).
    """
    factors = _factors(problem)
    for s in stacked:
        slope = s.slope.copy() if factors else s.slope
        for k, axis in factors:
            value = p[problem.free[k]]
            slope[:, axis, k] -= s.residual[:, axis] / (value if value != 0.0 else 1e-300)
        yield replace(s, slope=slope)


def _require_finite(problem: Problem, trial: int, stacked: Stacked, p: Array) -> None:
    """Name the parameter that makes the residual of a trial not finite at the start of the fit."""
    residual, slope = (np.abs(x) < _LARGEST for x in (stacked.residual, stacked.slope))
    if not residual.all():
        culprit = "with the parameters that the fit starts from"
    elif not slope.all():
        index = problem.free[int(np.argmin(slope.all(axis=(0, 1))))]
        culprit = f"as soon as parameter number {index + 1}, {p[index]:.4g}, changes"
    else:
        return
    place = f" on trial number {trial + 1}" if problem.n_trials > 1 else ""
    raise NotFinite(
        f"the model gives no finite force{place} {culprit}",
        where="least squares",
        remedy="narrow the bounds of the newest effect's parameters, or change their priors",
    )


def _scatter(stacked: Sequence[Stacked]) -> Array:
    square = np.sum([np.sum(s.residual**2, axis=0) for s in stacked], axis=0)
    count = np.sum([np.sum(s.used, axis=0) for s in stacked], axis=0)
    return np.asarray(np.sqrt(square / np.maximum(count, 1)))


def covariance_by_blocks(
    rows: Iterable[tuple[Array, Array]],
    precision: Array,
    blocks: Sequence[Indices],
    independent: Sequence[float],
) -> Array:
    """Covariance (P, P) from the scatter of the scores of blocks of time (White; Newey and West).

    At the minimum the scores of all blocks sum to zero; with as many parameters as blocks, some
    combination does not scatter at all. If blocks are few, the covariance is therefore at least
    that of independent samples.

    Args:
        rows: by axis, slopes (n, P) and residual (n,), in standard deviations of the residual.
        precision: (P, P) precision of the prior.
        blocks: by axis, (n,) numbers of the blocks, which are independent of each other.
        independent: by axis, the number of independent samples.
    """
    count = 1 + max((int(number.max()) for number in blocks if number.size), default=0)
    scores, size = np.zeros((count, len(precision))), np.zeros((count, 1))
    products, white = np.zeros_like(precision), np.array(precision)
    for (x, left), number, alone in zip(rows, blocks, independent, strict=True):
        np.add.at(scores, number, x * left[:, None])
        np.add.at(size, number, 1.0)
        square = x.T @ x
        products, white = products + square, white + alone / max(len(x), 1) * square
    normal = precision + products
    inverse = invert_scaled(normal)
    fitted = float(np.trace(inverse @ (normal - precision)))
    # The pull of priors and bounds, common to all blocks, is no scatter.
    scores -= scores.sum(axis=0) * size / size.sum()
    filled = int(np.count_nonzero(size))
    meat = scores.T @ scores * (filled / max(filled - fitted, 1.0)) + precision
    found = np.asarray(inverse @ meat @ inverse)
    if filled >= BLOCKS_A_PARAMETER * fitted:
        return found
    whole = float(sum(independent))
    least = np.diag(invert_scaled(white)) * whole / max(whole - fitted, 1.0)
    variance = np.diag(found)
    none = variance <= 0.0
    widen = np.sqrt(np.maximum(least / np.where(none, 1.0, variance), 1.0))
    widen[none] = 1.0
    return np.asarray(found * np.outer(widen, widen) + np.diag(np.where(none, least, 0.0)))
