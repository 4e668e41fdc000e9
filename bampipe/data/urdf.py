"""URDF files: what their links and joints say, and a robot written as one."""

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from bampipe.arrays import Array
from bampipe.data.refusals import refusal
from bampipe.data.robot_tree import Body, DriveLimits, Tree, TreeJoint, symmetric
from bampipe.data.robot_xml import Attribute, assign, document, number, numbers, put, read_xml
from bampipe.errors import InputError, located

_XACRO = ("{http://www.ros.org/wiki/xacro", "{http://ros.org/wiki/xacro", "{http://ros.org/xacro")
_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_UNLIMITED = 1e6
"""Effort and velocity of a joint of which none is known: a URDF has some, and 0 is a limit."""


def urdf_tree(root: Element, path: Path) -> Tree:
    """The links and joints of a URDF.

    Raises:
        InputError: a xacro file, or a link or joint that is wrong.
    """
    parts = [root, *root.iterfind("link"), *root.iterfind("joint")]
    values = (value for part in parts for inner in part.iter() for value in inner.attrib.values())
    macros = any(str(element.tag).startswith(_XACRO) for element in root.iter())
    if macros or any("${" in value for value in values):
        raise unexpanded(path)
    bodies: dict[str, Body] = {}
    for link in root.iterfind("link"):
        name = _name(link)
        if name in bodies:
            raise InputError(f"two links are called {name!r}")
        with located(f"link {name!r}", ": "):
            bodies[name] = _body(link)
    joints = []
    for entry in root.iterfind("joint"):
        with located(f"joint {_name(entry)!r}", ": "):
            joints.append(_joint(entry))
    return Tree(bodies, joints)


def unexpanded(path: Path) -> InputError:
    """The error that a file is written in macros."""
    stem = path.name.partition(".")[0]
    return refusal("xacro", str(path), name=path.name, stem=stem)


def _name(element: Element) -> str:
    name = element.get("name", "")
    if not name:
        raise InputError(f"a <{element.tag}> without a name")
    return name


def _pose(element: Element | None) -> tuple[Array, Array, list[float]]:
    angles = numbers(element, "rpy", "0 0 0", 3)
    offset = np.array(numbers(element, "xyz", "0 0 0", 3))
    return Rotation.from_euler("xyz", angles).as_matrix(), offset, angles


def _body(link: Element) -> Body:
    inertial = link.find("inertial")
    if inertial is None:
        return Body()
    turn, offset, _ = _pose(inertial.find("origin"))
    mass = number(inertial.find("mass"), "value")
    moments = [number(inertial.find("inertia"), key) for key in _MOMENTS]
    return Body(mass, np.zeros(3), symmetric(moments)).moved(turn, offset)


def _joint(entry: Element) -> TreeJoint:
    ends = []
    for tag in ("parent", "child"):
        element = entry.find(tag)
        if element is None or not element.get("link"):
            raise InputError(f"no <{tag} link>")
        ends.append(str(element.get("link")))
    parent, child = ends
    frame = _pose(entry.find("origin"))
    kind = entry.get("type", "")
    axis = numbers(entry.find("axis"), "xyz", "1 0 0", 3)
    limit, losses = entry.find("limit"), entry.find("dynamics")
    ends_at = (
        (0.0, 0.0) if kind == "continuous" else (number(limit, "lower"), number(limit, "upper"))
    )
    drive = (number(limit, "effort"), number(limit, "velocity"))
    limits = DriveLimits(*ends_at, *drive, number(losses, "damping"), number(losses, "friction"))
    mimic = None
    follows = entry.find("mimic")
    if follows is not None and follows.get("joint"):
        ratio = number(follows, "multiplier", "1")
        mimic = str(follows.get("joint")), ratio, number(follows, "offset")
    return TreeJoint(_name(entry), kind, parent, child, *frame, axis, limits, mimic)


def urdf_text(name: str, tree: Tree, comment: str) -> str:
    """A URDF of links and joints, without shapes; ``comment`` is said at its head."""
    robot = Element("robot", name=name)
    for link, body in tree.bodies.items():
        _put_inertial(put(robot, "link", name=link), body)
    for joint in tree.joints:
        own = joint.limits
        moves, bounded = joint.kind != "fixed", own.lower < own.upper
        kind = "continuous" if joint.kind == "revolute" and not bounded else joint.kind
        entry = put(robot, "joint", name=joint.name, type=kind)
        put(entry, "origin", xyz=joint.offset, rpy=joint.angles)
        put(entry, "parent", link=joint.parent)
        put(entry, "child", link=joint.child)
        if moves:
            put(entry, "axis", xyz=joint.axis)
            most = {"effort": own.effort or _UNLIMITED, "velocity": own.velocity or _UNLIMITED}
            put(entry, "limit", lower=own.lower, upper=own.upper, **most)
            _enter(entry, "dynamics", damping=own.damping, friction=own.friction)
            if joint.mimic is not None:
                other, ratio, zero = joint.mimic
                put(entry, "mimic", joint=other, multiplier=ratio, offset=zero)
    return document(robot, comment)


def changed_urdf(path: Path, before: Tree, after: Tree, comment: str) -> str:
    """The text of a URDF with other bodies and losses than it was read with, all else as it is.

    Raises:
        InputError: the file cannot be read.
    """
    robot = read_xml(path, to_write=True)
    for link in robot.iterfind("link"):
        name = str(link.get("name"))
        if after.bodies[name] is not before.bodies[name]:
            _put_inertial(link, after.bodies[name])
    for entry, old, new in zip(robot.iterfind("joint"), before.joints, after.joints, strict=True):
        if (own := new.limits) is not old.limits:
            _enter(entry, "dynamics", damping=own.damping, friction=own.friction)
    return document(robot, comment, indented=False)


def _put_inertial(link: Element, body: Body) -> None:
    """Give a link the mass of a body, and none where that has none."""
    inertial = link.find("inertial")
    if body.mass == 0.0 and not body.inertia.any():
        if inertial is not None:
            link.remove(inertial)
        return
    if inertial is None:
        inertial = put(link, "inertial")
        inertial.tail = "\n"
    _enter(inertial, "origin", xyz=body.center, rpy="0 0 0")
    _enter(inertial, "mass", value=body.mass)
    moments = zip(_MOMENTS, body.inertia[np.triu_indices(3)], strict=True)
    _enter(inertial, "inertia", **dict(moments))


def _enter(element: Element, tag: str, **attributes: Attribute) -> None:
    """Give the inner element of a tag attributes; a new one where there is none."""
    found = element.find(tag)
    assign(put(element, tag) if found is None else found, **attributes)
