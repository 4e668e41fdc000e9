"""``compare.json``: the ladder of model versions on the same held-out trials."""

import math
from typing import Literal, Self

from pydantic import Field

from bampipe.results.floor import FLOOR_WRONG, FloorStatus
from bampipe.results.record import Names, Record, Result, Size
from bampipe.results.validate import AxisDrift, FreeRunError

NOTICEABLE = 0.01
"""Least relative fall of the held-out error that confirms a model; superfluous effects give
less."""


class Rung(Record):
    """One model version."""

    model: str
    parent: str | None
    added: str | None = Field(description="Effects that the parent lacks")
    effects: Names
    held_out_rmse: dict[str, Size]
    noise_floor: dict[str, Size | None] = Field(description="null if none was computed")
    standing: dict[str, FloorStatus]
    confirmed: bool
    """A model without a parent, or one with a confirmed parent and a lower held-out error than
    that; not a model without a noise floor if its parent has one"""
    unit: dict[str, str]
    free_run_mode: Literal["closed_loop", "open_loop"] | None = None
    free_run_reason: str = ""
    """Why there is no free run, or none in closed loop"""
    free_run: dict[str, FreeRunError] = Field(default={}, description="By axis")
    drift: dict[str, AxisDrift] = Field(default={}, description="By axis: short free runs")

    def improves_on(self, other: Self) -> bool:
        """Return whether its held-out error is lower and can still be judged.

        A version that has lost its noise floor is no better, whatever its error: its replicates
        diverge, or its error is far below the sensor noise, because both sides are small.
        """
        return self.has_lower_error_than(other) and not self.has_lost_its_floor(other)

    def has_lower_error_than(self, other: Self) -> bool:
        """Whether the held-out error, as the product over the axes, is noticeably lower."""
        ratios = (self.held_out_rmse[a] / max(e, 1e-300) for a, e in other.held_out_rmse.items())
        return math.prod(ratios) < 1.0 - NOTICEABLE

    def axes_worse_than(self, other: Self) -> set[str]:
        """Return the axes with a higher held-out error."""
        return {a for a, e in other.held_out_rmse.items() if self.held_out_rmse[a] > e}

    def has_lost_its_floor(self, other: Self) -> bool:
        """Whether its error has no floor on an axis where that of ``other`` has one."""
        mine, theirs = self.standing, other.standing
        return any(mine[a] in FLOOR_WRONG and theirs[a] not in FLOOR_WRONG for a in theirs)


class Value(Record):
    """A parameter as one model version has it."""

    estimate: float
    sd: Size
    unit: str


class Moved(Record):
    """A parameter that an added effect changed by more than its uncertainty."""

    parameter: str
    model: str
    parent: str
    change: float
    sd: Size = Field(description="Of the change")
    unit: str
    sentence: str


class CompareResult(Result, file="compare.json", stage="compare"):
    """The ladder of model versions on the same held-out trials."""

    best: str
    """The model used by default: the confirmed one with the lowest held-out error"""
    ladder: tuple[Rung, ...] = Field(min_length=1, description="Parents before children")
    parameters: dict[str, dict[str, Value]] = Field(description="By name, then by model")
    moved: tuple[Moved, ...]
