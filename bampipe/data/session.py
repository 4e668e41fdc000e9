"""A session: what ``session.toml`` says about the channels and the trials, checked.

Everything that can be known from the session file alone is checked here, and a mistake raises
:class:`bampipe.errors.InputError` naming file, field, what was found and what is expected. What
is wrong with one trial's file is the reader's and the quality rules' business.
"""

from __future__ import annotations

import datetime
import math
import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np

from bampipe.data import schema, store
from bampipe.data.schema import did_you_mean
from bampipe.errors import InputError

FILE_NAME = "session.toml"
LARGEST_CONDITION = 1e8
"""A calibration matrix with a larger condition number counts as singular."""

SECONDS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0}
_SI = {"rad": ("rad", 1.0), "deg": ("rad", math.pi / 180), "m": ("m", 1.0), "mm": ("m", 1e-3)}
_FORCE_SUFFIXES = ("_nm", "_v", "_n")


@dataclass(frozen=True)
class Clock:
    """The time column.

    Attributes:
        column: its name.
        seconds: length of one tick, s.
    """

    column: str
    seconds: float


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
    """

    axis: str
    column: str
    unit: str
    zero: float
    scale: float
    counts: bool
    resolution: float | None


@dataclass(frozen=True)
class Force:
    """Force sensor or motor force: SI value = calibration @ (raw - zero).

    Attributes:
        columns: columns of the trial files.
        names: names of the calibrated components, ``force_<component>``.
        unit: "N" or "N.m", after calibration.
        calibration: n by n, N (N.m) for one raw unit.
        zero: raw readings without force.
        noise_sd: standard deviation at rest, in ``unit``; None if not measured.
        volts: whether the raw readings are a sensor's voltages.
    """

    columns: tuple[str, ...]
    names: tuple[str, ...]
    unit: str
    calibration: tuple[tuple[float, ...], ...]
    zero: tuple[float, ...]
    noise_sd: float | None
    volts: bool


@dataclass(frozen=True)
class Brake:
    """Commanded braking torque (N.m) or force (N) of one axis, already in SI units."""

    axis: str
    column: str
    unit: str


@dataclass(frozen=True)
class Channel:
    """Any other recorded input: SI value = scale * raw + offset.

    Where ``wrap_bits`` is not 0 the raw readings are the unsigned register of a signed number of
    so many bits (two's complement): those in the upper half stand for negative numbers.
    """

    name: str
    column: str
    unit: str
    scale: float
    offset: float
    wrap_bits: int = 0


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
    """

    trial_id: str
    file: str
    kind: str
    locked_axis: str | None
    viscous: float | None
    start_s: float = 0.0
    end_s: float = math.inf

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

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns that every trial file must have, the time column first."""
        force = self.force.columns if self.force else ()
        parts = (self.encoders, self.brakes, self.channels)
        return (self.clock.column, *(c.column for part in parts for c in part), *force)

    @property
    def device_file(self) -> Path | None:
        """Path of the lab's own device file, None for a built-in device.

        Raises:
            InputError: there is no such file, or it is outside the session folder.
        """
        if not is_device_path(self.device):
            return None
        return inside(self.root, self.device, where=f"{self.root / FILE_NAME}: device")


def is_device_path(device: str) -> bool:
    """Whether ``device`` is the path of a device file rather than a built-in name."""
    return device.endswith(".toml") or "/" in device or "\\" in device


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
        raise InputError(
            f"no {FILE_NAME} in this folder", where=str(path), remedy="give a session folder"
        )
    return session_from(store.read_toml(file), file.parent, str(file))


def session_from(table: Mapping[str, Any], root: Path, where: str = FILE_NAME) -> Session:
    """Check the parsed session file ``table`` of the folder ``root``.

    Args:
        table: what TOML parsing gave.
        root: the session folder; only a device file is looked for in it.
        where: the file, for messages.

    Raises:
        InputError: any mistake, named by field.
    """
    table = {**table}
    if isinstance(table.get("recorded_at"), datetime.date):
        table["recorded_at"] = table["recorded_at"].isoformat()
    _refuse_non_finite(table, (), where)
    schema.validate(table, "session", where)
    recorded_at = table.get("recorded_at")
    if recorded_at is not None:
        try:
            datetime.datetime.fromisoformat(recorded_at)
        except ValueError as error:
            raise InputError(
                f'found "{recorded_at}", expected a date and time like 2026-10-03T10:12:00Z',
                where=f"{where}: recorded_at",
            ) from error
    clock = table.get("time", {"column": "time_us", "unit": "us"})
    encoders = tuple(
        _encoder(axis, entry, f"{where}: encoders.{axis}")
        for axis, entry in table["encoders"].items()
    )
    force = _force(table["force"], f"{where}: force") if "force" in table else None
    session = Session(
        root=Path(root),
        session_id=table["session_id"],
        device=table["device"],
        recorded_at=recorded_at,
        sample_rate=float(table["sample_rate_hz"]),
        clock=Clock(clock["column"], SECONDS[clock["unit"]]),
        encoders=encoders,
        force=force,
        brakes=_brakes(table.get("brakes"), encoders, f"{where}: brakes"),
        channels=_channels(table.get("channels", {}), f"{where}: channels"),
        trials=_trials(table["trials"], encoders, where),
    )
    _refuse_shared_columns(session, where)
    if is_device_path(session.device):
        lexically_inside(session.device, where=f"{where}: device")
    return session


def lexically_inside(path: str, where: str) -> None:
    """Refuse a path that by its text alone leaves the session folder.

    Raises:
        InputError: the path is absolute, has "..", a drive, a backslash or a NUL character.
    """
    remedy = "give a path relative to the session folder, with / between folders"
    if PurePosixPath(path).is_absolute() or PureWindowsPath(path).drive:
        raise InputError(f"absolute path '{path}'", where=where, remedy=remedy)
    if ".." in PurePosixPath(path).parts or ".." in PureWindowsPath(path).parts:
        raise InputError(f"path '{path}' leaves the session folder", where=where, remedy=remedy)
    if "\\" in path or not path.isprintable():
        shown = path.encode("unicode_escape").decode()
        raise InputError(f"path '{shown}' is not portable", where=where, remedy=remedy)


def inside(root: Path, path: str, where: str) -> Path:
    """The existing file ``path`` of the session folder ``root``.

    Raises:
        InputError: it is no regular file, or it leaves the folder, also by a symbolic link.
    """
    lexically_inside(path, where)
    full = Path(root) / path
    try:
        real, real_root = os.path.realpath(full), os.path.realpath(root)
        exists, regular = full.exists(), full.is_file()
    except (OSError, ValueError) as error:
        raise InputError(f"path '{path}' cannot be used", where=where) from error
    if os.path.commonpath([real, real_root]) != real_root:
        raise InputError(
            f"'{path}' is a link to a place outside the session folder",
            where=where,
            remedy="copy the file into the session folder",
        )
    if not exists:
        stem = full.stem.lower()
        near = [other for other in full.parent.glob("*") if other.stem.lower() == stem != ""]
        names = [other.relative_to(root).as_posix() for other in near if other != full]
        remedy = f"there is '{min(names)}'" if names else ""
        raise InputError(f"no such file '{path}'", where=where, remedy=remedy)
    if not regular:
        raise InputError(f"'{path}' is not a file", where=where)
    return full


def _refuse_non_finite(value: object, path: tuple[str | int, ...], where: str) -> None:
    if isinstance(value, Mapping):
        for key, item in value.items():
            _refuse_non_finite(item, (*path, key), where)
    elif isinstance(value, list):
        for number, item in enumerate(value):
            _refuse_non_finite(item, (*path, number), where)
    elif isinstance(value, float) and not math.isfinite(value):
        raise InputError(
            f"found {value}, expected a finite number", where=f"{where}: {schema.dotted(path)}"
        )
    elif isinstance(value, int) and abs(value) > 2**53:
        raise InputError(
            "found a whole number beyond 2^53", where=f"{where}: {schema.dotted(path)}"
        )
    elif isinstance(value, datetime.date | datetime.time):
        raise InputError(f"found the date or time {value}", where=f"{where}: {schema.dotted(path)}")


def _encoder(axis: str, entry: Mapping[str, Any], where: str) -> Encoder:
    unit, factor = _SI[entry["unit"]]
    if "counts_per_unit" not in entry:
        resolution = entry.get("resolution")
        return Encoder(
            axis=axis,
            column=entry["column"],
            unit=unit,
            zero=float(entry.get("zero_counts", 0.0)),
            scale=factor,
            counts=False,
            resolution=None if resolution is None else resolution * factor,
        )
    per_unit = float(entry["counts_per_unit"])
    if not 1e-6 < abs(per_unit) < 1e15:
        raise InputError(
            f"found {per_unit:g}, expected the number of counts in one {entry['unit']}, not zero",
            where=f"{where}.counts_per_unit",
            remedy="negative turns the axis round; leave the key out for a column already in units",
        )
    if "resolution" in entry:
        raise InputError(
            "given beside counts_per_unit, which sets it already", where=f"{where}.resolution"
        )
    return Encoder(
        axis=axis,
        column=entry["column"],
        unit=unit,
        zero=float(entry.get("zero_counts", 0.0)),
        scale=factor / per_unit,
        counts=True,
        resolution=factor / abs(per_unit),
    )


def _force(entry: Mapping[str, Any], where: str) -> Force:
    columns = tuple(entry["columns"])
    size = len(columns)
    components = entry.get("components", [_component(column) for column in columns])
    if len(components) != size:
        raise InputError(
            f"found {len(components)} names, expected {size}, one a column",
            where=f"{where}.components",
        )
    for component, times in Counter(components).items():
        if times > 1 or not component.isidentifier():
            raise InputError(
                f"the columns give no clear name to component '{component}'",
                where=f"{where}.columns",
                remedy='name the components: components = ["x", ...]',
            )
    volts = entry["unit"] == "V"
    for key in ("calibration_n_per_v", "zero_v"):
        if volts and key not in entry:
            raise InputError(
                f"'{key}' is missing", where=where, remedy='it is needed where unit = "V"'
            )
        if not volts and key in entry:
            raise InputError(
                f'given although unit = "{entry["unit"]}" needs no calibration',
                where=f"{where}.{key}",
                remedy='give unit = "V" or leave it out',
            )
    if volts:
        calibration, zero = _calibration(entry, size, where)
    else:
        calibration, zero = np.eye(size), [0.0] * size
    return Force(
        columns=columns,
        names=tuple(f"force_{component}" for component in components),
        unit="N" if volts else entry["unit"],
        calibration=tuple(tuple(float(v) for v in row) for row in calibration),
        zero=tuple(float(v) for v in zero),
        noise_sd=None if "noise_sd_n" not in entry else float(entry["noise_sd_n"]),
        volts=volts,
    )


def _calibration(entry: Mapping[str, Any], size: int, where: str) -> tuple[np.ndarray, list[float]]:
    rows, zero = entry["calibration_n_per_v"], entry["zero_v"]
    lengths = sorted({len(row) for row in rows})
    if len(rows) != size or lengths != [size]:
        raise InputError(
            f"found {len(rows)} rows of {' and '.join(map(str, lengths))} numbers,"
            f" expected {size} rows of {size}, for {size} columns",
            where=f"{where}.calibration_n_per_v",
        )
    if len(zero) != size:
        raise InputError(
            f"found {len(zero)}, expected {size} numbers, one a column", where=f"{where}.zero_v"
        )
    calibration = np.array(rows, dtype=float)
    condition = float(np.linalg.cond(calibration))
    if not condition < LARGEST_CONDITION:
        raise InputError(
            "the matrix is singular: some force gives no voltage",
            where=f"{where}.calibration_n_per_v",
            remedy="check for equal or zero rows",
        )
    return calibration, zero


def _component(column: str) -> str:
    """``x`` for the columns ``force_x_v``, ``force_x`` and ``x``."""
    name = column
    for suffix in _FORCE_SUFFIXES:
        if name.lower().endswith(suffix) and len(name) > len(suffix):
            name = name[: -len(suffix)]
            break
    return name.removeprefix("force_")


def _brakes(
    entry: Mapping[str, Any] | None, encoders: tuple[Encoder, ...], where: str
) -> tuple[Brake, ...]:
    if entry is None:
        return ()
    columns = entry["columns"]
    axes = {encoder.axis: encoder for encoder in encoders}
    named = [column.removeprefix("brake_") for column in columns]
    if not set(named) <= set(axes):
        unknown = next(name for name in named if name not in axes)
        if len(columns) != len(axes) or any(name in axes for name in named):
            raise InputError(
                f"column 'brake_{unknown}' names no axis{did_you_mean(unknown, axes)}",
                where=f"{where}.columns",
                remedy=f"call it brake_<axis>; the axes are {', '.join(axes)}",
            )
        named = list(axes)
    units = [unit.strip() for unit in entry["unit"].split(",")]
    if len(units) == 1:
        units *= len(columns)
    if len(units) != len(columns):
        raise InputError(
            f"found {len(units)} units, expected {len(columns)}, one a column",
            where=f"{where}.unit",
        )
    for axis, unit in zip(named, units, strict=True):
        expected = "N.m" if axes[axis].unit == "rad" else "N"
        if unit != expected:
            raise InputError(
                f'found "{unit}" for {axis}, expected "{expected}"', where=f"{where}.unit"
            )
    return tuple(Brake(*brake) for brake in zip(named, columns, units, strict=True))


def _channels(entries: Mapping[str, Any], where: str) -> tuple[Channel, ...]:
    channels = []
    for name, entry in entries.items():
        if name in ("trial_id", "t") or name.startswith(("q_", "force_", "brake_")):
            raise InputError(
                f"the name '{name}' is taken by ingest's own columns",
                where=where,
                remedy="choose another name, or use [encoders], [force] or [brakes]",
            )
        scale = float(entry.get("scale", 1.0))
        if scale == 0.0:
            raise InputError("found 0, expected another number", where=f"{where}.{name}.scale")
        if entry.get("signed", False) != ("wrap_bits" in entry):
            raise InputError(
                "signed and wrap_bits belong together",
                where=f"{where}.{name}",
                remedy="give wrap_bits = 16, signed = true for a signed register read as unsigned",
            )
        channels.append(
            Channel(
                name=name,
                column=entry["column"],
                unit=entry["unit"],
                scale=scale,
                offset=float(entry.get("offset", 0.0)),
                wrap_bits=int(entry.get("wrap_bits", 0)),
            )
        )
    return tuple(channels)


def _trials(
    entries: list[Mapping[str, Any]], encoders: tuple[Encoder, ...], where: str
) -> tuple[TrialEntry, ...]:
    axes = [encoder.axis for encoder in encoders]
    for number, entry in enumerate(entries):
        place = f"{where}: trials[{number}]"
        lexically_inside(entry["file"], where=f"{place}.file")
        kind, axis = entry["kind"], entry.get("locked_axis")
        for key, only in (("locked_axis", "locked"), ("viscous_n_s_per_m", "viscous")):
            if key in entry and kind != only:
                raise InputError(
                    f'given for a "{kind}" trial',
                    where=f"{place}.{key}",
                    remedy=f'only for "{only}"',
                )
        if axis is not None and axis not in axes:
            raise InputError(
                f"no axis '{axis}'{did_you_mean(axis, axes)}",
                where=f"{place}.locked_axis",
                remedy=f"the axes are {', '.join(axes)}",
            )
    files = [PurePosixPath(entry["file"]).as_posix() for entry in entries]
    ids = _trial_ids(files)
    trials = tuple(
        TrialEntry(
            trial_id=trial_id,
            file=file,
            kind=entry["kind"],
            locked_axis=entry.get("locked_axis"),
            viscous=None if "viscous_n_s_per_m" not in entry else float(entry["viscous_n_s_per_m"]),
            start_s=float(entry.get("start_s", 0.0)),
            end_s=float(entry.get("end_s", math.inf)),
        )
        for trial_id, file, entry in zip(ids, files, entries, strict=True)
    )
    _refuse_bad_stretches(trials, where)
    return trials


def _refuse_bad_stretches(trials: tuple[TrialEntry, ...], where: str) -> None:
    """Raise InputError for an empty stretch, or for stretches of one file that overlap.

    The same file twice without stretches is left to ingest, which uses it once and says so.
    """
    for number, trial in enumerate(trials):
        place = f"{where}: trials[{number}]"
        if not trial.start_s < trial.end_s:
            raise InputError(
                f"found {trial.end_s:g}, expected more than start_s = {trial.start_s:g}",
                where=f"{place}.end_s",
            )
        for other in trials[:number]:
            whole = (trial.start_s, trial.end_s) == (other.start_s, other.end_s) == (0.0, math.inf)
            if other.file == trial.file and other.overlaps(trial) and not whole:
                raise InputError(
                    f"overlaps trial {other.trial_id} of the same file",
                    where=place,
                    remedy="give each stretch its own start_s and end_s: held-out samples must"
                    " not be in another trial",
                )


def _trial_ids(files: list[str]) -> list[str]:
    """Distinct short names: the stem, else the whole path, else the path and a number."""
    stems = Counter(PurePosixPath(file).stem for file in set(files))
    seen: Counter[str] = Counter()
    ids = []
    for file in files:
        stem = PurePosixPath(file).stem
        name = stem if stems[stem] == 1 else file.replace("/", "_").replace(".", "_")
        seen[name] += 1
        ids.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return ids


def _refuse_shared_columns(session: Session, where: str) -> None:
    for column, times in Counter(session.columns).items():
        if times > 1:
            raise InputError(
                f"column '{column}' is used for {times} channels",
                where=where,
                remedy="each channel has its own column",
            )
