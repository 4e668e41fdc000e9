"""What a diagnosis found: verdicts by axis, the ranking of candidates, the effects to add."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from bampipe.results.diagnose import (
    AxisVerdict,
    Contender,
    RankedEffect,
    RefusedEffect,
    SearchStep,
    TransientCandidate,
)
from bampipe.trials.evidence import Evidence


@dataclass(frozen=True)
class Diagnosis:
    """What `diagnose` found.

    Attributes:
        axes: by coordinate, in order.
        ranking: candidates, best first.
        selected: effects to add, in order.
        groups: for each selected effect, the others that these trials cannot tell from it.
        contests: for each selected effect, those who contend for its place, itself first.
        steps: how the search went.
        cut_short: whether it ended at the most effects that may be tried.
        transients: candidates that only one second speaks for.
        evidence: of the model with all selected effects.
        initial: of the model as given.
        refused: candidates that beat chance and were added, but not kept.
        wider: for each selected effect, those that it is a part of and whose other parts add
            nothing.
    """

    axes: tuple[AxisVerdict, ...]
    ranking: tuple[RankedEffect, ...]
    selected: tuple[str, ...]
    groups: Mapping[str, tuple[str, ...]]
    contests: Mapping[str, tuple[Contender, ...]]
    steps: tuple[SearchStep, ...]
    cut_short: bool
    transients: tuple[TransientCandidate, ...]
    evidence: Evidence
    initial: Evidence
    refused: tuple[RefusedEffect, ...] = ()
    wider: Mapping[str, frozenset[str]] = field(default_factory=dict)
