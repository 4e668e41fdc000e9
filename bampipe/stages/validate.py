"""Stage validate: inverse-dynamics torque and handle force against the measured ones (Fig. 9)."""

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
import pandas as pd
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.arrays import Array
from bampipe.data.run_folder import FILTERED, INGESTED, RunFolder
from bampipe.data.store import ParquetAppender
from bampipe.declarations.model_file import IDENTIFIED_MODEL, load_model, read_estimate, read_spec
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.session import Session
from bampipe.errors import InputError
from bampipe.identification.free_run import find_drift, free_runs
from bampipe.identification.terms import describe_terms
from bampipe.lists import count_noun
from bampipe.phrases.results import find_failed_checks
from bampipe.physics import System, compile_model
from bampipe.physics.model_spec import ModelSpec
from bampipe.progress import Progress
from bampipe.results.floor import AT_FLOOR, compare_with_floor
from bampipe.results.identify import IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.rounding import significant
from bampipe.results.validate import ForceError, FreeRun, JudgedError, TrialError, ValidateResult
from bampipe.schema import STRICT, Count
from bampipe.trials.comparison import ComparedTrial, axis_errors, compare_trial
from bampipe.trials.kept import KeptItems
from bampipe.trials.measured import MeasuredTrials, read_measured_trials, trial_of_block
from bampipe.trials.motion import trial_names, trial_sizes
from bampipe.trials.noise_floor import NoiseFloor, count_floor_replicates, draw_trials
from bampipe.trials.reading import held_out_trials, read_motions
from bampipe.trials.residuals import rms
from bampipe.trials.soundness import require_sound

SUMMARY = "Predicted against measured torque and force, on trials that the fit has not seen"
INPUTS = (*INGESTED, *FILTERED, *IDENTIFIED_MODEL)
OUTPUTS = (
    "models/{model}/validate.json",
    "models/{model}/residuals.parquet",
    "models/{model}/terms.json",
)

SILENT_PERCENT = 30.0
"""Fit of a robot's joint below which its parameters are meaningless."""


@checked_dataclass(frozen=True, config=STRICT)
class Config:
    """Settings of the stage.

    Attributes:
        model: which model version.
        noise_floor: whether to compute the error that sensors and filters alone would leave.
        repeats: replicates for the noise floor; 0 takes three to six, fewer for a long session.
        seed: seed of their sensor noise.
        free_run: whether to run the model freely over every trial, and from many starts in it.
    """

    model: str = "base"
    noise_floor: bool = True
    repeats: Count = 0
    seed: Count = 0
    free_run: bool = True


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Compare one identified model with all free trials, and those in a viscous field."""
    model = load_model(run, config.model)
    system = compile_model(model)
    p = read_estimate(run, config.model, system)
    estimates = run.read(IdentifyResult, config.model)
    trials = read_measured_trials(run, system, timing=estimates.input_timing)
    require_sound(system, trials.motions)
    progress(0.1, "residuals")
    # Parameters estimated with delayed inputs belong to inputs with that delay.
    published = np.append(p, estimates.input_timing.estimate - trials.late_s)
    names = trial_names(trials.motions)
    unseen = [_leave_out(system, published, estimates, name) for name in names]
    compared = KeptItems(
        compare_trial(system, trials, k, published, p) for k, p in enumerate(unseen)
    )
    alone = (
        f"There is one trial: it is predicted in {trials.blocks} blocks, each with the estimate"
        " from the others."
    )
    notes = [alone] * (trials.blocks == len(trials.motions))
    if trials.folds.nothing_held_out:
        notes.append("With one trial or group, nothing is held out: the error is that of the fit.")
    floor: NoiseFloor | None = None
    if config.noise_floor:
        spec = read_spec(run, config.model, model)
        floor, said = _noise_floor(system, trials, p, spec, config, progress)
        notes += said
    free: FreeRun | None = None
    if config.free_run:
        progress(0.8, "free runs")
        motions, judged = trials.motions, [c.judged for c in compared]
        parameters = [p[:-1] for p in unseen]
        if trials.blocks:  # of the only trial, which runs as a whole
            motions, held_out = read_motions(run, system, braked=True), held_out_trials(run)
            judged = [motion.trial_id in held_out for motion in motions]
            parameters = [published[:-1]] * len(motions)
        drift = find_drift(system, motions, parameters, judged)
        free = free_runs(run, system, motions, parameters, judged)
        free = free.model_copy(update={"drift": drift})
    device, axes = system.model.device, dict[str, JudgedError]()
    for i, (axis, found) in enumerate(axis_errors(system, compared).items()):
        level, scatter = (floor.level[i], floor.sd[i]) if floor else (None, 0.0)
        axes[axis] = JudgedError.of(
            found,
            noise_floor=level,
            noise_floor_sd=scatter,
            standing=compare_with_floor(found.held_out_rmse, level, scatter),
        )
    if device.robot is not None:
        notes += _silent_joints(axes, compared)
    with ParquetAppender(out / f"models/{config.model}/residuals.parquet") as file:
        for name, parts in groupby(compared, key=lambda c: trial_of_block(c.trial_id)):
            tables = [_tabulate_residuals(system, name, c) for c in parts]
            file.append(pd.concat(tables, ignore_index=True))
    describe_terms(system, trials, compared, p, estimates.covariance, config.model).write(out)
    used = [c.used.min(axis=1, keepdims=True) for c in compared]
    sizes = zip(device.forces, rms((c.force_residual for c in compared), used), strict=True)
    forces = {name: ForceError(rmse=size, unit=device.force_unit) for name, size in sizes}
    fits = {axis: e.fit_percent for axis, e in axes.items() if e.fit_percent is not None}
    best = ", ".join(f"{axis} {fit:.1f} %" for axis, fit in fits.items())
    on = "held-out trials" if any(c.judged for c in compared) else "the trials it was fitted to"
    failed = tuple(find_failed_checks(run.read(IngestResult), estimates, axes))
    checks = f"; {count_noun(len(failed), 'check')} failed" if failed else ""
    return ValidateResult(
        model=config.model,
        axes=axes,
        trials={
            c.trial_id: TrialError.model_validate(axis_errors(system, [c]) | {"held_out": c.judged})
            for c in compared
        },
        forces=forces,
        free_run=free,
        cutoff_hz=dict(zip(system.coordinates, trials.band.cutoff_hz, strict=True)),
        floor_replays=0 if floor is None else floor.replicates,
        failed_checks=failed,
        notes=tuple(notes),
        headline=f"fit on {on}: {best}{checks}",
    ).write(out)


def _leave_out(system: System, published: Array, estimates: IdentifyResult, trial: str) -> Array:
    """The published parameters and timing without a trial, or block of one, (n_p + 1,)."""
    moves = estimates.moves_without(trial)
    without = published.copy()
    for i, item in enumerate(system.parameters):
        without[i] = np.clip(without[i] + moves.get(item.name, 0.0), item.lower, item.upper)
    without[-1] += moves.get("input_timing", 0.0)
    return without


def _noise_floor(
    system: System,
    trials: MeasuredTrials,
    p: Array,
    spec: ModelSpec,
    config: Config,
    progress: Progress,
) -> tuple[NoiseFloor | None, list[str]]:
    """Return the floor, None if the fitted model cannot be simulated, and notes on it."""
    progress(0.4, "noise floor")
    count = config.repeats or count_floor_replicates(trials.motions)
    if count == 1:
        raise InputError("one replicate has no scatter", where="validate.repeats", remedy="set 2")
    # Held-out trials are few, and all are needed for the judgement.
    chosen: Sequence[int] = range(len(trials.motions))
    if all(trials.folds.judged):
        chosen = draw_trials(trial_sizes(trials.motions))
    session = Session(trials.subset(chosen), Criteria(), seed=config.seed)
    try:
        found = session.judge(spec, p, count)
    except InputError as error:
        return None, [f"No noise floor: simulating the fitted model failed ({error})."]
    notes = []
    for i, axis in enumerate(system.coordinates):
        creeps, level = found.creeping_floor[i], found.noise_floor.level[i]
        if level > AT_FLOOR * creeps:
            unit = system.torque_units[i]
            notes.append(
                f"{axis}: the noise floor of {significant(level)} {unit} assumes friction that"
                " stops the machine at reversals; replicates that creep over `sign_width` have a"
                f" floor of {significant(creeps)}."
            )
    return found.noise_floor, notes


def _silent_joints(axes: Mapping[str, JudgedError], compared: Sequence[ComparedTrial]) -> list[str]:
    """Say which joints of a robot these trials do not identify, and the likely reason."""
    found = []
    for i, (axis, entry) in enumerate(axes.items()):
        if entry.fit_percent is None or entry.fit_percent >= SILENT_PERCENT:
            continue
        size = rms((c.measured for c in compared), (c.used for c in compared))[i]
        why = "the model lacks the effect that dominates it"
        if entry.noise_floor is not None and entry.held_out_rmse < 2.0 * entry.noise_floor:
            why = "noise and friction mask it"
        share = max(entry.fit_percent, 0.0)
        found.append(
            f"{axis}: the model explains {share:.0f} % of its torque of {size:.2g} {entry.unit}"
            f" RMS, so these trials do not identify this joint; {why}."
        )
    return found


def _tabulate_residuals(system: System, trial_id: str, c: ComparedTrial) -> pd.DataFrame:
    """Return rows of residuals.parquet: predictions by parameters that have not seen the trial."""
    columns: dict[str, object] = {"trial_id": trial_id, "t": c.t, "held_out": c.judged}
    for i, axis in enumerate(system.coordinates):
        measured = c.measured[:, i]
        columns[f"torque_measured_{axis}"] = measured
        columns[f"torque_predicted_{axis}"] = measured - c.residual_held_out[:, i]
        without = measured - c.residual_without_friction[:, i]
        columns[f"torque_predicted_without_friction_{axis}"] = without
        columns[f"residual_{axis}"] = c.residual_held_out[:, i]
        columns[f"moving_{axis}"] = c.used[:, i]
    for j, name in enumerate(system.model.device.forces):
        component = name.removeprefix("force_")
        columns[f"force_measured_{component}"] = c.force[:, j]
        columns[f"force_predicted_{component}"] = c.force[:, j] - c.force_residual[:, j]
    return pd.DataFrame(columns)
