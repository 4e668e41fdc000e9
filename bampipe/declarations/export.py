"""An identified model in forms that other programs read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from bampipe.data.chain import Body, DriveLimits, symmetric
from bampipe.data.mjcf import mjcf_text
from bampipe.data.run_folder import RunFolder
from bampipe.data.urdf import urdf_text
from bampipe.declarations.model_file import identified, load_model
from bampipe.errors import InputError
from bampipe.files import json_text
from bampipe.physics import System, compile_model
from bampipe.physics.newton_euler import INERTIAL
from bampipe.physics.portable import portable_source
from bampipe.physics.robot import Robot
from bampipe.results.identify import IdentifyResult

Array = NDArray[np.float64]
Form = Literal["json", "urdf", "mjcf", "python", "c"]
FORMS: tuple[Form, ...] = get_args(Form)


def export_model(run: RunFolder, name: str, form: Form) -> str:
    """Return the model called ``name`` of a run folder as text.

    Args:
        run: the run folder; name: of the model.
        form: json, device, parameters and uncertainties; urdf, the bodies and joint friction of a
            robot; mjcf, these and the inertia of its drives, for MuJoCo; python or c, a
            self-contained function of inverse dynamics.

    Raises:
        InputError: the model is not identified, or cannot be written in this form.
    """
    system = compile_model(load_model(run, name))
    p = identified(run, name, system)
    writers: dict[Form, Callable[[], str]] = {
        "json": lambda: _json(run, name, system, p),
        "urdf": lambda: _urdf(run, system, p),
        "mjcf": lambda: _mjcf(run, system, p),
        "python": lambda: portable_source(system.model, p, "python"),
        "c": lambda: portable_source(system.model, p, "c"),
    }
    return writers[form]()


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
    _, joints, limits = _bodies_on_joints(run, system, p)
    comment = _head(system, ["drives' inertia"])
    return urdf_text(system.model.device.name, joints, limits, comment)


def _mjcf(run: RunFolder, system: System, p: Array) -> str:
    robot, joints, limits = _bodies_on_joints(run, system, p)
    # What is left of the inertia when no body has any is the drives'.
    without = p.copy()
    inertial = {item.name for item in robot.parameters}
    without[[item.name in inertial for item in system.parameters]] = 0.0
    (drives,) = system.mass_matrix(np.zeros((1, len(joints))), without)
    limits = {
        joint: replace(limits[joint], armature=float(own))
        for joint, own in zip(system.coordinates, np.diag(drives), strict=True)
    }
    coupled = np.any(np.abs(drives - np.diag(np.diag(drives))) > 0.0)
    comment = _head(system, ["inertia by which drives couple joints"] if coupled else [])
    gravity = [float(v) for v in robot.gravity]
    return mjcf_text(system.model.device.name, joints, limits, gravity, comment)


def _head(system: System, lacks: Sequence[str]) -> str:
    """Where a model comes from and what of it is not in the text."""
    lacks = [*lacks, *(item.name for item in system.model.effects)]
    return "identified by bampipe" + (f"; not in it: {', '.join(lacks)}" if lacks else "")


def _bodies_on_joints(
    run: RunFolder, system: System, p: Array
) -> tuple[Robot, dict[str, dict[str, Any]], dict[str, DriveLimits]]:
    """The robot, tables of its joints with identified bodies, and limits with their friction.

    Raises:
        InputError: the device is no robot.
    """
    device = system.model.device
    robot = device.robot
    if robot is None:
        others = (f for f in FORMS if f not in ("urdf", "mjcf"))
        raise InputError(
            f"device {device.name!r} is no robot: it has no bodies on joints",
            where=str(run.root),
            remedy=f"choose another form: {', '.join(others)}",
        )
    value = {item.name: float(p[i]) for i, item in enumerate(system.parameters)}
    joints, limits = {}, {}
    for joint, declared in zip(
        robot.joints, device.declaration["robot"]["joints"].values(), strict=True
    ):
        numbers = np.array(
            [value[q.name] for q in robot.parameters if q.name.endswith(f".{joint.name}")]
        )
        assert numbers.size == INERTIAL
        joints[joint.name] = {**_BARE, **declared, **_body(numbers)}
        lower, upper = device.limits.get(joint.name, (0.0, 0.0))
        limits[joint.name] = DriveLimits(
            lower,
            upper,
            joint.effort,
            joint.velocity,
            damping=max(value.get(f"viscous.{joint.name}", 0.0), 0.0),
            friction=max(value.get(f"coulomb.{joint.name}", 0.0), 0.0),
        )
    return robot, joints, limits


_BARE: Mapping[str, Any] = {
    "position": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0), "axis": (0.0, 0.0, 1.0),
}  # fmt: skip


def _body(numbers: Array) -> dict[str, Any]:
    """Mass, centre and inertia about it, of the ten numbers about the joint."""
    mass = float(numbers[0])
    center = numbers[1:4] / mass if mass != 0.0 else np.zeros(3)
    inertia = symmetric(numbers[4:]) - Body(mass, center).about(np.zeros(3))
    return Body(mass, center, inertia).table()
