"""The tables of a session file that say what the columns mean."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from bampipe.data import units
from bampipe.data.session.records import Brake, Channel, Clock, Encoder, Force, Velocity
from bampipe.errors import InputError, did_you_mean

LARGEST_CONDITION = 1e8
"""A calibration matrix with a larger condition number counts as singular."""

SECONDS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0}
_FORCE_SUFFIXES = ("_nm", "_v", "_n")


def clock_from(entry: Mapping[str, Any] | None, rate: float, where: str) -> Clock:
    """The time column; without a table it is ``time_us``.

    Args:
        entry: the table ``[time]``, None where there is none.
        rate: nominal sample rate, Hz, of samples that are counted.
        where: file and table, for messages.

    Raises:
        InputError: a column is missing, or a key makes no sense beside the unit.
    """
    if entry is None:
        return Clock("time_us", SECONDS["us"])
    kind = entry["unit"]
    if kind == "samples":
        if "column" in entry:
            raise InputError(
                'given although unit = "samples" counts them',
                where=f"{where}.column",
                remedy="leave it out",
            )
        return Clock("", 1.0 / rate)
    if "column" not in entry:
        raise InputError(
            "'column' is missing",
            where=where,
            remedy='name the time column, or say unit = "samples" where there is none',
        )
    if "format" in entry and kind != "datetime":
        raise InputError('only for unit = "datetime"', where=f"{where}.format")
    if "nanoseconds" in entry and kind != "s":
        raise InputError('only for unit = "s"', where=f"{where}.nanoseconds")
    moments = kind == "datetime"
    return Clock(
        entry["column"],
        1.0 if moments else SECONDS[kind],
        moments,
        str(entry.get("format", "")),
        str(entry.get("nanoseconds", "")),
    )


def encoder_from(axis: str, entry: Mapping[str, Any], where: str) -> Encoder:
    """One entry of ``[encoders]``; a column in a unit of velocity is to be integrated.

    Raises:
        InputError: a count that makes no sense, or a velocity of another kind.
    """
    raw = units.unit(entry["unit"])
    assert raw is not None  # by the schema
    factor = raw.scale
    if raw.si in ("rad/s", "m/s"):
        for key in ("counts_per_unit", "zero_counts", "resolution", "velocity"):
            if key in entry:
                raise InputError(
                    f'given although unit = "{entry["unit"]}" makes the column a velocity',
                    where=f"{where}.{key}",
                    remedy="leave it out, or give the column of the position",
                )
        return Encoder(
            axis=axis, column=entry["column"], unit=raw.si.removesuffix("/s"), zero=0.0,
            scale=factor, counts=False, resolution=None, raw_unit=entry["unit"], integrate=True,
        )  # fmt: skip
    velocity = _velocity(entry.get("velocity"), raw.si, f"{where}.velocity")
    if "counts_per_unit" not in entry:
        resolution = entry.get("resolution")
        return Encoder(
            axis=axis,
            column=entry["column"],
            unit=raw.si,
            zero=float(entry.get("zero_counts", 0.0)),
            scale=factor,
            counts=False,
            resolution=None if resolution is None else resolution * factor,
            raw_unit=entry["unit"],
            velocity=velocity,
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
        unit=raw.si,
        zero=float(entry.get("zero_counts", 0.0)),
        scale=factor / per_unit,
        counts=True,
        resolution=factor / abs(per_unit),
        raw_unit="counts",
        velocity=velocity,
    )


def _velocity(entry: Mapping[str, Any] | None, position: str, where: str) -> Velocity | None:
    if entry is None:
        return None
    raw = units.unit(entry["unit"])
    if raw is None or raw.si != f"{position}/s":
        raise InputError(
            f'found "{entry["unit"]}", expected a unit of velocity such as "{position}/s"',
            where=f"{where}.unit",
        )
    return Velocity(entry["column"], entry["unit"], raw.scale)


def force_from(entry: Mapping[str, Any], where: str) -> Force:
    """The table ``[force]``.

    Raises:
        InputError: names that are not clear, or a calibration that does not fit the columns.
    """
    columns = tuple(entry["columns"])
    volts = entry["unit"] == "V"
    components = entry.get("components", [_component(column) for column in columns])
    if len(components) != len(columns) and not (volts and len(components) < len(columns)):
        raise InputError(
            f"found {len(components)} names, expected {len(columns)}, one a column",
            where=f"{where}.components",
            remedy=None if volts else 'several columns make one component only where unit = "V"',
        )
    for component, times in Counter(components).items():
        if times > 1 or not component.isidentifier():
            raise InputError(
                f"the columns give no clear name to component '{component}'",
                where=f"{where}.columns",
                remedy='name the components: components = ["x", ...]',
            )
    raw = units.unit(entry["unit"])
    assert raw is not None  # by the schema
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
        calibration, zero = _calibration(entry, len(components), len(columns), where)
    else:
        calibration, zero = raw.scale * np.eye(len(columns)), [0.0] * len(columns)
    return Force(
        columns=columns,
        names=tuple(f"force_{component}" for component in components),
        unit="N" if volts else raw.si,
        calibration=tuple(tuple(float(v) for v in row) for row in calibration),
        zero=tuple(float(v) for v in zero),
        noise_sd=None if "noise_sd_n" not in entry else float(entry["noise_sd_n"]),
        volts=volts,
        raw_unit=entry["unit"],
    )


def _calibration(
    entry: Mapping[str, Any], components: int, columns: int, where: str
) -> tuple[np.ndarray, list[float]]:
    """Matrix, one row a component and one column a raw column, and zero readings."""
    rows, zero = entry["calibration_n_per_v"], entry["zero_v"]
    lengths = sorted({len(row) for row in rows})
    if len(rows) != components or lengths != [columns]:
        raise InputError(
            f"found {len(rows)} rows of {' and '.join(map(str, lengths))} numbers,"
            f" expected {components} rows of {columns}, for {columns} columns",
            where=f"{where}.calibration_n_per_v",
        )
    if len(zero) != columns:
        raise InputError(
            f"found {len(zero)}, expected {columns} numbers, one a column", where=f"{where}.zero_v"
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


def brakes_from(
    entry: Mapping[str, Any] | None, encoders: tuple[Encoder, ...], where: str
) -> tuple[Brake, ...]:
    """The table ``[brakes]``.

    Raises:
        InputError: a column that names no axis, or a unit that does not fit one.
    """
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
    stated = [unit.strip() for unit in entry["unit"].split(",")]
    if len(stated) == 1:
        stated *= len(columns)
    if len(stated) != len(columns):
        raise InputError(
            f"found {len(stated)} units, expected {len(columns)}, one a column",
            where=f"{where}.unit",
        )
    for axis, unit in zip(named, stated, strict=True):
        expected = "N.m" if axes[axis].unit == "rad" else "N"
        if unit != expected:
            raise InputError(
                f'found "{unit}" for {axis}, expected "{expected}"', where=f"{where}.unit"
            )
    return tuple(Brake(*brake) for brake in zip(named, columns, stated, strict=True))


def channels_from(entries: Mapping[str, Any], where: str) -> tuple[Channel, ...]:
    """The table ``[channels]``; a unit with a prefix or the like becomes SI by its scale.

    Raises:
        InputError: a name that is taken, or a scale of zero.
    """
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
        raw = units.unit(entry["unit"]) or units.Unit(entry["unit"])
        rescaled = not {"scale", "offset", "wrap_bits"}.isdisjoint(entry)
        channels.append(
            Channel(
                name=name,
                column=entry["column"],
                unit=raw.si,
                scale=scale * raw.scale,
                offset=float(entry.get("offset", 0.0)) * raw.scale + raw.offset,
                wrap_bits=int(entry.get("wrap_bits", 0)),
                raw_unit="" if rescaled else entry["unit"],
            )
        )
    return tuple(channels)
