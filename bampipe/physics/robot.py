"""A robot: joints in a row or in a tree, each with the body behind it, in place of energies."""

import math
from collections.abc import Iterator
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from bampipe.arrays import Array, Flags
from bampipe.errors import InputError, did_you_mean
from bampipe.physics.expression import Name
from bampipe.physics.newton_euler import INERTIAL, Algebra, Link, Vector, columns, joint_forces
from bampipe.physics.parameter import Parameter
from bampipe.schema import (
    ByName,
    Declaration,
    NamedDeclaration,
    NotNegative,
    Number,
    Positive,
    Several,
    Text,
)

_LARGEST = 1e9
"""Largest number of a drawn body, kg, m or kg.m2: sums over bodies stay below a parameter's
limit."""
Triple = Annotated[Several[Number], Field(min_length=3, max_length=3)]
Sextuple = Annotated[Several[Number], Field(min_length=6, max_length=6)]
INERTIAL_NAMES = (
    "mass",
    *(f"first_moment_{axis}" for axis in "xyz"),
    *(f"inertia_{pair}" for pair in ("xx", "xy", "xz", "yy", "yz", "zz")),
)
"""Names of the inertial numbers of a link, in the order of `newton_euler`."""
_UNITS = ("kg", *("kg.m",) * 3, *("kg.m2",) * 6)
_ROUNDING = 1e-10
"""Rotations by quarter turns, written with eleven digits, leave less than this beside 0 and 1."""
_NO_EFFECT = 1e-9
"""An inertial number with a column below this share of the largest changes no joint's force."""
_LEAST_SHARE, _UNDRAWN_SHARE = 0.01, 0.1
"""Share of the robot's mass and length: the uncertainty of a body is at least that of a link of
this size, as for a link whose mass is not drawn."""
_TRIANGLE = 1e-6
"""Relative excess of a principal moment over the sum of the other two by rounding of drawings."""


class Joint(NamedDeclaration):
    """A joint and the body behind it."""

    kind: Literal["revolute", "prismatic"] = Field(description="Turns about z, or slides along it")
    after: str = Field(default="", description="The joint before it; empty: the base")
    position: Triple = (0.0, 0.0, 0.0)
    """Of the joint in the frame of the link before, m"""
    rotation: Triple = (0.0, 0.0, 0.0)
    """Of its frame in that of the link before: roll, pitch and yaw about fixed axes, rad"""
    axis: Triple = Field(default=(0.0, 0.0, 1.0), description="Of the motion, in its own frame")
    follows: str = Field(default="", description="The joint that it follows; empty: none")
    ratio: Number = Field(default=1.0, description="Its motion for one of the joint it follows")
    zero: Number = Field(default=0.0, description="Its position where that is at zero, rad or m")
    mass: Number = Field(default=0.0, description="Of the body behind it, kg, as drawn")
    center: Triple = Field(default=(0.0, 0.0, 0.0), description="Its centre of mass, m")
    inertia: Sextuple = (0.0,) * 6
    """xx, xy, xz, yy, yz, zz about the centre of mass, kg.m2"""
    effort: NotNegative = Field(default=0.0, description="Largest, N.m or N; 0: not known")
    velocity: NotNegative = Field(default=0.0, description="Largest, rad/s or m/s; 0: not known")

    def cross_faults(self) -> Iterator[InputError]:
        length = math.hypot(*self.axis)
        if not 0.0 < length < math.inf:
            yield InputError(
                f"found a vector of length {length:g}, expected a direction", where="axis"
            )
        with np.errstate(over="ignore", invalid="ignore"):
            largest = float(np.abs([*self.inertial, *self.position]).max())
        if not largest <= _LARGEST:
            yield InputError(
                f"a body beyond what can be computed with, {_LARGEST:.0e} in SI units",
                remedy="give physically possible numbers",
            )

    @property
    def inertial(self) -> Array:
        """The ten numbers of the body, about the joint; see `INERTIAL_NAMES`.

        Impossible numbers become the nearest possible ones: zero for a negative mass, and no
        negative spread of mass along a principal axis.
        """
        if self.mass < 0.0:
            return np.zeros(INERTIAL)
        c, tensor = np.array(self.center), _matrix(self.inertia)
        if self.impossible:
            spread, axes = np.linalg.eigh(0.5 * np.trace(tensor) * np.eye(3) - tensor)
            spread = np.maximum(spread, 0.0)
            tensor = spread.sum() * np.eye(3) - axes * spread @ axes.T
        about = tensor + self.mass * (c @ c * np.eye(3) - np.outer(c, c))
        upper = about[np.triu_indices(3)]
        return np.array([self.mass, *(self.mass * c), *upper])

    @property
    def principal_moments(self) -> tuple[float, ...]:
        """Of the inertia about the centre of mass, rising, kg.m2."""
        return tuple(float(m) for m in np.linalg.eigvalsh(_matrix(self.inertia)))

    @property
    def impossible(self) -> list[str]:
        """Physically impossible drawn numbers, one sentence each."""
        faults = [f"a mass of {self.mass:g} kg"] if self.mass < 0.0 else []
        moments = self.principal_moments
        shown = f"(principal moments {', '.join(f'{m:.3g}' for m in moments)} kg.m2)"
        if moments[0] < -_TRIANGLE * max(abs(moments[2]), 1e-12):
            faults.append(f"a negative moment of inertia {shown}")
        elif moments[2] > (moments[0] + moments[1]) * (1.0 + _TRIANGLE):
            faults.append(f"an inertia whose largest moment exceeds the sum of the others {shown}")
        elif self.mass == 0.0 and moments[2] > 0.0:
            faults.append("an inertia without a mass")
        return [f"{self.name}: {text}" for text in faults]

    @property
    def size(self) -> float:
        """Radius of gyration of the body about the joint, m."""
        if not self.mass > 0.0:
            return 0.0
        numbers = self.inertial
        return float(np.sqrt(max(numbers[4] + numbers[7] + numbers[9], 0.0) / (2.0 * self.mass)))


class Motor(Declaration):
    """A motor and the joints that turn it."""

    turns: dict[Name, Number] = Field(min_length=1)
    """Turns of the motor for one of each joint, rad/rad or rad/m"""
    rotor_inertia: Positive | None = Field(default=None, description="At the motor, kg.m2")
    torque_constant: Number | None = Field(default=None, description="For a logged current, N.m/A")
    torque_constant_sd: Positive | None = None
    """Its standard uncertainty; the constant is estimated if this is given"""


class Row(NamedDeclaration):
    """A joint in a table of Denavit and Hartenberg: standard form, turned about z of the last."""

    d: Number = Field(default=0.0, description="Along z of the frame before, m")
    a: Number = Field(default=0.0, description="Along its own x, m")
    alpha: Number = Field(default=0.0, description="About its own x, rad")
    offset: Number = Field(default=0.0, description="Angle about z where the position is 0, rad")
    kind: Literal["revolute", "prismatic"] = "revolute"
    """Turns about z of the row before, or slides along it"""
    mass: Number = Field(default=0.0, description="Of the body behind it, kg")
    center: Triple = Field(default=(0.0, 0.0, 0.0), description="In the frame of this row, m")
    inertia: Sextuple = (0.0,) * 6
    """Inertia of the body, in the frame of this row"""


class Payload(Declaration):
    """A body held by the last link."""

    mass: Positive = Field(description="kg")
    center: Triple = Field(default=(0.0, 0.0, 0.0), description="In the frame of the tip, m")
    inertia: Sextuple = Field(default=(0.0,) * 6, description="As for the body of a joint")


class Robot(Declaration):
    """Rigid bodies on joints; energies in [energy] are added."""

    urdf: Text | None = None
    """URDF or MJCF file beside this one that the joints are read from"""
    base: str = Field(default="", description="Link that stands still; the URDF's root by default")
    tip: str = Field(default="", description="Last link of the chain; the URDF's only end")
    dh: Annotated[tuple[Row, ...], ByName(Name)] = Field(
        default=(), description="One table per joint, in place of a URDF"
    )
    payload: Payload | None = Field(default=None, description="A body held by the last link")
    motors: dict[Name, Motor] = Field(default={})
    """One table per motor; otherwise a drive at each joint whose torque is logged"""
    gravity: Triple = Field(default=(0.0, 0.0, -9.81), description="m/s2, in the base's frame")
    uncertainty: Positive = 0.3
    """Relative standard uncertainty of the drawn inertial numbers"""
    joints: Annotated[tuple[Joint, ...], ByName(Name)] = Field(
        default=(), description="One table per joint, parents first; read from the URDF if given"
    )

    def cross_faults(self) -> Iterator[InputError]:
        known, alone = list[str](), [joint.name for joint in self.moving]
        for joint in self.joints:
            if joint.after and joint.after not in known:
                yield InputError(
                    f"there is no joint {joint.after!r} above it",
                    where=f"joints.{joint.name}.after",
                    remedy="the joint before stands first; leave it out for the base",
                )
            known.append(joint.name)
            if joint.follows and joint.follows not in alone:
                yield InputError(
                    f"there is no joint {joint.follows!r} that follows none",
                    where=f"joints.{joint.name}.follows",
                )
        for name, motor in self.motors.items():
            for turned in motor.turns:
                if turned not in alone:
                    yield InputError(
                        f"there is no joint {turned!r}{did_you_mean(turned, alone)}",
                        where=f"motors.{name}.turns",
                    )
            if motor.torque_constant_sd is not None and motor.torque_constant is None:
                yield InputError("'torque_constant' is missing", where=f"motors.{name}")
        by_current = {motor.torque_constant is not None for motor in self.motors.values()}
        if len(by_current) > 1:
            yield InputError(
                "some motors have a torque_constant, others do not",
                where="motors",
                remedy="log the current of all, or the torque of all",
            )
        motors = self.motors.values()
        if motors and all(motor.torque_constant_sd is not None for motor in motors):
            yield InputError(
                "every torque constant is estimated, so the scale of all masses is undetermined",
                where="motors",
                remedy="leave out torque_constant_sd for the best-known constant",
            )

    @property
    def moving(self) -> tuple[Joint, ...]:
        """The joints that follow no other: the coordinates."""
        return tuple(joint for joint in self.joints if not joint.follows)

    @cached_property
    def links(self) -> tuple[Link, ...]:
        """The joints as `newton_euler` wants them."""
        place = {joint.name: i for i, joint in enumerate(self.joints)}
        return tuple(
            Link(
                place.get(joint.after, -1), joint.kind == "prismatic",
                _keep_integers(np.array(joint.axis) / math.hypot(*joint.axis)),
                _keep_integers(np.array(joint.position)),
                tuple(map(_keep_integers, rotation_matrix(joint.rotation))),
                place.get(joint.follows, -1), joint.ratio, joint.zero,
            )
            for joint in self.joints
        )  # fmt: skip

    @cached_property
    def matters(self) -> Flags:
        """Return which inertial numbers change the force of some joint, (joints, 10)."""
        size = np.abs(self.regressor)
        largest = max(float(size.max(initial=0.0)), 1.0)
        return size.max(axis=0).reshape(-1, INERTIAL) > _NO_EFFECT * largest

    @cached_property
    def regressor(self) -> Array:
        """Slopes of the joint forces by all inertial numbers along a rich motion, (rows, 10 n)."""
        rng = np.random.default_rng(0)
        n, moving = len(self.joints), len(self.moving)
        samples = 40 * max(n, 1)
        entries = self.columns(*(rng.uniform(-2.0, 2.0, (moving, samples)).T for _ in range(3)))
        shape = INERTIAL, samples
        table = [np.concatenate([np.broadcast_to(x, shape) for x in row]).T for row in entries]
        return np.ascontiguousarray(np.concatenate(table))

    def describe_mass(self, place: int, factor: float) -> str:
        """Say that the drives suggest ``factor`` times the drawn mass of a body, and the remedy.

        For the last body, which may hold a tool, the remedy is ``[robot.payload]``.
        """
        joint = self.joints[place]
        said = (
            f"the body on {joint.name} is about {factor:.2g} times as heavy as drawn"
            f" ({joint.mass:.3g} kg), by all drives together"
        )
        if joint is not self.joints[-1] or self.payload is not None:
            return f"{said}: if that is the mounted body, enter its mass, centre and inertia"
        more = (factor - 1.0) * joint.mass
        return f"{said}: a tool of about {more:.2g} kg? put it into [robot.payload]"

    def columns(self, q: Array, qd: Array, qdd: Array) -> list[list[Array]]:
        """Forces of the joints by one unit of each inertial number: [joint][link].

        Args:
            q, qd, qdd: a motion of `moving`, (T, joints), rad or m and derivatives.

        Returns:
            (10, T), or (10, 1) where all samples are equal, N.m or N.
        """
        a, b, c = (np.ascontiguousarray(x.T) for x in (q, qd, qdd))
        return columns(self.links, a, b, c, gravity_vector(self))

    def drawn_forces(
        self, q: Array, qd: Array, qdd: Array, gravity: Array, only: int | None = None
    ) -> Array:
        """Forces of the joints, (T, n), that the drawn bodies require along a motion.

        Args:
            q, qd, qdd: a motion, (T, n), rad or m and derivatives.
            gravity: in the frame of the base, m/s2, (3,), or (3, T) where it differs. only: number
            of the only body; None for all.
        """
        bodies = [
            list(joint.inertial) if only in (None, k) else [0.0] * INERTIAL
            for k, joint in enumerate(self.joints)
        ]
        a, b, c = (np.ascontiguousarray(part.T) for part in (q, qd, qdd))
        forces = joint_forces(Algebra(), self.links, bodies, a, b, c, gravity)
        return np.broadcast_to(forces, (len(forces), len(q))).T.copy()

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The inertial numbers of all bodies; those that no motion shows are fixed."""
        heaviest = max(sum(max(joint.mass, 0.0) for joint in self.joints), 1e-3)
        longest = max((joint.size for joint in self.joints), default=0.0) or 0.1
        entries = []
        for joint, matters in zip(self.joints, self.matters, strict=True):
            least = _LEAST_SHARE if joint.mass > 0.0 else _UNDRAWN_SHARE
            mass = max(joint.mass, least * heaviest)
            size = max(joint.size, least * longest)
            for k, short in enumerate(INERTIAL_NAMES):
                power = 0 if k == 0 else 1 if k < 4 else 2
                entry = Parameter(
                    unit=_UNITS[k],
                    prior=float(joint.inertial[k]),
                    sd=self.uncertainty * mass * size**power,
                    fixed=not bool(matters[k]),
                    weighed=True,
                )
                entries.append(entry.renamed(f"{short}.{joint.name}"))
        return tuple(entries)

    @property
    def rotors_at_joints(self) -> dict[str, float]:
        """Inertia at a joint of the rotor that alone drives it, kg.m2 or kg, if given."""
        alone = {next(iter(m.turns)): m for m in self.motors.values() if len(m.turns) == 1}
        return {
            joint: motor.rotor_inertia * motor.turns[joint] ** 2
            for joint, motor in alone.items()
            if motor.rotor_inertia is not None
        }

    @property
    def impossible(self) -> list[str]:
        """Physically impossible drawn numbers, one sentence each."""
        return [line for joint in self.joints for line in joint.impossible]

    @property
    def undrawn(self) -> list[str]:
        """Joints whose body has neither mass nor inertia in the drawing."""
        return [j.name for j in self.joints if j.mass == 0.0 and not any(j.inertia)]


def rotation_matrix(angles: tuple[float, ...]) -> Array:
    """Rotation by roll, pitch and yaw about the fixed axes x, y, z; columns are turned axes."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(angles), np.cos(angles)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def gravity_vector(robot: Robot) -> Vector:
    """Gravity in the frame of the base, m/s2."""
    return _keep_integers(np.array(robot.gravity))


def _matrix(six: tuple[float, ...]) -> Array:
    xx, xy, xz, yy, yz, zz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _keep_integers(vector: Array) -> Vector:
    """Numbers with 0, 1 and -1 as integers, so that products with them vanish from the text."""
    entries: list[Any] = []
    for value in vector:
        near = round(float(value))
        entries.append(near if abs(value - near) < _ROUNDING and abs(near) <= 1 else float(value))
    return entries[0], entries[1], entries[2]
