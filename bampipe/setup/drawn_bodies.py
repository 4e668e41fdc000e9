"""Comparison of a robot's drives with its drawn bodies, the measure of every hypothesis.

Fitted bodies absorb much of a mistake: with a reversed drive they turn over, within their prior
uncertainty, and leave little error. Drawn bodies cannot. A body that is far heavier than drawn is
found by its share in all drives.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares

from bampipe.arrays import Array, Flags, Indices
from bampipe.physics.robot import Robot
from bampipe.setup.mounting import Mounting, find_mounting

Bounds = tuple[float, float]

WIDE: Bounds = (-np.inf, np.inf)
"""Range of the share of a drive whose sign and unit are not stated."""
STATED: Bounds = (1.0 / 3.0, 3.0)
"""Plausible ratios of the actual to the drawn weight on a joint; a drive beyond them is that of a
motor before its gear, or has another unit."""
_SURE = 5.0
"""Standard errors beyond which the sign of a drive is certain."""
_LEAST_LEFT = 3e-3
"""Fraction of a drive's variance below which drawings are not distinguished."""
_CONTRADICTED = 3.0 * np.log(2.0)
"""Penalty, in nats, of a mounting for each drive whose friction would then drive the joint: more
than that of a robot that hangs."""
_MOST_LEFT = 0.05
"""Largest fraction of the drives' variance that a drawing with the right reductions leaves."""
_TURNING = 0.02
"""Width of the smoothed sign of a velocity, relative to the largest velocity."""
_FAR = 2.0
"""Ratio of masses beyond which a drawing is not merely inaccurate."""
_WORTH = np.log(4.0)
"""Smallest gain by a heavier body: drop of the sum over joints of the log of the fraction left."""
_EXPLAINED = 0.3
"""Largest fraction of the mean square of all drives that a heavier body may leave."""


@dataclass(frozen=True)
class Drive:
    """Regression of a joint's drive on the force that its motion requires by the drawing.

    Attributes:
        share: ratio of the drive to the required force; 1 if both refer to the joint.
        error: its standard error by the scatter alone; the drawing adds its own.
        left: fraction of the drive's variance left by drawing, drive inertia and friction, with a
            share within the given bounds.
        losses: mean power that friction takes from the drive, in its standard errors; negative if
            the drive or the joint is logged with the wrong sign.
    """

    share: float
    error: float
    left: float
    losses: float

    @property
    def is_contradicted(self) -> bool:
        """Whether weight suggests a sign with which friction would drive the joint."""
        against = self.is_dissipative if self.share < 0.0 else self.losses < -_SURE
        return abs(self.share) > _SURE * self.error and against

    @property
    def is_sure(self) -> bool:
        """Whether weight and inertia determine the sign, without contradiction by friction."""
        return abs(self.share) > _SURE * self.error and not self.is_contradicted

    @property
    def is_dissipative(self) -> bool:
        """Whether friction certainly takes power from the drive."""
        return self.losses > _SURE

    @property
    def is_turned(self) -> bool:
        """Whether it certainly has the wrong sign, by weight and inertia or by friction."""
        return self.share < 0.0 if self.is_sure else self.losses < -_SURE


@dataclass(frozen=True)
class JointMotion:
    """Positions, velocities and accelerations of a robot's joints, each (T, n)."""

    position: Array
    rate: Array
    change: Array

    def rows(self, rows: slice | Indices) -> "JointMotion":
        """The motion at some samples."""
        return JointMotion(self.position[rows], self.rate[rows], self.change[rows])

    def reread(self, gain: Array, time: float = 1.0) -> "JointMotion":
        """Motion of joints that are ``gain`` (n, n) times these, by a clock ``time`` slower."""
        return JointMotion(
            self.position @ gain.T, self.rate @ gain.T / time, self.change @ gain.T / time**2
        )


def keep(values: Array, axes: Sequence[int]) -> Array:
    """Return the columns unchanged: a `Comparison.thin` that compares every sample."""
    return values


@dataclass(frozen=True)
class Comparison:
    """Drives, and the forces that the drawn bodies require along the motion of some trials.

    Attributes:
        robot: its drawn bodies; turning: whether each of its joints is rotary.
        motions: of the joints as read, one per trial.
        drives: (K, n), N.m, N or A.
        ratio: turns of each drive per turn of its joint, (n,).
        thin: maps columns (T, m), given the joint of each, to the samples that are compared.
        used: which samples of each joint are compared, (K, n); None for all.
        shared: turns by joint, (n,), of each motor that turns several: its friction acts on all.
        has_offset: whether a drive may have an offset. It absorbs weight of the wrong sign, so it
            must have none if signs are stated.
    """

    robot: Robot
    turning: tuple[bool, ...]
    motions: Sequence[JointMotion]
    drives: Array
    ratio: Array
    thin: Callable[[Array, Sequence[int]], Array] = keep
    used: Flags | None = None
    shared: Sequence[Array] = ()
    has_offset: bool = True
    _required: dict[bytes, Array] = field(default_factory=dict, repr=False)
    _sums: dict[bytes, list[tuple[Array, ...]]] = field(default_factory=dict, init=False)

    @property
    def nominal(self) -> Mounting:
        """The mounting as drawn, under the stated gravity."""
        n, gravity = len(self.ratio), np.array(self.robot.gravity, dtype=float)
        return Mounting(np.ones(n), np.zeros(n), gravity)

    def reread(self, gain: Array, time: float = 1.0) -> "Comparison":
        """The comparison with other readings of the joints; see `JointMotion.reread`."""
        motions = [m.reread(gain, time) for m in self.motions]
        return replace(self, motions=motions, _required={})

    def _rows(self, values: Array, k: int) -> Array:
        """Samples of ``values``, (K, ...), that are compared on joint ``k``."""
        return values if self.used is None else values[self.used[:, k]]

    def _thinned(self, columns: Sequence[Array], k: int) -> Array:
        """Thinned columns (K, m) of joint ``k`` over all trials, each given as (T, m)."""
        parts = [self.thin(one, [k] * one.shape[1]) for one in columns]
        return self._rows(np.concatenate(parts), k)

    def _require(self, mounting: Mounting) -> Array:
        """Drives (4, K, n) required without gravity, and by 1 m/s2 along each axis of the base."""
        n, found = len(self.ratio), []
        for motion in self.motions:
            moved = motion.reread(np.diag(mounting.direction))
            still = np.zeros((3 * len(moved.rate), n))
            q = np.tile(moved.position + mounting.zero, (4, 1))
            qd, qdd = (np.concatenate([part, still]) for part in (moved.rate, moved.change))
            gravity = np.repeat(np.eye(4)[1:], len(moved.rate), axis=1)
            parts = self.robot.drawn_forces(q, qd, qdd, gravity) / self.ratio
            beside = np.hstack(list(parts.reshape(4, -1, n)))
            found.append(self.thin(beside, list(range(n)) * 4))
        parts = np.concatenate(found).reshape(-1, 4, n).transpose(1, 0, 2)
        # Rounding errors of a force that is zero by symmetry are not a force.
        return np.where(np.abs(parts) > 1e-9 * np.abs(parts).max(initial=0.0), parts, 0.0)

    def by_body(self, mounting: Mounting) -> list[Array]:
        """By joint, the drive that each drawn body requires, less the losses, (K, bodies)."""

        def forces(q: Array, qd: Array, qdd: Array) -> Array:
            bodies, down = range(len(self.robot.joints)), mounting.gravity
            each = [self.robot.drawn_forces(q, qd, qdd, down, only=b) for b in bodies]
            return np.stack(each, axis=2)

        return self._left_of(mounting, forces)

    def by_number(self, mounting: Mounting, place: int) -> list[Array]:
        """By joint, the drive per unit of each inertial number of a body, less losses, (K, 10)."""
        under = self.robot.model_copy(update={"gravity": tuple(mounting.gravity)})

        def numbers(q: Array, qd: Array, qdd: Array) -> Array:
            rows = (row[place] for row in under.columns(q, qd, qdd))
            each = [np.column_stack([np.broadcast_to(c, len(q)) for c in row]) for row in rows]
            return np.stack(each, axis=1)

        return self._left_of(mounting, numbers)

    def _left_of(
        self, mounting: Mounting, columns: Callable[[Array, Array, Array], Array]
    ) -> list[Array]:
        """By joint, columns (K, m) less the losses, from forces (T, n, m) along each motion."""
        moved = [motion.reread(np.diag(mounting.direction)) for motion in self.motions]
        found = [columns(m.position + mounting.zero, m.rate, m.change) for m in moved]
        parts = [one / self.ratio[:, None] for one in found]
        return [
            loss.without(self._thinned([part[:, k] for part in parts], k).T).T
            for k, loss in enumerate(self.losses)
        ]

    @cached_property
    def losses(self) -> "list[Losses]":
        """Losses of each drive; the sign is that of the joint, whichever way the motor turns."""
        found = []
        for k, way in enumerate(np.sign(self.ratio)):
            own = way * np.eye(len(self.ratio))[k]
            turns = np.column_stack([own, *(shared for shared in self.shared if shared[k])])
            rates = [motion.rate @ turns for motion in self.motions]
            width = np.maximum(_TURNING * np.abs(np.concatenate(rates)).max(axis=0), 1e-9)
            columns = [
                np.hstack([motion.change @ turns, rate, np.tanh(rate / width)])
                for motion, rate in zip(self.motions, rates, strict=True)
            ]
            rows = self._thinned(columns, k)
            _, rate, sign = np.split(rows, 3, axis=1)
            means = [part.sum(axis=0) / max(len(part), 1) for part in (rate**2, sign * rate)]
            powers = np.concatenate([np.zeros(turns.shape[1]), *means])
            found.append(Losses.of(rows, powers, self._rows(self.drives[:, k], k), self.has_offset))
        return found

    def hold(self, mounting: Mounting, bounds: Bounds = WIDE) -> list[Drive]:
        """Regress each drive on the drawing in a given mounting."""
        key = mounting.direction.tobytes() + mounting.zero.tobytes()
        if key not in self._sums:
            if key not in self._required:
                self._required[key] = self._require(mounting)
            parts = self._required[key]
            self._sums[key] = [
                loss.sums(np.array([self._rows(part[:, k], k) for part in parts]))
                for k, loss in enumerate(self.losses)
            ]
        by_part = np.array([1.0, *mounting.gravity])
        return [
            loss.beside(sums, by_part, mounting.direction[k], bounds)
            for k, (loss, sums) in enumerate(zip(self.losses, self._sums[key], strict=True))
        ]

    def best_mounting(self, roughly: "Comparison", doubted: float) -> Mounting:
        """Return the mounting with which the drawing explains most of ``roughly`` the same.

        It is the nominal one if that leaves less than the fraction ``doubted`` of every drive, and
        friction contradicts none.
        """
        nominal = self.nominal
        if all(d.left < doubted and not d.is_contradicted for d in self.hold(nominal)):
            return nominal
        return find_mounting(roughly.turning, nominal, roughly.misfit)

    def misfit(self, mounting: Mounting) -> float:
        """The quantity that `find_mounting` minimises; friction that contradicts weight adds."""
        drives = self.hold(mounting)
        left = np.log([drive.left + _LEAST_LEFT for drive in drives])
        return float(left.sum() + _CONTRADICTED * sum(drive.is_contradicted for drive in drives))


@dataclass(frozen=True)
class Losses:
    """The part of a drive (K,) that its inertia, friction and offset explain, and the rest.

    Attributes:
        basis: orthonormal basis of their columns, (K, m).
        power: vector whose product with the force that is not required is the mean power of
            friction, (K,).
        drive: drive less the losses, (K,); size: mean square of the drive without its offset.
        taken: mean power of friction if nothing is required.
        known: whether the columns are independent.
    """

    basis: Array
    power: Array
    drive: Array
    size: float
    taken: float
    known: bool

    @classmethod
    def of(cls, columns: Array, powers: Array, drive: Array, has_offset: bool) -> "Losses":
        """Compute losses from columns (K, m), the mean power per unit of each, and the drive."""
        if has_offset:
            columns, powers = np.column_stack([columns, np.ones(len(drive))]), np.append(powers, 0)
        size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        left, values, right = np.linalg.svd(columns / size, full_matrices=False)
        held = values > 1e-9 * values.max(initial=1e-300)
        power = left[:, held] @ (right[held] @ (powers / size) / values[held])
        rest = drive - left[:, held] @ (left[:, held].T @ drive)
        middle = drive.sum() / max(len(drive), 1) if has_offset else 0.0
        return cls(
            left[:, held],
            power,
            rest,
            max(_mean_square(drive - middle), 1e-300),
            float(power @ drive),
            bool(len(held)) and bool(held.all()),
        )

    def sums(self, parts: Array) -> tuple[Array, ...]:
        """Products of the required forces, ``parts`` (m, K), so that `beside` needs no samples."""
        own = self.without(parts)
        return own @ own.T, parts @ parts.T, own @ self.drive, parts @ self.power

    def without(self, columns: Array) -> Array:
        """Columns, (m, K), less the losses."""
        return np.asarray(columns - (columns @ self.basis) @ self.basis.T)

    def beside(
        self, sums: tuple[Array, ...], by_part: Array, direction: float, bounds: Bounds
    ) -> Drive:
        """Regress the drive on losses and the required force, the sum of ``by_part`` (m,) parts.

        ``sums`` are those of the parts, ``direction`` is the joint's, ``bounds`` limit the share.
        """
        square, whole = (float(by_part @ of @ by_part) for of in sums[:2])
        along, power = (float(of @ by_part) for of in sums[2:])
        left, count = float(self.drive @ self.drive), max(len(self.drive), 1)
        # Losses alone may explain all that is required, as the mass of a slide by its drive's.
        inverse = self.known / square if square > 1e-18 * max(whole, 1e-300) else 0.0
        share = along * inverse
        mean_square = max(left - share * along, 0.0) / count
        # Errors of neighbouring samples are correlated: about one sample in ten is independent.
        variance = 10.0 * mean_square
        power_sd = np.sqrt(variance * (float(self.power @ self.power) + power**2 * inverse))
        taken = direction * (self.taken - share * power)
        held = min(max(share, bounds[0]), bounds[1]) if inverse else 0.0
        return Drive(
            share,
            float(np.sqrt(variance * inverse)) if inverse else np.inf,
            (mean_square + (held - share) ** 2 * square / count) / self.size,
            float(self.known * taken / max(power_sd, 1e-300)),
        )


def fits(drives: Sequence[Drive]) -> bool:
    """Whether drawing and log describe the same joints."""
    return mean_left(drives) < _MOST_LEFT


def mean_left(drives: Sequence[Drive]) -> float:
    """Mean fraction of the drives' variance that is left."""
    return float(np.mean([drive.left for drive in drives]))


@dataclass(frozen=True)
class HeavierBody:
    """The index of a body, and the ratio of its mass and inertia to the drawn ones."""

    place: int
    factor: float


def find_heavy(compared: Comparison, mounting: Mounting) -> HeavierBody | None:
    """Find the one body whose mass lets the drawing explain all drives, N.m or N; or None.

    It must explain more than another unit of one or all drives, which is a single number, too.
    """
    if not mounting.gravity.any():
        return None
    drives, bodies = _signed_drives(compared, mounting), compared.by_body(mounting)
    size = [max(_mean_square(drive), np.finfo(float).tiny) for drive in drives]

    def misfit(left: Sequence[Array]) -> Array:
        shares = [_mean_square(rest) / s for rest, s in zip(left, size, strict=True)]
        return np.log(np.array(shares) + _LEAST_LEFT)

    whole = [columns.sum(axis=1) for columns in bodies]
    rest = [drive - force for drive, force in zip(drives, whole, strict=True)]
    nominal, scaled = misfit(rest), misfit(_fitted(rest, whole, size)[1])
    alone = misfit([_fitted([r], [w], [1.0])[1][0] for r, w in zip(rest, whole, strict=True)])
    least = min(float(scaled.sum()), float(nominal.sum() + (alone - nominal).min()))
    best: tuple[float, HeavierBody, list[Array]] | None = None
    for place in range(bodies[0].shape[1]):
        change, left = _fitted(rest, [columns[:, place] for columns in bodies], size)
        score = float(misfit(left).sum())
        if 1.0 + change > _FAR and score < (best[0] if best else least - _WORTH):
            best = score, HeavierBody(place, 1.0 + change), left
    if best is None:
        return None
    share = sum(map(_mean_square, best[2])) / sum(size)
    return best[1] if share < _EXPLAINED else None


def _mean_square(values: Array) -> float:
    """Mean square of samples (K,), 0 without any."""
    return float(values @ values) / max(len(values), 1)


def _fitted(
    rest: Sequence[Array], columns: Sequence[Array], size: Sequence[float]
) -> tuple[float, list[Array]]:
    """Return the coefficient of a column, (K,) by joint, nearest to ``rest``, and the remainder."""
    weights = [1.0 / (s * max(len(one), 1)) for s, one in zip(size, rest, strict=True)]
    along = sum(w * float(c @ r) for w, c, r in zip(weights, columns, rest, strict=True))
    square = sum(w * float(c @ c) for w, c in zip(weights, columns, strict=True))
    change = along / max(square, np.finfo(float).tiny)
    return change, [r - change * c for r, c in zip(rest, columns, strict=True)]


def _fit_point_mass(
    rest: Sequence[Array], columns: Sequence[Array], mass: float, center: Array
) -> tuple[float, Array]:
    """Return mass, kg, and position, (3,), m, of the point mass that explains most of the drives.

    Args:
        rest: by joint, the remainder of its drive, (K,).
        columns: by joint, the drive per unit of each of the body's ten inertial numbers, (K, 10).
        mass, center: initial values.
    """
    size = [max(float(np.linalg.norm(one)), np.finfo(float).tiny) for one in rest]

    def left(x: Array) -> Array:
        m, c = x[0], x[1:]
        about = m * (c @ c * np.eye(3) - np.outer(c, c))
        numbers = np.array([m, *(m * c), *about[np.triu_indices(3)]])
        parts = zip(rest, columns, size, strict=True)
        held = 1e-3 * (x - start)
        return np.concatenate([*((one - by @ numbers) / s for one, by, s in parts), held])

    start = np.array([mass, *center])
    found = least_squares(left, start, x_scale=[mass, 0.1, 0.1, 0.1])
    return float(found.x[0]), np.asarray(found.x[1:])


def _signed_drives(compared: Comparison, mounting: Mounting) -> list[Array]:
    signs = [-1.0 if drive.is_turned else 1.0 for drive in compared.hold(mounting)]
    return [sign * loss.drive for sign, loss in zip(signs, compared.losses, strict=True)]


def describe_heavy(
    compared: Comparison, mounting: Mounting, found: HeavierBody, in_tip: Callable[[Array], Array]
) -> str:
    """Describe a body that is heavier than drawn; for the last one, suggest a payload.

    ``in_tip`` maps a position in the frame of the last joint, (3,), to that of the tip.
    """
    robot = compared.robot
    said, joint = robot.describe_mass(found.place, found.factor), robot.joints[found.place]
    if joint is not robot.joints[-1] or robot.payload is not None:
        return said
    pairs = zip(_signed_drives(compared, mounting), compared.by_body(mounting), strict=True)
    mass, center = _fit_point_mass(
        [drive - forces.sum(axis=1) for drive, forces in pairs],
        compared.by_number(mounting, found.place),
        (found.factor - 1.0) * joint.mass,
        np.array(joint.center),
    )
    place = ", ".join(f"{value:.2g}" for value in in_tip(center))
    return f"{said} mass = {mass:.3g}, center = [{place}]"


def with_heavier_body(robot: Robot, found: HeavierBody) -> Robot:
    """The robot with the mass and inertia of a body multiplied by the factor found."""
    joints, one = list(robot.joints), robot.joints[found.place]
    more = {"mass": found.factor * one.mass, "inertia": tuple(found.factor * np.array(one.inertia))}
    joints[found.place] = one.model_copy(update=more)
    return robot.model_copy(update={"joints": tuple(joints)})
