"""``filter/setup.json``: whether the recorded signals mean what session and device file say."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from bampipe.results.record import Names, Record, Result, Share, Size
from bampipe.schema import Count

Kind = Literal["sign", "scale", "exchange", "zero", "clock", "gravity"]


class PossibleMistake(Record):
    """One mistake in a session or device file."""

    kind: Kind
    signals: Names = Field(
        description="Axes, force channels and other channels that it concerns; none of a clock or"
        " of gravity"
    )
    sentence: str = Field(description="What is wrong, and what to write instead")


class SetupMistake(PossibleMistake):
    """A mistake that was found, with what speaks for it."""

    factor: float = Field(
        default=1.0, description="By which their readings must be multiplied, of a scale or clock"
    )
    offset: float = Field(default=0.0, description="Which must be added, rad or m, of a zero")
    gravity: tuple[float, float, float] | None = Field(
        default=None, description="In the frame of a robot's base, m/s2, where that is mistaken"
    )
    axes: Names = Field(description="Whose equations it spoils")
    evidence: str = Field(description="What changes once it is set right")
    error_before: dict[str, Size] = Field(
        description="Error of the fit by axis, per cent of the applied force"
    )
    error_after: dict[str, Size] = Field(description="The same with it set right")
    alternatives: tuple[PossibleMistake, ...] = Field(
        default=(), description="Other mistakes that the trials cannot tell from this one"
    )


class AxisSetup(Record):
    """What the trials say of the set-up of one axis."""

    state: Literal["sound", "mistaken", "hardly_moves"]
    error_percent: Size | None = Field(
        description="Error of the bare device fitted by least squares, per cent of the "
        "applied force; null where none is applied, or the axis hardly moves"
    )
    moving_share: Share = Field(description="Share of the samples in which the axis moves")


class SetupResult(Result):
    """Whether the recorded signals mean what session and device file say."""

    FILE: ClassVar[str] = "filter/setup.json"
    STAGE: ClassVar[str] = "filter"

    headline: str = Field(description="Empty where nothing is wrong")
    mistakes: tuple[SetupMistake, ...]
    warnings: Names = Field(description="What makes results doubtful without being a mistake")
    tested: Count = Field(description="Set-ups that were held against the one stated")
    axes: dict[str, AxisSetup] = Field(min_length=1)
