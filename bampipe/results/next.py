"""``models/<model>/next.json``: the trial to record next, and what it is expected to give."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, Literal

from pydantic import Field

from bampipe.results.record import Names, Record, Result, Share, Size
from bampipe.schema import Count

Purpose = Literal["precision", "decision", "sensitivity"]
"""What a trial is for: smaller uncertainties, one effect distinguished from others, effects shown
that the trials at hand would not have shown."""

NOTHING = "nothing missing"
"""Name of the alternative that no effect is missing."""
AS_FORECAST = 1.3
"""Factor within which an uncertainty came as forecast."""


def join_effects(effects: Iterable[str]) -> str:
    """The name of effects that together are one alternative."""
    return " + ".join(effects) or NOTHING


def split_effects(name: str) -> set[str]:
    """The effects of an alternative that is called so by `join_effects`."""
    return {*name.split(" + ")} - {NOTHING}


class Move(Record):
    """Back and forth of one axis."""

    low: float
    high: float
    slow: Size = Field(description="Least and")
    fast: Size = Field(description="most of the highest speed of each stroke")
    rest_s: Size = 0.0
    unit: Literal["rad", "m"]


class ExpectedSd(Record):
    """Standard deviation of one parameter, without and with new trials."""

    before: Size = Field(description="As published")
    after: Size = Field(description="Median")
    low: Size = Field(description="What comes lies between this and")
    high: Size = Field(description="this, in eight of ten cases")
    unit: str

    @property
    def is_sharp(self) -> bool:
        """Whether one number says it: both ends are within `AS_FORECAST` of the median."""
        return self.high <= AS_FORECAST * self.after and self.after <= AS_FORECAST * self.low

    @property
    def number(self) -> str:
        """What is forecast without its unit: one number where it can be trusted, else a range."""
        return f"{self.after:.2g}" if self.is_sharp else f"{self.low:.2g} to {self.high:.2g}"


class ExpectedConfusion(Record):
    """Chance of taking one alternative for another."""

    between: Names = Field(description="Each by its effects, joined by +")
    weight: Share = Field(description="Box-Hill weight of the pair: product of the odds")
    before: Share = Field(description="By the probabilities of the diagnosis")
    after: Share = Field(description="Median of those who follow it")
    distance_before: Size = Field(description="Expected log likelihood ratio, nats")
    distance_after: Size
    left: dict[str, Size] = Field(
        description="By axis: error on the new trial of the wrong one refitted, over the noise"
    )


class Proposal(Record):
    """One trial that could be recorded."""

    sentence: str
    seconds: Size = Field(description="Of all its trials together")
    parts: Count = Field(default=1, description="Trials in which it is recorded, each as long")
    like: str = Field(
        default="", description="The trial at hand that is imitated; there are no moves then"
    )
    moves: dict[str, Move] = Field(description="By axis; the first is the one that it is about")
    pose: dict[str, float] = Field(description="Where the other axes are held, rad or m")
    brakes: Share = Field(default=0.0, description="Share of the commands of the viscous trials")
    levels: dict[str, float] = Field(default={}, description="Of further channels")
    worth: float = Field(description="By which proposals are ranked; of nine versions in ten")
    information_gain: float = Field(description="Half the drop of the log determinant, nats")
    sd: dict[str, ExpectedSd] = Field(
        default={},
        description="By parameter; none where the model lacks something or is not fitted to it",
    )
    confusion: tuple[ExpectedConfusion, ...] = ()
    farther: Names = Field(default=(), description="Axes moved farther than in the trials at hand")
    faster: Names = Field(default=(), description="Axes moved faster than there")


class Detectable(Record):
    """The smallest strength of an effect that the trials would have revealed."""

    parameter: str
    smallest: Size | None = Field(description="null where they do not excite it")
    typical: float = Field(description="Size at which the effect is clearly there")
    unit: str
    axis: str = Field(description="Where it shows first; empty where it shows nowhere")
    with_proposal: Size | None = Field(
        default=None, description="The same once the first proposal has been recorded"
    )


class PlannedTrial(Record):
    """One trial of a plan."""

    sentence: str
    seconds: Size
    times: Count = Field(description="How often it is recorded")
    moves: dict[str, Move] = Field(description="By axis; the first is the one that it is about")


class PlannedSd(ExpectedSd):
    """The same with the trials of a plan, beside what is asked."""

    asked: Size


class PlannedConfusion(Record):
    """Chance of taking one effect for another, without and with the trials of a plan."""

    between: Names
    before: Share
    after: Share


class Plan(Record):
    """The trials that bring every uncertainty below what is asked."""

    sentence: str
    seconds: Size = Field(description="Of all trials")
    is_enough: bool = Field(description="Whether what is asked is expected to be reached")
    trials: tuple[PlannedTrial, ...]
    sd: dict[str, PlannedSd] = Field(
        default={}, description="By parameter; none where the model lacks something"
    )
    confusion: tuple[PlannedConfusion, ...] = ()


class NextResult(Result):
    """The trial to record next, and what it is expected to give."""

    FILE: ClassVar[str] = "models/{model}/next.json"
    STAGE: ClassVar[str] = "next"
    EARLIER: ClassVar[str] = "models/{model}/forecasts"
    """Folder of earlier proposals whose trial may still come, each as in FILE."""

    model: str
    purpose: Purpose
    parameter: str = Field(default="", description="The one that is to become precise")
    trials: Names = Field(description="At hand when this was proposed")
    sentence: str = Field(description="What to record")
    why: str
    expected: str = Field(description="What it is expected to give")
    proposals: tuple[Proposal, ...] = Field(description="Best first")
    sensitivity: dict[str, Detectable] = Field(default={}, description="By effect of the library")
    unpromised: Names = Field(
        default=(),
        description="Effects that change the motion too much for such a number",
    )
    shows: Names = Field(
        default=(), description="Effects that the first proposal is to show, and the trials not"
    )
    plan: Plan | None = None
