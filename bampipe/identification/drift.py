"""Short free runs: how far the model drifts from the measured position, from many starts.

A mechanism without a restoring force integrates every error of the force, so that a free run over a
whole trial says little about the model. Over a tenth of a second to two seconds it does: from the
filtered state at many moments, the model runs under the recorded inputs alone, without controller.
"""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array, Flags
from bampipe.estimate.simulation import Runaway, simulate
from bampipe.physics import System
from bampipe.results.validate import AxisDrift, Drift
from bampipe.trials.motion import Motion
from bampipe.trials.replay import is_stiff

HORIZONS_S = (0.1, 0.5, 2.0)
"""A reversal, a movement, several movements of a hand."""
_STARTS = 100
"""Over all trials together; neighbours overlap, so that more would hardly say more."""
_STARTS_OF_ROBOT = 20
"""A robot's light joints stop and start a hundred times more slowly to integrate: 0.3 s a start."""
_LEAST = 10
"""Windows in which an axis moves, for quantiles that mean anything."""
_MARGIN_S = 0.2
"""Lost to the filters at both ends of a trial."""
_MOVES = 0.01
"""Share of its range in the trial by which an axis must move within a window to count there."""
_RUNS_AWAY = 0.1
"""Share of windows that may run away."""
_STEPS_S = (1e-3, 1e-4)
"""Longest steps of integration, the next where a motion runs away with one: friction that builds up
within micrometres is stiffer than an axis, and runs away by the step alone."""


@dataclass
class _Window:
    """One start, and how far the model has run from it.

    Attributes:
        motion: the trial, inputs u (T, n_u) and dt in s beside it; p: (n_p,) its parameters.
        start: sample at which the model is let go; last: the last sample that counts.
        at: sample up to which it has run; state: (nx,) there, None where the motion ran away.
    """

    motion: Motion
    u: Array
    dt: float
    p: Array
    start: int
    last: int
    at: int
    state: Array | None


_Reach = tuple[Array, Array, Flags]
"""A window at one horizon: error, infinite if run away, displacement, is it a move, (n_q,) each."""


def find_drift(
    system: System, motions: Sequence[Motion], parameters: Sequence[Array], judged: Sequence[bool]
) -> dict[str, AxisDrift]:
    """Run the model from many starts of every trial and say how far it drifts.

    Args:
        parameters: for each trial, (>= n_p,) parameters that have not seen it.
        judged: which trials count; all where none does.

    Returns:
        By axis: the drift at each horizon, and why some horizons are absent.
    """
    axes = list(zip(system.coordinates, system.coordinate_units, strict=True))
    why = why_not_free(system, motions, parameters)
    if why:
        return {axis: AxisDrift(unit=unit, horizons=(), reason=why) for axis, unit in axes}
    chosen = [k for k, counts in enumerate(judged) if counts] or range(len(motions))
    starts = _STARTS_OF_ROBOT if system.model.device.robot is not None else _STARTS
    if len(chosen) > starts:  # one from each of so many, spread over the session
        chosen = [chosen[i] for i in np.linspace(0, len(chosen) - 1, starts).round().astype(int)]
    usable = [max(motions[k].t[-1] - motions[k].t[0] - 2.0 * _MARGIN_S, 0.0) for k in chosen]
    spacing = sum(usable) / starts
    windows = [
        window
        for k, length in zip(chosen, usable, strict=True)
        for window in _windows(
            system, motions[k], parameters[k], length, length if len(chosen) == starts else spacing
        )
    ]
    found = {axis: AxisDrift(unit=unit, horizons=()) for axis, unit in axes}
    for horizon in HORIZONS_S:
        if all(entry.reason for entry in found.values()):
            break  # the longest runs, which cost most, would say nothing of any axis
        reached = [r for window in windows if (r := _advance(system, window, horizon)) is not None]
        for i, (axis, _) in enumerate(axes):
            if not found[axis].reason:
                found[axis] = found[axis].model_copy(
                    update=_drift(reached, i, horizon, found[axis])
                )
    return found


def why_not_free(system: System, motions: Sequence[Motion], parameters: Sequence[Array]) -> str:
    """Why a model does not run by the measured force alone; "" where it may."""
    if system.model.device.prescribed:
        return "A machine prescribes the motion, and the force is what that takes."
    robot = system.model.device.robot is not None
    if not robot and is_stiff(system, parameters[0][: len(system.parameters)], motions[0]):
        return (
            "Friction would stop the machine within a small part of a sample: its drive gives the"
            " motion, and the force is what that takes."
        )
    return ""


def _windows(
    system: System, motion: Motion, parameters: Array, length: float, spacing: float
) -> list[_Window]:
    """Return the windows of one trial; ``length`` and ``spacing`` of the starts, s."""
    p = np.ascontiguousarray(parameters[: len(system.parameters)])
    u = motion.inputs(system.inputs)
    dt = float(motion.t[1] - motion.t[0])
    true = motion.of_mechanism(system, u, p)
    states = np.hstack([true.q, true.qd, system.memory(*true.kinematics, u, p, true.t)])
    last = len(motion.t) - 1 - round(_MARGIN_S / dt)
    count = int(length / spacing) if spacing > 0.0 else 0
    starts = (round((_MARGIN_S + (number + 0.5) * spacing) / dt) for number in range(count))
    return [_Window(motion, u, dt, p, k, last, k, states[k]) for k in starts]


def _advance(system: System, window: _Window, horizon: float) -> _Reach | None:
    """Let the model run on to the horizon, s; None where the trial ends before it."""
    end = window.start + round(horizon / window.dt)
    if end > window.last:
        return None
    if window.state is not None:
        window.state = _simulate(system, window, window.state, end)
    window.at = end
    motion = window.motion
    measured = motion.q[window.start : end + 1]
    error = np.full(motion.q.shape[1], np.inf)
    if window.state is not None:
        reading = np.empty(2 * error.size)
        system.measure(window.state, window.u[end], window.p, reading)
        error = np.abs(reading[: error.size] - measured[-1])
    moves = np.ptp(measured, axis=0) > _MOVES * np.ptp(motion.q, axis=0)
    return error, np.abs(measured[-1] - measured[0]), moves


def _simulate(system: System, window: _Window, state: Array, end: int) -> Array | None:
    """Return the state (nx,) at sample ``end``, from ``state`` on; None if it runs away."""
    for step in _STEPS_S:
        with contextlib.suppress(Runaway):
            path = simulate(
                system.derivative, state, window.u[window.at : end + 1], window.p, window.dt,
                width=system.sign_widths, n_noise=len(system.noise), smooth=system.forced,
                max_step=step,
            )  # fmt: skip
            return np.asarray(path[-1])
    return None


def _drift(
    reached: Sequence[_Reach], axis: int, horizon: float, shorter: AxisDrift
) -> dict[str, object]:
    """Return what a horizon, s, adds to what shorter ones say of one axis, or why it is absent."""
    used = [(error[axis], way[axis]) for error, way, moves in reached if moves[axis]]
    error = np.array([error for error, _ in used])
    if len(used) < _LEAST:
        return {"reason": f"In {len(used)} windows of {horizon:g} s the axis moves: too few."}
    if np.mean(np.isinf(error)) > _RUNS_AWAY:
        return {"reason": f"Within {horizon:g} s the simulated motion runs away."}
    median, most = np.quantile(error, [0.5, 0.9], method="inverted_cdf")
    displacement = float(np.median([way for _, way in used]))
    if median > displacement or not np.isfinite(most):
        return {"reason": f"In {horizon:g} s the model drifts further than the axis moves."}
    drift = Drift(
        horizon_s=horizon, median=median, quantile_90=most, displacement=displacement,
        windows=len(used),
    )  # fmt: skip
    return {"horizons": (*shorter.horizons, drift)}
