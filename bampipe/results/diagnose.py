"""``models/<model>/diagnose.json``: what the model lacks, axis by axis, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from bampipe.results.record import Names, Record, Result, Share, Size
from bampipe.results.standing import FLOOR_WRONG, Standing
from bampipe.results.terms import EffectText
from bampipe.schema import Count

Verdict = Literal["nothing_missing", "missing", "undecided", "unknown_effect"]
UpToOne = Annotated[float, Field(le=1)]


class Stretch(Record):
    """A stretch of a trial, s from its beginning."""

    trial_id: str
    t_start: float
    t_end: float


class OtherBand(Record):
    """How the final model stands in another band than that of the session."""

    cutoff_hz: Size
    rmse: Size = Field(description="Cross-validated, by one linear step")
    noise_floor: Size = Field(description="The same of replays")
    standing: Standing


class AxisVerdict(Record):
    """What one axis lacks."""

    verdict: Verdict
    effects: Names = Field(description="Found to be missing; they are what `extend` adds")
    likely: dict[str, Share] = Field(
        description="Where undecided: effects that may be missing, by their odds"
    )
    rmse_before: Size = Field(description="On held-out trials")
    rmse_after: Size = Field(description="With what was found")
    noise_floor: Size
    noise_floor_sd: Size
    creeping_floor: Size | None = Field(
        default=None,
        description="Of replays that creep where the motion turns round, where that of ones that "
        "stand still there is clearly larger, and the noise floor",
    )
    standing: Standing = Field(description="rmse_after against noise_floor")
    worst_second: Stretch = Field(description="Where the residual with what was found is largest")
    rmse_without_worst_second: Size = Field(
        description="rmse_after but for it; whether something remains is judged by this"
    )
    other_band: OtherBand | None = Field(
        description="null where no other band is reasonable: below 8 Hz, or above the motion's"
    )
    unit: str
    explainable_share: UpToOne = Field(
        description="Share of the residual that any flexible function predicts on unseen data"
    )
    explainable_after: UpToOne
    explainable_chance: UpToOne = Field(description="Its chance level")
    remains: bool = Field(description="Whether something is left that the library does not explain")
    explained_by_effects: UpToOne = Field(
        description="Share of the excess mean square that what was found or is likely removes"
    )
    sentence: str

    @property
    def by_odds(self) -> list[str]:
        """The effects that may be missing, the likeliest first."""
        return sorted(self.likely, key=lambda name: -self.likely[name])


class RankedEffect(Record):
    """A candidate effect on the axis that it helps most."""

    effect: str
    axis: str
    held_out_rmse_before: Size = Field(
        description="Of the model diagnosed; for an effect found, of the one it was added to"
    )
    held_out_rmse_after: Size = Field(
        description="That, times the ratio of the cross-validated errors with and without it; "
        "measured for an effect that was added and refused"
    )
    unit: str
    p_value: Share
    score: float
    parameters: dict[str, float]
    indistinguishable_from: Names


class Contender(Record):
    """An effect that contends for a place in the model, all others found being in it."""

    effect: str
    axis: str = Field(description="Where the effect found helps most")
    held_out_rmse: Size = Field(
        description="There, with this effect in that place, as if it left both sides of the "
        "equation at their size"
    )
    score: float = Field(description="Gain in log likelihood over all axes")
    score_without_trial: float | None = Field(
        description="Without the trial that speaks most for the effect found; null with two trials"
    )
    score_without_second: float = Field(
        description="Without the second that speaks most for the effect found"
    )
    odds: Share = Field(
        description="That it is this one, of those that replays do not distinguish; else 0"
    )
    beside: Literal["", "about as likely", "likelier by score"] = Field(
        default="", description="Of a rival that a verdict names beside the effect found, why"
    )


def in_words(effect: str, contest: Sequence[Contender], mark: str = "") -> str:
    """An effect found, with the rivals that its odds do not set it apart from.

    Args:
        effect: its name; contest: who contends for its place, itself among them.
        mark: what a name stands between.
    """
    said = f"{mark}{effect}{mark}"
    for why in ("about as likely", "likelier by score"):
        rivals = [f"{mark}{c.effect}{mark}" for c in contest if c.beside == why]
        said += f" or, {why}, {' or '.join(rivals)}" if rivals else ""
    return said


class SearchStep(Record):
    """One step of the search over sets of effects."""

    effects: Names = Field(description="In the model then, beyond those of the model diagnosed")
    held_out_rmse: dict[str, Size] = Field(description="By axis")


class TransientCandidate(Record):
    """A candidate that only one second speaks for: it is not named as missing."""

    effect: str
    axis: str
    second: Stretch


RefusalReason = Literal["held_out", "runs_away", "replays", "scale", "stops"]


class RefusedEffect(Record):
    """A candidate that beats chance by its score, and is not kept."""

    effect: str
    axis: str
    held_out_rmse_before: Size = Field(description="Of the model that it was added to")
    held_out_rmse_after: Size | None = Field(
        description="With it, fitted, as if it left both sides of the equation at their size; null "
        "where it runs away"
    )
    without_worst_second_before: Size | None = Field(
        default=None, description="The same but for the worst second; null where it was not fitted"
    )
    without_worst_second_after: Size | None = None
    why: RefusalReason = Field(
        description="It does too little on held-out trials; or, fitted without one of them, runs "
        "away there; or replays with it give no floor that "
        "an error could be judged by; or it leaves next to nothing of what the force does, so that "
        "all forces become small together; or replays that truly stand still at reversals give it "
        "most of its gain as well"
    )


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
    groups: dict[str, Names] = Field(
        description="By effect found: others that these trials cannot tell from it"
    )
    contests: dict[str, tuple[Contender, ...]] = Field(
        description="By effect found: itself, then the rivals that come close to it"
    )
    steps: tuple[SearchStep, ...] = Field(
        description="Sets of effects that the search went through"
    )
    transients: tuple[TransientCandidate, ...]
    refused: tuple[RefusedEffect, ...] = ()
    suggested_trial: SuggestedTrial | None
    not_weighed: Names = Field(default=(), description="Effects that the search was to leave out")
    maps: dict[str, dict[str, ResidualMap]] = Field(description="By axis, then variable")
    worst_windows: tuple[WorstWindow, ...]

    @property
    def limits(self) -> str:
        """What the search left out, in a sentence; "" where it weighed the whole library."""
        if not self.not_weighed:
            return ""
        return f"Not weighed (setting `without`): {', '.join(self.not_weighed)}."

    @property
    def verdicts_in_words(self) -> dict[str, str]:
        """By axis, in a few words, with what is missing there."""
        found = {}
        for axis, entry in self.axes.items():
            contests = ((name, self.contests.get(name, ())) for name in entry.effects)
            named = " and ".join(in_words(*one) for one in contests)
            words = entry.verdict.replace("_", " ")
            found[axis] = f"{words} {named}".rstrip() if entry.verdict == "missing" else words
        return found

    def named(self, axis: str) -> list[str]:
        """Each effect found on an axis in words: with its rivals, and with those it is one of."""
        entry = self.axes[axis]
        return [
            f"{' or '.join(entry.by_odds)} (undecided)"
            if effect in entry.likely and len(entry.likely) > 1
            else in_words(effect, self.contests.get(effect, ()))
            for effect in entry.effects
        ]

    @property
    def unnamed_axes(self) -> Names:
        """Axes on which something is left that no effect of the library explains."""
        return tuple(
            axis
            for axis, entry in self.axes.items()
            if entry.remains and entry.standing not in FLOOR_WRONG
        )
