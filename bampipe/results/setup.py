"""``filter/setup.json``: whether the recorded signals mean what session and device file say."""

from typing import Literal

from pydantic import Field

from bampipe.results.record import Names, Record, Result, Share, Size
from bampipe.schema import Count

AxisState = Literal["sound", "mistaken", "hardly_moves", "unexplained"]
"""Unexplained if the bare device hardly follows the variation of the applied force."""
Kind = Literal["sign", "scale", "exchange", "zero", "clock", "gravity"]


class PossibleMistake(Record):
    """One mistake in a session or device file."""

    kind: Kind
    signals: Names
    """Axes, force channels and other channels concerned; none for a clock or gravity"""
    sentence: str = Field(description="The mistake and its correction")


class SetupMistake(PossibleMistake):
    """A mistake that was found, with its evidence."""

    factor: float = Field(default=1.0, description="Correcting factor of a scale or clock")
    offset: float = Field(default=0.0, description="Correction of a zero, rad or m")
    gravity: tuple[float, float, float] | None = None
    """Corrected gravity in the frame of a robot's base, m/s2"""
    axes: Names = Field(description="Whose equations it spoils")
    evidence: str = Field(description="The change after its correction")
    error_before: dict[str, Size]
    """Error of the fit by axis, per cent of the applied force"""
    error_after: dict[str, Size] = Field(description="The same after its correction")
    alternatives: tuple[PossibleMistake, ...] = ()
    """Other mistakes that the trials cannot distinguish from this one"""


class AxisSetup(Record):
    """The state of the set-up of one axis."""

    state: AxisState
    error_percent: Size | None
    """Error of the bare device fitted by least squares, per cent of the applied force; null without
    applied force, or if the axis hardly moves"""
    moving_share: Share = Field(description="Share of the samples in which the axis moves")


class SetupResult(Result, file="filter/setup.json", stage="filter"):
    """Whether the recorded signals mean what session and device file say."""

    headline: str = Field(description="Empty if nothing is wrong")
    mistakes: tuple[SetupMistake, ...]
    warnings: Names = Field(description="Reasons to doubt results that are no mistakes")
    unexplained: dict[str, str] = Field(default_factory=dict)
    """What the bare device leaves unexplained, by axis; a model with effects may explain it"""
    tested: Count = Field(description="Number of set-ups compared with the stated one")
    axes: dict[str, AxisSetup] = Field(min_length=1)
