"""Requests to readers and their results, and the checks that all readers share."""

import gzip
import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import BinaryIO, Literal, cast

import numpy as np
from pydantic import Field

from bampipe.data.refusals import refusal
from bampipe.errors import InputError, did_you_mean
from bampipe.schema import Declaration, Distinct, Text

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
"""Pattern of a number with a decimal point."""
LARGEST_BYTES = 4 << 30
"""A trial larger than this in memory is refused unless the caller allows more."""


class Dialect(Declaration):
    """Statements of a session about its text files; the rest is found in the file."""

    delimiter: Literal["", ",", ";", "\t", "|", " "] = ""
    """Separator of columns; a blank stands for any number of them"""
    decimal: Literal["", ".", ","] = Field(default="", description="Decimal sign")
    encoding: Literal["", "utf-8", "utf-16", "latin-1", "cp1252"] = ""
    """Of the characters"""
    names: Distinct[Text] = ()
    """Names of the columns, for files without a header"""
    missing: Distinct[Text] = Field(
        default=(), description='Text of a cell without a reading, such as "ovf"'
    )


@dataclass(frozen=True)
class Wanted:
    """Request to a reader.

    Attributes:
        columns: their names; datetimes: ``strptime`` format of each that holds dates and times, ""
            for ISO 8601: they are returned as s since the first.
        dialect: of text files; largest_bytes: that a trial may take in memory.
    """

    columns: tuple[str, ...]
    datetimes: Mapping[str, str] = field(default_factory=dict)
    dialect: Dialect = field(default_factory=Dialect)
    largest_bytes: int = LARGEST_BYTES


@dataclass(frozen=True)
class RawTrial:
    """The samples of one trial as they stand in its file.

    Attributes:
        columns: (T,) float64 a column, NaN where a cell is empty.
        rows: (T,) int64, the row or number of each sample in the file, for messages.
        notes: what was left out, one sentence each.
        remarks: what was found out about the file, one sentence each.
        units: units that the file itself gives to its columns.
        begun: samples at which another recording begins: the header stands again, or an episode.
        since: of columns of dates and times, where known, their first moment, ns since 1970.
    """

    columns: dict[str, np.ndarray]
    rows: np.ndarray
    notes: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    begun: tuple[int, ...] = ()
    since: Mapping[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.rows)

    def between(self, start: int, stop: int) -> "RawTrial":
        """The samples from ``start`` to before ``stop``."""
        return replace(
            self,
            columns={name: values[start:stop] for name, values in self.columns.items()},
            rows=self.rows[start:stop],
            begun=tuple(at - start for at in self.begun if start < at < stop),
        )


def check_size(rows: int, wanted: Wanted) -> None:
    """Raise InputError where ``rows`` samples of the wanted columns take too much memory."""
    if rows * len(wanted.columns) * 8 > wanted.largest_bytes:
        most = wanted.largest_bytes >> 20
        raise refusal("too_large", rows=rows, columns=len(wanted.columns), most=most)


def check_columns(found: Sequence[str], wanted: Sequence[str], where: str = "") -> None:
    """Raise InputError where a wanted column is missing or stands twice."""
    for column in wanted:
        if column not in found:
            shown = ", ".join(found[:12]) + (", ..." if len(found) > 12 else "")
            near = did_you_mean(column, [other for other in found if other not in wanted])
            remedy = f"it has {shown}" if shown else ""
            raise InputError(f"no column '{column}'{near}", where=where, remedy=remedy)
        if list(found).count(column) > 1:
            first, second = [n for n, other in enumerate(found, 1) if other == column][:2]
            raise refusal("stands_twice", where, column=column, first=first, second=second)


def aligned(values: dict[str, np.ndarray], what: str) -> dict[str, np.ndarray]:
    """The columns (T,), all of one length; a single number (1,) is a column that does not change.

    Raises:
        InputError: a column, which the file calls a ``what``, is of another length.
    """
    first = max(values, key=lambda column: len(values[column]) > 1, default="")
    count = len(values[first]) if values else 0
    for column, value in values.items():
        if len(value) not in (1, count):
            of = {"here": len(value), "first": first, "there": count}
            raise refusal("other_length", f"{what} '{column}'", **of)
    return {c: np.repeat(v, count) if len(v) == 1 < count else v for c, v in values.items()}


def interpolated(at: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (T,) at ``at`` (N,), NaN before the first time (T,) and after the last.

    Missing values are bridged; times need not be in order.
    """
    known = np.flatnonzero(np.isfinite(times) & np.isfinite(values))
    if len(known) == 0:
        return np.full(len(at), np.nan)
    order = known[np.argsort(times[known], kind="stable")]
    return np.asarray(np.interp(at, times[order], values[order], left=np.nan, right=np.nan))


def opened(path: Path) -> BinaryIO:
    """The file, unpacked if it is under gzip."""
    return cast(BinaryIO, gzip.open(path)) if path.suffix.lower() == ".gz" else path.open("rb")


def need(module: str, extra: str) -> ModuleType:
    """The module, which belongs to an optional extra of bampipe.

    Raises:
        InputError: it is not installed; names the pip command.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise refusal("needs", package=module.partition(".")[0], extra=extra) from error
