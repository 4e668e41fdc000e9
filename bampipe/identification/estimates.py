"""An estimate of a model's parameters, whatever method made it, and what identify.json says."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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
    BaseEstimate,
    Convergence,
    Covariance,
    IdentifiabilityReport,
    IdentifyResult,
    InputTiming,
    Method,
    MethodTried,
    ParameterEstimate,
    StateBound,
)
from bampipe.trials.motion import Motion

Array = NDArray[np.float64]

MOST_SHOWN = 24
"""Parameters that a headline lists."""


@dataclass(frozen=True)
class Estimate:
    """Parameters with what belongs to them, physical units, those estimated in order.

    Attributes:
        p: (n_p + 1,) all parameters, the timing of the inputs last.
        problem: the inverse dynamics, its free parameters those estimated, the timing last
            where it was.
        method: that made it.
        covariance: (n, n) of the estimated parameters of the model.
        at_bound: (n,) which lie at the limit of their range.
        held_out: by trial, (n_p + 1,) the parameters without the trials that it is left out with.
        doubts: why it may not be believed, a clause each; none where nothing speaks against it.
        details: by parameter, further fields of its record.
        report: further fields of the result.
        tabulate: makes the tables of the states and of the parameters along the data.
    """

    method: Method
    p: Array
    problem: Problem
    covariance: Array
    at_bound: NDArray[np.bool_]
    held_out: Sequence[Array]
    doubts: tuple[str, ...]
    details: Sequence[dict[str, float]]
    report: dict[str, Any]
    tabulate: Callable[[], tuple[pd.DataFrame, pd.DataFrame]]

    @property
    def evidence(self) -> dict[str, Any]:
        """What a filter says of the model and the noise, whatever becomes of its parameters."""
        return {key: self.report[key] for key in ("nis", "innovations", "noise")}

    @property
    def free(self) -> NDArray[np.int64]:
        """(n,) places of the estimated parameters of the model."""
        return self.problem.free[: len(self.covariance)]

    @property
    def value(self) -> Array:
        """(n,) estimated parameters of the model."""
        return np.asarray(self.p[self.free])

    @property
    def sd(self) -> Array:
        """(n,) their standard deviations."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


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
    method: Method,
    system: System,
    motions: Sequence[Motion],
    problem: Problem,
    fit: LeastSquares | OutputError,
    p: Array,
    held_out: Sequence[Array],
    details: Sequence[dict[str, float]],
    rows: Callable[[], Sequence[Mapping[str, object]]],
    **report: object,
) -> Estimate:
    """Return the estimate of a method that leaves the motion as the filter stage did.

    Args:
        method: its name; system: the model; motions: the trials; problem: what was fitted.
        fit: the outcome; p: (n_p + 1,) the estimate, without bias.
        held_out, details, report: as of `Estimate`; rows: makes those of its trace.
    """
    count = int(np.sum(problem.free < len(system.parameters)))
    timed = count < problem.free.size
    sd = 3.0 * np.median(np.concatenate([motion.qd_sd for motion in motions]), axis=0)

    def tabulate() -> tuple[pd.DataFrame, pd.DataFrame]:
        frames = [as_filtered(system, motion, p[:-1]) for motion in motions]
        return pd.concat(frames, ignore_index=True), pd.DataFrame(rows())

    return Estimate(
        method=method,
        p=p,
        problem=problem,
        covariance=fit.covariance[:count, :count],
        at_bound=fit.at_bound[:count],
        held_out=held_out,
        doubts=() if fit.converged else ("its search has not converged",),
        details=details[:count],
        report={
            "input_timing": input_timing(p, fit.covariance[-1, -1] if timed else 0.0),
            "convergence": Convergence(iterations=fit.iterations, converged=fit.converged),
            "state_3sigma": {
                axis: StateBound(velocity=sd[i]) for i, axis in enumerate(system.coordinates)
            },
            **report,
        },
        tabulate=tabulate,
    )


def collect_result(
    system: System,
    estimate: Estimate,
    identifiability: IdentifiabilityReport,
    motions: Sequence[Motion],
    model: str,
    engine: Literal["compiled", "filterpy"],
    methods: Mapping[Method, MethodTried],
    notes: Sequence[str],
    base_parameters: tuple[BaseEstimate, ...] | None = None,
) -> IdentifyResult:
    """Return what identify.json says."""
    free, sd = estimate.free, estimate.sd
    names = tuple(system.parameters[i].name for i in free)
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
        headline=_headline(parameters),
        method=estimate.method,
        engine=engine,
        methods=dict(methods),
        parameters=parameters,
        covariance=Covariance(names=names, matrix=estimate.covariance.tolist()),
        trials=tuple(motion.trial_id for motion in motions),
        identifiability=identifiability,
        base_parameters=base_parameters,
        notes=(*notes, *identifiability.sentences),
        **estimate.report,
    )


def _headline(parameters: Mapping[str, ParameterEstimate]) -> str:
    """The parameters in one line; of a robot's many, the first."""
    shown = [
        f"{name} {entry.estimate:.4g} ± {entry.sd:.2g} {entry.unit}"
        for name, entry in parameters.items()
    ]
    if len(shown) <= MOST_SHOWN:
        return ", ".join(shown)
    return f"{', '.join(shown[:MOST_SHOWN])} and {len(shown) - MOST_SHOWN} more"
