"""A chain or tree of joints as a model file of MuJoCo (MJCF)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree import ElementTree

from scipy.spatial.transform import Rotation

from bampipe.data.urdf import DriveLimits, number_list

_KINDS = {"revolute": "hinge", "prismatic": "slide"}


def mjcf_text(
    name: str,
    joints: Mapping[str, Mapping[str, Any]],
    limits: Mapping[str, DriveLimits],
    armature: Mapping[str, float],
    gravity: Sequence[float],
    comment: str,
) -> str:
    """An MJCF of joints and bodies without shapes, one body and one motor a joint.

    Source: MuJoCo's documentation, XML reference.

    Args:
        name: of the robot.
        joints: by name, tables as of ``[robot.joints]``, the bodies' numbers in them.
        limits: by name: range, effort, damping and friction.
        armature: inertia of the drives at the joints, by name, kg.m2 or kg.
        gravity: in the base's frame, m/s2.
        comment: what to say at its head.
    """
    root = ElementTree.Element("mujoco", model=name)
    root.append(ElementTree.Comment(f" {comment.replace('--', '- -')} "))
    ElementTree.SubElement(root, "compiler", angle="radian", inertiafromgeom="false")
    ElementTree.SubElement(root, "option", gravity=number_list(gravity))
    bodies = {"": ElementTree.SubElement(root, "worldbody")}
    actuators = ElementTree.SubElement(root, "actuator")
    for joint, table in joints.items():
        x, y, z, w = Rotation.from_euler("xyz", table["rotation"]).as_quat()
        body = ElementTree.SubElement(
            bodies[table.get("after") or ""], "body", name=f"{joint}_link",
            pos=number_list(table["position"]), quat=number_list((w, x, y, z)),
        )  # fmt: skip
        bodies[joint] = body
        xx, xy, xz, yy, yz, zz = table["inertia"]
        ElementTree.SubElement(
            body, "inertial", pos=number_list(table["center"]),
            mass=number_list([table["mass"]]), fullinertia=number_list((xx, yy, zz, xy, xz, yz)),
        )  # fmt: skip
        own = limits[joint]
        moves = ElementTree.SubElement(
            body, "joint", name=joint, type=_KINDS[table["kind"]],
            axis=number_list(table["axis"]), damping=number_list([own.damping]),
            frictionloss=number_list([own.friction]), armature=number_list([armature[joint]]),
        )  # fmt: skip
        motor = ElementTree.SubElement(actuators, "motor", name=f"drive_{joint}", joint=joint)
        if own.lower < own.upper:
            moves.set("limited", "true")
            moves.set("range", number_list((own.lower, own.upper)))
        if own.effort > 0.0:
            motor.set("ctrllimited", "true")
            motor.set("ctrlrange", number_list((-own.effort, own.effort)))
    ElementTree.indent(root)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'
