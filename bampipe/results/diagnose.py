"""``models/<model>/diagnose.json``: what the model lacks, axis by axis, and how sure that is."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from bampipe.results.floor import FloorStatus
from bampipe.results.record import Names, Record, Result, Share, Size
from bampipe.results.terms import EffectText
from bampipe.schema import Count

Verdict = Literal["nothing_missing", "missing", "undecided", "unknown_effect", "no_verdict"]
UpToOne = Annotated[float, Field(le=1)]


class AxisVerdict(Record):
    """What one axis lacks."""

    verdict: Verdict
    effects: Names = Field(description="Of the most probable set, on this axis; `extend` adds them")
    probabilities: dict[str, Share] = Field(
        description="Effects of any probable set on this axis, by their probability"
    )
    unknown: Share = Field(
        description="Probability that something is missing which no effect of the library is"
    )
    rmse_before: Size = Field(description="On held-out trials")
    rmse_after: Size = Field(description="With the most probable set")
    rmse_beyond_bias: Size = Field(
        description="With it, but for the bias that filters leave where friction turns"
    )
    noise_floor: Size = Field(description="The error of replays of the final model")
    noise_floor_sd: Size
    standing: FloorStatus = Field(description="rmse_after against noise_floor")
    unit: str
    force_rms: Size = Field(description="Of the applied force, root mean square")
    explained: UpToOne = Field(
        description="Share of the mean square of the applied force that the final model explains"
    )
    explainable_share: UpToOne = Field(
        description="Share of the residual, in the mean square, that a smooth function of position,"
        " speed, load and time since reversal predicts on unseen trials"
    )
    explainable_after: UpToOne = Field(description="The same of the final model")
    explained_by_effects: UpToOne = Field(
        description="Share of the excess mean square that the most probable set removes"
    )
    remains: bool = Field(description="Whether more is missing than the set explains")
    sentence: str

    @property
    def likely(self) -> list[str]:
        """The effects that may be missing, the likeliest first."""
        return sorted(self.probabilities, key=lambda name: -self.probabilities[name])


class RankedEffect(Record):
    """A candidate effect on the axis that it helps most."""

    effect: str
    axis: str
    held_out_rmse_before: Size = Field(description="Of the model diagnosed")
    held_out_rmse_after: Size = Field(
        description="Of an effect of the most probable set, without and with it beside the others;"
        " else of the model diagnosed with it alone, as if both sides of the equation kept their"
        " size"
    )
    unit: str
    probability: Share
    p_value: Share = Field(description="Chance that replays give a gain as large to any candidate")
    score: float = Field(description="Log evidence that it gains, nats")
    parameters: dict[str, float]
    indistinguishable_from: Names


class WeighedSet(Record):
    """A set of effects and how probable it is."""

    effects: Names = Field(description="Beyond those of the model diagnosed")
    unknown: str | None = Field(
        default=None, description="Axis on which something unknown stands beside them"
    )
    probability: Share
    log_evidence: float = Field(description="Over that of the first set, nats")


class NullDistribution(Record):
    """What chance gives to candidates where nothing is missing: replays of the final model."""

    replicates: Count
    largest: tuple[float, ...] = Field(
        description="On each replay, the largest gain of any candidate, nats"
    )
    measured: float = Field(description="The same on the measured trials, beside the final model")
    effect: str = Field(description="Of which candidate")
    p_value: Share


class SuggestedTrial(Record):
    """What to record to tell a group apart."""

    between: Names
    axis: str = Field(description="Where it shows most")
    design: str
    separation: Size = Field(
        description="Error there of the wrong one, refitted, in noise floors; on that trial"
    )
    separation_now: Size = Field(description="The same on the trials at hand")
    confusion: Share = Field(description="Chance of taking one for the other, with that trial")
    confusion_now: Share
    sentence: str


class ResidualMap(Record):
    """Mean residual in bins of one variable, with a confidence band."""

    unit: str = Field(description="Of the variable")
    center: tuple[float, ...]
    mean: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    count: tuple[Count, ...]
    variance_share: Share


class WorstWindow(Record):
    """A stretch of a trial with a large residual."""

    axis: str
    trial_id: str
    t_start: float
    t_end: float
    rmse: Size
    unit: str
    doing: str = Field(description="What the device was doing")


class DiagnoseResult(Result):
    """What the model lacks, axis by axis, and how sure that is."""

    FILE: ClassVar[str] = "models/{model}/diagnose.json"
    STAGE: ClassVar[str] = "diagnose"

    model: str
    trials: Names = Field(default=(), description="By which effects were weighed")
    sentence: str = Field(description="The verdicts in words")
    next: str = Field(description="What to do now")
    axes: dict[str, AxisVerdict] = Field(min_length=1)
    ranking: tuple[RankedEffect, ...] = Field(description="Best first")
    descriptions: dict[str, EffectText] = Field(
        default={}, description="By name of an effect in the ranking: what its file says"
    )
    selected: Names
    sets: tuple[WeighedSet, ...] = Field(description="The most probable first")
    chance: NullDistribution | None = Field(
        default=None, description="null where replays are not like the measurement"
    )
    cut_short: bool = Field(
        default=False, description="Whether more effects were wanted than may be added"
    )
    suggested_trial: SuggestedTrial | None
    not_weighed: Names = Field(default=(), description="Effects that the search was to leave out")
    maps: dict[str, dict[str, ResidualMap]] = Field(description="By axis, then variable")
    worst_windows: tuple[WorstWindow, ...]

    @property
    def lacking(self) -> Names:
        """Axes whose verdict is another one than that nothing is missing."""
        return tuple(a for a, entry in self.axes.items() if entry.verdict != "nothing_missing")

    def sets_on(self, axis: str) -> list[tuple[Names, float]]:
        """What the sets come to on one axis, by probability: the most probable first."""
        known, found = self.axes[axis].probabilities, dict[Names, float]()
        for one in self.sets:
            here = tuple(name for name in known if name in one.effects)
            found[here] = found.get(here, 0.0) + one.probability
        return sorted(found.items(), key=lambda pair: -pair[1])

    @property
    def alternatives(self) -> dict[str, Names]:
        """By effect of the most probable set, those that stand in its place in other sets."""
        found = {}
        for effect in self.selected:
            rest = {*self.selected} - {effect}
            others = [s.effects for s in self.sets[1:] if effect not in s.effects]
            swapped = [{*o} - rest for o in others if rest <= {*o} and len({*o} - rest) == 1]
            found[effect] = tuple(dict.fromkeys(name for one in swapped for name in one))
        return found

    @property
    def unnamed_axes(self) -> Names:
        """Axes on which something is left that no effect of the library explains."""
        return tuple(
            axis
            for axis, entry in self.axes.items()
            if entry.remains and entry.verdict != "no_verdict"
        )
