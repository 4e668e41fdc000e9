"""Stage identify: the parameters of a model, with uncertainties, from the free trials."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.run_folder import FILTERED, INGESTED, RunFolder
from bampipe.data.store import write_parquet
from bampipe.declarations.model_file import MODEL_INPUTS, load_model, read_recipe
from bampipe.diagnosis.sign_width import SignWidth, choose_sign_width
from bampipe.diagnosis.start import search_start
from bampipe.errors import InputError
from bampipe.estimate.least_squares import LeastSquares, Problem, fit, independent_samples
from bampipe.identification.bodies import base_estimates, make_possible, summarise_bases
from bampipe.identification.calibration import (
    describe_calibration,
    propagate_calibration,
    with_calibration,
)
from bampipe.identification.estimates import Estimate, collect_result
from bampipe.identification.filter_choice import FilterChoice
from bampipe.identification.filter_estimate import estimate_by_filter
from bampipe.identification.filter_run import MotionLost, load_filter_trial
from bampipe.identification.identifiability import assess_identifiability
from bampipe.identification.least_squares_estimate import estimate_by_least_squares
from bampipe.identification.method_choice import (
    choose,
    describe_methods,
    judge,
    prefer_steady,
    tabulate_methods,
    widen,
)
from bampipe.identification.output_estimate import estimate_by_output_error
from bampipe.identification.sensor_noise import sensor_noise
from bampipe.identification.smoothing import describe_smoothing, with_smoothing
from bampipe.physics import System, compile_model
from bampipe.progress import Progress
from bampipe.results.identify import InputTiming
from bampipe.results.ingest import IngestResult
from bampipe.results.intervals import NORMAL_95
from bampipe.results.rounding import significant
from bampipe.schema import STRICT, Positive
from bampipe.trials.bias import UnbiasedFit, remove_bias
from bampipe.trials.folds import Folds
from bampipe.trials.measured import read_measured_trials
from bampipe.trials.motion import Motion, trial_names
from bampipe.trials.reading import (
    read_band,
    read_kinematics,
    read_motions,
    read_sensors,
    require_sound_motions,
)
from bampipe.trials.residuals import applied_rms, problem_of
from bampipe.trials.timing import find_robot_timing

SUMMARY = "Parameters of the model with uncertainties, from the free trials"
INPUTS = (*INGESTED, *FILTERED, *MODEL_INPUTS)
OUTPUTS = (
    "models/{model}/identify.json",
    "models/{model}/states.parquet",
    "models/{model}/trace.parquet",
)

_MOST_SAMPLES = 4_000
"""Of segments that `auto` fits by output error, which takes half a millisecond a sample."""

_MOST_LEFT = 0.5
"""Share of the applied force that least squares may leave for output error to be worth its time:
the summary refuses a model that explains less than half."""
_NOT_SIMULATED = (
    "Output error was not tried: of the applied force, least squares leaves more than half"
    " unexplained, and a simulated motion would not be that of the machine."
)

MOST_FILTERED = 30
"""Parameters beyond which ``auto`` takes least squares: the filter's cost grows with the cube of
their number, and what it adds, noise in positions, matters least where torques are rich."""

Array = NDArray[np.float64]


@checked_dataclass(frozen=True, config=STRICT)
class Config(FilterChoice):
    """Settings of the stage.

    Attributes:
        model: which model version.
        method: ``ukf``, the augmented unscented Kalman filter; ``least-squares`` on the inverse
            dynamics; ``output-error``, the motion simulated in pieces against the positions; or
            ``auto``: the one whose parameters best predict trials that they have not seen, the
            filter where several do; of more than `MOST_FILTERED` parameters, as of a robot, least
            squares.
        start_factor: multiplies every starting value: estimates must not depend on it.
        input_timing: whether the time by which inputs were sampled after positions is estimated.
        remove_bias: whether the bias that filters give least squares is measured and taken off.
        choose_sign_width: whether, on a test bench, the trials may make the sign of the velocity
            narrower than the device's `sign_width`.
    """

    model: str = "base"
    method: Literal["auto", "ukf", "least-squares", "output-error"] = "auto"
    start_factor: Positive = 1.0
    input_timing: bool = True
    remove_bias: bool = True
    choose_sign_width: bool = True


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Estimate one model from the free trials; effects of brakes from braked ones too."""
    model = load_model(run, config.model, as_declared=True)
    system = compile_model(model)
    progress(0.0, "reading the trials")
    motions = read_motions(run, system, fitted=True, braked=system.braked)
    require_sound_motions(system, motions)
    width = _choose_width(run, system, config)
    if width is not None:
        chosen_recipe = read_recipe(run, config.model, model).with_sign_widths(width.factor)
        system = compile_model(chosen_recipe.model())
    sensors, kinematics = read_sensors(run, system), read_kinematics(run, system)
    band = read_band(run, system)
    timing = config.input_timing and not system.has_free_delay
    problem = problem_of(system, motions, band, timing=timing)
    progress(0.1, "least squares")
    model_parameters = problem.free[problem.free < len(system.parameters)]
    try:
        start = _start(run, system, config)
        start[model_parameters] *= config.start_factor
        raw = fit(problem, np.append(start, 0.0), block_s=config.block_s)
    except ValueError as error:
        raise InputError(
            f"the free trials are too short to identify from ({error})",
            where=str(run.root),
            remedy="record faster motion at a higher rate, or more of it",
        ) from error
    robot, held = system.model.device.robot is not None, None
    if config.input_timing and system.has_free_delay and robot:
        raw, held = _hold_timing(system, motions, problem, raw, config.block_s)
    moving = int(independent_samples(band, raw.stacked))
    # Their scatter about the fit must be known, too, or no interval means anything.
    if moving < 2 * problem.free.size:
        raise InputError(
            f"of the free trials, {moving} independent samples are clear of standstill, fewer than"
            f" twice the {problem.free.size} numbers to be found",
            where=str(run.root),
            remedy="record faster motion at a higher rate, or more of it",
        )

    squares = UnbiasedFit(raw, raw.p, None, problem)
    if config.remove_bias:
        squares = remove_bias(sensors, kinematics, system, motions, problem, raw)
    squares, notes = make_possible(system, squares)
    near = raw.p[: len(start)]
    noise = sensor_noise(sensors, system, motions, near, config)
    names = trial_names(motions)
    folds = Folds.of_trials(names, (), names)
    estimates: list[Estimate] = []
    lost = ""
    method = config.method
    if method == "auto" and len(model_parameters) > MOST_FILTERED:
        method = "least-squares"

    def by_output_error(most_samples: int | None) -> Estimate:
        raw_trials = [
            load_filter_trial(run, motion, system, near, noise, 1, config) for motion in motions
        ]
        return estimate_by_output_error(
            system, motions, raw_trials, squares, folds, progress, most_samples
        )

    recipe = read_recipe(run, config.model, system.model)

    def narrowed(factor: float) -> System:
        return compile_model(recipe.with_sign_widths(factor).model())

    if method in ("auto", "ukf"):
        try:
            by_filter = estimate_by_filter(
                run,
                system,
                narrowed,
                motions,
                start,
                squares,
                noise,
                config,
                folds,
                config.model,
                progress,
            )
            estimates.append(by_filter)
        except MotionLost as error:
            if method == "ukf":
                raise
            lost = error.what
    if method == "output-error":
        progress(0.3, "output error")
        estimates.append(by_output_error(None))
    estimates.append(estimate_by_least_squares(system, motions, squares, folds))
    judged = [judge(squares, folds, with_smoothing(estimate, recipe)) for estimate in estimates]
    chosen = choose(system, judged) if method == "auto" else 0
    moved_by_force = not system.model.device.prescribed
    if method == "auto" and estimates[chosen].method != "ukf" and moved_by_force:
        # Where the filter is out of the question, a third opinion is worth its time. On a test
        # bench there is none: the stroke is given, whatever the force. A model that explains
        # nothing moves nowhere near the machine, and simulations of it take minutes.
        size = applied_rms(system, motions, band, near, [stacked.used for stacked in raw.stacked])
        driven = [axis not in system.undriven for axis in system.coordinates]
        if (raw.residual_sd > _MOST_LEFT * size)[driven].any():
            notes.append(_NOT_SIMULATED)
        else:
            with suppress(InputError):
                third = with_smoothing(by_output_error(_MOST_SAMPLES), recipe)
                judged.append(judge(squares, folds, third))
                chosen = choose(system, judged)
    if method == "auto":
        chosen = prefer_steady(system, judged, chosen)
    estimate = widen(system, judged, chosen, squares)
    if estimate.method == "least-squares":
        if config.remove_bias and squares.bias is None:
            notes.append(
                "No bias was taken off least squares: a replay of the model does not resemble the"
                " machine."
            )
        if system.undriven:
            notes.append(
                f"No force acts on {', '.join(system.undriven)}: least squares makes what stands in"
                " such an equation too small, more so the more the model lacks."
            )
    progress(0.97, "identifiability of the parameters")
    identifiability, unseen = assess_identifiability(
        system, motions, estimate.problem, estimate.p, noise, estimate.at_bound
    )
    # What the trials say nothing of is as uncertain as it was before, whatever the fit believes.
    estimate = replace(estimate, covariance=estimate.covariance + unseen)
    if estimates[0].method == "ukf":
        # What the filter's innovations say of model and noise is kept whatever is published.
        estimate = replace(estimate, report={**estimates[0].evidence, **estimate.report})
    methods = tabulate_methods(system, estimate, judged, lost)
    moved = propagate_calibration(
        system,
        recipe,
        run.read(IngestResult),
        read_motions(run, system, fitted=True, braked=system.braked, every_input=True),
        estimate,
    )
    estimate = with_calibration(estimate, moved)
    engine = config.engine if estimate.method == "ukf" else "compiled"
    bases = base_estimates(system, estimate.p, estimate.covariance)
    notes = [
        *describe_methods(system, methods),
        *notes,
        *describe_smoothing(system, estimate),
        *(_describe_width(system, width) if width is not None else ()),
        *describe_calibration(estimate, moved),
        *summarise_bases(system, bases),
    ]
    late = float(raw.p[-1]), float(np.sqrt(raw.covariance[-1, -1]))
    if timing and robot:
        late = find_robot_timing(system, motions, band, near)
    if held is not None:
        late = held.estimate, held.sd
        estimate = replace(estimate, report={**estimate.report, "input_timing": held})
    result = collect_result(
        system, estimate, identifiability, motions, config.model, raw, late, engine, methods, notes,
        bases,
    )  # fmt: skip
    if width is not None:
        result = result.model_copy(update={"sign_width_factor": width.factor})
    states, trace = estimate.tabulate()
    write_parquet(out / f"models/{config.model}/states.parquet", states)
    write_parquet(out / f"models/{config.model}/trace.parquet", trace)
    return result.write(out)


def _hold_timing(
    system: System, motions: Sequence[Motion], problem: Problem, raw: LeastSquares, block_s: float
) -> tuple[LeastSquares, InputTiming | None]:
    """The fit to inputs moved by the timing of those drives that no delay of the model moves.

    Beside a delay it cannot be estimated for all drives at once; but a log in which one drive acts
    late and all of them hold their commands leaves the others half a sample late.
    """
    late_s, sd = find_robot_timing(system, motions, problem.band, raw.p[:-1])
    if abs(late_s) < NORMAL_95 * sd:
        return raw, None
    half = 0.5 / problem.band.rate_hz
    late_s = float(np.clip(late_s, -half, half))
    moved = fit(problem, np.append(raw.p[:-1], late_s), block_s=block_s)
    return moved, InputTiming(estimate=late_s, sd=sd, unit="s", limit=half)


def _start(run: RunFolder, system: System, config: Config) -> Array:
    """Priors of the device; of effects, what a search over their range finds."""
    start = system.prior
    if system.model.effects:
        trials = read_measured_trials(run, system, every_input=True)
        found = search_start(trials, read_recipe(run, config.model, system.model))
        count = len(system.model.device.parameters)
        start[count:] = found[count:]
    return start


def _choose_width(run: RunFolder, system: System, config: Config) -> SignWidth | None:
    """The width of the smoothed sign that the trials ask for; None where the declared one stays.

    Where no test bench gives the motion it stays: filter and replays integrate along the sign.
    """
    if not (config.choose_sign_width and system.model.device.prescribed):
        return None
    trials = read_measured_trials(run, system, every_input=True)
    with suppress(ValueError):  # too short: the fit itself says so
        found = choose_sign_width(trials, read_recipe(run, config.model, system.model))
        return found if found.factor < 1.0 else None
    return None


def _describe_width(system: System, width: SignWidth) -> list[str]:
    """Say which narrower width was chosen, and why, for each axis of a narrowed model."""
    said = []
    for i, axis in enumerate(system.model.device.coordinates):
        before, after = width.declared[i], width.chosen[i]
        said.append(
            f"{axis.name}: the sign of the velocity is smoothed over {significant(axis.sign_width)}"
            f" {axis.unit}/s, {significant(width.factor)} of the device's `sign_width`, for with"
            f" that the error on trials left out falls from {significant(before)} to"
            f" {significant(after)} {system.torque_units[i]}. `sign_width = {axis.sign_width:.2g}`"
            " in a device file says so from the start."
        )
    return said
