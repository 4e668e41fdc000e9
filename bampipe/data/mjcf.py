"""MJCF, the model files of MuJoCo: what their bodies and joints say, and a robot written as one.

Source: MuJoCo's documentation, XML reference.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from bampipe.arrays import Array
from bampipe.data.robot_tree import Body, DriveLimits, Tree, TreeJoint, fixed_joint, symmetric
from bampipe.data.robot_xml import Attribute, assign, document, number, numbers, put
from bampipe.errors import InputError, did_you_mean, located
from bampipe.lists import join_names

Attributes = dict[str, str]
STEP_S = 5e-4
_FIRM = {"solreffriction": "0.001 1", "solimpfriction": "0.999 0.9999 0.001"}
"""Of dry friction: as stiff as the time step allows, since MuJoCo's usual one creeps."""
_TINY = 1e-9
"""Mass and inertia of a body that stands for the inertia of its joint alone, kg and kg.m2."""
_WORLD = "world"
_KINDS = {"revolute": "hinge", "prismatic": "slide"}
_READ = {name: kind for kind, name in _KINDS.items()}
_COUPLES = ("equality", "tendon")
_BUILDS = ("include", "replicate", "composite", "flexcomp", "attach", "frame")
_FLAT = 'write it out flat (mj_saveLastXML, saveinertial="true"), or take it out of the folder'


@dataclass
class Additions:
    """What an MJCF has beside bodies, joints and a motor each.

    Attributes:
        joints, drives: attributes of joints and of their motors, by joint, in place of the usual.
        tendons: attributes of each, and turns of its joints.
        loads: name, kind of joint and inertia of what only tendons hold.
        bristles: attributes of motors that are LuGre friction.
    """

    joints: dict[str, Attributes] = field(default_factory=dict)
    drives: dict[str, Attributes] = field(default_factory=dict)
    tendons: list[tuple[Attributes, dict[str, float]]] = field(default_factory=list)
    loads: list[tuple[str, str, float]] = field(default_factory=list)
    bristles: list[Attributes] = field(default_factory=list)


def mjcf_text(name: str, tree: Tree, gravity: Sequence[float], comment: str, add: Additions) -> str:
    """An MJCF of bodies and joints without shapes, one body a link, one motor a joint that moves.

    Parents come first in ``tree``; ``gravity`` is in the frame of its root, m/s2; ``comment`` is
    said at the head, and ``add`` is what else it has.
    """
    root = Element("mujoco", model=name)
    put(root, "compiler", angle="radian", inertiafromgeom="false")
    put(root, "option", gravity=gravity, timestep=STEP_S, integrator="implicitfast")
    world, actuators = put(root, "worldbody"), put(root, "actuator")
    carried = {joint.child for joint in tree.joints}
    (stem,) = (link for link in tree.bodies if link not in carried)
    bodies = {stem: world}
    if stem != _WORLD:
        bodies[stem] = put(world, "body", name=stem)
        _write_inertial(bodies[stem], tree.bodies[stem])
    for joint in tree.joints:
        x, y, z, w = Rotation.from_matrix(joint.turn).as_quat()
        frame: dict[str, Attribute] = {"pos": joint.offset, "quat": (w, x, y, z)}
        body = put(bodies[joint.parent], "body", name=joint.child, **frame)
        bodies[joint.child] = body
        _write_inertial(body, tree.bodies[joint.child])
        if joint.kind != "fixed":
            _write_joint(body, actuators, joint, add)
    for load, kind, inertia in add.loads:
        body = put(world, "body", name=load)
        _write_inertial(body, Body(_TINY, np.zeros(3), _TINY * np.eye(3)))
        put(body, "joint", name=load, type=kind, armature=inertia)
    tendons = put(root, "tendon") if add.tendons else root
    for attributes, turns in add.tendons:
        tendon = put(tendons, "fixed", **{**_FIRM, **attributes})
        for moved, turn in turns.items():
            put(tendon, "joint", joint=moved, coef=turn)
    for attributes in add.bristles:
        put(actuators, "dcmotor", **attributes)
    return document(root, comment)


def _write_inertial(element: Element, body: Body) -> None:
    """Write the inertial element of a body, zeros too: not every parser of MJCF takes none."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = body.inertia
    inertial = put(element, "inertial", pos=body.center, mass=body.mass)
    if body.inertia.any():
        assign(inertial, fullinertia=(xx, yy, zz, xy, xz, yz))
    else:
        assign(inertial, diaginertia="0 0 0")


def _write_joint(body: Element, actuators: Element, joint: TreeJoint, add: Additions) -> None:
    own = joint.limits
    kind = "prismatic" if joint.kind == "prismatic" else "revolute"
    usual: dict[str, Attribute] = {
        "name": joint.name, "type": _KINDS[kind], "axis": joint.axis, "damping": own.damping,
        "frictionloss": own.friction, "armature": own.armature,
    }  # fmt: skip
    moves = put(body, "joint", **{**usual, **_FIRM, **add.joints.get(joint.name, {})})
    drive = {"name": f"drive_{joint.name}", "joint": joint.name, **add.drives.get(joint.name, {})}
    motor = put(actuators, "general" if len(drive) > 2 else "motor", **drive)
    if own.lower < own.upper:
        assign(moves, limited="true", range=(own.lower, own.upper))
    if own.effort > 0.0:
        assign(motor, ctrllimited="true", ctrlrange=(-own.effort, own.effort))


class _Reader:
    """Walks the bodies of an MJCF and collects links and joints."""

    def __init__(self, root: Element) -> None:
        compiler = _merged(root, "compiler")
        self.radian = compiler.get("angle", "degree") == "radian"
        self.sequence = compiler.get("eulerseq", "xyz")
        if not re.fullmatch("[xyzXYZ]{3}", self.sequence):
            raise InputError(f'eulerseq: found "{self.sequence}", expected three of x, y, z')
        self.autolimits = compiler.get("autolimits", "true") == "true"
        self.by_shape = compiler.get("inertiafromgeom", "auto") == "true"
        if compiler.get("coordinate", "local") != "local":
            raise InputError("coordinates are global", remedy=_FLAT)
        for tag in _BUILDS:
            if next(root.iter(tag), None) is not None:
                raise InputError(f"a <{tag}>, which MuJoCo expands", remedy=_FLAT)
        self.defaults: dict[str, dict[str, str]] = {"": {}, "main": {}}
        for entry in root.iterfind("default"):
            self._read_defaults(entry, {})
            self.defaults[""] = self.defaults[entry.get("class", "")]
        self.efforts: dict[str, float] = {}
        for motor in root.iterfind("actuator/*"):
            self._read_motor(motor)
        self.bodies = {_WORLD: Body()}
        self.joints: list[TreeJoint] = []

    def _read_defaults(self, entry: Element, outer: Mapping[str, str]) -> None:
        joint = entry.find("joint")
        own = {**outer, **({} if joint is None else joint.attrib)}
        self.defaults[entry.get("class", "")] = own
        for inner in entry.iterfind("default"):
            self._read_defaults(inner, own)

    def _read_motor(self, motor: Element) -> None:
        """Note the effort of a joint that a motor alone is for."""
        joint = motor.get("joint")
        ranges = ("ctrlrange", "forcerange") if motor.tag == "motor" else ("forcerange",)
        key = next((key for key in ranges if motor.get(key)), "")
        if joint is None or not key:
            return
        with located(f"actuator of {joint!r}", ": "):
            low, high = numbers(motor, key, "", 2)
            gear = numbers(motor, "gear", "1", max(len(motor.get("gear", "1").split()), 1))[0]
        self.efforts[joint] = max(abs(low), abs(high)) * abs(gear)

    def walk(self, body: Element, parent: str, shift: Array, given: str, moves: bool) -> None:
        """Read a body and those on it.

        Args:
            body: the element; parent: link that carries it.
            shift: of the body's parent in the frame of that link, (3,), m.
            given: class of defaults that it inherits; moves: whether a joint is above it.
        """
        name = body.get("name") or f"body_{len(self.bodies)}"
        given = body.get("childclass", given)
        with located(f"body {name!r}", ": "):
            if name in self.bodies:
                raise InputError("a second body of that name")
            turn = self.orientation(body)
            offset = shift + np.array(numbers(body, "pos", "0 0 0", 3))
            joints = [*body.iterfind("freejoint"), *body.iterfind("joint")]
            center = np.zeros(3)
            for k, entry in enumerate(joints):
                usual = entry.get("class", given)
                if usual not in self.defaults:
                    near = did_you_mean(usual, self.defaults)
                    raise InputError(f"no <default> of class {usual!r}{near}")
                known = {**self.defaults[usual], **entry.attrib}
                joint = known.get("name") or f"{name}_joint{k or ''}"
                own = Element("joint", known)
                kind = "free" if entry.tag == "freejoint" else known.get("type", "hinge")
                kind = _READ.get(kind, kind)
                with located(f"joint {joint!r}", ": "):
                    at = np.array(numbers(own, "pos", "0 0 0", 3))
                    axis = numbers(own, "axis", "0 0 1", 3)
                    start, limits = number(own, "ref"), self.limits(own, joint, kind)
                child = name if k == len(joints) - 1 else f"{name}_before_{k + 1}"
                offset = offset + turn @ (at - center)
                along = _unit(np.array(axis))
                if kind == "revolute" and start:
                    turn = turn @ Rotation.from_rotvec(-self.angle(start) * along).as_matrix()
                elif kind == "prismatic":
                    offset = offset - turn @ along * start
                frame = turn, offset, Rotation.from_matrix(turn).as_euler("xyz")
                self.joints.append(TreeJoint(joint, kind, parent, child, *frame, axis, limits))
                if child != name:
                    self.bodies[child] = Body()
                parent, turn, offset, center, moves = child, np.eye(3), np.zeros(3), at, True
            if not joints:
                self.joints.append(fixed_joint(f"{name}_fixed", parent, name, turn, offset))
            self.bodies[name] = self.body(body, moves).moved(np.eye(3), -center)
        for inner in body.iterfind("body"):
            self.walk(inner, name, -center, given, moves)

    def angle(self, value: float) -> float:
        return value if self.radian else math.radians(value)

    def orientation(self, element: Element) -> Array:
        """Rotation of an element's frame, (3, 3)."""
        if element.get("quat"):
            w, x, y, z = numbers(element, "quat", "", 4)
            if not any((w, x, y, z)):
                raise InputError("a quat of length zero")
            return np.asarray(Rotation.from_quat((x, y, z, w)).as_matrix())
        if element.get("axisangle"):
            *about_axis, angle = numbers(element, "axisangle", "", 4)
            turned = self.angle(angle) * _unit(np.array(about_axis))
            return np.asarray(Rotation.from_rotvec(turned).as_matrix())
        if element.get("euler"):
            angles = [self.angle(v) for v in numbers(element, "euler", "", 3)]
            turn = np.eye(3)
            for letter, angle in zip(self.sequence, angles, strict=True):
                one = Rotation.from_euler(letter.lower(), angle).as_matrix()
                # About axes that turn along, small letters; about fixed ones, capitals.
                turn = turn @ one if letter.islower() else one @ turn
            return turn
        if element.get("xyaxes"):
            six = np.array(numbers(element, "xyaxes", "", 6))
            first = _unit(six[:3])
            second = _unit(six[3:] - (six[3:] @ first) * first)
            return np.column_stack([first, second, np.cross(first, second)])
        if element.get("zaxis"):
            up = _unit(np.array(numbers(element, "zaxis", "", 3)))
            if up[2] == -1.0:
                return np.diag([1.0, -1.0, -1.0])
            return np.asarray(Rotation.align_vectors(up, (0.0, 0.0, 1.0))[0].as_matrix())
        return np.eye(3)

    def body(self, body: Element, moves: bool) -> Body:
        """Its mass; refused where it moves and follows from shapes."""
        inertial = body.find("inertial")
        shapes = body.find("geom") is not None
        if moves and shapes and (inertial is None or self.by_shape):
            raise InputError("mass and inertia follow from shapes", remedy=_FLAT)
        if inertial is None:
            return Body()
        mass, center = number(inertial, "mass"), np.array(numbers(inertial, "pos", "0 0 0", 3))
        if inertial.get("fullinertia"):
            xx, yy, zz, xy, xz, yz = numbers(inertial, "fullinertia", "", 6)
            return Body(mass, center, symmetric((xx, xy, xz, yy, yz, zz)))
        inertia = np.diag(numbers(inertial, "diaginertia", "0 0 0", 3))
        return Body(mass, np.zeros(3), inertia).moved(self.orientation(inertial), center)

    def limits(self, own: Element, joint: str, kind: str) -> DriveLimits:
        low, high = numbers(own, "range", "0 0", 2)
        limited = own.get("limited", "auto")
        if limited == "false" or (limited == "auto" and not self.autolimits):
            low = high = 0.0
        if kind == "revolute":
            low, high = self.angle(low), self.angle(high)
        effort = max(map(abs, numbers(own, "actuatorfrcrange", "0 0", 2)))
        losses = (number(own, key) for key in ("damping", "frictionloss", "armature"))
        return DriveLimits(low, high, effort or self.efforts.get(joint, 0.0), 0.0, *losses)


def mjcf_tree(root: Element) -> Tree:
    """The bodies and joints of an MJCF.

    A joint beside a body's origin moves the frame of the link to the joint.

    Raises:
        InputError: what only MuJoCo can expand, masses that follow from shapes, or wrong numbers.
    """
    reader = _Reader(root)
    for body in root.iterfind("worldbody/body"):
        reader.walk(body, _WORLD, np.zeros(3), "", moves=False)
    coupled = [tag for tag in _COUPLES if root.find(f"{tag}/*") is not None]
    notes = (f"not heard: {join_names(coupled)}",) if coupled else ()
    x, y, z = numbers(_merged(root, "option"), "gravity", "0 0 -9.81", 3)
    return Tree(reader.bodies, reader.joints, notes, (x, y, z))


def _merged(root: Element, tag: str) -> Element:
    """All elements of a tag as one, the later ones counting."""
    merged = Element(tag)
    for element in root.iterfind(tag):
        merged.attrib.update(element.attrib)
    return merged


def _unit(vector: Array) -> Array:
    """The vector at length one; as it is, if that is zero."""
    return np.asarray(vector / (np.linalg.norm(vector) or 1.0))
