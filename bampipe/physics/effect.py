"""An effect: one physical term that a model may have, declared in one TOML file."""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bampipe.errors import InputError, did_you_mean
from bampipe.physics import expression
from bampipe.physics.device import INPUT_ORDERS, Device, derivative
from bampipe.physics.parameter import Parameter, parameter_from

# What an effect of each kind must give, where it may apply.
_EXPRESSIONS = {
    "torque": (("torque",), ("axis", "device")),
    "input": (("input",), ("force_component", "force_pair", "channel", "device")),
    "energy": (("kinetic", "potential"), ("axis", "device")),
    "measurement": (("offset",), ("axis", "device")),
}
SCOPES = ("axis", "force_component", "force_pair", "channel", "device")
EACH = "each"
"""Place of a device-wide input effect that stands for every force channel."""
KINDS = ("torque", "input", "energy", "measurement")
_KEYS = frozenset(
    [
        "schema",
        "name",
        "summary",
        "scope",
        "kind",
        "torque",
        "input",
        "kinetic",
        "potential",
        "offset",
        "dissipative",
        "looks_like",
        "source",
        "parameters",
        "states",
        "devices",
        "drive",
    ]
)


@dataclass(frozen=True)
class State:
    """An internal state of an effect: its rate, where it starts, its unit by kind of axis."""

    name: str
    rate: ast.expr
    initial: ast.expr
    entry: Mapping[str, Any]


@dataclass(frozen=True)
class Effect:
    """A physical term as its file declares it; `at` binds it to a target of a device."""

    name: str
    summary: str
    scope: str
    kind: str
    expressions: Mapping[str, ast.expr]
    parameters: Mapping[str, Mapping[str, Any]]
    states: tuple[State, ...]
    dissipative: bool
    looks_like: str
    source: str
    devices: tuple[str, ...]
    drive: bool
    declaration: Mapping[str, Any] = field(repr=False, compare=False)

    def targets(self, device: Device) -> tuple[str, ...]:
        """Names after the colon that make sense for ``device``; ``("",)`` for a device effect."""
        if (self.devices and device.name not in self.devices) or (self.drive and not device.drive):
            return ()
        if self.scope == "axis":
            used = self._names()
            return tuple(
                c.name
                for c in device.coordinates
                if ("brake" not in used or c.name in device.brakes)
                and ("dry" not in used or device.rubs(c.name))
            )
        if self.scope == "channel":
            return tuple(device.channels)
        if self.scope == "force_component":
            return device.components
        if self.scope == "force_pair":
            return tuple(a + b for a in device.components for b in device.components if a != b)
        return ("",) if self._fits(device) else ()

    def _names(self) -> set[str]:
        """Every name that its expressions use."""
        trees = [*self.expressions.values()]
        trees += [tree for state in self.states for tree in (state.rate, state.initial)]
        return set().union(*map(expression.names, trees))

    def _fits(self, device: Device) -> bool:
        """Whether every name that a device-wide effect uses exists in ``device``."""
        known = set(device.definitions) | set(device.constants) | {"t"}
        known |= {c.name for c in device.coordinates} | {p.name for p in device.parameters}
        for force in device.forces:
            known |= {derivative(force, k) for k in range(len(INPUT_ORDERS))}
        known |= set(device.channels)
        known |= set(device.brakes.values()) | set(self.parameters) | {s.name for s in self.states}
        for c in device.coordinates:
            known |= {
                f"{prefix}_{c.name}" for prefix in ("qd", "applied", "viscous", "coulomb", "load")
            }
        keys = {key.partition(".")[2] for key in self.expressions} - {""}
        places = {c.name for c in device.coordinates} | set(device.forces)
        if EACH in keys and device.forces:
            places |= {EACH}
            known |= {derivative("f", k) for k in range(len(INPUT_ORDERS))}
        return keys <= places and self._names() <= known


@dataclass(frozen=True)
class BoundEffect:
    """An effect at its target: what a model is made of."""

    effect: Effect
    target: str
    parameters: tuple[Parameter, ...]

    @property
    def name(self) -> str:
        """Canonical name: ``stribeck:yaw``, ``force_delay``."""
        return f"{self.effect.name}:{self.target}" if self.target else self.effect.name

    @property
    def prefix(self) -> str:
        """Prefix of its parameters' names: ``stribeck.yaw``."""
        return self.name.replace(":", ".")

    def parameter(self, short: str) -> Parameter:
        """Its parameter called ``short``, such as ``force``."""
        return next(p for p in self.parameters if p.name == f"{self.prefix}.{short}")


def effect_from(declaration: Mapping[str, Any], where: str = "effect file") -> Effect:
    """Check an effect declaration and make an `Effect` of it.

    Args:
        declaration: the parsed TOML of an effect file.
        where: its name, for messages.

    Raises:
        InputError: something is missing, unknown or of the wrong type; names the field.
    """
    unknown = sorted(set(declaration) - _KEYS)
    if unknown:
        raise InputError(
            f"unknown key {unknown[0]!r}{did_you_mean(unknown[0], _KEYS)}",
            where=where,
        )
    if declaration.get("schema", "bampipe.effect/1") != "bampipe.effect/1":
        raise InputError("schema must be 'bampipe.effect/1'", where=where)
    for key in ("name", "summary", "scope", "kind", "looks_like", "source"):
        if not isinstance(declaration.get(key), str) or not declaration[key]:
            raise InputError(f"{key!r} is missing or not text", where=where)
    scope, kind = declaration["scope"], declaration["kind"]
    if scope not in SCOPES:
        raise InputError(f"scope {scope!r} is none of {', '.join(SCOPES)}", where=where)
    if kind not in KINDS:
        raise InputError(f"kind {kind!r} is none of {', '.join(KINDS)}", where=where)
    if not declaration["name"].isidentifier():
        raise InputError("name must be an identifier, such as magnetic_detent", where=where)
    main, scopes = _EXPRESSIONS[kind]
    if scope not in scopes:
        raise InputError(
            f"an effect of kind {kind!r} cannot have scope {scope!r}",
            where=where,
            remedy=f"scope may be {' or '.join(scopes)}",
        )
    for other in sorted({k for keys, _ in _EXPRESSIONS.values() for k in keys} - {*main}):
        if other in declaration:
            raise InputError(f"{other!r} has no meaning for kind {kind!r}", where=where)
    trees: dict[str, ast.expr] = {}
    for key in main:
        value = declaration.get(key)
        placed = scope == "device" and kind != "energy"
        if value is not None and isinstance(value, Mapping) != placed:
            raise InputError(
                f"{key!r} must be "
                + ("a table, one expression a place" if placed else "one expression"),
                where=where,
            )
        if isinstance(value, Mapping):
            for place, text in value.items():
                trees[f"{key}.{place}"] = expression.parse(text, f"{where}: {key}.{place}")
        elif value is not None:
            trees[key] = expression.parse(value, f"{where}: {key}")
    if not trees:
        raise InputError(
            f"an effect of kind {kind!r} needs {' or '.join(main)}",
            where=where,
        )
    parameters = declaration.get("parameters")
    if not isinstance(parameters, Mapping) or not parameters:
        raise InputError("[parameters.*] is missing", where=where)
    for name in parameters:
        expression.check_name(name, f"{where}: parameters")
    states = []
    tables = declaration.get("states", {})
    if not isinstance(tables, Mapping):
        raise InputError("states must be tables, [states.name]", where=where)
    devices = declaration.get("devices", [])
    if not isinstance(devices, list | tuple) or any(not isinstance(d, str) for d in devices):
        raise InputError("devices must be a list of names", where=where)
    for name, entry in tables.items():
        at = f"{where}: states.{name}"
        expression.check_name(name, f"{where}: states")
        if name in parameters:
            raise InputError("a parameter has this name already", where=at)
        if not isinstance(entry, Mapping) or "rate" not in entry:
            raise InputError("a state needs its rate", where=at)
        states.append(
            State(
                name,
                expression.parse(entry["rate"], f"{at}.rate"),
                expression.parse(str(entry.get("initial", "0")), f"{at}.initial"),
                entry,
            )
        )
    return Effect(
        name=declaration["name"],
        summary=declaration["summary"],
        scope=scope,
        kind=kind,
        expressions=trees,
        parameters=parameters,
        states=tuple(states),
        dissipative=bool(declaration.get("dissipative", False)),
        looks_like=declaration["looks_like"],
        source=declaration["source"],
        devices=tuple(devices),
        drive=bool(declaration.get("drive", False)),
        declaration=declaration,
    )


def bind(effect: Effect, target: str, device: Device) -> BoundEffect:
    """Place ``effect`` at ``target`` of ``device``.

    Raises:
        InputError: the target does not exist there, or a parameter lacks its entry for that kind
            of axis.
    """
    targets = effect.targets(device)
    if not targets:
        raise InputError(
            f"effect {effect.name!r} needs something that device {device.name!r} does not have"
        )
    if target not in targets:
        choices = ", ".join(f"{effect.name}:{t}" if t else effect.name for t in targets)
        hint = did_you_mean(target, targets)
        raise InputError(
            f"effect {effect.name!r} has no target {target!r}{hint}"
            if target
            else f"effect {effect.name!r} needs a target",
            remedy=f"choose from {choices}",
        )
    kind = device.coordinate(target).kind if effect.scope == "axis" else ""
    prefix = f"{effect.name}.{target}" if target else effect.name
    bound = []
    for name, entry in effect.parameters.items():
        where = f"effect {effect.name!r}: parameters.{name}"
        chosen = entry
        if isinstance(entry, Mapping) and ("rotary" in entry or "linear" in entry):
            if kind not in entry:
                raise InputError(f"no entry for a {kind or 'device'} parameter", where=where)
            chosen = {**entry[kind]}
            if "description" in entry:
                chosen.setdefault("description", entry["description"])
        if isinstance(chosen, Mapping) and isinstance(chosen.get("unit"), str):
            chosen = {**chosen, "unit": unit_of(chosen["unit"], effect, target, device)}
        bound.append(parameter_from(f"{prefix}.{name}", chosen, where))
    return BoundEffect(effect, target, tuple(bound))


def unit_of(unit: str, effect: Effect, target: str, device: Device) -> str:
    """``unit`` of a parameter or state with ``input`` replaced by that of the channel acted on."""
    own = device.channels[target] if effect.scope == "channel" else device.force_unit
    above: list[str] = []
    below: list[str] = []
    for sign, part in _factors(unit):
        for inner, piece in _factors(own) if part == "input" else [("*", part)]:
            (above if sign == inner or (sign, inner) == ("/", "/") else below).append(piece)
    return (".".join(above) or ("1" if below else "")) + "".join(f"/{p}" for p in below)


def _factors(unit: str) -> list[tuple[str, str]]:
    """Factors of a unit text, each with ``*`` or ``/``."""
    found = re.findall(r"([./]?)([^./]+)", unit)
    return [("/" if sign == "/" else "*", part) for sign, part in found if part != "1"]
