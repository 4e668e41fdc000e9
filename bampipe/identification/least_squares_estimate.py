"""Least squares on the inverse dynamics, freed of the bias that filtered motions give it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.least_squares import fit
from bampipe.estimate.normal_equations import NormalEquations
from bampipe.identification.estimates import Estimate, estimate_of_fit, trace_row
from bampipe.physics import System
from bampipe.trials.bias import UnbiasedFit
from bampipe.trials.folds import Folds
from bampipe.trials.motion import Motion

Array = NDArray[np.float64]

_FARTHEST = 3.0
"""Standard deviations that a nonlinear fit moves at most where a trial is left out."""


def estimate_by_least_squares(
    system: System, motions: Sequence[Motion], squares: UnbiasedFit, folds: Folds
) -> Estimate:
    """Return the least-squares estimate; its trace is the fit to the trials so far."""
    problem, raw = squares.problem, squares.raw
    unbiased = replace(raw, covariance=squares.covariance)
    shift = 0.0 if squares.bias is None else squares.bias

    def rows() -> list[dict[str, object]]:
        trace: list[dict[str, object]] = []
        clock = 0.0
        for number, motion in enumerate(motions):
            clock += float(motion.t[-1])
            so_far = fit(problem, raw.p, trials=range(number + 1))
            row = trace_row(system, problem, so_far, shift)
            trace.append({"t_total": clock, "trial_id": motion.trial_id, **row})
        return trace

    residual_sd = dict(zip(system.coordinates, raw.residual_sd, strict=True))
    return estimate_of_fit(
        "least-squares", system, motions, problem, unbiased, squares.p,
        _leave_out(squares, folds), bias_details(squares), rows, residual_sd=residual_sd,
    )  # fmt: skip


def _leave_out(squares: UnbiasedFit, folds: Folds) -> list[Array]:
    """Return the parameters (n_p + 1,) without the trials that each is left out with.

    A step of Gauss and Newton from the fit to all, no longer than a few standard deviations where
    the model is nonlinear: farther away the slopes are others.
    """
    raw, problem = squares.raw, squares.problem
    free = problem.free
    lower, upper = problem.lower - raw.p[free], problem.upper - raw.p[free]
    if not problem.linear:
        sd = np.sqrt(np.diag(raw.covariance))
        lower, upper = np.maximum(lower, -_FARTHEST * sd), np.minimum(upper, _FARTHEST * sd)
    stacked = raw.measured
    sums = NormalEquations.from_samples(
        [s.slope for s in stacked], [s.residual for s in stacked], [s.used for s in stacked],
        problem.precision, problem.known - raw.p[free],
    )  # fmt: skip
    weight = 1.0 / np.maximum(raw.residual_sd, 1e-150) ** 2
    found = []
    for step in folds.solve(sums, weight, lower, upper):
        p = squares.p.copy()
        p[free] = np.clip(p[free] + step, problem.lower, problem.upper)
        found.append(p)
    return found


def bias_details(squares: UnbiasedFit) -> list[dict[str, float]]:
    """Return, for each free parameter, the bias that was taken off."""
    if squares.bias is None:
        return [{} for _ in squares.problem.free]
    return [{"least_squares_bias": bias} for bias in squares.bias]
