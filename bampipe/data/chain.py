"""A chain of joints out of a tree of links, as the plain tables that a device file holds.

Bodies on fixed joints, and on joints beside the chain, are joined to the link that carries them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bampipe.data.robot_xml import DEEPEST
from bampipe.errors import InputError, did_you_mean
from bampipe.lists import join_names

Array = NDArray[np.float64]

_MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
_ROUNDING = 1e-6
"""Share of the largest second moment of mass by which one may be below zero."""
UPRIGHT = (0.0, 0.0, -9.81)
"""Gravity where nothing else is said, m/s2."""
_MANY = 8
"""Most names that a message lists."""


class Branches(InputError):
    """The joints of a robot branch.

    Attributes:
        stem: last link before they do; empty where they do at the base.
    """

    def __init__(
        self,
        what: str,
        *,
        where: str = "",
        remedy: str = "",
        others: Sequence[InputError] = (),
        stem: str = "",
    ) -> None:
        super().__init__(what, where=where, remedy=remedy, others=others)
        self.stem = stem


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
class Chain:
    """The moving joints between two links.

    Attributes:
        joints: by name, tables as of ``[robot.joints]``.
        limits: by name.
        base, tip: the links.
        notes: what was left out or joined, one sentence each.
        gravity: in the base's frame, m/s2; None where it is not known.
        gravity_note: where that is from, or why it is not known, if that is not plain.
    """

    joints: Mapping[str, dict[str, Any]]
    limits: Mapping[str, DriveLimits]
    base: str
    tip: str
    notes: tuple[str, ...]
    gravity: tuple[float, float, float] | None = None
    gravity_note: str = ""


@dataclass
class Body:
    """Mass, centre (3,) and inertia about it (3, 3), in the axes of a frame."""

    mass: float = 0.0
    center: Array = field(default_factory=lambda: np.zeros(3))
    inertia: Array = field(default_factory=lambda: np.zeros((3, 3)))

    def moved(self, turn: Array, offset: Array) -> Body:
        """The same body seen from a frame in which its own lies at ``offset``, ``turn``."""
        return Body(self.mass, turn @ self.center + offset, turn @ self.inertia @ turn.T)

    def joined(self, other: Body) -> Body:
        """Both as one."""
        mass = self.mass + other.mass
        if mass == 0.0:
            return Body(0.0, self.center, self.inertia + other.inertia)
        center = (self.mass * self.center + other.mass * other.center) / mass
        return Body(mass, center, self.about(center) + other.about(center))

    def without(self, other: Body) -> Body:
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
        return self.mass >= 0.0 and bool(moments[0] >= -_ROUNDING * abs(moments[2]))

    def table(self) -> dict[str, Any]:
        """As of a joint in a device file."""
        upper = [float(v) for v in self.inertia[np.triu_indices(3)]]
        return {"mass": self.mass, "center": [float(v) for v in self.center], "inertia": upper}


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
    """

    name: str
    kind: str
    parent: str
    child: str
    turn: Array
    offset: Array
    angles: tuple[float, float, float]
    axis: list[float]
    limits: DriveLimits


@dataclass(frozen=True)
class Tree:
    """Links and the joints between them, as a file has them.

    Attributes:
        bodies: by link, in its frame.
        joints: from a link to one behind it.
        notes: what of the file is not heard, one sentence each.
        gravity: in the frame of the link at the root, m/s2; None where the file says nothing.
    """

    bodies: Mapping[str, Body]
    joints: Sequence[TreeJoint]
    notes: tuple[str, ...] = ()
    gravity: tuple[float, float, float] | None = None


def select_chain(
    tree: Tree, base: str, tip: str, payload: Mapping[str, Any] | None, where: str
) -> Chain:
    """The chain of joints from ``base`` to ``tip``.

    Args:
        tree: what a file has.
        base: link that stands still; the root of the tree where empty.
        tip: last link; where empty, the only end of the tree.
        payload: ``mass``, ``center`` and ``inertia`` of a body held at the tip, in its frame.
        where: the file.

    Raises:
        InputError: a joint or link that is wrong, or no single chain between the links.
    """
    bodies, joints = dict(tree.bodies), list(tree.joints)
    for joint in joints:
        for end in (joint.parent, joint.child):
            if end not in bodies:
                raise InputError(
                    f"joint {joint.name!r} names link {end!r}, which is not there"
                    f"{did_you_mean(end, bodies)}",
                    where=where,
                )
        if joint.kind in _MOVING and not any(joint.axis):
            raise InputError("an axis of length zero", where=f"{where}: joint {joint.name!r}")
    above = {joint.child: joint for joint in joints}
    if len(above) < len(joints):
        twice = next(j for j in joints if above[j.child] is not j)
        raise InputError(
            f"link {twice.child!r} has two joints above it: a closed loop", where=where,
            remedy="cut the loop: leave one of the joints out",
        )  # fmt: skip
    _refuse_loops(above, where)
    base = _link(base, bodies, where) if base else _only_root(bodies, above, where)
    tip = _link(tip, bodies, where) if tip else _only_end(base, joints, above, where)
    path_up = _path(base, tip, above, where)
    if payload is not None:
        held = Body(
            float(payload["mass"]),
            np.array(payload.get("center", (0.0,) * 3), dtype=float),
            symmetric(payload.get("inertia", (0.0,) * 6)),
        )
        bodies[tip] = bodies[tip].joined(held)
    gravity, said = gravity_at(tree, base)
    found = _chain(base, tip, path_up, bodies, joints, where)
    return replace(found, notes=(*found.notes, *tree.notes), gravity=gravity, gravity_note=said)


def gravity_at(tree: Tree, base: str) -> tuple[tuple[float, float, float] | None, str]:
    """Gravity in the frame of a link, m/s2, and a clause where joints on the way to it turn it.

    The root of a URDF stands upright. None where that goes for the link as well, or where a joint
    above it can tilt it.
    """
    above = {joint.child: joint for joint in tree.joints}
    root, way = base, list[TreeJoint]()
    while root in above:
        way.insert(0, above[root])
        root = above[root].parent
    if not way:
        return tree.gravity, ""
    start = np.array(tree.gravity or UPRIGHT)
    down, least = start, _ROUNDING * float(np.linalg.norm(start))
    for joint in way:
        down = joint.turn.T @ down
        turns = joint.kind not in ("fixed", "prismatic")
        about_it = joint.kind in _MOVING and np.abs(np.cross(joint.axis, down)).max() <= least
        if turns and not about_it:
            return None, f"gravity taken along -z of {base}, which {joint.name} can tilt"
    if tree.gravity is None and np.abs(down - start).max() <= least:
        return None, ""
    x, y, z = (float(v) for v in np.where(np.abs(down) <= least, 0.0, down))
    said = f"gravity ({x:.4g}, {y:.4g}, {z:.4g}) m/s2 in the frame of {base}, from that of {root}"
    return (x, y, z), said


@dataclass(frozen=True)
class _Carriage:
    """What the links of a chain carry.

    Attributes:
        bodies: by link, in its frame; joints: all; moving: those of the chain that move.
    """

    bodies: Mapping[str, Body]
    joints: Sequence[TreeJoint]
    moving: Sequence[TreeJoint]

    @cached_property
    def _behind(self) -> Mapping[str, Sequence[TreeJoint]]:
        """By link, the joints on it that the chain does not move."""
        starts = {joint.child for joint in self.moving}
        found: dict[str, list[TreeJoint]] = {}
        for joint in self.joints:
            if joint.child not in starts:
                found.setdefault(joint.parent, []).append(joint)
        return found

    def body_on(self, link: str) -> Body:
        """The body of a link with all that is fixed to it or held still on it, in its frame."""
        total = self.bodies[link]
        for joint in self._behind.get(link, ()):
            total = total.joined(self.body_on(joint.child).moved(joint.turn, joint.offset))
        return total

    def held_on(self, link: str) -> Iterator[TreeJoint]:
        """The joints held still on a link and what is on it, of those that carry mass."""
        for joint in self._behind.get(link, ()):
            if joint.kind != "fixed" and self._mass_on(joint.child) > 0.0:
                yield joint
            yield from self.held_on(joint.child)

    def fixed_on(self, link: str) -> Iterator[str]:
        """The links fixed to a link, one on another."""
        for joint in self._behind.get(link, ()):
            if joint.kind == "fixed":
                yield joint.child
                yield from self.fixed_on(joint.child)

    def body_held_on(self, link: str) -> Body:
        """The part of `body_on` that is behind joints held still, in the frame of the link."""
        total = Body()
        for joint in self._behind.get(link, ()):
            fixed = joint.kind == "fixed"
            part = self.body_held_on(joint.child) if fixed else self.body_on(joint.child)
            total = total.joined(part.moved(joint.turn, joint.offset))
        return total

    def _mass_on(self, link: str) -> float:
        behind = self._behind.get(link, ())
        return self.bodies[link].mass + sum(self._mass_on(joint.child) for joint in behind)


def put_bodies(
    tree: Tree, base: str, tip: str, bodies: Mapping[str, Body], limits: Mapping[str, DriveLimits]
) -> Tree:
    """The tree with other bodies and limits on the joints of a chain, the same to its motion.

    What was joined to make the body of a joint is parted again: links on fixed joints get no mass,
    which is in that of the link behind the joint; those on joints that are held keep theirs, which
    is taken off there.

    Args:
        tree: from which the chain was selected.
        base, tip: of the chain.
        bodies, limits: by joint of the chain.
    """
    above = {joint.child: joint for joint in tree.joints}
    moving = [joint for joint in _path(base, tip, above, "") if joint.kind != "fixed"]
    carriage = _Carriage(tree.bodies, tree.joints, moving)
    placed = dict(tree.bodies)
    named = {joint.name: identifier(joint.name) for joint in moving}
    for joint in moving:
        own = bodies[named[joint.name]]
        placed[joint.child] = own.without(carriage.body_held_on(joint.child))
        placed |= {link: Body() for link in carriage.fixed_on(joint.child)}
    joints = [
        replace(joint, limits=limits[named[joint.name]]) if joint.name in named else joint
        for joint in tree.joints
    ]
    return replace(tree, bodies=placed, joints=joints)


def hold_beside(tree: Tree, base: str, tip: str) -> Tree:
    """The part of the tree on ``base``, fixed what does not move from there to ``tip``.

    Joints come parents first.
    """
    above = {joint.child: joint for joint in tree.joints}
    moving = {joint.child for joint in _path(base, tip, above, "")}
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
    bodies, joints = {"base": Body()}, []
    for name, table in tables.items():
        center = np.array(table.get("center", (0.0,) * 3), dtype=float)
        link, after = f"{name}_link", table.get("after")
        bodies[link] = Body(
            float(table.get("mass", 0.0)), center, symmetric(table.get("inertia", (0.0,) * 6))
        )
        roll, pitch, yaw = (float(v) for v in table.get("rotation", (0.0,) * 3))
        joints.append(
            TreeJoint(
                name,
                str(table["kind"]),
                f"{after}_link" if after else "base",
                link,
                Rotation.from_euler("xyz", (roll, pitch, yaw)).as_matrix(),
                np.array(table.get("position", (0.0,) * 3), dtype=float),
                (roll, pitch, yaw),
                [float(v) for v in table.get("axis", (0.0, 0.0, 1.0))],
                DriveLimits(),
            )
        )
    return Tree(bodies, joints)


def fixed_joint(name: str, parent: str, child: str, turn: Array, offset: Array) -> TreeJoint:
    """A joint that does not move, between two links."""
    roll, pitch, yaw = (float(v) for v in Rotation.from_matrix(turn).as_euler("xyz"))
    axis = [0.0, 0.0, 1.0]
    return TreeJoint(
        name, "fixed", parent, child, turn, offset, (roll, pitch, yaw), axis, DriveLimits()
    )


def _chain(
    base: str,
    tip: str,
    path_up: list[TreeJoint],
    bodies: Mapping[str, Body],
    joints: list[TreeJoint],
    where: str,
) -> Chain:
    moving = [joint for joint in path_up if joint.kind != "fixed"]
    if not moving:
        raise InputError(f"no joint moves between {base!r} and {tip!r}", where=where)
    carriage = _Carriage(bodies, joints, moving)
    found: dict[str, dict[str, Any]] = {}
    limits: dict[str, DriveLimits] = {}
    turn, offset, before = np.eye(3), np.zeros(3), ""
    fixed_between = False
    for joint in path_up:
        offset = offset + turn @ joint.offset
        turn = turn @ joint.turn
        if joint.kind == "fixed":
            fixed_between = True
            continue
        name = identifier(joint.name)
        if name in found:
            raise InputError(f"two joints are called {name!r}", where=where)
        angles = Rotation.from_matrix(turn).as_euler("xyz") if fixed_between else joint.angles
        table: dict[str, Any] = {
            "kind": _MOVING[joint.kind],
            "position": [float(v) for v in offset],
            "rotation": [float(v) for v in angles],
            "axis": joint.axis,
            "effort": max(joint.limits.effort, 0.0),
            "velocity": max(joint.limits.velocity, 0.0),
            **carriage.body_on(joint.child).table(),
        }
        found[name] = {"after": before, **table} if before else table
        limits[name] = joint.limits
        turn, offset, before, fixed_between = np.eye(3), np.zeros(3), name, False
    notes = []
    held = [joint.name for start in moving for joint in carriage.held_on(start.child)]
    if held:
        notes.append(f"held at zero beside the chain: {join_names(held, _MANY)}")
    return Chain(found, limits, base, tip, tuple(notes))


def identifier(name: str) -> str:
    """The joint's name as expressions can use it."""
    text = re.sub(r"\W", "_", name, flags=re.ASCII)
    return text if text[:1].isalpha() else f"joint_{text}"


def symmetric(six: Any) -> Array:
    """The matrix, (3, 3), of its upper triangle by rows."""
    xx, xy, xz, yy, yz, zz = (float(v) for v in six)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _link(name: str, bodies: Mapping[str, Body], where: str) -> str:
    if name not in bodies:
        raise InputError(f"no link {name!r}{did_you_mean(name, bodies)}", where=where)
    return name


def _refuse_loops(above: Mapping[str, TreeJoint], where: str) -> None:
    """Refuse links that hang on themselves, or too many one behind another."""
    depth: dict[str, int] = {}
    for first in above:
        path = [first]
        while path[-1] in above and path[-1] not in depth:
            parent = above[path[-1]].parent
            if parent in path:
                raise InputError(f"the joints above {parent!r} form a loop", where=where)
            if len(path) > DEEPEST:
                raise InputError(f"more than {DEEPEST} links one behind another", where=where)
            path.append(parent)
        reached = depth.get(path.pop(), 0)
        for link in reversed(path):
            reached += 1
            depth[link] = reached
        if reached > DEEPEST:
            raise InputError(f"more than {DEEPEST} links one behind another", where=where)


def _only_root(bodies: Mapping[str, Body], above: Mapping[str, TreeJoint], where: str) -> str:
    roots = [name for name in bodies if name not in above]
    if not roots:
        raise InputError("no links", where=where)
    if len(roots) != 1:
        raise InputError(
            f"{len(roots)} links have nothing above them: {join_names(roots, _MANY)}",
            where=where,
            remedy="name the one that stands still: base = ...",
        )
    return roots[0]


def _only_end(
    base: str, joints: list[TreeJoint], above: Mapping[str, TreeJoint], where: str
) -> str:
    """The last link of the only chain of moving joints from ``base``."""

    def moving(link: str) -> list[str]:
        found = []
        while link != base and link in above:
            if above[link].kind != "fixed":
                found.append(above[link].name)
            link = above[link].parent
        return found[::-1] if link == base else []

    chains = {joint.child: moving(joint.child) for joint in joints}
    longest = max(chains, key=lambda link: len(chains[link]), default="")
    ends = [
        link
        for link, names in chains.items()
        if names and above[link].kind != "fixed" and names != chains[longest][: len(names)]
    ]
    if not longest or not chains[longest]:
        raise InputError(f"no joint moves below {base!r}", where=where)
    if ends:
        others = [above[longest].child, *ends]
        levels = zip(*(chains[link] for link in others), strict=False)
        common = [level[0] for level in takewhile(lambda level: len(set(level)) == 1, levels)]
        stem = next((j.child for j in joints if common and j.name == common[-1]), "")
        raise Branches(
            f"the joints branch; chains end at {join_names(others, _MANY)}",
            where=where,
            remedy='choose one: base = "..." and tip = "..." in [robot]'
            + (f'; tip = "{stem}" ends before they branch' if stem else ""),
            stem=stem,
        )
    return longest


def _path(base: str, tip: str, above: Mapping[str, TreeJoint], where: str) -> list[TreeJoint]:
    """Joints from base to tip."""
    found: list[TreeJoint] = []
    link = tip
    while link != base:
        if link not in above:
            raise InputError(f"link {tip!r} does not hang on {base!r}", where=where)
        joint = above[link]
        if joint.kind not in (*_MOVING, "fixed"):
            raise InputError(
                f"a joint of type {joint.kind!r}",
                where=f"{where}: joint {joint.name!r}",
                remedy="between base and tip joints are revolute, continuous, prismatic or fixed",
            )
        found.append(joint)
        link = joint.parent
    return found[::-1]
