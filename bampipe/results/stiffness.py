"""``stiffness/stiffness.json``: stiffness of the axes that were locked and loaded."""

from typing import Literal

from pydantic import Field

from bampipe.results.record import Names, Record, Result, Size
from bampipe.schema import Positive


class Bandwidth(Record):
    """sqrt(stiffness / inertia) at one pose."""

    rad_s: Positive
    hz: Positive
    inertia: Positive = Field(description="Diagonal entry of the mass matrix, kg m2 or kg")


class LoopCycle(Record):
    """One hysteresis loop."""

    trial_id: str
    duration_s: Positive
    stiffness: float
    loop_width: float
    loop_width_deflection: float
    energy: float
    amplitude: float = Field(description="Half the range of the torque")
    centre: float = Field(description="Deflection in the middle of the loop at no torque")


class LockedTrial(Record):
    """One locked trial."""

    stiffness: Positive
    standard_error: Size
    transition: float = Field(description="Torque after a reversal at which the loop is post-yield")
    slope_change: float
    """Stiffness of the first half of the post-yield part over the second, less 1"""
    drift: float = Field(description="Drift of the loops from first to last, share of their range")


class AxisStiffness(Record):
    """Stiffness of one axis over its locked trials."""

    stiffness: Positive
    sd: Size
    """Standard uncertainty: standard_error, systematic and calibration_sd together"""
    standard_error: Size
    """By the scatter over cycles or by the regression over all, whichever is larger"""
    systematic: Size
    """A quarter of the change of slope, measured or possible, over the straight part"""
    calibration_sd: Size
    """Part from the stated uncertainties of sensors, and the zeros of encoders"""
    unit: str = Field(description="Of the stiffness: N.m/rad or N/m")
    n_cycles: int = Field(ge=1)
    bandwidth_rad_s: Positive = Field(description="sqrt(stiffness / inertia) at bandwidth_pose")
    bandwidth_hz: Positive
    bandwidth_pose: str = Field(description="Key of bandwidths and poses")
    bandwidths: dict[str, Bandwidth]
    poses: dict[str, dict[str, float]] = Field(description="Coordinates of each pose, rad or m")
    loop_width: float = Field(description="Height of the loop, mean over the cycles")
    loop_width_unit: str
    loop_width_deflection: float = Field(description="The same in deflection")
    loop_width_deflection_unit: str
    energy_per_cycle: float = Field(description="Energy lost, mean over the cycles")
    energy_unit: Literal["J"]
    yielded: bool = Field(description="Whether the load overcame the friction")
    cycles: tuple[LoopCycle, ...] = Field(min_length=1)
    trials: dict[str, LockedTrial]


class GearStiffness(Record):
    """Stiffness of a gear with an encoder on either side, over the free trials."""

    stiffness: Positive | None
    """Null if the difference of the encoders does not follow the load"""
    sd: Size | None = Field(description="Standard uncertainty, by the scatter of stretches")
    unit: str = Field(description="Of the stiffness: N.m/rad or N/m")
    play: float | None
    """Gap that the gear crosses as the load changes sign, rad or m; null if it never does"""
    play_sd: Size | None
    play_unit: str
    side: Literal["motor", "load"] = Field(description="Side of the second encoder")
    late_s: float = Field(description="Delay of the second encoder's reading after the first, s")
    late_sd: Size
    explained: float
    """Share of the variance of the difference that stiffness and play explain, after timing and the
    drive's own losses"""
    channel: str = Field(description="Of the second encoder")


class StiffnessResult(Result, file="stiffness/stiffness.json", stage="stiffness"):
    """Stiffness of the axes that were locked and loaded, and of gears with two encoders."""

    headline: str
    notes: Names = Field(description="Trials without loops, slipping brakes, small loads")
    axes: dict[str, AxisStiffness]
    """One entry for each axis with a locked trial"""
    gears: dict[str, GearStiffness] = Field(default={})
    """By axis with a second encoder; see channels.second_encoder_of"""
