"""The drives of a robot's log held against its drawing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from bampipe.physics.device import Device
from bampipe.physics.robot import Robot
from bampipe.proposal.joints import Group
from bampipe.proposal.mounting import Mounting
from bampipe.proposal.positions import position_in_si, scale_to

Array = NDArray[np.float64]

_SMOOTHED_S = 0.1
"""Stretch of a record over which a parabola gives velocity and acceleration."""
MOST_ROWS = 4000
FEW_ROWS = 1000
_SURE = 5.0
"""Standard errors from which on the sign of a drive is known."""
_LEAST_LEFT = 3e-3
"""Part of a drive's variance below which no drawing is believed to be better than another."""
_CONTRADICTED = 2.0 * np.log(2.0)
"""What a drive counts for against a mounting with which its friction would drive the joint."""
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
    def is_contradicted(self) -> bool:
        """Whether weight tells a sign with which friction would drive the joint."""
        against = self.is_dissipative if self.share < 0.0 else self.losses < -_SURE
        return abs(self.share) > _SURE * self.error and against

    @property
    def is_sure(self) -> bool:
        """Whether weight and inertia tell the sign: friction gives no power, whatever they say."""
        return abs(self.share) > _SURE * self.error and not self.is_contradicted

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

    def scaled(self, factor: Array) -> JointMotion:
        """The same of joints that move ``factor``, (n,), times as far."""
        return JointMotion(
            factor * self.position, factor * self.rate, factor * self.change, self.rows
        )


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


@dataclass(frozen=True)
class Comparison:
    """Drives beside what the drawn bodies require along a motion.

    Attributes:
        device, robot: the robot; drives: one a joint.
        ratio: turns of each drive for one of its joint, (n,).
        motion: of the joints as their readings have it.
    """

    device: Device
    robot: Robot
    drives: Group
    ratio: Array
    motion: JointMotion
    _sums: dict[bytes, list[tuple[Array, ...]]] = field(default_factory=dict, init=False)

    @property
    def drawn(self) -> Mounting:
        """All as it is drawn."""
        return Mounting.as_drawn(len(self.ratio), self.robot.gravity)

    @property
    def turning(self) -> list[bool]:
        """Whether each joint turns."""
        return [c.unit == "rad" for c in self.device.coordinates]

    def _required(self, mounting: Mounting) -> Array:
        """Drives (4, K, n) required without gravity, and by 1 m/s2 of it along each axis."""
        moved = self.motion.scaled(mounting.direction)
        still = np.zeros((3 * len(moved.rate), len(self.ratio)))
        q = np.tile(moved.position + mounting.zero, (4, 1))
        qd, qdd = (np.concatenate([part, still]) for part in (moved.rate, moved.change))
        gravity = np.repeat(np.eye(4)[1:], len(moved.rate), axis=1)
        parts = self.robot.drawn_forces(q, qd, qdd, gravity) / self.ratio
        return parts.reshape(4, -1, len(self.ratio))

    def by_number(self, mounting: Mounting) -> list[list[Array]]:
        """By joint and body, what one of each inertial number adds beside losses, (K, 10)."""
        moved = self.motion.scaled(mounting.direction)
        under = self.robot.model_copy(update={"gravity": tuple(mounting.gravity)})
        columns = under.columns(moved.position + mounting.zero, moved.rate, moved.change)
        count = len(moved.rate)
        return [
            [
                loss.without(np.array([np.broadcast_to(c, count) for c in body])).T / ratio
                for body in row
            ]
            for row, loss, ratio in zip(columns, self.losses, self.ratio, strict=True)
        ]

    def values(self, k: int) -> Array:
        """Drive ``k`` (K,), in the unit of the device."""
        column = self.drives.columns[k]
        found = np.nan_to_num(column.values)[self.motion.rows]
        return np.asarray(found * scale_to(self.device.force_unit, column))

    @cached_property
    def losses(self) -> list[Losses]:
        """Of each drive, which a motor that turns the other way counts so."""
        motion, way = self.motion, np.sign(self.ratio)
        return [
            Losses.along(way[k] * motion.rate[:, k], way[k] * motion.change[:, k], self.values(k))
            for k in range(len(self.ratio))
        ]

    def hold(self, mounting: Mounting) -> list[Drive]:
        """How each drive goes with the drawing, the joints counted and the base mounted so."""
        key = mounting.direction.tobytes() + mounting.zero.tobytes()
        if key not in self._sums:
            parts = self._required(mounting)
            self._sums[key] = [loss.sums(parts[:, :, k]) for k, loss in enumerate(self.losses)]
        by_part = np.array([1.0, *mounting.gravity])
        return [
            loss.beside(sums, by_part, mounting.direction[k])
            for k, (loss, sums) in enumerate(zip(self.losses, self._sums[key], strict=True))
        ]

    def misfit(self, mounting: Mounting) -> float:
        """What `find_mounting` makes small: more where friction contradicts weight."""
        drives = self.hold(mounting)
        left = np.log([drive.left + _LEAST_LEFT for drive in drives])
        return float(left.sum() + _CONTRADICTED * sum(drive.is_contradicted for drive in drives))


@dataclass(frozen=True)
class Losses:
    """What its own inertia, friction and an offset take of a drive (K,), and what they leave.

    Attributes:
        basis: of their columns, (K, 4) and orthonormal.
        power: the mean power of friction is its product with what is not required, (K,).
        drive: what they leave of the drive, (K,); size: mean square of the drive without an offset.
        taken: mean power of friction where nothing is required.
        known: whether they can be told from each other.
    """

    basis: Array
    power: Array
    drive: Array
    size: float
    taken: float
    known: bool

    @classmethod
    def along(cls, rate: Array, change: Array, drive: Array) -> Losses:
        """With the velocity and acceleration of the drive, (K,) each."""
        sign = np.tanh(rate / max(0.02 * float(np.abs(rate).max()), 1e-9))
        columns = np.column_stack([change, rate, sign, np.ones_like(rate)])
        size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        left, values, right = np.linalg.svd(columns / size, full_matrices=False)
        held = values > 1e-9 * values[0]
        by_friction = np.array([0.0, np.mean(rate**2), np.mean(sign * rate), 0.0]) / size
        power = left[:, held] @ (right[held] @ by_friction / values[held])
        rest = drive - left[:, held] @ (left[:, held].T @ drive)
        return cls(
            left[:, held],
            power,
            rest,
            max(float(np.var(drive)), 1e-300),
            float(power @ drive),
            bool(held.all()),
        )

    def sums(self, parts: Array) -> tuple[Array, ...]:
        """Products of what is required, in ``parts`` (m, K), by which `beside` needs no samples."""
        own = self.without(parts)
        return own @ own.T, parts @ parts.T, own @ self.drive, parts @ self.power

    def without(self, columns: Array) -> Array:
        """What the losses leave of columns, (m, K)."""
        return np.asarray(columns - (columns @ self.basis) @ self.basis.T)

    def beside(self, sums: tuple[Array, ...], by_part: Array, direction: float) -> Drive:
        """A regression of the drive on what is required too, the sum of ``by_part`` (m,) parts.

        Of a joint that counts in ``direction``; ``sums``: of the parts.
        """
        square, whole = (float(by_part @ of @ by_part) for of in sums[:2])
        along, power = (float(of @ by_part) for of in sums[2:])
        left, count = float(self.drive @ self.drive), len(self.drive)
        if not self.known or square <= 1e-18 * max(whole, 1e-300):
            return Drive(0.0, np.inf, left / count / self.size, 0.0)
        share = along / square
        mean_square = max(left - share * along, 0.0) / count
        # Neighbouring samples err alike: about one in ten counts.
        variance = 10.0 * mean_square
        power_sd = np.sqrt(variance * (float(self.power @ self.power) + power**2 / square))
        taken = direction * (self.taken - share * power)
        return Drive(
            share,
            float(np.sqrt(variance / square)),
            mean_square / self.size,
            float(taken / max(power_sd, 1e-300)),
        )


def fits(drives: Sequence[Drive]) -> bool:
    """Whether drawing and log are of the same joints."""
    return mean_left(drives) < _MOST_LEFT


def mean_left(drives: Sequence[Drive]) -> float:
    return float(np.mean([drive.left for drive in drives]))
