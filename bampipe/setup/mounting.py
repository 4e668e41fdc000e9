"""How the joints of a robot are counted, and how its base hangs, where that is not as it is drawn.

A file draws a robot upright in one posture; a controller counts from another, counts a joint the
other way round, and serves a robot on a wall, under a ceiling or on the side of a torso. Weight
goes with the sines of the angles, so only the right zeros and the right gravity let the drawn
bodies explain the drives.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from scipy.optimize import minimize

from bampipe.arrays import Array

_TURNS = (0.0, 0.5 * np.pi, -0.5 * np.pi, np.pi)
_DOWN = tuple(np.array(v) for v in product((-1.0, 0.0, 1.0), repeat=3) if any(v))
"""Directions of gravity in the frame of a base that stands, hangs or lies, or half of two."""
_WORTH = np.log(2.0)
"""What each change must gain of the sum over the joints of the logarithm of what is left."""
_HANGING, _LEANING = 2.0, 4.0
"""Changes of joints that another gravity must be worth, along an axis of the base and along none:
far more robots stand than hang, and drawn bodies that are wrong tilt it a little."""
_LEAST_TILT = np.radians(10.0)
"""Angle below which a gravity that explains more is put down to the drawing of the bodies."""
_FIRST_TILT = 0.2
"""Angle by which the search for one along no axis begins, rad."""
_MOST_ROUNDS = 6
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Mounting:
    """How the joints are counted, and where gravity points.

    Attributes:
        direction: 1 or -1 by joint, (n,).
        zero: what is added to direction times the reading, rad, (n,); 0 where a joint slides.
        gravity: in the frame of the base, m/s2, (3,).
        hangs: whether that is not the gravity that is stated.
    """

    direction: Array
    zero: Array
    gravity: Array
    hangs: bool = False

    @property
    def changed(self) -> list[int]:
        """Numbers of the joints that are not counted as they are drawn."""
        return [k for k, _ in enumerate(self.zero) if self.direction[k] < 0.0 or self.zero[k]]

    @property
    def is_changed(self) -> bool:
        """Whether anything is not as it is drawn or stated."""
        return self.hangs or bool(self.changed)

    @property
    def changes(self) -> float:
        """How many changes of joints all of it is as unlikely as."""
        size = np.abs(self.gravity)
        leans = size.max() < (1.0 - _ROUNDING) * np.linalg.norm(size)
        return len(self.changed) + self.hangs * (_LEANING if leans else _HANGING)

    @property
    def by_joint(self) -> list[tuple[float, float]]:
        """Direction and zero of each joint."""
        pairs = zip(self.direction, self.zero, strict=True)
        return [(float(direction), float(zero)) for direction, zero in pairs]

    def under(self, down: Array) -> Mounting:
        """The same under a gravity as large as this one along ``down``, (3,)."""
        size = float(np.linalg.norm(self.gravity))
        gravity = size * down / np.linalg.norm(down)
        return Mounting(self.direction, self.zero, gravity, hangs=True)

    def counted(self, options: dict[int, tuple[float, float]]) -> Mounting:
        """The same with other directions and zeros of some joints, by their numbers."""
        direction, zero = self.direction.copy(), self.zero.copy()
        for k, option in options.items():
            direction[k], zero[k] = option
        return Mounting(direction, zero, self.gravity, self.hangs)


Judge = Callable[[Mounting], float]


def find_mounting(
    turning: Sequence[bool], drawn: Mounting, judge: Judge, stands: bool = False
) -> Mounting:
    """The quarter turns, directions and gravity that let the drawing explain most.

    One of them is changed at a time, or two: the second of two that are off hides what the first
    gains. Joints that do not turn can only be counted the other way round.

    Args:
        drawn: as everything is stated; judge: what `Comparison.misfit` gives.
        stands: whether gravity is as stated, as where reductions are unknown, too.
    """

    def cost(mounting: Mounting) -> float:
        return judge(mounting) + float(_WORTH * mounting.changes)

    best, least = drawn, cost(drawn)
    for _ in range(_MOST_ROUNDS):
        tried = [(cost(other), other) for other in _neighbours(best, drawn, turning, stands)]
        score, other = min(tried, key=lambda one: one[0], default=(np.inf, best))
        if not score < least and not stands:
            other = _tilted(best, judge)
            score = cost(other)
        if not score < least:
            break
        best, least = other, score
    return best


def _alike(one: Mounting, other: Mounting) -> float:
    """Cosine of the angle between two gravities."""
    size = np.linalg.norm(one.gravity) * np.linalg.norm(other.gravity)
    return float(one.gravity @ other.gravity / size) if size > 0.0 else 1.0


def _tilted(mounting: Mounting, judge: Judge) -> Mounting:
    """The same under the gravity of any direction near its own that leaves least.

    That itself where it is closer than `_LEAST_TILT`.
    """
    down = mounting.gravity / max(float(np.linalg.norm(mounting.gravity)), _ROUNDING)
    aside = np.linalg.svd(down[None, :])[2][1:]

    def left(tilt: Array) -> float:
        return judge(mounting.under(down + tilt @ aside))

    start = _FIRST_TILT * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    options = {"initial_simplex": start, "maxfev": 50, "xatol": 0.01, "fatol": 0.01}
    found = minimize(left, start[0], method="Nelder-Mead", options=options)
    tilted = mounting.under(down + found.x @ aside)
    return tilted if _alike(tilted, mounting) < np.cos(_LEAST_TILT) else mounting


def _neighbours(
    best: Mounting, drawn: Mounting, turning: Sequence[bool], stands: bool
) -> Iterator[Mounting]:
    one = {
        k: [
            (direction, zero)
            for direction in (1.0, -1.0)
            for zero in (_TURNS if turns else (0.0,))
            if (direction, zero) != (best.direction[k], best.zero[k])
        ]
        for k, turns in enumerate(turning)
    }
    singles = [best.counted({k: option}) for k, options in one.items() for option in options]
    for single in (best, *singles):
        yield single
        if drawn.gravity.any() and not stands:
            yield replace(single, gravity=drawn.gravity, hangs=False)
            yield from (single.under(down) for down in _DOWN)
    # Two joints that are both off are off by their zeros: that is what a maker's zero posture is.
    for a, b in combinations(one, 2):
        for first, second in product(one[a], one[b]):
            if first[0] == best.direction[a] and second[0] == best.direction[b]:
                yield best.counted({a: first, b: second})
