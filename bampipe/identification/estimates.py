"""An estimate of a model's parameters, whatever method made it, and what identify.json says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bampipe.estimate.least_squares import Problem
from bampipe.identification.identifiability import Identifiability
from bampipe.physics import System
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
        details: by parameter, further entries of identify.json.
        report: further fields of identify.json.
        states, trace: tables.
    """

    p: Array
    problem: Problem
    covariance: Array
    at_bound: NDArray[np.bool_]
    details: Sequence[dict[str, float]]
    report: dict[str, object]
    states: pd.DataFrame
    trace: pd.DataFrame


def timing_entry(p: Array, variance: float) -> dict[str, object]:
    """Return the timing of the inputs as identify.json has it."""
    return {"estimate": float(p[-1]), "sd": float(np.sqrt(variance)), "unit": "s"}


def collect_result(
    system: System,
    estimate: Estimate,
    identifiability: Identifiability,
    motions: Sequence[Motion],
    model: str,
    method: str,
    engine: str,
) -> dict[str, object]:
    """Return what identify.json says."""
    free = [i for i in estimate.problem.free if i < len(system.parameters)]
    names = [system.parameters[i].name for i in free]
    sd = np.sqrt(np.diag(estimate.covariance))
    parameters: dict[str, dict[str, object]] = {}
    for i, (name, place) in enumerate(zip(names, free, strict=True)):
        parameters[name] = {
            "estimate": float(estimate.p[place]),
            "sd": float(sd[i]),
            "unit": system.parameters[place].unit,
            "at_bound": bool(estimate.at_bound[i]),
            "bound_sd": identifiability.bound_sd[i],
            **estimate.details[i],
        }
    headline = ", ".join(
        f"{name} {entry['estimate']:.4g} ± {entry['sd']:.2g} {entry['unit']}"
        for name, entry in parameters.items()
    )
    return {
        "model": model,
        "headline": headline,
        "method": method,
        "engine": engine,
        "parameters": parameters,
        "covariance": {"names": names, "matrix": estimate.covariance.tolist()},
        "trials": [motion.trial_id for motion in motions],
        "identifiability": identifiability.report,
        **estimate.report,
    }
