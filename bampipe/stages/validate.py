"""Stage validate: inverse-dynamics torque and handle force against the measured ones (Fig. 9)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.run_folder import RunFolder
from bampipe.data.store import read_parquet, write_parquet
from bampipe.declarations.model_file import identified, load_model, model_inputs
from bampipe.errors import InputError
from bampipe.estimate.least_squares import Problem, fit
from bampipe.estimate.low_pass import Band
from bampipe.estimate.standstill import moving
from bampipe.identification.free_run import free_runs
from bampipe.physics import System, compile_model
from bampipe.progress import Progress
from bampipe.results.validate import ValidateResult
from bampipe.schema import STRICT, Count, Positive
from bampipe.trials.motions import (
    Motion,
    free_trials,
    held_out_trials,
    problem_of,
    read_motions,
)
from bampipe.trials.replayed import replayed

NAME = "validate"
SUMMARY = "Predicted against measured torque and force, on trials that the fit has not seen"

HELD_OUT = -1
"""Group of the trials that the session holds out."""

Array = NDArray[np.float64]


MOST_GROUPS = 10
"""With more trials than this, they are held out in so many groups: the cost of leaving each out
alone grows with the square of their number."""


@checked_dataclass(frozen=True, config=STRICT)
class Config:
    """What the stage can be told.

    Attributes:
        model: which model version.
        cutoff_hz: low-pass that measured and predicted torque both go through, Hz.
        noise_floor: whether to compute what sensors and filters alone would leave.
        repeats: simulated sessions for the noise floor.
        seed: of their sensor noise.
        free_run: whether to run the model freely over every trial.
        hold_out_by: a channel that is constant in each trial, such as a gain or a supply voltage:
            trials at one value of it are held out together. Empty: one trial at a time.
    """

    model: str = "base"
    cutoff_hz: Positive = 8.0
    noise_floor: bool = True
    repeats: Annotated[int, Field(ge=1)] = 1
    seed: Count = 0
    free_run: bool = True
    hold_out_by: str = ""


def inputs(config: Config) -> tuple[str, ...]:
    """Return the paths the stage reads."""
    return (
        "ingest/trials.parquet",
        "ingest/session.json",
        "ingest/samples.parquet",
        "filter/kinematics.parquet",
        "filter/filter.json",
        *model_inputs(config.model),
        f"models/{config.model}/identify.json",
    )


def outputs(config: Config) -> tuple[str, ...]:
    """Return the paths the stage writes."""
    folder = f"models/{config.model}"
    return (f"{folder}/validate.json", f"{folder}/residuals.parquet")


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
    session = run.read_json("ingest/session.json")
    system = compile_model(load_model(run, config.model))
    p = identified(run, config.model, system)
    late = run.read_json(f"models/{config.model}/identify.json")["input_timing"]
    motions = read_motions(run, system, braked=True)
    band = Band(float(session["sample_rate_hz"]), config.cutoff_hz)
    timing = late["sd"] > 0.0  # zero where it was not estimated
    problem = problem_of(system, motions, band, timing=timing)
    p = np.append(p, late["estimate"])
    progress(0.1, "held-out fits")
    groups = _groups(run, motions, config.hold_out_by)
    judged = _judged(groups)
    fitted = _fitted(run, system, motions)
    held_out = _held_out(problem, p, groups, fitted)
    compared = _compare(system, motions, problem, p, held_out, judged)
    notes = []
    if len(set(groups)) == 1:
        notes.append("One trial, or one group: nothing is held out; the error is that of the fit.")
    floor: Array | None = None
    if config.noise_floor:
        progress(0.4, "noise floor")
        try:
            floor = _noise_floor(run, session, system, motions, band, p, config, groups, fitted)
        except InputError as error:
            notes.append(f"No noise floor: simulating the fitted model failed ({error}).")
    used = replace(config, cutoff_hz=band.cutoff_hz)
    content = _content(system, compared, floor, notes, used)
    if config.free_run:
        progress(0.8, "free runs")
        content["free_run"] = free_runs(run, system, motions, held_out, judged)
    write_parquet(out / f"models/{config.model}/residuals.parquet", _table(system, compared))
    return ValidateResult.model_validate(content).write(out)


def _compare(
    system: System,
    motions: Sequence[Motion],
    problem: Problem,
    p: Array,
    held_out: Sequence[Array],
    judged: Sequence[bool],
) -> list[_Compared]:
    """Compare every trial with the model as identified, held out, and without friction."""
    frictionless = p.copy()
    for i, item in enumerate(system.parameters):
        if item.name.startswith(("viscous.", "coulomb.")):
            frictionless[i] = 0.0
    compared = []
    for k, motion in enumerate(motions):
        n = len(system.parameters)
        u = motion.u - p[n] * motion.u_rate
        z = system.memory(motion.q, motion.qd, motion.qdd, u, p[:n], motion.t)
        applied = system.applied(motion.q, motion.qd, motion.qdd, z, u, p[:n])
        force = [system.inputs.index(name) for name in system.model.device.forces]
        kept = problem.band.kept(len(motion.t))
        thin = problem.band.thin
        residual = thin(problem.residual(k, p))
        push = np.linalg.pinv(system.input_map(motion.q[kept], u[kept], p[:n]))
        compared.append(
            _Compared(
                trial_id=motion.trial_id,
                t=motion.t[kept],
                used=moving(problem.resting[k], problem.band),
                measured=thin(applied),
                residual=residual,
                residual_held_out=thin(problem.residual(k, held_out[k])),
                residual_without_friction=thin(problem.residual(k, frictionless)),
                force=thin(motion.u[:, force]),
                force_residual=np.einsum("tfq,tq->tf", push, residual),
                judged=judged[k],
            )
        )
    return compared


def _groups(run: RunFolder, motions: Sequence[Motion], channel: str) -> list[int]:
    """Return the number of the group of each trial; trials of a group are held out together.

    Trials that the session holds out are in the group `HELD_OUT`, which no fit sees.

    Raises:
        InputError: the channel is not recorded, or changes within a trial.
    """
    unseen = held_out_trials(run)
    if not channel:
        return [
            HELD_OUT if motion.trial_id in unseen else number % MOST_GROUPS
            for number, motion in enumerate(motions)
        ]
    path = run.require("ingest/samples.parquet", "ingest")
    values = []
    for motion in motions:
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
    return [HELD_OUT if m.trial_id in unseen else k for m, k in zip(motions, numbers, strict=True)]


def _fitted(run: RunFolder, system: System, motions: Sequence[Motion]) -> list[bool]:
    """Return which trials a fit may see: those that `identify` does.

    What brakes do is no part of a model without an effect of theirs: fitted to them, it would
    be wrong where they are off as well.
    """
    seen = set(free_trials(run, fitted=True, braked=system.braked))
    return [motion.trial_id in seen for motion in motions]


def _judged(groups: Sequence[int]) -> list[bool]:
    """Return which trials count as held out: those of the session, else all by turns."""
    if HELD_OUT in groups:
        return [group == HELD_OUT for group in groups]
    return [len(set(groups)) > 1] * len(groups)


def _held_out(
    problem: Problem, p: Array, groups: Sequence[int], fitted: Sequence[bool]
) -> list[Array]:
    """Return, for each trial, the parameters that the fitted trials of other groups give."""
    if len(set(groups)) == 1:
        return [p] * problem.n_trials
    start = fit(problem, p, trials=[i for i, fits in enumerate(fitted) if fits]).p
    found = {}
    for group in sorted(set(groups)):
        others = [i for i, fits in enumerate(fitted) if fits and groups[i] != group]
        found[group] = fit(problem, start, trials=others).p if others else p
    return [found[group] for group in groups]


def _noise_floor(
    run: RunFolder,
    session: Mapping[str, Any],
    system: System,
    motions: Sequence[Motion],
    band: Band,
    p: Array,
    config: Config,
    groups: Sequence[int],
    fitted: Sequence[bool],
) -> Array:
    """Return the held-out error (n_q,) that the identified model leaves when it is the truth.

    Every trial is replayed by the model under the measured force and an arm that keeps the
    motion near the measured one; the replay goes through the same encoders, force noise,
    filters and fits as the measurement.
    """
    settings = run.read_json("filter/filter.json")
    squares, counts = np.zeros(len(system.coordinates)), np.zeros(len(system.coordinates))
    parameters = p[: len(system.parameters)]
    for repeat in range(config.repeats):
        seed = (config.seed, repeat)
        seen = replayed(session, settings, system, motions, parameters, band.rate_hz, seed)
        problem = problem_of(system, seen, band)
        start = np.append(parameters, 0.0)
        for k, held in enumerate(_held_out(problem, start, groups, fitted)):
            if HELD_OUT in groups and groups[k] != HELD_OUT:
                continue
            used = moving(problem.resting[k], band)
            residual = band.thin(problem.residual(k, held)) * used
            squares += np.sum(residual**2, axis=0)
            counts += used.sum(axis=0)
    return np.asarray(np.sqrt(squares / np.maximum(counts, 1.0)))


def _rms(values: Sequence[Array], used: Sequence[NDArray[np.bool_]]) -> Array:
    """Return the root mean square by axis of the samples that count."""
    square = sum(np.sum(v**2 * keep, axis=0) for v, keep in zip(values, used, strict=True))
    count = sum(keep.sum(axis=0) for keep in used)
    return np.asarray(np.sqrt(square / np.maximum(count, 1)))


def _percent(error: float, size: float) -> float:
    """Relative error: norm of the residual over norm of the measured torque, per cent."""
    return float(100.0 * error / size) if size > 0.0 else 100.0


def _entries(
    system: System, compared: Sequence[_Compared], floor: Array | None
) -> dict[str, dict[str, object]]:
    """Return the numbers of each axis over some trials."""
    used = [c.used for c in compared]
    rmse = _rms([c.residual for c in compared], used)
    without = _rms([c.residual_without_friction for c in compared], used)
    size = _rms([c.measured for c in compared], used)
    unseen = [c for c in compared if c.judged] or compared
    where = [c.used for c in unseen]
    held_out = _rms([c.residual_held_out for c in unseen], where)
    count = np.maximum(sum(keep.sum(axis=0) for keep in where), 1)
    mean = sum(np.sum(c.measured * c.used, axis=0) for c in unseen) / count
    spread = _rms([c.measured - mean for c in unseen], where)
    unseen_size = _rms([c.measured for c in unseen], where)
    entries: dict[str, dict[str, object]] = {}
    for i, axis in enumerate(system.coordinates):
        # Of an axis that nothing drives, such as a pole on a cart, no force is there to explain.
        fit = 100.0 * (1.0 - held_out[i] / spread[i]) if spread[i] > 0.0 else None
        entries[axis] = {
            "rmse": float(rmse[i]),
            "rmse_without_friction": float(without[i]),
            "held_out_rmse": float(held_out[i]),
            "relative_error_percent": _percent(rmse[i], size[i]),
            "held_out_relative_error_percent": _percent(held_out[i], unseen_size[i]),
            "fit_percent": None if fit is None else float(fit),
            "unit": system.torque_units[i],
        }
        if floor is not None:
            entries[axis]["noise_floor"] = float(floor[i])
    return entries


def _content(
    system: System,
    compared: Sequence[_Compared],
    floor: Array | None,
    notes: Sequence[str],
    config: Config,
) -> dict[str, object]:
    """Return what validate.json says."""
    axes = _entries(system, compared, floor)
    forces = {}
    for column, name in enumerate(system.model.device.forces):
        error = np.concatenate([c.force_residual[c.used.all(axis=1), column] for c in compared])
        forces[name] = {
            "rmse": float(np.sqrt(np.mean(error**2))) if error.size else 0.0,
            "unit": system.model.device.force_unit,
        }
    best = ", ".join(
        f"{axis} {entry['fit_percent']:.1f} %"
        for axis, entry in axes.items()
        if entry["fit_percent"] is not None
    )
    on = "held-out trials" if any(c.judged for c in compared) else "the trials it was fitted to"
    return {
        "model": config.model,
        "axes": axes,
        "trials": {
            c.trial_id: _entries(system, [c], None) | {"held_out": c.judged} for c in compared
        },
        "forces": forces,
        "cutoff_hz": config.cutoff_hz,
        "notes": list(notes),
        "headline": f"fit on {on}: {best}",
    }


def _table(system: System, compared: Sequence[_Compared]) -> pd.DataFrame:
    """Return residuals.parquet: predictions by parameters that have not seen the trial."""
    frames = []
    for c in compared:
        columns: dict[str, object] = {"trial_id": c.trial_id, "t": c.t, "held_out": c.judged}
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
        frames.append(pd.DataFrame(columns))
    return pd.concat(frames, ignore_index=True)
