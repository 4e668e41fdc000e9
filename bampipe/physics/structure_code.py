"""Derivation of the numbers of a model that no motion separates; see `structure`."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp

from bampipe.physics.codegen import ARRAY_HEADER, function_source
from bampipe.physics.derivation import derive
from bampipe.physics.equations import Equations, join_overlapping
from bampipe.physics.model import Model
from bampipe.physics.readable import notation
from bampipe.physics.vocabulary import constant_symbol


def structure_code(model: Model) -> tuple[dict[str, Any], dict[str, str]]:
    """The groups and numbers of a model, as JSON holds them, and the source of the slopes."""
    equations = derive(model, named_constants=True)
    groups, numbers, pivots = _separate_numbers(model, equations)
    facts = {"together": groups, "numbers": numbers}
    at = {constant_symbol(name): sp.Float(c.value) for name, c in model.device.constants.items()}
    slopes = [sp.diff(r, constant_symbol(n)).subs(at) for r in equations.residual for n in pivots]
    text = function_source("slopes", equations.groups("q qd qdd z u p"), slopes, equations.steps)
    return facts, {"slopes": ARRAY_HEADER + text}


def _separate_numbers(model: Model, e: Equations) -> tuple[list[Any], list[Any], list[str]]:
    """Return groups, numbers that data could determine, and the constant that stands for each.

    Groups as lists of members and combinations, numbers of name, value and unit: see `Structure`.
    """
    constants = {constant_symbol(c): c for c in model.device.constants}
    names = constants | dict(zip(e.p, (p.name for p in model.parameters), strict=True))
    motion = {*e.q, *e.qd, *e.z, *e.changes.values(), *e.u}
    factors: list[Any] = []
    # Without motion there is no force. For a robot's bodies, see `base_parameters`.
    for expr in (e.kinetic, e.potential) if model.device.robot is None else ():
        factors += _collect_factors(expr - expr.subs(dict.fromkeys(motion, 0)), motion, set(names))
    for expr in (*e.applied, *e.other, *e.rates, *e.offset):
        factors += _collect_factors(expr, motion, set(names))
    exact = {symbol for symbol, c in constants.items() if model.device.constants[c].sd == 0.0}
    known_symbols = exact
    while True:
        open_factors = _select_distinct([_strip_known(f, known_symbols) for f in factors])
        new_symbols = {next(iter(f.free_symbols)) for f in open_factors if len(f.free_symbols) == 1}
        new_symbols = new_symbols or _find_determined(open_factors)
        if not new_symbols:
            break
        known_symbols = known_symbols | new_symbols
    at = {symbol: model.device.constants[name].value for symbol, name in constants.items()}
    numbers: list[Any] = [
        [name, at[symbol], model.device.constants[name].unit]
        for symbol, name in constants.items()
        if symbol in known_symbols - exact
    ]
    pivots: list[str] = [name for name, *_ in numbers]
    groups = []
    for members in join_overlapping([f.free_symbols for f in open_factors]):
        own = [f for f in open_factors if f.free_symbols <= members]
        ordered = [name for symbol, name in names.items() if symbol in members]
        groups.append([ordered, [notation(f, names) for f in own]])
        for sum_ in own:
            pivot = _find_pivot(sum_, own, constants)
            if pivot is not None:
                unit = model.device.constants[constants[pivot]].unit
                numbers.append([notation(sum_, names), float(sum_.subs(at)), unit])
                pivots.append(constants[pivot])
    return groups, numbers, pivots


def _find_determined(factors: Sequence[Any]) -> set[Any]:
    """Return the symbols that all factors together determine, whatever the others are."""
    symbols = sorted(set().union(*(f.free_symbols for f in factors)), key=sp.default_sort_key)
    if not symbols:
        return set()
    at = {s: 0.7 + 0.37 * i % 1.1 for i, s in enumerate(symbols)}
    slope = np.array([[float(sp.diff(f, s).subs(at)) for s in symbols] for f in factors])
    _, size, right = np.linalg.svd(slope)
    null = right[np.sum(size > 1e-9 * size[0]) :]
    return {s for i, s in enumerate(symbols) if np.all(np.abs(null[:, i]) < 1e-9)}


def _find_pivot(combination: Any, group: Sequence[Any], constants: Mapping[Any, str]) -> Any:
    """Return a constant that changes ``combination``, one for one, and no other of the group."""
    if not combination.free_symbols <= set(constants):
        return None
    for symbol in sorted(combination.free_symbols, key=sp.default_sort_key):
        alone = sum(f.has(symbol) for f in group) == 1
        if alone and sp.diff(combination, symbol) == 1:
            return symbol
    return None


def _collect_factors(expr: Any, motion: set[Any], numbers: set[Any]) -> list[Any]:
    """Return the factor of each function of the motion in ``expr``, like terms collected.

    A number inside a function of the motion shapes that function and so enters on its own.
    """
    squares = sp.expand(expr).replace(
        lambda f: f.is_Pow and isinstance(f.base, sp.sin) and f.exp.is_Integer and f.exp >= 2,
        lambda f: (
            (1 - sp.cos(f.base.args[0]) ** 2) ** (int(f.exp) // 2) * f.base ** (int(f.exp) % 2)
        ),
    )
    collected: dict[Any, Any] = {}
    shapes: set[Any] = set()
    for term in sp.Add.make_args(sp.expand(squares)):
        factor, moving = term.as_independent(*motion, as_Add=False)
        collected[moving] = collected.get(moving, 0) + factor
        shapes |= moving.free_symbols & numbers
    return [*collected.values(), *shapes]


def _strip_known(factor: Any, known_symbols: set[Any]) -> Any:
    """Return the terms of ``factor`` that hold something unknown, without known multipliers."""
    terms_kept = [t for t in sp.Add.make_args(factor) if t.free_symbols - known_symbols]
    if not terms_kept:
        return sp.S.Zero
    total = sp.Add(*terms_kept)
    unknown = total.free_symbols - known_symbols
    common, _ = sp.gcd_terms(total).as_independent(*unknown, as_Add=False)
    is_known = common.is_number or common.free_symbols <= known_symbols
    return sp.expand(total / common) if is_known else total


def _select_distinct(factors: Sequence[Any]) -> list[Any]:
    """Return factors that are not multiples of each other, the shortest first."""
    terms_kept: list[Any] = []
    present = [f for f in factors if f != 0]
    for factor in sorted(present, key=lambda f: (len(sp.Add.make_args(f)), sp.default_sort_key(f))):
        if all(not sp.cancel(factor / other).is_number for other in terms_kept):
            terms_kept.append(-factor if str(factor).startswith("-") else factor)
    return terms_kept
