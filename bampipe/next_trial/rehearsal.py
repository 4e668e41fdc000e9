"""Simulation of a design by the fitted model: prescribed motion and the force that it requires.

People follow a sentence roughly, so each version of a design has its own speeds, turns and drift.
The result passes the sensors and filters of the session.
"""

from dataclasses import dataclass, replace

import numpy as np

from bampipe.arrays import Array
from bampipe.next_trial.primitives import PEAK, Envelope, Example, Primitive, Series, Stroke
from bampipe.physics import System
from bampipe.physics.device import LAST_ORDER, derivative
from bampipe.trials.kinematics import Kinematics
from bampipe.trials.motion import Motion
from bampipe.trials.replicates import read_by_sensors
from bampipe.trials.sensors import Sensors

_SPEED_SPREAD, _RANGE_SPREAD, _TURN_SPREAD, _DRIFT_SHARE = 0.2, 0.15, 0.1, 0.05
"""Errors of people: speed and range of a trial, each turn and the slow drift of the middle; the
last two are shares of the range."""
HASTY = -1
"""Number of the version that covers half the range at twice the speed."""
_TURN_BACK_S = 1.0
"""Time before the end of an imitated trial at which the motion starts to turn back."""
_FORCE_STEPS = 4
"""Iterations for the force, if the required force depends on the applied one."""


@dataclass(frozen=True)
class Rehearsal:
    """The fitted model with its parameters, and the instruments with which designs are tried."""

    system: System
    p: Array
    sensors: Sensors
    kinematics: Kinematics
    seen: Envelope
    seed: int

    def record(self, design: Primitive, version: int) -> Motion:
        """Return one version of a design as recorded; 0 is followed exactly."""
        rng = np.random.default_rng([self.seed, 1 + version])
        given = design if version == 0 else follow_roughly(design, self.seen, rng, version == HASTY)
        t = np.arange(int(design.seconds * self.sensors.rate_hz)) / self.sensors.rate_hz
        q, qd, qdd = self._path(given, t, rng, exact=version == 0)
        system, forces = self.system, self.system.model.device.forces
        motion = self._prescribe(q, qd, qdd, given)
        # The design is the true motion; to first order its offset is that at the reading.
        read = q - system.offset(q, motion.inputs(system.inputs), self.p)
        applied = motion.inputs(forces)
        recording = read_by_sensors(system, motion, read, applied, self.sensors, rng)
        return self.kinematics.observe(recording, forces)

    def effort(self, series: Series) -> tuple[Array, Array]:
        """Return times (T,), s, and the drive force of each axis along a series, (T, n_q)."""
        system = self.system
        t = np.arange(int(series.seconds * self.sensors.rate_hz)) / self.sensors.rate_hz
        design = Primitive({}, series.middle, series.seconds, series=series)
        motion = self._prescribe(*series.path(t), design)
        u = motion.inputs(system.inputs)
        z = system.memory(*motion.kinematics, u, self.p, motion.t)
        return t, system.applied(*motion.kinematics, z, u, self.p)

    def _path(
        self, design: Primitive, t: Array, rng: np.random.Generator, exact: bool
    ) -> tuple[Array, Array, Array]:
        """Return position, velocity and acceleration along a design, each (T, n_q)."""
        if design.example is not None:
            return example_path(design.example, t)
        if design.series is not None:
            return design.series.path(t)
        n = len(self.system.coordinates)
        q, qd, qdd = np.tile(design.pose, (t.size, 1)), np.zeros((t.size, n)), np.zeros((t.size, n))
        for axis, stroke in design.strokes.items():
            path = stroke_path(stroke, t, rng, 0.0 if exact else _TURN_SPREAD)
            drift = 0.0 if exact else _DRIFT_SHARE * (stroke.high - stroke.low)
            w, phase = 2.0 * np.pi * rng.uniform(0.02, 0.1), rng.uniform(0.0, 2.0 * np.pi)
            q[:, axis] = path[0] + drift * np.sin(w * t + phase)
            qd[:, axis] = path[1] + drift * w * np.cos(w * t + phase)
            qdd[:, axis] = path[2] - drift * w**2 * np.sin(w * t + phase)
        return q, qd, qdd

    def _prescribe(self, q: Array, qd: Array, qdd: Array, design: Primitive) -> Motion:
        """Return the motion of the mechanism, with the force that it needs."""
        system, device = self.system, self.system.model.device
        t = np.arange(len(q)) / self.sensors.rate_hz
        channels = {"t": t}
        for name, (_, usual, _) in self.seen.levels.items():
            channels[name] = np.full(t.size, (design.levels or {}).get(name, usual))
        for axis, brake in device.brakes.items():
            i = system.coordinates.index(axis)
            channels[brake] = design.field * self.seen.field[i] * np.abs(qd[:, i])
        for force in device.forces:
            channels |= {derivative(force, k): np.zeros(t.size) for k in range(LAST_ORDER + 1)}
        motion = Motion("design", t, q, qd, qdd, np.zeros_like(q), channels)
        # The force that leaves no residual.
        at, forces = motion.kinematics, device.forces
        for _ in range(_FORCE_STEPS):
            u = motion.inputs(system.inputs)
            z = system.memory(*at, u, self.p, motion.t)
            left = system.residual(*at, z, u, self.p)
            excess = system.least_force(motion.q, left, u, self.p)
            changed = {name: motion.channels[name] - excess[:, k] for k, name in enumerate(forces)}
            if not system.driven and not system.memory_names:
                # Nothing depends on the rates of the force.
                return motion.with_channels(changed)
            for name in forces:
                rates = self.kinematics.input_rates(changed[name])
                changed |= {derivative(name, o + 1): rate for o, rate in enumerate(rates)}
            motion = motion.with_channels(changed)
        return motion


def follow_roughly(
    design: Primitive, seen: Envelope, rng: np.random.Generator, hastily: bool
) -> Primitive:
    """Return a design as a person follows it: other speeds and turns, within the allowed range.

    Drives follow a series exactly.
    """
    if design.series is not None:
        return design
    if design.example is not None:
        haste = 2.0 if hastily else 1.0 + rng.uniform(-_SPEED_SPREAD, _SPEED_SPREAD)
        reach = 0.5 if hastily else 1.0 - rng.uniform(0.0, _RANGE_SPREAD)
        return replace(design, example=replace(design.example, reach=reach, haste=haste))
    strokes, farthest = {}, seen.wider or seen
    for axis, stroke in design.strokes.items():
        speed = 2.0 if hastily else 1.0 + rng.uniform(-_SPEED_SPREAD, _SPEED_SPREAD)
        share = 0.5 if hastily else 1.0 + rng.uniform(-_RANGE_SPREAD, _RANGE_SPREAD)
        width = share * (stroke.high - stroke.low)
        room = 0.5 * (stroke.high - stroke.low) * _TURN_SPREAD
        middle = 0.5 * (stroke.low + stroke.high) + rng.uniform(-room, room)
        strokes[axis] = replace(
            stroke,
            low=max(middle - 0.5 * width, float(farthest.low[axis])),
            high=min(middle + 0.5 * width, float(farthest.high[axis])),
            slow=speed * stroke.slow,
            fast=speed * stroke.fast,
        )
    return replace(design, strokes=strokes)


def example_path(example: Example, t: Array) -> tuple[Array, Array, Array]:
    """Return position, velocity and acceleration of a trial played to and fro, each (T, n_q).

    A jump from its end to its beginning would be faster than the trial. Times ``t``, s, begin at 0.
    """
    motion = example.motion
    clock = motion.t - motion.t[0]
    length, rate = float(clock[-1]), example.haste / example.reach
    back = min(_TURN_BACK_S, 0.25 * length)
    # Distance from the nearest turn, smooth to the second derivative.
    turn = np.rint(rate * t / length)
    x = rate * t - turn * length
    u = np.where(turn == 0.0, 1.0, np.clip(np.abs(x) / back, 0.0, 1.0))
    distance = np.where(u < 1.0, back * (0.375 + 0.75 * u**2 - 0.125 * u**4), np.abs(x))
    way = np.where(turn % 2.0 == 0.0, 1.0, -1.0)
    at = np.where(way > 0.0, distance, length - distance)
    slope, curvature = (
        (way * each)[:, None]
        for each in (np.sign(x) * (1.5 * u - 0.5 * u**3), 1.5 * (1.0 - u**2) / back)
    )
    slope[turn == 0.0] = 1.0
    q, qd, qdd = (
        np.stack([np.interp(at, clock, column) for column in part.T], axis=1)
        for part in motion.kinematics
    )
    middle = np.median(motion.q, axis=0)
    return (
        middle + example.reach * (q - middle),
        example.reach * rate * slope * qd,
        example.reach * rate**2 * (slope**2 * qdd + curvature * qd),
    )


def stroke_path(
    stroke: Stroke, t: Array, rng: np.random.Generator, jitter: float
) -> tuple[Array, Array, Array]:
    """Return position, velocity and acceleration of minimum-jerk strokes, each (T,).

    The speed of each stroke is drawn within its band, and its turns: ``jitter`` is the largest
    error of a turn, as a share of the travel. Times ``t``, s, begin at 0.
    """
    q, qd, qdd = np.empty(t.size), np.zeros(t.size), np.zeros(t.size)
    travel = stroke.high - stroke.low
    start, at, k = 0.0, 0.5 * (stroke.low + stroke.high), 0
    while start <= t[-1]:
        end = stroke.high if k % 2 == 0 else stroke.low
        inwards = -1.0 if k % 2 == 0 else 1.0
        goal = end + inwards * jitter * travel * rng.uniform(0.0, 1.0)
        speed = np.exp(rng.uniform(np.log(stroke.slow), np.log(stroke.fast)))
        length = max(PEAK * abs(goal - at) / speed, 1e-3)
        s = np.clip((t - start) / length, 0.0, 1.0)
        here = (t >= start) & (t < start + length + stroke.rest_s)
        way, s = goal - at, s[here]
        q[here] = at + way * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        qd[here] = way / length * 30.0 * s**2 * (1.0 - s) ** 2
        qdd[here] = way / length**2 * 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s)
        start, at, k = start + length + stroke.rest_s, goal, k + 1
    return q, qd, qdd
