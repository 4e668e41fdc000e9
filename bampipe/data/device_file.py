"""A device file as its table, complete: of a robot, the URDF is read and what follows filled in.

A robot needs no more than ``[robot] urdf = "arm.urdf"``. Coordinates, inputs, friction and limits
are those of its joints; what the file says itself stands.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bampipe.arrays import Array
from bampipe.data.refusals import refusal
from bampipe.data.robot_tree import Body, DriveLimits, Tree, fixed_joint, symmetric, tree_of_tables
from bampipe.files import read_toml

_UNITS = {"revolute": ("rad", "N.m", "kg.m2"), "prismatic": ("m", "N", "kg")}
_FRICTION_SHARE = 0.1
"""Share of the joint's largest effort that friction may take, before any data."""
_EFFORT, _VELOCITY = 50.0, 3.0
"""Largest effort and velocity of a joint for which the URDF states none."""
_DATA_SHEET = 0.2
"""Relative uncertainty of a rotor inertia that is given."""
_ACCELERATING_S = 0.02
"""Time in which a drive without load reaches full speed at full effort: how large a rotor may be.
A joint whose drawn body has no inertia, as of many last links, moves by that of its drive."""

_MOST_JOINTS = 32
"""Most joints of a chain: equations grow with their square, and no machine logs more as one."""


def read_device_file(path: Path) -> dict[str, Any]:
    """The table of a device file, a robot's joints, inputs and friction in it.

    Raises:
        InputError: no such file, not TOML, or a URDF or MJCF that cannot be used.
    """
    return complete_device(read_toml(path), path.parent, str(path))


def complete_device(table: dict[str, Any], folder: Path, where: str) -> dict[str, Any]:
    """``table`` of a device file in ``folder``; as it is where it is no robot, or not well formed.

    Raises:
        InputError: a URDF or MJCF that cannot be used.
    """
    robot = table.get("robot")
    if not isinstance(robot, Mapping):
        return table
    robot = dict(robot)
    limits: Mapping[str, DriveLimits] = {}
    source = ""
    file = _robot_file(robot, where)
    if file is not None:
        from bampipe.data.chain import read_chain  # slow to import, and for robots alone

        robot, limits, notes = read_chain(folder / file, robot)
        source = "; ".join([f"{file.name}, {robot['base']} to {robot['tip']}", *notes])
    if isinstance(robot.get("dh"), Mapping) and "joints" not in robot:
        robot["joints"] = _from_dh(robot["dh"])
    joints = robot.get("joints")
    if not isinstance(joints, Mapping) or not all(isinstance(j, Mapping) for j in joints.values()):
        return table
    if len(joints) > _MOST_JOINTS:
        raise refusal("many_joints", where, joints=len(joints), most=_MOST_JOINTS)
    kinds = {j: str(entry.get("kind")) for j, entry in joints.items() if not entry.get("follows")}
    if not set(kinds.values()) <= set(_UNITS):
        return table
    motors = robot.get("motors", {})
    if not _well_formed(motors, kinds):  # the check of its fields says what is wrong
        motors = {}
    filled = _filled(kinds, {joint: limits.get(joint, DriveLimits()) for joint in kinds}, motors)
    if source and not table.get("source"):
        filled["source"] = source
    given = table.get("limits")
    if isinstance(given, Mapping):
        # A joint's own table adds to what is drawn of it.
        of_joints = filled["limits"]
        filled["limits"] = of_joints | {
            joint: {**of_joints.get(joint, {}), **own} if isinstance(own, Mapping) else own
            for joint, own in given.items()
        }
        table = {key: value for key, value in table.items() if key != "limits"}
    return {**filled, **table, "robot": robot}


def find_robot_file(path: Path) -> Path | None:
    """The URDF or MJCF from which a device file takes its joints; None if there is none."""
    robot = read_toml(path).get("robot")
    file = _robot_file(robot, str(path)) if isinstance(robot, Mapping) else None
    return path.parent / file if file is not None else None


def _robot_file(robot: Mapping[str, Any], where: str) -> Path | None:
    name = robot.get("urdf")
    if not isinstance(name, str) or "joints" in robot:
        return None
    file = Path(name)
    if file.is_absolute() or ".." in file.parts:
        raise refusal("robot_outside", f"{where}: robot.urdf", path=name)
    return file


def tree_of_robot(robot: Mapping[str, Any]) -> Tree:
    """Links and joints of a complete table ``[robot]`` without a file; every DH frame is a link."""
    tree = tree_of_tables(robot["joints"])
    bodies, joints = dict(tree.bodies), list(tree.joints)
    for name, row in robot.get("dh", {}).items():
        frame = f"{name}_frame"
        bodies[frame] = Body()
        joints.append(fixed_joint(f"{name}_to_frame", f"{name}_link", frame, *_frame_of_row(row)))
    return replace(tree, bodies=bodies, joints=joints)


def _frame_of_row(row: Mapping[str, Any]) -> tuple[Array, Array]:
    """Rotation and place of a row's frame, seen from where its joint is."""
    from scipy.spatial.transform import Rotation

    d, a, alpha = (float(row.get(key, 0.0)) for key in ("d", "a", "alpha"))
    return Rotation.from_euler("x", alpha).as_matrix(), np.array([a, 0.0, d])


def _from_dh(rows: Mapping[str, Any]) -> dict[str, dict[str, Any]] | None:
    """Joints of a table of Denavit and Hartenberg; None if a row is not well formed.

    A row's frame lies behind its joint; joint and body are put where the motion is.
    """
    from scipy.spatial.transform import Rotation

    found: dict[str, dict[str, Any]] = {}
    turn, offset, before = np.eye(3), np.zeros(3), ""
    for name, row in rows.items():
        if not isinstance(row, Mapping):
            return None
        try:
            zero = float(row.get("offset", 0.0))
            twist, behind = _frame_of_row(row)
            center = np.array(row.get("center", (0.0,) * 3), dtype=float).reshape(3)
            six = np.array(row.get("inertia", (0.0,) * 6), dtype=float).reshape(6)
        except (TypeError, ValueError):
            return None
        inertia = symmetric(six)
        placed = turn @ Rotation.from_euler("z", zero).as_matrix()
        found[name] = {
            "kind": row.get("kind", "revolute"),
            "position": [float(v) for v in offset],
            "rotation": [float(v) for v in Rotation.from_matrix(placed).as_euler("xyz")],
            "axis": [0.0, 0.0, 1.0],
            "mass": row.get("mass", 0.0),
            "center": [float(v) for v in twist @ center + behind],
            "inertia": [float(v) for v in (twist @ inertia @ twist.T)[np.triu_indices(3)]],
        } | ({"after": before} if before else {})
        turn, offset, before = twist, behind, name
    return found


def _well_formed(motors: object, joints: Mapping[str, str]) -> bool:
    """Whether a table of motors can be filled in."""
    if not isinstance(motors, Mapping):
        return False
    for motor in motors.values():
        turns = motor.get("turns") if isinstance(motor, Mapping) else None
        if not isinstance(turns, Mapping) or not turns or not set(turns) <= set(joints):
            return False
        numbers = [*turns.values(), *(v for k, v in motor.items() if k != "turns")]
        if not all(isinstance(value, int | float) and value != 0 for value in numbers):
            return False
    return True


def _filled(
    kinds: Mapping[str, str],
    limits: Mapping[str, DriveLimits],
    motors: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    """Defaults of the device file of a robot.

    Args:
        kinds: of the joints, by name; limits: of their drives.
        motors: tables of ``[robot.motors]``; one a joint, at the joint, where there are none.
    """
    given = bool(motors)
    motors = motors or {joint: {"turns": {joint: 1.0}} for joint in kinds}
    slides = {joint for joint, kind in kinds.items() if kind == "prismatic"}
    by_current = all("torque_constant" in motor for motor in motors.values())
    channel = {name: f"{'current' if by_current else 'torque'}_{name}" for name in motors}
    applied: dict[str, list[str]] = {joint: [] for joint in kinds}
    losses: dict[str, list[str]] = {joint: [] for joint in kinds}
    parameters: dict[str, dict[str, Any]] = {}
    kinetic = []
    for name, motor in motors.items():
        ratios = {
            joint: f"({float(ratio)!r}{'/metre' if joint in slides else ''})"
            for joint, ratio in motor["turns"].items()
        }
        speed = " + ".join(f"{ratio}*qd_{joint}" for joint, ratio in ratios.items())
        torque = channel[name]
        last = list(motor["turns"])[-1]
        turns = abs(float(motor["turns"][last]))
        if by_current:
            torque += f"*torque_constant_{name}"
            parameters[f"torque_constant_{name}"] = _constant(motor)
        for joint, ratio in ratios.items():
            applied[joint].append(f"{ratio}*{torque}")
        # At the joint, inertia of a joint that slides is a mass.
        unit = "kg.m2" if given else _UNITS[kinds[last]][2]
        rotor = f"rotor_inertia_{name}"
        parameters[rotor] = _rotor_parameter(motor, name, limits[last], turns, unit)
        kinetic.append(f"0.5*{rotor}*({speed})**2" if given else f"0.5*{rotor}*qd_{last}**2")
        if len(ratios) > 1:
            effort, velocity = (value / turns for value in _scale(limits[last]))
            velocity *= turns * turns
            for term, size, unit in (
                ("viscous", _FRICTION_SHARE * effort / velocity, "N.m.s/rad"),
                ("coulomb", _FRICTION_SHARE * effort, "N.m"),
            ):
                about = f"friction of motor {name}, at the motor"
                parameters[f"{term}_{name}"] = _positive(unit, 0.0, size, description=about)
            for joint, ratio in ratios.items():
                losses[joint].append(
                    f"{ratio}*(viscous_{name}*({speed}) + coulomb_{name}*sgn({speed}))"
                )
    found: dict[str, Any] = {
        "coordinates": {j: {"kind": "linear" if j in slides else "rotary"} for j in kinds},
        "inputs": {
            "force": [*channel.values()],
            "force_unit": "A" if by_current else "N.m",
            "drive": True,
        },
        "applied": {joint: " + ".join(terms) or "0" for joint, terms in applied.items()},
        "torque": {joint: " - ".join(["0", *terms]) for joint, terms in losses.items() if terms},
        "friction": {joint: _friction(kinds[joint], limits[joint]) for joint in kinds},
        "parameters": parameters,
        "energy": {"kinetic": " + ".join(kinetic)},
        "limits": {
            joint: {"lower": limits[joint].lower, "upper": limits[joint].upper}
            for joint in kinds
            if limits[joint].lower < limits[joint].upper
        },
    }
    if slides:
        found["constants"] = {
            "metre": {"value": 1.0, "unit": "m", "sd": 0.0, "source": "a slide feels a force"}
        }
    return found


def _constant(motor: Mapping[str, Any]) -> dict[str, Any]:
    """The torque constant of a motor, estimated where its uncertainty is given."""
    value, sd = float(motor["torque_constant"]), float(motor.get("torque_constant_sd", 0.0))
    known = {"fixed": True} if sd == 0.0 else {"weighed": True}
    return {
        "unit": "N.m/A", "prior": value, "sd": sd, **known,
        "description": "torque per ampere, at the motor",
    }  # fmt: skip


def _rotor_parameter(
    motor: Mapping[str, Any], name: str, limits: DriveLimits, turns: float, unit: str
) -> dict[str, Any]:
    """Inertia of a rotor: of the data sheet where it is given, else of the file, else a guess."""
    about = f"inertia of the rotor of {name}, seen from where its torque is"
    if "rotor_inertia" in motor:
        value = float(motor["rotor_inertia"])
        return _positive(unit, value, _DATA_SHEET * value, weighed=True, description=about)
    effort, velocity = _scale(limits)
    guess = _ACCELERATING_S * effort / velocity / turns**2
    # Many a file has an armature that only steadies its simulation: a start, not weighed as data.
    prior = max(limits.armature, 0.0) / turns**2 or guess
    return _positive(unit, prior, 5.0 * max(prior, guess), description=about)


def _friction(kind: str, limits: DriveLimits) -> dict[str, Any]:
    effort, velocity = _scale(limits)
    length, torque, _ = _UNITS[kind]
    size = _FRICTION_SHARE * effort
    return {
        "viscous": _positive(f"{torque}.s/{length}", max(limits.damping, 0.0), size / velocity),
        "coulomb": _positive(torque, max(limits.friction, 0.0), size),
    }


def _positive(unit: str, prior: float, sd: float, **more: object) -> dict[str, Any]:
    """The table of a parameter that is not below zero."""
    return {"unit": unit, "prior": prior, "sd": sd, "lower": 0.0, **more}


def _scale(limits: DriveLimits) -> tuple[float, float]:
    """Largest effort and velocity of a joint."""
    return max(limits.effort, 0.0) or _EFFORT, max(limits.velocity, 0.0) or _VELOCITY
