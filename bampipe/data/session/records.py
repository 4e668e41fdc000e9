"""What a checked session file says: its channels, its trials, and where they lie."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

from bampipe.data.readers.trial import Dialect
from bampipe.data.session.places import inside, is_device_path

FILE_NAME = "session.toml"


@dataclass(frozen=True)
class Clock:
    """The time column.

    Attributes:
        column: its name; "" where samples are counted instead, at the nominal rate.
        seconds: length of one tick, s.
        datetime: whether it holds dates and times, which are read as s since the first.
        form: how they are written, as of ``strptime``; "" for ISO 8601.
        nanoseconds: column of what comes on top of whole seconds, ns; "" where there is none.
    """

    column: str
    seconds: float
    datetime: bool = False
    form: str = ""
    nanoseconds: str = ""


@dataclass(frozen=True)
class Velocity:
    """A recorded velocity of one axis, for checking its position: SI value = raw * scale.

    Attributes:
        column: column of the trial files.
        unit: as the session file says.
        scale: rad/s or m/s for one raw unit.
    """

    column: str
    unit: str
    scale: float


@dataclass(frozen=True)
class Encoder:
    """Position of one axis: SI value = (raw - zero) * scale.

    Attributes:
        axis: name of the axis.
        column: column of the trial files.
        unit: "rad" or "m".
        zero: raw reading at position 0.
        scale: rad or m for one raw unit.
        counts: whether the raw readings are whole counts.
        resolution: smallest step, rad or m; None where only the data can tell.
        raw_unit: unit of the column; "counts" where it counts.
        velocity: the velocity recorded beside it, None where there is none.
        integrate: whether the column is a velocity, whose integral from 0 is the position.
    """

    axis: str
    column: str
    unit: str
    zero: float
    scale: float
    counts: bool
    resolution: float | None
    raw_unit: str = ""
    velocity: Velocity | None = None
    integrate: bool = False


@dataclass(frozen=True)
class Force:
    """Force sensor or motor force: SI value = calibration @ (raw - zero).

    Attributes:
        columns: columns of the trial files.
        names: names of the calibrated components, ``force_<component>``.
        unit: "N" or "N.m", after calibration.
        calibration: one row a component, one number a column: N (N.m) for one raw unit.
        zero: raw readings without force.
        noise_sd: standard deviation at rest, in ``unit``; None if not measured.
        volts: whether the raw readings are a sensor's voltages.
        raw_unit: unit of the columns.
    """

    columns: tuple[str, ...]
    names: tuple[str, ...]
    unit: str
    calibration: tuple[tuple[float, ...], ...]
    zero: tuple[float, ...]
    noise_sd: float | None
    volts: bool
    raw_unit: str = ""


@dataclass(frozen=True)
class Brake:
    """Commanded braking torque (N.m) or force (N) of one axis, already in SI units."""

    axis: str
    column: str
    unit: str


@dataclass(frozen=True)
class Channel:
    """Any other recorded input: SI value = scale * raw + offset, in ``unit``.

    ``raw_unit`` is the unit of the column, "" where the session file rescales it. Where
    ``wrap_bits`` is not 0 the raw readings are the unsigned register of a signed number of
    so many bits (two's complement): those in the upper half stand for negative numbers.
    """

    name: str
    column: str
    unit: str
    scale: float
    offset: float
    wrap_bits: int = 0
    raw_unit: str = ""


@dataclass(frozen=True)
class TrialEntry:
    """One ``[[trials]]`` entry.

    Attributes:
        trial_id: the file's name without its ending (with its folders where that is not unique).
        file: path relative to the session folder, as given.
        kind: "free", "locked" or "viscous".
        locked_axis: for "locked".
        viscous: commanded Cartesian damping, N.s/m, for "viscous".
        start_s, end_s: the stretch of the record that is this trial, s after its first sample;
            0 and infinity for all of it.
        hold_out: never fitted, only for judging.
    """

    trial_id: str
    file: str
    kind: str
    locked_axis: str | None
    viscous: float | None
    start_s: float = 0.0
    end_s: float = math.inf
    hold_out: bool = False

    def overlaps(self, other: TrialEntry) -> bool:
        """Whether the stretches of two trials of one record have samples in common."""
        return self.start_s < other.end_s and other.start_s < self.end_s


@dataclass(frozen=True)
class Session:
    """A checked session file.

    Attributes:
        root: the session folder.
        session_id: its name.
        device: name of a built-in device, or path of a device file relative to ``root``.
        recorded_at: ISO 8601, None if not given.
        sample_rate: nominal, Hz.
        clock: the time column.
        encoders, force, brakes, channels: what the columns mean; ``force`` may be None.
        trials: in the order of the file.
        dialect: what the file says about text files.
    """

    root: Path
    session_id: str
    device: str
    recorded_at: str | None
    sample_rate: float
    clock: Clock
    encoders: tuple[Encoder, ...]
    force: Force | None
    brakes: tuple[Brake, ...]
    channels: tuple[Channel, ...]
    trials: tuple[TrialEntry, ...]
    dialect: Dialect = field(default_factory=Dialect)

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns that every trial file must have, the time column first."""
        force = self.force.columns if self.force else ()
        parts = (self.encoders, self.brakes, self.channels)
        speeds = (e.velocity.column for e in self.encoders if e.velocity)
        clock = tuple(c for c in (self.clock.column, self.clock.nanoseconds) if c)
        return (*clock, *(c.column for part in parts for c in part), *speeds, *force)

    @property
    def raw_units(self) -> dict[str, str]:
        """Unit of each column as the session file has it, where it is no count and no voltage."""
        found = {e.column: e.raw_unit for e in self.encoders if not e.counts}
        found |= {e.velocity.column: e.velocity.unit for e in self.encoders if e.velocity}
        if self.force is not None:
            found |= dict.fromkeys(self.force.columns, self.force.raw_unit)
        found |= {c.column: c.raw_unit for c in self.channels if c.raw_unit}
        return found

    @property
    def device_file(self) -> Path | None:
        """Path of the lab's own device file, None for a built-in device.

        Raises:
            InputError: there is no such file, or it is outside the session folder.
        """
        if not is_device_path(self.device):
            return None
        return inside(self.root, self.device, where=f"{self.root / FILE_NAME}: device")
