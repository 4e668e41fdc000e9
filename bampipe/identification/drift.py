"""Short free runs: how far the model drifts from the measured position, from many starts.

A mechanism without a restoring force integrates every error of the force, so that a free run over a
whole trial says little about the model. Over a tenth of a second to two seconds it does: from the
filtered state at many moments, the model runs under the recorded inputs alone, without controller.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.simulation import Runaway, simulate
from bampipe.physics import System
from bampipe.results.validate import AxisDrift, Drift
from bampipe.trials.motion import Motion

Array = NDArray[np.float64]

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
_MAX_STEP_S = 1e-3


@dataclass(frozen=True)
class _Window:
    """One start: error, displacement and whether the axis moves, each (horizons, n_q).

    NaN where the trial ends before the horizon; errors are infinite where the motion runs away.
    """

    error: Array
    displacement: Array
    moves: NDArray[np.bool_]


def find_drift(
    system: System, motions: Sequence[Motion], parameters: Sequence[Array], judged: Sequence[bool]
) -> dict[str, AxisDrift]:
    """Run the model from many starts of every trial and say how far it drifts.

    Args:
        system: the model.
        motions: the trials.
        parameters: for each trial, (>= n_p,) parameters that have not seen it.
        judged: which trials count; all where none does.

    Returns:
        By axis: the drift at each horizon, and why some horizons are absent.
    """
    axes = list(zip(system.coordinates, system.coordinate_units, strict=True))
    if system.model.device.prescribed:
        why = "A machine prescribes the motion, and the force is what that takes."
        return {axis: AxisDrift(unit=unit, horizons=(), reason=why) for axis, unit in axes}
    chosen = [k for k, counts in enumerate(judged) if counts] or range(len(motions))
    usable = [max(motions[k].t[-1] - motions[k].t[0] - 2.0 * _MARGIN_S, 0.0) for k in chosen]
    robot = system.model.device.robot is not None
    spacing = sum(usable) / (_STARTS_OF_ROBOT if robot else _STARTS)
    windows = [
        window
        for k, length in zip(chosen, usable, strict=True)
        for window in _windows(system, motions[k], parameters[k], length, spacing)
    ]
    return {axis: _drift(windows, i, unit) for i, (axis, unit) in enumerate(axes)}


def _windows(
    system: System, motion: Motion, parameters: Array, length: float, spacing: float
) -> list[_Window]:
    """Return the windows of one trial; ``length`` and ``spacing`` of the starts, s."""
    p = np.ascontiguousarray(parameters[: len(system.parameters)])
    u, n = motion.inputs(system.inputs), motion.q.shape[1]
    dt = float(motion.t[1] - motion.t[0])
    q, qd, _ = system.true_motion(motion.q, motion.qd, motion.qdd, u, p)
    states = np.hstack([q, qd, system.memory(motion.q, motion.qd, motion.qdd, u, p, motion.t)])
    ahead = [round(horizon / dt) for horizon in HORIZONS_S]
    range_of = np.ptp(motion.q, axis=0)
    width = np.array([c.sign_width for c in system.model.device.coordinates])
    last = len(motion.t) - 1 - round(_MARGIN_S / dt)
    found = []
    for number in range(int(length / spacing) if spacing > 0.0 else 0):
        start = round((_MARGIN_S + (number + 0.5) * spacing) / dt)
        steps = [k for k in ahead if start + k <= last]
        if not steps:
            continue
        error = np.full((len(ahead), n), np.nan)
        displacement, moves = error.copy(), np.zeros((len(ahead), n), dtype=np.bool_)
        stop = start + steps[-1] + 1
        try:
            x = simulate(
                system.derivative, states[start], u[start:stop], p, dt,
                width=width, n_noise=len(system.noise), max_step=_MAX_STEP_S,
            )  # fmt: skip
        except Runaway:
            x = None
        reading = np.empty(2 * n)
        for place, k in enumerate(steps):
            measured = motion.q[start : start + k + 1]
            displacement[place] = np.abs(measured[-1] - measured[0])
            moves[place] = np.ptp(measured, axis=0) > _MOVES * range_of
            error[place] = np.inf
            if x is not None:
                system.measure(x[k], u[start + k], p, reading)
                error[place] = np.abs(reading[:n] - measured[-1])
        found.append(_Window(error, displacement, moves))
    return found


def _drift(windows: Sequence[_Window], axis: int, unit: str) -> AxisDrift:
    """Return what the windows say of one axis, up to the horizon where it says nothing."""
    horizons: list[Drift] = []
    for place, horizon in enumerate(HORIZONS_S):
        used = [w for w in windows if w.moves[place, axis]]
        error = np.array([w.error[place, axis] for w in used])
        if len(used) < _LEAST:
            reason = f"In {len(used)} windows of {horizon:g} s the axis moves: too few."
            return AxisDrift(unit=unit, horizons=tuple(horizons), reason=reason)
        if np.mean(np.isinf(error)) > _RUNS_AWAY:
            reason = f"Within {horizon:g} s the simulated motion runs away."
            return AxisDrift(unit=unit, horizons=tuple(horizons), reason=reason)
        median, most = np.quantile(error, [0.5, 0.9], method="inverted_cdf")
        displacement = float(np.median([w.displacement[place, axis] for w in used]))
        if median > displacement or not np.isfinite(most):
            reason = f"In {horizon:g} s the model drifts further than the axis moves."
            return AxisDrift(unit=unit, horizons=tuple(horizons), reason=reason)
        horizons.append(
            Drift(
                horizon_s=horizon,
                median=median,
                quantile_90=most,
                displacement=displacement,
                windows=len(used),
            )
        )
    return AxisDrift(unit=unit, horizons=tuple(horizons))
