"""Symbolic regression of a residual: formulas of any form in several quantities.

The optional library pyoperon breeds expressions in ratios of the axis' quantities. After expansion,
an expression is a sum of products whose coefficients are forces. It becomes a `Form`, and so do
shorter sums of its products.
"""

import importlib
import re
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np

from bampipe.arrays import Array
from bampipe.diagnosis.drafts.columns import FormDictionary
from bampipe.diagnosis.drafts.forms import FORCE, Form, Quantity, list_quantities
from bampipe.diagnosis.drafts.shapes import Shape
from bampipe.errors import InputError
from bampipe.physics.expression import build, parse
from bampipe.trials.linear_problem import LinearProblem

EXTRA = "formulas"
"""Extra of bampipe that installs pyoperon."""
_FOLLOWED = ("position", "velocity", "direction", "command")
"""Quantities of formulas. A formula in a measured force could cancel that force, and time has
structured forms."""
_ROUNDS = 2
"""Number of searches; the model's own parameters adapt to each formula before the next."""
_MOST_SAMPLES = 1000
_BREEDING = {
    "allowed_symbols": "add,sub,mul,constant,variable,sin,exp,tanh,abs,square",
    "objectives": ["r2", "length"], "max_length": 20, "max_depth": 8, "population_size": 500,
    "generations": 30, "optimizer_iterations": 3, "epsilon": 1e-4, "n_threads": 1,
}  # fmt: skip
_MOST_CONSTANTS = 8
_DIGITS = 6
_NEGLIGIBLE = 0.01
"""Share of the largest coefficient of a sum below which a product is left out."""


def is_available() -> bool:
    """Return whether pyoperon is installed."""
    return find_spec("pyoperon") is not None


def breed(forms: FormDictionary, problem: LinearProblem) -> None:
    """Add formulas for the residual of ``problem`` on the axis of ``forms``."""
    device, axis = forms.linearisation.system.model.device, forms.axis
    known = [
        q
        for q in list_quantities(device, axis)
        if q.quantity in _FOLLOWED and q.words in forms.spans
    ]
    x = np.column_stack([_ratios(forms, q) for q in known])
    root, base = problem.likelihood.root[axis], problem.base[axis]
    unweighted = base / root[:, None]
    found: dict[str, tuple[Form, dict[str, float]]] = {}
    for text in _breed_expressions(-problem.y[axis] / root, unweighted, x):
        for parts in _choices(_read(text, len(known))):
            form, numbers = write_form(forms, known, parts)
            if len(form.parameters) <= _MOST_CONSTANTS:
                found.setdefault(form.expression, (form, numbers))
    for number, (form, numbers) in enumerate(found.values(), 1):
        forms.candidates[f"{form.name} {number}"] = form
        forms.starts[f"{form.name} {number}"] = numbers


def _ratios(forms: FormDictionary, quantity: Quantity) -> Array:
    """Return a quantity over its reach, low-passed like the residual, (n,)."""
    span = forms.spans[quantity.words]
    middle = span.middle if quantity.quantity == "position" else 0.0
    return (forms.thin(quantity.words) - middle) / (0.5 * span.width)


def _breed_expressions(wanted: Array, base: Array, x: Array) -> list[str]:
    """Return expressions in ``x`` (n, k) for ``wanted`` (n,) beside ``base`` (n, P)."""
    breeder = importlib.import_module("pyoperon.sklearn").SymbolicRegressor
    some = slice(None, None, -(-len(x) // _MOST_SAMPLES))
    taken = base @ np.linalg.pinv(base)
    left, found = wanted - taken @ wanted, []
    sought = left
    for number in range(_ROUNDS):
        regressor = breeder(**_BREEDING, random_state=number + 1)
        regressor.fit(x[some], sought[some])
        front = sorted(regressor.pareto_front_, key=lambda entry: entry["complexity"])
        found += [regressor.get_model_string(entry["tree"], _DIGITS) for entry in front]
        # The model's own parameters had absorbed part of the formula.
        sought = left + taken @ regressor.predict(x)
    return found


def _read(text: str, count: int) -> dict[Any, float]:
    """Return the products of a bred expression in ``X1``, ... with their coefficients.

    The constant has the product 1. An expression with meaningless numbers has no products.
    """
    import sympy as sp

    symbols = {f"X{k + 1}": sp.Symbol(f"X{k + 1}", real=True) for k in range(count)}
    try:
        whole = build(parse(text.replace("^", "**"), "a formula"), symbols, "a formula", {})
    except InputError:
        return {}
    found: dict[Any, float] = {}
    for part in sp.Add.make_args(sp.expand_mul(whole)):
        coefficient, product = part.as_coeff_Mul()
        found[product] = found.get(product, 0.0) + float(coefficient)
    largest = max((abs(c) for p, c in found.items() if p != 1), default=0.0)
    return {p: c for p, c in found.items() if abs(c) > _NEGLIGIBLE * largest}


def _choices(parts: Mapping[Any, float]) -> list[list[Any]]:
    """Return the products of a formula, largest coefficients first, and those of shorter ones."""
    products = sorted((p for p in parts if p != 1), key=lambda p: -abs(parts[p]))
    whole = [*products, *(p for p in parts if p == 1)]
    shorter = [products[: k + 1] for k in range(len(products))]
    less = [[p for p in whole if p != one] for one in products if len(products) > 1]
    return [choice for choice in [whole, *shorter, *less] if choice and products]


def write_form(
    forms: FormDictionary, known: Sequence[Quantity], products: Sequence[Any]
) -> tuple[Form, dict[str, float]]:
    """Return a sum of products of ``X1``, ... as a form, and its numbers by name."""
    import sympy as sp

    numbers = sorted({n for p in products for n in p.atoms(sp.Float)}, key=float)
    names = {n: sp.Symbol(f"c{k + 1}") for k, n in enumerate(numbers)}
    used = sorted({int(s.name[1:]) for p in products for s in p.free_symbols})
    place = {number: k for k, number in enumerate(used)}
    chosen = [known[number - 1] for number in used]
    fixed: list[str] = []

    def ratio(found: re.Match[str]) -> str:
        k = place[int(found[1])]
        mark, kind = (str(k + 1) if k else ""), chosen[k].quantity
        if kind == "direction":
            return f"x{mark}"
        scales = [f"middle{mark}", f"reach{mark}"] if kind == "position" else [f"reach{mark}"]
        fixed.extend(s for s in scales if s not in fixed)
        moved = f"(x{mark} - middle{mark})" if kind == "position" else f"x{mark}"
        return f"({moved}/reach{mark})"

    texts = []
    for k, p in enumerate(products):
        text = re.sub(r"\bX(\d+)\b", ratio, str(p.xreplace(names)).replace("Abs(", "abs("))
        part = f"({text})" if p.is_Add else text
        texts.append(f"h{k + 1}" if p == 1 else f"h{k + 1}*{part}")
    strengths = {f"h{k + 1}": f"factor of part {k + 1}" for k in range(len(products))}
    shape = Shape(
        "formula", " + ".join(texts), strengths, {str(c): "number" for c in names.values()},
        tuple(fixed), "follows a formula in {x}",
    )  # fmt: skip
    (first, span), *beside = ((q, forms.spans[q.words]) for q in chosen)
    axis = forms.linearisation.system.model.device.coordinates[forms.axis]
    form = Form(axis, forms.axis, FORCE, shape, first, span, forms.times, 1.0, tuple(beside))
    return form, {str(name): float(n) for n, name in names.items()}
