"""Stage stiffness: of axes that were locked and loaded (Fig. 3), of gears with two encoders."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from pydantic.dataclasses import dataclass as checked_dataclass
from scipy.stats import linregress

from bampipe.arrays import Array
from bampipe.data.refusals import refusal
from bampipe.data.run_folder import INGESTED, RunFolder
from bampipe.data.store import ParquetAppender, read_parquet
from bampipe.declarations.model_file import load_device
from bampipe.errors import InputError
from bampipe.estimate.differentiation import uniform_grid
from bampipe.estimate.gear_windup import Windup, find_windup
from bampipe.estimate.hysteresis import Hysteresis, measure_hysteresis
from bampipe.physics import Model, System, compile_model
from bampipe.progress import Progress
from bampipe.results.ingest import IngestResult
from bampipe.results.rounding import round_with_sd
from bampipe.results.stiffness import (
    AxisStiffness,
    Bandwidth,
    GearStiffness,
    LockedTrial,
    LoopCycle,
    StiffnessResult,
)
from bampipe.schema import STRICT, Positive
from bampipe.trials.motion import Motion
from bampipe.trials.signals import Signals, calibration_changes

SUMMARY = "Stiffness, loop width and bandwidth of locked axes; gears with two encoders"
INPUTS = (*INGESTED, "ingest/device.toml?")
OUTPUTS = ("stiffness/stiffness.json", "stiffness/loops.parquet")

_FEWEST = 100
"""Most samples of a trial that determine the wind-up of a gear."""
_SMOOTHED_S = 0.05
"""Averaging time of the velocity whose sign the drive's friction follows."""
_SURE = 3.0
"""Compliance and play are significant from so many standard uncertainties on."""

_COLUMNS = {
    "trial_id": "str", "axis": "str", "cycle": "int64", "branch": "str",
    "t": "float64", "torque": "float64", "deflection": "float64", "post_yield": "bool",
}  # fmt: skip
"""Columns of loops.parquet, and their types."""


@checked_dataclass(frozen=True, config=STRICT)
class Config:
    """Settings of the stage.

    Attributes:
        largest_drift: a locked trial whose loops drift from the first to the last cycle by more
            than this share of their range is reported as a slipping brake.
    """

    largest_drift: Positive = 0.05


@dataclass(frozen=True)
class _Loops:
    """The loops of one locked trial.

    ``pose`` is the median reading of every axis (n_q,), ``torque`` and ``deflection`` (T,) are
    the whole record of the locked axis, ``calibration`` the share by which one standard
    uncertainty of each sensor's calibration changes the stiffness.
    """

    trial_id: str
    pose: Array
    torque: Array
    deflection: Array
    rate: float
    found: Hysteresis
    calibration: Mapping[str, float]


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Find the stiffness of every axis that has a locked trial."""
    session = run.read(IngestResult)
    system = compile_model(Model(load_device(run, session.device)))
    samples = run.require("ingest/samples.parquet", "ingest")
    trials = read_parquet(run.require("ingest/trials.parquet", "ingest"))
    locked = trials[(trials["kind"] == "locked") & (trials["status"] != "set_aside")]

    loops: dict[str, list[_Loops]] = {}
    notes: list[str] = []
    for number, row in enumerate(locked.itertuples()):
        progress(number / len(locked), str(row.trial_id))
        axis = str(row.locked_axis)
        if axis not in system.coordinates:
            of = {"name": f"axis {axis!r}", "near": "", "axes": ", ".join(system.coordinates)}
            raise refusal("unknown_axis", f"trial {row.trial_id}: locked_axis", **of)
        result = _loops_of(samples, str(row.trial_id), axis, system, session)
        if isinstance(result, str):
            notes.append(f"{row.trial_id}: {result}")
        else:
            loops.setdefault(axis, []).append(result)
    gears = _gears(samples, trials, system, session, notes)
    if locked.empty and not gears:
        notes.append("No locked trials in this session: no stiffness to report.")
    axes = {
        axis: _axis(axis, loops[axis], system, config, notes)
        for axis in system.coordinates
        if axis in loops
    }
    with ParquetAppender(out / "stiffness/loops.parquet") as file:
        for axis, found in loops.items():
            for trial in found:
                file.append(_loop_rows(axis, trial))
        if not loops:
            file.append(pd.DataFrame(columns=[*_COLUMNS]).astype(_COLUMNS))
    said = [
        f"{axis} {round_with_sd(entry.stiffness, entry.sd)} {entry.unit} "
        f"({entry.bandwidth_rad_s:.3g} rad/s, {entry.bandwidth_hz:.3g} Hz)"
        for axis, entry in axes.items()
    ]
    headline = "; ".join([*said, *_describe_gears(gears)]) or notes[-1]
    return StiffnessResult(axes=axes, notes=tuple(notes), headline=headline, gears=gears).write(out)


def _gears(
    samples: Path, trials: pd.DataFrame, system: System, session: IngestResult, notes: list[str]
) -> dict[str, GearStiffness]:
    """Stiffness of every gear with an encoder on either side, from the free trials."""
    second = {c.second_encoder_of: n for n, c in session.channels.items() if c.second_encoder_of}
    free = trials[(trials["kind"] == "free") & (trials["status"] != "set_aside")]
    if not second or free.empty:
        return {}
    robot = system.model.device.robot
    rotors = robot.rotors_at_joints if robot is not None else {}
    apart: dict[str, list[tuple[Array, Array, Array]]] = {axis: [] for axis in second}
    for trial_id in free["trial_id"]:
        frame = read_parquet(samples, trial=str(trial_id)).dropna()
        if len(frame) < _FEWEST:
            continue
        q = frame[[f"q_{name}" for name in system.coordinates]].to_numpy(dtype=np.float64)
        u = np.column_stack([frame.get(name, 0.0 * frame["t"]) for name in system.inputs])
        t = frame["t"].to_numpy(dtype=np.float64)
        load = _applied(system, q, u, t)
        for axis, channel in second.items():
            number = system.coordinates.index(axis)
            rate = np.gradient(q[:, number], t)
            width = max(3, round(_SMOOTHED_S * session.sample_rate_hz))
            smooth = np.convolve(rate, np.full(width, 1.0 / width), "same")
            difference = frame[channel].to_numpy(dtype=np.float64) - q[:, number]
            carried = load[:, number]
            if axis in rotors:
                change = np.convolve(np.gradient(smooth, t), np.full(width, 1.0 / width), "same")
                carried = carried - rotors[axis] * change
            apart[axis].append((difference, carried, smooth))
    found = {}
    for axis, parts in apart.items():
        if not parts:
            continue
        try:
            differences, loads, rates = zip(*parts, strict=True)
            windup = find_windup(differences, loads, rates, axis in rotors)
        except InputError as error:
            notes.append(f"{axis}: {error}")
            continue
        found[axis] = _gear(axis, second[axis], windup, system, notes)
    return found


def _gear(
    axis: str, channel: str, windup: Windup, system: System, notes: list[str]
) -> GearStiffness:
    number = system.coordinates.index(axis)
    unit = system.coordinate_units[number]
    size, stiffness, sd = abs(windup.compliance), None, None
    if size > _SURE * windup.compliance_sd:
        stiffness, sd = 1.0 / size, windup.compliance_sd / size**2
    else:
        notes.append(f"{axis}: its two encoders do not move apart with the load.")
    return GearStiffness.of(
        windup,
        stiffness=stiffness,
        sd=sd,
        unit=f"{system.torque_units[number]}/{unit}",
        play=None if windup.play is None else windup.play * np.sign(windup.compliance),
        play_unit=unit,
        side="motor" if windup.compliance > 0.0 else "load",
        channel=channel,
    )


def _loops_of(
    samples: Path, trial_id: str, axis: str, system: System, session: IngestResult
) -> _Loops | str:
    """Return the loops of one trial, or why there are none."""
    rate = session.sample_rate_hz
    frame = read_parquet(samples, trial=trial_id).dropna()
    t = frame["t"].to_numpy(dtype=np.float64)
    if len(t) < 2:
        return "no sound samples"
    # Encoder counts must stay counts: a missing sample takes the previous value.
    grid = uniform_grid(t, rate)
    held = {
        name: grid.hold(frame[name].to_numpy(dtype=np.float64))
        for name in frame.columns
        if name not in ("trial_id", "t")
    } | {"t": grid.t}
    for name in system.inputs:
        if name.startswith("brake_"):  # a session without brake channels has its brakes off
            held.setdefault(name, np.zeros_like(grid.t))
    absent = [name for name in system.inputs if name not in held]
    if absent:
        raise InputError(
            f"no channel {absent[0]!r}, which the device needs", where=f"trial {trial_id}"
        )
    q = np.stack([held[f"q_{name}"] for name in system.coordinates], axis=1)
    u = np.stack([held[name] for name in system.inputs], axis=1)
    number, still = system.coordinates.index(axis), np.zeros_like(q)
    torque = np.ascontiguousarray(_applied(system, q, u, grid.t)[:, number])
    deflection = np.ascontiguousarray(q[:, number])
    try:
        found = measure_hysteresis(torque, deflection, rate)
    except ValueError as error:
        return str(error)
    pose = np.median(q, axis=0)
    channels = {name: held[name] for name in system.inputs}
    motion = Motion(trial_id, grid.t, q, still, still, still, channels)
    signals = Signals.of_session(system, session)
    calibration = _find_calibration_shares(system, signals, motion, number, torque)
    return _Loops(trial_id, pose, torque, deflection, rate, found, calibration)


def _find_calibration_shares(
    system: System, signals: Signals, motion: Motion, number: int, torque: Array
) -> dict[str, float]:
    """Return the share of a stiffness that one standard uncertainty of each source is.

    ``torque`` (T,) is that on axis ``number``, as logged.
    """
    deflection, shares = motion.q[:, number], {}
    for name, change in calibration_changes(signals):
        moved = change.of_motion(motion, signals)
        theirs = _applied(system, moved.q, moved.inputs(system.inputs), moved.t)[:, number]
        torques = linregress(torque, theirs).slope
        shares[name] = torques / linregress(deflection, moved.q[:, number]).slope - 1.0
    return shares


def _applied(system: System, q: Array, u: Array, t: Array) -> Array:
    """Generalised force (T, n_q) of inputs u (T, n_u) on a device at rest in poses q (T, n_q)."""
    still, p = np.zeros_like(q), system.prior
    return system.applied(q, still, still, system.memory(q, still, still, u, p, t), u, p)


def _axis(
    axis: str, trials: list[_Loops], system: System, config: Config, notes: list[str]
) -> AxisStiffness:
    """Return the entry of one axis; add to ``notes`` what a reader must know."""
    number = system.coordinates.index(axis)
    unit = f"{system.torque_units[number]}/{system.coordinate_units[number]}"
    cycles = [(trial, cycle) for trial in trials for cycle in trial.found.cycles]
    weights = np.array([len(trial.found.cycles) for trial in trials]) / len(cycles)
    stiffness = float(weights @ [trial.found.stiffness for trial in trials])
    error = float(np.linalg.norm(weights * [trial.found.standard_error for trial in trials]))
    # The remainder of the transition has the same sign in every trial.
    systematic = float(weights @ [trial.found.systematic for trial in trials])
    shares: dict[str, float] = defaultdict(float)
    for weight, trial in zip(weights, trials, strict=True):
        for name, share in trial.calibration.items():
            shares[name] += weight * share
    calibration = stiffness * float(np.linalg.norm(list(shares.values())))
    drifts = {trial.trial_id: _drift(trial) for trial in trials}
    for trial in trials:
        if not trial.found.yielded:
            notes.append(
                f"{trial.trial_id}: the slope of the loops changes by"
                f" {100.0 * trial.found.slope_change:.1f} % over their straight part, so the"
                " stiffness is too high: load the axis further."
            )
        if abs(drift := drifts[trial.trial_id]) > config.largest_drift:
            notes.append(
                f"{trial.trial_id}: the loops drift by {100.0 * drift:.1f} % of their range, so"
                " the brake slips."
            )
    poses = _poses(system, trials[0].pose)
    bandwidths = {}
    for name, pose in poses.items():
        inertia = float(system.mass_matrix(pose[None, :], system.prior)[0, number, number])
        speed = float(np.sqrt(stiffness / inertia))
        bandwidths[name] = Bandwidth(rad_s=speed, hz=speed / (2.0 * np.pi), inertia=inertia)
    stated = "maximum_extension" if "maximum_extension" in bandwidths else "recorded"
    return AxisStiffness(
        stiffness=stiffness,
        sd=float(np.linalg.norm([error, systematic, calibration])),
        standard_error=error,
        systematic=systematic,
        calibration_sd=calibration,
        unit=unit,
        n_cycles=len(cycles),
        bandwidth_rad_s=bandwidths[stated].rad_s,
        bandwidth_hz=bandwidths[stated].hz,
        bandwidth_pose=stated,
        bandwidths=bandwidths,
        poses={
            name: dict(zip(system.coordinates, pose, strict=True)) for name, pose in poses.items()
        },
        loop_width=float(np.mean([cycle.loop_width for _, cycle in cycles])),
        loop_width_unit=system.torque_units[number],
        loop_width_deflection=float(np.mean([cycle.loop_width_deflection for _, cycle in cycles])),
        loop_width_deflection_unit=system.coordinate_units[number],
        energy_per_cycle=float(np.mean([cycle.energy for _, cycle in cycles])),
        energy_unit="J",
        yielded=all(trial.found.yielded for trial in trials),
        cycles=tuple(
            LoopCycle.of(
                cycle, trial_id=trial.trial_id, duration_s=(cycle.stop - cycle.start) / trial.rate
            )
            for trial, cycle in cycles
        ),
        trials={t.trial_id: LockedTrial.of(t.found, drift=drifts[t.trial_id]) for t in trials},
    )


def _drift(trial: _Loops) -> float:
    """Return the drift of the loops from first to last cycle, as a share of their range."""
    cycles = trial.found.cycles
    reach = 2.0 * max(cycle.amplitude for cycle in cycles) / trial.found.stiffness
    return (cycles[-1].centre - cycles[0].centre) / reach


def _poses(system: System, recorded: Array) -> dict[str, Array]:
    """Return the poses at which the bandwidth is stated, each (n_q,).

    ``recorded`` is that of the locked trial. Where the device has linear axes with limits,
    ``maximum_extension`` has them at their upper limits and the rotary axes at zero, where the
    inertia about them is largest.
    """
    device = system.model.device
    poses = {"recorded": recorded}
    linear = [c.name for c in device.coordinates if c.kind == "linear" and c.name in device.limits]
    if linear and len(linear) < len(device.coordinates):
        poses["maximum_extension"] = np.array(
            [device.limits[c.name][1] if c.name in linear else 0.0 for c in device.coordinates]
        )
    return poses


def _loop_rows(axis: str, trial: _Loops) -> pd.DataFrame:
    """Return the samples of one trial, branch by branch; deflection from the recorded pose."""
    branches = trial.found.branches
    rows = np.concatenate([np.arange(branch.start, branch.stop) for branch in branches])
    number = np.repeat(np.arange(len(branches)), [one.stop - one.start for one in branches])
    direction = np.array([branch.direction for branch in branches])[number]
    since_reversal = trial.torque[rows] - trial.torque[[one.start for one in branches]][number]
    return pd.DataFrame(
        {
            "trial_id": trial.trial_id,
            "axis": axis,
            "cycle": number // 2,
            "branch": np.where(direction > 0, "rising", "falling"),
            "t": rows / trial.rate,
            "torque": trial.torque[rows],
            "deflection": trial.deflection[rows],
            "post_yield": direction * since_reversal >= trial.found.transition,
        }
    )


def _describe_gears(gears: Mapping[str, GearStiffness]) -> list[str]:
    """The stiffness of every gear with two encoders."""
    found = []
    for axis, gear in gears.items():
        words = "stiffer than its encoders show"
        if gear.stiffness is not None and gear.sd is not None:
            words = f"{round_with_sd(gear.stiffness, gear.sd)} {gear.unit}"
        if gear.play is not None and gear.play_sd is not None and gear.play > _SURE * gear.play_sd:
            words += f", play {round_with_sd(gear.play, gear.play_sd)} {gear.play_unit}"
        if abs(gear.late_s) > _SURE * gear.late_sd:
            when = "after" if gear.late_s > 0.0 else "before"
            words += f", second encoder read {1e3 * abs(gear.late_s):.2g} ms {when} the first"
        found.append(f"gear of {axis} {words}")
    return found
