"""A mistake that was found, and what makes one worth naming."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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


@dataclass(frozen=True)
class Finding:
    """One mistake with the two set-ups it lies between.

    Attributes:
        correction: that sets it right; rivals: others that do so as well.
        before, after: what the set-ups explain.
        gain: of the score.
        drawn: whether both are with bodies as drawn.
    """

    correction: Correction
    rivals: tuple[Correction, ...]
    before: Plausibility
    after: Plausibility
    gain: float
    drawn: bool = False


@dataclass(frozen=True)
class Tried:
    """Corrections that were tried together, and what they explain."""

    option: tuple[Correction, ...]
    after: Plausibility

    @property
    def cost(self) -> float:
        """How unlikely a person is to make these mistakes, in the unit of the score."""
        return sum(one.cost for one in self.option)

    @property
    def score(self) -> float:
        """The lower, the better."""
        return self.after.score(RANKED_ERROR) + self.cost

    @property
    def signals(self) -> set[tuple[str, tuple[str, ...]]]:
        """What is mistaken: the kinds, and the signals of each."""
        return {(one.kind, one.signals) for one in self.option}


def choose(
    before: Plausibility,
    tried: Sequence[Tried],
    placeholders: Sequence[str] = (),
    drawn: bool = False,
) -> list[Finding]:
    """The mistakes that set most right, of those worth naming; none if none is.

    Args:
        before: what is explained without; tried: what may be mistaken.
        placeholders: signals whose scale stands at exactly 1.
        drawn: whether all that is with bodies as drawn.
    """
    ranked = sorted(tried, key=lambda one: one.score)
    for best in ranked:
        gain = gain_of(before, best.after, best.cost)
        hinted = all(
            one.kind == "scale" and set(one.signals) <= set(placeholders) for one in best.option
        )
        least = LEAST_GAIN_PLACEHOLDER if hinted else LEAST_GAIN
        if gain < least or spoils_sound_axes(before, best.after):
            continue
        rivals = [
            other.option[0]
            for other in ranked
            if len(best.option) == len(other.option) == 1
            and other.signals != best.signals
            and other.score < best.score + ALIKE
        ]
        return [
            Finding(one, distinct(rivals), before, best.after, gain, drawn) for one in best.option
        ]
    return []


def spoilt_axes(finding: Finding) -> list[int]:
    """Axes whose error falls by more than a third once the mistake is set right; all, if none."""
    before, after = finding.before.error, finding.after.error
    fallen = [i for i in range(len(before)) if after[i] < before[i] / 1.5]
    return fallen or list(range(len(before)))


def is_explained(finding: Finding, last: Plausibility) -> bool:
    """Whether the axes that a mistake spoils are explained in the end."""
    return bool((last.error[spoilt_axes(finding)] < EXPLAINED).all())


def gain_of(before: Plausibility, after: Plausibility, cost: float) -> float:
    """Of the score, by a correction of that cost."""
    return before.score(JUDGED_ERROR) - after.score(JUDGED_ERROR) - cost


def spoils_sound_axes(before: Plausibility, after: Plausibility) -> bool:
    """Whether a correction makes an axis much worse that was right without it."""
    sound = before.error < SUSPICIOUS_ERROR
    return bool(np.any(after.error[sound] > SPOILS * np.maximum(before.error[sound], JUDGED_ERROR)))


def distinct(corrections: Sequence[Correction]) -> tuple[Correction, ...]:
    """The first of each kind and signals."""
    found: dict[tuple[str, tuple[str, ...]], Correction] = {}
    for correction in corrections:
        found.setdefault((correction.kind, correction.signals), correction)
    return tuple(found.values())
