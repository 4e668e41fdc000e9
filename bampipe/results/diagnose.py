"""``models/<model>/diagnose.json``: effects that the model lacks, by axis, with probabilities."""

from typing import Annotated, Literal

from pydantic import Field

from bampipe.results.floor import FloorStatus
from bampipe.results.record import Names, Record, Result, Share, Size
from bampipe.results.terms import EffectText
from bampipe.schema import Count

UNKNOWN = "something unknown"
"""Beside effects in a set: whatever no effect of the library explains."""
Verdict = Literal["nothing_missing", "missing", "undecided", "unknown_effect", "no_verdict"]
UpToOne = Annotated[float, Field(le=1)]


class AxisVerdict(Record):
    """The effects that one axis lacks."""

    verdict: Verdict
    effects: Names = Field(description="Those of the most probable set here; `extend` adds them")
    probabilities: dict[str, Share] = Field(description="Effects of any probable set on this axis")
    unknown: Share = Field(description="Probability that an effect outside the library is missing")
    rmse_before: Size = Field(description="On held-out trials")
    rmse_after: Size = Field(description="With the most probable set")
    rmse_beyond_bias: Size
    """With it, without the bias that filters leave where friction changes its sign"""
    noise_floor: Size = Field(description="Error of replicates of the final model")
    noise_floor_sd: Size
    standing: FloorStatus = Field(description="rmse_after against noise_floor")
    unit: str
    force_rms: Size = Field(description="Root mean square of the applied force")
    explained: UpToOne
    """Share of the mean square of the applied force that the final model explains"""
    explainable_share: UpToOne
    """Share of the residual, in the mean square, that a smooth function of position, speed, load
    and time since reversal predicts on unseen trials"""
    explainable_after: UpToOne = Field(description="The same of the final model")
    explained_by_effects: UpToOne
    """Share of the excess mean square that the most probable set removes"""
    remains: bool = Field(description="Whether the set leaves something unexplained")
    sentence: str

    @property
    def likely(self) -> list[str]:
        """The effects that may be missing, the most probable first."""
        return sorted(self.probabilities, key=lambda name: (-self.probabilities[name], name))


class RankedEffect(Record):
    """A candidate effect on the axis whose error it lowers most."""

    effect: str
    axis: str
    held_out_rmse_before: Size = Field(description="Of the model diagnosed")
    held_out_rmse_after: Size
    """For an effect of the most probable set, error without and with it beside the others;
    otherwise of the diagnosed model with it alone, as if both sides of the equation kept their
    size"""
    unit: str
    probability: Share
    p_value: Share = Field(description="Probability that replicates give any candidate such a gain")
    score: float = Field(description="Gain in log evidence, nats")
    parameters: dict[str, float]
    indistinguishable_from: Names


class WeighedSet(Record):
    """A set of effects and how probable it is."""

    effects: Names = Field(description="Effects beyond those of the diagnosed model")
    unknown: str | None = Field(default=None, description="Axis with an unknown effect beside them")
    probability: Share
    log_evidence: float = Field(description="Log evidence over that of the first set, nats")


class NullDistribution(Record):
    """Gains of candidates on replicates of the final model, in which nothing is missing."""

    replicates: Count
    largest: tuple[float, ...] = Field(description="Largest gain of any candidate, nats")
    measured: float = Field(description="Largest gain on the measured trials, final model")
    effect: str = Field(description="The candidate with that gain")
    p_value: Share


class SuggestedTrial(Record):
    """A trial that would distinguish effects."""

    between: Names
    axis: str = Field(description="Axis on which they differ most")
    design: str
    confusion: Share = Field(description="Probability of taking one for the other, with that trial")
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
    doing: str = Field(description="Motion of the device")


class DiagnoseResult(Result, file="models/{model}/diagnose.json", stage="diagnose"):
    """Effects that the model lacks, by axis, with probabilities."""

    model: str
    trials: Names = Field(default=(), description="Trials on which effects were weighed")
    sentence: str = Field(description="The verdicts in words")
    next: str = Field(description="The command or action that follows")
    axes: dict[str, AxisVerdict] = Field(min_length=1)
    ranking: tuple[RankedEffect, ...] = Field(description="Best first")
    descriptions: dict[str, EffectText] = Field(default={})
    """Text of the effect file, by name of an effect in the ranking"""
    selected: Names
    fitted: dict[str, float] = Field(default={})
    """Parameters of the effects of the final model, in SI units"""
    sets: tuple[WeighedSet, ...] = Field(description="The most probable first")
    chance: NullDistribution | None = None
    """null if replicates do not resemble the measurement"""
    cut_short: bool = False
    """Whether the search stopped at the largest set allowed"""
    suggested_trial: SuggestedTrial | None
    not_weighed: Names = Field(default=(), description="Effects left out of the search on request")
    maps: dict[str, dict[str, ResidualMap]] = Field(description="By axis, then variable")
    worst_windows: tuple[WorstWindow, ...]

    @property
    def lacking(self) -> Names:
        """Axes with another verdict than ``nothing_missing``."""
        return tuple(a for a, entry in self.axes.items() if entry.verdict != "nothing_missing")

    @property
    def remainder_unknown(self) -> bool:
        """Whether something unknown is missing on each lacking axis, and no effect is probable."""
        return {self.axes[axis].verdict for axis in self.lacking} == {"unknown_effect"}

    def sets_on(self, axis: str) -> list[tuple[Names, float]]:
        """Return the sets restricted to one axis, the most probable first.

        A set that holds improbable effects alone on the axis keeps these: it is not "nothing".
        `UNKNOWN` is a member where it is an open question whether something unknown is missing.
        """
        entry, found = self.axes[axis], dict[Names, float]()
        axis_of = {each.effect: each.axis for each in self.ranking}
        open_question = entry.unknown > 0.0 and not entry.remains
        for one in self.sets:
            here = tuple(name for name in entry.likely if name in one.effects)
            here = here or tuple(name for name in one.effects if axis_of.get(name) == axis)
            here += (UNKNOWN,) * (open_question and one.unknown == axis)
            found[here] = found.get(here, 0.0) + one.probability
        return sorted(found.items(), key=lambda pair: -pair[1])

    def fitted_of(self, effects: Names) -> dict[str, float]:
        """Return the fitted parameters of ``effects``; none where it has not fitted them all."""
        found = [
            {k: v for k, v in self.fitted.items() if k.startswith(f"{effect.replace(':', '.')}.")}
            for effect in effects
        ]
        return {k: v for one in found for k, v in one.items()} if all(found) else {}

    @property
    def unnamed_axes(self) -> Names:
        """Axes with a residual that no effect of the library explains."""
        return tuple(a for a, e in self.axes.items() if e.remains and e.verdict != "no_verdict")
