"""Uncertainty of parameters due to the calibration of sensors and constants, by source."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from functools import partial

import numpy as np

from bampipe.arrays import Array
from bampipe.identification.estimates import Estimate
from bampipe.identification.least_squares_estimate import SquaresFit
from bampipe.physics import System, compile_model
from bampipe.physics.model_spec import ModelSpec
from bampipe.results.ingest import IngestResult
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import ModelOnTrial
from bampipe.trials.signals import ZERO_OF, Signals, calibration_changes


def propagate_calibration(
    system: System,
    spec: ModelSpec,
    session: IngestResult,
    motions: Sequence[Motion],
    squares: SquaresFit,
) -> Mapping[str, Array]:
    """Return the change of the estimates, (n,), by one standard uncertainty of each source.

    Sources are gains and cross-talk of sensors and scales of encoders and channels, as the session
    file states them, zeros of encoders, and constants of the device file with an ``sd``; they are
    independent. Changes are those of least squares (law of propagation of uncertainty, JCGM
    100:2008, 5.1) for either method; a parameter at its bound stays. The fitted motions must have
    every input of the device.
    """
    count = int(np.sum(squares.free < len(system.parameters)))
    held = [int(k) for k in np.flatnonzero(squares.at_bound)]
    found, p, late_s = {}, squares.fit.linearisation.p, squares.trials.late_s
    for name, theirs, change in _sources(system, spec, session):
        timed = (change(motion).with_input_timing(late_s) for motion in motions)
        changed = (ModelOnTrial(theirs, p, [motion]).residual_once for motion in timed)
        found[name] = squares.respond(squares.residual_change(changed), held)[:count]
    return found


def with_calibration(estimate: Estimate, moved: Mapping[str, Array]) -> Estimate:
    """Add the calibration to the covariance of an estimate, and report it as a separate term."""
    if not moved:
        return estimate
    steps = np.array([*moved.values()])
    added, parts = steps.T @ steps, np.linalg.norm(steps, axis=0)
    details = [
        {**entry, "calibration_sd": part, "statistical_sd": sd}
        for entry, part, sd in zip(estimate.details, parts, estimate.sd, strict=True)
    ]
    return replace(estimate, covariance=estimate.covariance + added, details=details)


def _sources(
    system: System, spec: ModelSpec, session: IngestResult
) -> Iterator[tuple[str, System, Callable[[Motion], Motion]]]:
    """Yield sources of uncertainty, each with model and motion changed by its standard one."""
    signals = Signals.of_session(system, session)
    for name, change in calibration_changes(signals):
        yield name, system, partial(change.of_motion, signals=signals)
    for name, constant in system.model.device.constants.items():
        if constant.sd and name in spec.device.get("constants", {}):
            declaration = deepcopy(dict(spec.device))
            declaration["constants"][name]["value"] = constant.value + constant.sd
            changed = compile_model(replace(spec, device=declaration).model())
            yield name, changed, lambda motion: motion


def describe_calibration(estimate: Estimate, moved: Mapping[str, Array]) -> tuple[str, ...]:
    """Report the calibration's part in the intervals, or that no uncertainty is stated."""
    if all(name.startswith(ZERO_OF) for name in moved):
        return ("No uncertainty of gains, scales or constants is stated, so none is included.",)
    sd = np.maximum(estimate.sd, np.finfo(float).tiny)
    largest = max(moved, key=lambda name: float(np.max(np.abs(moved[name]) / sd)))
    return (
        f"The intervals include the uncertainty of the calibration ({len(moved)} sources); most of"
        f" it comes from {largest}.",
    )
