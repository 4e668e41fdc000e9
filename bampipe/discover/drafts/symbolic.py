"""Symbolic regression of a residual: formulas in several quantities, of any form.

pyoperon, an optional library, breeds expressions of ratios of the axis' quantities. What it finds
is brought into one form, a sum of products, whose leading factors are forces and whose other
numbers are pure, and becomes a `Form` like any other: refined, fitted with the model, and weighed.
"""

from __future__ import annotations

import ast
import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.drafts.forms import FORCE, Form
from bampipe.discover.drafts.quantities import Quantity, coordinates
from bampipe.discover.drafts.screen import Screen, Screened
from bampipe.discover.drafts.shapes import Shape
from bampipe.discover.settings import Settings

Array = NDArray[np.float64]

NAME = "formula"
"""Of the shape of what is found."""
EXTRA = "formulas"
"""The extra of bampipe that brings pyoperon."""
_FOLLOWED = ("position", "velocity", "direction", "command")
"""Quantities that a formula may hold: no force, for one that cancels the measured force explains
anything; time has structured forms."""
_CENTRED = "position"
"""Positions are counted from the middle of their range, all others from zero."""
_HIGHEST = 50.0
"""Of an exponent: beyond it a formula has no meaning, and must still be a number."""
_FUNCTIONS: Mapping[str, Callable[[Array], Array]] = {
    "sin": np.sin,
    "exp": lambda v: np.exp(np.minimum(v, _HIGHEST)),
    "tanh": np.tanh,
    "abs": np.abs,
    "square": np.square,
}
_ROUNDS = 3
"""Searches, each for what is left beside what the model's own parameters take of the last one."""
_MOST_SAMPLES = 1000
_BREEDING = {
    "allowed_symbols": ",".join(["add", "sub", "mul", "constant", "variable", *_FUNCTIONS]),
    "objectives": ["r2", "length"], "max_length": 20, "max_depth": 8, "population_size": 500,
    "generations": 30, "optimizer_iterations": 3, "epsilon": 1e-4, "n_threads": 1,
}  # fmt: skip
_MOST_CONSTANTS = 8
_REFINED = 4
"""Formulas whose numbers are refined, the best first."""
_DIGITS = 6
_NEGLIGIBLE = 0.01
"""Of the largest coefficient of a sum; below it a part is left out: its quantities are ratios."""


def is_available() -> bool:
    """Whether pyoperon is installed."""
    return find_spec("pyoperon") is not None


@dataclass(frozen=True)
class Ratio:
    """A quantity over its reach; ``number`` counts from 1."""

    number: int


@dataclass(frozen=True)
class Call:
    """A function of a sum."""

    function: str
    inside: Sum


@dataclass(frozen=True)
class Sum:
    """A constant plus products, each a coefficient and its factors."""

    constant: float
    parts: tuple[tuple[float, tuple[Multiplicand, ...]], ...] = ()


Multiplicand = Ratio | Call | Sum


def search(screen: Screen) -> list[Screened]:
    """Formulas that may explain the residual of an axis, best first."""
    device = screen.signals.device
    known = [
        q
        for q in coordinates(device, screen.signals.axis)
        if q.quantity in _FOLLOWED and q.words in screen.spans
    ]
    x = np.column_stack([_ratios(screen, q) for q in known])
    found: dict[str, Screened] = {}
    worth = Settings().draft_worth * screen.fit.independent

    def cost(one: Screened) -> float:
        return worth * one.form.constants - one.gain

    for text in _bred(screen, x):
        for whole in _sums(text):
            form, _ = _form(screen, known, whole)
            if form.constants <= _MOST_CONSTANTS:
                found.setdefault(form.expression, _shortened(screen, known, whole, cost))
    ranked = sorted({f.form.expression: f for f in found.values()}.values(), key=cost)
    refined = [
        screen.refined(one.form, {n: one.values[n] for n in one.form.shape.searched})
        for one in ranked[:_REFINED]
    ]
    return sorted(refined, key=lambda one: -one.gain)


def _shortened(
    screen: Screen, known: Sequence[Quantity], whole: Sum, cost: Callable[[Screened], float]
) -> Screened:
    """A sum without the parts that are not worth their constants."""
    best = screen.at(*_form(screen, known, whole))
    while len(whole.parts) > 1:
        shorter = [
            Sum(whole.constant, whole.parts[:k] + whole.parts[k + 1 :])
            for k in range(len(whole.parts))
        ]
        tried = [(screen.at(*_form(screen, known, part)), part) for part in shorter]
        found, part = min(tried, key=lambda one: cost(one[0]))
        if cost(found) >= cost(best):
            break
        best, whole = found, part
    return best


def _ratios(screen: Screen, quantity: Quantity) -> Array:
    """A quantity over its reach where the residual is, (n,), low-passed as that is."""
    span = screen.spans[quantity.words]
    middle = span.middle if quantity.quantity == _CENTRED else 0.0
    return (screen.signals.thinned(quantity.words) - middle) / (0.5 * span.width)


def _bred(screen: Screen, x: Array) -> list[str]:
    """Expressions of ``x`` (n, k) for what the model leaves, as text, shorter ones first."""
    breeder = importlib.import_module("pyoperon.sklearn").SymbolicRegressor
    some = slice(None, None, -(-len(x) // _MOST_SAMPLES))
    wanted, found = -screen.fit.left, []
    for number in range(_ROUNDS):
        regressor = breeder(**_BREEDING, random_state=number + 1)
        regressor.fit(x[some], wanted[some])
        front = sorted(regressor.pareto_front_, key=lambda entry: entry["complexity"])
        found += [regressor.get_model_string(entry["tree"], _DIGITS) for entry in front]
        # What the model's own parameters took of the formula belongs to it.
        wanted = -screen.fit.left + screen.fit.taken(regressor.predict(x))
    return found


def _sums(text: str) -> list[Sum]:
    """A bred expression without its constant part, and with it where it is not negligible."""
    try:
        bred = _read(ast.parse(text, mode="eval").body)
    except (OverflowError, ValueError):
        return []  # numbers beyond any meaning
    if not bred.parts:
        return []
    found = [Sum(0.0, bred.parts)]
    if abs(bred.constant) > _NEGLIGIBLE * max(abs(c) for c, _ in bred.parts):
        found.append(bred)
    return found


def _form(screen: Screen, known: Sequence[Quantity], whole: Sum) -> tuple[Form, dict[str, float]]:
    """A sum as a form, and the numbers in it."""
    used = sorted(_used(whole))
    chosen = [known[k - 1] for k in used]
    writer = _Writer(used, [q.quantity for q in chosen])
    shape = writer.shape(whole)
    (first, span), *beside = ((q, screen.spans[q.words]) for q in chosen)
    of = screen.signals
    axis = of.device.coordinates[of.axis]
    form = Form(axis, of.axis, FORCE, shape, first, span, of.times, 1.0, tuple(beside))
    return form, dict(zip(shape.searched, writer.numbers, strict=True))


def _used(value: Multiplicand) -> set[int]:
    if isinstance(value, Ratio):
        return {value.number}
    if isinstance(value, Call):
        return _used(value.inside)
    return set().union(*(_used(f) for _, factors in value.parts for f in factors), set())


def _read(node: ast.expr) -> Sum:
    """The sum of products that an expression of pyoperon stands for.

    Raises:
        ValueError: it holds what was not asked for; or a number that is not finite.
    """
    match node:
        case ast.Constant(value=float() | int() as value):
            if not np.isfinite(value):
                raise ValueError("not finite")
            return Sum(float(value))
        case ast.Name(id=name):
            return Sum(0.0, ((1.0, (Ratio(int(name[1:])),)),))
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return _times(Sum(-1.0), _read(operand))
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return _plus(_read(left), _read(right))
        case ast.BinOp(left=left, op=ast.Sub(), right=right):
            return _plus(_read(left), _times(Sum(-1.0), _read(right)))
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            return _times(_read(left), _read(right))
        case ast.BinOp(left=left, op=ast.BitXor(), right=ast.Constant(value=2)):
            return _call("square", _read(left))
        case ast.Call(func=ast.Name(id=name), args=[inside]) if name in _FUNCTIONS:
            return _call(name, _read(inside))
    raise ValueError(ast.unparse(node))


def _call(name: str, inside: Sum) -> Sum:
    if not inside.parts:
        return Sum(float(_FUNCTIONS[name](np.array(inside.constant))))
    if name in ("square", "abs"):
        # Their scale goes before them: one number fewer.
        scale, factors = _as_product(inside)
        inner = factors[0] if len(factors) == 1 else Sum(0.0, ((1.0, factors),))
        body = inner if isinstance(inner, Sum) else Sum(0.0, ((1.0, (inner,)),))
        return Sum(0.0, ((float(_FUNCTIONS[name](np.array(scale))), (Call(name, body),)),))
    return Sum(0.0, ((1.0, (Call(name, inside),)),))


def _plus(a: Sum, b: Sum) -> Sum:
    parts: dict[tuple[Multiplicand, ...], float] = {}
    for coefficient, factors in (*a.parts, *b.parts):
        parts[factors] = parts.get(factors, 0.0) + coefficient
    largest = max((abs(c) for c in parts.values()), default=0.0)
    kept = tuple((c, f) for f, c in parts.items() if abs(c) > _NEGLIGIBLE * largest)
    return Sum(a.constant + b.constant, kept)


def _times(a: Sum, b: Sum) -> Sum:
    for one, other in ((a, b), (b, a)):
        if not one.parts:
            c = one.constant
            parts = tuple((c * k, f) for k, f in other.parts) if c else ()
            return Sum(c * other.constant, parts)
    (k, left), (m, right) = _as_product(a), _as_product(b)
    return Sum(0.0, ((k * m, tuple(sorted((*left, *right), key=repr))),))


def _as_product(a: Sum) -> tuple[float, tuple[Multiplicand, ...]]:
    """Coefficient and factors; a sum of several parts is one factor, its first coefficient 1."""
    if len(a.parts) == 1 and a.constant == 0.0:
        return a.parts[0]
    lead = a.parts[0][0]
    return lead, (Sum(a.constant / lead, tuple((c / lead, f) for c, f in a.parts)),)


Value = Callable[[Array, Mapping[str, Any]], Any]
"""Of quantities (T, k) and constants."""


class _Writer:
    """Text and value of a sum of products, its numbers named ``c1``, ``c2``, ... in order."""

    def __init__(self, used: Sequence[int], kinds: Sequence[str]) -> None:
        self._place = {number: k for k, number in enumerate(used)}
        self._kinds = kinds
        self.numbers: list[float] = []

    def shape(self, whole: Sum) -> Shape:
        """The shape whose strengths are the coefficients of ``whole``, its constant as well."""
        texts, values = [], []
        for _, factors in whole.parts:
            text, value = self._product(factors)
            texts.append(f"*{text}")
            values.append(value)
        if whole.constant:
            texts.append("")
            values.append(lambda x, c: np.ones((len(x), 1)))
        names = [f"h{k + 1}" for k in range(len(texts))]
        many = len(self._kinds)
        middles = [f"middle{_mark(k)}" for k in range(many) if self._kinds[k] == _CENTRED]
        reaches = [f"reach{_mark(k)}" for k in range(many) if self._kinds[k] != "direction"]
        return Shape(
            NAME, " + ".join(f"{n}{t}" for n, t in zip(names, texts, strict=True)),
            {name: f"of part {k + 1} of the formula" for k, name in enumerate(names)},
            {f"c{k + 1}": "number" for k in range(len(self.numbers))}, (*middles, *reaches),
            lambda x, c: tuple(value(x, c) for value in values), "follows a formula in {x}",
        )  # fmt: skip

    def _product(self, factors: Sequence[Multiplicand]) -> tuple[str, Value]:
        texts, values = zip(*(self._factor(f) for f in factors), strict=True)
        return "*".join(texts), lambda x, c: np.prod(
            np.broadcast_arrays(*(value(x, c) for value in values)), axis=0
        )

    def _factor(self, factor: Multiplicand) -> tuple[str, Value]:
        match factor:
            case Ratio(number):
                return self._ratio(self._place[number])
            case Call("square", inside):
                text, value = self._sum(inside)
                return f"{text}**2", lambda x, c: value(x, c) ** 2
            case Call(name, inside):
                text, value = self._sum(inside)
                return f"{name}{text}", lambda x, c: _FUNCTIONS[name](value(x, c))
            case Sum():
                return self._sum(factor)

    def _ratio(self, k: int) -> tuple[str, Value]:
        mark = _mark(k)
        if self._kinds[k] == "direction":
            return f"x{mark}", lambda x, c: x[:, k : k + 1]
        if self._kinds[k] == _CENTRED:
            middle, reach = f"middle{mark}", f"reach{mark}"
            text = f"((x{mark} - {middle})/{reach})"
            return text, lambda x, c: (x[:, k : k + 1] - c[middle]) / c[reach]
        reach = f"reach{mark}"
        return f"(x{mark}/{reach})", lambda x, c: x[:, k : k + 1] / c[reach]

    def _sum(self, whole: Sum) -> tuple[str, Value]:
        texts: list[str] = []
        values: list[Value] = []
        if whole.constant:
            name = self._number(whole.constant)
            texts.append(name)
            values.append(_scaled(name))
        for coefficient, factors in whole.parts:
            text, value = self._product(factors)
            if coefficient != 1.0:
                name = self._number(coefficient)
                text, value = f"{name}*{text}", _scaled(name, value)
            texts.append(text)
            values.append(value)
        return f"({' + '.join(texts)})", lambda x, c: sum(value(x, c) for value in values)

    def _number(self, value: float) -> str:
        self.numbers.append(value)
        return f"c{len(self.numbers)}"


def _scaled(name: str, value: Value = lambda x, c: 1.0) -> Value:
    return lambda x, c: c[name] * value(x, c)


def _mark(k: int) -> str:
    """What tells quantity ``k`` of a formula from the first one."""
    return str(k + 1) if k else ""
