"""An estimate of a model's parameters, whatever method made it, and what identify.json says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bampipe.estimate.least_squares import LeastSquares, Problem
from bampipe.estimate.output_error import OutputError
from bampipe.identification.filter_tables import as_filtered
from bampipe.physics import System
from bampipe.results.identify import (
    Convergence,
    Covariance,
    IdentifiabilityReport,
    IdentifyResult,
    InputTiming,
    ParameterEstimate,
    StateBound,
)
from bampipe.trials.motion import Motion

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """Parameters with what belongs to them, physical units, those estimated in order.

    Attributes:
        p: (n_p + 1,) all parameters, the timing of the inputs last.
        problem: the inverse dynamics, its free parameters those estimated, the timing last
            where it was.
        covariance: (n, n) of the estimated parameters of the model.
        at_bound: (n,) which lie at the limit of their range.
        details: by parameter, further fields of its record.
        report: further fields of the result.
        states, trace: tables.
    """

    p: Array
    problem: Problem
    covariance: Array
    at_bound: NDArray[np.bool_]
    details: Sequence[dict[str, float]]
    report: dict[str, Any]
    states: pd.DataFrame
    trace: pd.DataFrame


def input_timing(p: Array, variance: float) -> InputTiming:
    """Return the timing of the inputs, the last of ``p``."""
    return InputTiming(estimate=p[-1], sd=np.sqrt(variance), unit="s")


def trace_row(
    system: System, problem: Problem, fit: LeastSquares | OutputError, bias: Array | float = 0.0
) -> dict[str, float]:
    """Return the parameters and their standard deviations as ``trace.parquet`` has them."""
    found, sd = fit.p[problem.free] - bias, np.sqrt(np.diag(fit.covariance))
    row: dict[str, float] = {}
    for k, place in enumerate(problem.free):
        if place < len(system.parameters):
            name = system.parameters[place].name
            row |= {name: found[k], f"{name}_sd": sd[k]}
    return row


def estimate_of_fit(
    system: System,
    motions: Sequence[Motion],
    problem: Problem,
    fit: LeastSquares | OutputError,
    p: Array,
    details: Sequence[dict[str, float]],
    rows: Sequence[Mapping[str, object]],
    **report: object,
) -> Estimate:
    """Return the estimate of a method that leaves the motion as the filter stage did.

    Args:
        system: the model; motions: the trials; problem: what was fitted; fit: the outcome.
        p: (n_p + 1,) the estimate, without bias.
        details, report: as of `Estimate`; rows: of its trace.
    """
    model_indices = [k for k, place in enumerate(problem.free) if place < len(system.parameters)]
    timed = len(model_indices) < problem.free.size
    sd = 3.0 * np.median(np.concatenate([motion.qd_sd for motion in motions]), axis=0)
    frames = [as_filtered(system, motion, p[:-1]) for motion in motions]
    return Estimate(
        p=p,
        problem=problem,
        covariance=fit.covariance[np.ix_(model_indices, model_indices)],
        at_bound=fit.at_bound[model_indices],
        details=[details[k] for k in model_indices],
        report={
            "input_timing": input_timing(p, fit.covariance[-1, -1] if timed else 0.0),
            "convergence": Convergence(iterations=fit.iterations, converged=fit.converged),
            "state_3sigma": {
                axis: StateBound(velocity=sd[i]) for i, axis in enumerate(system.coordinates)
            },
            **report,
        },
        states=pd.concat(frames, ignore_index=True),
        trace=pd.DataFrame(rows),
    )


def collect_result(
    system: System,
    estimate: Estimate,
    identifiability: IdentifiabilityReport,
    motions: Sequence[Motion],
    model: str,
    method: Literal["ukf", "least-squares", "output-error"],
    engine: Literal["compiled", "filterpy"],
    notes: Sequence[str],
) -> IdentifyResult:
    """Return what identify.json says."""
    free = [i for i in estimate.problem.free if i < len(system.parameters)]
    names = tuple(system.parameters[i].name for i in free)
    sd = np.sqrt(np.diag(estimate.covariance))
    parameters = {
        name: ParameterEstimate(
            estimate=estimate.p[place],
            sd=sd[i],
            unit=system.parameters[place].unit,
            at_bound=estimate.at_bound[i],
            bound_sd=identifiability.parameters[name].bound_sd,
            **estimate.details[i],
        )
        for i, (name, place) in enumerate(zip(names, free, strict=True))
    }
    return IdentifyResult(
        model=model,
        headline=", ".join(
            f"{name} {entry.estimate:.4g} ± {entry.sd:.2g} {entry.unit}"
            for name, entry in parameters.items()
        ),
        method=method,
        engine=engine,
        parameters=parameters,
        covariance=Covariance(names=names, matrix=estimate.covariance.tolist()),
        trials=tuple(motion.trial_id for motion in motions),
        identifiability=identifiability,
        notes=(*notes, *identifiability.sentences),
        **estimate.report,
    )
