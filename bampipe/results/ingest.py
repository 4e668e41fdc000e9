"""``ingest/session.json``: channels and sensors of the session, in SI units."""

from typing import Literal

from pydantic import Field

from bampipe.results.record import Names, Record, Result, Size
from bampipe.schema import Positive


class EncoderChannel(Record):
    """One axis."""

    unit: Literal["rad", "m"]
    resolution: Size = Field(description="Step of the encoder in that unit, as used")
    resolution_stated: Size | None = Field(description="From session.toml, or null")
    resolution_measured: Size | None
    """Step of the readings; null without a grid"""
    noise_sd: Size = Field(description="Standard deviation of a reading, rounding included")
    scale: float = Field(default=1.0, description="rad or m for one raw unit, by session.toml")
    zero: float = Field(default=0.0, description="Raw reading at position 0, by session.toml")
    counts_per_unit: float | None = Field(default=None, description="As in session.toml, or null")
    raw_unit: str = Field(default="", description="Unit that session.toml gives the column")
    unit_in_log: bool = Field(default=False, description="Whether the log gives that unit, too")
    scale_sd: Size = Field(default=0.0, description="Standard uncertainty of scale, as a share")


class ForceChannels(Record):
    """The measured force."""

    columns: Names
    unit: str
    noise_sd: dict[str, Size] = Field(description="Standard deviation by channel, as used")
    noise_sd_stated: Size | None = Field(description="From session.toml, or null")
    noise_sd_measured: dict[str, Size | None]
    """By channel; null if too little is recorded"""
    calibration: tuple[tuple[float, ...], ...] = ()
    """One row per component: `unit` per raw unit of each column"""
    zero: tuple[float, ...] = Field(default=(), description="Raw readings without force")
    raw_unit: str = Field(default="", description="Unit of the raw columns")
    gain_sd: Size = Field(default=0.0, description="Standard uncertainty of each gain, as a share")
    crosstalk_sd: Size = 0.0
    """Standard uncertainty of the crosstalk between components, a share"""
    look_like_counts: Names = ()
    """Channels whose readings look like counts of a converter"""


class RecordedChannel(Record):
    """A brake command, or another recorded channel."""

    unit: str
    scale: float = Field(default=1.0, description="SI value = scale * raw + offset")
    offset: float = 0.0
    raw_unit: str = Field(default="", description="Unit of the column if it is not rescaled")
    scale_sd: Size = Field(default=0.0, description="Standard uncertainty of scale, as a share")
    second_encoder_of: str = ""
    """Axis whose position it reads on the other side of the gear"""


class MainsHum(Record):
    """A sine of the power supply on a channel, subtracted from the samples."""

    channel: str
    unit: str
    hz: Positive = Field(description="Nominal frequency of mains, or of a harmonic")
    amplitude: Size = Field(description="Median over the trials")
    trials: int = Field(ge=1, description="Number of trials that had it")


class DeadStretch(Record):
    """A stretch in which a sensor reads nothing, one value in motion, or the end of its range."""

    column: str
    start_s: Size = Field(description="Since the start of the trial")
    end_s: Size
    rail: float | None = Field(default=None, description="That value, at the end of the range")
    missing: bool = Field(default=False, description="Whether it has no readings there")


class IngestResult(Result, file="ingest/session.json", stage="ingest"):
    """Channels and sensors of the session, in SI units."""

    session_id: str = Field(min_length=1)
    device: str = Field(min_length=1)
    device_file: str | None = Field(description="The session's own; null for a built-in device")
    driven: bool = Field(default=False, description="Whether a motor drives the device, not a hand")
    default_effects: Names = ()
    """Effects that the device file gives the base model"""
    placeholders: Names = Field(default=(), description="Numbers whose source still says `fill in`")
    recorded_at: str | None = Field(description="ISO 8601, or null")
    operator: str = Field(default="", description="Who recorded it")
    device_serial: str = ""
    notes: str = ""
    simulated: bool = Field(default=False, description="Whether a simulator made it")
    sample_rate_hz: Positive = Field(description="Median over the trials, from their clocks")
    announced_rate_hz: Positive | None = Field(description="By session.toml, or null")
    kept_every: int = Field(default=1, ge=1, description="One sample of a log in this many is kept")
    axes: dict[str, EncoderChannel] = Field(min_length=1)
    force: ForceChannels
    sensor_warnings: Names
    """Stated noise or resolution that differs from the measured one by more than a factor of two;
    readings that look like counts"""
    mains_hum: tuple[MainsHum, ...] = ()
    brakes: dict[str, RecordedChannel]
    channels: dict[str, RecordedChannel]
    dead: dict[str, tuple[DeadStretch, ...]] = Field(default_factory=dict)
    """By trial: stretches with a dead sensor"""
