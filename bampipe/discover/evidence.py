"""The residual of a model as evidence: both sides of the equation filtered alike, by trial.

Velocities from encoders are low-passed, forces are not. Comparing them raw misses effects near
standstill and invents delays; so the whole residual, the sign of the velocity in it included, goes
through one low-pass before anything is fitted, and is thinned to what that leaves independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.low_pass import Band
from bampipe.estimate.standstill import moving, resting
from bampipe.physics import System
from bampipe.trials.observation import Motion, Sensors

Array = NDArray[np.float64]


def told(motion: Motion, sensors: Sensors, band: Band) -> Array:
    """Which thinned samples tell about friction, (K, n_q), one or zero; see `standstill`."""
    rest = resting(motion.qd, velocity_sd(sensors), sensors.rate_hz)
    return moving(rest, band).astype(float)


def velocity_sd(sensors: Sensors) -> Array:
    """Noise of the filtered velocities that comes from the encoders' resolution, (n_q,).

    Quantisation is taken as white, resolution / sqrt(12) (Widrow 1961), and passed through a
    differentiator that ends at the filter's cut-off.
    """
    share = 2.0 * sensors.cutoff_hz / sensors.rate_hz
    gain = 2.0 * np.pi * sensors.cutoff_hz * np.sqrt(share / 3.0)
    return np.asarray(sensors.resolution / np.sqrt(12.0) * gain)


@dataclass(frozen=True)
class Evidence:
    """Residuals of one model on the trials of one session, linearised at its parameters.

    Attributes:
        system: the model.
        p: parameters at which it is linearised, (n_p,).
        motions: the trials.
        band: the low-pass.
        memory: internal states of the model by trial, each (T, n_z).
        plain: residual before the low-pass by trial, each (T, n_q), N.m or N.
        residual: low-passed and thinned, by trial, each (K, n_q).
        jacobian: derivative of ``residual`` by the free parameters, by trial, (K, n_q, n_free).
        used: which samples count, by trial, (K, n_q), see `told`; the others are zero in
            ``residual`` and ``jacobian``.
        free: indices of the parameters that are estimated.
    """

    system: System
    p: Array
    motions: tuple[Motion, ...]
    band: Band
    memory: tuple[Array, ...]
    plain: tuple[Array, ...]
    residual: tuple[Array, ...]
    jacobian: tuple[Array, ...]
    used: tuple[Array, ...]
    free: tuple[int, ...]

    def rmse(self) -> Array:
        """Root mean square of the residual by axis over all trials, (n_q,), N.m or N."""
        total = sum(np.sum(r**2, axis=0) for r in self.residual)
        return np.asarray(np.sqrt(total / np.maximum(sum(u.sum(axis=0) for u in self.used), 1.0)))


def residual_of(system: System, motion: Motion, p: Array) -> tuple[Array, Array]:
    """Residual (T, n_q) of the inverse dynamics on one trial, and the internal states (T, n_z)."""
    u = motion.inputs(system.inputs)
    z = system.memory(motion.q, motion.qd, motion.qdd, u, p, motion.t)
    true = system.true_motion(motion.q, motion.qd, motion.qdd, u, p)
    return system.residual(*true, z, u, p), z


def fit(
    system: System,
    motions: Sequence[Motion],
    sensors: Sensors,
    band: Band,
    start: Array,
    iterations: int = 12,
) -> Evidence:
    """Least-squares parameters of a model over all trials, and the evidence linearised there.

    Gauss-Newton on the low-passed residual, each axis weighted by its own scatter; parameters
    stay within their bounds. Models linear in their parameters need one step.

    Args:
        system: the model.
        motions: the trials.
        sensors: for `told`.
        band: the low-pass.
        start: parameters to start from, (n_p,).
        iterations: the most steps taken.
    """
    parameters = system.parameters
    free = tuple(i for i, p in enumerate(parameters) if not p.fixed)
    lower = np.array([parameters[i].lower for i in free])
    upper = np.array([parameters[i].upper for i in free])
    p = start.copy()
    used = [told(motion, sensors, band) for motion in motions]
    evidence = _linearise(system, motions, used, band, p, free)
    cost = np.inf
    for _ in range(iterations):
        new_cost = float(np.sum(np.log(evidence.rmse())))
        if new_cost > cost - 1e-9:
            break
        cost = new_cost
        step = _bounded_step(evidence, p[list(free)], lower, upper)
        accepted = evidence
        for share in (1.0, 0.5, 0.25, 0.1):
            trial = p.copy()
            trial[list(free)] = np.clip(p[list(free)] + share * step, lower, upper)
            candidate = _linearise(system, motions, used, band, trial, free)
            value = float(np.sum(np.log(candidate.rmse())))
            if value < cost:
                accepted, p = candidate, trial
                break
        if accepted is evidence:
            break
        evidence = accepted
        if all(system.linear[i] for i in free):
            cost = -np.inf
    return evidence


def _bounded_step(evidence: Evidence, value: Array, lower: Array, upper: Array) -> Array:
    """Least-squares step of the free parameters, (n_free,), that stays within their bounds.

    A parameter that would leave its range is held at the bound and the others are solved again:
    clipping the unbounded solution instead can make the fit worse than it was.
    """
    r, j, weight = _stack(evidence)
    a = (j * weight[None, :, None]).reshape(-1, len(value))
    b = (r * weight).reshape(-1)
    scale = np.linalg.norm(a, axis=0)
    scale[scale == 0.0] = 1.0
    step, open_ = np.zeros(len(value)), np.ones(len(value), dtype=bool)
    while open_.any():
        rest = b + a[:, ~open_] @ step[~open_]
        solved = np.linalg.lstsq((a / scale)[:, open_], rest, rcond=1e-9)[0]
        step[open_] = -solved / scale[open_]
        outside = open_ & ((value + step < lower) | (value + step > upper))
        if not outside.any():
            break
        step[outside] = (np.clip(value + step, lower, upper) - value)[outside]
        open_ &= ~outside
    return step


def _stack(evidence: Evidence) -> tuple[Array, Array, Array]:
    r = np.concatenate(evidence.residual)
    j = np.concatenate(evidence.jacobian)
    return r, j, 1.0 / np.maximum(evidence.rmse(), 1e-12)


def _linearise(
    system: System,
    motions: Sequence[Motion],
    used: Sequence[Array],
    band: Band,
    p: Array,
    free: tuple[int, ...],
) -> Evidence:
    memory, plain, residual, jacobian = [], [], [], []
    for motion, keep in zip(motions, used, strict=True):
        r, z = residual_of(system, motion, p)
        columns = [r]
        for i in free:
            parameter = system.parameters[i]
            size = 1.0 if system.linear[i] else 1e-4 * max(abs(p[i]), parameter.sd)
            moved = p.copy()
            moved[i] += size if p[i] + size <= parameter.upper else -size
            columns.append((residual_of(system, motion, moved)[0] - r) / (moved[i] - p[i]))
        thin = band.thin(np.concatenate(columns, axis=1))
        n = r.shape[1]
        memory.append(z)
        plain.append(r)
        residual.append(thin[:, :n] * keep)
        slopes = thin[:, n:].reshape(len(thin), len(free), n) * keep[:, None, :]
        jacobian.append(slopes.transpose(0, 2, 1))
    return Evidence(
        system, p.copy(), tuple(motions), band, tuple(memory), tuple(plain),
        tuple(residual), tuple(jacobian), tuple(used), free,
    )  # fmt: skip
