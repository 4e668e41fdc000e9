"""Which trial would tell two effects apart: designs are tried on the fitted model, not guessed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bampipe.physics import System, compile_model
from bampipe.physics.device import INPUT_ORDERS, derivative
from bampipe.physics.recipe import Recipe
from bampipe.physics.registry import device_from
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import Evidence

Array = NDArray[np.float64]

_DURATION_S = 16.0
_BETTER = 1.5
"""A trial is suggested if it tells two effects apart so many times better than those at hand: the
designs are ideal, a hand is not."""


@dataclass(frozen=True)
class Advice:
    """A trial to record.

    Attributes:
        design: what to do with the handle, in words.
        separation: error, in noise floors of the axis, that would remain if the wrong effect of
            the two were fitted to that trial.
        separation_now: the same for the trials at hand, per trial.
    """

    design: str
    separation: float
    separation_now: float


@dataclass(frozen=True)
class _Design:
    words: str
    frequency_hz: float
    size: float
    together: bool
    hold: bool


_DESIGNS = (
    _Design("slow sweeps of {axis} over its whole range, 8 s each way", 0.06, 1.0, False, False),
    _Design("slow sweeps of {axis} over a third of its range", 0.06, 0.33, False, False),
    _Design("{axis} back and forth over its whole range, 3 s a cycle", 0.33, 1.0, False, False),
    _Design("fast small strokes of {axis}, 0.5 s a cycle", 2.0, 0.1, False, False),
    _Design("fast strokes of {axis} over a third of its range", 1.0, 0.33, False, False),
    _Design("{axis} at 2 s a cycle while the other axes sweep slowly", 0.5, 0.6, True, False),
    _Design("moves of {axis} with rests of 2 s between them", 0.25, 0.8, False, True),
)


def advise(
    trials: MeasuredTrials,
    recipe: Recipe,
    evidence: Evidence,
    axis: int,
    first: str,
    second: str,
    values: Mapping[str, Array],
    floor: float,
) -> Advice | None:
    """The design under which confusing ``first`` with ``second`` would cost most.

    Args:
        trials: the trials at hand, for ranges and filters.
        recipe: the model without either effect.
        evidence: its fit.
        axis: where the two act.
        first, second: canonical names.
        values: fitted parameters of each effect, in the order of its file.
        floor: noise floor of the axis, N.m or N.

    Returns:
        None where no design would show more than the trials at hand, or less than the floor.
    """
    now = [_confusion(recipe, evidence, m, axis, first, second, values) for m in trials.motions]
    best: Advice | None = None
    for design in _DESIGNS:
        motion = _motion(trials, evidence.system, evidence.p, axis, design)
        cost = _confusion(recipe, evidence, motion, axis, first, second, values) / floor
        if best is None or cost > best.separation:
            words = design.words.format(axis=evidence.system.coordinates[axis])
            best = Advice(words, float(cost), float(np.mean(now) / floor))
    tells = best is not None and best.separation > max(1.0, _BETTER * best.separation_now)
    return best if tells else None


def _confusion(
    recipe: Recipe,
    evidence: Evidence,
    motion: Motion,
    axis: int,
    first: str,
    second: str,
    values: Mapping[str, Array],
) -> float:
    """RMS of the first effect's torque that base parameters and the second cannot imitate."""
    system, band = evidence.system, evidence.band
    true = _torque(recipe, evidence, motion, first, values[first])[:, axis]
    wrong = _torque(recipe, evidence, motion, second, values[second])[:, axis]
    u = motion.inputs(system.inputs)
    z = system.memory(motion.q, motion.qd, motion.qdd, u, evidence.p, motion.t)
    base = system.residual(motion.q, motion.qd, motion.qdd, z, u, evidence.p)[:, axis]
    columns = [true, wrong]
    for i in evidence.free:
        moved = evidence.p.copy()
        size = 1.0 if system.linear[i] else 1e-4 * max(system.parameters[i].sd, 1e-6)
        moved[i] += size
        changed = system.residual(motion.q, motion.qd, motion.qdd, z, u, moved)[:, axis]
        columns.append((changed - base) / size)
    thin = band.thin(np.column_stack(columns), [axis] * len(columns))
    x = thin[:, 1:]
    scale = np.maximum(np.linalg.norm(x, axis=0), 1e-12)
    left = thin[:, 0] - (x / scale) @ np.linalg.lstsq(x / scale, thin[:, 0], rcond=1e-8)[0]
    return float(np.sqrt(np.mean(left**2)))


def _torque(recipe: Recipe, evidence: Evidence, motion: Motion, name: str, own: Array) -> Array:
    """What one effect adds to the residual along a motion, (T, n_q)."""
    device = device_from(recipe.device)
    system = compile_model(replace(recipe, effects=(name,)).model())
    p = np.concatenate([evidence.p[: len(device.parameters)], own])
    u = motion.inputs(system.inputs)
    if system.moves_sensors:
        base = evidence.system
        moved = system.true_motion(motion.q, motion.qd, motion.qdd, u, p)
        inputs = motion.inputs(base.inputs)
        z = base.memory(motion.q, motion.qd, motion.qdd, inputs, evidence.p, motion.t)
        plain = base.residual(motion.q, motion.qd, motion.qdd, z, inputs, evidence.p)
        return base.residual(*moved, z, inputs, evidence.p) - plain
    z = system.memory(motion.q, motion.qd, motion.qdd, u, p, motion.t)
    return system.contribution(motion.q, motion.qd, motion.qdd, z, u, p)


def _motion(trials: MeasuredTrials, system: System, p: Array, axis: int, design: _Design) -> Motion:
    """A designed motion within the range of the trials, with the force that the model needs."""
    rate = trials.sensors.rate_hz
    t = np.arange(int(_DURATION_S * rate)) / rate
    every = np.concatenate([m.q for m in trials.motions])
    low, high = np.quantile(every, 0.02, axis=0), np.quantile(every, 0.98, axis=0)
    n = every.shape[1]
    q, qd, qdd = (np.zeros((len(t), n)) for _ in range(3))
    for i in range(n):
        size = 0.5 * (high[i] - low[i]) * (design.size if i == axis else 0.7)
        omega = 2.0 * np.pi * (design.frequency_hz if i == axis else 0.11 * (1 + 0.3 * i))
        moves = i == axis or design.together
        s, ds, dds = np.sin(omega * t), omega * np.cos(omega * t), -(omega**2) * np.sin(omega * t)
        if design.hold and i == axis:
            s, ds, dds = np.tanh(4 * s), 4 * ds / np.cosh(4 * s) ** 2, np.zeros_like(s)
            dds = np.gradient(ds, t)
        q[:, i] = 0.5 * (high[i] + low[i]) + (size * s if moves else 0.0)
        qd[:, i], qdd[:, i] = (size * ds, size * dds) if moves else (0.0, 0.0)
    channels: dict[str, Array] = {name: np.zeros(len(t)) for name in system.inputs}
    device = system.model.device
    channels |= {"t": t} | {b: np.zeros(len(t)) for b in device.brakes.values()}
    for name in device.channels:
        typical = np.median(np.concatenate([m.channels[name] for m in trials.motions]))
        channels[name] = np.full(len(t), typical)
    for f in device.forces:
        channels |= {derivative(f, k): np.zeros(len(t)) for k in range(len(INPUT_ORDERS))}
    u = np.column_stack([channels[name] for name in system.inputs])
    z = system.memory(q, qd, qdd, u, p, t)
    need = system.required(q, qd, qdd, z, u, p)
    gains = system.input_map(q, u, p)
    force = np.einsum("tfq,tq->tf", np.linalg.pinv(gains), need)
    for k, f in enumerate(device.forces):
        value = force[:, k]
        for order in range(len(INPUT_ORDERS)):
            channels[derivative(f, order)] = value
            value = np.gradient(value, t)
    return Motion("design", t, q, qd, qdd, np.zeros_like(qd), channels)
