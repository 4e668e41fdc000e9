"""Lagrange's equation on energies (eqs 9-14), and checks of a mechanical model."""

from functools import cache
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import sympy as sp

from bampipe.errors import InputError
from bampipe.physics.model import Model

_PRINTABLE: tuple[Any, ...] = (sp.sin, sp.cos, sp.tan, sp.exp, sp.log, sp.tanh, sp.atan)
_PRINTABLE += (sp.Abs, sp.sign, sp.Heaviside)
_INFINITE = (sp.nan, sp.oo, -sp.oo, sp.zoo, sp.I)


def allow(what: str, exprs: list[Any], allowed: list[Any], words: str) -> None:
    """Raise InputError unless ``exprs`` use ``allowed`` symbols only and can be computed."""
    for expr in (sp.sympify(e, strict=True) for e in exprs):
        if expr.free_symbols - set(allowed):
            raise InputError(f"{what} may depend on {words} only")
        odd = [f for f in expr.atoms(sp.Function, sp.Derivative) if not isinstance(f, _PRINTABLE)]
        if odd or expr.has(*_INFINITE):
            raise InputError(
                f"{what} is not smooth enough to be differentiated, or not finite",
                remedy="keep sgn, abs, heaviside, min and max out of energies and offsets",
            )


def check_inertia(model: Model, mass: list[list[Any]], symbols: list[Any]) -> None:
    """Raise InputError if no pose gives every coordinate an inertia."""
    numbers = {s: 0.37 * (i + 1) % 1.3 for i, s in enumerate(symbols)}
    numbers |= {
        sp.Symbol(f"p{i}", real=True): p.prior or 1.0 for i, p in enumerate(model.parameters)
    }
    values = np.array(
        [
            [_value(m, frozenset((s, numbers[s]) for s in m.free_symbols)) for m in row]
            for row in mass
        ]
    )
    if np.linalg.matrix_rank(values) < len(values):
        rows = zip(model.device.coordinates, values, strict=True)
        bare = [c.name for c, v in rows if not v.any()]
        raise InputError(
            f"{'coordinate ' + bare[0] if bare else 'some coordinate'} has no inertia of its own",
            where=f"device {model.device.name!r}: energy.kinetic",
            remedy="the kinetic energy must grow with the rate of every coordinate",
        )


@cache
def _value(expression: Any, numbers: frozenset[tuple[Any, float]]) -> float:
    return float(expression.subs(dict(numbers)))


@cache
def lagrange(
    kinetic: Any, potential: Any, q: tuple[Any, ...], qd: tuple[Any, ...]
) -> tuple[list[list[Any]], list[Any]]:
    """Mass matrix (eq 13) and bias (eq 12 with accelerations zero) of one pair of energies.

    Lagrange's equation is linear in the energies, so each effect's are derived on their own and
    the device's, which take seconds to simplify, only once.

    Raises:
        InputError: the kinetic energy is not quadratic in the rates.
    """
    mass = [[sp.expand_trig(sp.simplify(sp.diff(kinetic, a, b))) for b in qd] for a in qd]
    still = dict.fromkeys(qd, 0)
    lower = [kinetic.subs(still), *(sp.diff(kinetic, a).subs(still) for a in qd)]
    if any(e.has(*qd) for row in mass for e in row) or any(sp.simplify(e) != 0 for e in lower):
        raise InputError("the kinetic energy must be quadratic in the rates")
    # Christoffel's symbols of the simplified matrix: the same as d/dt dT/dqd - dT/dq, but compact.
    bias = []
    for i, a in enumerate(q):
        total = sp.diff(potential, a)
        for j, k in combinations_with_replacement(range(len(q)), 2):
            slope = sp.diff(mass[i][j], q[k]) + sp.diff(mass[i][k], q[j]) - sp.diff(mass[j][k], a)
            total += (slope / 2 if j == k else slope) * qd[j] * qd[k]
        bias.append(total)
    return mass, bias
