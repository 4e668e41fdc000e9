"""Dimensional analysis of device and effect files.

Units are written as products such as ``N.m.s/rad`` or ``kg.m2``: names joined by ``.``, each with
an optional whole exponent, and ``/`` before every name that divides. Only coherent SI units are
known, because values are used as they stand. A radian counts as a pure number.

A number in an expression is pure if it is a multiple of one quarter; any other may carry a unit
that the text does not show, and is let pass. Give such a number a name and a unit instead.
"""

import ast
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction

from bampipe.errors import InputError, did_you_mean
from bampipe.physics.device import INPUT_ORDERS, Device, derivative
from bampipe.physics.effect import EACH, PAIR, BoundEffect, Effect, bind, state_units

BASE = ("kg", "m", "s", "A", "K")


@dataclass(frozen=True)
class Dimension:
    """Exponents of the SI base units in `BASE`."""

    exponents: tuple[Fraction, ...] = (Fraction(0),) * len(BASE)

    def __mul__(self, other: "Dimension") -> "Dimension":
        pairs = zip(self.exponents, other.exponents, strict=True)
        return Dimension(tuple(a + b for a, b in pairs))

    def __truediv__(self, other: "Dimension") -> "Dimension":
        return self * other**-1

    def __pow__(self, power: Fraction | int) -> "Dimension":
        return Dimension(tuple(e * power for e in self.exponents))

    def __str__(self) -> str:
        for name in ("N.m", "N", "W"):
            if self == parse_unit(name, name):
                return name
        above = [(b, e) for b, e in zip(BASE, self.exponents, strict=True) if e > 0]
        below = [(b, -e) for b, e in zip(BASE, self.exponents, strict=True) if e < 0]
        text = ".".join(f"{b}{'' if e == 1 else e}" for b, e in above) or "1"
        text += "".join(f"/{b}{'' if e == 1 else e}" for b, e in below)
        return "a pure number" if text == "1" else text


PURE = Dimension()


def _dimension(kg: int = 0, m: int = 0, s: int = 0, ampere: int = 0, kelvin: int = 0) -> Dimension:
    return Dimension(tuple(Fraction(e) for e in (kg, m, s, ampere, kelvin)))


_UNITS = {
    "1": PURE, "rad": PURE, "m": _dimension(m=1), "kg": _dimension(kg=1), "s": _dimension(s=1),
    "A": _dimension(ampere=1), "K": _dimension(kelvin=1), "Hz": _dimension(s=-1),
    "N": _dimension(1, 1, -2), "Pa": _dimension(1, -1, -2), "J": _dimension(1, 2, -2),
    "W": _dimension(1, 2, -3), "V": _dimension(1, 2, -3, -1), "Ohm": _dimension(1, 2, -3, -2),
    "H": _dimension(1, 2, -2, -2), "F": _dimension(-1, -2, 4, 2), "C": _dimension(s=1, ampere=1),
    "T": _dimension(1, 0, -2, -1), "Wb": _dimension(1, 2, -2, -1),
}  # fmt: skip
_FACTOR = re.compile(r"([A-Za-z]+|1)(-?\d{1,2})?\Z")


def parse_unit(text: str, where: str) -> Dimension:
    """Dimension of a unit such as ``N.m.s2/rad2``; ``""`` is a pure number.

    Args:
        text: the unit.
        where: file and field, for messages.

    Raises:
        InputError: it is not a product of known coherent SI units.
    """
    total = PURE
    if not text:
        return total
    for sign, part in zip("." + re.sub(r"[^./]", "", text), re.split(r"[./]", text), strict=True):
        match = _FACTOR.match(part)
        if not match or match[1] not in _UNITS:
            raise InputError(
                f"unit {text!r:.60}: {part!r:.30} is not an SI unit known here",
                where=where,
                remedy=f"write products like N.m.s/rad of {', '.join(_UNITS)}",
            )
        total *= _UNITS[match[1]] ** (int(match[2] or 1) * (1 if sign == "." else -1))
    return total


# A dimension, or None if a number might carry any.
Found = Dimension | None


def dimension(tree: ast.expr, symbols: Mapping[str, Found]) -> Found:
    """Dimension of a checked expression, ``None`` where a number in it might carry any unit.

    Args:
        tree: from `expression.parse`.
        symbols: dimension of every name in it.

    Raises:
        InputError: a name is unknown, or quantities of unlike dimension are added or compared, or
            a function is given one that it cannot take.
    """
    match tree:
        case ast.Constant(value=value):
            quarters = 4.0 * float(value)  # type: ignore[arg-type]
            return PURE if quarters.is_integer() and quarters != 0.0 else None
        case ast.Name(id=name):
            if name not in symbols:
                raise InputError(f"unknown symbol {name!r}{did_you_mean(name, symbols)}")
            return symbols[name]
        case ast.UnaryOp(operand=operand):
            return dimension(operand, symbols)
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            base = dimension(left, symbols)
            power = Fraction(ast.literal_eval(right)).limit_denominator(1000)
            return None if base is None else base**power
        case ast.BinOp(left=left, op=op, right=right):
            a, b = dimension(left, symbols), dimension(right, symbols)
            if isinstance(op, ast.Add | ast.Sub):
                return _common_dimension(tree, [left, right], [a, b])
            if a is None or b is None:
                return None
            return a * b if isinstance(op, ast.Mult) else a / b
        case ast.Call(func=ast.Name(id=name), args=args):
            return _find_call_dimension(tree, name, args, [dimension(a, symbols) for a in args])
    raise AssertionError(f"unchecked node {type(tree).__name__}")


def _common_dimension(node: ast.expr, parts: list[ast.expr], found: list[Found]) -> Found:
    """Common dimension of ``parts``, which are added or compared in ``node``."""
    pairs = [(p, f) for p, f in zip(parts, found, strict=True) if f is not None]
    for part, other in pairs[1:]:
        if other != pairs[0][1]:
            raise InputError(
                f"{_quote(node)} puts together {_quote(pairs[0][0])} ({pairs[0][1]}) "
                f"and {_quote(part)} ({other})"
            )
    return pairs[0][1] if pairs else None


def _find_call_dimension(
    node: ast.expr, name: str, args: list[ast.expr], found: list[Found]
) -> Found:
    match name:
        case "abs":
            return found[0]
        case "sgn" | "heaviside":
            return PURE
        case "sqrt":
            return None if found[0] is None else found[0] ** Fraction(1, 2)
        case "ddt":
            return None if found[0] is None else found[0] / _UNITS["s"]
        case "min" | "max" | "clip":
            return _common_dimension(node, args, found)
    if found[0] not in (None, PURE):
        raise InputError(f"{name}() takes a pure number, and {_quote(args[0])} is in {found[0]}")
    return PURE


def _quote(node: ast.expr) -> str:
    text = ast.unparse(node)
    return repr(text if len(text) <= 60 else text[:57] + "...")


class _Findings:
    """Sentences about one file, collected while its expressions are checked."""

    def __init__(self) -> None:
        self.found: list[str] = []

    def unit(self, text: str, field: str) -> Found:
        """Dimension of a unit; a wrong one becomes a sentence and stays unknown."""
        try:
            return parse_unit(text, field)
        except InputError as error:
            self.found.append(str(error))
            return None

    def named(self, text: str, field: str, wanted: Dimension) -> None:
        """A unit that must have the dimension ``wanted``."""
        given = self.unit(text, field)
        if given not in (None, wanted):
            self.found.append(f"{field}: unit {text!r} where {wanted} is needed")

    def expression(
        self, tree: ast.expr, symbols: Mapping[str, Found], field: str, wanted: Found
    ) -> Found:
        """An expression that must have the dimension ``wanted``; any if that is ``None``."""
        try:
            given = dimension(tree, symbols)
        except InputError as error:
            self.found.append(f"{field}: {error}")
            return wanted
        if None not in (given, wanted) and given != wanted:
            self.found.append(f"{field}: is {given} where {wanted} is needed")
        return given


def _axes(device: Device) -> Iterator[tuple[str, Dimension, Dimension]]:
    """Name, dimension of the coordinate and of its generalised force, per axis."""
    for c in device.coordinates:
        yield c.name, parse_unit(c.unit, c.name), parse_unit(c.torque_unit, c.name)


def _device_symbols(device: Device, check: _Findings) -> dict[str, Found]:
    """Dimension of every name that the device's expressions may use."""
    second = _UNITS["s"]
    symbols: dict[str, Found] = {"t": second}
    for axis, unit, torque in _axes(device):
        symbols |= {axis: unit, f"qd_{axis}": unit / second}
        if axis in device.brakes:
            symbols[device.brakes[axis]] = torque
    force = check.unit(device.force_unit, "inputs.force_unit")
    for channel in device.forces:
        for order in range(len(INPUT_ORDERS)):
            rate_dimension = None if force is None else force / second**order
            symbols[derivative(channel, order)] = rate_dimension
    for name, unit_text in device.channels.items():
        symbols[name] = check.unit(unit_text, f"inputs.channels.{name}")
    for name, constant in device.constants.items():
        symbols[name] = check.unit(constant.unit, f"constants.{name}")
    for parameter in device.parameters:
        symbols[parameter.name] = check.unit(parameter.unit, f"parameters.{parameter.name}")
    for name, tree in device.definitions.items():
        symbols[name] = check.expression(tree, symbols, f"definitions.{name}", None)
    return symbols


def check_device(device: Device) -> list[str]:
    """Return the inconsistent units and symbols of a device file.

    Returns: One sentence per finding, the field first; empty if all is consistent.
    """
    check, joule = _Findings(), _UNITS["J"]
    symbols = _device_symbols(device, check)
    check.expression(device.kinetic, symbols, "energy.kinetic", joule)
    check.expression(device.potential, symbols, "energy.potential", joule)
    for axis, unit, torque in _axes(device):
        for label, table in (("torque", device.torque), ("applied", device.applied)):
            if axis in table:
                check.expression(table[axis], symbols, f"{label}.{axis}", torque)
        if axis in device.side_load:
            check.expression(device.side_load[axis], symbols, f"side_load.{axis}", None)
        for name, noise in device.process_noise.items():
            if axis in noise.torque:
                field = f"process_noise.{name}"
                own = check.unit(noise.unit, f"{field}.unit")
                wanted = None if own is None else torque / own
                check.expression(noise.torque[axis], symbols, f"{field}.torque.{axis}", wanted)
        if axis in device.friction:
            wanted_units = {"viscous": torque * _UNITS["s"] / unit, "coulomb": torque}
            for term, parameter in device.friction[axis]:
                check.named(parameter.unit, f"friction.{axis}.{term}", wanted_units[term])
    _check_controller(device, symbols, check)
    return list(dict.fromkeys(check.found))


def _check_controller(device: Device, symbols: Mapping[str, Found], check: _Findings) -> None:
    """Hold the control law's expressions to the unit of the forces that they command."""
    if device.controller is None:
        return
    parameters = {p.name for p in device.parameters}
    known_symbols = {name: of for name, of in symbols.items() if name not in parameters}
    for name, unit in device.controller.channels.items():
        known_symbols[name] = check.unit(unit, f"controller.channels.{name}")
    for name, state in device.controller.states.items():
        known_symbols[name] = check.unit(state.unit, f"controller.states.{name}")
    for name, state in device.controller.states.items():
        kept, second = known_symbols[name], _UNITS["s"]
        wanted = None if kept is None else kept / second
        check.expression(state.rate, known_symbols, f"controller.states.{name}.rate", wanted)
    for force, tree in device.controller.command.items():
        check.expression(tree, known_symbols, f"controller.command.{force}", symbols[force])


def _effect_symbols(item: BoundEffect, device: Device, check: _Findings) -> dict[str, Found]:
    """Dimension of every name that the expressions of a bound effect may use."""
    second = _UNITS["s"]
    symbols = _device_symbols(device, _Findings())
    for axis, unit, torque in _axes(device):
        terms = ("applied", "load", "coulomb", "weight", "pull", "support")
        symbols |= dict.fromkeys((f"{term}_{axis}" for term in terms), torque)
        symbols[f"viscous_{axis}"] = torque * second / unit
        if axis == item.target and item.effect.scope == "axis":
            symbols |= {"q": unit, "qd": unit / second, "brake": torque, "side_load": None}
            torques = (*terms, "dry", "dry_difference", "axis_bias", "axis_torque")
            symbols |= dict.fromkeys(torques, torque)
            symbols |= {"qdd": unit / second**2, "axis_inertia": torque * second**2 / unit}
            symbols["viscous"] = torque * second / unit
            if axis in device.side_load:
                side = device.side_load[axis]
                symbols["side_load"] = check.expression(side, symbols, f"side_load.{axis}", None)
        if axis in item.axes and item.effect.scope == "axis_pair":
            letter = PAIR[item.axes.index(axis)]
            symbols |= dict.fromkeys((f"q_{letter}", f"middle_{letter}"), unit)
            symbols[f"qd_{letter}"] = unit / second
    if item.effect.scope == "channel":
        symbols["f"] = symbols[item.target]
    of_each = any(key.endswith(f".{EACH}") for key in item.effect.expressions)
    letters = {"force_pair": "fg", "force_component": "f"}.get(item.effect.scope, "f" * of_each)
    for letter in letters:
        for order in range(len(INPUT_ORDERS)):
            symbols[derivative(letter, order)] = symbols[derivative(device.forces[0], order)]
    for p in item.parameters:
        short = p.name.removeprefix(f"{item.prefix}.")
        symbols[short] = check.unit(p.unit, f"parameters.{short}.unit")
    return symbols


def check_effect(effect: Effect, device: Device, target: str = "") -> list[str]:
    """Return the inconsistent units and symbols of an effect at ``target`` of ``device``.

    Args:
        target: axis, force component or pair; empty for an effect of scope ``device``.

    Returns: One sentence per finding, the field first; empty if all is consistent.

    Raises:
        InputError: the target does not exist.
    """
    check = _Findings()
    item = bind(effect, target, device)
    symbols = _effect_symbols(item, device, check)
    for name, unit in state_units(item, device).items():
        symbols[name] = check.unit(unit, f"states.{name}.unit")
    for name, tree in effect.definitions.items():
        symbols[name] = check.expression(tree, symbols, f"definitions.{name}", None)
    force = symbols[device.forces[0]] if device.forces else None
    wanted: dict[str, Callable[[str], Found]] = {
        "torque": {axis: torque for axis, _, torque in _axes(device)}.get,
        "offset": {axis: unit for axis, unit, _ in _axes(device)}.get,
        "input": lambda _: symbols[target] if effect.scope == "channel" else force,
        "kinetic": lambda _: _UNITS["J"],
        "potential": lambda _: _UNITS["J"],
    }
    for key, tree in effect.expressions.items():
        check.expression(tree, symbols, key, wanted[key.partition(".")[0]](item.target_of(key)))
    if effect.ahead is not None:
        at, second = symbols.get("q"), _UNITS["s"]
        check.expression(effect.ahead.share, symbols, "ahead.share", PURE)
        check.expression(effect.ahead.position, symbols, "ahead.position", at)
        check.expression(effect.ahead.rate, symbols, "ahead.rate", at and at / second)
    for state in effect.states:
        own = symbols[state.name]
        rate = None if own is None else own / _UNITS["s"]
        check.expression(state.rate, symbols, f"states.{state.name}.rate", rate)
        check.expression(state.initial, symbols, f"states.{state.name}.initial", own)
    return list(dict.fromkeys(check.found))
