"""Stage validate: inverse-dynamics torque and handle force against the measured ones (Fig. 9)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.run_folder import FILTERED, INGESTED, RunFolder
from bampipe.data.store import ParquetAppender, read_parquet
from bampipe.declarations.model_file import IDENTIFIED_MODEL, identified, load_model, read_recipe
from bampipe.errors import InputError
from bampipe.identification.drift import find_drift
from bampipe.identification.free_run import free_runs
from bampipe.identification.terms import describe_terms
from bampipe.physics import System, compile_model
from bampipe.physics.recipe import Recipe
from bampipe.progress import Progress
from bampipe.results.checks import find_failed_checks
from bampipe.results.identify import IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.rounding import significant
from bampipe.results.standing import AT_FLOOR, standing
from bampipe.results.validate import (
    AxisError,
    ForceError,
    FreeRun,
    JudgedError,
    TrialError,
    ValidateResult,
)
from bampipe.schema import STRICT, Count
from bampipe.trials.folds import HELD_OUT, Folds
from bampipe.trials.measured import MeasuredTrials, read_measured_trials, trial_of_block
from bampipe.trials.motion import Motion
from bampipe.trials.noise_floor import (
    STILL_WIDTH,
    NoiseFloor,
    find_noise_floor,
    floor_replays,
    parameters_to_replay,
    replay_evidence,
)
from bampipe.trials.reading import held_out_trials, read_motions, require_sound_motions
from bampipe.trials.replay import UNLIKE, StandIn
from bampipe.trials.residuals import Evidence, ModelOnTrial, gather_evidence

SUMMARY = "Predicted against measured torque and force, on trials that the fit has not seen"
INPUTS = (*INGESTED, *FILTERED, *IDENTIFIED_MODEL)
OUTPUTS = (
    "models/{model}/validate.json",
    "models/{model}/residuals.parquet",
    "models/{model}/terms.json",
)

REFUSAL_RATIO = 1.2
"""Error of the published parameters over that of parameters refitted without each trial, beyond
which they do not describe the trials they come from, and are refused."""

SILENT_PERCENT = 30.0
"""Fit of a robot's joint below which its parameters say nothing of it."""
_EXPECTED_SEED = 3
"""After the user's: of the replay that shows how the published parameters would look if true."""

Array = NDArray[np.float64]


@checked_dataclass(frozen=True, config=STRICT)
class Config:
    """Settings of the stage.

    Attributes:
        model: which model version.
        noise_floor: whether to compute what sensors and filters alone would leave.
        repeats: replays for the noise floor; 0 takes as many as the length of the session asks
            for, which is what `diagnose` does.
        seed: of their sensor noise.
        free_run: whether to run the model freely over every trial, and from many starts in it.
        hold_out_by: a channel that is constant in each trial, such as a gain or a supply voltage:
            trials at one value of it are held out together. Empty: one trial at a time.
    """

    model: str = "base"
    noise_floor: bool = True
    repeats: Count = 0
    seed: Count = 0
    free_run: bool = True
    hold_out_by: str = ""


@dataclass(frozen=True)
class _Compared:
    """One trial, low-passed and thinned; torques (K, n_q), N.m or N, forces (K, n_f), N.

    ``used`` (K, n_q) is false where an axis stands still: there Coulomb friction balances
    whatever the load is, and no model predicts it.
    """

    trial_id: str
    t: Array
    used: NDArray[np.bool_]
    measured: Array
    residual: Array
    residual_held_out: Array
    residual_without_friction: Array
    force: Array
    force_residual: Array
    judged: bool


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Compare one identified model with all free trials, and those in a viscous field."""
    model = load_model(run, config.model)
    system = compile_model(model)
    p = identified(run, config.model, system)
    estimates = run.read(IdentifyResult, config.model)
    trials = read_measured_trials(run, system, timing=estimates.input_timing)
    if config.hold_out_by and trials.blocks:
        raise InputError(
            "there is one trial only, so nothing to hold out by a channel",
            where="validate.hold_out_by",
        )
    if config.hold_out_by:
        trials = replace(trials, folds=_folds_by_channel(run, trials, config.hold_out_by))
    require_sound_motions(system, trials.motions)
    progress(0.1, "held-out fits")
    evidence = gather_evidence(system, trials.motions, trials.band, p, trials.folds)
    timing = estimates.input_timing
    # Parameters found with the inputs late are those of inputs that late, known for sure or not.
    late_s = timing.estimate - trials.late_s if timing is not None else 0.0
    compared = [_compare(evidence, number, p, late_s) for number in range(len(trials.motions))]
    expected = np.ones(len(system.coordinates))
    if np.any(_published_rmse(compared) > REFUSAL_RATIO * evidence.held_out_rmse):
        expected = _expected_ratio(evidence, trials, p, config.seed)
    notes = []
    if trials.blocks == len(compared):
        notes.append(
            f"One trial: it is left out in {trials.blocks} blocks with gaps between them, by"
            " parameters fitted to the others."
        )
    if trials.folds.nothing_held_out:
        notes.append("One trial, or one group: nothing is held out; the error is that of the fit.")
    floor: NoiseFloor | None = None
    if config.noise_floor:
        count = config.repeats or floor_replays(trials.motions)

        def report(done: int) -> None:
            progress(0.4 + 0.4 * done / count, "noise floor")

        report(0)
        try:
            replayed = parameters_to_replay(evidence, trials.sensors, trials.kinematics, p)
            floor = find_noise_floor(
                evidence, replayed, trials.sensors, trials.kinematics, config.seed, count, report
            )
        except InputError as error:
            notes.append(f"No noise floor: simulating the fitted model failed ({error}).")
    recipe = read_recipe(run, config.model, model)
    if (
        floor is not None
        and floor.is_exceeded(evidence.held_out_rmse)
        and not recipe.has_drawn_axes
    ):
        floor, said = _with_still_replays(evidence, trials, replayed, floor, recipe, config.seed)
        notes += said
    free: FreeRun | None = None
    if config.free_run and not trials.blocks:
        progress(0.8, "free runs")
        unseen = [evidence.held_out_parameters(k) for k in range(len(trials.motions))]
        free = _run_freely(run, system, trials.motions, unseen, [c.judged for c in compared])
    elif config.free_run:
        progress(0.8, "free runs")
        whole = read_motions(run, system, braked=True)
        held_out = held_out_trials(run)
        judged = [motion.trial_id in held_out for motion in whole]
        free = _run_freely(run, system, whole, [evidence.p] * len(whole), judged)
    if system.model.device.robot is not None:
        notes += _silent_joints(system, compared, floor)
    with ParquetAppender(out / f"models/{config.model}/residuals.parquet") as file:
        for frame in _tables(system, compared):
            file.append(frame)
    describe_terms(evidence, p, estimates.covariance, config.model).write(out)
    return _result(run, system, trials, compared, expected, floor, free, notes, estimates).write(
        out
    )


def _with_still_replays(
    evidence: Evidence,
    trials: MeasuredTrials,
    p: Array,
    floor: NoiseFloor,
    recipe: Recipe,
    seed: int,
) -> tuple[NoiseFloor, list[str]]:
    """The floor of a machine that creeps or stands still where it turns round, and what to say."""
    narrow = compile_model(recipe.with_sign_widths(STILL_WIDTH).model())
    try:
        still = find_noise_floor(
            evidence, p, trials.sensors, trials.kinematics, seed, floor.replays, replayed=narrow
        )
    except InputError:
        return floor, []
    either, system = floor.larger(still), evidence.system
    raised = np.flatnonzero(either.level > AT_FLOOR * floor.level)
    return either, [
        f"{system.coordinates[i]}: replays that stand still where the motion turns round leave"
        f" {significant(still.level[i])} {system.torque_units[i]}, those that creep as `sign_width`"
        f" says {significant(floor.level[i])}: the former is the noise floor. A smaller"
        " `sign_width` in the device file lets more be seen."
        for i in raised
    ]


def _run_freely(
    run: RunFolder,
    system: System,
    motions: Sequence[Motion],
    parameters: Sequence[Array],
    judged: Sequence[bool],
) -> FreeRun:
    """Leave the model to itself, over whole trials and over short horizons."""
    drift = find_drift(system, motions, parameters, judged)
    found = free_runs(run, system, motions, parameters, judged)
    return found.model_copy(update={"drift": drift})


def _silent_joints(
    system: System, compared: Sequence[_Compared], floor: NoiseFloor | None
) -> list[str]:
    """Say which joints of a robot these trials do not identify, and why as far as it shows."""
    found = []
    for i, (axis, entry) in enumerate(_errors(system, compared).items()):
        if entry.fit_percent is None or entry.fit_percent >= SILENT_PERCENT:
            continue
        size = _rms([c.measured for c in compared], [c.used for c in compared])[i]
        buried = floor is not None and entry.held_out_rmse < 2.0 * floor.level[i]
        why = "noise and friction bury it" if buried else "the model lacks what drives it"
        share = max(entry.fit_percent, 0.0)
        found.append(
            f"{axis}: of its torque of {size:.2g} {entry.unit} RMS {share:.0f} % is explained:"
            f" these trials do not identify this joint; {why}."
        )
    return found


def _published_rmse(compared: Sequence[_Compared]) -> Array:
    """Error of the published parameters by axis on the trials that are judged, (n_q,)."""
    unseen = [c for c in compared if c.judged] or compared
    return _rms([c.residual for c in unseen], [c.used for c in unseen])


def _expected_ratio(evidence: Evidence, trials: MeasuredTrials, p: Array, seed: int) -> Array:
    """Return published over held-out error, at least 1, were the published parameters true, (n_q,).

    A refit takes on what filtering does to a change of direction; the truth does not. How much
    worse it therefore looks, a replay of it shows.
    """
    nothing = np.ones(len(evidence.system.coordinates))
    published = StandIn(evidence.system, p, evidence.motions, trials.sensors.rate_hz)
    try:
        again = replay_evidence(
            published, evidence.system, evidence.p, trials.sensors, trials.kinematics,
            evidence.band, evidence.folds, (seed, _EXPECTED_SEED),
        )  # fmt: skip
    except InputError:
        return nothing
    if np.any(again.held_out_rmse > UNLIKE * evidence.held_out_rmse):
        return nothing
    replayed = [_compare(again, number, p) for number in range(len(again.motions))]
    return np.maximum(_published_rmse(replayed) / np.maximum(again.held_out_rmse, 1e-300), 1.0)


def _compare(evidence: Evidence, number: int, p: Array, late_s: float = 0.0) -> _Compared:
    """Compare one trial with the model as published, held out, and without friction.

    Args:
        evidence: the model, fitted; number: of the trial; p: the published parameters.
        late_s: published timing of the inputs, as far as it is not taken off the trials.
    """
    system, motion = evidence.system, evidence.motions[number]
    timed = [motion.with_input_timing(late_s)]
    dry = (effect for effect in system.model.effects if effect.effect.is_dry_friction)
    strengths = {item.name for effect in dry for item in effect.parameters if item.strength}
    frictionless = p.copy()
    for i, item in enumerate(system.parameters):
        if item.name in strengths or item.name.startswith(("viscous.", "coulomb.")):
            frictionless[i] = 0.0
    band, folds = evidence.band, evidence.folds
    u = motion.inputs(system.inputs)
    z = system.memory(motion.q, motion.qd, motion.qdd, u, p, motion.t)
    applied = system.applied(motion.q, motion.qd, motion.qdd, z, u, p)
    force = [system.inputs.index(name) for name in system.model.device.forces]
    rows = band.thinned_rows(len(motion.t))
    residual = band.thin(ModelOnTrial(system, p, timed).residual)
    push = np.linalg.pinv(system.input_map(motion.q[rows], u[rows], p))
    return _Compared(
        trial_id=motion.trial_id,
        t=motion.t[rows],
        used=evidence.used[number],
        measured=band.thin(applied),
        residual=residual,
        residual_held_out=evidence.held_out_residual(number),
        residual_without_friction=band.thin(ModelOnTrial(system, frictionless, timed).residual),
        force=band.thin_input(u[:, force]),
        force_residual=np.einsum("tfq,tq->tf", push, residual),
        judged=folds.judged[number] and not folds.nothing_held_out,
    )


def _folds_by_channel(run: RunFolder, trials: MeasuredTrials, channel: str) -> Folds:
    """Return folds that leave out together the trials at one value of a channel.

    Raises:
        InputError: the channel is not recorded, or changes within a trial.
    """
    path = run.require("ingest/samples.parquet", "ingest")
    values = []
    for motion in trials.motions:
        frame = read_parquet(path, trial=motion.trial_id)
        if channel not in frame:
            raise InputError(f"no channel {channel!r} is recorded", where="validate.hold_out_by")
        column = frame[channel].to_numpy(dtype=float)
        if np.ptp(column) > 1e-9 * np.abs(column).max():
            raise InputError(
                f"channel {channel!r} changes within trial {motion.trial_id}",
                where="validate.hold_out_by",
                remedy="name a channel that is constant in each trial",
            )
        values.append(float(column[0]))
    numbers = [sorted(set(values)).index(value) for value in values]
    unseen = held_out_trials(run)
    groups = [
        HELD_OUT if motion.trial_id in unseen else number
        for motion, number in zip(trials.motions, numbers, strict=True)
    ]
    return Folds.of_groups(groups, trials.folds.fitted)


def _rms(values: Sequence[Array], used: Sequence[NDArray[np.bool_]]) -> Array:
    """Return the root mean square by axis of the samples that count."""
    square = sum(np.sum(v**2 * keep, axis=0) for v, keep in zip(values, used, strict=True))
    count = sum(keep.sum(axis=0) for keep in used)
    return np.asarray(np.sqrt(square / np.maximum(count, 1)))


def _percent(error: float, size: float) -> float:
    """Relative error: norm of the residual over norm of the measured torque, per cent."""
    return 100.0 * error / size if size > 0.0 else 100.0


def _errors(system: System, compared: Sequence[_Compared]) -> dict[str, AxisError]:
    """Return the errors of each axis over some trials."""
    used = [c.used for c in compared]
    rmse = _rms([c.residual for c in compared], used)
    without = _rms([c.residual_without_friction for c in compared], used)
    size = _rms([c.measured for c in compared], used)
    unseen = [c for c in compared if c.judged] or compared
    where = [c.used for c in unseen]
    held_out = _rms([c.residual_held_out for c in unseen], where)
    published = _published_rmse(compared)
    count = np.maximum(sum(keep.sum(axis=0) for keep in where), 1)
    mean = sum(np.sum(c.measured * c.used, axis=0) for c in unseen) / count
    spread = _rms([c.measured - mean for c in unseen], where)
    unseen_size = _rms([c.measured for c in unseen], where)
    # Of an axis that nothing drives, such as a pole on a cart, no force is there to explain.
    return {
        axis: AxisError(
            rmse=rmse[i],
            rmse_without_friction=without[i],
            held_out_rmse=held_out[i],
            published_rmse=published[i],
            relative_error_percent=_percent(rmse[i], size[i]),
            held_out_relative_error_percent=_percent(held_out[i], unseen_size[i]),
            fit_percent=100.0 * (1.0 - held_out[i] / spread[i]) if spread[i] > 0.0 else None,
            unit=system.torque_units[i],
        )
        for i, axis in enumerate(system.coordinates)
    }


def _judged(
    found: AxisError, expected_ratio: float, level: float | None, scatter: float
) -> JudgedError:
    """Hold the error of one axis against its noise floor ``level``, which scatters so much."""
    refused = found.published_rmse > REFUSAL_RATIO * expected_ratio * found.held_out_rmse
    return JudgedError(
        **vars(found),
        noise_floor=level,
        noise_floor_sd=scatter,
        standing=standing(found.held_out_rmse, level, scatter),
        expected_ratio=expected_ratio,
        estimate="refused" if refused else "accepted",
    )


def _result(
    run: RunFolder,
    system: System,
    trials: MeasuredTrials,
    compared: Sequence[_Compared],
    expected: Array,
    floor: NoiseFloor | None,
    free_run: FreeRun | None,
    notes: Sequence[str],
    identified: IdentifyResult,
) -> ValidateResult:
    """Return what validate.json says."""
    axes = {
        axis: _judged(
            found,
            float(expected[i]),
            floor.level[i] if floor else None,
            floor.sd[i] if floor else 0.0,
        )
        for i, (axis, found) in enumerate(_errors(system, compared).items())
    }
    forces = {}
    for column, name in enumerate(system.model.device.forces):
        error_of = np.concatenate([c.force_residual[c.used.all(axis=1), column] for c in compared])
        rmse = np.sqrt(np.mean(error_of**2)) if error_of.size else 0.0
        forces[name] = ForceError(rmse=rmse, unit=system.model.device.force_unit)
    best = ", ".join(
        f"{axis} {entry.fit_percent:.1f} %"
        for axis, entry in axes.items()
        if entry.fit_percent is not None
    )
    on = "held-out trials" if any(c.judged for c in compared) else "the trials it was fitted to"
    refused = ", ".join(axis for axis, entry in axes.items() if entry.estimate == "refused")
    refusal = f"estimate refused ({refused}); " if refused else ""
    failed = tuple(find_failed_checks(run.read(IngestResult), identified, axes))
    checks = f"; {len(failed)} check{'s' if len(failed) > 1 else ''} failed" if failed else ""
    return ValidateResult(
        model=identified.model,
        axes=axes,
        trials={
            c.trial_id: TrialError.model_validate(_errors(system, [c]) | {"held_out": c.judged})
            for c in compared
        },
        forces=forces,
        free_run=free_run,
        cutoff_hz=dict(zip(system.coordinates, trials.band.cutoff_hz, strict=True)),
        floor_replays=0 if floor is None else floor.replays,
        failed_checks=failed,
        notes=tuple(notes),
        headline=f"{refusal}fit on {on}: {best}{checks}",
    )


def _tables(system: System, compared: Sequence[_Compared]) -> Iterator[pd.DataFrame]:
    """Yield residuals.parquet by trial: predictions by parameters that have not seen it."""
    for name, parts in groupby(compared, key=lambda c: trial_of_block(c.trial_id)):
        yield pd.concat([_table(system, name, c) for c in parts], ignore_index=True)


def _table(system: System, trial_id: str, c: _Compared) -> pd.DataFrame:
    columns: dict[str, object] = {"trial_id": trial_id, "t": c.t, "held_out": c.judged}
    for i, axis in enumerate(system.coordinates):
        measured = c.measured[:, i]
        columns[f"torque_measured_{axis}"] = measured
        columns[f"torque_predicted_{axis}"] = measured - c.residual_held_out[:, i]
        columns[f"torque_predicted_without_friction_{axis}"] = (
            measured - c.residual_without_friction[:, i]
        )
        columns[f"residual_{axis}"] = c.residual_held_out[:, i]
        columns[f"moving_{axis}"] = c.used[:, i]
    for j, name in enumerate(system.model.device.forces):
        component = name.removeprefix("force_")
        columns[f"force_measured_{component}"] = c.force[:, j]
        columns[f"force_predicted_{component}"] = c.force[:, j] - c.force_residual[:, j]
    return pd.DataFrame(columns)
