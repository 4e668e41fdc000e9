"""What a diagnosis found: verdicts by axis, the ranking of candidates, the effects to add."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from bampipe.results.diagnose import Verdict
from bampipe.results.standing import Standing
from bampipe.trials.residuals import Evidence


@dataclass(frozen=True)
class Ranked:
    """One candidate in the ranking; errors are of the axis where it helps most, N.m or N."""

    effect: str
    axis: int
    held_out_rmse_before: float
    held_out_rmse_after: float
    p_value: float
    score: float
    values: Mapping[str, float]
    indistinguishable_from: tuple[str, ...] = ()


@dataclass(frozen=True)
class AxisFinding:
    """Verdict on one axis.

    Attributes:
        verdict: ``nothing_missing``, ``missing``, ``unknown_effect``, or ``undecided`` where
            the noise floor is wrong.
        rmse_before, rmse_after: held-out error without and with the effects found, N.m or N.
        noise_floor: what the final model leaves when it is the whole truth, N.m or N.
        floor_sd: its scatter over replays.
        standing: the error against the floor.
        explainable_share: share of the residual of the model as given that a flexible regressor
            predicts on unseen trials, beyond what it predicts on replays; zero where that is nil.
        explainable_after: the same with the effects found.
        explainable_chance: share that it predicts on replays of the final model, the largest.
        effects: effects found that act on this axis.
        remains: whether the effects found leave something that no effect explains.
        nearest: on an axis called unknown, the effects that come nearest without explaining it.
        explained: share of the excess mean square that the effects found or nearest remove.
    """

    verdict: Verdict
    rmse_before: float
    rmse_after: float
    noise_floor: float
    floor_sd: float
    standing: Standing
    explainable_share: float
    explainable_after: float
    explainable_chance: float
    effects: tuple[str, ...] = ()
    remains: bool = False
    nearest: tuple[str, ...] = ()
    explained: float = 0.0


@dataclass(frozen=True)
class Diagnosis:
    """What `diagnose` found.

    Attributes:
        axes: by coordinate, in order.
        ranking: candidates, best first.
        selected: effects to add, in order.
        groups: for each selected effect, the others that these trials cannot tell from it.
        evidence: of the model with all selected effects.
        initial: of the model as given.
    """

    axes: tuple[AxisFinding, ...]
    ranking: tuple[Ranked, ...]
    selected: tuple[str, ...]
    groups: Mapping[str, tuple[str, ...]]
    evidence: Evidence
    initial: Evidence
