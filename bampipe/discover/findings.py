"""What a diagnosis found: verdicts by axis, the ranking of candidates, the effects to add."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from bampipe.discover.influence import Stretch
from bampipe.discover.other_band import AxisInBand
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
class Step:
    """One step of the search over sets of effects.

    Attributes:
        effects: those in the model then, in order.
        held_out_rmse: its error, by axis, N.m or N.
    """

    effects: tuple[str, ...]
    held_out_rmse: tuple[float, ...]


@dataclass(frozen=True)
class AxisFinding:
    """Verdict on one axis.

    Attributes:
        verdict: ``nothing_missing``; ``missing``; ``undecided`` where effects are likely but not
            sure, several fit alike, or the noise floor is wrong; ``unknown_effect``.
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
        explained: share of the excess mean square that the effects found remove.
        odds: of an undecided axis, by effect, that it is this one.
        worst_second: where the error with the effects found is largest.
        rmse_without_second: that error but for it: one second must not make an axis fail.
    """

    verdict: Verdict
    rmse_before: float
    rmse_after: float
    noise_floor: float
    floor_sd: float
    standing: Standing
    worst_second: Stretch
    rmse_without_second: float
    explainable_share: float
    explainable_after: float
    explainable_chance: float
    effects: tuple[str, ...] = ()
    remains: bool = False
    explained: float = 0.0
    odds: Mapping[str, float] = field(default_factory=dict)


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
        transient: candidates that only one second speaks for: their axis and that second.
        evidence: of the model with all selected effects.
        initial: of the model as given.
        other_band: how the final model stands in another band, by axis.
    """

    axes: tuple[AxisFinding, ...]
    ranking: tuple[Ranked, ...]
    selected: tuple[str, ...]
    groups: Mapping[str, tuple[str, ...]]
    contests: Mapping[str, tuple[Contender, ...]]
    steps: tuple[Step, ...]
    transient: Mapping[str, tuple[int, Stretch]]
    evidence: Evidence
    initial: Evidence
    other_band: tuple[AxisInBand | None, ...] = ()
