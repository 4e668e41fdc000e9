"""A chain of joints out of a URDF file, as the plain tables that a device file holds.

Bodies on fixed joints, and on joints beside the chain, are joined to the link that carries them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bampipe.errors import InputError, did_you_mean
from bampipe.files import read_bytes
from bampipe.lists import join_names

Array = NDArray[np.float64]

LARGEST_BYTES = 20_000_000
_KINDS = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
_XACRO = ("{http://www.ros.org/wiki/xacro", "{http://ros.org/wiki/xacro", "{http://ros.org/xacro")
_UNLIMITED = 1e6
"""Effort and velocity of a joint of which none is known: a URDF has some, and 0 is a limit."""
_MANY = 8
"""Most names that a message lists."""


class Branches(InputError):
    """The joints of a URDF branch.

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
    """What a URDF says of a joint's drive; 0 where it says nothing.

    Attributes:
        lower, upper: range, rad or m; equal where there is none.
        effort: N.m or N; velocity: rad/s or m/s.
        damping: N.m.s/rad or N.s/m; friction: N.m or N.
    """

    lower: float = 0.0
    upper: float = 0.0
    effort: float = 0.0
    velocity: float = 0.0
    damping: float = 0.0
    friction: float = 0.0


@dataclass(frozen=True)
class Chain:
    """The moving joints between two links.

    Attributes:
        joints: by name, tables as of ``[robot.joints]``.
        limits: by name.
        base, tip: the links.
        notes: what was left out or joined, one sentence each.
    """

    joints: Mapping[str, dict[str, Any]]
    limits: Mapping[str, DriveLimits]
    base: str
    tip: str
    notes: tuple[str, ...]


@dataclass
class _Body:
    """Mass, centre (3,) and inertia about it (3, 3), in the axes of a frame."""

    mass: float = 0.0
    center: Array = field(default_factory=lambda: np.zeros(3))
    inertia: Array = field(default_factory=lambda: np.zeros((3, 3)))

    def moved(self, turn: Array, offset: Array) -> _Body:
        """The same body seen from a frame in which its own lies at ``offset``, ``turn``."""
        return _Body(self.mass, turn @ self.center + offset, turn @ self.inertia @ turn.T)

    def joined(self, other: _Body) -> _Body:
        """Both as one."""
        mass = self.mass + other.mass
        if mass == 0.0:
            return _Body(0.0, self.center, self.inertia + other.inertia)
        center = (self.mass * self.center + other.mass * other.center) / mass
        return _Body(mass, center, self.about(center) + other.about(center))

    def about(self, point: Array) -> Array:
        """Inertia about a point, (3, 3)."""
        r = self.center - point
        return self.inertia + self.mass * ((r @ r) * np.eye(3) - np.outer(r, r))

    def table(self) -> dict[str, Any]:
        """As of a joint in a device file."""
        upper = [float(v) for v in self.inertia[np.triu_indices(3)]]
        return {"mass": self.mass, "center": [float(v) for v in self.center], "inertia": upper}


@dataclass(frozen=True)
class _Joint:
    name: str
    kind: str
    parent: str
    child: str
    turn: Array
    offset: Array
    angles: tuple[float, float, float]
    axis: list[float]
    limits: DriveLimits


def read_chain(
    path: Path, base: str = "", tip: str = "", payload: Mapping[str, Any] | None = None
) -> Chain:
    """Read the chain of joints from ``base`` to ``tip``.

    Args:
        path: the URDF file.
        base: link that stands still; the root of the file where empty.
        tip: last link; where empty, the only end of the file.
        payload: ``mass``, ``center`` and ``inertia`` of a body held at the tip, in its frame.

    Raises:
        InputError: no URDF, a link or joint that is wrong, or no single chain between the links.
    """
    where = str(path)
    root = _parse(path)
    bodies = {_name(link, where): _body(link, where) for link in root.iterfind("link")}
    joints = [_joint(entry, where) for entry in root.iterfind("joint")]
    for joint in joints:
        for end in (joint.parent, joint.child):
            if end not in bodies:
                raise InputError(
                    f"joint {joint.name!r} names link {end!r}, which is not there"
                    f"{did_you_mean(end, bodies)}",
                    where=where,
                )
    above = {joint.child: joint for joint in joints}
    if len(above) < len(joints):
        twice = next(j for j in joints if above[j.child] is not j)
        raise InputError(
            f"link {twice.child!r} has two joints above it: a closed loop", where=where,
            remedy="cut the loop: leave one of the joints out",
        )  # fmt: skip
    base = _link(base, bodies, where) if base else _only_root(bodies, above, where)
    tip = _link(tip, bodies, where) if tip else _only_end(base, joints, above, where)
    path_up = _path(base, tip, above, where)
    if payload is not None:
        held = _Body(
            float(payload["mass"]),
            np.array(payload.get("center", (0.0,) * 3), dtype=float),
            _symmetric(payload.get("inertia", (0.0,) * 6)),
        )
        bodies[tip] = bodies[tip].joined(held)
    return _chain(base, tip, path_up, bodies, joints, where)


def _chain(
    base: str,
    tip: str,
    path_up: list[_Joint],
    bodies: Mapping[str, _Body],
    joints: list[_Joint],
    where: str,
) -> Chain:
    below: dict[str, list[_Joint]] = {}
    for joint in joints:
        below.setdefault(joint.parent, []).append(joint)
    moving = [joint for joint in path_up if joint.kind != "fixed"]
    if not moving:
        raise InputError(f"no joint moves between {base!r} and {tip!r}", where=where)
    starts = {joint.child for joint in moving}
    held: list[str] = []

    def carried(link: str) -> _Body:
        """The body of a link with all that is fixed to it or held still on it."""
        total = bodies[link]
        for joint in below.get(link, ()):
            if joint.child in starts:
                continue
            if joint.kind != "fixed" and bodies_below(joint.child) > 0.0:
                held.append(joint.name)
            part = carried(joint.child)
            total = total.joined(part.moved(joint.turn, joint.offset))
        return total

    def bodies_below(link: str) -> float:
        own = bodies[link].mass
        return own + sum(bodies_below(joint.child) for joint in below.get(link, ()))

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
        name = _identifier(joint.name)
        if name in found:
            raise InputError(f"two joints are called {name!r}", where=where)
        angles = Rotation.from_matrix(turn).as_euler("xyz") if fixed_between else joint.angles
        table: dict[str, Any] = {
            "kind": _KINDS[joint.kind],
            "position": [float(v) for v in offset],
            "rotation": [float(v) for v in angles],
            "axis": joint.axis,
            "effort": max(joint.limits.effort, 0.0),
            "velocity": max(joint.limits.velocity, 0.0),
            **carried(joint.child).table(),
        }
        found[name] = {"after": before, **table} if before else table
        limits[name] = joint.limits
        turn, offset, before, fixed_between = np.eye(3), np.zeros(3), name, False
    notes = []
    if held:
        notes.append(f"held at zero beside the chain: {join_names(held, _MANY)}")
    return Chain(found, limits, base, tip, tuple(notes))


def _parse(path: Path) -> ElementTree.Element:
    where = str(path)
    text = read_bytes(path, LARGEST_BYTES)
    if b"<!ENTITY" in text or b"<!DOCTYPE" in text:
        raise InputError("a URDF has no document type or entities", where=where)
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        line = error.position[0]
        raise InputError(
            f"not XML: {str(error).partition(':')[0]}", where=f"{where}, line {line}"
        ) from error
    parts = [root, *root.iterfind("link"), *root.iterfind("joint")]
    values = (value for part in parts for inner in part.iter() for value in inner.attrib.values())
    macros = any(str(element.tag).startswith(_XACRO) for element in root.iter())
    if macros or any("${" in value for value in values):
        raise InputError(
            "a xacro file: macros that are no URDF yet",
            where=where,
            remedy=f"expand it first: xacro {path.name} > {path.name.partition('.')[0]}.urdf",
        )
    if root.tag != "robot":
        raise InputError(f"found <{root.tag}>, expected <robot>", where=where)
    return root


def _name(element: ElementTree.Element, where: str) -> str:
    name = element.get("name", "")
    if not name:
        raise InputError(f"a <{element.tag}> without a name", where=where)
    return name


def _identifier(name: str) -> str:
    """The joint's name as expressions can use it."""
    text = re.sub(r"\W", "_", name, flags=re.ASCII)
    return text if text[:1].isalpha() else f"joint_{text}"


def _numbers(
    element: ElementTree.Element | None, key: str, default: str, count: int, where: str
) -> list[float]:
    text = default if element is None else element.get(key, default)
    try:
        found = [float(part) for part in text.split()]
    except ValueError:
        found = []
    if len(found) != count or not all(map(math.isfinite, found)):
        tag = "" if element is None else f"<{element.tag} {key}>: "
        expected = "a number" if count == 1 else f"{count} numbers"
        raise InputError(f'{tag}found "{text}", expected {expected}', where=where)
    return found


def _pose(element: ElementTree.Element | None, where: str) -> tuple[Array, Array, list[float]]:
    angles = _numbers(element, "rpy", "0 0 0", 3, where)
    offset = np.array(_numbers(element, "xyz", "0 0 0", 3, where))
    return Rotation.from_euler("xyz", angles).as_matrix(), offset, angles


def _body(link: ElementTree.Element, where: str) -> _Body:
    inertial = link.find("inertial")
    if inertial is None:
        return _Body()
    place = f"{where}: link {link.get('name')!r}"
    turn, offset, _ = _pose(inertial.find("origin"), place)
    mass = _numbers(inertial.find("mass"), "value", "0", 1, place)[0]
    entry = inertial.find("inertia")
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    moments = [_numbers(entry, key, "0", 1, place)[0] for key in keys]
    return _Body(mass, np.zeros(3), _symmetric(moments)).moved(turn, offset)


def _symmetric(six: Any) -> Array:
    xx, xy, xz, yy, yz, zz = (float(v) for v in six)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _joint(entry: ElementTree.Element, where: str) -> _Joint:
    name = _name(entry, where)
    place = f"{where}: joint {name!r}"
    ends = []
    for tag in ("parent", "child"):
        element = entry.find(tag)
        if element is None or not element.get("link"):
            raise InputError(f"no <{tag} link>", where=place)
        ends.append(str(element.get("link")))
    turn, offset, angles = _pose(entry.find("origin"), place)
    kind = entry.get("type", "")
    axis = _numbers(entry.find("axis"), "xyz", "1 0 0", 3, place)
    if kind in _KINDS and not any(axis):
        raise InputError("an axis of length zero", where=place)

    def number(tag: str, key: str) -> float:
        return _numbers(entry.find(tag), key, "0", 1, place)[0]

    bounded = kind != "continuous"
    limits = DriveLimits(
        number("limit", "lower") if bounded else 0.0,
        number("limit", "upper") if bounded else 0.0,
        number("limit", "effort"),
        number("limit", "velocity"),
        number("dynamics", "damping"),
        number("dynamics", "friction"),
    )
    shown = (angles[0], angles[1], angles[2])
    return _Joint(name, kind, ends[0], ends[1], turn, offset, shown, axis, limits)


def _link(name: str, bodies: Mapping[str, _Body], where: str) -> str:
    if name not in bodies:
        raise InputError(f"no link {name!r}{did_you_mean(name, bodies)}", where=where)
    return name


def _only_root(bodies: Mapping[str, _Body], above: Mapping[str, _Joint], where: str) -> str:
    roots = [name for name in bodies if name not in above]
    if len(roots) != 1:
        raise InputError(
            f"{len(roots)} links have nothing above them: {join_names(roots, _MANY)}",
            where=where,
            remedy="name the one that stands still: base = ...",
        )
    return roots[0]


def _only_end(base: str, joints: list[_Joint], above: Mapping[str, _Joint], where: str) -> str:
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
        raise Branches(
            f"the joints branch; chains end at {join_names(others, _MANY)}",
            where=where,
            remedy='choose one: base = "..." and tip = "..." in [robot]',
            stem=next((j.child for j in joints if common and j.name == common[-1]), ""),
        )
    return longest


def _path(base: str, tip: str, above: Mapping[str, _Joint], where: str) -> list[_Joint]:
    """Joints from base to tip."""
    found: list[_Joint] = []
    link = tip
    while link != base:
        if link not in above:
            raise InputError(f"link {tip!r} does not hang on {base!r}", where=where)
        joint = above[link]
        if joint.kind not in (*_KINDS, "fixed"):
            raise InputError(
                f"a joint of type {joint.kind!r}",
                where=f"{where}: joint {joint.name!r}",
                remedy="between base and tip joints are revolute, continuous, prismatic or fixed",
            )
        found.append(joint)
        link = joint.parent
        if len(found) > len(above):
            raise InputError(f"the joints above {tip!r} form a loop", where=where)
    return found[::-1]


def urdf_text(
    name: str,
    joints: Mapping[str, Mapping[str, Any]],
    limits: Mapping[str, DriveLimits],
    comment: str = "",
) -> str:
    """A URDF of joints and bodies, one link a joint, without shapes.

    Args:
        name: of the robot.
        joints: by name, tables as of ``[robot.joints]``, the bodies' numbers in them.
        limits: by name: range, effort, velocity, damping and friction.
        comment: what to say at its head.
    """
    robot = ElementTree.Element("robot", name=name)
    if comment:
        robot.append(ElementTree.Comment(f" {comment.replace('--', '- -')} "))
    ElementTree.SubElement(robot, "link", name="base")
    for joint, table in joints.items():
        link = ElementTree.SubElement(robot, "link", name=f"{joint}_link")
        inertial = ElementTree.SubElement(link, "inertial")
        ElementTree.SubElement(inertial, "origin", xyz=number_list(table["center"]), rpy="0 0 0")
        ElementTree.SubElement(inertial, "mass", value=repr(float(table["mass"])))
        keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        moments = {k: repr(float(v)) for k, v in zip(keys, table["inertia"], strict=True)}
        ElementTree.SubElement(inertial, "inertia", moments)
        own = limits[joint]
        bounded = own.lower < own.upper
        kind = str(table["kind"])
        if kind == "revolute" and not bounded:
            kind = "continuous"
        entry = ElementTree.SubElement(robot, "joint", name=joint, type=kind)
        ElementTree.SubElement(
            entry, "origin", xyz=number_list(table["position"]), rpy=number_list(table["rotation"])
        )
        after = table.get("after")
        ElementTree.SubElement(entry, "parent", link=f"{after}_link" if after else "base")
        ElementTree.SubElement(entry, "child", link=f"{joint}_link")
        ElementTree.SubElement(entry, "axis", xyz=number_list(table["axis"]))
        ElementTree.SubElement(
            entry, "limit", lower=repr(own.lower), upper=repr(own.upper),
            effort=repr(own.effort or _UNLIMITED), velocity=repr(own.velocity or _UNLIMITED),
        )  # fmt: skip
        ElementTree.SubElement(
            entry, "dynamics", damping=repr(own.damping), friction=repr(own.friction)
        )
    ElementTree.indent(robot)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(robot, encoding="unicode")}\n'


def number_list(values: Iterable[float]) -> str:
    """Numbers as an attribute of XML holds them."""
    return " ".join(repr(float(v)) for v in values)
