"""The best of many primitives: tried exactly, in other surroundings, and as people follow them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
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
_FOLLOWED = 4
"""For each finalist, so many designs are also tried as somebody hasty follows them."""
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
    with_brakes: bool,
    progress: Callable[[float, str], None] = lambda fraction, message: None,
    others: Sequence[Primitive] = (),
    least: float = -np.inf,
) -> list[Tried]:
    """Try primitives about ``axes`` of so many seconds; the best ones as followed, best first.

    What is best when it is followed exactly may be worth little to somebody hasty, so that the
    finalists are those that are good both ways. One of them at least stays within what the trials
    at hand have shown. ``others`` are tried beside these primitives. Nothing is returned where none
    is worth ``least`` when it is followed exactly. ``with_brakes``, they may be on.
    """

    def try_design(design: Primitive) -> float:
        return worth(rehearsal.record(design, 0))

    def follow_hastily(value: float, design: Primitive) -> float:
        return _robust([value, worth(rehearsal.record(design, HASTY))])

    def surroundings(design: Primitive) -> Iterator[Primitive]:
        every = vary_surroundings(rehearsal.seen, design)
        return (other for other in every if with_brakes or not other.field)

    designs, is_quick = _list_designs(rehearsal, seconds, axes, with_rests, others)
    finalists = _FINALISTS if is_quick else _OF_FEW
    exact = []
    for k, design in enumerate(designs):
        progress(0.5 * k / len(designs), f"trying {len(designs)} designs")
        exact.append((try_design(design), design))
    exact.sort(key=lambda pair: -pair[0])
    if exact[0][0] < least:
        varied = (
            try_design(other)
            for _, design in exact[: _VARIED * is_quick]
            for other in surroundings(design)
        )
        if all(value < least for value in varied):
            return []
    inside = [pair for pair in exact if not any(find_beyond(pair[1], rehearsal.seen))]
    progress(0.5, "following them hastily")
    ahead = exact[: _FOLLOWED * finalists]
    if all(any(find_beyond(design, rehearsal.seen)) for _, design in ahead):
        ahead += inside[:1]
    best = [(follow_hastily(*pair), pair[1]) for pair in ahead]
    best.sort(key=lambda pair: -pair[0])
    near = next((d for _, d in best if not any(find_beyond(d, rehearsal.seen))), None)
    for _, design in best[: _VARIED * is_quick]:
        for other in surroundings(design):
            best.append((follow_hastily(try_design(other), other), other))
    best.sort(key=lambda pair: -pair[0])
    chosen = [design for _, design in best[:finalists]]
    if near is not None and all(any(find_beyond(design, rehearsal.seen)) for design in chosen):
        chosen[-1] = near
    tried = []
    for k, design in enumerate(chosen):
        progress(0.75 + 0.25 * k / finalists, "following the best ones roughly")
        tried.append(_follow(rehearsal, design, worth))
    tried.sort(key=lambda one: -one.worth)
    least = tried[0].worth - _CLOSE * abs(tried[0].worth)
    for k, one in enumerate(tried):
        if one.worth >= least and not any(find_beyond(one.design, rehearsal.seen)):
            return [one, *tried[:k], *tried[k + 1 :]]
    return tried


def find_best_of_each(
    rehearsal: Rehearsal,
    inform: Callable[[Motion], Array],
    worths: Sequence[Callable[[Array], float]],
    seconds: float,
    axes: Sequence[int],
    others: Sequence[Primitive] = (),
) -> list[Tried]:
    """The best designs by each of several worths, each once; all are recorded once for them all.

    Args:
        inform: the information (m, m) of a motion; worths: of it, larger is better.
        rehearsal, seconds, axes, others: as of `rank_designs`.
    """
    designs, is_quick = _list_designs(rehearsal, seconds, axes, False, others)
    known = [inform(rehearsal.record(design, 0)) for design in designs]
    counted = Counter(
        k
        for worth in worths
        for k in sorted(range(len(designs)), key=lambda k: -worth(known[k]))[:_OF_FEW]
    )
    # Where that takes long, only the designs that are good by most worths are followed.
    chosen = [k for k, _ in counted.most_common(None if is_quick else _OF_FEW)]
    motions = {k: _versions(rehearsal, designs[k]) for k in chosen}
    informed = {k: [inform(motion) for motion in motions[k]] for k in chosen}
    found: dict[int, Tried] = {}
    for worth in worths:
        values = {k: _robust([worth(one) for one in informed[k]]) for k in chosen}
        best = max(chosen, key=lambda k: values[k])
        found.setdefault(best, Tried(designs[best], values[best], motions[best]))
    return list(found.values())


def _list_designs(
    rehearsal: Rehearsal,
    seconds: float,
    axes: Sequence[int],
    with_rests: bool,
    others: Sequence[Primitive],
) -> tuple[list[Primitive], bool]:
    """The designs to try, and whether that takes so little that none was left out."""
    designs = list_primitives(rehearsal.seen, seconds, axes, with_rests)
    work = seconds * rehearsal.sensors.rate_hz * len(rehearsal.system.parameters)
    most = max(_FEWEST, int(_WORK / work))
    return [*designs[:: -(-len(designs) // most)], *others], len(designs) <= most


def _follow(rehearsal: Rehearsal, design: Primitive, worth: Worth) -> Tried:
    """A design as different people follow it."""
    motions = _versions(rehearsal, design)
    return Tried(design, _robust([worth(motion) for motion in motions]), motions)


def _versions(rehearsal: Rehearsal, design: Primitive) -> tuple[Motion, ...]:
    return tuple(rehearsal.record(design, version) for version in _VERSIONS)


def _robust(worths: Sequence[float]) -> float:
    """What a design is worth on a bad day."""
    return float(np.quantile(worths, _QUANTILE))
