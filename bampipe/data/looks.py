"""What columns without a name look like: a time, a position, its derivative, a drive."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bampipe.arrays import Array
from bampipe.data import guesses
from bampipe.data.session import SECONDS

_MOST_ROWS = 20_000
_DERIVATIVE = 0.98
"""Correlation of a column with the integral of another, both without a line, to be that of it."""
_DRIVEN = 0.5
"""Share of a column that the motion must explain for it to pass as what drives it."""
_MOVED, _CLEARLY = 0.8, 0.5
"""Of two columns, the share of one that the motion of the other must explain, and how much less it
may leave than the other way round."""
_STEADY = 50.0
"""Of the median step: the longest one of a time."""


def find_roles(values: Mapping[str, Array], t: Array | None) -> dict[str, str]:
    """Roles of columns (T,) by what they look like, those that look like nothing left out.

    Args:
        values: columns that change, by name, in the order of the file.
        t: (T,) time, None where no column is known to be one.

    Returns:
        "time", "position", "velocity", "acceleration" or "force" (what drives the motion) by name.
    """
    found: dict[str, str] = {}
    sound = {name: v[:_MOST_ROWS] for name, v in values.items() if np.all(np.isfinite(v))}
    if t is None:
        clock = next((name for name, v in sound.items() if is_time(v)), "")
        found |= {clock: "time"} if clock else {}
        t = sound.pop(clock, None)
    if len(sound) < 2:
        return found
    matrix = np.column_stack(list(sound.values()))
    t = np.arange(len(matrix), dtype=float) if t is None else t[:_MOST_ROWS]
    if not np.all(np.isfinite(t)):
        return found
    names = list(sound)
    derivative = _derivatives(matrix, t)
    rates = set(derivative.values())
    for k, rate in derivative.items():
        if k not in rates:
            found |= {names[k]: "position", names[rate]: "velocity"}
            if rate in derivative:
                found[names[derivative[rate]]] = "acceleration"
    positions = [k for k in derivative if k not in rates]
    left = [k for k, name in enumerate(names) if name not in found]
    if len(positions) == 1:
        q, unit = matrix[:, positions[0]], guesses.time_unit(t, "")
        seconds = (t - t[0]) * SECONDS.get(unit, 1.0)
        share = {
            k: guesses.driven(seconds, q, matrix[:, k]).share
            for k in left
            if abs(float(np.corrcoef(q, matrix[:, k])[0, 1])) < _DERIVATIVE
        }
        best = max(share, key=lambda k: share[k], default=-1)
        if best >= 0 and share[best] >= _DRIVEN:
            found[names[best]] = "force"
    elif positions and len(left) == len(positions):
        found |= {names[k]: "force" for k in left}
    elif not positions and len(left) == 2:
        seconds = (t - t[0]) * SECONDS.get(guesses.time_unit(t, ""), 1.0)
        explained = [guesses.driven(seconds, matrix[:, k], matrix[:, 1 - k]).share for k in left]
        moved = int(explained[1] > explained[0])
        least, most = sorted(explained)
        if most >= _MOVED and 1.0 - most < _CLEARLY * (1.0 - least):
            found |= {names[moved]: "position", names[1 - moved]: "force"}
    return found


def describe(name: str, values: Array) -> str:
    """What is seen of a column, for a person who knows what was logged."""
    known = values[np.isfinite(values)]
    if is_time(known):
        return f"{name} increases as a time does"
    return f"{name} from {known.min():.4g} to {known.max():.4g}" if len(known) else f"{name} empty"


def is_time(values: Array) -> bool:
    """Whether readings (T,) rise evenly."""
    steps = np.diff(values)
    rises = len(steps) > 3 and bool(np.all(steps > 0))
    return rises and float(steps.max()) < _STEADY * float(np.median(steps))


def _derivatives(matrix: Array, t: Array) -> dict[int, int]:
    """Columns (T, n) by the column that is their derivative, the likeliest each.

    A column is held against the integrals of the others: noise spoils derivatives.
    """
    since = t - t[0]
    middle = 0.5 * (matrix[1:] + matrix[:-1]) * np.diff(since)[:, None]
    integrals = np.concatenate([np.zeros((1, matrix.shape[1])), np.cumsum(middle, axis=0)])
    base, _ = np.linalg.qr(np.column_stack([np.ones_like(since), since]))
    p, i = (each - base @ (base.T @ each) for each in (matrix, integrals))
    size = np.outer(np.linalg.norm(p, axis=0), np.linalg.norm(i, axis=0))
    alike = np.divide(p.T @ i, size, out=np.zeros_like(size), where=size > 0.0)
    np.fill_diagonal(alike, 0.0)
    found: dict[int, int] = {}
    for k, rate in zip(*np.unravel_index(np.argsort(-alike, axis=None), alike.shape), strict=True):
        if alike[k, rate] < _DERIVATIVE:
            break
        if int(k) not in found and int(rate) not in found.values():
            found[int(k)] = int(rate)
    return found
