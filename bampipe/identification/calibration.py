"""What the uncertainty of sensors and drawings adds to parameters, source by source."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.bounded import invert_scaled
from bampipe.estimate.least_squares import as_measured, stacked_residual
from bampipe.identification.estimates import Estimate
from bampipe.physics import System, compile_model
from bampipe.physics.recipe import Recipe
from bampipe.results.ingest import IngestResult
from bampipe.trials.motion import Motion
from bampipe.trials.signals import ZERO_OF, Signals, calibration_changes

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Source:
    """A model and a motion as one standard uncertainty of something makes them."""

    name: str
    system: System
    change: Callable[[Motion], Motion]


def propagate_calibration(
    system: System,
    recipe: Recipe,
    session: IngestResult,
    motions: Sequence[Motion],
    estimate: Estimate,
) -> Mapping[str, Array]:
    """Return by how much one standard uncertainty of each source moves the estimates, (n,) each.

    Sources are gains and cross-talk of sensors and scales of encoders and channels as the session
    file states them, zeros of encoders, and constants of the device file with an ``sd``; they are
    independent. A
    parameter moves as least squares would near the estimate (law of propagation of uncertainty,
    JCGM 100:2008, 5.1), whichever method made it; one at its bound stays.

    Args:
        system: the model; recipe: the same as data; session: as ingested.
        motions: that were fitted, with every input of the device; estimate: of their parameters.
    """
    sources = list(_sources(system, recipe, session))
    if not sources:
        return {}
    problem, band, count = estimate.problem, estimate.problem.band, len(estimate.free)
    n_q = len(system.coordinates)
    normal, square, used = np.zeros((n_q, count, count)), np.zeros(n_q), np.zeros(n_q)
    moments = {source.name: np.zeros((n_q, count)) for source in sources}
    for trial, motion in enumerate(motions):
        here = [stacked_residual(problem, trial, estimate.p)]
        (stacked,) = as_measured(problem, estimate.p, here)
        slope = stacked.slope[:, :, :count]
        normal += np.einsum("kqi,kqj->qij", slope, slope)
        square += np.sum(stacked.residual**2, axis=0)
        used += np.sum(stacked.used, axis=0)
        for source in sources:
            theirs = _residual(source.system, source.change(motion), estimate.p)
            residual = band.thin(theirs) * stacked.used
            moments[source.name] += np.einsum("kqn,kq->qn", slope, stacked.residual - residual)
    weight = used / np.maximum(square, np.finfo(float).tiny)
    inside = np.flatnonzero(~estimate.at_bound)
    inverse = np.zeros((count, count))
    part = np.ix_(inside, inside)
    inverse[part] = invert_scaled(np.einsum("q,qij->ij", weight, normal)[part])
    return {name: np.asarray(inverse @ (weight @ moment)) for name, moment in moments.items()}


def _residual(system: System, motion: Motion, p: Array) -> Array:
    """Residual (T, n_q) of a trial, of functions that are not compiled: they serve once."""
    timed, p = motion.with_input_timing(p[-1]), p[:-1]
    u = timed.inputs(system.inputs)
    at = timed.of_mechanism(system, u, p).kinematics
    z = system.memory(*at, u, p, timed.t)
    return system.applied(*at, z, u, p) - system.required(*at, z, u, p)


def with_calibration(estimate: Estimate, moved: Mapping[str, Array]) -> Estimate:
    """Return the estimate with what calibration adds in its covariance, and said apart."""
    if not moved:
        return estimate
    added = sum(
        (np.outer(step, step) for step in moved.values()), np.zeros_like(estimate.covariance)
    )
    parts = np.sqrt(np.diag(added))
    details = [
        {**entry, "calibration_sd": part, "statistical_sd": sd}
        for entry, part, sd in zip(estimate.details, parts, estimate.sd, strict=True)
    ]
    return replace(estimate, covariance=estimate.covariance + added, details=details)


def _sources(system: System, recipe: Recipe, session: IngestResult) -> Iterator[_Source]:
    signals = Signals.of_session(system, session)
    for name, change in calibration_changes(signals):
        yield _Source(name, system, partial(change.of_motion, signals=signals))
    for name, constant in system.model.device.constants.items():
        if constant.sd and name in recipe.device.get("constants", {}):
            declaration = deepcopy(dict(recipe.device))
            declaration["constants"][name]["value"] = constant.value + constant.sd
            changed = compile_model(replace(recipe, device=declaration).model())
            yield _Source(name, changed, lambda motion: motion)


def describe_calibration(estimate: Estimate, moved: Mapping[str, Array]) -> tuple[str, ...]:
    """A sentence on what calibration adds, or that it is not stated."""
    if all(name.startswith(ZERO_OF) for name in moved):
        return (
            "No uncertainty of gains, scales and constants is stated: the intervals hold none.",
        )
    sd = estimate.sd
    shares = {
        name: float(np.max(np.abs(step) / np.maximum(sd, np.finfo(float).tiny)))
        for name, step in moved.items()
    }
    largest = max(shares, key=lambda name: shares[name])
    sentence = (
        f"The uncertainty of the calibration is in the intervals ({len(moved)} sources); most of it"
        f" comes from {largest}."
    )
    return (sentence,)
