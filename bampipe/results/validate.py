"""``models/<model>/validate.json``: predicted against measured torque and force."""

from typing import Annotated, Literal

from pydantic import ConfigDict, Field

from bampipe.results.floor import FloorStatus
from bampipe.results.record import Names, Record, Result, Size
from bampipe.schema import Count, Positive


class AxisError(Record):
    """Error of the predicted generalised force of one axis."""

    rmse: Size = Field(description="Parameters as identified")
    rmse_without_friction: Size
    held_out_rmse: Size = Field(description="Each trial by the estimate without it")
    relative_error_percent: Size = Field(description="100 rmse / RMS of the measured torque")
    held_out_relative_error_percent: Size
    """100 held_out_rmse / root mean square of the measured torque"""
    fit_percent: Annotated[float, Field(le=100)] | None = Field(
        description="100 (1 - held_out_rmse / standard deviation of the measured torque); null on"
        " an undriven axis"
    )
    unit: str


class JudgedError(AxisError):
    """Error of one axis over all trials, compared with its noise floor."""

    noise_floor: Size | None
    """Error of the fitted model's own replicates with the same sensors and filters; null if none
    was computed"""
    noise_floor_sd: Size = Field(description="Scatter of one replicate")
    standing: FloorStatus


class TrialError(Record):
    """Errors of one trial, by axis beside ``held_out``."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, AxisError]

    held_out: bool = Field(description="Predicted by the estimate without it")

    @property
    def axes(self) -> dict[str, AxisError]:
        """The errors by axis."""
        return self.__pydantic_extra__


class ForceError(Record):
    """Error of one component of the handle's force."""

    rmse: Size
    unit: str


class FreeRunError(Record):
    """Position error of one axis of the freely running model."""

    mean_absolute: Size
    rmse: Size
    relative_error_percent: Size
    velocity_relative_error_percent: Size
    unit: Literal["rad", "m"]


class CommandError(Record):
    """Error of a commanded force channel."""

    relative_error_percent: Size


class Drift(Record):
    """Distance of the simulated position from the measured one, some time after a common start."""

    horizon_s: Positive = Field(description="Duration of the free run, s")
    median: Size = Field(description="Over the windows in which the axis moves")
    quantile_90: Size
    displacement: Size = Field(description="Median distance that the axis itself has moved by then")
    windows: Count = Field(description="Starts from which the axis moves within the horizon")


class AxisDrift(Record):
    """Drift of one axis under the recorded inputs alone, without controller."""

    unit: str = Field(description="rad or m")
    horizons: tuple[Drift, ...] = Field(description="Shortest first")
    reason: str = Field(default="", description="Reason why there are no longer horizons")


class FreeRun(Record):
    """The model running freely over held-out trials."""

    reason: str = Field(default="", description="Reason why there is none, or none in closed loop")
    mode: Literal["closed_loop", "open_loop"] | None = None
    axes: dict[str, FreeRunError] = Field(default={})
    trials: dict[str, dict[str, FreeRunError]] = Field(default={})
    forces: dict[str, CommandError] = Field(default={})
    """Commanded force channels, closed loop"""
    drift: dict[str, AxisDrift] = Field(default={})
    """By axis: short free runs from many starts of each trial"""


class ValidateResult(Result, file="models/{model}/validate.json", stage="validate"):
    """Predicted against measured torque and force."""

    model: str
    headline: str
    cutoff_hz: dict[str, Positive] = Field(description="Low-pass of both sides by axis, Hz")
    floor_replays: Count = Field(description="Replicates over which the noise floor is a mean")
    failed_checks: Names = Field(description="Of data, estimate and floor; empty for a sound model")
    notes: Names
    axes: dict[str, JudgedError]
    """Over all free trials and those in a viscous field, stretches at rest left out"""
    trials: dict[str, TrialError]
    forces: dict[str, ForceError]
    """Handle force by component, identified parameters"""
    free_run: FreeRun | None = None
