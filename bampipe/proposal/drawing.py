"""The drives of a robot's log held against its drawing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from bampipe.physics.device import Device
from bampipe.physics.newton_euler import Algebra, joint_forces
from bampipe.physics.robot import Robot, gravity_vector
from bampipe.proposal.joints import Group
from bampipe.proposal.positions import position_in_si, scale_to

Array = NDArray[np.float64]

_SMOOTHED_S = 0.1
"""Stretch of a record over which a parabola gives velocity and acceleration."""
MOST_ROWS = 4000
FEW_ROWS = 1000
_SURE = 5.0
"""Standard errors from which on the sign of a drive is known."""
_MOST_LEFT = 0.05
"""Of the drives' variance: what a drawing with the right reductions leaves at most."""


@dataclass(frozen=True)
class Drive:
    """How the drive of a joint goes with what its motion requires by the drawing.

    Attributes:
        share: of the drive, for one of what is required; 1 where both are of the joint.
        error: its standard error by the scatter alone; the drawing has another.
        left: part of the drive's variance that drawing, drive's inertia and friction leave.
        losses: mean power that friction takes from the drive, in its standard errors: negative
            where the drive, or the joint, is logged with the other sign.
    """

    share: float
    error: float
    left: float
    losses: float

    @property
    def is_sure(self) -> bool:
        """Whether weight and inertia tell the sign: friction gives no power, whatever they say."""
        contradicted = self.is_dissipative if self.share < 0.0 else self.losses < -_SURE
        return abs(self.share) > _SURE * self.error and not contradicted

    @property
    def is_dissipative(self) -> bool:
        """Whether friction surely takes power from the drive."""
        return self.losses > _SURE

    @property
    def is_turned(self) -> bool:
        """Whether it is surely logged with the other sign, by weight and inertia or by friction."""
        return self.share < 0.0 if self.is_sure else self.losses < -_SURE


def positions_of(device: Device, group: Group, t: Array) -> Array:
    """Positions (T, n) in SI, wherever their encoders sit."""
    columns = zip(device.coordinates, group.columns, strict=True)
    return np.column_stack([position_in_si(column, t, c.unit) for c, column in columns])


def range_of(device: Device, joint: str) -> float:
    low, high = device.limits.get(joint, (-np.inf, np.inf))
    return high - low


def judge_along(
    device: Device,
    robot: Robot,
    q: Array,
    drives: Group,
    ratio: Array,
    t: Array,
    most_rows: int = MOST_ROWS,
) -> list[Drive]:
    """How drives go with positions (T, n) of the joints; ``ratio``: turns of the motors (n,)."""
    motion = motion_along(q, t, most_rows)
    return [] if motion is None else hold(device, robot, motion, drives, ratio)


@dataclass(frozen=True)
class JointMotion:
    """Positions, velocities and accelerations of a robot's joints, each (K, n).

    Attributes:
        rows: of the log, of which they are.
    """

    position: Array
    rate: Array
    change: Array
    rows: slice

    def counted(self, direction: Array, zero: Array) -> JointMotion:
        """The same with joints that count the other way, or from another zero; each (n,)."""
        parts = (direction * part for part in (self.position, self.rate, self.change))
        position, rate, change = parts
        return JointMotion(position + zero, rate, change, self.rows)


def motion_along(q: Array, t: Array, most_rows: int) -> JointMotion | None:
    """The motion along positions (T, n); None where they are too few or incomplete."""
    step = float(np.median(np.diff(t)))
    window = max(5, 2 * round(0.5 * _SMOOTHED_S / step) + 1) if step > 0.0 else len(q)
    if not np.isfinite(q).all() or window >= len(q):
        return None
    rows = slice(None, None, max(1, len(q) // most_rows))
    position, rate, change = (
        savgol_filter(q, window, 2, deriv=k, delta=step, axis=0)[rows] for k in range(3)
    )
    return JointMotion(position, rate, change, rows)


def hold(
    device: Device, robot: Robot, motion: JointMotion, drives: Group, ratio: Array
) -> list[Drive]:
    """How drives go with a motion of the joints; ``ratio``: turns of the motors (n,)."""
    position, rate, change = (
        list(part.T) for part in (motion.position, motion.rate, motion.change)
    )
    bodies = [list(joint.inertial) for joint in robot.joints]
    forces = joint_forces(
        Algebra.numbers(), robot.links, bodies, position, rate, change, gravity_vector(robot)
    )
    found = []
    for k, column in enumerate(drives.columns):
        required = np.broadcast_to(forces[k], rate[k].shape) / ratio[k]
        values = np.nan_to_num(column.values)[motion.rows] * scale_to(device.force_unit, column)
        # Of the drive, which a motor that turns the other way counts so.
        way = float(np.sign(ratio[k]))
        found.append(_compare(required, way * rate[k], way * change[k], values))
    return found


def left_by(
    device: Device, robot: Robot, motion: JointMotion, drives: Group, ratio: Array
) -> Callable[[Array, Array], Array]:
    """The part of each drive's variance that is left, (n,), by directions and zeros of the joints.

    The judge of `find_counting`.
    """

    def left(direction: Array, zero: Array) -> Array:
        held = hold(device, robot, motion.counted(direction, zero), drives, ratio)
        return np.array([drive.left for drive in held])

    return left


def _compare(required: Array, rate: Array, change: Array, drive: Array) -> Drive:
    """Regress a drive on what the drawing requires, its own inertia, friction and an offset."""
    sign = np.tanh(rate / max(0.02 * float(np.abs(rate).max()), 1e-9))
    columns = np.column_stack([required, change, rate, sign, np.ones_like(rate)])
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    values, _, rank, _ = np.linalg.lstsq(columns / size, drive, rcond=1e-9)
    rest = drive - columns / size @ values
    left = float(np.var(rest) / max(np.var(drive), 1e-300))
    if rank < columns.shape[1]:
        return Drive(0.0, np.inf, left, 0.0)
    # Neighbouring samples err alike: about one in ten counts.
    covariance = 10.0 * np.mean(rest**2) * np.linalg.inv((columns / size).T @ (columns / size))
    by_friction = np.array([0.0, 0.0, np.mean(rate**2), np.mean(sign * rate), 0.0]) / size
    power, power_sd = by_friction @ values, np.sqrt(by_friction @ covariance @ by_friction)
    return Drive(
        float(values[0] / size[0]),
        float(np.sqrt(covariance[0, 0]) / size[0]),
        left,
        float(power / max(power_sd, 1e-300)),
    )


def fits(drives: Sequence[Drive]) -> bool:
    """Whether drawing and log are of the same joints."""
    return mean_left(drives) < _MOST_LEFT


def mean_left(drives: Sequence[Drive]) -> float:
    return float(np.mean([drive.left for drive in drives]))
