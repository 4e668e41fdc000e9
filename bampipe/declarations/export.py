"""Export of an identified model to formats that other programs read."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from bampipe.arrays import Array
from bampipe.data.chain import read_tree
from bampipe.data.device_file import tree_of_robot
from bampipe.data.mjcf import mjcf_text
from bampipe.data.robot_tree import (
    UPRIGHT,
    Body,
    DriveLimits,
    Tree,
    gravity_at,
    hold_beside,
    identifier,
    put_bodies,
    symmetric,
)
from bampipe.data.robot_xml import number_list, read_xml
from bampipe.data.run_folder import RunFolder
from bampipe.data.urdf import changed_urdf, urdf_text
from bampipe.declarations.mjcf_effects import add_effects
from bampipe.declarations.model_file import load_model, read_estimate
from bampipe.declarations.recording import DRAWING
from bampipe.errors import InputError
from bampipe.files import json_text
from bampipe.lists import join_names
from bampipe.physics import System, compile_model
from bampipe.physics.portable import portable_source
from bampipe.physics.robot import INERTIAL_NAMES, Robot
from bampipe.results.identify import IdentifyResult

Form = Literal["json", "urdf", "mjcf", "python", "c"]
FORMS: tuple[Form, ...] = get_args(Form)


def export_model(run: RunFolder, name: str, form: Form) -> str:
    """Return the model called ``name`` of a run folder as text.

    ``form`` is json for device, parameters and uncertainties; urdf for the robot's own URDF with
    identified bodies and joint friction; mjcf for these and the drives' inertia, for MuJoCo; python
    or c for a self-contained function of inverse dynamics.

    Raises:
        InputError: the model is not identified, or cannot be written in this form.
    """
    system = compile_model(load_model(run, name))
    p = read_estimate(run, name, system)
    if form == "python" or form == "c":
        return portable_source(system.model, p, form)
    if form == "json":
        return _json(run, name, system, p)
    return _urdf(run, system, p) if form == "urdf" else _mjcf(run, system, p)


def _json(run: RunFolder, name: str, system: System, p: Array) -> str:
    found = run.read(IdentifyResult, name)
    sd = {key: entry.sd for key, entry in found.parameters.items()}
    content: dict[str, Any] = {
        "model": name,
        "device": dict(system.model.device.declaration),
        "effects": [dict(item.effect.declaration) for item in system.model.effects],
        "bound": [item.name for item in system.model.effects],
        "parameters": {
            item.name: {"value": float(p[i]), "sd": sd.get(item.name), "unit": item.unit}
            for i, item in enumerate(system.parameters)
        },
    }
    if found.base_parameters is not None:
        content["base_parameters"] = [vars(entry) for entry in found.base_parameters]
    return json_text(content)


def _urdf(run: RunFolder, system: System, p: Array) -> str:
    tree, robot = _identify_tree(run, system, p), _robot(run, system)
    drives = _drive_inertia(system, p)
    shown = ", ".join(
        f"{joint} {own:.6g}" for joint, own in zip(system.coordinates, np.diag(drives), strict=True)
    )
    lacks = [f"drives' inertia at their joints, kg.m2 or kg ({shown})"] if drives.any() else []
    said = gravity_at(tree.before, tree.base)[0] if tree.urdf is not None else None
    if not np.allclose(robot.gravity, said or UPRIGHT):
        lacks.append(f"gravity in the frame of {tree.base} ({number_list(robot.gravity)})")
    # Motors that move several joints couple them, which a URDF cannot express.
    if np.any(drives != np.diag(np.diag(drives))):
        lacks.append("inertia by which drives couple joints")
    if shared := [name for name, motor in robot.motors.items() if len(motor.turns) > 1]:
        lacks.append(f"friction of motors of several joints ({', '.join(shared)})")
    comment = _head(tree, [*lacks, *(item.name for item in system.model.effects)])
    if tree.urdf is not None:
        return changed_urdf(tree.urdf, tree.before, tree.after, comment)
    return urdf_text(system.model.device.name, tree.flat, comment)


def _mjcf(run: RunFolder, system: System, p: Array) -> str:
    tree, robot = _identify_tree(run, system, p), _robot(run, system)
    names = {identifier(joint.name): joint.name for joint in tree.flat.joints}
    drives = np.diag(_drive_inertia(system, p))
    add, lacks = add_effects(system, p, robot, names, drives)
    comment = _head(tree, lacks)
    return mjcf_text(system.model.device.name, tree.flat, robot.gravity, comment, add)


def _head(tree: "_IdentifiedTree", lacks: Sequence[str]) -> str:
    """Describe the origin of a model, moved masses, and the parts that the text lacks."""
    parts = ["identified by bampipe", *tree.notes]
    return "; ".join([*parts, f"not in it: {', '.join(lacks)}"] if lacks else parts)


@dataclass(frozen=True)
class _IdentifiedTree:
    """A robot's links and joints, as drawn and as identified.

    Attributes:
        urdf: copy of the drawing in the run folder; None if there is none, or it is no URDF.
        before, after: all links and joints, as drawn and as identified.
        flat: the part of ``after`` in the model: on the base, with joints beside the chain fixed.
        base: link that stands still.
        notes: masses that are not where the drawing has them, one clause each.
    """

    urdf: Path | None
    before: Tree
    after: Tree
    flat: Tree
    base: str
    notes: tuple[str, ...]


def _identify_tree(run: RunFolder, system: System, p: Array) -> _IdentifiedTree:
    robot = _robot(run, system)
    bodies, limits = _identified_joints(robot, system, p)
    if not run.exists(DRAWING):
        table = dict(system.model.device.declaration["robot"])
        before = tree_of_robot(table)
        links = {f"{joint}_link": body for joint, body in bodies.items()}
        joints = [replace(j, limits=limits.get(j.name, j.limits)) for j in before.joints]
        after = replace(before, bodies={**before.bodies, **links}, joints=joints)
        return _IdentifiedTree(None, before, after, after, "base", ())
    file = run.path(DRAWING)
    before = read_tree(file)
    after = put_bodies(before, robot.base, robot.tip, bodies, limits)
    notes = []
    emptied = [
        link
        for link, body in after.bodies.items()
        if before.bodies[link].mass != 0.0 and body.mass == 0.0 and not body.inertia.any()
    ]
    if emptied:
        notes.append(f"masses fixed to a link are part of that link, not of {join_names(emptied)}")
    if robot.payload is not None:
        notes.append(f"the payload of {robot.payload.mass:g} kg is in the last link that moves")
    # Links that become impossible once the drawn bodies beside the chain are subtracted.
    child_of = {identifier(joint.name): joint.child for joint in after.joints}
    possible = (child_of[joint] for joint, body in bodies.items() if body.is_possible)
    if overdrawn := [link for link in possible if not after.bodies[link].is_possible]:
        notes.append(
            f"no possible body remains for {join_names(overdrawn)}: the bodies beside the chain"
            " there are drawn too heavy"
        )
    urdf = file if read_xml(file).tag == "robot" else None
    flat = hold_beside(after, robot.base, robot.tip)
    return _IdentifiedTree(urdf, before, after, flat, robot.base, tuple(notes))


def _drive_inertia(system: System, p: Array) -> Array:
    """Mass matrix without the inertia of any body, (n, n)."""
    robot = system.model.device.robot
    assert robot is not None
    without = p.copy()
    inertial = {item.name for item in robot.parameters}
    without[[item.name in inertial for item in system.parameters]] = 0.0
    (drives,) = system.mass_matrix(np.zeros((1, len(system.coordinates))), without)
    return np.asarray(drives)


def _robot(run: RunFolder, system: System) -> Robot:
    """Return the robot of a device; raise `InputError` if the device is not a robot."""
    device = system.model.device
    if device.robot is None:
        others = (f for f in FORMS if f not in ("urdf", "mjcf"))
        raise InputError(
            f"device {device.name!r} is not a robot: it has no bodies on joints",
            where=str(run.root),
            remedy=f"choose another form: {', '.join(others)}",
        )
    return device.robot


def _identified_joints(
    robot: Robot, system: System, p: Array
) -> tuple[dict[str, Body], dict[str, DriveLimits]]:
    """Return bodies by joint, and limits, friction and inertia of the joints' drives."""
    value = system.by_name(p)
    drives = dict(zip(system.coordinates, np.diag(_drive_inertia(system, p)), strict=True))
    bodies, limits = {}, {}
    for joint in robot.joints:
        # Mass, centre and central inertia from the ten numbers about the joint.
        numbers = np.array([value[f"{name}.{joint.name}"] for name in INERTIAL_NAMES])
        mass = float(numbers[0])
        center = numbers[1:4] / mass if mass != 0.0 else np.zeros(3)
        inertia = symmetric(numbers[4:]) - Body(mass, center).about(np.zeros(3))
        bodies[joint.name] = Body(mass, center, inertia)
        lower, upper = system.model.device.limits.get(joint.name, (0.0, 0.0))
        limits[joint.name] = DriveLimits(
            lower,
            upper,
            joint.effort,
            joint.velocity,
            damping=max(value.get(f"viscous.{joint.name}", 0.0), 0.0),
            friction=max(value.get(f"coulomb.{joint.name}", 0.0), 0.0),
            armature=float(drives.get(joint.name, 0.0)),
        )
    return bodies, limits
