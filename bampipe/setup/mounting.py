"""Zeros and directions of a robot's joints, and the mounting of its base, if not as drawn.

A file draws a robot upright in one posture. A controller may count from another posture, count a
joint in the opposite direction, and serve a robot on a wall, under a ceiling or on the side of a
torso. Weight varies with the sines of the angles, so drawn bodies explain the drives only with the
right zeros and the right gravity.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from scipy.optimize import minimize

from bampipe.arrays import Array

_TURNS = (0.0, 0.5 * np.pi, -0.5 * np.pi, np.pi)
_DOWN = tuple(np.array(v) for v in product((-1.0, 0.0, 1.0), repeat=3) if any(v))
"""Directions of gravity in the frame of a base that stands, hangs or lies, or half-way between."""
_WORTH = np.log(2.0)
"""Smallest gain by each change: drop of the sum over joints of the log of the fraction left."""
_HANGING, _LEANING = 2.0, 4.0
"""Number of joint changes to which another gravity is equivalent, along an axis of the base and
otherwise: far more robots stand than hang, and errors of the drawn bodies tilt it a little."""
_LEAST_TILT = np.radians(10.0)
"""Angle below which a gravity that explains more is attributed to errors of the drawn bodies."""
_FIRST_TILT = 0.2
"""Initial angle of the search for a gravity along no axis, rad."""
_MOST_ROUNDS = 6
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Mounting:
    """Directions and zeros of the joints, and the direction of gravity.

    Attributes:
        direction: 1 or -1 by joint, (n,).
        zero: added to direction times the reading, rad, (n,); 0 for a sliding joint.
        gravity: in the frame of the base, m/s2, (3,).
        hangs: whether gravity differs from the stated one.
    """

    direction: Array
    zero: Array
    gravity: Array
    hangs: bool = False

    @property
    def changed(self) -> list[int]:
        """Numbers of the joints that are not counted as drawn."""
        return [k for k, _ in enumerate(self.zero) if self.direction[k] < 0.0 or self.zero[k]]

    @property
    def changes(self) -> float:
        """Number of joint changes that are as improbable as the mounting; 0 if it is as drawn."""
        size = np.abs(self.gravity)
        leans = size.max() < (1.0 - _ROUNDING) * np.linalg.norm(size)
        return len(self.changed) + self.hangs * (_LEANING if leans else _HANGING)

    @property
    def by_joint(self) -> list[tuple[float, float]]:
        """Direction and zero of each joint."""
        pairs = zip(self.direction, self.zero, strict=True)
        return [(float(direction), float(zero)) for direction, zero in pairs]

    def under(self, down: Array) -> "Mounting":
        """The same mounting with its gravity along ``down``, (3,)."""
        size = float(np.linalg.norm(self.gravity))
        gravity = size * down / np.linalg.norm(down)
        return Mounting(self.direction, self.zero, gravity, hangs=True)

    def counted(self, options: dict[int, tuple[float, float]]) -> "Mounting":
        """The same mounting with other directions and zeros of some joints, by their numbers."""
        direction, zero = self.direction.copy(), self.zero.copy()
        for k, option in options.items():
            direction[k], zero[k] = option
        return Mounting(direction, zero, self.gravity, self.hangs)


Judge = Callable[[Mounting], float]


def find_mounting(
    turning: Sequence[bool], nominal: Mounting, judge: Judge, stands: bool = False
) -> Mounting:
    """Find the quarter turns, directions and gravity with which the drawing explains most.

    They are changed one or two at a time, because of two wrong joints the second hides the gain of
    the first. Joints that do not turn can only change direction.

    Args:
        nominal: the mounting as stated; judge: returns its `Comparison.misfit`.
        stands: whether gravity is fixed, as it must be if reductions are unknown too.
    """

    def cost(mounting: Mounting) -> float:
        return judge(mounting) + float(_WORTH * mounting.changes)

    def descend(best: Mounting, stands: bool) -> Mounting:
        least = cost(best)
        for _ in range(_MOST_ROUNDS):
            tried = [(cost(other), other) for other in _neighbours(best, nominal, turning, stands)]
            score, other = min(tried, key=lambda one: one[0], default=(np.inf, best))
            if not score < least and not stands:
                other = _tilted(best, judge)
                score = cost(other)
            if not score < least:
                break
            best, least = other, score
        return best

    # Upside down, a robot resembles one of which a joint is reversed.
    standing = descend(nominal, stands=True)
    return standing if stands else min(descend(nominal, False), descend(standing, False), key=cost)


def _tilted(mounting: Mounting, judge: Judge) -> Mounting:
    """Return the mounting with the best direction of gravity near its own.

    If that is closer than `_LEAST_TILT`, the mounting itself is returned.
    """
    down = mounting.gravity / max(float(np.linalg.norm(mounting.gravity)), _ROUNDING)
    aside = np.linalg.svd(down[None, :])[2][1:]

    def left(tilt: Array) -> float:
        return judge(mounting.under(down + tilt @ aside))

    start = _FIRST_TILT * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    options = {"initial_simplex": start, "maxfev": 150, "xatol": 1e-4, "fatol": 1e-4}
    found = minimize(left, start[0], method="Nelder-Mead", options=options)
    tilted = mounting.under(down + found.x @ aside)
    size = float(np.linalg.norm(tilted.gravity) * np.linalg.norm(mounting.gravity))
    far = tilted.gravity @ mounting.gravity < np.cos(_LEAST_TILT) * size
    return tilted if far else mounting


def _neighbours(
    best: Mounting, nominal: Mounting, turning: Sequence[bool], stands: bool
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
        if nominal.gravity.any() and not stands:
            yield replace(single, gravity=nominal.gravity, hangs=False)
            yield from (single.under(down) for down in _DOWN)
    # Two joints that are both wrong differ in their zeros, as a maker's zero posture does.
    for a, b in combinations(one, 2):
        for first, second in product(one[a], one[b]):
            if first[0] == best.direction[a] and second[0] == best.direction[b]:
                yield best.counted({a: first, b: second})
