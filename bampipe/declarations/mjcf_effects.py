"""Effects of a robot's model as MuJoCo has them: polynomial joints, tendons, motors, bristles."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bampipe.data.mjcf import STEP_S, Additions
from bampipe.data.robot_xml import number_list
from bampipe.physics import System, registry
from bampipe.physics.effect import BoundEffect
from bampipe.physics.robot import Robot

Array = NDArray[np.float64]

_FAR = 1e6
"""Where a spring on one side ends on the other, rad or m."""
_BRISTLE, _SETTLE_S = 1e-5, 1e-5
"""Travel in which a bristle that stands for Stribeck friction gives way, rad or m, and its damping
over its stiffness: more of it acts a step late."""
_PAIRS = {"sum": 1.0, "difference": -1.0}


@dataclass
class _Writer:
    """Collects what effects add to a robot, and says of which it could not.

    Attributes:
        system, p: the model and its parameters; robot: its joints.
        names: of the drawing, by that of the coordinate.
        add: what goes into the MJCF; lacks: effects that do not, and how others differ.
        friction: what is left of each joint's Coulomb friction.
        springs: coefficients of position, its square and cube by joint, N.m or N.
        drives: gain, offset, delay and time constant of each drive.
        armature: inertia of each joint's drives, less what tendons have of it.
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

    def value(self, name: str, default: float | None = None) -> float:
        """A parameter by its name."""
        if default is not None and name not in {q.name for q in self.system.parameters}:
            return default
        return float(self.p[self.system.index(name)])

    def tendon(self, turns: Mapping[str, float], **attributes: float | str) -> None:
        """A tendon over joints with what acts on the sum of their turns."""
        shown = {k: v if isinstance(v, str) else number_list([v]) for k, v in attributes.items()}
        name = f"tendon_{len(self.add.tendons) + 1}"
        for joint in turns:
            if "armature" in attributes:
                self.armature[joint] -= turns[joint] ** 2 * float(attributes["armature"])
        joints = {self.names.get(joint, joint): turn for joint, turn in turns.items()}
        self.add.tendons.append(({"name": name, **shown}, joints))

    def set_joint(self, axis: str, **attributes: str) -> None:
        """Give a joint attributes in place of its own."""
        self.add.joints.setdefault(self.names[axis], {}).update(attributes)

    def bristles(self, axis: str, numbers: list[float]) -> None:
        """LuGre friction at a joint: a motor that never turns it otherwise."""
        joint = self.names[axis]
        given = {"joint": joint, "motorconst": "1e-6", "resistance": "1"}
        name = f"friction_{len(self.add.bristles) + 1}_{joint}"
        self.add.bristles.append({"name": name, **given, "lugre": number_list(numbers)})

    def drive(self, force: str) -> dict[str, float]:
        """What stands between a drive and its joint."""
        return self.drives.setdefault(force, {"gain": 1.0, "offset": 0.0, "delay": 0.0, "lag": 0.0})

    def motors(self) -> None:
        """Friction and inertia of motors that turn several joints."""
        for name, motor in self.robot.motors.items():
            if len(motor.turns) > 1:
                self.tendon(
                    motor.turns,
                    armature=self.value(f"rotor_inertia_{name}"),
                    damping=self.value(f"viscous_{name}", 0.0),
                    frictionloss=self.value(f"coulomb_{name}", 0.0),
                )

    def write(self, item: BoundEffect) -> None:
        """Add one effect, or note that it has no place."""
        act = _WRITERS.get(item.effect.name)
        own = item.effect.name in registry.effect_names()
        known = own and item.effect.declaration == registry.effect(item.effect.name).declaration
        if act is None or not known or not act(self, item, _Values(self, item)):
            self.lacks.append(item.name)

    def finish(self) -> None:
        """Give joints and drives what their effects make together."""
        for axis, inertia in self.armature.items():
            self.set_joint(axis, armature=number_list([inertia]))
        for axis, c in self.friction.items():
            self.set_joint(axis, frictionloss=number_list([c]))
        for axis, numbers in self.springs.items():
            self.set_joint(axis, stiffness=number_list(numbers))
        for axis in self.system.coordinates:
            one = self.drive(f"torque_{axis}")
            if one == {"gain": 1.0, "offset": 0.0, "delay": 0.0, "lag": 0.0}:
                continue
            given = {"gainprm": number_list([one["gain"]])}
            given |= {"biastype": "affine", "biasprm": number_list([one["offset"], 0.0, 0.0])}
            if one["lag"] > 0.0:
                given |= {"dyntype": "filterexact", "dynprm": number_list([one["lag"]])}
            if one["delay"] > 0.0:
                kept = math.ceil(one["delay"] / STEP_S) + 2
                given |= {"delay": number_list([one["delay"]]), "nsample": str(kept)}
                given["interp"] = "linear"
            self.add.drives[self.names[axis]] = given


class _Values:
    """Parameters of one effect by their short names."""

    def __init__(self, writer: _Writer, item: BoundEffect) -> None:
        self._writer, self._item = writer, item

    def __getattr__(self, short: str) -> float:
        return self._writer.value(self._item.parameter(short).name)


_Act = Callable[[_Writer, BoundEffect, _Values], bool]
"""Writes an effect; False where it has no place."""


def _spring(w: _Writer, item: BoundEffect, v: _Values) -> bool:
    cubic = item.effect.name == "cable_torque"
    more = [v.bending, v.stiffening] if cubic else [0.0, 0.0]
    own = w.springs.get(item.target, np.zeros(3))
    w.springs[item.target] = own + np.array([v.stiffness, *more])
    w.drive(f"torque_{item.target}")["offset"] += v.offset
    return True


def _drag(w: _Writer, item: BoundEffect, v: _Values) -> bool:
    linear = max(w.value(f"viscous.{item.target}"), 0.0)
    w.set_joint(item.target, damping=number_list([linear, v.coefficient, 0.0]))
    return True


def _stop(w: _Writer, item: BoundEffect, v: _Values) -> bool:
    ends = (-_FAR, v.position) if item.effect.name == "upper_stop" else (v.position, _FAR)
    w.tendon({item.target: 1.0}, stiffness=v.stiffness, springlength=number_list(ends))
    return True


def _load(w: _Writer, item: BoundEffect, v: _Values) -> bool:
    axis = item.target
    load = f"load_{w.names[axis]}"
    kind = next(c.kind for c in w.system.model.device.coordinates if c.name == axis)
    w.add.loads.append((load, "slide" if kind == "linear" else "hinge", v.inertia))
    half = 0.5 * v.gap if item.effect.name == "loose_load" else 0.0
    w.tendon(
        {load: 1.0, axis: -1.0},
        stiffness=v.inertia * v.frequency**2,
        damping=2.0 * v.damping * v.frequency * v.inertia,
        springlength=number_list([-half, half]),
    )
    if half:
        w.lacks.append(f"of {item.name} its weight, and that nothing damps it within the gap")
    return True


def _presliding(w: _Writer, item: BoundEffect, v: _Values) -> bool:
    left = w.friction.get(item.target, w.value(f"coulomb.{item.target}")) - v.force
    if left < 0.0:
        return False
    w.friction[item.target] = left
    w.bristles(item.target, [v.force / v.distance, 0.0, v.force, v.force, 1.0])
    return True


def _stribeck(w: _Writer, item: BoundEffect, v: _Values) -> bool:
    c = w.friction.get(item.target, w.value(f"coulomb.{item.target}"))
    most = c + v.force
    if c <= 0.0 or v.force <= 0.0:
        return False
    w.friction[item.target] = 0.0
    stiffness = most / _BRISTLE
    w.bristles(item.target, [stiffness, _SETTLE_S * stiffness, c, most, v.speed])
    return True


def _pair_friction(w: _Writer, item: BoundEffect, v: _Values) -> bool:
    sign = _PAIRS[item.effect.name.rpartition("_")[2]]
    turns = dict(zip(item.axes, (1.0, sign), strict=True))
    w.tendon(turns, damping=v.viscous, frictionloss=v.coulomb)
    return True


def _pair_inertia(w: _Writer, item: BoundEffect, v: _Values) -> bool:
    if v.inertia < 0.0:
        return False
    sign = _PAIRS[item.effect.name.rpartition("_")[2]]
    w.tendon(dict(zip(item.axes, (1.0, sign), strict=True)), armature=v.inertia)
    return True


def _drive(w: _Writer, item: BoundEffect, v: _Values) -> bool:
    every = [f"torque_{axis}" for axis in w.system.coordinates]
    forces = [item.target] if item.target else every
    if w.robot.motors or not {*forces} <= {*every}:
        return False
    for force in forces:
        one = w.drive(force)
        if item.effect.name == "force_gain":
            one["gain"] -= v.error
        elif item.effect.name == "force_bias":
            one["offset"] -= v.bias
        elif item.effect.name == "actuator_lag":
            one["lag"] += 0.5 * (v.time_constant + math.sqrt(v.time_constant**2 + 4e-6))
        else:
            one["delay"] += v.delay
    return True


_WRITERS: Mapping[str, _Act] = {
    "return_spring": _spring,
    "cable_torque": _spring,
    "quadratic_drag": _drag,
    "upper_stop": _stop,
    "lower_stop": _stop,
    "flexible_load": _load,
    "loose_load": _load,
    "presliding": _presliding,
    "stribeck": _stribeck,
    "friction_of_sum": _pair_friction,
    "friction_of_difference": _pair_friction,
    "inertia_of_sum": _pair_inertia,
    "inertia_of_difference": _pair_inertia,
    # In the armature of the joint already.
    "inertia_mismatch": lambda w, item, v: True,
    **dict.fromkeys(
        ("force_gain", "force_bias", "actuator_lag", "actuator_delay", "drive_delay"), _drive
    ),
}


def add_effects(
    system: System, p: Array, robot: Robot, names: Mapping[str, str], drives: Array
) -> tuple[Additions, list[str]]:
    """What a model's effects and shared motors add to an MJCF, and which find no place in it.

    Args:
        system, p: the model and its parameters (n_p,); robot: its joints.
        names: the drawing's name of each coordinate's joint.
        drives: inertia of the drives at each joint, (n_q,).
    """
    writer = _Writer(system, p, robot, names, dict(zip(system.coordinates, drives, strict=True)))
    writer.motors()
    # Presliding takes its part of the friction before Stribeck's takes the rest.
    for item in sorted(system.model.effects, key=lambda item: item.effect.name == "stribeck"):
        writer.write(item)
    writer.finish()
    return writer.add, writer.lacks
