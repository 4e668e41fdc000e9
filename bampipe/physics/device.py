"""A device: coordinates, energies, inputs, friction, all declared in one TOML file."""

import ast
import math
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Annotated, Any, Literal, Self

from pydantic import Field, PrivateAttr

from bampipe.errors import InputError, did_you_mean
from bampipe.physics import expression
from bampipe.physics.expression import MAX_NUMBER, Expression, Name
from bampipe.physics.parameter import Parameter, PhysicalNumber
from bampipe.physics.robot import Robot
from bampipe.schema import (
    ByName,
    Declaration,
    Distinct,
    NamedDeclaration,
    NotNegative,
    Positive,
    Several,
    Text,
    read,
)

KINDS: Mapping[str, tuple[Literal["rad", "m"], str, float]] = MappingProxyType(
    {"rotary": ("rad", "N.m", 1e-3), "linear": ("m", "N", 2.5e-4)}
)
"""By kind of coordinate: its unit, that of its generalised force, default sign width."""


class Coordinate(NamedDeclaration):
    """One generalised coordinate; its name is used in expressions and column names."""

    kind: Literal["rotary", "linear"] = Field(description='"rotary" (rad, N.m) or "linear" (m, N)')
    given_symbol: Text | None = Field(default=None, alias="symbol")
    """Symbol in printed equations"""
    given_sign_width: Annotated[float, Field(gt=0, lt=1000)] | None = Field(
        default=None,
        alias="sign_width",
        description="Speed over which the sign of the velocity is smoothed, rad/s or m/s",
    )

    @property
    def symbol(self) -> str:
        """Symbol in printed equations."""
        return self.given_symbol or self.name

    @property
    def sign_width(self) -> float:
        """Speed over which the sign of the velocity is smoothed, rad/s or m/s."""
        return self.given_sign_width or KINDS[self.kind][2]

    @property
    def unit(self) -> Literal["rad", "m"]:
        """Of the coordinate."""
        return KINDS[self.kind][0]

    @property
    def torque_unit(self) -> str:
        """Of its generalised force."""
        return KINDS[self.kind][1]


class Constant(Declaration):
    """A number taken from drawings or data sheets, with where it comes from."""

    value: float = Field(gt=-MAX_NUMBER, lt=MAX_NUMBER, description="In its unit")
    unit: str = Field(default="", description="Coherent SI; empty for a pure number")
    source: str = Field(default="", description="Where it comes from")
    sd: NotNegative | None = Field(default=None, description="Standard uncertainty; 0 if exact")
    description: str = Field(default="", description="Meaning, in a few words")


class Energy(Declaration):
    """The energies of a device, J; beside those of its rigid bodies where it is a robot."""

    kinetic: Expression = Field(default="0", validate_default=True)
    """Kinetic energy, J: quadratic in the rates"""
    potential: Expression = Field(default="0", validate_default=True)
    """Potential energy, J; 0 where left out"""


class Inputs(Declaration):
    """The measured channels that drive a device."""

    force: Several[Name] = ()
    """Channels that drive it: force_<component>, or any name"""
    force_unit: str = Field(default="N", description="Their unit, coherent SI")
    drive: bool = False
    """Whether they come from a motor rather than a force sensor: effects of motors are then
    candidates"""
    prescribed: bool = False
    """Whether a machine prescribes the motion, from which the force follows: replicates keep the
    motion as measured"""
    brakes: dict[Name, Name] = Field(default={})
    """Channel of the commanded brake, by coordinate"""
    channels: dict[Name, str] = Field(default={})
    """Other channels that its expressions use, with their units"""


class ProcessNoise(Declaration):
    """Further process noise of the filter."""

    unit: str = Field(default="", description="Coherent SI, of the noise")
    torque: dict[Name, Expression] = Field(description="Per coordinate: gain of the noise")
    description: str = Field(default="", description="Meaning, in a few words")


class Friction(Declaration):
    """Friction along one coordinate."""

    viscous: Parameter = Field(description="Force by velocity")
    coulomb: Parameter = Field(description="Sliding friction, independent of the speed")


class Limits(Declaration):
    """Range of one coordinate."""

    lower: PhysicalNumber = Field(description="Least position, rad or m")
    upper: PhysicalNumber = Field(description="Largest position, rad or m")
    speed: Positive | None = Field(default=None, description="Highest speed, rad/s or m/s")
    acceleration: Positive | None = Field(default=None, description="Highest, rad/s2 or m/s2")
    effort: Positive | None = None
    """Largest that its drive may give, N.m or N"""

    def cross_faults(self) -> Iterator[InputError]:
        if not self.lower < self.upper:
            yield InputError("lower must be below upper")


class Integral(Declaration):
    """One state of a controller, such as the integral of its error; kept within its limits."""

    unit: str = Field(description="Coherent SI")
    rate: Expression
    """Its rate of change, in the quantities that a command may use; its unit per second"""
    lower: float = Field(default=-math.inf, allow_inf_nan=True, description="Where it stops")
    upper: float = Field(default=math.inf, allow_inf_nan=True, description="Where it stops")

    def cross_faults(self) -> Iterator[InputError]:
        if not self.lower < self.upper:
            yield InputError("lower must be below upper")


# Only a free run, a simulation of machine and controller together, needs it.
class Controller(Declaration):
    """A control law as its device file declares it."""

    channels: dict[Name, str] = Field(default={})
    """Recorded references and gains, name = unit"""
    rate_hz: float = Field(default=0.0, ge=0, le=1e6, description="How often it acts; 0 if unknown")
    states: dict[Name, Integral] = Field(default={})
    """Its states, such as the integral of its error"""
    command: dict[Name, Expression]
    """The command, by force channel, from measured motion, channels and constants"""
    source: str = Field(default="", description="Source of the law")


_NEEDED = ("coordinates", "inputs", "applied")
"""Tables that every device has; those of a robot are filled in where its file is read."""


class DeclaredFile(Declaration):
    """The declarations of one TOML file, with the parsed file."""

    _declaration: Mapping[str, Any] = PrivateAttr({})

    @property
    def declaration(self) -> Mapping[str, Any]:
        """The parsed file."""
        return self._declaration

    @classmethod
    def from_declaration(cls, declaration: Mapping[str, Any], where: str = "") -> Self:
        """Check a parsed file, named ``where`` in messages, and make one of it.

        Raises:
            InputError: something is missing, unknown or of the wrong type; names the field.
        """
        found = read(cls, declaration, where or f"{cls.__name__.lower()} file")
        found._declaration = declaration
        return found


class Device(DeclaredFile):
    """A device: coordinates, energies, inputs and friction of one mechanism."""

    schema_: Literal["bampipe.device/1"] = Field(default="bampipe.device/1", alias="schema")
    name: Text = Field(max_length=60, description="Name of the device")
    summary: str = Field(default="", description="Meaning, in one sentence")
    source: str = Field(default="", description="Source of its equations and numbers")
    coordinates: Annotated[tuple[Coordinate, ...], ByName(Name, least=1)] = Field(
        default=(), description="One table per coordinate; for a robot, its joints by default"
    )
    constants: dict[Name, Constant] = Field(default={})
    """Numbers from drawings and data sheets"""
    definitions: dict[Name, Expression] = Field(default={})
    """Named expressions, in order; each may use those before it"""
    energy: Energy | None = None
    """Its energies; beside [robot], added to those of its bodies"""
    robot: Robot | None = None
    """Rigid bodies on joints, in place of [energy]"""
    torque: dict[Name, Expression] = Field(default={})
    """Per coordinate: generalised force beside friction, brakes and the input"""
    inputs: Inputs = Inputs()
    """Its inputs; for a robot, one torque per joint or motor"""
    applied: dict[Name, Expression] = Field(default={}, min_length=1)
    """Per coordinate: generalised force of the channels; for a robot, by its motors"""
    side_load: dict[Name, Expression] = Field(default={})
    """Per coordinate: load across the motion"""
    process_noise: dict[Name, ProcessNoise] = Field(default={})
    """Further process noise of the filter"""
    friction: dict[Name, Friction] = Field(default={})
    """Per coordinate: viscous and coulomb"""
    other_parameters: Annotated[tuple[Parameter, ...], ByName(Name)] = Field(
        default=(), alias="parameters", description="Other numbers to estimate"
    )
    ranges: dict[Name, Limits] = Field(default={}, alias="limits")
    """Range that the simulator and proposed trials stay in, by coordinate"""
    controller: Controller | None = None
    """How the force was commanded, for free runs"""
    default_effects: Distinct[Text] = ()
    """Effects that its base model has"""

    @property
    def kinetic(self) -> ast.expr:
        """Kinetic energy, J; for a robot, added to that of its bodies."""
        return self.energy.kinetic if self.energy else ast.Constant(0)

    @property
    def potential(self) -> ast.expr:
        """Potential energy, J; for a robot, added to that of its bodies."""
        return self.energy.potential if self.energy else ast.Constant(0)

    @property
    def forces(self) -> tuple[str, ...]:
        """Channels that drive it."""
        return self.inputs.force

    @property
    def force_unit(self) -> str:
        """Unit of these."""
        return self.inputs.force_unit

    @property
    def drive(self) -> bool:
        """Whether they come from a motor rather than a force sensor."""
        return self.inputs.drive

    @property
    def prescribed(self) -> bool:
        """Whether a machine prescribes the motion, as on a test bench."""
        return self.inputs.prescribed

    @property
    def brakes(self) -> Mapping[str, str]:
        """Channel of the commanded brake, by coordinate."""
        return self.inputs.brakes

    @property
    def channels(self) -> Mapping[str, str]:
        """Units of other channels that its expressions use."""
        return self.inputs.channels

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """All its parameters: ``viscous.<axis>`` and ``coulomb.<axis>`` first, bodies last."""
        terms = [
            parameter.renamed(f"{term}.{axis}")
            for axis, entry in self.friction.items()
            for term, parameter in entry
        ]
        return (*terms, *self.other_parameters, *(self.robot.parameters if self.robot else ()))

    @property
    def limits(self) -> Mapping[str, tuple[float, float]]:
        """Range of each coordinate that has one, rad or m."""
        return {axis: (entry.lower, entry.upper) for axis, entry in self.ranges.items()}

    @property
    def speed_limits(self) -> Mapping[str, float]:
        """Highest speed of each coordinate, if known, rad/s or m/s."""
        stated = {j.name: j.velocity for j in self.robot.moving if j.velocity} if self.robot else {}
        return stated | {axis: e.speed for axis, e in self.ranges.items() if e.speed is not None}

    @property
    def acceleration_limits(self) -> Mapping[str, float]:
        """Highest acceleration of each coordinate, if stated, rad/s2 or m/s2."""
        stated = {axis: entry.acceleration for axis, entry in self.ranges.items()}
        return {axis: value for axis, value in stated.items() if value is not None}

    @property
    def effort_limits(self) -> Mapping[str, float]:
        """Largest effort of each coordinate's drive, if known, N.m or N."""
        stated = {j.name: j.effort for j in self.robot.moving if j.effort} if self.robot else {}
        return stated | {axis: e.effort for axis, e in self.ranges.items() if e.effort is not None}

    def cross_faults(self) -> Iterator[InputError]:
        missing = [key for key in _NEEDED if key not in self.model_fields_set]
        for key in missing:
            about = type(self).model_fields[key].description or ""
            yield InputError(f"'{key}' is missing", remedy=about.partition(";")[0])
        if missing:
            return
        axes = [c.name for c in self.coordinates]
        yield from self._faults_of_bodies()
        tables: dict[str, Mapping[str, Any]] = {
            "torque": self.torque, "applied": self.applied, "side_load": self.side_load,
            "inputs.brakes": self.brakes, "friction": self.friction, "limits": self.ranges,
        }  # fmt: skip
        tables |= {f"process_noise.{k}.torque": n.torque for k, n in self.process_noise.items()}
        for label, table in tables.items():
            for axis in table:
                if axis not in axes:
                    yield InputError(
                        f"unknown axis {axis!r}{did_you_mean(axis, axes)}",
                        where=label,
                        remedy=f"axes are {', '.join(axes)}",
                    )
        law = self.controller
        if law is not None and set(law.command) != set(self.forces):
            yield InputError(
                f"one expression is needed for each of {', '.join(self.forces)}",
                where="controller.command",
            )
        rates = [derivative(f, k) for f in self.forces for k in range(1, len(INPUT_ORDERS))]
        taken = dict.fromkeys(["t", *(f"qd_{a}" for a in axes), *rates], "a built-in symbol")
        own: dict[str, Iterable[str]] = {
            "coordinates": axes, "inputs.force": self.forces,
            "inputs.brakes": self.brakes.values(), "inputs.channels": self.channels,
            "controller.channels": law.channels if law else (),
            "controller.states": law.states if law else (), "constants": self.constants,
            "definitions": self.definitions, "parameters": [p.name for p in self.other_parameters],
        }  # fmt: skip
        for label, names in own.items():
            for name in names:
                if name in taken:
                    yield InputError(
                        f"the name {name!r} is already taken by {taken[name]}", where=label
                    )
                taken[name] = f"one of {label}"

    def _faults_of_bodies(self) -> Iterator[InputError]:
        """Require energies, or one joint per coordinate."""
        if self.robot is None:
            if self.energy is None:
                yield InputError("'energy' is missing", remedy="give [energy], or [robot]")
            elif "kinetic" not in self.energy.model_fields_set:
                yield InputError(
                    "'kinetic' is missing",
                    where="energy",
                    remedy="Kinetic energy, J: quadratic in the rates",
                )
            return
        kinds = {"revolute": "rotary", "prismatic": "linear"}
        joints = [(joint.name, kinds[joint.kind]) for joint in self.robot.moving]
        if joints != [(c.name, c.kind) for c in self.coordinates]:
            yield InputError(
                "the joints that do not follow another one are not the coordinates",
                where="robot.joints",
                remedy="give one coordinate per joint, with its name and in its order: rotary for"
                " revolute, linear for prismatic",
            )

    def coordinate(self, name: str) -> Coordinate:
        """The coordinate called ``name``.

        Raises:
            InputError: there is none.
        """
        known = {c.name: c for c in self.coordinates}
        if name in known:
            return known[name]
        raise InputError(
            f"device {self.name!r} has no axis {name!r}{did_you_mean(name, known)}",
            remedy=f"its axes are {', '.join(known)}",
        )

    def has_dry_friction(self, axis: str) -> bool:
        """Whether the device adds dry friction of its own to ``axis``, beside the base term."""
        return axis in self.torque and bool(expression.names_within([self.torque[axis]], "sgn"))

    def has_weight(self, axis: str) -> bool:
        """Whether the device's potential energy depends on the position of ``axis``."""
        return axis in expression.reached_names([self.potential], self.definitions)

    @cached_property
    def own_of_torque(self) -> frozenset[str]:
        """Constants and definitions that nothing but the device's own torques uses."""
        rest = [self.kinetic, self.potential, *self.applied.values(), *self.side_load.values()]
        used, others = (
            expression.reached_names(trees, self.definitions)
            for trees in (self.torque.values(), rest)
        )
        return frozenset(used - others)

    @property
    def components(self) -> tuple[str, ...]:
        """Short names of the forces: ``x`` for the channel ``force_x``, ``duty`` for ``duty``."""
        return tuple(name.removeprefix("force_") for name in self.forces)


INPUT_ORDERS = ("", "rate", "curvature", "third", "fourth", "fifth", "sixth")
"""Time derivatives of a measured input that effects may use, by order."""

LAST_ORDER = len(INPUT_ORDERS) - 1


def derivative(force: str, order: int) -> str:
    """Name of the time derivative of an input: ``force_x`` -> ``force_rate_x``, ``duty_rate``."""
    kind = INPUT_ORDERS[order]
    if not kind:
        return force
    if force.startswith("force_"):
        return f"force_{kind}_{force.removeprefix('force_')}"
    return f"{force}_{kind}"


device_from = Device.from_declaration
