"""The best of many primitives: tried exactly, in other surroundings, and as people follow them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bampipe.next_trial.motion import HASTY, Rehearsal
from bampipe.next_trial.primitives import (
    Primitive,
    find_beyond,
    list_primitives,
    vary_surroundings,
)
from bampipe.trials.motion import Motion

Array = NDArray[np.float64]

_VERSIONS = (1, 2, 3, 4, HASTY)
"""As followed by different people."""
_WORK = 2.5e7
"""Samples times parameters of all designs that are tried exactly: of a robot with 80 numbers each
takes seconds, and some are left out."""
_FEWEST = 12
_FINALISTS, _OF_FEW = 5, 2
_VARIED = 2
"""Of the best, so many are tried in other surroundings."""
_QUANTILE = 0.1
"""Of the worth over versions, by which designs are ranked: a bad day must still do."""
_CLOSE = 0.05
"""Share of its worth that the best design must have before one that stays within what has been
seen, or that one comes first: going beyond has to pay."""

Worth = Callable[[Motion], float]
"""What a motion is worth: larger is better."""


@dataclass(frozen=True)
class Tried:
    """A design, and what it is worth.

    Attributes:
        design: the primitive.
        worth: the quantile by which designs are ranked.
        motions: its versions, that of somebody hasty last.
    """

    design: Primitive
    worth: float
    motions: tuple[Motion, ...]

    @property
    def usual(self) -> tuple[Motion, ...]:
        """The versions that are expected; the hasty one is only guarded against."""
        return self.motions[:-1]


def rank_designs(
    rehearsal: Rehearsal,
    worth: Worth,
    seconds: float,
    axes: Sequence[int],
    with_rests: bool,
    progress: Callable[[float, str], None] = lambda fraction, message: None,
) -> list[Tried]:
    """Try primitives about ``axes`` of so many seconds; the best ones as followed, best first.

    One of them at least stays within what the trials at hand have shown.
    """
    designs = list_primitives(rehearsal.seen, seconds, axes, with_rests)
    one = seconds * rehearsal.sensors.rate_hz * len(rehearsal.system.parameters)
    most = max(_FEWEST, int(_WORK / one))
    is_quick = len(designs) <= most
    finalists = _FINALISTS if is_quick else _OF_FEW
    designs = designs[:: -(-len(designs) // most)]
    values = []
    for k, design in enumerate(designs):
        progress(0.6 * k / len(designs), f"trying {len(designs)} designs")
        values.append(worth(rehearsal.record(design, 0)))
    order = sorted(range(len(designs)), key=lambda k: -values[k])
    best = [(values[k], designs[k]) for k in order[:finalists]]
    for _, design in best[: _VARIED * is_quick]:
        for other in vary_surroundings(rehearsal.seen, design):
            best.append((worth(rehearsal.record(other, 0)), other))
    best.sort(key=lambda pair: -pair[0])
    chosen = [design for _, design in best[:finalists]]
    inside = [k for k in order if not any(find_beyond(designs[k], rehearsal.seen))]
    if inside and all(any(find_beyond(design, rehearsal.seen)) for design in chosen):
        chosen[-1] = designs[inside[0]]
    tried = []
    for k, design in enumerate(chosen):
        progress(0.7 + 0.3 * k / finalists, "following the best ones roughly")
        motions = tuple(rehearsal.record(design, version) for version in _VERSIONS)
        worths = [worth(motion) for motion in motions]
        tried.append(Tried(design, float(np.quantile(worths, _QUANTILE)), motions))
    tried.sort(key=lambda one: -one.worth)
    least = tried[0].worth - _CLOSE * abs(tried[0].worth)
    for k, near in enumerate(tried):
        if near.worth >= least and not any(find_beyond(near.design, rehearsal.seen)):
            return [near, *tried[:k], *tried[k + 1 :]]
    return tried
