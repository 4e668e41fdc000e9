"""``models/<model>/draft.json``: a formula for a residual that no effect explains."""

from typing import Literal

from pydantic import Field

from bampipe.results.record import Names, Record, Result, Share, Size
from bampipe.schema import Count

ActsAs = Literal["force", "friction", "damping", "inertia", "reading"]
DraftVerdict = Literal["drafted", "nothing_beyond_chance", "no_lower_error"]


class FittedConstant(Record):
    """A constant of a formula, fitted together with all parameters of the model."""

    value: float
    low: float = Field(description="Lower end of its 95 % interval")
    high: float
    unit: str


class DraftCurve(Record):
    """A formula against its variable, at the highest speed or acceleration if it scales with it."""

    variable: str
    variable_unit: str
    unit: str = Field(description="Of the force")
    at: tuple[float, ...]
    mean: tuple[float, ...]
    low: tuple[float, ...] = Field(description="95 % band by the constants' covariance")
    high: tuple[float, ...]
    beside: dict[str, float]
    """Other variables of the formula, with the value at which the curve is drawn"""


class DraftedEffect(Record):
    """A formula that was written as an effect file."""

    file: str = Field(description="Relative to the run folder")
    axis: str
    expression: str
    acts_as: ActsAs
    constants: dict[str, FittedConstant]
    summary: str
    looks_like: str
    sentence: str
    curve: DraftCurve


class ChanceOfDraft(Record):
    """Gains of the same search on replicates of the model, in which nothing is missing."""

    gain: float = Field(description="Gain in log evidence of the best formula on the grid, nats")
    gains: tuple[float, ...] = Field(description="Gain of the best formula on each replicate, nats")
    p_value: Share


class DraftOption(Record):
    """A formula that was fitted with the model."""

    effects: Names = Field(description="Empty for the unchanged model")
    constants: Count
    held_out_rmse: Size
    log_evidence: float = Field(description="Gain over the unchanged model, nats")


class NearestEffect(Record):
    """An effect of the library beside the draft."""

    effect: str
    held_out_rmse: Size
    sentence: str


class AxisDraft(Record):
    """The search on one axis and its result."""

    verdict: DraftVerdict
    effects: Names = Field(description="Drafted effects, which `extend` adds")
    chance: tuple[ChanceOfDraft, ...] = Field(min_length=1)
    """Search of the first formula, and of the second one if any"""
    options: tuple[DraftOption, ...] = Field(description="Shortest first")
    rmse_before: Size = Field(description="On held-out trials")
    rmse_after: Size
    noise_floor: Size = Field(description="Median error of replicates of the final model")
    unit: str
    nearest: tuple[NearestEffect, ...]
    sentence: str


class DraftResult(Result, file="models/{model}/draft.json", stage="draft"):
    """Formulas for residuals that no effect of the library explains, by axis."""

    model: str
    sentence: str = Field(description="The findings in words")
    next: str = Field(description="The command or action that follows")
    axes: dict[str, AxisDraft] = Field(min_length=1)
    effects: dict[str, DraftedEffect] = Field(description="By name, as a model has it")
    selected: Names
