"""How the joints of a log are counted against a drawing: the other way round, from another zero.

Controllers count a joint from where its maker calibrates it, a quarter turn from the drawing's zero
more often than not. Weight goes with the sines of the angles, so only the right zeros let the drawn
bodies explain the drives.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Judge = Callable[[Array, Array], Array]

_TURNS = (0.0, 0.5 * np.pi, -0.5 * np.pi, np.pi)
_LEAST_LEFT = 3e-3
"""Part of a drive's variance below which no drawing is believed to be better than another."""
_WORTH = np.log(2.0)
"""What each change must gain of the sum over the joints of the logarithm of what is left."""
_MOST_ROUNDS = 3


@dataclass(frozen=True)
class Counting:
    """How the joints are counted.

    Attributes:
        direction: 1 or -1 by joint, (n,).
        zero: what is added to direction times the reading, rad, (n,); 0 where a joint slides.
    """

    direction: Array
    zero: Array

    @classmethod
    def as_drawn(cls, n: int) -> Counting:
        """Every joint as the drawing has it."""
        return cls(np.ones(n), np.zeros(n))

    @property
    def changed(self) -> list[int]:
        """Numbers of the joints that are not counted as they are drawn."""
        return [k for k, _ in enumerate(self.zero) if self.direction[k] < 0.0 or self.zero[k]]

    @property
    def by_joint(self) -> list[tuple[float, float]]:
        """Direction and zero of each joint."""
        pairs = zip(self.direction, self.zero, strict=True)
        return [(float(direction), float(zero)) for direction, zero in pairs]


def find_counting(turning: Sequence[bool], judge: Judge) -> Counting:
    """The counting, of quarter turns and directions, that lets the drawing explain most.

    One joint is changed at a time, or two: the second of two that are off hides what the first
    gains.

    Args:
        turning: whether each joint turns; those that slide can only be counted the other way round.
        judge: parts of the drives' variances that are left, (n,), with directions and zeros.
    """
    best = Counting.as_drawn(len(turning))
    least = _cost(best, judge)
    for _ in range(_MOST_ROUNDS):
        tried = [(_cost(other, judge), other) for other in _neighbours(best, turning)]
        score, other = min(tried, key=lambda one: one[0], default=(np.inf, best))
        if not score < least:
            break
        best, least = other, score
    return best


def _cost(counting: Counting, judge: Judge) -> float:
    left = judge(counting.direction, counting.zero)
    return float(np.log(left + _LEAST_LEFT).sum() + _WORTH * len(counting.changed))


def _neighbours(best: Counting, turning: Sequence[bool]) -> Iterator[Counting]:
    one = {
        k: [
            (direction, zero)
            for direction in (1.0, -1.0)
            for zero in (_TURNS if turns else (0.0,))
            if (direction, zero) != (best.direction[k], best.zero[k])
        ]
        for k, turns in enumerate(turning)
    }
    for k, options in one.items():
        for option in options:
            yield _with(best, {k: option})
    # Two joints that are both off are off by their zeros: that is what a maker's zero posture is.
    for a, b in combinations(one, 2):
        for first in one[a]:
            for second in one[b]:
                if first[0] == best.direction[a] and second[0] == best.direction[b]:
                    yield _with(best, {a: first, b: second})


def _with(counting: Counting, options: dict[int, tuple[float, float]]) -> Counting:
    direction, zero = counting.direction.copy(), counting.zero.copy()
    for k, option in options.items():
        direction[k], zero[k] = option
    return Counting(direction, zero)
