"""A device: coordinates, energies, inputs, friction, all declared in one TOML file."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from bampipe.errors import InputError
from bampipe.physics import expression
from bampipe.physics.parameter import Parameter, parameter_from

_KEYS = frozenset(
    "schema name summary source coordinates constants definitions energy torque inputs applied "
    "side_load process_noise friction parameters limits default_effects motor".split()
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
    brakes: Mapping[str, str]
    applied: Mapping[str, ast.expr]
    side_load: Mapping[str, ast.expr]
    process_noise: Mapping[str, Mapping[str, ast.expr]]
    parameters: tuple[Parameter, ...]
    frictional: tuple[str, ...]
    limits: Mapping[str, tuple[float, float]]
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
            f"device {self.name!r} has no axis {name!r}{expression.did_you_mean(name, known)}",
            remedy=f"its axes are {', '.join(known)}",
        )

    @property
    def components(self) -> tuple[str, ...]:
        """Short names of the force components: ``x`` for the channel ``force_x``."""
        return tuple(name.removeprefix("force_") for name in self.forces)


def _table(
    declaration: Mapping[str, Any], key: str, where: str, required: bool
) -> dict[str, Any]:
    value = declaration.get(key, {})
    if not isinstance(value, Mapping) or (required and not value):
        raise InputError(f"table [{key}] is missing or not a table", where=where)
    return dict(value)


def _expressions(table: Mapping[str, Any], where: str) -> dict[str, ast.expr]:
    return {
        name: expression.parse(text, f"{where}.{name}") for name, text in table.items()
    }


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
            f"unknown table {unknown[0]!r}{expression.did_you_mean(unknown[0], _KEYS)}",
            where=where,
        )
    name = declaration.get("name")
    if not isinstance(name, str) or not name:
        raise InputError("name is missing", where=where)
    coordinates = []
    for key, entry in _table(declaration, "coordinates", where, True).items():
        at = f"{where}: coordinates.{key}"
        if not key.isidentifier():
            raise InputError("a coordinate's name must be an identifier", where=at)
        if not isinstance(entry, Mapping) or entry.get("kind") not in UNITS:
            raise InputError("kind must be 'rotary' or 'linear'", where=at)
        width = entry.get("sign_width", 1e-3 if entry["kind"] == "rotary" else 2.5e-4)
        if not isinstance(width, int | float) or not width > 0:
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
            or abs(value) > 1e30
        ):
            raise InputError(
                "expected { value = number, unit = text, source = text }", where=at
            )
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
            raise InputError(
                f"unknown axis{expression.did_you_mean(axis, axes)}", where=at
            )
        if not isinstance(terms, Mapping) or set(terms) != {"viscous", "coulomb"}:
            raise InputError(
                "give viscous and coulomb, each with unit, prior, sd", where=at
            )
        frictional.append(axis)
        for term in ("viscous", "coulomb"):
            parameters.append(
                parameter_from(f"{term}.{axis}", terms[term], f"{at}.{term}")
            )
    for key, entry in _table(declaration, "parameters", where, False).items():
        parameters.append(parameter_from(key, entry, f"{where}: parameters.{key}"))
    noise = {}
    for key, entry in _table(declaration, "process_noise", where, False).items():
        at = f"{where}: process_noise.{key}"
        if not isinstance(entry, Mapping) or not isinstance(
            entry.get("torque"), Mapping
        ):
            raise InputError("expected a table with [torque] per axis", where=at)
        noise[key] = _expressions(entry["torque"], at)
    limits = {}
    for axis, entry in _table(declaration, "limits", where, False).items():
        limits[axis] = (float(entry["lower"]), float(entry["upper"]))
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
        potential=expression.parse(
            energy.get("potential", "0"), f"{where}: energy.potential"
        ),
        torque=_expressions(
            _table(declaration, "torque", where, False), f"{where}: torque"
        ),
        forces=tuple(inputs.get("force", ())),
        force_unit=str(inputs.get("force_unit", "N")),
        brakes=dict(inputs.get("brakes", {})),
        applied=_expressions(
            _table(declaration, "applied", where, True), f"{where}: applied"
        ),
        side_load=_expressions(
            _table(declaration, "side_load", where, False), f"{where}: side_load"
        ),
        process_noise=noise,
        parameters=tuple(parameters),
        frictional=tuple(frictional),
        limits=limits,
        declaration=declaration,
    )
    for label, table in (
        ("torque", device.torque),
        ("applied", device.applied),
        ("side_load", device.side_load),
        ("brakes", device.brakes),
    ):
        for axis in table:
            if axis not in axes:
                raise InputError(
                    f"unknown axis {axis!r}{expression.did_you_mean(axis, axes)}",
                    where=f"{where}: {label}",
                    remedy=f"axes are {', '.join(axes)}",
                )
    return device
