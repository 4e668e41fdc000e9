"""URDF files: what their links and joints say, and a robot written as one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bampipe.data.chain import Body, DriveLimits, Tree, TreeJoint, symmetric
from bampipe.data.robot_xml import document, number_list, numbers
from bampipe.errors import InputError

Array = NDArray[np.float64]

_XACRO = ("{http://www.ros.org/wiki/xacro", "{http://ros.org/wiki/xacro", "{http://ros.org/xacro")
_UNLIMITED = 1e6
"""Effort and velocity of a joint of which none is known: a URDF has some, and 0 is a limit."""


def urdf_tree(root: ElementTree.Element, path: Path) -> Tree:
    """The links and joints of a URDF.

    Raises:
        InputError: a xacro file, or a link or joint that is wrong.
    """
    where = str(path)
    parts = [root, *root.iterfind("link"), *root.iterfind("joint")]
    values = (value for part in parts for inner in part.iter() for value in inner.attrib.values())
    macros = any(str(element.tag).startswith(_XACRO) for element in root.iter())
    if macros or any("${" in value for value in values):
        raise InputError(
            "a xacro file: macros that are no URDF yet",
            where=where,
            remedy=f"expand it first: xacro {path.name} > {path.name.partition('.')[0]}.urdf",
        )
    bodies: dict[str, Body] = {}
    for link in root.iterfind("link"):
        name = _name(link, where)
        if name in bodies:
            raise InputError(f"two links are called {name!r}", where=where)
        bodies[name] = _body(link, where)
    return Tree(bodies, [_joint(entry, where) for entry in root.iterfind("joint")])


def _name(element: ElementTree.Element, where: str) -> str:
    name = element.get("name", "")
    if not name:
        raise InputError(f"a <{element.tag}> without a name", where=where)
    return name


def _pose(element: ElementTree.Element | None, where: str) -> tuple[Array, Array, list[float]]:
    angles = numbers(element, "rpy", "0 0 0", 3, where)
    offset = np.array(numbers(element, "xyz", "0 0 0", 3, where))
    return Rotation.from_euler("xyz", angles).as_matrix(), offset, angles


def _body(link: ElementTree.Element, where: str) -> Body:
    inertial = link.find("inertial")
    if inertial is None:
        return Body()
    place = f"{where}: link {link.get('name')!r}"
    turn, offset, _ = _pose(inertial.find("origin"), place)
    mass = numbers(inertial.find("mass"), "value", "0", 1, place)[0]
    entry = inertial.find("inertia")
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    moments = [numbers(entry, key, "0", 1, place)[0] for key in keys]
    return Body(mass, np.zeros(3), symmetric(moments)).moved(turn, offset)


def _joint(entry: ElementTree.Element, where: str) -> TreeJoint:
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
    axis = numbers(entry.find("axis"), "xyz", "1 0 0", 3, place)

    def number(tag: str, key: str) -> float:
        return numbers(entry.find(tag), key, "0", 1, place)[0]

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
    return TreeJoint(name, kind, ends[0], ends[1], turn, offset, shown, axis, limits)


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
    return document(robot, comment)
