"""A device's equations of motion in readable form."""

import re
from collections.abc import Container, Iterable, Mapping, Sequence
from typing import Any

import sympy as sp
from sympy.printing.str import StrPrinter

from bampipe import generated_code
from bampipe.physics.base_parameters import base_parameters
from bampipe.physics.derivation import derive
from bampipe.physics.device import Device
from bampipe.physics.model import Model
from bampipe.physics.robot import Robot
from bampipe.physics.vocabulary import constant_symbol


class _Notation(StrPrinter):  # type: ignore[misc]
    """Sympy's text, with ``^`` for powers, spaces for products and four digits of a number."""

    def _print_Float(self, expr: Any) -> str:
        return f"{float(expr):.4g}"

    def _print_Pow(self, expr: Any, rational: bool = False) -> str:
        return super()._print_Pow(expr, rational).replace("**", "^")

    def _print_Mul(self, expr: Any) -> str:
        return super()._print_Mul(expr).replace("*", " ")


def notation(expr: Any, names: Mapping[Any, str]) -> str:
    """``expr`` as text, its symbols by ``names``."""
    plain = {symbol: sp.Symbol(name, real=True) for symbol, name in names.items()}
    return str(_Notation().doprint(expr.xreplace(plain)))


def describe_equations(device: Device) -> str:
    """The derived equations of motion, line by line.

    Rates carry primes: ``θ'`` is the first, ``θ''`` the second derivative. Numbers of the device
    stand by their names; definitions are put in.

    Returns:
        Text of several lines: coordinates, energies, mass matrix M, terms h, generalised forces Q
        of M q'' + h = Q.

    Raises:
        InputError: an expression of the device is wrong.
    """
    if device.robot is not None:
        return _describe_robot(device, device.robot)
    model = Model(device)
    known = _print_templates(model, [p.name for p in model.parameters])
    axes = (
        f"  {c.symbol} = {c.name}, {c.unit}; generalised force in {c.torque_unit}"
        for c in device.coordinates
    )
    lines = [
        f"{device.name}: {device.summary}", "", "Coordinates", *axes,
        "", "Energies", "  kinetic   = q'ᵀ M q' / 2", f"  potential = {known['potential']}",
        "", "M q'' + h = Q, where", *(f"  {left}{right}" for left, right in known["lines"]),
        "", "Numbers", *_list_numbers(device),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def model_equations(model: Model, values: Mapping[str, float]) -> tuple[str, ...]:
    """The equations of motion of a model with its effects, ``values`` of parameters put in.

    They are derived once for each content of the model, then read from the cache.

    Returns:
        Lines for the entries of M, h and Q of M q'' + h = Q, and for the rates of internal states;
        parameters without a value, and numbers of the device, stand by their names.

    Raises:
        InputError: an expression is wrong, or deriving takes too long.
    """
    names = [p.name for p in model.parameters]
    places = [f"#{number}#" for number in range(len(names))]
    code = generated_code.load(
        f"{model.key}_print_equations", lambda: (_print_templates(model, places), {})
    )
    labels = [_format_number(values[name]) if name in values else name for name in names]

    def fill_template(template: str) -> str:
        text = re.sub(r"#(\d+)#", lambda found: labels[int(found[1])], template)
        # Otherwise two numbers would read as one.
        return re.sub(r"(?<=[\w)]) (?=\d)", " · ", _join_signs(text))

    return tuple(left + fill_template(right) for left, right in code.facts["lines"])


def _print_templates(model: Model, labels: Sequence[str]) -> dict[str, Any]:
    """Potential energy and equations of motion as text, parameters by their ``labels``.

    Returns:
        ``potential``, and ``lines``: pairs of what is defined and its expression.
    """
    device = model.device
    e = derive(model, named_constants=True)
    marks = [c.symbol for c in device.coordinates]
    names: dict[Any, str] = {constant_symbol(c): c for c in device.constants}
    rates, seconds = [f"{m}'" for m in marks], [f"{m}''" for m in marks]
    for symbols, texts in (
        (e.q, marks), (e.qd, rates), (e.qdd, seconds),
        (e.u, e.inputs), (e.z, e.z_names), (e.p, labels),
        (e.changes.values(), [f"d {e.z_names[e.z.index(z)]}/dt" for z in e.changes]),
    ):  # fmt: skip
        names |= zip(symbols, texts, strict=True)
    sign = sp.Function("sgn")

    def text(expr: Any) -> str:
        plain = sp.sympify(expr, strict=True)
        # A factor of 1.0 is redundant, and 2.0 is 2.
        plain = plain.xreplace({f: sp.Integer(f) for f in plain.atoms(sp.Float) if f == int(f)})
        for rate in e.qd:
            plain = plain.replace(
                lambda f, rate=rate: isinstance(f, sp.tanh) and f.args[0].free_symbols == {rate},
                lambda f, rate=rate: sign(rate),
            )
        return notation(plain, names)

    lines: list[tuple[str, str]] = []
    if device.robot is not None:  # hundreds of lines, of which nobody would read one
        bodies = "rigid bodies on joints, by Newton and Euler's equations, and the drives"
        lines.append(("M, h: ", bodies))
    else:
        for i, a in enumerate(marks):
            for j, b in enumerate(marks):
                if j >= i and e.mass[i][j] != 0:
                    lines.append((f"M[{a},{b}] = ", text(e.mass[i][j])))
        lines += [(f"h[{a}] = ", text(h)) for a, h in zip(marks, e.bias, strict=True)]
    for a, applied, other in zip(marks, e.applied, e.other, strict=True):
        lines.append((f"Q[{a}] = ", text(applied + other)))
    lines += [(f"d {z}/dt = ", text(rate)) for z, rate in zip(e.z_names, e.rates, strict=True)]
    return {"potential": text(e.potential), "lines": lines}


def _join_signs(text: str) -> str:
    """Return a sum in which a negative number that was put in has one sign."""
    negative = r"\(-([\d.]+)\)(?!\^)"
    text = re.sub(rf"(^|\()-{negative}", r"\1\2", text)
    text = re.sub(rf"- {negative}", r"+ \1", text)
    return re.sub(rf"\+ {negative}", r"- \1", text)


def _format_number(value: float) -> str:
    """A number as it stands in a formula."""
    text = f"{value:.4g}"
    return f"({text})" if value < 0.0 or "e" in text else text


_HEAD = ["joint", "kind", "after", "at, m", "axis", "range"]
_HEAD += ["mass, kg", "centre, m", "moments, kg.m2"]


def _describe_robot(device: Device, robot: Robot) -> str:
    """Return the chain as a table, one line per joint, then its prior information."""
    rows = [_HEAD]
    for joint in robot.joints:
        unit = "rad" if joint.kind == "revolute" else "m"
        low, high = device.limits.get(joint.name, (None, None))
        after = joint.after or robot.base or "base"
        after += f", follows {joint.follows}" if joint.follows else ""
        place, axis = _join_numbers(joint.position), _join_numbers(joint.axis)
        limits = "" if low is None else f"{low:.4g} to {high:.4g} {unit}"
        body = (_join_numbers(n) for n in ([joint.mass], joint.center, joint.principal_moments))
        rows.append([joint.name, joint.kind, after, place, axis, limits, *body])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    padded = ([cell.ljust(n) for cell, n in zip(row, widths, strict=True)] for row in rows)
    table = [f"  {'  '.join(row).rstrip()}" for row in padded]
    free = sum(not p.fixed for p in robot.parameters)
    lines = [f"{device.name}: {device.summary}".rstrip(": "), "", "Joints", *table, ""]
    if device.source:
        lines += [f"Source: {device.source}", ""]
    count, combined = len(robot.parameters), len(base_parameters(robot))
    lines += [f"Of {count} inertial numbers {free} act on some joint, in {combined} combinations."]
    lines += [f"Physically impossible: {line}." for line in robot.impossible]
    lines += ["", "Numbers", *_list_numbers(device, {p.name for p in robot.parameters})]
    return "\n".join(lines) + "\n"


def _join_numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value:.4g}" for value in values)


def _list_numbers(device: Device, hidden: Container[str] = ()) -> list[str]:
    """One line a constant and a parameter: value, unit, where from."""
    rows = {n: (f"{c.value:g} {c.unit}", c.source) for n, c in device.constants.items()}
    rows |= {
        p.name: (f"{p.prior:g} ± {p.sd:g} {p.unit}", "prior, to be estimated")
        for p in device.parameters
        if p.name not in hidden
    }
    return [f"  {n} = {v.strip()}" + (f"  ({s})" if s else "") for n, (v, s) in rows.items()]
