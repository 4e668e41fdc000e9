"""Stage viscous: the Cartesian damping that the brakes rendered, against the command (Fig. 8)."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass
from scipy import stats

from bampipe.arrays import Array
from bampipe.data.run_folder import FILTERED, INGESTED, RunFolder
from bampipe.data.store import read_parquet, trial_ids, write_parquet
from bampipe.declarations.model_file import IDENTIFIED_MODEL, load_model
from bampipe.estimate.filter_uncertainty import sandwich_covariance
from bampipe.identification import filter_run
from bampipe.identification.filter_tables import tabulate_trace
from bampipe.identification.sensor_noise import FilterChoice, untuned_settings
from bampipe.physics import Model, System, compile_model
from bampipe.physics.viscous_field import NAME as FIELD
from bampipe.physics.viscous_field import viscous_field
from bampipe.progress import Progress
from bampipe.results.filter import FilterResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.rounding import round_with_sd
from bampipe.results.viscous import Damping, ViscousResult
from bampipe.schema import STRICT, Positive
from bampipe.trials.motion import Motion, trial_names
from bampipe.trials.reading import read_kinematics, read_motion, read_sensors

SUMMARY = "Cartesian damping that the brakes rendered in the viscous trials, against the command"
INPUTS = (*INGESTED, *FILTERED, *IDENTIFIED_MODEL)
OUTPUTS = ("models/{model}/viscous.json", "models/{model}/viscous.parquet")


_SIGNIFICANT = 0.05
_RESTARTS = 4


@checked_dataclass(frozen=True, config=STRICT)
class Config(FilterChoice):
    """Settings of the stage.

    Attributes:
        model: which model version.
    """

    model: str = "base"
    longest_step_s: Positive = 2e-3
    trace_rows: Annotated[int, Field(gt=0)] = 1000


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Estimate the damping along each direction of the handle from the viscous trials.

    The brakes' commands are removed from the model, and their effect becomes a state of the filter;
    friction and inertia stay as identified, with their uncertainty.
    """
    trials = read_parquet(run.require("ingest/trials.parquet", "ingest"))
    trials = trials[(trials["kind"] == "viscous") & (trials["status"] != "set_aside")]
    path = run.require("filter/kinematics.parquet", "filter")
    trials = trials[trials["trial_id"].astype(str).isin(trial_ids(path))]
    target = f"models/{config.model}/viscous"
    if trials.empty:
        rows = pd.DataFrame(columns=["t_total", "trial_id"])
        rows = rows.astype({"t_total": "float64", "trial_id": "str"})
        write_parquet(out / f"{target}.parquet", rows)
        headline = "No trials in a viscous field in this session."
        empty = ViscousResult(model=config.model, directions={}, trials=(), headline=headline)
        return empty.write(out)
    identified = run.read(IdentifyResult, config.model)
    bare = load_model(run, config.model)
    effects = [item.effect for item in bare.effects]
    names = [item.name for item in bare.effects]
    system = compile_model(
        Model(bare.device, [*names, FIELD], [*effects, viscous_field(bare.device)])
    )
    progress(0.1, "reading the trials")
    brakes = [name for name in bare.device.brakes.values() if name in system.inputs]
    motions = []
    stretches, filters = run.read(FilterResult).disturbances, read_kinematics(run, system)
    for name in trials["trial_id"].astype(str):  # as if no brake had been commanded
        motion = read_motion(path, name, system, stretches.get(name, ()), filters)
        motions.append(motion.with_channels({b: np.zeros(motion.t.size) for b in brakes}))
    commanded = trials["viscous_n_s_per_m"].to_numpy(dtype=float)
    result, frame = _estimate_damping(run, system, motions, commanded, identified, config, progress)
    write_parquet(out / f"{target}.parquet", frame)
    return result.write(out)


def _estimate_damping(
    run: RunFolder,
    system: System,
    motions: Sequence[Motion],
    commanded: Array,
    identified: IdentifyResult,
    config: Config,
    progress: Progress,
) -> tuple[ViscousResult, pd.DataFrame]:
    """Return the content of viscous.json, and the convergence of the estimates."""
    known = identified.parameters
    estimates = {name: one.estimate for name, one in known.items()}
    start = np.array([estimates.get(item.name, item.prior) for item in system.parameters])
    settings = untuned_settings(read_sensors(run, system), system, motions, start, config)
    settings = settings._replace(stride=filter_run.choose_stride(motions))
    if identified.noise is not None and config.force_noise == 0.0:
        found_sd = [identified.noise.process_sd[name] for name in system.noise]
        settings = settings._replace(noise_sd=np.array(found_sd))
    is_brake = [name in system.model.device.brakes.values() for name in system.inputs]
    readings = []
    for motion in motions:
        trial = filter_run.load_filter_trial(run, motion, system, start, settings)
        readings.append(replace(trial, u=np.where(is_brake, 0.0, trial.u)))
    free = [item for item in system.parameters if not item.fixed]
    late_s = identified.input_timing.estimate
    model = filter_run.build_filter_model(system, readings, start, False, late_s)
    command = float(np.nanmean(commanded)) if np.isfinite(commanded).any() else None
    value = np.array([estimates.get(item.name, command or 0.0) for item in free])
    sd = np.array([known[item.name].sd if item.name in known else item.sd for item in free])
    sd = np.maximum(sd, 1e-9 * np.maximum(np.abs(value), 1e-6))
    attempts: list[filter_run.Attempt] = [(value, sd, 4.0**k) for k in range(_RESTARTS)]
    found = filter_run.follow_trials(
        model,
        readings,
        config,
        trial_names(motions),
        attempts,
        settings,
        where=f"model {config.model}",
        remedy="set the trial aside, or identify with an effect of the brakes",
        report_progress=lambda fraction, message: progress(0.2 + 0.75 * fraction, message),
    )
    estimate, slope = model.to_physical(found.theta)
    names = [item.name for item in free]
    field = [i for i, name in enumerate(names) if name.startswith(f"{FIELD}.")]
    field_sd, blocks = _block_sd(found, model.n_states, field)
    spread = slope[field] * field_sd
    friction = _device_damping(system, motions, start)
    directions = {
        component: _direction(estimate[field[k]], spread[k], friction[k], command, blocks)
        for k, component in enumerate(system.model.device.components)
    }
    frame = tabulate_trace(names, model, motions, found, config.trace_rows)
    kept = [c for c in frame if c in ("t_total", "trial_id") or str(c).startswith(f"{FIELD}.")]
    frame = frame[kept].rename(columns=lambda c: str(c).removeprefix(f"{FIELD}."))
    result = ViscousResult(
        model=config.model,
        trials=tuple(motion.trial_id for motion in motions),
        directions=directions,
        blocks=blocks,
        headline="; ".join(
            f"{name} {round_with_sd(entry.estimate, entry.sd)} N.s/m"
            + ("" if command is None else f" ({entry.verdict})")
            for name, entry in directions.items()
        ),
    )
    return result, frame


def _block_sd(
    found: filter_run.FilterRun, n_states: int, field: Sequence[int]
) -> tuple[Array, int]:
    """Return standard deviations of the ``field`` from the scatter of blocks, and their number.

    Identified parameters are known so much better than the field that these trials hardly move
    them: each is put on the scale of its own uncertainty, or the inverses would lose it.
    """
    scale = np.sqrt(np.diag(found.covariance))
    all_scales = np.concatenate([np.ones(n_states), scale])
    both = np.outer(all_scales, all_scales)
    ends = [
        replace(one, mean=one.mean / all_scales, covariance=one.covariance / both)
        for one in found.ends
    ]
    covariance, blocks = sandwich_covariance(
        ends, n_states, found.search_theta / scale, found.search_covariance / np.outer(scale, scale)
    )
    return scale[field] * np.sqrt(np.diag(covariance)[field]), blocks


def _device_damping(system: System, motions: Sequence[Motion], p: Array) -> Array:
    """Return the device's own viscous friction as felt along each direction, mean, (n_f,), N.s/m.

    q' = B^-T v, so that joint damping D is felt as B^-1 D B^-T.
    """
    parameters = system.by_name(p)
    joint = np.diag([parameters.get(f"viscous.{axis}", 0.0) for axis in system.coordinates])
    felt = []
    for motion in motions:
        rows = slice(None, None, max(1, len(motion.t) // 500))
        u = motion.inputs(system.inputs)[rows]
        back = np.linalg.pinv(system.input_map(motion.q[rows], u, p))
        felt.append(np.einsum("tfi,ij,tfj->tf", back, joint, back))
    return np.asarray(np.concatenate(felt).mean(axis=0))


def _direction(
    estimate: float, sd: float, friction: float, command: float | None, blocks: int
) -> Damping:
    """Return the record of one direction; the test is two-sided, Student's t over blocks."""
    felt = estimate + friction
    found = partial(
        Damping, estimate=estimate, sd=sd, own_friction=friction, felt=felt, unit="N.s/m"
    )
    if command is None:
        return found()
    ratios = [abs(value - command) / sd if sd > 0.0 else np.inf for value in (estimate, felt)]
    p, felt_p = (float(2.0 * stats.t.sf(ratio, max(blocks - 1, 1))) for ratio in ratios)
    differs = p < _SIGNIFICANT
    what = "differs" if differs else "no significant difference"
    return found(
        commanded=command,
        p_value=p,
        differs=differs,
        felt_differs=felt_p < _SIGNIFICANT,
        verdict=f"{what} from the commanded {command:.4g}, p = {p:.2g}",
    )
