"""An effect: one physical term that a model may have, declared in one TOML file."""

import ast
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations
from typing import Annotated, Literal

from pydantic import Discriminator, Field, StringConstraints, Tag

from bampipe.errors import InputError, did_you_mean
from bampipe.physics import expression
from bampipe.physics.device import INPUT_ORDERS, DeclaredFile, Device, derivative
from bampipe.physics.expression import Expression, Name
from bampipe.physics.parameter import Parameter
from bampipe.schema import ByName, Declaration, Distinct, NamedDeclaration, Text

# Required expressions and permitted scopes of each kind of effect.
_EXPRESSIONS = {
    "torque": (("torque",), ("axis", "axis_pair", "device")),
    "input": (("input",), ("force_component", "force_pair", "channel", "device")),
    "energy": (("kinetic", "potential"), ("axis", "axis_pair", "device")),
    "measurement": (("offset",), ("axis", "device")),
}
Link = Literal["timing", "zero", "scale", "delay", "lag", "saturation", "lever"]
"""Links between log and mechanism, in order: timing, zero and scale of a sensor; delay, lag and
saturation of the drive; the lever at which the force acts."""
Scope = Literal["axis", "axis_pair", "force_component", "force_pair", "channel", "device"]
_PLACED = ("axis_pair", "device")
"""Scopes in which an expression is a table, one entry per place."""
PAIR = ("a", "b")
"""Places of an effect on a pair of axes."""
_FARTHEST = 2
"""Largest distance of the axes of a pair, in the order of the coordinates."""
EACH = "each"
"""Place of a device-wide input effect that stands for every force channel."""


class ParameterByKind(Declaration):
    """A parameter whose unit and prior depend on the kind of axis."""

    rotary: Parameter | None = Field(default=None, description="On a rotary axis")
    linear: Parameter | None = Field(default=None, description="On a linear axis")
    description: str = Field(default="", description="Meaning, in a few words")


def _shape_of_parameter(entry: object) -> str:
    by_kind = isinstance(entry, Mapping) and not {"rotary", "linear"}.isdisjoint(entry)
    return "#ParameterByKind" if by_kind else "#Parameter"


EffectParameter = Annotated[
    Annotated[Parameter, Tag("#Parameter")] | Annotated[ParameterByKind, Tag("#ParameterByKind")],
    Discriminator(_shape_of_parameter),
]
Expressions = Annotated[
    Annotated[Expression, Tag("#one")]
    | Annotated[dict[Name, Expression], Field(min_length=1), Tag("#by_place")],
    Discriminator(lambda entry: "#by_place" if isinstance(entry, Mapping) else "#one"),
]


class Unit(Declaration):
    """The unit of a state on one kind of axis."""

    unit: str = Field(description="Coherent SI")


class State(NamedDeclaration):
    """An internal state of an effect with memory."""

    rate: Expression = Field(description="Its rate of change")
    initial: Expression = Field(default="0", validate_default=True)
    """Value at the start of a trial; 0 if left out"""
    unit: str = Field(default="", description="Coherent SI, if it is the same on every axis")
    rotary: Unit | None = Field(default=None, description="On a rotary axis")
    linear: Unit | None = Field(default=None, description="On a linear axis")
    description: str = Field(default="", description="Meaning, in a few words")


class Ahead(Declaration):
    """Position of the mechanism that hand and gravity act on, relative to the encoder."""

    share: Expression = Field(description="Share of the mechanism there, 0 to 1")
    position: Expression = Field(description="How far it is ahead of the encoder")
    rate: Expression = Field(description="How much faster it moves")


class Effect(DeclaredFile):
    """An effect: one physical term that a model may have; `bind` places it on a device."""

    schema_: Literal["bampipe.effect/1"] = Field(default="bampipe.effect/1", alias="schema")
    name: Annotated[
        str,
        StringConstraints(pattern="^[A-Za-z_][A-Za-z0-9_]*$", max_length=60),
        Field(description="an identifier, such as magnetic_detent"),
    ]
    summary: Text = Field(description="Meaning, in one sentence")
    scope: Scope
    """axis: one coordinate; axis_pair: one and another (q_a, qd_a, q_b, qd_b), for a robot two
    neighbouring joints, a nearer to the base if it acts on both; force_component: one reading;
    force_pair: a reading that leaks into another; channel: an input other than a force; device: the
    whole device"""
    kind: Literal["torque", "input", "energy", "measurement"]
    """torque: acts on the joints; input: maps the measured force to the true one; energy: goes
    through Lagrange's equation; measurement: true minus measured position"""
    torque: Expressions | None = None
    """Generalised force added to the joints; per axis for the scope device"""
    input: Expressions | None = None
    """True force from the measured one (f, f_rate, to f_sixth; g for the other of a pair); per
    channel for the scope device"""
    offset: Expressions | None = None
    """True position minus measured position"""
    kinetic: Expression | None = Field(default=None, description="Kinetic energy added, J")
    potential: Expression | None = Field(default=None, description="Potential energy added, J")
    dissipative: bool = False
    """Whether the effect dissipates energy for all parameters within their bounds"""
    drive: bool = False
    """Whether it applies to motors only: offered if the device has drive = true"""
    own_dry: bool = False
    """Whether it is offered only on axes whose dry friction is more than the base term"""
    link: Link | None = None
    """Where it acts between log and mechanism: links act in this order, each on the output of the
    previous one. Default: scale, or lever for a measurement; a torque with a link is part of the
    drive, and of the load of the later links"""
    robot: bool | None = None
    """true: offered for robots only; false: for other devices only"""
    devices: Distinct[Text] = ()
    """Devices that it suits; all if left out"""
    combines: int = Field(default=1, ge=1)
    """Number of effects that it stands for: a diagnosis gives it the prior of as many"""
    on_request: bool = False
    """Whether a diagnosis weighs it only where its setting `also` names it"""
    looks_like: Text = Field(description="Its trace in the residual")
    on_the_machine: str = Field(default="", description="Remedy on the machine, in one sentence")
    source: Text = Field(description="Literature, with year")
    parameters: dict[Name, EffectParameter] = Field(min_length=1)
    """Its parameters, by name; each for all axes, or by kind of axis"""
    definitions: dict[Name, Expression] = Field(default={})
    """Expressions that those of the effect, and later definitions, may use by name"""
    states: Annotated[tuple[State, ...], ByName(Name)] = Field(
        default=(), description="Internal states, by name, if it has memory"
    )

    ahead: Ahead | None = None
    """For a torque on an axis: position of the mechanism relative to its encoder, for the gravity,
    Coriolis and centrifugal forces on every axis"""

    @cached_property
    def expressions(self) -> Mapping[str, ast.expr]:
        """Its expressions: ``torque``, or ``torque.<place>`` if there is one per place."""
        results: dict[str, ast.expr] = {}
        for key in _EXPRESSIONS[self.kind][0]:
            value = getattr(self, key)
            if isinstance(value, Mapping):
                results |= {f"{key}.{place}": tree for place, tree in value.items()}
            elif value is not None:
                results[key] = value
        return results

    @property
    def formulas(self) -> tuple[str, ...]:
        """Its expressions as lines of text, states with their rates."""
        pairs: list[tuple[str, object]] = []
        for key in ("torque", "input", "kinetic", "potential", "offset"):
            value = self.declaration.get(key, {})
            by_place = value if isinstance(value, Mapping) else {"": value}
            pairs += [(f"{key} of {at}" if at else key, text) for at, text in by_place.items()]
        pairs += self.declaration.get("definitions", {}).items()
        for name, state in self.declaration.get("states", {}).items():
            pairs.append((f"d {name}/dt", state["rate"]))
            pairs += [(f"{name} at the start", state[k]) for k in ("initial",) if k in state]
        return tuple(f"{left} = {' '.join(str(right).split())}" for left, right in pairs)

    @property
    def _formulas(self) -> tuple[ast.expr, ...]:
        return (*self.expressions.values(), *self.definitions.values())

    @property
    def is_dry_friction(self) -> bool:
        """Whether it is a torque on axes that changes sign with their motion."""
        on_axes = self.kind == "torque" and self.scope in ("axis", "axis_pair")
        return on_axes and bool(expression.names_within(self._formulas, "sgn"))

    @property
    def acting_link(self) -> Link | None:
        """Its link; None for what acts on the mechanism itself."""
        usual: dict[str, Link] = {"input": "scale", "measurement": "lever"}
        return self.link or usual.get(self.kind)

    def cross_faults(self) -> Iterator[InputError]:
        main, scopes = _EXPRESSIONS[self.kind]
        if self.scope not in scopes:
            yield InputError(
                f"an effect of kind {self.kind!r} cannot have scope {self.scope!r}",
                remedy=f"scope may be {' or '.join(scopes)}",
            )
        for key in (key for keys, _ in _EXPRESSIONS.values() for key in keys):
            value, placed = getattr(self, key), self.scope in _PLACED and self.kind != "energy"
            if value is not None and key not in main:
                yield InputError(f"{key!r} does not apply to kind {self.kind!r}")
            elif value is not None and isinstance(value, Mapping) != placed:
                form = "give a table, one expression per place" if placed else "one expression"
                yield InputError(f"{key!r} must be {form}")
            elif self.scope == "axis_pair" and placed and value and not set(value) <= set(PAIR):
                yield InputError(f"the places of {key!r} are {' and '.join(PAIR)}")
        if self.ahead and (self.kind, self.scope) != ("torque", "axis"):
            yield InputError("'ahead' applies only to a torque on an axis")
        if self.link and self.kind == "energy":
            yield InputError("'link' does not apply to kind 'energy'")
        if not self.expressions:
            yield InputError(f"an effect of kind {self.kind!r} needs {' or '.join(main)}")
        taken = dict.fromkeys(self.parameters, "parameter")
        names = [(state.name, "state") for state in self.states]
        for name, kind in (*names, *((name, "definition") for name in self.definitions)):
            if name in taken:
                yield InputError(f"a {taken[name]} has this name already", where=f"{kind}s.{name}")
            taken[name] = kind

    def targets(self, device: Device) -> tuple[str, ...]:
        """Names after the colon that make sense for ``device``; ``("",)`` for a device effect."""
        return tuple(self.places(device))

    def places(self, device: Device) -> Mapping[str, tuple[str, ...]]:
        """The axes, or input channels, that each target of ``device`` stands for."""
        if (self.devices and device.name not in self.devices) or (self.drive and not device.drive):
            return {}
        if self.robot is not None and self.robot != (device.robot is not None):
            return {}
        if self.scope == "axis":
            return {
                c.name: (c.name,)
                for c in device.coordinates
                if not self._lacks_kind(c.kind)
                and ("brake" not in self.names or c.name in device.brakes)
                and (not self.own_dry or device.has_dry_friction(c.name))
            }
        if self.scope == "axis_pair":
            # Neighbouring joints where it acts on both, else axes that lie near each other.
            if self.kind == "energy" or (isinstance(self.torque, Mapping) and len(self.torque) > 1):
                return _list_neighbours(device)
            names = [c.name for c in device.coordinates]
            return _pair_near(names, names, _FARTHEST if device.robot is None else 1, "-")
        if self.scope == "channel":
            return {name: (name,) for name in device.channels}
        if self.scope == "force_component":
            return {n: (f,) for n, f in zip(device.components, device.forces, strict=True)}
        if self.scope == "force_pair":
            # The drives of a robot may share a gear with their neighbours, not with all others.
            farthest, between = (1, "-") if device.robot else (len(device.forces), "")
            return _pair_near(device.components, device.forces, farthest, between)
        return {"": ()} if self._fits_device(device) else {}

    @cached_property
    def names(self) -> set[str]:
        """Every name that its expressions use."""
        trees = [*self._formulas, *(t for s in self.states for t in (s.rate, s.initial))]
        trees += [self.ahead.share, self.ahead.position, self.ahead.rate] if self.ahead else []
        return set().union(*map(expression.names, trees))

    @property
    def terms(self) -> set[str]:
        """Those names without an axis or the like behind them: ``load`` of ``load_yaw``."""
        return {name.partition("_")[0] for name in self.names}

    @property
    def uses_weight(self) -> bool:
        """Whether it acts on the slope of the potential energy."""
        return bool(self.terms & {"weight", "pull"})

    @property
    def uses_support(self) -> bool:
        """Whether it acts on the device's own torque, such as that of a gravity compensator."""
        return "support" in self.terms

    def is_part_of_support(self, device: Device) -> bool:
        """Whether it changes the device's own torque: it names what nothing else uses."""
        return self.kind == "torque" and bool(self.names & device.own_of_torque)

    @property
    def uses_inertia(self) -> bool:
        """Whether it acts on what the energies require of its axis."""
        of_axis = {"axis_inertia", "axis_bias", "axis_torque"}
        return self.ahead is not None or bool(self.names & of_axis)

    @property
    def has_play(self) -> bool:
        """Whether its torque is a change of momentum of its states: impacts between samples."""
        within = expression.names_within(self._formulas, "ddt")
        return any(state.name in within for state in self.states)

    @property
    def pulls(self) -> bool:
        """Whether it is a torque by the position of its axis alone, as of a spring or a cable."""
        if self.kind != "torque" or self.scope != "axis" or self.acting_link or self.states:
            return False
        return self.names - {*self.parameters, *self.definitions} == {"q"}

    def _lacks_kind(self, kind: str) -> bool:
        """Whether a parameter has no entry for this kind of axis."""
        return any(getattr(entry, kind, entry) is None for entry in self.parameters.values())

    def _fits_device(self, device: Device) -> bool:
        """Whether every name that a device-wide effect uses exists in ``device``."""
        axes, forces = [c.name for c in device.coordinates], [*device.forces]
        keys = {key.partition(".")[2] for key in self.expressions} - {""}
        places = {*axes, *forces, *([EACH] if forces else [])}
        symbols = [*forces, *(["f"] if EACH in keys and forces else [])]
        known = {derivative(symbol, k) for symbol in symbols for k in range(len(INPUT_ORDERS))}
        terms = ("qd", "applied", "viscous", "coulomb", "load", "weight", "pull")
        known |= {f"{term}_{axis}" for term in terms for axis in axes} | {"t", *axes}
        known |= {f"support_{axis}" for axis in device.torque}
        known |= {*device.definitions, *device.constants, *device.channels, *self.parameters}
        known |= {*self.definitions} | {entry.name for entry in (*device.parameters, *self.states)}
        return keys <= places and self.names <= known | {*device.brakes.values()}


def _pair_near(
    names: Sequence[str], values: Sequence[str], farthest: int, between: str
) -> dict[str, tuple[str, str]]:
    """Ordered pairs of values at most so far apart, by their names with ``between`` them."""
    return {
        f"{names[i]}{between}{names[j]}": (values[i], values[j])
        for i, j in permutations(range(len(names)), 2)
        if abs(i - j) <= farthest
    }


def _list_neighbours(device: Device) -> dict[str, tuple[str, str]]:
    """Pairs of neighbouring joints of one kind, by the text after the colon: ``wrist-hand``."""
    if device.robot is None:
        return {}
    kinds = {c.name: c.kind for c in device.coordinates}
    return {
        f"{joint.after}-{joint.name}": (joint.after, joint.name)
        for joint in device.robot.moving
        if joint.after in kinds and kinds[joint.after] == kinds[joint.name]
    }


@dataclass(frozen=True)
class BoundEffect:
    """An effect at its target, as a part of a model.

    Attributes:
        effect, target: the effect and its place, the text after the colon.
        parameters: its parameters with their full names.
        places: the axes, or input channels, that the target stands for.
    """

    effect: Effect
    target: str
    parameters: tuple[Parameter, ...]
    places: tuple[str, ...]

    @property
    def axes(self) -> tuple[str, ...]:
        """The one or two axes that it acts on, if its scope has any."""
        return self.places if self.effect.scope in ("axis", "axis_pair") else ()

    @property
    def name(self) -> str:
        """Canonical name: ``stribeck:yaw``, ``force_delay``."""
        return f"{self.effect.name}:{self.target}" if self.target else self.effect.name

    @property
    def prefix(self) -> str:
        """Prefix of its parameters' names: ``stribeck.yaw``."""
        return self.name.replace(":", ".")

    def target_of(self, key: str) -> str:
        """The axis, force or channel that the expression ``key`` acts on."""
        place = key.partition(".")[2]
        if self.effect.scope == "axis_pair" and place:
            return self.axes[PAIR.index(place)]
        return place or self.target


effect_from = Effect.from_declaration


def bind(effect: Effect, target: str, device: Device, pulled: Collection[str] = ()) -> BoundEffect:
    """Place ``effect`` at ``target`` of ``device``.

    Args:
        pulled: axes on which other effects of the model pull by position.

    Raises:
        InputError: the target does not exist there, or a parameter lacks its entry for that kind
            of axis.
    """
    targets = effect.places(device)
    if not targets:
        raise InputError(
            f"effect {effect.name!r} needs something that device {device.name!r} does not have"
        )
    if target not in targets:
        choices = ", ".join(f"{effect.name}:{t}" if t else effect.name for t in targets)
        hint = did_you_mean(target, targets)
        kinds = {c.name: c.kind for c in device.coordinates}
        if target in kinds and effect._lacks_kind(kinds[target]):
            hint = f": a parameter has no entry for a {kinds[target]} axis"
        raise InputError(
            f"effect {effect.name!r} has no target {target!r}{hint}"
            if target
            else f"effect {effect.name!r} needs a target",
            remedy=f"choose from {choices}",
        )
    places = targets[target]
    axes = places if effect.scope in ("axis", "axis_pair") else ()
    kind = device.coordinate(axes[0]).kind if axes else ""
    prefix = f"{effect.name}.{target}" if target else effect.name
    bound = []
    for name, entry in effect.parameters.items():
        chosen = getattr(entry, kind, None) if isinstance(entry, ParameterByKind) else entry
        if chosen is None:
            raise InputError(
                f"no entry for a {kind or 'device'} parameter",
                where=f"effect {effect.name!r}: parameters.{name}",
            )
        unit = unit_of(chosen.unit, effect, places, device)
        about = chosen.description or entry.description
        # The weight of a robot's bodies is excluded, since no effect can be separated from it.
        others = pulled if device.robot is None else ()
        held = chosen.needs_pull and not any(device.has_weight(a) or a in others for a in axes)
        bound.append(
            chosen.renamed(
                f"{prefix}.{name}", unit=unit, description=about, fixed=chosen.fixed or held
            )
        )
    return BoundEffect(effect, target, tuple(bound), places)


def unit_of(unit: str, effect: Effect, places: Sequence[str], device: Device) -> str:
    """``unit`` of a parameter or state with ``input`` replaced by that of the channel acted on.

    For a pair of axes, ``other`` stands for the unit of the second.
    """
    own = device.channels[places[0]] if effect.scope == "channel" else device.force_unit
    units = {"input": own}
    if effect.scope == "axis_pair":
        units["other"] = device.coordinate(places[1]).unit
    above: list[str] = []
    below: list[str] = []
    for sign, part in _split_unit(unit):
        for inner, piece in _split_unit(units[part]) if part in units else [("*", part)]:
            (above if sign == inner or (sign, inner) == ("/", "/") else below).append(piece)
    return (".".join(above) or ("1" if below else "")) + "".join(f"/{p}" for p in below)


def state_units(item: BoundEffect, device: Device) -> dict[str, str]:
    """The unit of every state of a bound effect, by the name of the state."""
    kind = device.coordinate(item.axes[0]).kind if item.axes else ""
    units = {s.name: (getattr(s, kind, None) or s).unit for s in item.effect.states}
    return {s: unit_of(unit, item.effect, item.places, device) for s, unit in units.items()}


def _split_unit(unit: str) -> list[tuple[str, str]]:
    """Factors of a unit text, each with ``*`` or ``/``."""
    results = re.findall(r"([./]?)([^./]+)", unit)
    return [("/" if sign == "/" else "*", part) for sign, part in results if part != "1"]
