"""Scores of diagnoses of sessions whose truth is known, and tables of them under any criteria."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta, poisson

from bampipe.diagnosis.criteria import Criteria, cap_probability

TENTHS = np.linspace(0.0, 1.0, 11)
MOST_ALARMS = 0.01
"""Share of clean sessions that may be said to lack something."""
BY_CHANCE = 0.01
"""Probability below which as many wrong names as in a tenth are not put down to chance."""


@dataclass(frozen=True)
class Scores:
    """What a diagnosis of one session computed, and the truth.

    Attributes:
        id: of the session; effects: hidden, of the library, by their strength; outside: not of it.
        effects_found: probability of each effect of any probable set.
        sets: effects, axis of something unknown, log evidence (nats) and probability of each.
        drops: log evidence lost without each effect that is selected, nats, with p-values.
        chance: largest gain of any candidate on each replicate of the final model, nats.
        beside: the same on the measured trials.
        unknown: probability of something unknown, by axis.
        over_floor: held-out error over the noise floor, by axis.
        no_verdict: axes without a verdict; failure: why there is no diagnosis.
        seconds: processor time of the diagnosis.
    """

    id: str
    effects: Mapping[str, float]
    outside: Sequence[str]
    effects_found: Mapping[str, float] = field(default_factory=dict)
    sets: Sequence[Mapping[str, Any]] = ()
    drops: Mapping[str, Sequence[float]] = field(default_factory=dict)
    chance: Sequence[float] = ()
    beside: float = 0.0
    unknown: Mapping[str, float] = field(default_factory=dict)
    over_floor: Mapping[str, float] = field(default_factory=dict)
    no_verdict: Sequence[str] = ()
    seconds: float = 0.0
    failure: str = ""

    def probabilities(self, criteria: Criteria) -> dict[str, float]:
        """Of each effect of any probable set; no surer than chance allows."""
        p_values = {e: p for e, (_, p) in self.drops.items()}
        return {
            e: min(p, cap_probability(p_values.get(e, 0.0))) for e, p in self.effects_found.items()
        }

    def finds_unknown(self, criteria: Criteria) -> bool:
        """Whether something is said to be missing that no effect of the library is."""
        return max(self.unknown.values(), default=0.0) >= criteria.probability


def write_tables(scores: Sequence[Scores], criteria: Criteria, *, by_set: bool = True) -> str:
    """Reliability, alarms and, if asked, sets and time at the given criteria, as Markdown."""
    done = [s for s in scores if not s.failure]
    clean = [s for s in done if not s.effects and not s.outside]
    hidden = [s for s in done if s.effects and not s.outside]
    outside = [s for s in done if s.outside]
    table, facts = _reliability([*hidden, *outside], criteria)
    facts += _alarms(clean, criteria)
    if by_set:
        facts += _sets(hidden, criteria)
    if by_set and outside:
        facts.append(
            f"Sessions with an effect outside the library: {len(outside)}; something unknown is"
            f" said to be missing in {sum(s.finds_unknown(criteria) for s in outside)}."
        )
    if by_set:
        seconds = [s.seconds for s in done] or [np.nan]
        took = f"{np.median(seconds):.1f} s of processor time, at most {max(seconds):.1f} s"
        facts.append(f"A diagnosis took {took}.")
    return "\n".join(
        [
            f"{len(done)} sessions, {len(scores) - len(done)} refused; probability"
            f" {criteria.probability:g}",
            "",
            *table,
            "",
            *(f"- {fact}" for fact in facts),
        ]
    )


def _reliability(scores: Iterable[Scores], criteria: Criteria) -> tuple[list[str], list[str]]:
    """Of the effects given each tenth of probability, how many are there; where too few are."""
    stated = [(p, e in s.effects) for s in scores for e, p in s.probabilities(criteria).items()]
    head = "| stated probability | effects | mean stated | there | wrong |"
    lines, high_stated = [head, "|-|-|-|-|-|"], []
    for low, high in pairwise(TENTHS):
        here = [(p, t) for p, t in stated if low <= p < high or (high == 1.0 and p == 1.0)]
        if here:
            wrong = sum(not t for _, t in here)
            expected = sum(1.0 - p for p, _ in here)
            lines.append(
                f"| {low:.1f} to {high:.1f} | {len(here)} | {1.0 - expected / len(here):.3f} |"
                f" {1.0 - wrong / len(here):.3f} | {wrong} |"
            )
            if poisson.sf(wrong - 1, expected) < BY_CHANCE:
                high_stated.append(f"{low:.1f} to {high:.1f}")
    where = " and ".join(high_stated)
    said = f"More effects are wrong than stated, beyond chance (p < {BY_CHANCE:g}), at {where}."
    return lines, [said] if high_stated else []


def _alarms(clean: Sequence[Scores], criteria: Criteria) -> list[str]:
    """Sessions where nothing is missing of which something else is said."""
    if not clean:
        return []
    least = 1.0 - criteria.probability
    named = [max(s.probabilities(criteria).values(), default=0.0) for s in clean]
    sure = sum(
        p >= criteria.probability or s.finds_unknown(criteria)
        for p, s in zip(named, clean, strict=True)
    )
    unsure = sum(
        least <= max(p, *s.unknown.values()) < criteria.probability
        for p, s in zip(named, clean, strict=True)
    )
    bound = float(beta.ppf(0.95, sure + 1, len(clean) - sure)) if sure < len(clean) else 1.0
    met = "met" if sure <= MOST_ALARMS * len(clean) else "not met"
    return [
        f"Of {len(clean)} clean sessions, {sure} are said to lack something (at most"
        f" {100 * bound:.1f} % at 95 % confidence): the second target is {met}; {unsure} are left"
        f" undecided, and {sum(bool(s.no_verdict) for s in clean)} have an axis without a verdict."
    ]


def _sets(hidden: Sequence[Scores], criteria: Criteria) -> list[str]:
    """Whole sets and single effects, where all that is hidden is of the library."""
    if not hidden:
        return []
    first = [set(s.sets[0]["effects"]) == set(s.effects) for s in hidden]
    among = [any(set(o["effects"]) == set(s.effects) and o["probability"] >= 0.1 for o in s.sets)
             for s in hidden]  # fmt: skip
    lines = [
        f"Of {len(hidden)} sessions with effects of the library alone, the most probable set is the"
        f" hidden one in {sum(first)}, and a set of probability 0.1 or more is in {sum(among)}."
    ]
    for low, high in ((0.1, 0.2), (0.2, 0.5), (0.5, 1.01)):
        chances = [s.probabilities(criteria).get(e, 0.0) for s in hidden
                   for e, strength in s.effects.items() if low <= strength < high]  # fmt: skip
        if chances:
            found = sum(p >= criteria.probability for p in chances)
            open_still = sum(1 - criteria.probability <= p < criteria.probability for p in chances)
            lines.append(
                f"At strengths {low:g} to {min(high, 1.0):g}, {found} of {len(chances)} effects are"
                f" called missing, and {open_still} more are undecided."
            )
    return lines


def read_scores(path: Path) -> Iterator[Scores]:
    """The scores of a file, a line each."""
    for line in path.read_text(encoding="utf-8").splitlines():
        yield Scores(**json.loads(line))
