"""``models/<model>/next.json``: the trial to record next, and its expected result."""

from collections.abc import Iterable
from typing import ClassVar, Literal

from pydantic import Field

from bampipe.results.record import Names, Record, Result, Share, Size
from bampipe.schema import Count

Purpose = Literal["precision", "decision", "sensitivity"]
"""Purpose of a trial: smaller uncertainties, a decision between effects, or sensitivity to effects
that the present trials would not have revealed."""

NOTHING = "nothing missing"
"""Name of the alternative without any missing effect."""
AS_FORECAST = 1.3
"""Factor within which an uncertainty counts as forecast."""


def join_effects(effects: Iterable[str]) -> str:
    """Return the name of effects that together are one alternative."""
    return " + ".join(effects) or NOTHING


def split_effects(name: str) -> set[str]:
    """Return the effects of an alternative from its name by `join_effects`."""
    return {*name.split(" + ")} - {NOTHING}


class Move(Record):
    """Motion of one axis back and forth."""

    low: float
    high: float
    slow: Size = Field(description="Highest speed of the slowest stroke")
    fast: Size = Field(description="Highest speed of the fastest stroke")
    rest_s: Size = 0.0
    unit: Literal["rad", "m"]


class ExpectedSd(Record):
    """Standard deviation of one parameter, without and with new trials."""

    before: Size = Field(description="As published")
    after: Size = Field(description="Median")
    low: Size = Field(description="Lower end of the range that holds eight of ten outcomes")
    high: Size = Field(description="Upper end of that range")
    unit: str

    @property
    def is_sharp(self) -> bool:
        """Whether one number is enough: both ends are within `AS_FORECAST` of the median."""
        return self.high <= AS_FORECAST * self.after and self.after <= AS_FORECAST * self.low

    @property
    def number(self) -> str:
        """The forecast without its unit: one number if both ends agree, otherwise a range."""
        return f"{self.after:.2g}" if self.is_sharp else f"{self.low:.2g} to {self.high:.2g}"


class PlannedConfusion(Record):
    """Chance of taking one alternative for another, without and with new trials."""

    between: Names = Field(description="Each by its effects, joined by +")
    before: Share = Field(description="Probabilities of the diagnosis")
    after: Share = Field(description="Median over people who follow it")


class ExpectedConfusion(PlannedConfusion):
    """The same with one new trial, and its errors."""

    weight: Share = Field(description="Box-Hill weight of the pair: product of the odds")
    left: dict[str, Size]
    """By axis: error on the new trial of the wrong one refitted, over the noise"""


class Proposal(Record):
    """One trial that could be recorded."""

    sentence: str
    seconds: Size = Field(description="Total length of its trials")
    parts: Count = Field(default=1, description="Trials of equal length in which it is recorded")
    like: str = Field(default="", description="The present trial that is imitated, without moves")
    moves: dict[str, Move] = Field(description="By axis; the trial is designed for the first")
    pose: dict[str, float] = Field(description="Positions at which other axes are held, rad or m")
    brakes: Share = Field(default=0.0, description="Share of the commands of the viscous trials")
    levels: dict[str, float] = Field(default={}, description="Of further channels")
    worth: float = Field(description="Utility that ranks proposals: nine in ten versions reach it")
    information_gain: float = Field(description="Half the drop of the log determinant, nats")
    sd: dict[str, ExpectedSd] = Field(default={})
    """By parameter; none if the model lacks something or is not fitted to it"""
    confusion: tuple[ExpectedConfusion, ...] = ()
    farther: Names = Field(default=(), description="Axes moved farther than in the present trials")
    faster: Names = Field(default=(), description="Axes moved faster than in the present trials")


class Detectable(Record):
    """The smallest strength of an effect that the trials would have revealed."""

    parameter: str
    smallest: Size | None = Field(description="null if they do not excite it")
    typical: float = Field(description="Size at which the effect is clearly visible")
    unit: str
    axis: str = Field(description="Axis on which it is revealed first; empty if on none")
    with_proposal: Size | None = Field(default=None, description="With the first proposal recorded")


class Extent(Record):
    """Range, speed, acceleration and effort of an axis: limits, or values that are reached."""

    lower: float = Field(description="Position, rad or m")
    upper: float
    speed: Size = Field(description="Highest, rad/s or m/s")
    acceleration: Size = Field(description="Highest, rad/s2 or m/s2")
    effort: Size = Field(description="Largest, N.m or N")


class Trajectory(Record):
    """The trajectory that drives follow in each trial of the first proposal."""

    file: str = Field(description="Path in the run folder")
    seconds: Size
    limits: dict[str, Extent] = Field(description="By axis")
    assumed: Names
    """Axes without a stated acceleration: their limit is the highest seen"""
    used: dict[str, Extent] = Field(description="By axis; effort is the model's forecast")


class PlannedTrial(Record):
    """One trial of a plan."""

    sentence: str
    seconds: Size
    times: Count = Field(description="How often it is recorded")
    moves: dict[str, Move] = Field(description="By axis; the trial is designed for the first")


class PlannedSd(ExpectedSd):
    """Standard deviation with the trials of a plan, and the required limit."""

    asked: Size


class Plan(Record):
    """The trials that bring every uncertainty below the requested limit."""

    sentence: str
    seconds: Size = Field(description="Of all trials")
    is_enough: bool = Field(description="Whether the limit is expected to be reached")
    trials: tuple[PlannedTrial, ...]
    sd: dict[str, PlannedSd] = Field(default={})
    """By parameter; none if the model lacks something"""
    confusion: tuple[PlannedConfusion, ...] = ()


class NextResult(Result, file="models/{model}/next.json", stage="next"):
    """The trial to record next, and its expected result."""

    EARLIER: ClassVar[str] = "models/{model}/forecasts"
    """Folder of earlier proposals whose trial may still come, each as in FILE."""

    model: str
    purpose: Purpose
    parameter: str = Field(default="", description="The parameter whose uncertainty is to fall")
    trials: Names = Field(description="Trials present at the time of this proposal")
    sentence: str = Field(description="The motion to record")
    why: str
    expected: str = Field(description="Its expected result")
    proposals: tuple[Proposal, ...] = Field(description="Best first")
    sensitivity: dict[str, Detectable] = Field(default={}, description="By effect of the library")
    unpromised: Names = ()
    """Effects that change the motion too much for such a number"""
    shows: Names = ()
    """Effects that the first proposal would reveal, unlike the present trials"""
    plan: Plan | None = None
    trajectory: Trajectory | None = None
