"""A mistake that was found, and what makes one worth naming."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bampipe.setup.hypotheses import Correction
from bampipe.setup.plausibility import Plausibility

SUSPICIOUS_ERROR = 0.4
"""Error, as a share of the applied force, from which other set-ups are tried. Right ones
stand below 0.15 with any one effect hidden, a gravity compensator that lags behind at 0.36."""
LEAST_GAIN = 7.0
"""Score that setting a mistake right must gain: the error of one axis falls to 42 %, say. Of sound
sessions no other set-up gains more than 5.0, of mistaken ones the right one at least 7.9."""
LEAST_GAIN_PLACEHOLDER = 4.0
"""The same for a scale that stands at exactly 1, as nobody has filled it in."""
EXPLAINED = 0.6
"""Error that must be left of a spoilt axis at most, as a share of the applied force."""
JUDGED_ERROR, RANKED_ERROR = 0.1, 0.01
"""Errors below these are alike: when a mistake is named, and when mistakes are ranked."""
SPOILS = 2.0
"""Times its error, or `JUDGED_ERROR` where that is larger, that a correction may leave of an axis
that was sound before. All drives of a robot taken twice help an axis whose counterbalance the
device lacks, and take another from 8 to 34 % of its force: no mistake of set-up."""
ALIKE = 1.5
"""Difference of scores within which two mistakes cannot be distinguished."""
MOST_MISTAKES = 4


Judge = Callable[[tuple[Correction, ...]], Plausibility | None]


@dataclass(frozen=True)
class Finding:
    """One mistake with the two set-ups it lies between.

    Attributes:
        correction: that sets it right; rivals: others that do so as well.
        before, after: what the set-ups explain, with all other mistakes set right.
        gain: of the score.
        drawn: whether both are with bodies as drawn.
    """

    correction: Correction
    rivals: tuple[Correction, ...]
    before: Plausibility
    after: Plausibility
    gain: float
    drawn: bool = False


def conclude(
    judge: Judge,
    chosen: tuple[Correction, ...],
    others: Sequence[Correction],
    placeholders: Sequence[str] = (),
    drawn: bool = False,
) -> tuple[Finding, ...]:
    """The mistakes among corrections that were found together, the one that gains most first.

    Those without which hardly more is left are no mistakes. None is one if some axis is not
    explained in the end, or is worse than as stated.

    Args:
        judge: what is explained with some corrections; chosen: what was found.
        others: corrections that may do in the place of one that was.
        placeholders: signals whose scale stands at exactly 1.
        drawn: whether all that is with bodies as drawn.
    """
    found: list[Finding] = []
    while chosen:
        after = judge(chosen)
        if after is None:
            return ()
        found = []
        for one in chosen:
            before = judge(without(chosen, one)) or after.with_nothing_explained()
            found.append(Finding(one, (), before, after, gain_of(before, after, one.cost), drawn))
        idle = min(found, key=lambda f: f.gain - least_gain(f.correction, placeholders))
        if idle.gain >= least_gain(idle.correction, placeholders):
            break
        chosen = without(chosen, idle.correction)
    stated = judge(())
    spoilt = stated is not None and chosen and spoils_sound_axes(stated, found[0].after)
    if spoilt or not 0 < len(chosen) <= MOST_MISTAKES:
        return ()
    most = score_of(judge, chosen) + ALIKE
    for place, finding in enumerate(found):
        rest = without(chosen, finding.correction)
        known = {(one.kind, one.signals) for one in chosen}
        rivals: dict[tuple[str, tuple[str, ...]], Correction] = {}
        for other in others:
            key = (other.kind, other.signals)
            if key not in known and score_of(judge, (*rest, other)) < most:
                rivals.setdefault(key, other)
        found[place] = replace(finding, rivals=tuple(rivals.values()))
    found.sort(key=lambda finding: -finding.gain)
    explained = all((f.after.error[spoilt_axes(f)] < EXPLAINED).all() for f in found)
    return tuple(found) if explained else ()


def without(corrections: tuple[Correction, ...], one: Correction) -> tuple[Correction, ...]:
    """All corrections but ``one``."""
    return tuple(other for other in corrections if other is not one)


def score_of(judge: Judge, corrections: tuple[Correction, ...]) -> float:
    """Of a set-up, the lower the better; infinite where it cannot be computed with."""
    found = judge(corrections)
    cost = sum(one.cost for one in corrections)
    return math.inf if found is None else found.score(RANKED_ERROR) + cost


def least_gain(correction: Correction, placeholders: Sequence[str] = ()) -> float:
    """Score that a correction must gain."""
    hinted = correction.kind == "scale" and set(correction.signals) <= set(placeholders)
    return LEAST_GAIN_PLACEHOLDER if hinted else LEAST_GAIN


def spoilt_axes(finding: Finding) -> list[int]:
    """Axes whose error falls by more than a third once the mistake is set right; all, if none."""
    before, after = finding.before.error, finding.after.error
    fallen = [i for i in range(len(before)) if after[i] < before[i] / 1.5]
    return fallen or list(range(len(before)))


def gain_of(before: Plausibility, after: Plausibility, cost: float) -> float:
    """Of the score, by a correction of that cost."""
    return before.score(JUDGED_ERROR) - after.score(JUDGED_ERROR) - cost


def spoils_sound_axes(before: Plausibility, after: Plausibility) -> bool:
    """Whether a correction makes an axis much worse that was right without it."""
    sound = before.error < SUSPICIOUS_ERROR
    return bool(np.any(after.error[sound] > SPOILS * np.maximum(before.error[sound], JUDGED_ERROR)))
