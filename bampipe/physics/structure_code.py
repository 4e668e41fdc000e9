"""Derivation of which numbers of a model no motion can tell apart; see `structure`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp

from bampipe.physics.codegen import ARRAY_HEADER, function_source
from bampipe.physics.derivation import derive
from bampipe.physics.equations import Equations
from bampipe.physics.model import Model
from bampipe.physics.readable import notation
from bampipe.physics.structure import Combination, DeterminableNumber
from bampipe.physics.vocabulary import constant_symbol


def structure_code(model: Model) -> tuple[dict[str, Any], dict[str, str]]:
    """The groups and numbers of a model, as JSON holds them, and the source of the slopes."""
    equations = derive(model, named_constants=True)
    groups, numbers, pivots = _split(model, equations)
    facts = {
        "together": [[list(g.members), list(g.combinations)] for g in groups],
        "numbers": [[n.name, n.value, n.unit] for n in numbers],
    }
    return facts, {"slopes": ARRAY_HEADER + _slope_source(model, equations, pivots)}


def _split(
    model: Model, e: Equations
) -> tuple[list[Combination], list[DeterminableNumber], list[str]]:
    """Return groups, numbers that data could determine, and the constant that stands for each."""
    constants = {constant_symbol(c): c for c in model.device.constants}
    names = constants | dict(zip(e.p, (p.name for p in model.parameters), strict=True))
    motion = {*e.q, *e.qd, *e.z, *e.u}
    factors: list[Any] = []
    quiet = dict.fromkeys(e.w, 0)
    # Where no motion is, there is no force. Of a robot's bodies, see `base_parameters`.
    for expr in (e.kinetic, e.potential) if model.device.robot is None else ():
        factors += _factors(expr - expr.subs(dict.fromkeys(motion, 0)), motion, set(names))
    for expr in (*e.applied, *e.other, *e.rates, *e.offset):
        factors += _factors(sp.sympify(expr, strict=True).subs(quiet), motion, set(names))
    known: set[Any] = set()
    while True:
        left = _distinct([_stripped(f, known) for f in factors])
        new = {next(iter(f.free_symbols)) for f in left if len(f.free_symbols) == 1}
        new = new or _determined(left)
        if not new:
            break
        known |= new
    at = {symbol: model.device.constants[name].value for symbol, name in constants.items()}
    numbers = [
        DeterminableNumber(name, at[symbol], model.device.constants[name].unit)
        for symbol, name in constants.items()
        if symbol in known
    ]
    pivots = [number.name for number in numbers]
    groups = []
    for members in _connected([f.free_symbols for f in left]):
        own = [f for f in left if f.free_symbols <= members]
        ordered = tuple(name for symbol, name in names.items() if symbol in members)
        groups.append(Combination(ordered, tuple(notation(f, names) for f in own)))
        for sum_ in own:
            pivot = _pivot(sum_, own, constants)
            if pivot is not None:
                unit = model.device.constants[constants[pivot]].unit
                numbers.append(
                    DeterminableNumber(notation(sum_, names), float(sum_.subs(at)), unit)
                )
                pivots.append(constants[pivot])
    return groups, numbers, pivots


def _determined(factors: Sequence[Any]) -> set[Any]:
    """Return the symbols that all factors together determine: no change of the others hides one."""
    symbols = sorted(set().union(*(f.free_symbols for f in factors)), key=sp.default_sort_key)
    if not symbols:
        return set()
    at = {s: 0.7 + 0.37 * i % 1.1 for i, s in enumerate(symbols)}
    slope = np.array([[float(sp.diff(f, s).subs(at)) for s in symbols] for f in factors])
    _, size, right = np.linalg.svd(slope)
    null = right[np.sum(size > 1e-9 * size[0]) :]
    return {s for i, s in enumerate(symbols) if np.all(np.abs(null[:, i]) < 1e-9)}


def _pivot(combination: Any, group: Sequence[Any], constants: Mapping[Any, str]) -> Any:
    """Return a constant that changes ``combination``, one for one, and no other of the group."""
    if not combination.free_symbols <= set(constants):
        return None
    for symbol in sorted(combination.free_symbols, key=sp.default_sort_key):
        alone = sum(f.has(symbol) for f in group) == 1
        if alone and sp.diff(combination, symbol) == 1:
            return symbol
    return None


def _factors(expr: Any, motion: set[Any], numbers: set[Any]) -> list[Any]:
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


def _stripped(factor: Any, known: set[Any]) -> Any:
    """Return the terms of ``factor`` that hold something unknown, without known multipliers."""
    kept = [t for t in sp.Add.make_args(factor) if t.free_symbols - known]
    if not kept:
        return sp.S.Zero
    total = sp.Add(*kept)
    common = sp.gcd_terms(total).as_independent(*(total.free_symbols - known), as_Add=False)[0]
    return sp.expand(total / common) if common.is_number or common.free_symbols <= known else total


def _distinct(factors: Sequence[Any]) -> list[Any]:
    """Return factors that are not multiples of each other, the shortest first."""
    kept: list[Any] = []
    present = [f for f in factors if f != 0]
    for factor in sorted(present, key=lambda f: (len(sp.Add.make_args(f)), sp.default_sort_key(f))):
        if all(not sp.cancel(factor / other).is_number for other in kept):
            kept.append(-factor if str(factor).startswith("-") else factor)
    return kept


def _connected(sets: Sequence[set[Any]]) -> list[set[Any]]:
    """Join sets that share an element."""
    joined: list[set[Any]] = []
    for one in map(set, sets):
        touching = [s for s in joined if s & one]
        joined = [s for s in joined if not s & one] + [one.union(*touching)]
    return joined


def _slope_source(model: Model, e: Equations, pivots: Sequence[str]) -> str:
    """Source of the slopes of the residual by the constants ``pivots``, axis by axis."""
    numbers: Mapping[Any, Any] = {
        constant_symbol(name): sp.Float(c.value) for name, c in model.device.constants.items()
    }
    quiet = dict.fromkeys(e.w, 0)
    slopes = []
    for a, o, f in zip(e.applied, e.other, e.dynamics, strict=True):
        residual = a + o - f
        for name in pivots:
            slope = sp.diff(residual, constant_symbol(name))
            slopes.append(sp.sympify(slope, strict=True).subs(quiet).subs(numbers))
    groups = {"q": e.q, "qd": e.qd, "qdd": e.qdd, "z": e.z, "u": e.u, "p": e.p}
    return function_source("slopes", groups, slopes, e.steps)
