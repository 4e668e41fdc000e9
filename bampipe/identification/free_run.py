"""Free runs: the identified model left to itself over a trial, against the measured position.

Where the device declares its controller and the session recorded what that needs, machine and
controller run together from the reference (closed loop). Otherwise the recorded inputs drive the
model alone (open loop), which says something only where the mechanism forgets where it started:
without a restoring force any error of the force is integrated for ever.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from bampipe.arrays import Array
from bampipe.data.run_folder import RunFolder
from bampipe.data.store import read_parquet
from bampipe.errors import InputError
from bampipe.estimate.simulation import simulate
from bampipe.identification.drift import why_not_free
from bampipe.physics import System
from bampipe.physics.control_law import ControlLaw, compile_law
from bampipe.physics.device import INPUT_ORDERS, derivative
from bampipe.results.ingest import IngestResult
from bampipe.results.validate import CommandError, FreeRun, FreeRunError
from bampipe.trials.motion import Motion

CLOSED: Final = "closed_loop"
OPEN: Final = "open_loop"
_PUSHED = 0.1
"""How far the start is displaced to see whether it is forgotten, in spreads of the motion."""
_FORGOTTEN = 0.5
"""Share of that which may be left over the last fifth of a trial."""


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
    """Run the model freely over every trial and say how far it ends up from the measurement.

    Args:
        run: the run folder, for the channels of the controller.
        parameters: for each trial, (>= n_p,) parameters that have not seen it.
        judged: which trials count for the whole; all where none does.

    Returns:
        Errors in closed loop, else in open loop; only a ``reason`` where no free run is possible
        or meaningful.
    """
    why_not = why_not_free(system, motions, parameters)
    if why_not and not system.model.device.prescribed:
        return FreeRun(reason=why_not)
    law = compile_law(system.model.device)
    reason = "the device file declares no [controller]" if law is None else _lacks(run, system, law)
    mode: Literal["closed_loop", "open_loop"] = OPEN if law is None or reason else CLOSED
    runs = []
    try:
        for motion, p in zip(motions, parameters, strict=True):
            if law is not None and mode == CLOSED:
                runs.append(_closed(run, system, motion, p, law))
            elif runs or _forgets(system, motion, p):
                runs.append(_open(system, motion, p))
            else:
                return FreeRun(
                    reason=f"{reason}, and driven by its recorded inputs alone the mechanism does "
                    "not forget where it started"
                )
    except InputError as error:
        return FreeRun(reason=f"{mode.replace('_', ' ')}: {error}")
    counted = [r for r, j in zip(runs, judged, strict=True) if j] or runs
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
        axes=_axes(system, counted),
        trials={r.trial_id: _axes(system, [r]) for r in runs},
        forces=forces,
    )


def _lacks(run: RunFolder, system: System, law: ControlLaw) -> str:
    """Why this session and model have no closed loop to run; "" where they have."""
    recorded = run.read(IngestResult).channels
    missing = [n for n in law.inputs if n != "t" and n not in recorded]
    if missing:
        return f"the session records no channel {missing[0]!r} for the controller"
    orders = range(1, len(INPUT_ORDERS))
    rates = {derivative(f, k) for f in law.forces for k in orders} & set(system.inputs)
    return "the model uses time derivatives of the force, which a command lacks" if rates else ""


def _closed(run: RunFolder, system: System, motion: Motion, p: Array, law: ControlLaw) -> _Run:
    from bampipe.estimate.closed_loop import simulate_controlled  # compiles: for few machines

    path = run.require("filter/kinematics.parquet", "filter")
    frame = read_parquet(path, trial=motion.trial_id)
    r = np.empty((len(motion.t), len(law.inputs)))
    for place, name in enumerate(law.inputs):
        r[:, place] = motion.t if name == "t" else frame[name].to_numpy(dtype=float)
    u = motion.inputs(system.inputs)
    force = [system.inputs.index(name) for name in law.forces]
    _, total, readings = simulate_controlled(
        system.derivative, system.measure, law.command, _start(system, motion, p), u, r,
        p[: len(system.parameters)], float(motion.t[1] - motion.t[0]),
        width=system.sign_widths, n_noise=len(system.noise), force=force, rate_hz=law.rate_hz,
        limits=law.limits,
    )  # fmt: skip
    measured = np.hstack([motion.q, motion.qd])
    return _Run(motion.trial_id, measured, readings, u[:, force], total[:, force])


def _open(system: System, motion: Motion, p: Array, push: Array | None = None) -> _Run:
    start, u = _start(system, motion, p), motion.inputs(system.inputs)
    n = motion.q.shape[1]
    if push is not None:
        start[:n] += push
    x = simulate(
        system.derivative, start, u, p[: len(system.parameters)], float(motion.t[1] - motion.t[0]),
        width=system.sign_widths, n_noise=len(system.noise), smooth=system.forced,
    )  # fmt: skip
    readings = np.empty((len(x), 2 * n))
    for i in range(len(x)):
        system.measure(x[i], u[i], p, readings[i])
    none = np.zeros((len(x), 0))
    return _Run(motion.trial_id, np.hstack([motion.q, motion.qd]), readings, none, none)


def _forgets(system: System, motion: Motion, p: Array) -> bool:
    """Whether the mechanism, driven by the recorded inputs, loses a displacement of its start."""
    push = _PUSHED * motion.q.std(axis=0)
    n = len(push)
    near, far = _open(system, motion, p), _open(system, motion, p, push)
    late = slice(-(len(motion.t) // 5) or None, None)
    left = (far.simulated - near.simulated)[late, :n]
    return bool(np.all(np.sqrt(np.mean(left**2, axis=0)) < _FORGOTTEN * push))


def _start(system: System, motion: Motion, p: Array) -> Array:
    u = motion.inputs(system.inputs)
    true = motion.of_mechanism(system, u, p[: len(system.parameters)])
    memory = system.initial_memory(true.q[0], u[0], p)
    return np.concatenate([true.q[0], true.qd[0], memory])


def _axes(system: System, runs: Sequence[_Run]) -> dict[str, FreeRunError]:
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
