"""A device: coordinates, energies, inputs, friction, all declared in one TOML file."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from bampipe.errors import InputError, did_you_mean
from bampipe.physics import expression
from bampipe.physics.controller import Controller, controller_from
from bampipe.physics.parameter import LARGEST, Parameter, parameter_from

_KEYS = frozenset(
    [
        "schema",
        "name",
        "summary",
        "source",
        "coordinates",
        "constants",
        "definitions",
        "energy",
        "torque",
        "inputs",
        "applied",
        "side_load",
        "process_noise",
        "friction",
        "parameters",
        "limits",
        "default_effects",
        "controller",
    ]
)
UNITS = MappingProxyType({"rotary": "rad", "linear": "m"})
TORQUE_UNITS = MappingProxyType({"rotary": "N.m", "linear": "N"})


@dataclass(frozen=True)
class Coordinate:
    """One generalised coordinate.

    Attributes:
        name: as used in expressions and column names.
        kind: ``rotary`` (rad) or ``linear`` (m).
        symbol: how a person writes it.
        sign_width: speed over which the sign of the velocity is smoothed, rad/s or m/s.
    """

    name: str
    kind: str
    symbol: str
    sign_width: float

    @property
    def unit(self) -> str:
        return UNITS[self.kind]

    @property
    def torque_unit(self) -> str:
        return TORQUE_UNITS[self.kind]


@dataclass(frozen=True)
class Constant:
    """A number taken from drawings or data sheets, with where it comes from."""

    value: float
    unit: str
    source: str = ""
    description: str = ""


@dataclass(frozen=True)
class Device:
    """A mechanism as its file declares it; expressions are checked trees, not code."""

    name: str
    summary: str
    source: str
    coordinates: tuple[Coordinate, ...]
    constants: Mapping[str, Constant]
    definitions: Mapping[str, ast.expr]
    kinetic: ast.expr
    potential: ast.expr
    torque: Mapping[str, ast.expr]
    forces: tuple[str, ...]
    force_unit: str
    drive: bool
    brakes: Mapping[str, str]
    channels: Mapping[str, str]
    applied: Mapping[str, ast.expr]
    side_load: Mapping[str, ast.expr]
    process_noise: Mapping[str, Mapping[str, ast.expr]]
    parameters: tuple[Parameter, ...]
    frictional: tuple[str, ...]
    limits: Mapping[str, tuple[float, float]]
    controller: Controller | None
    default_effects: tuple[str, ...]
    declaration: Mapping[str, Any] = field(repr=False, compare=False)

    def coordinate(self, name: str) -> Coordinate:
        """The coordinate called ``name``.

        Raises:
            InputError: there is none.
        """
        for coordinate in self.coordinates:
            if coordinate.name == name:
                return coordinate
        known = [c.name for c in self.coordinates]
        raise InputError(
            f"device {self.name!r} has no axis {name!r}{did_you_mean(name, known)}",
            remedy=f"its axes are {', '.join(known)}",
        )

    def rubs(self, axis: str) -> bool:
        """Whether the device adds dry friction of its own to ``axis``, beside the base term."""
        tree = self.torque.get(axis)
        calls = [n.func for n in ast.walk(tree) if isinstance(n, ast.Call)] if tree else []
        return any(isinstance(f, ast.Name) and f.id == "sgn" for f in calls)

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


def _table(declaration: Mapping[str, Any], key: str, where: str, required: bool) -> dict[str, Any]:
    value = declaration.get(key, {})
    if not isinstance(value, Mapping) or (required and not value):
        raise InputError(f"table [{key}] is missing or not a table", where=where)
    return dict(value)


def _expressions(table: Mapping[str, Any], where: str) -> dict[str, ast.expr]:
    return {name: expression.parse(text, f"{where}.{name}") for name, text in table.items()}


def device_from(declaration: Mapping[str, Any], where: str = "device file") -> Device:
    """Check a device declaration and make a `Device` of it.

    Args:
        declaration: the parsed TOML of a device file.
        where: its name, for messages.

    Raises:
        InputError: something is missing, unknown or of the wrong type; names the field.
    """
    unknown = sorted(set(declaration) - _KEYS)
    if unknown:
        raise InputError(
            f"unknown table {unknown[0]!r}{did_you_mean(unknown[0], _KEYS)}",
            where=where,
        )
    if declaration.get("schema", "bampipe.device/1") != "bampipe.device/1":
        raise InputError("schema must be 'bampipe.device/1'", where=where)
    name = declaration.get("name")
    if not isinstance(name, str) or not name:
        raise InputError("name is missing", where=where)
    coordinates = []
    for key, entry in _table(declaration, "coordinates", where, True).items():
        at = f"{where}: coordinates.{key}"
        if not isinstance(entry, Mapping) or entry.get("kind") not in (*UNITS,):
            raise InputError("kind must be 'rotary' or 'linear'", where=at)
        _known(entry, ("kind", "symbol", "sign_width"), at)
        width = entry.get("sign_width", 1e-3 if entry["kind"] == "rotary" else 2.5e-4)
        if isinstance(width, bool) or not isinstance(width, int | float) or not 0 < width < 1e3:
            raise InputError("sign_width must be a positive speed", where=at)
        coordinates.append(
            Coordinate(key, entry["kind"], str(entry.get("symbol", key)), float(width))
        )
    axes = {c.name: c for c in coordinates}
    constants = {}
    for key, entry in _table(declaration, "constants", where, False).items():
        at = f"{where}: constants.{key}"
        value = entry.get("value") if isinstance(entry, Mapping) else None
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not abs(value) < expression.MAX_NUMBER
        ):
            raise InputError("expected { value = number, unit = text, source = text }", where=at)
        _known(entry, ("value", "unit", "source", "description", "sd"), at)
        constants[key] = Constant(
            float(value),
            str(entry.get("unit", "")),
            str(entry.get("source", "")),
            str(entry.get("description", "")),
        )
    energy = _table(declaration, "energy", where, True)
    inputs = _table(declaration, "inputs", where, True)
    parameters: list[Parameter] = []
    frictional = []
    for axis, terms in _table(declaration, "friction", where, False).items():
        at = f"{where}: friction.{axis}"
        if axis not in axes:
            raise InputError(f"unknown axis{did_you_mean(axis, axes)}", where=at)
        if not isinstance(terms, Mapping) or set(terms) != {"viscous", "coulomb"}:
            raise InputError("give viscous and coulomb, each with unit, prior, sd", where=at)
        frictional.append(axis)
        for term in ("viscous", "coulomb"):
            parameters.append(parameter_from(f"{term}.{axis}", terms[term], f"{at}.{term}"))
    for key, entry in _table(declaration, "parameters", where, False).items():
        expression.check_name(key, f"{where}: parameters")
        parameters.append(parameter_from(key, entry, f"{where}: parameters.{key}"))
    noise = {}
    for key, entry in _table(declaration, "process_noise", where, False).items():
        at = f"{where}: process_noise.{key}"
        if not isinstance(entry, Mapping) or not isinstance(entry.get("torque"), Mapping):
            raise InputError("expected a table with [torque] per axis", where=at)
        noise[key] = _expressions(entry["torque"], at)
    limits = {}
    for axis, entry in _table(declaration, "limits", where, False).items():
        at = f"{where}: limits.{axis}"
        pair: list[Any] = []
        if isinstance(entry, Mapping):
            pair = [entry.get("lower"), entry.get("upper")]
        if not pair or any(isinstance(v, bool) or not isinstance(v, int | float) for v in pair):
            raise InputError("expected { lower = number, upper = number }", where=at)
        if not all(abs(v) <= LARGEST for v in pair):
            raise InputError(f"limits must be numbers of at most {LARGEST:.0e}", where=at)
        limits[axis] = (float(pair[0]), float(pair[1]))
        if not limits[axis][0] < limits[axis][1]:
            raise InputError("lower must be below upper", where=at)
    effects = declaration.get("default_effects", [])
    if not isinstance(effects, list | tuple) or not all(isinstance(e, str) and e for e in effects):
        raise InputError(
            'expected a list such as ["stribeck:joint"]', where=f"{where}: default_effects"
        )
    forces = inputs.get("force", [])
    if not isinstance(forces, list | tuple) or not all(
        isinstance(f, str) and f not in ("", "force_") for f in forces
    ):
        raise InputError("force must be a list of channel names", where=f"{where}: inputs")
    _known(inputs, ("force", "force_unit", "drive", "brakes", "channels"), f"{where}: inputs")
    if not isinstance(inputs.get("drive", False), bool):
        raise InputError("drive must be true or false", where=f"{where}: inputs")
    channels = inputs.get("channels", {})
    if not isinstance(channels, Mapping) or not all(isinstance(u, str) for u in channels.values()):
        raise InputError("channels must be a table, name = unit", where=f"{where}: inputs")
    brakes = inputs.get("brakes", {})
    if not isinstance(brakes, Mapping):
        raise InputError("brakes must be a table, axis = channel", where=f"{where}: inputs")
    device = Device(
        name=name,
        summary=str(declaration.get("summary", "")),
        source=str(declaration.get("source", "")),
        coordinates=tuple(coordinates),
        constants=constants,
        definitions=_expressions(
            _table(declaration, "definitions", where, False), f"{where}: definitions"
        ),
        kinetic=expression.parse(energy.get("kinetic"), f"{where}: energy.kinetic"),
        potential=expression.parse(energy.get("potential", "0"), f"{where}: energy.potential"),
        torque=_expressions(_table(declaration, "torque", where, False), f"{where}: torque"),
        forces=tuple(forces),
        force_unit=str(inputs.get("force_unit", "N")),
        drive=inputs.get("drive", False),
        brakes=dict(brakes),
        channels=dict(channels),
        applied=_expressions(_table(declaration, "applied", where, True), f"{where}: applied"),
        side_load=_expressions(
            _table(declaration, "side_load", where, False), f"{where}: side_load"
        ),
        process_noise=noise,
        parameters=tuple(parameters),
        frictional=tuple(frictional),
        limits=limits,
        controller=controller_from(
            declaration.get("controller"), tuple(forces), f"{where}: controller"
        ),
        default_effects=tuple(effects),
        declaration=declaration,
    )
    for label, table in (
        ("torque", device.torque),
        ("applied", device.applied),
        ("side_load", device.side_load),
        ("brakes", device.brakes),
        ("limits", device.limits),
        *((f"process_noise.{k}", table) for k, table in device.process_noise.items()),
    ):
        for axis in table:
            if axis not in axes:
                raise InputError(
                    f"unknown axis {axis!r}{did_you_mean(axis, axes)}",
                    where=f"{where}: {label}",
                    remedy=f"axes are {', '.join(axes)}",
                )
    _check_names(device, where)
    return device


def _known(entry: Mapping[str, Any], keys: tuple[str, ...], where: str) -> None:
    """Raise InputError for a key of ``entry`` that is not one of ``keys``."""
    for key in entry:
        if key not in keys:
            raise InputError(f"unknown key {key!r}{did_you_mean(key, keys)}", where=where)


def _check_names(device: Device, where: str) -> None:
    """Raise InputError where a name cannot stand in an expression or means two things."""
    axes = [c.name for c in device.coordinates]
    rates = [derivative(f, k) for f in device.forces for k in range(1, len(INPUT_ORDERS))]
    taken = dict.fromkeys(["t", *(f"qd_{a}" for a in axes), *rates], "a built-in symbol")
    for label, names in (
        ("coordinates", axes),
        ("inputs.force", device.forces),
        ("inputs.brakes", device.brakes.values()),
        ("inputs.channels", device.channels),
        ("controller.channels", device.controller.channels if device.controller else ()),
        ("controller.states", device.controller.states if device.controller else ()),
        ("constants", device.constants),
        ("definitions", device.definitions),
        ("parameters", [p.name for p in device.parameters if "." not in p.name]),
    ):
        for name in names:
            expression.check_name(name, f"{where}: {label}")
            if name in taken:
                raise InputError(
                    f"{name!r} is the name of {taken[name]} already", where=f"{where}: {label}"
                )
            taken[name] = f"one of {label}"
