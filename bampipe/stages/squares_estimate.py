"""Least squares on the inverse dynamics, freed of the bias that filtered motions give it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bampipe.errors import InputError
from bampipe.estimate.least_squares import LeastSquares, Problem, fit
from bampipe.physics import System
from bampipe.stages.estimates import Estimate, timing_entry
from bampipe.stages.filter_tables import as_filtered
from bampipe.stages.motions import Motion, problem_of
from bampipe.stages.replayed import replayed

Array = NDArray[np.float64]


def problem_with(problem: Problem, timing: bool) -> Problem:
    """Return the problem with the timing of the inputs estimated or held as it is given."""
    if timing:
        return problem
    return replace(
        problem,
        free=problem.free[:-1],
        lower=problem.lower[:-1],
        upper=problem.upper[:-1],
        step=problem.step[:-1],
    )


@dataclass(frozen=True)
class Squares:
    """Least squares with its bias taken off.

    Attributes:
        raw: the fit; p: (n_p + 1,) without its bias, within the bounds.
        bias: (n_free,) what was taken off; None where the model could not be replayed.
        problem: what was fitted.
    """

    raw: LeastSquares
    p: Array
    bias: Array | None
    problem: Problem


def unbiased(
    session: Mapping[str, Any],
    settings: Mapping[str, Any],
    system: System,
    motions: Sequence[Motion],
    problem: Problem,
    raw: LeastSquares,
) -> Squares:
    """Take off what the filters alone do to the fit.

    Filtering blurs changes of direction and shortens accelerations, so that the fit to a perfect
    machine is not its truth. How far off it is, is measured: the fitted model is replayed along
    the trials, read by the same encoders, sent through the same filters and fitted again
    (parametric bootstrap, Efron and Tibshirani 1993, chapter 10; indirect inference). The force
    sensor is without noise there: its noise adds scatter, not bias.

    Args:
        session: ``ingest/session.json``; settings: ``filter/filter.json``.
        system: the model; motions: the trials; problem: as fitted; raw: the fit.
    """
    own = raw.p[: len(system.parameters)]
    rate = problem.band.rate_hz
    try:
        seen = replayed(session, settings, system, motions, own, rate, (0, 0), force_noise=False)
    except (
        InputError
    ):  # a model that lacks much may not hold the motion; it has no bias to speak of
        return Squares(raw, raw.p, None, problem)
    timing = bool(problem.free[-1] == len(own))
    again = fit(problem_with(problem_of(system, seen, problem.band), timing), raw.p)
    truth = np.append(own, 0.0)
    bias = (again.p - truth)[problem.free]
    p = raw.p.copy()
    p[problem.free] = np.clip(p[problem.free] - bias, problem.lower, problem.upper)
    return Squares(raw, p, bias, problem)


def estimate_by_squares(system: System, motions: Sequence[Motion], squares: Squares) -> Estimate:
    """Return the least-squares estimate; its trace is the fit to the trials so far."""
    problem, raw = squares.problem, squares.raw
    kept = [k for k, i in enumerate(problem.free) if i < len(system.parameters)]
    names = [system.parameters[problem.free[k]].name for k in kept]
    shift = np.zeros(problem.free.size) if squares.bias is None else squares.bias
    rows, clock = [], 0.0
    for number, motion in enumerate(motions):
        clock += float(motion.t[-1])
        so_far = fit(problem, raw.p, trials=range(number + 1))
        row: dict[str, object] = {"t_total": clock, "trial_id": motion.trial_id}
        for k, name in zip(kept, names, strict=True):
            row[name] = so_far.p[problem.free[k]] - shift[k]
            row[f"{name}_sd"] = float(np.sqrt(so_far.covariance[k, k]))
        rows.append(row)
    frames = [as_filtered(system, motion, squares.p[:-1]) for motion in motions]
    sd = 3.0 * np.median(np.concatenate([motion.qd_sd for motion in motions]), axis=0)
    timed = len(kept) < problem.free.size
    report: dict[str, object] = {
        "input_timing": timing_entry(squares.p, raw.covariance[-1, -1] if timed else 0.0),
        "residual_sd": dict(zip(system.coordinates, map(float, raw.residual_sd), strict=True)),
        "convergence": {"iterations": raw.iterations, "converged": raw.converged},
        "state_3sigma": {
            axis: {"velocity": float(sd[i])} for i, axis in enumerate(system.coordinates)
        },
    }
    return Estimate(
        p=squares.p,
        problem=problem,
        covariance=raw.covariance[np.ix_(kept, kept)],
        at_bound=raw.at_bound[kept],
        details=bias_details(squares, kept),
        report=report,
        states=pd.concat(frames, ignore_index=True),
        trace=pd.DataFrame(rows),
    )


def bias_details(squares: Squares, kept: Sequence[int]) -> list[dict[str, float]]:
    """Return, for each of the parameters ``kept``, the bias that was taken off."""
    if squares.bias is None:
        return [{} for _ in kept]
    return [{"least_squares_bias": float(squares.bias[k])} for k in kept]
