"""``models/<model>/diagnose.json``: what the model lacks, axis by axis, and how sure that is."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from bampipe.results.record import Names, Record, Result, Share, Size
from bampipe.results.standing import Standing
from bampipe.results.terms import EffectText
from bampipe.schema import Count

Verdict = Literal["nothing_missing", "missing", "undecided", "unknown_effect"]
UpToOne = Annotated[float, Field(le=1)]


class AxisVerdict(Record):
    """What one axis lacks."""

    verdict: Verdict
    effects: Names = Field(description="Found to be missing")
    rmse_before: Size = Field(description="On held-out trials")
    rmse_after: Size = Field(description="With what was found")
    noise_floor: Size
    noise_floor_sd: Size
    standing: Standing = Field(description="rmse_after against noise_floor")
    unit: str
    explainable_share: UpToOne = Field(
        description="Share of the residual that any flexible function predicts on unseen data"
    )
    explainable_after: UpToOne
    explainable_chance: UpToOne = Field(description="Its chance level")
    remains: bool = Field(description="Whether something is left that the library does not explain")
    nearest: Names = Field(
        description="Of an unknown effect: what the library has that comes nearest"
    )
    explained_by_effects: UpToOne = Field(
        description="Share of the excess mean square that effects or nearest remove"
    )
    sentence: str


class RankedEffect(Record):
    """A candidate effect on the axis that it helps most."""

    effect: str
    axis: str
    held_out_rmse_before: Size
    held_out_rmse_after: Size
    unit: str
    p_value: Share
    score: float
    parameters: dict[str, float]
    indistinguishable_from: Names


class SuggestedTrial(Record):
    """What to record to tell a group apart; separations in noise floors."""

    between: Names
    axis: str
    design: str
    separation: Size
    separation_now: Size
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
    suggested_trial: SuggestedTrial | None
    maps: dict[str, dict[str, ResidualMap]] = Field(description="By axis, then variable")
    worst_windows: tuple[WorstWindow, ...]
