"""Least squares on the inverse dynamics, both sides of the equation filtered alike.

A residual of the inverse dynamics is torque minus a sum of regressors. Velocities from encoders
are low-passed, forces are not, and the sign of a velocity has sharp edges: fitted raw, the
mismatch passes for physics. So the residual as a whole, and its slope by every parameter, goes
through one zero-phase low-pass and is thinned to what that leaves independent, trial by trial.

Everything here sees arrays and callables only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bampipe.errors import InputError
from bampipe.estimate.low_pass import Band
from bampipe.estimate.standstill import moving

Array = NDArray[np.float64]
Residual = Callable[[int, Array], Array]
"""residual(trial, p) -> (T, n_q): unfiltered residual of one trial for parameters p (np,)."""


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
    used: NDArray[np.bool_]


@dataclass(frozen=True)
class Problem:
    """A model seen as residuals.

    Attributes:
        residual: the unfiltered residual of a trial; see `Residual`.
        n_trials: number of trials.
        free: indices of the estimated parameters in p.
        lower, upper: (n_free,) their bounds.
        step: (n_free,) sizes of their finite differences; any size does where the residual is
            linear in the parameter.
        linear: whether the residual is linear in all of them.
        band: the low-pass.
        resting: by trial, (T, n_q) whether an axis stands still; see `resting`.
    """

    residual: Residual
    n_trials: int
    free: NDArray[np.int64]
    lower: Array
    upper: Array
    step: Array
    linear: bool
    band: Band
    resting: Sequence[NDArray[np.bool_]]


@dataclass(frozen=True)
class LeastSquares:
    """Fitted parameters and what they rest on.

    Attributes:
        p: (np,) parameters, those not free as given.
        covariance: (n_free, n_free) sandwich estimate: blocks of time are independent, samples
            within one are not.
        residual_sd: (n_q,) root mean square of the low-passed residual.
        stacked: by trial, linearised at ``p``.
        iterations: Gauss-Newton steps taken.
        converged: whether the last step no longer changed the fit.
        at_bound: (n_free,) which parameters ended on a bound.
    """

    p: Array
    covariance: Array
    residual_sd: Array
    stacked: tuple[Stacked, ...]
    iterations: int
    converged: bool
    at_bound: NDArray[np.bool_]


def stacked_residual(problem: Problem, trial: int, p: Array) -> Stacked:
    """Low-pass and thin the residual of one trial and its slope by every free parameter.

    Args:
        problem: the model as residuals.
        trial: index of the trial.
        p: (np,) parameters at which to linearise, by forward differences.
    """
    base = problem.residual(trial, p)
    n_q, n_free = base.shape[1], problem.free.size
    columns = np.empty((len(base), n_q * (n_free + 1)))
    columns[:, :n_q] = base
    for k, place in enumerate(problem.free):
        moved = p.copy()
        moved[place] += problem.step[k]
        if moved[place] > problem.upper[k]:
            moved[place] = p[place] - problem.step[k]
        difference = (problem.residual(trial, moved) - base) / (moved[place] - p[place])
        columns[:, (k + 1) * n_q : (k + 2) * n_q] = difference
    thin = problem.band.thin(columns)
    used = moving(problem.resting[trial], problem.band)
    slope = thin[:, n_q:].reshape(len(thin), n_free, n_q).transpose(0, 2, 1)
    return Stacked(thin[:, :n_q] * used, np.ascontiguousarray(slope * used[:, :, None]), used)


def fit(
    problem: Problem,
    start: Array,
    trials: Sequence[int] | None = None,
    most_iterations: int = 30,
    block_s: float = 2.0,
) -> LeastSquares:
    """Estimate the free parameters by weighted least squares within their bounds.

    Each axis is weighted by the scatter of its own residual, which is iterated; parameters in
    which the residual is not linear are found by Gauss-Newton with halved steps.

    Args:
        problem: the model as residuals.
        start: (np,) parameters to start from.
        trials: which trials to use; all by default.
        most_iterations: the most Gauss-Newton steps.
        block_s: length of the blocks of the covariance, s.

    Raises:
        ValueError: there are fewer samples than parameters.
        InputError: the residual or its slope at ``start`` is not a finite number.
    """
    chosen = list(range(problem.n_trials)) if trials is None else list(trials)
    p = np.array(start, dtype=float)
    p[problem.free] = np.clip(p[problem.free], problem.lower, problem.upper)
    stacked = [stacked_residual(problem, trial, p) for trial in chosen]
    for trial, s in zip(chosen, stacked, strict=True):
        _require_finite(problem, trial, s, p)
    if sum(len(s.residual) for s in stacked) <= problem.free.size:
        raise ValueError("fewer samples than parameters")
    iterations, converged = 0, False
    while iterations < most_iterations:
        iterations += 1
        before, cost = p, _cost(stacked)
        target = refit(stacked, p[problem.free], problem.lower, problem.upper)
        share = 1.0
        while True:
            moved = before.copy()
            moved[problem.free] += share * (target - before[problem.free])
            if problem.linear:
                tried = [_moved(s, (moved - before)[problem.free]) for s in stacked]
            else:
                tried = [stacked_residual(problem, trial, moved) for trial in chosen]
            gained = cost - _cost(tried)
            if gained >= 0.0 or share < 1e-3:
                break
            share /= 2.0
        converged = abs(gained) < 1e-10
        if gained >= 0.0:
            p, stacked = moved, tried
        if gained < 1e-10:
            break
    value = p[problem.free]
    covariance = _sandwich(problem, stacked, block_s)
    return LeastSquares(
        p=p,
        covariance=covariance,
        residual_sd=_scatter(stacked),
        stacked=tuple(stacked),
        iterations=iterations,
        converged=converged,
        at_bound=np.asarray((value <= problem.lower) | (value >= problem.upper)),
    )


def _require_finite(problem: Problem, trial: int, stacked: Stacked, p: Array) -> None:
    """Say which parameter makes the residual of a trial no number where the fit starts."""
    if not np.isfinite(stacked.residual).all():
        culprit = "with the parameters that the fit starts from"
    elif not np.isfinite(stacked.slope).all():
        place = problem.free[int(np.argmin(np.isfinite(stacked.slope).all(axis=(0, 1))))]
        culprit = f"as soon as parameter number {place + 1}, {p[place]:.4g}, changes"
    else:
        return
    raise InputError(
        f"the model gives no finite force on trial number {trial + 1} {culprit}",
        where="least squares",
        remedy="narrow the bounds of the newest effect's parameters, or change their priors",
    )


def refit(
    stacked: Sequence[Stacked],
    value: Array,
    lower: Array,
    upper: Array,
) -> Array:
    """Solve the linearised problem within bounds; exact where the model is linear.

    Bounds are kept by the active-set rule of Lawson and Hanson: a parameter that would leave its
    range is held at the bound and the others are solved again.

    Args:
        stacked: trials to use, linearised at ``value``; leave one out to hold it out.
        value: (n_free,) where they are linearised; lower, upper: (n_free,).

    Returns:
        (n_free,) estimates.
    """
    weight = 1.0 / np.maximum(_scatter(stacked), 1e-300)
    n_free = value.size
    normal, side = np.zeros((n_free, n_free)), np.zeros(n_free)
    for s in stacked:
        slope = (s.slope * weight[None, :, None]).reshape(-1, n_free)
        normal += slope.T @ slope
        side -= slope.T @ (s.residual * weight).reshape(-1)
    scale = np.sqrt(np.diag(normal))
    scale[scale == 0.0] = 1.0
    step = np.zeros(n_free)
    free = np.ones(n_free, dtype=bool)
    for _ in range(n_free + 1):
        rest = side - normal[:, ~free] @ step[~free]
        part = normal[np.ix_(free, free)] / np.outer(scale[free], scale[free])
        solved = np.linalg.lstsq(part, rest[free] / scale[free], rcond=1e-12)[0] / scale[free]
        step[free] = solved
        outside = free & ((value + step < lower) | (value + step > upper))
        if not outside.any():
            break
        step[outside] = np.clip(value + step, lower, upper)[outside] - value[outside]
        free &= ~outside
    return np.asarray(value + step)


def _moved(stacked: Stacked, step: Array) -> Stacked:
    return Stacked(stacked.residual + stacked.slope @ step, stacked.slope, stacked.used)


def _scatter(stacked: Sequence[Stacked]) -> Array:
    square = np.sum([np.sum(s.residual**2, axis=0) for s in stacked], axis=0)
    count = np.sum([np.sum(s.used, axis=0) for s in stacked], axis=0)
    return np.asarray(np.sqrt(square / np.maximum(count, 1)))


def _cost(stacked: Sequence[Stacked]) -> float:
    """Negative log likelihood a sample where each axis has its own unknown scatter."""
    return float(np.sum(np.log(np.maximum(_scatter(stacked), 1e-300))))


def _sandwich(problem: Problem, stacked: Sequence[Stacked], block_s: float) -> Array:
    """Covariance from the scatter of the scores of blocks of time (White; Newey and West)."""
    weight = 1.0 / np.maximum(_scatter(stacked), 1e-300)
    n_free = problem.free.size
    band = problem.band
    samples = max(1, round(block_s * band.rate_hz / band.step))
    bread, meat, blocks = np.zeros((n_free, n_free)), np.zeros((n_free, n_free)), 0
    for s in stacked:
        slope = s.slope * weight[None, :, None]
        bread += np.einsum("tqi,tqj->ij", slope, slope)
        score = np.einsum("tqi,tq->ti", slope, s.residual * weight)
        for start in range(0, len(score), samples):
            part = score[start : start + samples].sum(axis=0)
            meat += np.outer(part, part)
            blocks += 1
    held = problem.lower == problem.upper
    bread[held], bread[:, held], meat[held], meat[:, held] = 0.0, 0.0, 0.0, 0.0
    inverse = np.linalg.pinv(bread, hermitian=True)
    return np.asarray(inverse @ meat @ inverse * (blocks / max(blocks - n_free, 1)))
