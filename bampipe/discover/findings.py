"""What a diagnosis found: verdicts by axis, the ranking of candidates, the effects to add."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from bampipe.results.diagnose import AxisVerdict, RankedEffect, SearchStep, TransientCandidate
from bampipe.trials.residuals import Evidence


@dataclass(frozen=True)
class Contender:
    """An effect that contends for a place in the model, all others found being in it.

    Attributes:
        effect: canonical name.
        axis: where the effect found helps most.
        held_out_rmse: error there with this effect, N.m or N.
        score: gain in log likelihood over all axes; score_without_trial, score_without_second:
            without the trial and without the second that speak most for the effect found; None
            with two trials.
        odds: that it is this one, of those that fit alike.
    """

    effect: str
    axis: int
    held_out_rmse: float
    score: float
    score_without_trial: float | None
    score_without_second: float
    odds: float = 0.0


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
        transients: candidates that only one second speaks for.
        evidence: of the model with all selected effects.
        initial: of the model as given.
    """

    axes: tuple[AxisVerdict, ...]
    ranking: tuple[RankedEffect, ...]
    selected: tuple[str, ...]
    groups: Mapping[str, tuple[str, ...]]
    contests: Mapping[str, tuple[Contender, ...]]
    steps: tuple[SearchStep, ...]
    transients: tuple[TransientCandidate, ...]
    evidence: Evidence
    initial: Evidence
