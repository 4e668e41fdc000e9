"""The links of a robot, as rigid bodies, and the joints between them, as a file draws them."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from bampipe.arrays import Array
from bampipe.data.refusals import refusal
from bampipe.data.robot_xml import DEEPEST
from bampipe.errors import InputError

_BELOW_ZERO = 1e-6
"""Share of the largest second moment of mass by which one may be below zero."""
MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
"""Kinds of joint that move a chain, and their names in a device file."""
UPRIGHT = (0.0, 0.0, -9.81)
"""Gravity where nothing else is said, m/s2."""
_ROUNDING = 1e-6
"""Share of gravity by which a component of it may be off zero."""


@dataclass
class Body:
    """Mass, centre (3,) and inertia about it (3, 3), in the axes of a frame."""

    mass: float = 0.0
    center: Array = field(default_factory=lambda: np.zeros(3))
    inertia: Array = field(default_factory=lambda: np.zeros((3, 3)))

    @classmethod
    def of_table(cls, table: Mapping[str, Any]) -> "Body":
        """The body that the entry of a joint or payload in a device file describes."""
        center = np.array(table.get("center", (0.0,) * 3), dtype=float)
        inertia = symmetric(table.get("inertia", (0.0,) * 6))
        return cls(float(table.get("mass", 0.0)), center, inertia)

    def moved(self, turn: Array, offset: Array) -> "Body":
        """The same body seen from a frame in which its own lies at ``offset``, ``turn``."""
        return Body(self.mass, turn @ self.center + offset, turn @ self.inertia @ turn.T)

    def joined(self, other: "Body") -> "Body":
        """Both as one."""
        mass = self.mass + other.mass
        if mass == 0.0:
            return Body(0.0, self.center, self.inertia + other.inertia)
        center = (self.mass * self.center + other.mass * other.center) / mass
        return Body(mass, center, self.about(center) + other.about(center))

    def without(self, other: "Body") -> "Body":
        """What is left when a part of it is taken off."""
        return self.joined(Body(-other.mass, other.center, -other.inertia))

    def about(self, point: Array) -> Array:
        """Inertia about a point, (3, 3)."""
        r = self.center - point
        return self.inertia + self.mass * ((r @ r) * np.eye(3) - np.outer(r, r))

    @property
    def is_possible(self) -> bool:
        """Whether a distribution of mass has these numbers."""
        spread = 0.5 * np.trace(self.inertia) * np.eye(3) - self.inertia
        moments = np.linalg.eigvalsh(spread)
        return self.mass >= 0.0 and bool(moments[0] >= -_BELOW_ZERO * abs(moments[2]))

    def table(self) -> dict[str, Any]:
        """The entries that describe it for a joint in a device file."""
        upper = [float(v) for v in self.inertia[np.triu_indices(3)]]
        return {"mass": self.mass, "center": [float(v) for v in self.center], "inertia": upper}


def symmetric(six: Any) -> Array:
    """The matrix, (3, 3), of its upper triangle by rows."""
    xx, xy, xz, yy, yz, zz = (float(v) for v in six)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@dataclass(frozen=True)
class DriveLimits:
    """What a file says of a joint's drive; 0 where it says nothing.

    Attributes:
        lower, upper: range, rad or m; equal where there is none.
        effort: N.m or N; velocity: rad/s or m/s.
        damping: N.m.s/rad or N.s/m; friction: N.m or N.
        armature: inertia of the drive at the joint, kg.m2 or kg.
    """

    lower: float = 0.0
    upper: float = 0.0
    effort: float = 0.0
    velocity: float = 0.0
    damping: float = 0.0
    friction: float = 0.0
    armature: float = 0.0


@dataclass(frozen=True)
class TreeJoint:
    """A joint between two links.

    Attributes:
        name: its own; kind: as of a URDF.
        parent, child: the links.
        turn, offset: of its frame in that of the parent, (3, 3) and (3,), m.
        angles: of ``turn``, about the fixed axes x, y, z, rad.
        axis: in its own frame.
        limits: of its drive.
        mimic: the joint that it follows, its motion for one of that, and its position where that
            is at zero, rad or m; None if it moves by itself.
    """

    name: str
    kind: str
    parent: str
    child: str
    turn: Array
    offset: Array
    angles: Sequence[float]
    axis: list[float]
    limits: DriveLimits = DriveLimits()
    mimic: tuple[str, float, float] | None = None


@dataclass(frozen=True)
class Tree:
    """Links and the joints between them, as a file has them.

    Attributes:
        bodies: by link, in its frame.
        joints: from a link to one behind it.
        notes: what of the file is not heard, one sentence each.
        gravity: in the frame of the link at the root, m/s2; None if the file says nothing.
    """

    bodies: Mapping[str, Body]
    joints: Sequence[TreeJoint]
    notes: tuple[str, ...] = ()
    gravity: tuple[float, float, float] | None = None

    @cached_property
    def above(self) -> Mapping[str, TreeJoint]:
        """By link, the joint that it hangs on."""
        return {joint.child: joint for joint in self.joints}

    def way(self, link: str) -> list[TreeJoint]:
        """Joints from the root to a link.

        Raises:
            InputError: they form a loop, or are too many.
        """
        found: dict[str, TreeJoint] = {}
        while joint := self.above.get(link):
            if link in found:
                raise InputError(f"the joints above {link!r} form a loop")
            if len(found) == DEEPEST:
                raise InputError(f"more than {DEEPEST} links one behind another")
            found[link], link = joint, joint.parent
        return [*found.values()][::-1]

    def path(self, base: str, tip: str) -> list[TreeJoint]:
        """Joints from base to tip.

        Raises:
            InputError: there is no such path, or one with a joint of another kind than a chain has.
        """
        way = self.way(tip)
        links = [*(joint.parent for joint in way), tip]
        if base not in links:
            raise InputError(f"no chain of joints leads from link {base!r} to link {tip!r}")
        for joint in way[links.index(base) :]:
            if joint.kind not in (*MOVING, "fixed"):
                raise refusal("joint_type", f"joint {joint.name!r}", kind=joint.kind)
        return way[links.index(base) :]


def gravity_at(tree: Tree, base: str) -> tuple[tuple[float, float, float] | None, str]:
    """Gravity in the frame of a link, m/s2, and a clause where joints on the way to it turn it.

    The root of a URDF stands upright. None if that goes for the link as well, or if a joint
    above it can tilt it.
    """
    way = tree.way(base)
    if not way:
        return tree.gravity, ""
    start = np.array(tree.gravity or UPRIGHT)
    down, least = start, _ROUNDING * float(np.linalg.norm(start))
    for joint in way:
        down = joint.turn.T @ down
        turns = joint.kind not in ("fixed", "prismatic")
        about_it = joint.kind in MOVING and np.abs(np.cross(joint.axis, down)).max() <= least
        if turns and not about_it:
            return None, f"gravity taken along -z of {base}, which {joint.name} can tilt"
    if tree.gravity is None and np.abs(down - start).max() <= least:
        return None, ""
    x, y, z = (float(v) for v in np.where(np.abs(down) <= least, 0.0, down))
    said = f"gravity ({x:.4g}, {y:.4g}, {z:.4g}) m/s2 in the frame of {base}"
    return (x, y, z), f"{said}, from that of {way[0].parent}"


def hold_beside(tree: Tree, base: str, tip: str) -> Tree:
    """The part of the tree on ``base``, fixed what does not move from there to ``tip``.

    Joints come parents first.
    """
    moving = {joint.child for joint in tree.path(base, tip)}
    joints: list[TreeJoint] = []
    links = [base]
    for link in links:
        for joint in tree.joints:
            if joint.parent == link:
                kind = joint.kind if joint.child in moving else "fixed"
                joints.append(replace(joint, kind=kind))
                links.append(joint.child)
    return replace(tree, bodies={link: tree.bodies[link] for link in links}, joints=joints)


def tree_of_tables(tables: Mapping[str, Mapping[str, Any]]) -> Tree:
    """Links and joints of the tables of ``[robot.joints]``: ``base``, and one link a joint."""
    from scipy.spatial.transform import Rotation  # slow to import, and for robots alone

    bodies, joints = {"base": Body()}, []
    for name, table in tables.items():
        link, after = f"{name}_link", table.get("after")
        bodies[link] = Body.of_table(table)
        angles = [float(v) for v in table.get("rotation", (0.0,) * 3)]
        turn = Rotation.from_euler("xyz", angles).as_matrix()
        offset = np.array(table.get("position", (0.0,) * 3), dtype=float)
        axis = [float(v) for v in table.get("axis", (0.0, 0.0, 1.0))]
        ends = f"{after}_link" if after else "base", link
        joint = TreeJoint(name, str(table["kind"]), *ends, turn, offset, angles, axis)
        if other := table.get("follows"):
            mimic = str(other), float(table.get("ratio", 1)), float(table.get("zero", 0))
            joint = replace(joint, mimic=mimic)
        joints.append(joint)
    return Tree(bodies, joints)


def fixed_joint(name: str, parent: str, child: str, turn: Array, offset: Array) -> TreeJoint:
    """A joint that does not move, between two links."""
    from scipy.spatial.transform import Rotation

    frame = turn, offset, Rotation.from_matrix(turn).as_euler("xyz")
    return TreeJoint(name, "fixed", parent, child, *frame, [0.0, 0.0, 1.0])


def identifier(name: str) -> str:
    """The joint's name as expressions can use it."""
    text = re.sub(r"\W", "_", name, flags=re.ASCII)
    return text if text[:1].isalpha() else f"joint_{text}"


@dataclass(frozen=True)
class LumpedBodies:
    """What the links of a chain carry: all that its joints ``moving`` do not move against them."""

    tree: Tree
    moving: Sequence[TreeJoint]

    @cached_property
    def _behind(self) -> Mapping[str, Sequence[TreeJoint]]:
        """By link, the joints on it that the chain does not move."""
        starts = {joint.child for joint in self.moving}
        found: dict[str, list[TreeJoint]] = {}
        for joint in self.tree.joints:
            if joint.child not in starts:
                found.setdefault(joint.parent, []).append(joint)
        return found

    def body_on(self, link: str, held_only: bool = False) -> Body:
        """The body of a link with all that is fixed to it or held still on it, in its frame.

        ``held_only``: the part of it that is behind joints held still.
        """
        total = Body() if held_only else self.tree.bodies[link]
        for joint in self._behind.get(link, ()):
            part = self.body_on(joint.child, held_only and joint.kind == "fixed")
            total = total.joined(part.moved(joint.turn, joint.offset))
        return total

    def held_on(self, link: str) -> Iterator[TreeJoint]:
        """The joints held still on a link and what is on it, of those that carry mass."""
        for joint in self._behind.get(link, ()):
            if joint.kind != "fixed" and self.body_on(joint.child).mass > 0.0:
                yield joint
            yield from self.held_on(joint.child)

    def fixed_on(self, link: str) -> Iterator[str]:
        """The links fixed to a link, one on another."""
        for joint in self._behind.get(link, ()):
            if joint.kind == "fixed":
                yield joint.child
                yield from self.fixed_on(joint.child)


def put_bodies(
    tree: Tree, base: str, tip: str, bodies: Mapping[str, Body], limits: Mapping[str, DriveLimits]
) -> Tree:
    """The tree with other bodies and limits, by joint of a chain, the same to its motion.

    What was joined to make the body of a joint is parted again: links on fixed joints get no mass,
    which is in that of the link behind the joint; those on joints that are held keep theirs, which
    is taken off there.
    """
    # A joint that follows one beside the chain is held, too, and has no body of its own.
    path = [joint for joint in tree.path(base, tip) if joint.kind != "fixed"]
    moving = [joint for joint in path if identifier(joint.name) in bodies]
    lumped = LumpedBodies(tree, moving)
    placed = dict(tree.bodies)
    named = {joint.name: identifier(joint.name) for joint in moving}
    for joint in moving:
        own = bodies[named[joint.name]]
        placed[joint.child] = own.without(lumped.body_on(joint.child, held_only=True))
        placed |= {link: Body() for link in lumped.fixed_on(joint.child)}
    joints = [
        replace(joint, limits=limits[named[joint.name]]) if joint.name in named else joint
        for joint in tree.joints
    ]
    return replace(tree, bodies=placed, joints=joints)
