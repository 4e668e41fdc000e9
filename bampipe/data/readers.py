"""Readers of trial files: CSV, Parquet, MATLAB (.mat) and JSON, one trial at a time.

Every reader returns the wanted columns as float64, with NaN where a cell is empty, and raises
:class:`bampipe.errors.InputError` naming file, row and column where the file cannot be trusted.
Rows of a CSV file are counted as an editor does (the header is row 1); samples of the other
files are counted from 1. Memory stays below three times what is returned, JSON aside, which has
to be held as a whole.
"""

from __future__ import annotations

import csv
import json
import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq

from bampipe.data import matlab
from bampipe.data.schema import did_you_mean
from bampipe.errors import InputError

LARGEST_BYTES = 4 << 30
"""A trial larger than this in memory is refused unless the caller allows more."""

_HEAD = 1 << 16
_BLOCK = 1 << 20
_BATCH_ROWS = 1 << 16
_NULLS = ["", "nan", "NaN", "NAN", "NA", "N/A", "#N/A", "null", "NULL", "None"]
_DELIMITERS = {";": "semicolons", "\t": "tabs", "|": "bars", " ": "blanks"}
_ENDINGS = (".csv", ".parquet", ".mat", ".json", ".jsonl")
_JSON_COST = 12
"""Memory that a JSON text takes once parsed, in multiples of its length, at most."""
_HDF5 = b"\x89HDF\r\n\x1a\n"


@dataclass(frozen=True)
class RawTrial:
    """The samples of one trial as they stand in its file.

    Attributes:
        columns: (T,) float64 a column, NaN where a cell is empty.
        first_row: number that the first sample has in the file, for messages.
        notes: what was left out or found in reading, one sentence each.
    """

    columns: dict[str, np.ndarray]
    first_row: int
    notes: tuple[str, ...] = ()


def read_trial(
    path: Path,
    columns: Sequence[str],
    *,
    name: str = "",
    largest_bytes: int = LARGEST_BYTES,
) -> RawTrial:
    """Read the wanted columns of one trial file; its ending says what kind of file it is.

    Args:
        path: the file.
        columns: names of the columns (MATLAB: of the variables).
        name: what to call the file in messages (default: its path).
        largest_bytes: refuse a trial that takes more than this in memory.

    Raises:
        InputError: empty, of another kind, cut off, too large, a column missing or twice, or a
            cell that is not a number.
    """
    path, name = Path(path), name or str(path)
    ending = path.suffix.lower()
    try:
        size = path.stat().st_size
        with path.open("rb") as stream:
            head = stream.read(_HEAD)
    except OSError as error:
        raise InputError(
            f"cannot be read: {(error.strerror or 'error').lower()}", where=name
        ) from error
    if ending not in _ENDINGS:
        raise InputError(
            f"ending '{ending}' is of no file that can be read",
            where=name,
            remedy=f"give {', '.join(_ENDINGS)}",
        )
    if size == 0:
        raise InputError("the file is empty", where=name)
    read = {
        ".csv": _read_csv,
        ".parquet": _read_parquet,
        ".mat": _read_mat,
        ".json": _read_json,
        ".jsonl": _read_json,
    }[ending]
    _check_kind(head, ending, name)
    try:
        trial = read(path, columns, name, largest_bytes)
    except MemoryError as error:
        raise InputError("does not fit into memory", where=name) from error
    if len(trial.columns[columns[0]]) == 0:
        raise InputError("a header but no samples", where=name)
    return trial


def _check_kind(head: bytes, ending: str, name: str) -> None:
    """Refuse a file whose first bytes belong to a file of another kind."""
    mat = head.startswith((b"MATLAB", _HDF5)) or head[512:520] == _HDF5
    kinds = (
        (head.startswith(b"PAR1"), ".parquet", "a Parquet file"),
        (mat, ".mat", "a MATLAB file"),
        (head.startswith(b"PK\x03\x04"), "", "a zip archive or spreadsheet"),
        (head.startswith(b"\x1f\x8b"), "", "a gzip archive"),
    )
    for found, right, words in kinds:
        if found and ending != right:
            remedy = f"name it *{right}" if right else "unpack it, or export it as CSV"
            raise InputError(f"this is {words}, not *{ending}", where=name, remedy=remedy)


def _check_size(rows: int, columns: Sequence[str], largest: int, name: str) -> None:
    if rows * len(columns) * 8 > largest:
        raise InputError(
            f"{rows} rows of {len(columns)} columns are more than the {largest >> 20} MB allowed",
            where=name,
            remedy="split the trial, or allow more (largest_trial_mb)",
        )


def _check_columns(found: Sequence[str], wanted: Sequence[str], name: str) -> None:
    for column in wanted:
        if column not in found:
            shown = ", ".join(found[:12]) + (", ..." if len(found) > 12 else "")
            others = [other for other in found if other not in wanted]
            raise InputError(
                f"no column '{column}'{did_you_mean(column, others)}",
                where=name,
                remedy=f"it has {shown}",
            )
        if list(found).count(column) > 1:
            first, second = [n for n, other in enumerate(found, 1) if other == column][:2]
            raise InputError(
                f"column '{column}' stands twice, as columns {first} and {second}",
                where=name,
                remedy="keep the right one",
            )


def _joined(parts: dict[str, list[np.ndarray]]) -> dict[str, np.ndarray]:
    """Concatenate column by column, letting go of the parts, so that only one column is double."""
    joined = {}
    for column in list(parts):
        chunks = parts.pop(column)
        joined[column] = np.concatenate(chunks) if chunks else np.empty(0)
    return joined


# CSV


class _Upto:
    """A binary file that ends at byte ``end``."""

    def __init__(self, stream: BinaryIO, end: int) -> None:
        self._stream = stream
        self._left = end
        self.closed = False

    def read(self, size: int = -1) -> bytes:
        size = self._left if size < 0 else min(size, self._left)
        data = self._stream.read(size)
        self._left -= len(data)
        return data

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return False

    def writable(self) -> bool:
        return False

    def close(self) -> None:
        self.closed = True


def _read_csv(path: Path, columns: Sequence[str], name: str, largest: int) -> RawTrial:
    with path.open("rb") as stream:
        header = _header(stream.read(_HEAD), columns, name)
        end, notes = _sound_end(stream, len(header), name)
        stream.seek(0)
        parts: dict[str, list[np.ndarray]] = {column: [] for column in columns}
        rows = 0
        try:
            reader = pa_csv.open_csv(
                pa.PythonFile(_Upto(stream, end), mode="r"),
                read_options=pa_csv.ReadOptions(
                    use_threads=False,
                    block_size=_BLOCK,
                    skip_rows=1,
                    # Names that are not wanted may be repeated or empty: a number stands for them.
                    column_names=[c if c in columns else f"\0{n}" for n, c in enumerate(header)],
                ),
                convert_options=pa_csv.ConvertOptions(
                    column_types=dict.fromkeys(columns, pa.float64()),
                    include_columns=list(columns),
                    null_values=_NULLS,
                    strings_can_be_null=True,
                ),
            )
            for batch in reader:
                rows += batch.num_rows
                _check_size(rows, columns, largest, name)
                for column in columns:
                    values = batch.column(column).to_numpy(zero_copy_only=False)
                    parts[column].append(np.array(values, dtype=np.float64))
        except pa.ArrowInvalid as error:
            raise _csv_fault(path, str(error), header, name) from error
    return RawTrial(_joined(parts), first_row=2, notes=notes)


def _header(head: bytes, columns: Sequence[str], name: str) -> list[str]:
    """Names in the first line of a CSV file, checked."""
    if head.startswith((b"\xff\xfe", b"\xfe\xff")) or _looks_utf16(head):
        raise InputError("UTF-16 text", where=name, remedy="save it as UTF-8")
    if b"\0" in head:
        raise InputError("binary data, not text", where=name, remedy="export the log as CSV")
    line = re.split(rb"[\r\n]", head, maxsplit=1)[0]
    if len(line) == _HEAD:
        raise InputError("no line end in the first 64 kB: not a table", where=name)
    try:
        text = line.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            "the header is not UTF-8 text", where=f"{name}, row 1", remedy="save it as UTF-8"
        ) from error
    if not text.isprintable() and "\t" not in text:
        raise InputError("binary data, not text", where=name, remedy="export the log as CSV")
    header = [cell.strip() for cell in _cells(text)]
    for sign, words in _DELIMITERS.items():
        if len(header) == 1 and len(_cells(text, sign)) >= min(len(columns), 2):
            raise InputError(
                f"columns are separated by {words}, expected commas",
                where=f"{name}, row 1",
                remedy="export with commas between columns and points as decimal sign",
            )
    if all(re.fullmatch(r"[-+0-9.eE]*", cell) for cell in header):
        raise InputError(
            "no header: the first line holds numbers",
            where=f"{name}, row 1",
            remedy=f"add a line {','.join(columns)}",
        )
    _check_columns(header, columns, f"{name}, row 1")
    return header


def _looks_utf16(head: bytes) -> bool:
    """Whether every other byte, and only those, is nearly always zero."""
    zeros = sorted((head[0::2].count(0), head[1::2].count(0)))
    return zeros[0] == 0 and zeros[1] > 0.4 * len(head)


def _cells(line: str, delimiter: str = ",") -> list[str]:
    return next(csv.reader([line], delimiter=delimiter), [])


def _sound_end(stream: BinaryIO, width: int, name: str) -> tuple[int, tuple[str, ...]]:
    """Byte where the last whole row ends, and what is said about the rest.

    A last line is cut off when it has too few cells, or when it has no line end and its last
    cell does not have as many decimals as the one above.
    """
    size = stream.seek(0, 2)
    start = max(0, size - _HEAD)
    stream.seek(start)
    tail = stream.read(_HEAD)
    content = tail.rstrip(b"\r\n")
    ended = len(content) < len(tail)
    cut = max(content.rfind(b"\n"), content.rfind(b"\r"))
    if cut < 0:
        return size, ()
    last, above = content[cut + 1 :], re.split(rb"[\r\n]+", content[:cut].rstrip(b"\r\n"))[-1]
    first_line = start == 0 and not re.search(rb"[\r\n]", content[:cut].rstrip(b"\r\n"))
    short = last.count(b",") < width - 1
    if not short:
        decimals = [line.rpartition(b",")[2].strip().partition(b".") for line in (last, above)]
        same = decimals[0][1] and len(decimals[0][2]) == len(decimals[1][2])
        short = not ended and not (same or first_line)
    if not short:
        return size, ()
    return start + cut + 1, ("last line is cut off: 1 row dropped",)


def _csv_fault(path: Path, message: str, header: list[str], name: str) -> InputError:
    """The plain form of what Arrow says about a CSV file."""
    torn = re.search(
        r"Row #(\d+): Expected (\d+) columns, got (\d+): (.*?)(?: \.\.\.)?$", message, re.DOTALL
    )
    if torn:
        row, expected, actual, text = int(torn[1]), int(torn[2]), int(torn[3]), torn[4]
        commas = actual > expected and re.fullmatch(r'[\s"0-9,+-]*', text)
        return InputError(
            f"{actual} cells, where the header has {expected}",
            where=f"{name}, row {_line(path, row)}",
            remedy="decimal commas? export with points as decimal sign"
            if commas
            else "the line is damaged",
        )
    cell = re.search(
        r"In CSV column #(\d+): (?:Row #(\d+): )?.*invalid value '(.*)'", message, re.DOTALL
    )
    if cell is None:
        if "Could not skip" in message:
            return InputError("a header but no samples", where=name)
        what = "a line is far too long" if "straddl" in message else message
        return InputError(what, where=name)
    column, row_number, value = header[int(cell[1])], cell[2], cell[3]
    shown = value if value.isprintable() and len(value) <= 40 else ascii(value)[1:41]
    comma = re.fullmatch(r"\s*[-+]?\d+,\d+\s*", value)
    place = f", row {_line(path, int(row_number))}" if row_number else ""
    return InputError(
        f"found '{shown}', expected a number",
        where=f"{name}{place}, column '{column}'",
        remedy="export with points as decimal sign" if comma else "",
    )


def _line(path: Path, row: int) -> int:
    """Line of the file that holds Arrow's row ``row``: Arrow does not count blank lines."""
    full = 0
    with path.open("rb") as stream:
        for number, line in enumerate(stream, 1):
            full += bool(line.strip(b"\r\n"))
            if full == row:
                return number
    return row


# Parquet


def _read_parquet(path: Path, columns: Sequence[str], name: str, largest: int) -> RawTrial:
    try:
        with pq.ParquetFile(path, memory_map=False, buffer_size=_BLOCK) as file:
            schema = file.schema_arrow
            _check_columns(schema.names, columns, name)
            for column in columns:
                kind = schema.field(column).type
                if not any(
                    check(kind)
                    for check in (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal)
                ):
                    raise InputError(
                        f"holds {kind}, expected numbers", where=f"{name}, column '{column}'"
                    )
            rows = file.metadata.num_rows
            _check_size(rows, columns, largest, name)
            values = {column: np.empty(rows) for column in columns}
            done = 0
            for batch in file.iter_batches(_BATCH_ROWS, columns=list(columns)):
                for column in columns:
                    cells = batch.column(column).cast(pa.float64(), safe=False)
                    values[column][done : done + batch.num_rows] = cells.to_numpy(
                        zero_copy_only=False
                    )
                done += batch.num_rows
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(
            "not a sound Parquet file", where=name, remedy="copy it again from the logger"
        ) from error
    if done != rows:
        raise InputError(f"{done} rows, where it claims {rows}", where=name)
    return RawTrial(values, first_row=1)


# JSON


def _read_json(path: Path, columns: Sequence[str], name: str, largest: int) -> RawTrial:
    """Samples that are objects: a list of them, a list under one key, or one a line (.jsonl).

    Numbers beside that list are the same at every sample: a column for each of them.
    """
    if path.stat().st_size * _JSON_COST > largest:
        raise InputError(
            f"a JSON text of {path.stat().st_size >> 20} MB takes more memory than the"
            f" {largest >> 20} MB allowed",
            where=name,
            remedy="log to CSV or Parquet, or allow more (largest_trial_mb)",
        )
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError("not UTF-8 text", where=name, remedy="save it as UTF-8") from error
    if path.suffix.lower() == ".jsonl":
        lines = [line for line in text.splitlines() if line.strip()]
        samples = [_parsed(x, f"{name}, sample {n}") for n, x in enumerate(lines, 1)]
        constants: dict[str, object] = {}
    else:
        samples, constants = _json_samples(_parsed(text, name), name)
    if not samples:
        raise InputError("a header but no samples", where=name)
    values = {column: np.empty(len(samples)) for column in columns}
    for number, sample in enumerate(samples, 1):
        if not isinstance(sample, dict):
            raise InputError("not an object with named values", where=f"{name}, sample {number}")
        if number == 1:
            _check_columns([*sample, *(c for c in constants if c not in sample)], columns, name)
        for column in columns:
            cell = sample[column] if column in sample else constants.get(column)
            values[column][number - 1] = _number(cell, f"{name}, sample {number}, '{column}'")
    return RawTrial(values, first_row=1)


def _parsed(text: str, where: str) -> object:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        place = f" at line {error.lineno}" if isinstance(error, json.JSONDecodeError) else ""
        raise InputError(
            f"not sound JSON{place}", where=where, remedy="was the log cut off? copy it again"
        ) from error


def _json_samples(content: object, name: str) -> tuple[list[object], dict[str, object]]:
    """Samples of a parsed file, and the numbers beside them."""
    if isinstance(content, list):
        return content, {}
    content = content if isinstance(content, dict) else {}
    lists = {
        key: value
        for key, value in content.items()
        if isinstance(value, list) and value and isinstance(value[0], dict)
    }
    if len(lists) != 1:
        raise InputError(
            f"{len(lists)} lists of samples: {', '.join(lists)}"
            if lists
            else "no list of samples, that is of objects with named values",
            where=name,
        )
    constants = {k: v for k, v in content.items() if isinstance(v, int | float)}
    return next(iter(lists.values())), constants


def _number(cell: object, where: str) -> float:
    """A JSON value as a number: null is missing, true is 1."""
    if cell is None:
        return float("nan")
    if not isinstance(cell, int | float):
        raise InputError(f"found {str(cell)[:40]!r}, expected a number", where=where)
    try:
        return float(cell)
    except OverflowError as error:
        raise InputError("found a number beyond all range", where=where) from error


# MATLAB

_MAT_FAULTS = (
    OSError,
    ValueError,
    TypeError,
    KeyError,
    NotImplementedError,
    OverflowError,
    RuntimeError,
    zlib.error,
    struct.error,
)
"""What reading a damaged file raises: h5py has no one error type for it."""


def _read_mat(path: Path, columns: Sequence[str], name: str, largest: int) -> RawTrial:
    with path.open("rb") as stream:
        head = stream.read(1024)
    if _HDF5 in (head[:8], head[512:520]):
        read = _read_mat73
    elif matlab.is_level5(head):
        read = _read_mat5
    else:
        raise InputError(
            "not a MATLAB file of version 5 or newer",
            where=name,
            remedy="save it again from MATLAB (-v7)",
        )
    try:
        values = read(path, columns, name, largest)
    except _MAT_FAULTS as error:
        raise InputError(
            "not a sound MATLAB file", where=name, remedy="save it again from MATLAB"
        ) from error
    count = len(values[columns[0]])
    for column, value in values.items():
        if len(value) == 1 < count:  # a single number stands for a column that does not change
            values[column] = np.repeat(value, count)
        elif len(value) != count:
            raise InputError(
                f"{len(value)} values, where '{columns[0]}' has {count}",
                where=f"{name}, variable '{column}'",
            )
    return RawTrial(values, first_row=1)


def _read_mat5(
    path: Path, columns: Sequence[str], name: str, largest: int
) -> dict[str, np.ndarray]:
    found = matlab.variables(path)
    _check_columns([variable.name for variable in found], columns, name)
    known = {variable.name: variable for variable in found}
    values = {}
    for column in columns:
        variable = known[column]
        if not variable.real:
            raise _no_numbers(name, column)
        _check_vector(variable.shape, name, column)
        _check_size(variable.length, columns, largest, name)
        values[column] = matlab.values(path, variable)
    return values


def _read_mat73(
    path: Path, columns: Sequence[str], name: str, largest: int
) -> dict[str, np.ndarray]:
    import h5py  # heavy: only for .mat files of version 7.3

    values = {}
    with h5py.File(path, "r") as file:
        _check_columns([key for key in file if not key.startswith("#")], columns, name)
        for column in columns:
            place = f"{name}, variable '{column}'"
            if not isinstance(file.get(column, getlink=True), h5py.HardLink):
                raise InputError("a link, expected numbers in this file", where=place)
            data = file[column]
            if not isinstance(data, h5py.Dataset):
                raise InputError("a structure, expected a vector of numbers", where=place)
            if data.external or data.is_virtual:
                raise InputError("stored outside this file", where=place)
            if data.dtype.kind not in "iufb" or data.attrs.get("MATLAB_class") == b"char":
                raise _no_numbers(name, column)
            _check_vector(data.shape, name, column)
            _check_size(int(data.size), columns, largest, name)
            values[column] = np.asarray(data[()], dtype=np.float64).ravel()
    return values


def _check_vector(shape: tuple[int, ...], name: str, variable: str) -> None:
    if sum(extent != 1 for extent in shape) > 1 and 0 not in shape:
        shown = " by ".join(map(str, shape))
        raise InputError(
            f"a {shown} array, expected a vector", where=f"{name}, variable '{variable}'"
        )


def _no_numbers(name: str, variable: str) -> InputError:
    return InputError(
        "not numbers, expected a vector of real numbers", where=f"{name}, variable '{variable}'"
    )
