"""Effects of a robot's model as MuJoCo elements: polynomial joints, tendons, motors, bristles."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np

from bampipe.arrays import Array
from bampipe.data.mjcf import STEP_S, Additions
from bampipe.data.robot_xml import number_list
from bampipe.physics import System, registry
from bampipe.physics.effect import BoundEffect
from bampipe.physics.robot import Robot

_FAR = 1e6
"""Far end of a spring that acts on one side only, rad or m."""
_BRISTLE, _SETTLE_S = 1e-5, 1e-5
"""Deflection at which a bristle for Stribeck friction yields, rad or m, and its damping over its
stiffness: with more damping, it acts a step late."""
_AS_LOGGED: Mapping[str, float] = {"gain": 1.0, "offset": 0.0, "delay": 0.0, "lag": 0.0}


@dataclass
class _Writer:
    """Collects the elements that effects add to a robot, and effects that MJCF cannot express.

    Attributes:
        system, p: the model and its parameters; robot: its joints.
        names: the drawing's name of each coordinate's joint.
        armature: inertia of each joint's drives, less the part in tendons.
        add: elements of the MJCF; lacks: effects that cannot be expressed, and other differences.
        friction: each joint's Coulomb friction that no bristle or load has taken.
        springs: coefficients of position, its square and cube by joint, N.m or N.
        drives: gain, offset, delay and lag between each drive's input and its joint.
    """

    system: System
    p: Array
    robot: Robot
    names: Mapping[str, str]
    armature: dict[str, float]
    add: Additions = field(default_factory=Additions)
    lacks: list[str] = field(default_factory=list)
    friction: dict[str, float] = field(default_factory=dict)
    springs: dict[str, Array] = field(default_factory=dict)
    drives: dict[str, dict[str, float]] = field(default_factory=dict)

    def value(self, name: str) -> float:
        """Return a parameter of the model by its name."""
        return float(self.p[self.system.index(name)])

    def add_tendon(self, turns: Mapping[str, float], **attributes: float | str) -> None:
        """Add a tendon over joints, with elements that act on the sum of their turns."""
        for joint in turns:
            if "armature" in attributes:
                self.armature[joint] -= turns[joint] ** 2 * float(attributes["armature"])
        shown = {k: v if isinstance(v, str) else number_list([v]) for k, v in attributes.items()}
        joints = {self.names.get(joint, joint): turn for joint, turn in turns.items()}
        self.add.tendons.append(({"name": f"tendon_{len(self.add.tendons) + 1}", **shown}, joints))

    def set_joint(self, axis: str, **attributes: float | Array) -> None:
        """Replace attributes of a joint."""
        shown = {k: number_list(np.atleast_1d(v)) for k, v in attributes.items()}
        self.add.joints.setdefault(self.names[axis], {}).update(shown)

    def add_bristles(self, axis: str, *numbers: float) -> None:
        """Add LuGre friction to a joint, as a motor that never drives it."""
        joint = self.names[axis]
        given = {"joint": joint, "motorconst": "1e-6", "resistance": "1"}
        name = f"friction_{len(self.add.bristles) + 1}_{joint}"
        self.add.bristles.append({"name": name, **given, "lugre": number_list(numbers)})

    def drive(self, force: str) -> dict[str, float]:
        """Return the changeable numbers between a drive's input and its joint."""
        return self.drives.setdefault(force, {**_AS_LOGGED})

    def remaining_friction(self, axis: str) -> float:
        """Return the Coulomb friction of a joint that no bristle or load has taken."""
        return self.friction.get(axis, self.value(f"coulomb.{axis}"))

    def remaining_damping(self, axis: str) -> float:
        """Return the viscous friction of a joint that no load has taken."""
        known = self.add.joints.get(self.names[axis], {})
        return float(known.get("damping", self.value(f"viscous.{axis}")))

    def write(self, item: BoundEffect) -> None:
        """Add one effect, or note that it cannot be expressed."""
        name, act = item.effect.name, _WRITERS.get(item.effect.name)
        # An effect of the user's own may have the name of a built-in one.
        if act is not None and item.effect.declaration == registry.effect(name).declaration:
            short = {q.name.removeprefix(f"{item.prefix}."): q.name for q in item.parameters}
            values = {key: self.value(full) for key, full in short.items()}
            if act(self, item, SimpleNamespace(**values)):
                return
        self.lacks.append(item.name)

    def finish(self) -> None:
        """Write the attributes of joints and drives to which motors and effects contribute."""
        for name, motor in self.robot.motors.items():
            if len(motor.turns) > 1:
                kinds = ("rotor_inertia", "viscous", "coulomb")
                inertia, viscous, coulomb = (self.value(f"{kind}_{name}") for kind in kinds)
                self.add_tendon(
                    motor.turns, armature=inertia, damping=viscous, frictionloss=coulomb
                )
        for axis, inertia in self.armature.items():
            self.set_joint(axis, armature=inertia)
        for axis, c in self.friction.items():
            self.set_joint(axis, frictionloss=c)
        for axis, numbers in self.springs.items():
            self.set_joint(axis, stiffness=numbers)
        for axis in self.system.coordinates:
            one = self.drive(f"torque_{axis}")
            if one == _AS_LOGGED:
                continue
            given = {"gainprm": number_list([one["gain"]])}
            given |= {"biastype": "affine", "biasprm": number_list([one["offset"], 0.0, 0.0])}
            if one["lag"] > 0.0:
                given |= {"dyntype": "filterexact", "dynprm": number_list([one["lag"]])}
            if one["delay"] > 0.0:
                kept = str(math.ceil(one["delay"] / STEP_S) + 2)
                given |= {"delay": number_list([one["delay"]]), "nsample": kept}
                given["interp"] = "linear"
            self.add.drives[self.names[axis]] = given


_Act = Callable[[_Writer, BoundEffect, SimpleNamespace], bool]
"""Writes an effect, given its parameters by their short names; returns False if it cannot."""


def _spring(w: _Writer, item: BoundEffect, v: SimpleNamespace) -> bool:
    numbers = [v.stiffness, getattr(v, "bending", 0.0), getattr(v, "stiffening", 0.0)]
    w.springs[item.target] = w.springs.get(item.target, np.zeros(3)) + np.array(numbers)
    w.drive(f"torque_{item.target}")["offset"] += v.offset
    return True


def _drag(w: _Writer, item: BoundEffect, v: SimpleNamespace) -> bool:
    linear = max(w.remaining_damping(item.target), 0.0)
    w.set_joint(item.target, damping=np.array([linear, v.coefficient, 0.0]))
    return True


def _stop(w: _Writer, item: BoundEffect, v: SimpleNamespace) -> bool:
    if v.settling > STEP_S:  # the damper of a tendon acts off the stop, too
        return False
    ends = (-_FAR, v.position) if item.effect.name == "upper_stop" else (v.position, _FAR)
    w.add_tendon({item.target: 1.0}, stiffness=v.stiffness, springlength=number_list(ends))
    return True


def _load(w: _Writer, item: BoundEffect, v: SimpleNamespace) -> bool:
    axis, half = item.target, 0.5 * getattr(v, "gap", 0.0)
    load = f"load_{w.names[axis]}"
    behind = (getattr(v, f"{what}_behind", 0.0) for what in ("coulomb", "viscous"))
    dry, viscous = (v.inertia * each for each in behind)
    if dry > w.remaining_friction(axis) or viscous > max(w.remaining_damping(axis), 0.0):
        return False
    if dry or viscous:
        w.friction[axis] = w.remaining_friction(axis) - dry
        w.set_joint(axis, damping=w.remaining_damping(axis) - viscous)
        w.add_tendon({load: 1.0}, damping=viscous, frictionloss=dry)
    kind = next(c.kind for c in w.system.model.device.coordinates if c.name == axis)
    w.add.loads.append((load, "slide" if kind == "linear" else "hinge", v.inertia))
    w.add_tendon(
        {load: 1.0, axis: -1.0},
        stiffness=v.inertia * v.frequency**2,
        damping=2.0 * v.damping * v.frequency * v.inertia,
        springlength=number_list([-half, half]),
    )
    if half:
        w.lacks.append(f"of {item.name} its weight, and that nothing damps it within the gap")
    return True


def _presliding(w: _Writer, item: BoundEffect, v: SimpleNamespace) -> bool:
    left = w.remaining_friction(item.target) - v.force
    if left < 0.0:
        return False
    w.friction[item.target] = left
    level = v.force * (1.0 + getattr(v, "rise", 0.0))
    speed = getattr(v, "speed", 1.0)
    w.add_bristles(item.target, v.force / v.distance, 0.0, v.force, level, speed)
    return True


def _stribeck(w: _Writer, item: BoundEffect, v: SimpleNamespace) -> bool:
    least = w.remaining_friction(item.target)
    if least <= 0.0 or v.force <= 0.0:
        return False
    w.friction[item.target] = 0.0
    stiffness = (least + v.force) / _BRISTLE
    w.add_bristles(item.target, stiffness, _SETTLE_S * stiffness, least, least + v.force, v.speed)
    return True


def _pair(w: _Writer, item: BoundEffect, v: SimpleNamespace) -> bool:
    turns = dict(
        zip(item.axes, (1.0, 1.0 if item.effect.name.endswith("_sum") else -1.0), strict=True)
    )
    if not hasattr(v, "inertia"):
        w.add_tendon(turns, damping=v.viscous, frictionloss=v.coulomb)
    elif v.inertia >= 0.0:
        w.add_tendon(turns, armature=v.inertia)
    return bool(getattr(v, "inertia", 0.0) >= 0.0)


def _drive(w: _Writer, item: BoundEffect, v: SimpleNamespace) -> bool:
    every = [f"torque_{axis}" for axis in w.system.coordinates]
    forces = [item.target] if item.target else every
    if w.robot.motors or not {*forces} <= {*every}:
        return False
    late = getattr(v, "time_constant", 0.0)
    for force in forces:
        one = w.drive(force)
        one["gain"] -= getattr(v, "error", 0.0)
        one["offset"] -= getattr(v, "bias", 0.0)
        one["delay"] += getattr(v, "delay", 0.0)
        one["lag"] += late
    return True


_WRITERS: Mapping[str, _Act] = {
    **dict.fromkeys(("return_spring", "cable_torque"), _spring),
    "quadratic_drag": _drag,
    **dict.fromkeys(("upper_stop", "lower_stop"), _stop),
    **dict.fromkeys(("flexible_load", "loose_link"), _load),
    **dict.fromkeys(("presliding", "lugre"), _presliding),
    "stribeck": _stribeck,
    **{
        f"{what}_of_{how}": _pair
        for what in ("friction", "inertia")
        for how in ("sum", "difference")
    },
    # The armature of the joint includes it already.
    "inertia_mismatch": lambda w, item, v: True,
    **dict.fromkeys(
        ("force_gain", "force_bias", "actuator_lag", "actuator_delay", "drive_delay"), _drive
    ),
}


def add_effects(
    system: System, p: Array, robot: Robot, names: Mapping[str, str], drives: Array
) -> tuple[Additions, list[str]]:
    """Convert a model's effects and shared motors to MJCF; return also those that have no place.

    Args:
        system, p: the model and its parameters (n_p,); robot: its joints.
        names: the drawing's name of each coordinate's joint.
        drives: inertia of the drives at each joint, (n_q,).
    """
    writer = _Writer(system, p, robot, names, dict(zip(system.coordinates, drives, strict=True)))
    # A load takes its part of the friction first, and Stribeck friction what is left at last.
    order = {"flexible_load": -1, "stribeck": 1}
    for item in sorted(system.model.effects, key=lambda item: order.get(item.effect.name, 0)):
        writer.write(item)
    writer.finish()
    return writer.add, writer.lacks
