"""Free runs: simulations by the identified model, compared with the measured position.

If the device declares its controller and the session recorded its channels, machine and controller
are simulated together over whole trials, driven by the reference (closed loop). Otherwise the
recorded inputs alone drive the model (open loop). Over a whole trial this is meaningful only if the
mechanism forgets its start: without a restoring force, any force error is integrated for ever. Over
a tenth of a second to two seconds it is always meaningful (drift): from the filtered state at many
instants, the recorded inputs drive the model.
"""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from bampipe.arrays import Array, Flags
from bampipe.data.run_folder import RunFolder
from bampipe.data.store import read_parquet
from bampipe.errors import InputError
from bampipe.estimate.simulation import (
    MAX_STEP_S,
    Plant,
    Runaway,
    make_plant,
    read_finely,
    simulate,
)
from bampipe.physics import System
from bampipe.physics.control_law import ControlLaw, compile_law
from bampipe.physics.device import INPUT_ORDERS, derivative
from bampipe.results.ingest import IngestResult
from bampipe.results.validate import AxisDrift, CommandError, Drift, FreeRun, FreeRunError
from bampipe.trials.motion import Motion
from bampipe.trials.replicates import is_stiff

CLOSED: Final = "closed_loop"
OPEN: Final = "open_loop"
_PUSHED = 0.1
"""Displacement of the start in the test whether it is forgotten, in deviations of the motion."""
_FORGOTTEN = 0.5
"""Largest fraction of the displacement that may remain over the last fifth of a trial."""
HORIZONS_S = (0.1, 0.5, 2.0)
"""Durations of a reversal, a movement and several movements of a hand."""
_STARTS = 100
"""Largest number of starts over all trials; neighbours overlap, so that more add little."""
_STARTS_OF_ROBOT = 20
"""The same for a robot, whose light joints take a hundred times longer to integrate: 0.3 s each."""
_LEAST = 10
"""Smallest number of windows in which an axis moves, for meaningful quantiles."""
_MARGIN_S = 0.2
"""Time lost to the filters at both ends of a trial."""
_MOVES = 0.01
"""Smallest motion, relative to the range in the trial, at which an axis counts in a window."""
_RUNS_AWAY = 0.1
"""Largest fraction of windows that may diverge."""
_RUN_AWAY_PERCENT = 1000.0
"""A free run is meaningless if its error exceeds this percentage of the motion."""
_STEPS_S = (1e-3, 1e-4)
"""Longest integration steps. The second is tried if a motion diverges with the first: friction that
builds up within micrometres is stiffer than an axis, and diverges because of the step alone."""


_Reach = tuple[Array, Array, Flags]
"""A run at one horizon, (n_q,) each: error, infinite if diverged; displacement; whether the axis
moves."""


@dataclass(frozen=True)
class _Run:
    """One trial: measured and simulated readings (T, 2 n_q), commands (T, n_f)."""

    trial_id: str
    measured: Array
    simulated: Array
    force: Array
    command: Array


def free_runs(
    run: RunFolder,
    system: System,
    motions: Sequence[Motion],
    parameters: Sequence[Array],
    judged: Sequence[bool],
) -> FreeRun:
    """Run the model freely over every trial and compare it with the measurement.

    ``parameters`` of each trial, (>= n_p,), are fitted without it; ``judged`` says which trials
    count, all if none does. The run folder has the channels of the controller. Returns errors in
    closed loop, otherwise in open loop; only a ``reason`` if no free run is possible or meaningful.
    """
    why_not = why_not_free(system, motions, parameters)
    if why_not and not system.model.device.prescribed:
        return FreeRun(reason=why_not)
    law = compile_law(system.model.device)
    reason = (
        "the device file declares no [controller]"
        if law is None
        else _why_not_closed(run, system, law)
    )
    mode: Literal["closed_loop", "open_loop"] = OPEN if law is None or reason else CLOSED
    runs = []
    try:
        for motion, p in zip(motions, parameters, strict=True):
            if law is not None and mode == CLOSED:
                runs.append(_run_closed_loop(run, system, motion, p, law))
            elif runs or _forgets(system, motion, p):
                runs.append(_run_open_loop(system, motion, p))
            else:
                return FreeRun(
                    reason=f"{reason}, and under its recorded inputs alone the mechanism does not"
                    " forget its initial position."
                )
    except InputError as error:
        return FreeRun(reason=f"{mode.replace('_', ' ')}: {error}.")
    counted = [r for r, j in zip(runs, judged, strict=True) if j] or runs
    axes = _tabulate_axes(system, counted)
    if any(axis.relative_error_percent > _RUN_AWAY_PERCENT for axis in axes.values()):
        return FreeRun(reason="The simulated motion diverges.")
    given = np.concatenate([r.force for r in counted])
    off = np.concatenate([r.command for r in counted]) - given
    names = system.model.device.forces if mode == CLOSED else ()
    forces = {
        name: CommandError(relative_error_percent=_percent(off[:, j], given[:, j]))
        for j, name in enumerate(names)
    }
    return FreeRun(
        reason="" if mode == CLOSED else reason,
        mode=mode,
        axes=axes,
        trials={r.trial_id: _tabulate_axes(system, [r]) for r in runs},
        forces=forces,
    )


def _why_not_closed(run: RunFolder, system: System, law: ControlLaw) -> str:
    """Return why this session and model have no closed loop to simulate, or ""."""
    recorded = run.read(IngestResult).channels
    missing = [n for n in law.inputs if n != "t" and n not in recorded]
    if missing:
        return f"the session records no channel {missing[0]!r} for the controller"
    orders = range(1, len(INPUT_ORDERS))
    rates = {derivative(f, k) for f in law.forces for k in orders} & set(system.inputs)
    return "the model uses time derivatives of the force, which a command lacks" if rates else ""


def _run_closed_loop(
    run: RunFolder, system: System, motion: Motion, p: Array, law: ControlLaw
) -> _Run:
    from bampipe.estimate.closed_loop import simulate_controlled  # compiled only for few machines

    path = run.require("filter/kinematics.parquet", "filter")
    frame = read_parquet(path, trial=motion.trial_id)
    r = np.empty((len(motion.t), len(law.inputs)))
    for place, name in enumerate(law.inputs):
        r[:, place] = motion.t if name == "t" else frame[name].to_numpy(dtype=float)
    u = motion.inputs(system.inputs)
    force = [system.inputs.index(name) for name in law.forces]
    _, total, readings = simulate_controlled(
        system.derivative, system.measure, law.command, _make_plant(system, p),
        _initial_state(system, motion, p), u, r, float(motion.t[1] - motion.t[0]),
        force=force, rate_hz=law.rate_hz, limits=law.limits,
    )  # fmt: skip
    measured = np.hstack([motion.q, motion.qd])
    return _Run(motion.trial_id, measured, readings, u[:, force], total[:, force])


def _run_open_loop(system: System, motion: Motion, p: Array, push: Array | None = None) -> _Run:
    start, u = _initial_state(system, motion, p), motion.inputs(system.inputs)
    if push is not None:
        start[: len(push)] += push
    plant, dt = _make_plant(system, p), float(motion.t[1] - motion.t[0])
    x, _ = simulate(system.derivative, plant, start, u, dt, smooth=system.forced)
    readings = system.encoder_readings(x, u, p)
    none = np.zeros((len(x), 0))
    return _Run(motion.trial_id, np.hstack([motion.q, motion.qd]), readings, none, none)


def _forgets(system: System, motion: Motion, p: Array) -> bool:
    """Return whether the mechanism forgets a displaced start under the recorded inputs."""
    push = _PUSHED * motion.q.std(axis=0)
    n = len(push)
    near, far = _run_open_loop(system, motion, p), _run_open_loop(system, motion, p, push)
    late = slice(-(len(motion.t) // 5) or None, None)
    left = (far.simulated - near.simulated)[late, :n]
    return bool(np.all(np.sqrt(np.mean(left**2, axis=0)) < _FORGOTTEN * push))


def _initial_state(system: System, motion: Motion, p: Array) -> Array:
    u = motion.inputs(system.inputs)
    true = motion.of_mechanism(system, u, p[: len(system.parameters)])
    memory = system.initial_memory(true.q[0], true.qd[0], u[0], p)
    return np.concatenate([true.q[0], true.qd[0], memory])


def _tabulate_axes(system: System, runs: Sequence[_Run]) -> dict[str, FreeRunError]:
    n = len(system.coordinates)
    error = np.concatenate([r.simulated - r.measured for r in runs])
    measured = np.concatenate([r.measured for r in runs])
    return {
        axis: FreeRunError(
            mean_absolute=np.mean(np.abs(error[:, i])),
            rmse=np.sqrt(np.mean(error[:, i] ** 2)),
            relative_error_percent=_percent(error[:, i], measured[:, i]),
            velocity_relative_error_percent=_percent(error[:, n + i], measured[:, n + i]),
            unit=system.coordinate_units[i],
        )
        for i, axis in enumerate(system.coordinates)
    }


def _percent(error: Array, size: Array) -> float:
    """Norm of the error over the norm of the measured quantity, per cent."""
    norm = float(np.linalg.norm(size))
    return 100.0 * float(np.linalg.norm(error)) / norm if norm > 0.0 else 100.0


def find_drift(
    system: System, motions: Sequence[Motion], parameters: Sequence[Array], judged: Sequence[bool]
) -> dict[str, AxisDrift]:
    """Run the model from many starts of every trial and measure its drift, by axis and horizon.

    ``parameters`` and ``judged`` are as in `free_runs`; a ``reason`` says why horizons are absent.
    """
    axes = list(zip(system.coordinates, system.coordinate_units, strict=True))
    why = why_not_free(system, motions, parameters)
    if why:
        return {axis: AxisDrift(unit=unit, horizons=(), reason=why) for axis, unit in axes}
    chosen = [k for k, counts in enumerate(judged) if counts] or range(len(motions))
    starts = _STARTS_OF_ROBOT if system.model.device.robot is not None else _STARTS
    if len(chosen) > starts:  # one start in each of so many trials, spread over the session
        chosen = [chosen[i] for i in np.linspace(0, len(chosen) - 1, starts).round().astype(int)]
    usable = [max(motions[k].t[-1] - motions[k].t[0] - 2.0 * _MARGIN_S, 0.0) for k in chosen]
    spacing = sum(usable) / starts
    runs = [
        _run_from_starts(
            system, motions, k, parameters[k], length, length if len(chosen) == starts else spacing
        )
        for k, length in zip(chosen, usable, strict=True)
    ]
    found = {axis: AxisDrift(unit=unit, horizons=()) for axis, unit in axes}
    for horizon in HORIZONS_S:
        if all(entry.reason for entry in found.values()):
            break  # the longest runs, which cost most, would be meaningless for every axis
        reached = [reach for run in runs for reach in next(run, [])]
        for i, (axis, _) in enumerate(axes):
            if not found[axis].reason:
                update = _summarise_drift(reached, i, horizon, found[axis])
                found[axis] = found[axis].model_copy(update=update)
    return found


def why_not_free(system: System, motions: Sequence[Motion], parameters: Sequence[Array]) -> str:
    """Return why a model cannot run under the measured force alone, or ""."""
    if system.model.device.prescribed:
        return "A machine prescribes the motion, and the force follows from it."
    robot = system.model.device.robot is not None
    if not robot and is_stiff(system, parameters[0][: len(system.parameters)], motions[0]):
        return (
            "Friction would stop the machine within a fraction of a sample, so its drive"
            " prescribes the motion, and the force follows from it."
        )
    return ""


def _run_from_starts(
    system: System, motions: Sequence[Motion], trial: int, p: Array, length: float, spacing: float
) -> Iterator[list[_Reach]]:
    """Yield runs from many starts in a trial by horizon; ``length``, ``spacing`` of starts in s."""
    motion, p = motions[trial], np.ascontiguousarray(p[: len(system.parameters)])
    u, dt = motion.inputs(system.inputs), float(motion.t[1] - motion.t[0])
    true = motion.of_mechanism(system, u, p)
    memory = system.memory(*true.kinematics, u, p, true.t)[:, : len(system.memory_names)]
    states = np.hstack([true.q, true.qd, memory])
    last = len(motion.t) - 1 - round(_MARGIN_S / dt)
    count = int(length / spacing) if spacing > 0.0 else 0
    starts = [round((_MARGIN_S + (number + 0.5) * spacing) / dt) for number in range(count)]
    running: list[Array | None] = [states[k].copy() for k in starts]
    travel, done, longest = np.ptp(motion.q, axis=0), 0, round(HORIZONS_S[-1] / dt) + 1
    seen = [(u[k : k + longest].copy(), motion.q[k : k + longest].copy()) for k in starts]
    del motion, true, u, states  # only these windows of a hundred trials stay in memory
    for horizon in HORIZONS_S:
        steps = round(horizon / dt)
        inside = [both for k, both in zip(starts, seen, strict=True) if k + steps <= last]
        if not inside:
            return
        windows = np.stack([given[done : steps + 1] for given, _ in inside], axis=-1)
        fine, fine_dt = read_finely(windows, dt, system.forced)
        reached, done = list[_Reach](), steps
        for place, (given, path) in enumerate(inside):
            measured, state = path[: steps + 1], running[place]
            if state is not None:
                state = _simulate_from(system, state, fine[..., place], p, fine_dt)
            running[place], error = state, np.full(len(travel), np.inf)
            if state is not None:
                reading = system.encoder_readings(state[None], given[[steps]], p)[0]
                error = np.abs(reading[: error.size] - measured[-1])
            moves = np.ptp(measured, axis=0) > _MOVES * travel
            reached.append((error, np.abs(measured[-1] - measured[0]), moves))
        yield reached


def _simulate_from(system: System, state: Array, u: Array, p: Array, dt: float) -> Array | None:
    """Return the state (nx,) at the last of inputs (T, n_u), `read_finely`; None if it diverges."""
    for step in _STEPS_S:
        with contextlib.suppress(Runaway):
            x, _ = simulate(system.derivative, _make_plant(system, p, step), state, u, dt)
            return np.asarray(x[-1])
    return None


def _make_plant(system: System, p: Array, longest_step_s: float = MAX_STEP_S) -> Plant:
    own = p[: len(system.parameters)]
    return make_plant(own, len(system.noise), system.sign_widths, longest_step_s)


def _summarise_drift(
    reached: Sequence[_Reach], axis: int, horizon: float, shorter: AxisDrift
) -> dict[str, object]:
    """Return the update of one axis' drift by a horizon, s, or the reason why there is none."""
    used = [(error[axis], way[axis]) for error, way, moves in reached if moves[axis]]
    error = np.array([error for error, _ in used])
    if len(used) < _LEAST:
        return {"reason": f"The axis moves in only {len(used)} windows of {horizon:g} s."}
    if np.mean(np.isinf(error)) > _RUNS_AWAY:
        return {"reason": f"The simulated motion diverges within {horizon:g} s."}
    median, most = np.quantile(error, [0.5, 0.9], method="inverted_cdf")
    displacement = float(np.median([way for _, way in used]))
    if median > displacement or not np.isfinite(most):
        return {"reason": f"Within {horizon:g} s the model drifts farther than the axis moves."}
    drift = Drift(
        horizon_s=horizon, median=median, quantile_90=most, displacement=displacement,
        windows=len(used),
    )  # fmt: skip
    return {"horizons": (*shorter.horizons, drift)}
