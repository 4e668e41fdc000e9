"""``filter/filter.json``: how the motion was differentiated, and how well."""

from typing import Literal

from pydantic import Field

from bampipe.results.record import Record, Result, Share, Size
from bampipe.schema import Positive


class ResidualBand(Record):
    """The band in which residuals of one axis are compared, by every later stage."""

    cutoff_hz: Positive = Field(description="Of the low-pass")
    reason: str
    force_hz: Size = Field(description="The applied force has 95 % of its power below this")
    motion_hz: Positive = Field(description="Bandwidth of the filtered motion")


class AxisDifferentiation(Record):
    """How one axis was differentiated; standard deviations are medians over samples and trials."""

    unit: Literal["rad", "m"]
    bandwidth_hz: Positive
    bandwidth_reason: str
    order: int | None = None
    """Order of the Kalman smoother's motion model"""
    resolution: Size
    measurement_noise_sd: Size
    log_likelihood: dict[str, float] = Field(description="By order of the motion model")
    position_sd: Size
    velocity_sd: Size
    acceleration_sd: Size
    band: ResidualBand


class ForceFilter(Record):
    """How the force was differentiated."""

    derivative_cutoff_hz: Positive


class Disturbance(Record):
    """A stretch of a trial that is left out of all estimates and errors."""

    start_s: Size = Field(description="Since the start of the trial")
    end_s: Positive
    reason: str


class FilterResult(Result, file="filter/filter.json", stage="filter"):
    """How the motion was differentiated, and how well."""

    headline: str
    method: str
    method_reason: str
    sample_rate_hz: Positive
    axes: dict[str, AxisDifferentiation] = Field(min_length=1)
    force: ForceFilter
    bridged_fraction: dict[str, Share]
    """By trial: share of its grid without samples"""
    skipped: dict[str, str] = Field(description="By trial: reason why it was skipped")
    disturbances: dict[str, tuple[Disturbance, ...]] = Field(default_factory=dict)
    """By trial: excluded stretches"""
    force_offsets: dict[str, dict[str, float]] = Field(default_factory=dict)
    """By trial and force, N, N.m or A: offset from the mean of the trials, for a sensor that was
    zeroed anew in each; it has been subtracted"""
