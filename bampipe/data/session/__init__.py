"""A session: what ``session.toml`` says about the channels and the trials, checked.

Everything that can be known from the session file alone is checked here, and a mistake raises
:class:`bampipe.errors.InputError` naming file, field, what was found and what is expected. What
is wrong with one trial's file is the reader's and the quality rules' business.
"""

import datetime
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, PrivateAttr, StringConstraints

from bampipe import schema
from bampipe.data.readers.trial import Dialect
from bampipe.data.refusals import refusal
from bampipe.data.session.channels import (
    SECONDS,
    Brake,
    BrakeTable,
    Channel,
    ChannelName,
    Clock,
    Encoder,
    Force,
    TimeUnit,
)
from bampipe.errors import InputError, did_you_mean
from bampipe.files import is_inside, is_normal, read_toml
from bampipe.schema import Declaration, NamedDeclaration, Positive, Several, Text, checked_by

FILE_NAME = "session.toml"


def _is_device_path(device: str) -> bool:
    """Whether ``device`` is the path of a device file rather than a built-in name."""
    return device.endswith(".toml") or "/" in device or "\\" in device


def lexically_inside(path: str, where: str) -> None:
    """Refuse a path that by its text alone leaves the session folder.

    Raises:
        InputError: the path is absolute, has "..", a drive, a backslash or a NUL character.
    """
    if not is_normal(PurePosixPath(path).as_posix()) or PureWindowsPath(path).drive:
        raise refusal("path_outside", where, path=path)


def inside(root: Path, path: str, where: str) -> Path:
    """The existing file ``path`` of the session folder ``root``.

    Raises:
        InputError: it is no regular file, or it leaves the folder, also by a symbolic link.
    """
    lexically_inside(path, where)
    full = Path(root) / path
    try:
        exists, regular = full.exists(), full.is_file()
    except (OSError, ValueError) as error:
        raise InputError(f"path '{path}' cannot be used", where=where) from error
    if exists and not is_inside(Path(root), PurePosixPath(path).as_posix()):
        raise refusal("link_outside", where, path=path)
    if not exists:
        stem = full.stem.lower()
        near = [other for other in full.parent.glob("*") if other.stem.lower() == stem != ""]
        names = [other.relative_to(root).as_posix() for other in near if other != full]
        remedy = f"there is '{min(names)}'" if names else ""
        raise InputError(f"no such file '{path}'", where=where, remedy=remedy)
    if not regular:
        raise InputError(f"'{path}' is not a file", where=where)
    return full


def _inside(path: str) -> str:
    lexically_inside(path, where="")
    return PurePosixPath(path).as_posix()


def _device(text: str) -> str:
    return _inside(text) if _is_device_path(text) else text


def _moment(value: Any) -> Any:
    if isinstance(value, datetime.date):
        return value.isoformat()
    if isinstance(value, str):
        try:
            datetime.datetime.fromisoformat(value)
        except ValueError:
            said = f'found "{value}", expected a date and time like 2026-10-03T10:12:00Z'
            raise schema.fault(said) from None
    return value


LogPath = Annotated[
    Text, AfterValidator(checked_by(_inside)), Field(description="Path in the session folder")
]


class Part(Declaration):
    """One ``[[trials.parts]]`` entry: another file of the same recording."""

    file: LogPath
    name: ChannelName
    """What its columns are called by: force:Fx is Fx of the part force"""
    join: Literal["rows", "time", "start"] = "rows"
    """rows: sample by sample; time: between its samples, by its time column, which is on the clock
    of the trial's file; start: the same, both counted from their first sample"""
    time: str = Field(default="", description="Its time column, if not called as that of the file")
    time_unit: TimeUnit | Literal[""] = ""
    """Unit of its time column, if not that of the file"""


class TrialEntry(NamedDeclaration):
    """One ``[[trials]]`` entry."""

    file: LogPath
    part: str = ""
    """Where parts have columns of the same names, a name for this file"""
    parts: Several[Part] = ()
    """Other files of the same recording, one entry each"""
    recording: Annotated[int, Field(ge=1)] | None = Field(
        default=None,
        description="Which recording, where the file holds several: each begins with the header, or"
        " where time starts again",
    )
    columns: dict[str, str] = Field(default={})
    """Where several trials stand side by side in a file: its columns, by the names that the tables
    give for the first of them"""
    units: dict[str, Text] = Field(default={})
    """Of columns that this trial has in another unit than the tables say, by their names there"""
    kind: Literal["free", "locked", "viscous"]
    """free: moved at will; locked: a brake holds one axis; viscous: in a field"""
    locked_axis: ChannelName | None = None
    """The locked axis, of a locked trial"""
    viscous: Positive | None = Field(default=None, alias="viscous_n_s_per_m")
    """Commanded Cartesian damping, N.s/m, of a viscous trial"""
    start_s: schema.NotNegative = 0.0
    """Where in the record the trial starts, s after its first sample"""
    end_s: Positive = math.inf
    """Where it ends, s after the first sample of the record; this moment excluded"""
    negated: schema.Distinct[ChannelName] = ()
    """Axes, components of the force and channels that were logged with the other sign in this
    trial"""
    hold_out: bool = Field(default=False, description="Never fitted, only for judging models")
    notes: str = Field(default="", description="Free text")

    def overlaps(self, other: "TrialEntry") -> bool:
        """Whether the stretches of two trials of one file have samples in common."""
        apart = self.recording != other.recording and None not in (self.recording, other.recording)
        apart |= self.columns != other.columns
        return not apart and self.start_s < other.end_s and other.start_s < self.end_s

    def cross_faults(self) -> Iterator[InputError]:
        for key, value, only in (
            ("locked_axis", self.locked_axis, "locked"),
            ("viscous_n_s_per_m", self.viscous, "viscous"),
        ):
            if value is None and self.kind == only:
                yield InputError(f"'{key}' is missing", remedy=f'needed for a "{only}" trial')
            if value is not None and self.kind != only:
                yield refusal("other_kind", key, kind=self.kind, only=only)
        named = Counter(part.name for part in self.parts)
        named.update([self.part] if self.part else [])
        for name, times in named.items():
            if times > 1:
                yield InputError(f"{times} parts are called '{name}'", where="parts")
        if not self.start_s < self.end_s:
            yield refusal("end", end=self.end_s, start=self.start_s)


def _with_ids(trials: tuple[TrialEntry, ...]) -> tuple[TrialEntry, ...]:
    """Give distinct names: the stem, else the whole path, else the path and a number."""
    stems = Counter(PurePosixPath(file).stem for file in {trial.file for trial in trials})
    seen: Counter[str] = Counter()
    for trial in trials:
        stem, flat = PurePosixPath(trial.file).stem, re.sub(r"[/.]", "_", trial.file)
        name = stem if stems[stem] == 1 else flat
        seen[name] += 1
        trial._name = name if seen[name] == 1 else f"{name}_{seen[name]}"
    return trials


def _no_axis(name: str, axes: Sequence[str], where: str, what: str = "") -> InputError:
    of = {"name": f"{what}axis '{name}'", "near": did_you_mean(name, axes)}
    return refusal("unknown_axis", where, **of, axes=", ".join(axes))


class Session(Declaration):
    """session.toml: one recording session, its channels and its trials."""

    schema_: Literal["bampipe.session/1"] = Field(
        alias="schema", description='the version of this format, "bampipe.session/1"'
    )
    session_id: Annotated[
        str, StringConstraints(pattern="^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)
    ] = Field(
        description="the name of the session and of its run folder, of letters, digits, '.', '_'"
        " and '-'"
    )
    device: Annotated[Text, AfterValidator(checked_by(_device))] = Field(
        description="A built-in device, or the path of a device file (.toml) in the session folder"
    )
    recorded_at: Annotated[str, BeforeValidator(_moment)] | None = Field(
        default=None, description="Date and time of the recording, ISO 8601"
    )
    sample_rate: Positive = Field(alias="sample_rate_hz")
    """Nominal sample rate; the time column rules"""
    notes: str = Field(default="", description="Free text")
    operator: str = Field(default="", description="Who recorded it")
    device_serial: str = Field(default="", description="Serial number of the device")
    simulated: bool = False
    """Whether a simulator made it; the report then says so"""
    clock: Clock = Field(default=Clock(column="time_us", unit="us"), alias="time")
    """The time column, where it is not time_us in microseconds"""
    dialect: Dialect = Field(default=Dialect(), alias="csv")
    """Layout of text files, where it cannot be found in them"""
    encoders: Annotated[tuple[Encoder, ...], schema.ByName(ChannelName, least=1)] = Field(
        description="One entry an axis"
    )
    force: Force | None = Field(default=None, description="Force sensor, or force of the motors")
    brake_table: BrakeTable | None = Field(default=None, alias="brakes")
    """Commanded braking"""
    channels: Annotated[tuple[Channel, ...], schema.ByName(ChannelName)] = Field(
        default=(), description="Any other recorded input"
    )
    trials: Annotated[Several[TrialEntry], Field(min_length=1), AfterValidator(_with_ids)] = Field(
        description="One entry a trial"
    )
    _root: Path = PrivateAttr(Path())

    @property
    def root(self) -> Path:
        """The session folder."""
        return self._root

    @cached_property
    def brakes(self) -> tuple[Brake, ...]:
        """Which column brakes which axis."""
        return self.brake_table.brakes(self.encoders) if self.brake_table else ()

    @property
    def tick(self) -> float:
        """Length of one unit of the time column, s; of one sample where samples are counted."""
        if self.clock.unit == "samples":
            return 1.0 / self.sample_rate
        if self.clock.ticks_per_s is not None:
            return 1.0 / self.clock.ticks_per_s
        return SECONDS.get(self.clock.unit, 1.0)

    @cached_property
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
        return found | ({self.clock.column: self.clock.unit} if self.clock.unit in SECONDS else {})

    @property
    def device_file(self) -> Path | None:
        """Path of the lab's own device file, None for a built-in device.

        Raises:
            InputError: there is no such file, or it is outside the session folder.
        """
        if not _is_device_path(self.device):
            return None
        return inside(self.root, self.device, where=f"{self.root / FILE_NAME}: device")

    def cross_faults(self) -> Iterator[InputError]:
        for channel in self.channels:
            name = channel.name
            if name in ("trial_id", "t") or name.startswith(("q_", "force_", "brake_")):
                yield refusal("name_taken", name=name)
        try:
            columns = self.columns
        except InputError as error:
            yield error
            columns = ()
        axes = [encoder.name for encoder in self.encoders]
        for encoder in self.encoders:
            for other in encoder.also_reads:
                if other not in axes or other == encoder.name:
                    yield _no_axis(other, axes, f"encoders.{encoder.name}.also_reads", "other ")
        units = {encoder.name: encoder.unit for encoder in self.encoders}
        for channel in self.channels:
            axis = channel.second_encoder_of
            if axis and axis not in axes:
                yield _no_axis(axis, axes, f"channels.{channel.name}.second_encoder_of")
            elif axis and channel.unit != units[axis]:
                found, place = channel.unit or "a pure number", f"channels.{channel.name}.unit"
                yield refusal(
                    "second_encoder_unit", place, unit=found, expected=units[axis], axis=axis
                )
        for column, times in Counter(columns).items():
            if times > 1:
                yield refusal("column_twice", column=column, times=times)
        yield from self._faults_of_trials()

    def _faults_of_trials(self) -> Iterator[InputError]:
        axes = [encoder.name for encoder in self.encoders]
        for number, trial in enumerate(self.trials):
            place = f"trials[{number}]"
            if trial.locked_axis is not None and trial.locked_axis not in axes:
                yield _no_axis(trial.locked_axis, axes, f"{place}.locked_axis")
            for other in self.trials[:number]:
                # The same file twice without stretches is left to ingest, which uses it once.
                stretches = {(t.start_s, t.end_s) for t in (trial, other)}
                twice = stretches == {(0.0, math.inf)}
                if other.file == trial.file and other.overlaps(trial) and not twice:
                    yield refusal("overlap", place, other=other.name)
        free = [trial for trial in self.trials if trial.kind == "free"]
        if any(trial.hold_out for trial in self.trials) and all(t.hold_out for t in free):
            yield refusal("all_held_out")


def read_session(path: Path) -> Session:
    """Read and check the session in the folder ``path`` (or the session file ``path`` itself).

    Raises:
        InputError: no such session, or any mistake in its session file.
    """
    path = Path(path)
    file = path if path.is_file() else path / FILE_NAME
    if not path.exists():
        raise InputError("no such session folder", where=str(path))
    if not file.is_file():
        raise refusal("no_session", str(path), name=FILE_NAME)
    return session_from(read_toml(file), file.parent, str(file))


def session_from(table: Mapping[str, Any], root: Path, where: str = FILE_NAME) -> Session:
    """Check the parsed session file ``table`` of the folder ``root``, where a device file may be.

    Raises:
        InputError: any mistake, named by field.
    """
    session = schema.read(Session, table, where)
    session._root = Path(root)
    return session
