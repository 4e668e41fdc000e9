"""Replicates: simulations of the fitted model on the trials, which lack nothing by construction.

They give noise floors, null distributions and the bias of least squares. The measured force, and a
soft spring towards the measured motion, drive the model. The motion is kept instead, and the force
that it requires is computed, where something stiff prescribes it: on a test bench; on a machine
whose friction would stop it within a small part of a sample; on a robot whose position controllers
are so fast that its drives jump when joints reverse; and on any robot that a spring missing from
the model would carry away. The same sensors and filters then read the result.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from bampipe.arrays import Array, Flags
from bampipe.estimate.butterworth import zero_phase
from bampipe.estimate.differentiation import UniformGrid
from bampipe.estimate.simulation import Arm, Runaway, count_steps, make_plant, simulate
from bampipe.physics import System
from bampipe.physics.device import derivative
from bampipe.trials.kept import KeptItems
from bampipe.trials.kinematics import Kinematics
from bampipe.trials.motion import STAMP_OFFSET, Motion, Recording, force_columns, input_derivatives
from bampipe.trials.residuals import ModelOnTrial, standstill_of
from bampipe.trials.sensors import Sensors

_FARTHEST = 0.1
"""Largest deviation of a robot's replicate from the measured motion, as a fraction of the joint's
travel. Sound replicates of simulated arms stay within 0.2 %, without a drive's delay within 0.7 %;
if a strong spring is missing, a light joint moves 1.3 times its travel."""
_JUMPS = 0.8
"""Fraction of the jump of friction at a reversal that drives make within one sample, above which
controllers prescribe the motion. Simulated arms on smooth paths make 0.93 to 0.99 of it, one whose
controller acts at 250 Hz 0.07 to 0.93, two measured arms 0.01 to 0.14."""
_LATEST = 8
"""Largest delay of a drive behind its log, or of the log behind the drive, in samples: the jumps of
the drive are then logged before or after those of friction."""
_FEW_REVERSALS = 5
_CORRECTIONS, _CANCELLED = 8, 1e-3
"""Newton steps to the force that a motion requires, and the fraction of the residual left."""
_SMALL, _LEAST_SLOPE = 1e-3, 0.05
"""Relative size of the step from which slopes are taken, and the smallest slope that is used."""
_PROBED, _FEW = 300, 50
"""Samples of a trial at which integration steps are counted; few suffice to tell ten from one."""
LONGEST_STEP_S = 2.5e-4
_STIFFEST = 10.0
"""Integration steps relative to those of `LONGEST_STEP_S` above which friction holds a machine so
firmly that its drive prescribes the motion. Machines that move freely, simulated and measured, take
1 to 1.5, a damper on a test bench 30 to 70."""
FOLLOWED_HZ = 10.0
"""Highest frequency of the motion to follow if the encoder and the handle move apart."""


class Course(NamedTuple):
    """The simulated motion and force of one trial, before any sensor reads them.

    Attributes:
        q: positions at the encoders, (T, n_q), rad or m.
        force: (T, n_f), N.m or N.
    """

    q: Array
    force: Array


@dataclass(frozen=True)
class SimulatedTrials:
    """A fitted model that follows the measured trials of a session: the source of replicates.

    Its effects of kind ``measurement`` act on the encoders' readings.
    """

    system: System
    p: Array
    motions: Sequence[Motion]
    rate_hz: float

    @cached_property
    def courses(self) -> Sequence[Course]:
        """The course of each trial, the same in all replicates: these differ only by noise."""
        return KeptItems(follow_motion(self.system, self.p, m, self.rate_hz) for m in self.motions)

    @cached_property
    def rests(self) -> Sequence[Flags]:
        """The samples that do not count in each trial, (T, n_q)."""
        return KeptItems(standstill_of(m, self.system, self.rate_hz) for m in self.motions)


def follow_motion(system: System, p: Array, motion: Motion, rate_hz: float) -> Course:
    """Simulate one trial of a fitted model; raise `Runaway` if the motion grows without bounds."""
    u = motion.inputs(system.inputs)
    fitted = ModelOnTrial(system, p, [motion])
    if _is_motion_given(fitted):
        return Course(motion.q, _required_force(fitted, rate_hz))
    q, qd = _reference(system, p, motion, u, rate_hz)
    start = np.concatenate([q[0], qd[0], system.initial_memory(q[0], qd[0], u[0], p)])
    at = {name: i for i, name in enumerate(system.inputs)}
    forces = system.model.device.forces
    columns = force_columns(system)
    # A delay by derivatives holds only within the band of a residual. A simulated machine feels
    # faster changes too, such as jumps of a drive, so its forces are shifted and its delay is zero.
    late = _lateness(fitted) * rate_hz
    acting, prompt = u.copy(), _without_delays(system, p)
    for force, samples in zip(forces, late, strict=True):
        for name in (force, *input_derivatives(force)):
            if name in at:
                acting[:, at[name]] = _shifted(u[:, at[name]], -samples)
    try:
        rate, curvature = ([at.get(derivative(f, k), -1) for f in forces] for k in (1, 2))
        x, total = simulate(
            system.derivative, make_plant(prompt, len(system.noise), system.sign_widths), start,
            acting, 1.0 / rate_hz, arm=Arm(q, qd, columns, rate, curvature, system.moved_first),
            smooth=system.forced,
        )  # fmt: skip
    except Runaway:
        if not _is_controlled(system):
            raise
        return Course(motion.q, _required_force(fitted, rate_hz))
    strayed = np.abs(x[:, : q.shape[1]] - q).max(axis=0) > _FARTHEST * np.ptp(q, axis=0)
    if _is_controlled(system) and strayed.any():  # controllers would not let a robot stray so far
        return Course(motion.q, _required_force(fitted, rate_hz))
    seen = system.encoder_readings(x, total, prompt)[:, : len(system.coordinates)]
    arm = total[:, columns] - acting[:, columns]
    logged = [_shifted(pull, samples) for pull, samples in zip(arm.T, late, strict=True)]
    return Course(seen, u[:, columns] + np.column_stack(logged))


def steps_to_follow(
    system: System,
    p: Array,
    motion: Motion,
    longest_step_s: float = LONGEST_STEP_S,
    probed: int = _PROBED,
) -> float:
    """Mean number of integration steps that a model takes per sample along a motion."""
    u = motion.inputs(system.inputs)
    true = motion.of_mechanism(system, u, p)
    memory = true.memory(system, p)[:, : len(system.memory_names)]
    rows = slice(None, None, -(-len(u) // probed))
    plant = make_plant(p, len(system.noise), system.sign_widths, longest_step_s)
    x, dt = np.hstack([true.q, true.qd, memory]), float(motion.t[1] - motion.t[0])
    return count_steps(system.derivative, plant, x[rows], u[rows], dt)


def _lateness(fitted: ModelOnTrial) -> Array:
    """Delay of each force behind its log, (n_f,), s; negative if the force acts earlier."""
    system, p, motion, u = fitted.system, fitted.p, fitted.motion, fitted.inputs
    found = np.zeros(len(system.model.device.forces))
    if not system.delays:
        return found
    memory = system.initial_memory(motion.q[0], motion.qd[0], u[0], p)
    x = np.concatenate([motion.q[0], motion.qd[0], memory])

    def slope(column: int) -> Array:
        moved, here, there = u[0].copy(), np.empty(len(x)), np.empty(len(x))
        moved[column] += 1.0
        for inputs, out in ((u[0], here), (moved, there)):
            system.derivative(x, inputs, p, np.zeros(len(system.noise)), out)
        return there - here

    for k, force in enumerate(system.model.device.forces):
        rate, direct = derivative(force, 1), slope(system.inputs.index(force))
        if rate in system.inputs and direct.any():
            by_rate = slope(system.inputs.index(rate))
            found[k] = -float(direct @ by_rate) / float(direct @ direct)
    return found


def _shifted(values: Array, samples: float) -> Array:
    """A signal (T,) advanced by some samples; beyond its ends, its last value."""
    if samples == 0.0 or not values.any():
        return values
    at = np.clip(np.arange(values.size) + samples, 0, values.size - 1)
    return np.asarray(CubicSpline(np.arange(values.size), values)(at))


def keep_motion(fitted: Sequence[ModelOnTrial]) -> bool:
    """Whether the replicates of a model keep the measured motion of every trial."""
    return all(_is_motion_given(each) for each in fitted)


def _is_motion_given(fitted: ModelOnTrial) -> bool:
    system = fitted.system
    if system.model.device.prescribed:
        return True
    if system.model.device.robot is not None:
        return _is_controlled(system) and _jumps(fitted)
    return is_stiff(system, fitted.p, fitted.motion)


def is_stiff(system: System, p: Array, motion: Motion) -> bool:
    """Whether friction would stop a machine within a small part of a sample, all along a motion."""
    usual = max(float(motion.t[1] - motion.t[0]) / LONGEST_STEP_S, 1.0)
    return steps_to_follow(system, p, motion, probed=_FEW) > _STIFFEST * usual


def _is_controlled(system: System) -> bool:
    """Whether every joint of a robot has a drive, whose controller follows a path."""
    return system.model.device.robot is not None and not system.undriven


def _jumps(fitted: ModelOnTrial) -> bool:
    """Whether a robot's drives jump within a sample when joints reverse, as friction does.

    The log does not say when between two samples they do. Driven by it, a model would stick for
    up to a sample and be rougher than the machine. Jumps of a delayed drive are logged earlier, and
    those of a delayed log later, spread over two samples.
    """
    motion, u = fitted.motion, fitted.inputs
    gains = fitted.system.input_map(motion.q, u, fitted.p)
    given = np.einsum("tqf,tf->tq", gains, u[:, force_columns(fitted.system)])
    logged, needed = np.diff(given, axis=0), np.diff(given - fitted.residual, axis=0)
    turns = np.diff(np.sign(motion.qd), axis=0) != 0.0
    wanted, count = needed * turns, len(turns)
    whole = np.sum(needed * wanted, axis=0)
    lags = range(1, min(_LATEST, count))
    earlier = [np.sum(wanted[lag:] * logged[: count - lag], axis=0) for lag in lags]
    later = [np.sum(wanted[: count - lag] * logged[lag:], axis=0) for lag in lags]
    late = [first + second for side in (earlier, later) for first, second in pairwise(side)]
    made = np.max([np.sum(wanted * logged, axis=0), *late], axis=0)
    known = (turns.sum(axis=0) >= _FEW_REVERSALS) & (whole > 0.0)
    return bool(known.any() and np.all(made[known] > _JUMPS * whole[known]))


def _required_force(fitted: ModelOnTrial, rate_hz: float) -> Array:
    """The force that leaves no residual for the measured motion, (T, n_f).

    The log of a delayed force is advanced, sample by sample: its jumps then fall between other
    samples than those of the position, which no delay of the whole log reproduces. Samples between
    those of the grid see a jump of friction earlier or later, and are resampled as the log was.
    """
    system, motion = fitted.system, fitted.motion
    offset = motion.channels.get(STAMP_OFFSET, np.zeros(0))
    if offset.any():
        by = offset[:, None]
        q, qd = motion.q + by * motion.qd + 0.5 * by**2 * motion.qdd, motion.qd + by * motion.qdd
        at_samples = replace(motion, q=q, qd=qd).with_channels({STAMP_OFFSET: 0.0 * offset})
        force = _required_force(ModelOnTrial(system, fitted.p, [at_samples]), rate_hz)
        # If points of the grid share a sample, the nearest one counts.
        order = np.argsort(np.abs(offset), kind="stable")
        stamps, first = np.unique(np.round(motion.t + offset, 9)[order], return_index=True)
        grid = UniformGrid(motion.t, np.zeros(len(offset), dtype=bool), False, stamps)
        return np.column_stack([grid.resample(f, jumps=True) for f in force[order[first]].T])
    found, late = fitted.inputs[:, force_columns(system)].copy(), _lateness(fitted) * rate_hz
    for samples in np.unique(late):
        at = fitted
        if late.any():
            moved = _advance_motion(motion, system.model.device.forces, samples)
            at = ModelOnTrial(system, _without_delays(system, fitted.p), [moved])
        found[:, late == samples] = _cancel_residual(at)[:, late == samples]
    return found


def _cancel_residual(fitted: ModelOnTrial) -> Array:
    """Change the measured force by Newton steps until no residual is left, (T, n_f).

    An effect that takes a part of the force requires more of it. A force behind an internal state,
    such as a lag, is assumed to have a slope. What no force can cancel stays, as in a gap; raises
    `Runaway` if that is all.
    """
    system, motion, p = fitted.system, fitted.motion, fitted.p
    columns = force_columns(system)
    u = kept = motion.inputs(system.inputs).copy()
    first, least = 0.0, np.inf
    for _ in range(_CORRECTIONS):
        at = motion.of_mechanism(system, u, p).kinematics
        z = system.memory(*at, u, p, motion.t)
        left = system.residual(*at, z, u, p)
        size = float(np.sqrt(np.mean(left**2)))
        if not size < least:
            break
        kept, least, first = u, size, first or size
        if size <= _CANCELLED * first:
            break
        u, moved = u.copy(), u.copy()
        moved[:, columns] -= _SMALL * system.least_force(motion.q, left, u, p)
        slope = (left - system.residual(*at, z, moved, p)) / _SMALL
        steep = np.abs(slope) > _LEAST_SLOPE * np.abs(left)
        share = np.divide(left, slope, out=np.ones_like(left), where=steep)
        u[:, columns] -= system.least_force(motion.q, share * left, u, p)
    if least == first > 0.0:  # a replicate with the measured residual would lack what that lacks
        raise Runaway("no force was found that moves the model as the machine moved")
    return kept[:, columns]


def _without_delays(system: System, p: Array) -> Array:
    prompt = p.copy()
    prompt[[system.index(name) for name in system.delays]] = 0.0
    return prompt


def _advance_motion(motion: Motion, forces: Sequence[str], samples: float) -> Motion:
    """Advance a trial by some samples, except for its ``forces``."""
    stay = {name for force in forces for name in (force, *input_derivatives(force))}
    channels = {
        name: values if name in stay else _shifted(values, samples)
        for name, values in motion.channels.items()
    }
    q, qd, qdd = (
        np.column_stack([_shifted(column, samples) for column in values.T])
        for values in motion.kinematics
    )
    return replace(motion, q=q, qd=qd, qdd=qdd, channels=channels)


def read_by_sensors(
    system: System,
    motion: Motion,
    q: Array,
    force: Array,
    sensors: Sensors,
    rng: np.random.Generator,
) -> Recording:
    """Add quantisation and noise to positions (T, n_q) and forces (T, n_f)."""
    seen = q + rng.normal(size=q.shape) * sensors.scatter_sd if sensors.scatter_sd.any() else q
    step = np.where(sensors.resolution > 0.0, sensors.resolution, 1.0)
    offset = rng.uniform(0.0, 1.0, q.shape[1]) * step
    read = (np.floor((seen + offset) / step) + 0.5) * step - offset
    read = np.where(sensors.resolution > 0.0, read, seen)
    noisy = force + rng.normal(size=force.shape) * sensors.force_sd
    named = dict(zip(system.model.device.forces, noisy.T, strict=True))
    return Recording(motion.trial_id, read, {**motion.channels, **named})


def make_replicate(
    simulated: SimulatedTrials,
    trial: int,
    sensors: Sensors,
    kinematics: Kinematics,
    rng: np.random.Generator,
) -> Motion:
    """Make a replicate of one trial, and filter it as the measured one was filtered.

    Only forces get time derivatives, those that the model needs; other channels are the measured
    ones. ``rng`` gives the noise and the offsets of the encoder counts.

    Raises:
        Runaway: the simulated motion grows without bounds.
    """
    system, course = simulated.system, simulated.courses[trial]
    recording = read_by_sensors(system, simulated.motions[trial], *course, sensors, rng)
    motion = kinematics.observe(recording, system.model.device.forces, system.inputs)
    return replace(motion, left_out=simulated.rests[trial])


def _reference(
    system: System, p: Array, motion: Motion, u: Array, rate_hz: float
) -> tuple[Array, Array]:
    """Positions and rates of the handle to follow, each (T, n_q).

    With play or wind-up between encoder and handle, the handle's motion is the encoder's plus the
    offset of the model. The offset jumps where a gap is crossed, slightly before or after the
    logged jump, and a handle with inertia cannot follow the difference; so the sum is low-passed.
    If the force first moves a part that an internal state describes, that state is followed.
    """
    if not system.moves_sensors:
        x = np.hstack([motion.q, motion.qd, system.memory(*motion.kinematics, u, p, motion.t)])
        return x[:, system.moved_first[:, 0]], x[:, system.moved_first[:, 1]]
    q = motion.q + system.offset(motion.q, u, p)
    smooth = [zero_phase(column, rate_hz, min(FOLLOWED_HZ, 0.2 * rate_hz)) for column in q.T]
    return np.column_stack([c[0] for c in smooth]), np.column_stack([c[1] for c in smooth])
