"""The fitted model in place of the machine: recordings that contain nothing the model lacks.

Noise floors, chance levels and the bias of least squares come from here. The model is driven along
nearly the measured motion by the measured force plus an arm. Where something stiff gives the
motion it keeps that and takes the force it needs: on a test bench; of a machine whose friction
would stop it within a small part of a sample; of a robot whose position controllers are so fast
that its drives jump where joints turn round; and of any robot that a spring which the model lacks
would carry away. What it does is read by the same sensors and goes through
the same filters.
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
from bampipe.estimate.simulation import Runaway, count_steps, simulate_tracking
from bampipe.physics import System
from bampipe.physics.device import derivative
from bampipe.trials.kept import KeptItems
from bampipe.trials.kinematics import Kinematics
from bampipe.trials.motion import Motion, Recording, force_columns, input_derivatives
from bampipe.trials.residuals import ModelOnTrial, standstill_of
from bampipe.trials.sensors import Sensors

_FARTHEST = 0.1
"""Of a joint's travel: how far the replay of a robot may be from the measured motion. Sound
replays of simulated arms stay within 0.2 %, without a drive's delay within 0.7 %; without a spring
that pulls, a light joint goes 1.3 times its travel."""
_JUMPS = 0.8
"""Share of the jump of friction at a reversal that drives make within one sample, from which on
controllers give the motion. Simulated arms along a smooth path make 0.93 to 0.99 of it, one whose
controller acts at 250 Hz 0.07 to 0.93, two measured arms 0.01 to 0.14."""
_LATEST = 8
"""Samples by which a drive may act after its log says so, or be read after it acts: its jumps then
stand in the log before or behind those of friction."""
_FEW_REVERSALS = 5
_CORRECTIONS, _CANCELLED = 8, 1e-3
"""Newton steps to the force that a motion needs, and the part of the residual that may remain."""
_SMALL, _LEAST_SLOPE = 1e-3, 0.05
"""Part of such a step from which slopes are taken, and the least of these that is one."""
_PROBED, _FEW = 300, 50
"""Samples of a trial at which the steps of integration are counted; to tell ten from one, a few."""
LONGEST_STEP_S = 2.5e-4
_STIFFEST = 10.0
"""Steps of integration over those of `LONGEST_STEP_S` from which on friction holds a machine so
fast that its drive gives the motion: simulated and measured machines that move freely take 1 to
1.5, a damper on a test bench 30 to 70."""
FOLLOWED_HZ = 10.0
"""Highest frequency of the motion to follow where encoder and handle move apart."""


class Course(NamedTuple):
    """What a machine does in one trial, before any sensor reads it.

    Attributes:
        q: positions at the encoders, (T, n_q), rad or m.
        force: (T, n_f), N.m or N.
    """

    q: Array
    force: Array


@dataclass(frozen=True)
class StandIn:
    """A fitted model in place of the machine, which follows the measured trials of a session.

    Its effects of kind ``measurement`` act on what the encoders read.
    """

    system: System
    p: Array
    motions: Sequence[Motion]
    rate_hz: float

    @cached_property
    def courses(self) -> Sequence[Course]:
        """What it does in each trial: the same in all replays, which differ by noise alone."""
        return KeptItems(follow_motion(self.system, self.p, m, self.rate_hz) for m in self.motions)

    @cached_property
    def rests(self) -> Sequence[Flags]:
        """Where the axes of each trial stand still, (T, n_q)."""
        return KeptItems(standstill_of(m, self.system, self.rate_hz) for m in self.motions)


def follow_motion(system: System, p: Array, motion: Motion, rate_hz: float) -> Course:
    """Simulate one trial of a fitted model.

    Raises:
        Runaway: the simulated motion grows without bounds.
    """
    u = motion.inputs(system.inputs)
    fitted = ModelOnTrial(system, p, [motion])
    if _is_motion_given(fitted):
        return Course(motion.q, _required_force(fitted, rate_hz))
    q, qd = _reference(system, p, motion, u, rate_hz)
    start = np.concatenate([q[0], qd[0], system.initial_memory(q[0], u[0], p)])
    at = {name: i for i, name in enumerate(system.inputs)}
    forces = system.model.device.forces
    columns = force_columns(system)
    # A delay by derivatives holds within the band of a residual; a simulated machine feels what is
    # beyond it, too, such as the jumps of a drive. So its forces are moved, and it has no delay.
    late = _lateness(fitted) * rate_hz
    acting, prompt = u.copy(), _without_delays(system, p)
    for force, samples in zip(forces, late, strict=True):
        for name in (force, *input_derivatives(force)):
            if name in at:
                acting[:, at[name]] = _shifted(u[:, at[name]], -samples)
    try:
        x, total = simulate_tracking(
            system.derivative, start, acting, prompt, 1.0 / rate_hz, q, qd,
            width=system.sign_widths, n_noise=len(system.noise), force=columns,
            rate=[at.get(derivative(f, 1), -1) for f in forces],
            curvature=[at.get(derivative(f, 2), -1) for f in forces],
            smooth=system.forced, moved_first=system.moved_first,
        )  # fmt: skip
    except Runaway:
        if not _is_controlled(system):
            raise
        return Course(motion.q, _required_force(fitted, rate_hz))
    strayed = np.abs(x[:, : q.shape[1]] - q).max(axis=0) > _FARTHEST * np.ptp(q, axis=0)
    if _is_controlled(system) and strayed.any():  # no likeness of a held robot
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
    """Steps of integration that a model takes along a motion, from sample to sample on average."""
    u = motion.inputs(system.inputs)
    true = motion.of_mechanism(system, u, p)
    memory = true.memory(system, p)
    rows = slice(None, None, -(-len(u) // probed))
    return count_steps(
        system.derivative, np.hstack([true.q, true.qd, memory])[rows], u[rows],
        np.ascontiguousarray(p), float(motion.t[1] - motion.t[0]),
        width=system.sign_widths, n_noise=len(system.noise), max_step=longest_step_s,
    )  # fmt: skip


def _lateness(fitted: ModelOnTrial) -> Array:
    """Time by which each force acts after it was logged, (n_f,), s; negative if it acts before."""
    system, p, motion, u = fitted.system, fitted.p, fitted.motion, fitted.inputs
    found = np.zeros(len(system.model.device.forces))
    if not system.delays:
        return found
    memory = system.initial_memory(motion.q[0], u[0], p)
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
    """What a signal (T,) is some samples later; its last value beyond its ends."""
    if samples == 0.0 or not values.any():
        return values
    at = np.clip(np.arange(values.size) + samples, 0, values.size - 1)
    return np.asarray(CubicSpline(np.arange(values.size), values)(at))


def keep_motion(fitted: Sequence[ModelOnTrial]) -> bool:
    """Whether replays of a model keep the motion of every trial, and its turns, as measured."""
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
    """Whether each joint of a robot has a drive, which follows the path of its controller."""
    return system.model.device.robot is not None and not system.undriven


def _jumps(fitted: ModelOnTrial) -> bool:
    """Whether the drives of a robot jump, within a sample, as friction does where a joint turns.

    Between two samples nothing says when they do: driven by such a log, a model would stick for as
    long as that, and be rougher than the machine. Of a drive that acts late they stand earlier in
    the log, of one that is read late they stand later, spread over two samples.
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
    """The force that the model needs for the motion as measured, (T, n_f): none is left over.

    What acts late is logged as much earlier, sample by sample: a jump of friction then falls
    between other samples than those of the position, which no delay of the log as a whole gives.
    """
    system, motion = fitted.system, fitted.motion
    found, late = fitted.inputs[:, force_columns(system)].copy(), _lateness(fitted) * rate_hz
    for samples in np.unique(late):
        at = fitted
        if late.any():
            moved = _moved_on(motion, system.model.device.forces, samples)
            at = ModelOnTrial(system, _without_delays(system, fitted.p), [moved])
        found[:, late == samples] = _cancel_residual(at)[:, late == samples]
    return found


def _cancel_residual(fitted: ModelOnTrial) -> Array:
    """The measured force changed by Newton steps until the model leaves nothing, (T, n_f).

    An effect that takes a part of the force needs more of it. What a force does through a state of
    its own, such as a lag, has no slope by the force of the moment; that is taken to be one.
    """
    system, motion, p = fitted.system, fitted.motion, fitted.p
    columns = force_columns(system)
    u, first = motion.inputs(system.inputs).copy(), 0.0
    for number in range(_CORRECTIONS):
        at = motion.of_mechanism(system, u, p).kinematics
        z = system.memory(*at, u, p, motion.t)
        left = system.residual(*at, z, u, p)
        size = float(np.sqrt(np.mean(left**2)))
        first = first or size
        if number and size <= _CANCELLED * first:
            break
        moved = u.copy()
        moved[:, columns] -= _SMALL * system.least_force(motion.q, left, u, p)
        slope = (left - system.residual(*at, z, moved, p)) / _SMALL
        steep = np.abs(slope) > _LEAST_SLOPE * np.abs(left)
        share = np.divide(left, slope, out=np.ones_like(left), where=steep)
        u[:, columns] -= system.least_force(motion.q, share * left, u, p)
    return u[:, columns]


def _without_delays(system: System, p: Array) -> Array:
    prompt = p.copy()
    prompt[[system.index(name) for name in system.delays]] = 0.0
    return prompt


def _moved_on(motion: Motion, forces: Sequence[str], samples: float) -> Motion:
    """A trial some samples later, beside ``forces`` as they are."""
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
    """What the sensors make of positions (T, n_q) and forces (T, n_f)."""
    seen = q + rng.normal(size=q.shape) * sensors.scatter_sd if sensors.scatter_sd.any() else q
    step = np.where(sensors.resolution > 0.0, sensors.resolution, 1.0)
    offset = rng.uniform(0.0, 1.0, q.shape[1]) * step
    read = (np.floor((seen + offset) / step) + 0.5) * step - offset
    read = np.where(sensors.resolution > 0.0, read, seen)
    noisy = force + rng.normal(size=force.shape) * sensors.force_sd
    named = dict(zip(system.model.device.forces, noisy.T, strict=True))
    return Recording(motion.trial_id, read, {**motion.channels, **named})


def replay_motion(
    stand_in: StandIn,
    trial: int,
    sensors: Sensors,
    kinematics: Kinematics,
    rng: np.random.Generator,
) -> Motion:
    """Replay one trial and filter it as the measured one was.

    Time derivatives are made of the forces alone, those that the model needs; other channels are
    the measured ones. ``rng`` is the source of the noise and of where the encoders' counts fall.

    Raises:
        Runaway: the simulated motion grows without bounds.
    """
    system, course = stand_in.system, stand_in.courses[trial]
    recording = read_by_sensors(system, stand_in.motions[trial], *course, sensors, rng)
    motion = kinematics.observe(recording, system.model.device.forces, system.inputs)
    return replace(motion, left_out=stand_in.rests[trial])


def _reference(
    system: System, p: Array, motion: Motion, u: Array, rate_hz: float
) -> tuple[Array, Array]:
    """Positions and rates of the handle to follow, each (T, n_q).

    Where play or wind-up lies between encoder and handle, the handle's motion is the encoder's
    plus what the model puts between them. That jumps where a gap is crossed, a little before or
    after the logged jump; a handle with inertia does not follow the difference of the two.
    Where the force moves a part first that an internal state follows, it is that state.
    """
    if not system.moves_sensors:
        x = np.hstack([motion.q, motion.qd, system.memory(*motion.kinematics, u, p, motion.t)])
        return x[:, system.moved_first[:, 0]], x[:, system.moved_first[:, 1]]
    q = motion.q + system.offset(motion.q, u, p)
    smooth = [zero_phase(column, rate_hz, min(FOLLOWED_HZ, 0.2 * rate_hz)) for column in q.T]
    return np.column_stack([c[0] for c in smooth]), np.column_stack([c[1] for c in smooth])
