"""The best values of parameters in which a residual is nonlinear, looked for on a grid."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.ranges import SearchRange, between

Array = NDArray[np.float64]

Cost = Callable[[Array], tuple[float, Array] | None]
"""cost(values) -> cost of the fit with the searched parameters at ``values``, and the columns
(n, m) that they make; None where they change nothing."""

_GRID = 7
_LARGEST_RATIO = 3.0
"""Of neighbours on the grid of a searched parameter."""
_NARROWINGS = 8
_FEWEST_NARROWINGS = 2
"""Values tried between the points of a grid: a parabola through these errs far from its vertex."""
_ENOUGH = 0.5
"""Fall of the cost, a log likelihood, that a next value must promise."""
_NEAR = 0.1
"""Of the widest gap beside the least, how near to that another value is tried."""
_LARGEST_RISE = 30.0
"""Logarithm of a mean square over the least one, beyond which it is as large as can be."""
_LEAST_LEFT = 1e-3
"""Share of a mean square that is thought to be left where a parabola promises to take all."""
_STARTS = (0.5, 0.8)
"""Shares of their ranges at which several searched parameters start, one after the other: a sharp
resonance is missed between the points of a grid, one that is damped well shows from afar."""
_SIMILAR = 0.7
_DENSEST = 48
_FAR = 3.0
"""Cost above a hopeless one from which on narrowing a grid is in vain: its columns resemble each
other, so that between two of them a fit gains at most a little more than at the better one."""


def scan_parameters(
    cost: Cost,
    ranges: Sequence[SearchRange],
    hopeless: float,
    has_columns: bool,
    count: float = np.inf,
) -> tuple[list[float], float] | None:
    """Best values of the searched parameters, and their cost; None if one never matters.

    Each is scanned over its range, finely enough that neighbours on the grid resemble each other,
    and narrowed around the best; several are taken in turn, from `_STARTS`.

    Args:
        cost: of the fit; ranges: of the parameters.
        hopeless: a cost above this after a scan ends the search.
        has_columns: whether columns can be compared.
        count: of independent samples: a cost is that many logarithms of a mean square.
    """
    starts = _STARTS if len(ranges) > 1 else _STARTS[:1]
    found = [_scan_in_turn(cost, ranges, share, hopeless, has_columns, count) for share in starts]
    return found[int(np.argmin([each[1] if each is not None else np.inf for each in found]))]


def _scan_in_turn(
    cost: Cost,
    ranges: Sequence[SearchRange],
    start: float,
    hopeless: float,
    has_columns: bool,
    count: float,
) -> tuple[list[float], float] | None:
    """The same, with every one at a share ``start`` of its range to begin with."""
    at, least = [r.within(start) for r in ranges], -np.inf
    for _ in range(min(len(ranges), 2)):
        for k in range(len(ranges)):
            found = _scan_one(cost, at, k, ranges, hopeless, has_columns, count)
            if found is None:
                return None
            at[k], least = found
            if least > hopeless:
                return at, least
    return at, least


def _scan_one(
    cost: Cost,
    at: Sequence[float],
    k: int,
    ranges: Sequence[SearchRange],
    hopeless: float,
    has_columns: bool,
    samples: float,
) -> tuple[float, float] | None:
    """Best value of parameter ``k``, the others held, and its cost; None if it never matters."""

    def cost_of(value: float) -> tuple[float, Array] | None:
        return cost(np.array([*at[:k], value, *at[k + 1 :]]))

    low, high = ranges[k].low, ranges[k].high
    count = _GRID if len(ranges) == 1 else _GRID - 2
    if ranges[k].by_ratio:
        count = max(count, min(int(np.log(high / low) / np.log(_LARGEST_RATIO)) + 2, 2 * _GRID))
        grid = list(np.geomspace(low, high, count))
    else:
        grid = list(np.linspace(low, high, count))
    if not np.isclose(grid, at[k], rtol=1e-6, atol=0.0).any():
        # Where the others were searched from must not be lost between two points.
        grid = sorted([*grid, at[k]])
    known = [cost_of(value) for value in grid]
    if all(found is None for found in known):
        return None
    i = 0
    while i + 1 < len(grid) and len(grid) < _DENSEST:
        first, second = known[i], known[i + 1]
        if has_columns and first and second and _similarity(first[1], second[1]) < _SIMILAR:
            middle = between(grid[i], grid[i + 1])
            grid.insert(i + 1, middle)
            known.insert(i + 1, cost_of(middle))
        else:
            i += 1
    costs = [found[0] if found else np.inf for found in known]
    j = int(np.argmin(costs))
    least, best = costs[j], grid[j]
    if has_columns and least > hopeless + _FAR:
        return float(best), float(least)
    return _narrow(cost_of, grid, costs, samples)


def _narrow(
    cost_of: Callable[[float], tuple[float, Array] | None],
    grid: list[float],
    costs: list[float],
    samples: float,
) -> tuple[float, float]:
    """The least cost around the best point of a grid, by parabolas through three points.

    Through the mean squares: near its best value what a shape leaves grows with the square of how
    far it is off, and the logarithm of that has a notch which no parabola resembles.
    """
    by_ratio = grid[0] > 0.0
    x = [float(np.log(value)) if by_ratio else value for value in grid]
    value_at = dict(zip(x, grid, strict=True))
    costs, gained = list(costs), np.inf
    for tried in range(_NARROWINGS):
        j = int(np.argmin(costs))
        near = slice(max(j - 1, 0), j + 2)
        u, promised = _vertex(x[near], costs[near], samples)
        if tried >= _FEWEST_NARROWINGS and max(promised, gained) < _ENOUGH:
            break
        value = float(np.exp(u)) if by_ratio else u
        found = cost_of(value)
        cost = found[0] if found is not None else np.inf
        gained = max(costs[j] - cost, 0.0)
        at = int(np.searchsorted(x, u))
        x.insert(at, u)
        costs.insert(at, cost)
        value_at[u] = value
    j = int(np.argmin(costs))
    return value_at[x[j]], costs[j]


def _vertex(x: Sequence[float], costs: Sequence[float], samples: float) -> tuple[float, float]:
    """Where to look next around the least of two or three costs, and the fall to expect there.

    The vertex of the parabola through three; the middle of the widest gap where there is none, and
    a little way into that gap where the vertex lies too near the least to tell more.
    """
    best = int(np.argmin(costs))
    gaps = [abs(other - x[best]) for other in x]
    widest = int(np.argmax(gaps))
    middle = 0.5 * (x[best] + x[widest])
    if len(x) < 3 or not np.isfinite(costs).all():
        return middle, 0.25 * float(max(costs) - min(costs))
    (a, b, c), (f, g, h) = x, _over_the_least(costs, samples)
    curvature = ((h - g) / (c - b) - (g - f) / (b - a)) / (c - a)
    if curvature <= 0.0:
        return middle, 0.0
    slope = (g - f) / (b - a) + curvature * (b - a)
    step = -0.5 * slope / curvature
    promised = _fall_of_cost(curvature * step**2, samples)
    if abs(step) < _NEAR * gaps[widest]:
        return b + _NEAR * (x[widest] - b), promised
    return b + step, promised


def _over_the_least(costs: Sequence[float], samples: float) -> list[float]:
    """By how much each mean square exceeds the least one, in its own size times ``samples``."""
    over = [cost - min(costs) for cost in costs]
    if not np.isfinite(samples):
        return over
    return [samples * float(np.expm1(min(rise / samples, _LARGEST_RISE))) for rise in over]


def _fall_of_cost(fall: float, samples: float) -> float:
    """The same of a fall of the least mean square, as a fall of the cost."""
    if not np.isfinite(samples):
        return fall
    return -samples * float(np.log1p(-min(fall / samples, 1.0 - _LEAST_LEFT)))


def _similarity(a: Array, b: Array) -> float:
    """Cosine between two sets of columns: one where they span the same, zero where nothing."""
    if a.shape[1] == 1:
        size = float(np.linalg.norm(a) * np.linalg.norm(b))
        return abs(float(a[:, 0] @ b[:, 0])) / size if size > 0.0 else 1.0
    first, second = np.linalg.qr(a)[0], np.linalg.qr(b)[0]
    return float(np.linalg.norm(first.T @ second) / np.sqrt(a.shape[1]))
