"""Stage identify: the parameters of a model, with uncertainties, from the free trials."""

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.arrays import Array
from bampipe.data.refusals import refusal
from bampipe.data.run_folder import FILTERED, INGESTED, RunFolder
from bampipe.data.store import ParquetAppender, write_parquet
from bampipe.declarations.model import read_model_file
from bampipe.declarations.model_file import MODEL_INPUTS, load_model, read_spec
from bampipe.diagnosis.start import SignWidth, choose_sign_width, search_start
from bampipe.estimate.square_root import FilterSettings
from bampipe.identification.bodies import base_estimates, make_possible, summarise_bases
from bampipe.identification.calibration import (
    describe_calibration,
    propagate_calibration,
    with_calibration,
)
from bampipe.identification.choice import (
    describe_methods,
    describe_worse,
    find_objections,
    tabulate_methods,
    why_not_filtered,
)
from bampipe.identification.estimates import Estimate, collect_result
from bampipe.identification.filter_estimate import Filtering, estimate_by_filter
from bampipe.identification.filter_run import MotionLost
from bampipe.identification.identifiability import assess_identifiability
from bampipe.identification.least_squares_estimate import (
    SquaresFit,
    estimate_by_least_squares,
    fit_squares,
    require_enough,
)
from bampipe.identification.sensor_noise import FilterChoice, untuned_settings
from bampipe.physics import System, compile_model
from bampipe.physics.model_spec import ModelSpec
from bampipe.progress import Progress
from bampipe.results.identify import InputTiming
from bampipe.results.ingest import IngestResult
from bampipe.results.rounding import NORMAL_95, significant
from bampipe.schema import STRICT, Positive
from bampipe.trials.folds import Folds
from bampipe.trials.measured import MeasuredTrials, read_measured_trials
from bampipe.trials.motion import trial_names
from bampipe.trials.reading import read_band, read_kinematics, read_motions, read_sensors
from bampipe.trials.residuals import find_robot_timing
from bampipe.trials.soundness import require_sound

SUMMARY = "Parameters of the model with uncertainties, from the free trials"
INPUTS = (*INGESTED, *FILTERED, *MODEL_INPUTS)
OUTPUTS = (
    "models/{model}/identify.json",
    "models/{model}/states.parquet",
    "models/{model}/trace.parquet",
)


@checked_dataclass(frozen=True, config=STRICT)
class Config(FilterChoice):
    """Settings of the stage.

    Attributes:
        model: which model version.
        method: ``least-squares`` on the inverse dynamics, under the likelihood by which models are
            judged; ``ukf``, the augmented unscented Kalman filter; or ``auto``: the filter if it
            agrees with least squares and is more precise, see `bampipe.identification.choice`.
        start_factor: multiplies every starting value: estimates must not depend on it.
        input_timing: whether the time by which inputs were sampled after positions is estimated.
        remove_bias: whether replicates of the model give the weights of samples and the bias by
            filters and stopping friction; otherwise all samples of an axis have equal weight.
        choose_sign_width: whether, on a test bench, the trials may make the sign of the velocity
            narrower than the device's `sign_width`.
    """

    model: str = "base"
    method: Literal["auto", "ukf", "least-squares"] = "auto"
    start_factor: Positive = 1.0
    input_timing: bool = True
    remove_bias: bool = True
    choose_sign_width: bool = True


@dataclass(frozen=True)
class _Task:
    """A model and the trials that it is fitted to.

    Attributes:
        run: the run folder; config: of the stage; spec, system: the model.
        width: of its smoothed sign, if the trials select a narrower one.
        trials: the trials, with the timing of their inputs free if it is estimated.
    """

    run: RunFolder
    config: Config
    spec: ModelSpec
    system: System
    width: SignWidth | None
    trials: MeasuredTrials


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Estimate one model from the free trials; effects of brakes from braked ones too."""
    progress(0.0, "reading the trials")
    task = _read(run, config)
    system = task.system
    progress(0.1, "least squares")
    start = _start(task)
    fitted, held = _fit(task, start)
    squares, notes = make_possible(system, fitted)
    motions = squares.trials.motions
    noise = untuned_settings(squares.trials.sensors, system, motions, squares.p[:-1], config)
    identifiability, unseen = assess_identifiability(
        system, motions, squares.problem, squares.p, noise
    )
    # Directions without information keep their prior uncertainty, whatever the fit gives.
    by_squares = estimate_by_least_squares(system, squares)
    by_squares = replace(by_squares, covariance=by_squares.covariance + unseen)
    by_filter, lost = _filter(task, squares, by_squares, start, noise, progress)
    if by_filter is not None:
        by_filter = replace(by_filter, covariance=by_filter.covariance + unseen)
    published, others = _choose(task, by_squares, by_filter)
    methods = tabulate_methods(system, published, others, lost)
    if published.method == "least-squares":
        notes += _describe_squares(task, squares)
        if by_filter is not None:
            # The tests of its innovations are kept whatever is published.
            published = replace(published, report={**by_filter.evidence, **published.report})
    progress(0.97, "uncertainty of the calibration")
    moved = propagate_calibration(
        system,
        task.spec,
        run.read(IngestResult),
        read_motions(run, system, fitted=True, braked=system.braked, every_input=True),
        squares,
    )
    estimate = with_calibration(published, moved)
    if held is not None:
        estimate = replace(estimate, report={**estimate.report, "input_timing": held})
    bases = base_estimates(system, estimate.p, estimate.covariance)
    result = collect_result(
        system,
        estimate,
        identifiability,
        trial_names(motions),
        dict(zip(trial_names(squares.parts), squares.moves, strict=True)),
        squares.find_worst_second(),
        _find_timing(task, squares, held),
        model=config.model,
        engine=config.engine if estimate.method == "ukf" else "compiled",
        methods=methods,
        base_parameters=bases,
        sign_width_factor=task.width.factor if task.width is not None else 1.0,
        notes=[
            *describe_methods(methods),
            *notes,
            *estimate.notes,
            *(_describe_width(system, task.width) if task.width is not None else ()),
            *describe_calibration(estimate, moved),
            *summarise_bases(system, bases),
        ],
    )
    states, trace = estimate.tabulate()
    with ParquetAppender(out / f"models/{config.model}/states.parquet") as file:
        for frame in states:
            file.append(frame)
    write_parquet(out / f"models/{config.model}/trace.parquet", trace)
    return result.write(out)


def _read(run: RunFolder, config: Config) -> _Task:
    """Read the model and the trials, and choose the width of the smoothed sign on a test bench."""
    model = load_model(run, config.model, as_declared=True)
    spec, system = read_spec(run, config.model, model), compile_model(model)
    motions = read_motions(run, system, fitted=True, braked=system.braked)
    require_sound(system, motions)
    width = _choose_width(run, system, config)
    if width is not None:
        spec = spec.with_sign_widths(width.factor)
        system = compile_model(spec.model())
    names, band = trial_names(motions), read_band(run, system)
    trials = MeasuredTrials(
        motions,
        read_sensors(run, system),
        read_kinematics(run, system),
        band,
        Folds.of_trials(names, (), names),
        limit_s=0.5 / band.rate_hz,
        timed=config.input_timing and not system.has_free_delay,
    )
    return _Task(run, config, spec, system, width, trials)


def _fit(task: _Task, start: Array) -> tuple[SquaresFit, InputTiming | None]:
    """Fit the model under the likelihood, and hold the timing of a robot whose drive is late.

    Beside a delay of the model the timing cannot be estimated for all drives at once; but a log in
    which one drive acts late and all of them hold their commands leaves the others half a sample
    late.
    """
    system, trials, config = task.system, task.trials, task.config
    how = config.block_s, config.remove_bias
    try:
        squares = fit_squares(trials, task.spec, system, start, *how)
    except ValueError as error:
        raise refusal("too_short_to_identify", str(task.run.root), why=error) from error
    require_enough(squares, str(task.run.root))
    is_late, sd, late_s = False, 0.0, 0.0
    if config.input_timing and system.has_free_delay and system.model.device.robot is not None:
        late_s, sd = find_robot_timing(system, trials.motions, trials.band, squares.p[:-1])
        is_late = abs(late_s) >= NORMAL_95 * sd
    if not is_late:
        return squares, None
    late_s = float(np.clip(late_s, -trials.limit_s, trials.limit_s))
    moved = trials.with_input_timing(late_s)
    held = InputTiming(estimate=late_s, sd=sd, unit="s", limit=trials.limit_s)
    return fit_squares(moved, task.spec, system, squares.p[:-1], *how), held


def _filter(
    task: _Task,
    squares: SquaresFit,
    by_squares: Estimate,
    start: Array,
    noise: FilterSettings,
    progress: Progress,
) -> tuple[Estimate | None, str]:
    """Return the filter's estimate if requested; otherwise the reason, "" if none is due."""
    config, why_not = task.config, None
    if config.method == "least-squares":
        why_not = ""
    elif config.method == "auto":
        why_not = why_not_filtered(task.system, squares, config.longest_step_s)
    if why_not is not None:
        return None, why_not
    try:
        filtering = Filtering(
            task.run, task.system, task.spec, config.model, start, squares, by_squares.sd, noise,
            config, progress,
        )  # fmt: skip
        return estimate_by_filter(filtering), ""
    except MotionLost as error:
        if config.method == "ukf":
            raise
        return None, error.what


def _choose(
    task: _Task, by_squares: Estimate, by_filter: Estimate | None
) -> tuple[Estimate, list[Estimate]]:
    """The published estimate, and the others: see `bampipe.identification.choice`."""
    if by_filter is None:
        return by_squares, []
    if task.config.method == "ukf":
        worse = describe_worse(task.system, by_filter.held_out_rmse, by_squares.held_out_rmse)
        doubts = (*by_filter.doubts, *([f"its parameters {worse}"] if worse else ()))
        return replace(by_filter, doubts=doubts), [by_squares]
    objections = find_objections(task.system, by_filter, by_squares)
    if objections:
        return by_squares, [replace(by_filter, doubts=objections)]
    return by_filter, [by_squares]


def _find_timing(task: _Task, squares: SquaresFit, held: InputTiming | None) -> tuple[float, float]:
    """Return the timing of the inputs for residuals, and its standard deviation, s."""
    if held is not None:
        return held.estimate, held.sd
    if not task.trials.timed:
        return 0.0, 0.0
    if task.system.model.device.robot is None:
        return float(squares.p[-1]), float(squares.sd[-1])
    trials = squares.trials
    return find_robot_timing(task.system, trials.motions, trials.band, squares.p[:-1])


def _describe_squares(task: _Task, squares: SquaresFit) -> list[str]:
    """Return notes on least squares: no replicates, or an axis that nothing drives."""
    simulated = squares.has_replicates or not task.config.remove_bias
    equal = (
        "The model cannot be simulated on these trials, so all samples have equal weight and the"
        " bias of filters was not removed."
    )
    undriven = task.system.undriven
    small = (
        f"No force acts on {', '.join(undriven)}: least squares underestimates the terms of that"
        " equation, the more so the more the model lacks."
    )
    return [equal] * (not simulated) + [small] * bool(undriven)


def _start(task: _Task) -> Array:
    """Return the device's priors, and values of effects from a diagnosis or a search."""
    system, start = task.system, task.system.prior
    count = len(system.model.device.parameters)
    path = task.run.path(f"models/{task.config.model}/model.toml")
    given, own = read_model_file(path).start, system.parameters[count:]
    if all(item.name in given for item in own):
        start[count:] = [np.clip(given[item.name], item.lower, item.upper) for item in own]
    else:
        trials = read_measured_trials(task.run, system, every_input=True)
        start[count:] = search_start(trials, task.spec)[count:]
    free = [k for k, item in enumerate(system.parameters) if not item.fixed]
    start[free] *= task.config.start_factor
    return start


def _choose_width(run: RunFolder, system: System, config: Config) -> SignWidth | None:
    """Return the width of the smoothed sign that the trials select; None for the declared one.

    Without a test bench it stays, because filter and replicates integrate along the sign.
    """
    if not (config.choose_sign_width and system.model.device.prescribed):
        return None
    trials = read_measured_trials(run, system, every_input=True)
    with suppress(ValueError):  # too short: the fit itself reports it
        found = choose_sign_width(trials, read_spec(run, config.model, system.model))
        return found if found.factor < 1.0 else None
    return None


def _describe_width(system: System, width: SignWidth) -> list[str]:
    """Return the chosen narrower width, and the reason, for each axis of a narrowed model."""
    return [
        f"{axis.name}: the sign of the velocity is smoothed over {significant(axis.sign_width)}"
        f" {axis.unit}/s, {significant(width.factor)} of the device's `sign_width`, because the"
        f" held-out error then falls from {significant(width.declared[i])} to"
        f" {significant(width.chosen[i])} {system.torque_units[i]}. Put"
        f" `sign_width = {axis.sign_width:.2g}` into the device file to start from it."
        for i, axis in enumerate(system.model.device.coordinates)
    ]
