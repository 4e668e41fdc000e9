"""The tables of a session file that say what the columns mean, and what follows in SI units."""

import json
import re
from collections import Counter
from collections.abc import Iterator
from functools import cached_property
from typing import Annotated, Literal, NamedTuple, get_args

import numpy as np
from pydantic import AfterValidator, Field

from bampipe import schema
from bampipe.data import units
from bampipe.data.refusals import refusal
from bampipe.errors import InputError, did_you_mean
from bampipe.schema import Declaration, Distinct, NamedDeclaration, Number, Several, fault

LARGEST_CONDITION = 1e8
"""A calibration matrix with a larger condition number counts as singular."""

TimeUnit = Literal["ns", "us", "ms", "s", "min", "h", "days", "datetime"]
CLOCK_UNITS: tuple[TimeUnit, ...] = get_args(TimeUnit)
SECONDS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "days": 86_400.0}


def _name(text: str) -> str:
    if re.fullmatch("[A-Za-z][A-Za-z0-9_]{0,59}", text) is None:
        raise fault(f"found {json.dumps(text)}, expected letters, digits and '_', a letter first")
    return text


ChannelName = Annotated[
    str, AfterValidator(_name), Field(json_schema_extra={"pattern": "^[A-Za-z][A-Za-z0-9_]*$"})
]


def _filled_in(column: str) -> str:
    if column == "?":
        raise fault(
            'found "?", which `bampipe init` leaves for what it could not tell',
            remedy="fill in the name of the column; every input of the device has to be logged",
        )
    return column


Column = Annotated[
    schema.Text,
    AfterValidator(_filled_in),
    Field(description="A column (or variable) of the trial files"),
]
Uncertainty = Annotated[float, Field(ge=0, lt=1)]
SignBit = Annotated[
    int | None,
    Field(
        ge=1,
        le=62,
        description="The column is a register whose bit of this number, from 0, stands for minus"
        " and whose lower bits are the magnitude, such as 15",
    ),
]
Columns = Annotated[Distinct[Column], Field(min_length=1, description="Columns of the trial files")]


def _unit(text: str) -> units.RecordedUnit:
    """A unit that its declaration allows only where it is known."""
    found = units.unit(text)
    assert found is not None
    return found


def _unit_of(*si: str) -> AfterValidator:
    """Of a field that holds a unit of one of the SI units ``si``; of volts, V alone."""

    def checked(text: str) -> str:
        found = units.unit(text)
        if found is None or found.si not in si or (found.si == "V" and text != "V"):
            listed = f"{', '.join(si[:-1])} or {si[-1]}"
            raise fault(f'found "{text}", expected a unit of {listed}{did_you_mean(text, si)}')
        return text

    return AfterValidator(checked)


class Clock(Declaration):
    """The time column."""

    column: str = Field(default="", description="Its name; left out where samples are counted")
    unit: Literal[TimeUnit, "samples", "ticks"]
    """datetime: dates and times; samples: no column, one sample each 1/sample_rate_hz; ticks: of a
    counter, see ticks_per_s"""
    ticks_per_s: schema.Positive | None = Field(
        default=None, description='Rate of the counter, 1/s, where unit = "ticks"'
    )
    format: str = ""
    """How dates and times are written, in the codes of strptime; ISO 8601, or the time of day,
    where left out"""
    nanoseconds: str = ""
    """A second column of nanoseconds on top of whole seconds, as in ROS stamps"""
    fraction_unit: Literal["ns", "us", "ms"] = "ns"
    """Of that column, if it counts otherwise"""

    def cross_faults(self) -> Iterator[InputError]:
        if self.unit == "samples" and self.column:
            yield refusal("clock_counts")
        if self.unit != "samples" and not self.column:
            yield refusal("clock_lacks")
        if self.format and self.unit != "datetime":
            yield InputError('only for unit = "datetime"', where="format")
        if (self.unit == "ticks") != (self.ticks_per_s is not None):
            yield refusal("clock_ticks")
        if self.nanoseconds and self.unit not in ("s", "datetime"):
            yield InputError('only for unit = "s" or "datetime"', where="nanoseconds")


class Velocity(Declaration):
    """A recorded velocity of one axis, for checking its position: SI value = raw * scale."""

    column: Column
    unit: str = Field(description="A unit of velocity, such as rad/s or mm/s")

    @property
    def scale(self) -> float:
        """rad/s or m/s for one raw unit."""
        return _unit(self.unit).scale


class Encoder(NamedDeclaration):
    """Position of one axis: (counts - zero_counts) / counts_per_unit, or as it stands."""

    column: Column
    counts_per_unit: Number | None = None
    """Counts in one unit, negative to turn the axis round"""
    gear_ratio: Number = 1.0
    """Of a position on the side of the motor: what it travels for one of the axis, negative where
    it turns the other way round"""
    zero: Number = Field(default=0.0, alias="zero_counts", description="Raw reading at position 0")
    stated_unit: Annotated[str, _unit_of("rad", "m", "rad/s", "m/s")] = Field(
        alias="unit",
        description="Such as deg, mm or 0.088deg; a unit of velocity where no position was"
        " recorded: it is integrated",
    )
    scale_sd: Uncertainty = 0.0
    """Standard uncertainty of its scale, as a share: 0.001 for 0.1 %"""
    velocity: Velocity | None = None
    """A velocity recorded beside it: checks unit and sign of the position"""
    stated_resolution: schema.Positive | None = Field(default=None, alias="resolution")
    """Smallest step of a column that is not in counts, in its unit"""
    sign_bit: SignBit = None
    also_reads: dict[ChannelName, Number] = Field(default={})
    """Of an encoder on a motor that several joints turn: what it reads of other axes beside its
    own, units of it for one of theirs"""

    @property
    def unit(self) -> Literal["rad", "m"]:
        """Unit of the position."""
        return "rad" if _unit(self.stated_unit).si.startswith("rad") else "m"

    @property
    def integrate(self) -> bool:
        """Whether the column is a velocity, whose integral from 0 is the position."""
        return _unit(self.stated_unit).si.endswith("/s")

    @property
    def counts(self) -> bool:
        """Whether the raw readings are whole counts."""
        return self.counts_per_unit is not None

    @property
    def scale(self) -> float:
        """rad or m for one raw unit: SI value = (raw - zero) * scale."""
        return self.raw_scale / self.gear_ratio

    @property
    def raw_scale(self) -> float:
        """rad or m, where the encoder sits, for one raw unit."""
        return _unit(self.stated_unit).scale / (self.counts_per_unit or 1.0)

    @property
    def resolution(self) -> float | None:
        """Smallest step, rad or m; None if only the data can tell."""
        if self.counts:
            return abs(self.scale)
        return None if self.stated_resolution is None else abs(self.stated_resolution * self.scale)

    @property
    def raw_unit(self) -> str:
        """Unit of the column; "counts" where it counts."""
        return "counts" if self.counts else self.stated_unit

    def cross_faults(self) -> Iterator[InputError]:
        unit = self.stated_unit
        if self.gear_ratio == 0.0:
            yield InputError("found 0, expected the turns of the motor", where="gear_ratio")
        if self.integrate:
            for key in ("counts_per_unit", "zero_counts", "resolution", "velocity"):
                field = {"zero_counts": "zero", "resolution": "stated_resolution"}.get(key, key)
                if field in self.model_fields_set:
                    yield refusal("beside_velocity", key, unit=unit)
            return
        if self.velocity is not None:
            found = units.unit(self.velocity.unit)
            if found is None or found.si != f"{self.unit}/s":
                yield refusal("velocity_unit", found=self.velocity.unit, unit=self.unit)
        if self.counts_per_unit is None:
            return
        if not 1e-6 < abs(self.counts_per_unit) < 1e15:
            yield refusal("counts", found=self.counts_per_unit, unit=unit)
        if self.stated_resolution is not None:
            yield InputError("given beside counts_per_unit, which sets it", where="resolution")


class Force(Declaration):
    """Force sensor or motor force; unit V: calibration_n_per_v @ (volts - zero_v)."""

    columns: Columns
    given_components: Annotated[Distinct[ChannelName], Field(min_length=1)] | None = Field(
        default=None,
        alias="components",
        description="Names of the components, where the columns are not called"
        " force_<component>; fewer than columns where the calibration joins several, one row a"
        " component",
    )
    raw_unit: Annotated[str, _unit_of("N", "N.m", "V")] = Field(
        alias="unit", description="Of the columns, such as kN or mN.m; only V needs a calibration"
    )
    lever: schema.NotNegative | None = Field(default=None, alias="lever_m")
    """Distance from the axis at which a force acts, m: makes a torque in N.m of it"""
    reaction: bool = False
    """The sensor shows what the machine exerts, as one at the foot of a motor or a brake does: its
    sign is turned"""
    frame: str = Field(default="", description="In which the components are given: free text")
    calibration_n_per_v: (
        Annotated[Several[Annotated[Several[Number], Field(min_length=1)]], Field(min_length=1)]
        | None
    ) = Field(default=None, description="One row a component, one number a column")
    zero_v: Several[Number] | None = None
    """Reading of each column without load"""
    gain_sd: Uncertainty = 0.0
    """Standard uncertainty of each component's gain, as a share: 0.01 for 1 %"""
    crosstalk_sd: Uncertainty = 0.0
    """Standard uncertainty of how much of another component each one shows, as a share"""
    noise_sd: schema.NotNegative | None = Field(default=None, alias="noise_sd_n")
    """Standard deviation at rest, after calibration"""

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the components, as given or as the columns say."""
        # x for the columns force_x_v, force_x and x.
        bare = (re.sub(r"(?i)(?<=.)_(nm|v|n)\Z", "", column) for column in self.columns)
        return self.given_components or tuple(name.removeprefix("force_") for name in bare)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the calibrated components, ``force_<component>``."""
        return tuple(f"force_{component}" for component in self.components)

    @property
    def volts(self) -> bool:
        """Whether the raw readings are a sensor's voltages."""
        return self.raw_unit == "V"

    @property
    def unit(self) -> str:
        """Unit after calibration and lever, "N" or "N.m"."""
        return "N.m" if self.lever is not None else self._calibrated_unit

    @property
    def _calibrated_unit(self) -> str:
        return "N" if self.volts else _unit(self.raw_unit).si

    @cached_property
    def calibration(self) -> tuple[tuple[float, ...], ...]:
        """One row a component, one number a column: ``unit`` for one raw unit."""
        matrix = _unit(self.raw_unit).scale * np.eye(len(self.columns))
        if self.calibration_n_per_v is not None:
            matrix = np.array(self.calibration_n_per_v)
        lever = (1.0 if self.lever is None else self.lever) * (-1.0 if self.reaction else 1.0)
        return tuple(tuple(float(v) for v in row) for row in lever * matrix)

    @property
    def zero(self) -> tuple[float, ...]:
        """Raw readings without force: SI value = calibration @ (raw - zero)."""
        return self.zero_v or (0.0,) * len(self.columns)

    def cross_faults(self) -> Iterator[InputError]:
        components, columns = self.components, len(self.columns)
        if len(components) != columns and not (self.volts and len(components) < columns):
            name = "components" if self.volts else "components_joined"
            yield refusal(name, found=len(components), columns=columns)
        for component, times in Counter(components).items():
            if times > 1 or not component.isidentifier():
                yield refusal("component_name", component=component)
        if self.lever is not None and self._calibrated_unit != "N":
            yield InputError(f'unit = "{self.raw_unit}" is a torque already', where="lever_m")
        if self.lever == 0.0:
            yield refusal("no_lever")
        for key in ("calibration_n_per_v", "zero_v"):
            given = getattr(self, key) is not None
            if self.volts and not given:
                yield InputError(f"'{key}' is missing", remedy='it is needed where unit = "V"')
            if not self.volts and given:
                yield refusal("no_calibration", key, unit=self.raw_unit)
        if self.volts and self.zero_v is not None and len(self.zero_v) != columns:
            yield refusal("zeros", found=len(self.zero_v), columns=columns)
        if self.volts and self.calibration_n_per_v is not None:
            rows = self.calibration_n_per_v
            lengths = sorted({len(row) for row in rows})
            if len(rows) != len(components) or lengths != [columns]:
                found = f"{len(rows)} rows of {' and '.join(map(str, lengths))} numbers"
                expected = f"{len(components)} rows of {columns}"
                yield refusal("calibration_rows", found=found, expected=expected, columns=columns)
            elif not np.linalg.cond(np.array(rows)) < LARGEST_CONDITION:
                yield refusal("singular")


class Brake(NamedTuple):
    """Commanded braking torque (N.m) or force (N) of one axis, already in SI units."""

    axis: str
    column: str
    unit: str


class BrakeTable(Declaration):
    """Commanded braking torque or force, one column a braked axis."""

    columns: Columns
    unit: str = Field(description="One unit an axis, N.m or N, separated by commas")

    def brakes(self, encoders: tuple[Encoder, ...]) -> tuple[Brake, ...]:
        """Which column brakes which axis.

        Raises:
            InputError: a column that names no axis, or a unit that does not fit one.
        """
        axes = {encoder.name: encoder for encoder in encoders}
        named = [column.removeprefix("brake_") for column in self.columns]
        if not set(named) <= set(axes):
            unknown = next(name for name in named if name not in axes)
            if len(self.columns) != len(axes) or any(name in axes for name in named):
                near = did_you_mean(unknown, axes)
                raise refusal("brake_axis", name=unknown, near=near, axes=", ".join(axes))
            named = list(axes)
        stated = [unit.strip() for unit in self.unit.split(",")]
        if len(stated) == 1:
            stated *= len(self.columns)
        if len(stated) != len(self.columns):
            raise refusal("brake_units", found=len(stated), columns=len(self.columns))
        for axis, unit in zip(named, stated, strict=True):
            expected = "N.m" if axes[axis].unit == "rad" else "N"
            if unit != expected:
                raise refusal("brake_unit", axis=axis, found=unit, expected=expected)
        return tuple(map(Brake, named, self.columns, stated))


class Register(NamedTuple):
    """How an unsigned register holds signed numbers.

    Attributes:
        bits: of its width, of two's complement; 0 where it has a sign bit.
        sign_bit: number of the bit that stands for minus, the lower ones being the magnitude.
    """

    bits: int = 0
    sign_bit: int = 0

    @property
    def fields(self) -> str:
        """What the session file says of it, after a comma."""
        if self.bits:
            return f", wrap_bits = {self.bits}"
        return f", sign_bit = {self.sign_bit}"

    @property
    def words(self) -> str:
        if self.bits:
            return f"a signed register of {self.bits} bits"
        return f"sign and magnitude: bit {self.sign_bit} stands for minus"

    @property
    def period(self) -> float:
        """Number of its readings, 0 to one less."""
        return 2.0 ** (self.bits or self.sign_bit + 1)

    def signed(self, values: np.ndarray) -> np.ndarray:
        """What readings (T,) stand for."""
        half = 0.5 * self.period
        negative = values - self.period if self.bits else half - values
        return np.where(values >= half, negative, values)


class Channel(NamedDeclaration):
    """Any other recorded input: scale * raw + offset, in the unit given, which becomes SI."""

    column: Column
    stated_unit: str = Field(alias="unit", description="Of the scaled value; results are in SI")
    stated_scale: Number = Field(default=1.0, alias="scale")
    """What a raw reading is multiplied by"""
    stated_offset: Number = Field(default=0.0, alias="offset")
    """What is then added, in the unit"""
    scale_sd: Uncertainty = 0.0
    """Standard uncertainty of its scale, as a share: 0.01 for 1 %"""
    wrap_bits: Literal[8, 16, 24, 32] | None = None
    """The column is a register of so many bits, whose upper half stands for negative numbers
    (two's complement)"""
    sign_bit: SignBit = None
    second_encoder_of: str = ""
    """Axis of which it reads the position on the other side of the gear, in the axis' unit: how far
    both move apart shows the gear's stiffness and play"""

    @property
    def _raw(self) -> units.RecordedUnit:
        return units.unit(self.stated_unit) or units.RecordedUnit(self.stated_unit)

    @property
    def unit(self) -> str:
        """SI unit of the value."""
        return self._raw.si

    @property
    def scale(self) -> float:
        """SI value = scale * raw + offset."""
        return self.stated_scale * self._raw.scale

    @property
    def offset(self) -> float:
        """SI value where the raw reading is 0."""
        return self.stated_offset * self._raw.scale + self._raw.offset

    @property
    def raw_unit(self) -> str:
        """Unit of the column, "" if the session file rescales it."""
        changing = {"stated_scale", "stated_offset", "wrap_bits", "sign_bit"}
        return "" if changing & self.model_fields_set else self.stated_unit

    def cross_faults(self) -> Iterator[InputError]:
        if self.stated_scale == 0.0:
            yield InputError("found 0, expected another number", where="scale")
        if self.sign_bit is not None and self.wrap_bits is not None:
            yield refusal("two_signs")
