"""Parquet files: one row a sample."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from bampipe.data.readers import moments
from bampipe.data.readers.trial import RawTrial, Wanted, check_columns, check_size
from bampipe.data.readers.unpacking import check_unpacked
from bampipe.errors import InputError

BATCH_ROWS = 1 << 16
_BUFFER = 1 << 20
_LONGEST_HEADER = 1 << 24
_NUMBERS = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_boolean)
_MOMENTS = (pa.types.is_timestamp, pa.types.is_date, pa.types.is_string, pa.types.is_large_string)


def read(path: Path, wanted: Wanted, name: str) -> RawTrial:
    """The wanted columns of a Parquet file.

    Raises:
        InputError: damaged, too large, a column missing or not of numbers.
    """
    try:
        # Text stays as a dictionary, so that it takes as much memory as in the file.
        with pq.ParquetFile(
            path, memory_map=False, buffer_size=_BUFFER, read_dictionary=[*wanted.datetimes]
        ) as file:
            schema = file.schema_arrow
            check_columns(schema.names, wanted.columns, name)
            for column in wanted.columns:
                _check_kind(schema.field(column).type, column in wanted.datetimes, name, column)
            rows = file.metadata.num_rows
            check_size(rows, wanted, name)
            _check_pages(path, file.metadata, wanted, name)
            values = {
                column: np.empty(rows, np.int64 if column in wanted.datetimes else np.float64)
                for column in wanted.columns
            }
            done = 0
            for batch in file.iter_batches(BATCH_ROWS, columns=list(wanted.columns)):
                for column in wanted.columns:
                    cells = batch.column(column)
                    values[column][done : done + batch.num_rows] = _numbers(
                        cells, wanted.datetimes.get(column), f"{name}, column '{column}'", done + 1
                    )
                done += batch.num_rows
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(
            "not a sound Parquet file", where=name, remedy="copy it again from the logger"
        ) from error
    if done != rows:
        raise InputError(f"{done} rows, where it claims {rows}", where=name)
    for column in wanted.datetimes:
        values[column] = moments.seconds(values[column])
    return RawTrial(values, first_row=1)


def columns(path: Path, name: str) -> dict[str, str]:
    """Names of the columns that hold numbers or moments; the unit is "datetime" for these.

    Raises:
        InputError: not a sound Parquet file.
    """
    try:
        schema = pq.read_schema(path)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError("not a sound Parquet file", where=name) from error
    found = {}
    for field in schema:
        if any(check(field.type) for check in _NUMBERS):
            stated = (field.metadata or {}).get(b"unit") or b""
            found[field.name] = stated.decode("utf-8", "replace")
        elif pa.types.is_timestamp(field.type):
            found[field.name] = "datetime"
    return found


def _check_pages(path: Path, metadata: pq.FileMetaData, wanted: Wanted, name: str) -> None:
    """Raise InputError where a page of a wanted column unpacks to far more than the trial takes.

    Arrow allocates what the page's own header says; the footer may say less.
    """
    trial_bytes = 8 * metadata.num_rows * len(wanted.columns)
    with path.open("rb") as stream:
        for group in range(metadata.num_row_groups):
            for number in range(metadata.num_columns):
                chunk = metadata.row_group(group).column(number)
                if chunk.path_in_schema not in wanted.columns:
                    continue
                offset = chunk.data_page_offset
                if chunk.has_dictionary_page and chunk.dictionary_page_offset:
                    offset = min(offset, chunk.dictionary_page_offset)
                end = offset + chunk.total_compressed_size
                where = f"{name}, column '{chunk.path_in_schema}'"
                while offset < end:
                    header, length = _page_header(stream, offset)
                    if not length:  # damaged: Arrow ends here, too
                        break
                    check_unpacked(header.get(2, 0), trial_bytes, where, "a page")
                    offset += length + max(header.get(3, 0), 0)


def _page_header(stream: BinaryIO, offset: int) -> tuple[dict[int, int], int]:
    """Whole numbers in a page's header by field, and its length; 0 where it is none."""
    for length in (1 << 12, _LONGEST_HEADER):
        stream.seek(offset)
        with suppress(IndexError):
            return _numbers_of_struct(stream.read(length), 0)
    return {}, 0


def _numbers_of_struct(data: bytes, at: int, depth: int = 0) -> tuple[dict[int, int], int]:
    """Whole numbers in a struct of Thrift's compact protocol, by field, and where it ends.

    Raises:
        IndexError: it is not there as a whole.
    """
    found: dict[int, int] = {}
    field = 0
    while kind := data[at] & 0x0F:
        step, at = data[at] >> 4, at + 1
        if step:
            field += step
        else:
            field, at = _zigzag(data, at)
        if kind in (4, 5, 6):
            found[field], at = _zigzag(data, at)
        elif kind == 8:
            length, at = _varint(data, at)
            at += length
        elif kind == 12 and depth < 4:
            _, at = _numbers_of_struct(data, at, depth + 1)
        elif kind in (3, 7):
            at += 1 if kind == 3 else 8
        elif kind > 2:  # a list, set or map: none is in a page's header
            raise IndexError
    return found, at + 1


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while data[at] & 0x80:
        value |= (data[at] & 0x7F) << shift
        at, shift = at + 1, shift + 7
    return value | data[at] << shift, at + 1


def _zigzag(data: bytes, at: int) -> tuple[int, int]:
    value, at = _varint(data, at)
    return (value >> 1) ^ -(value & 1), at


def _check_kind(kind: pa.DataType, moment: bool, name: str, column: str) -> None:
    if moment and pa.types.is_dictionary(kind):
        kind = kind.value_type
    if not any(check(kind) for check in (_MOMENTS if moment else _NUMBERS)):
        stamped = pa.types.is_timestamp(kind)
        raise InputError(
            f"holds {kind}, expected {'dates and times' if moment else 'numbers'}",
            where=f"{name}, column '{column}'",
            remedy='is it the time? then say unit = "datetime" under [time]' if stamped else "",
        )


def _numbers(cells: pa.Array, form: str | None, where: str, first: int) -> np.ndarray:
    if form is None:
        if pa.types.is_boolean(cells.type):
            cells = cells.cast(pa.uint8())
        numbers = cells.cast(pa.float64(), safe=False)
        return np.asarray(numbers.to_numpy(zero_copy_only=False))
    if pa.types.is_timestamp(cells.type) or pa.types.is_date(cells.type):
        stamps = cells.cast(pa.timestamp("ns", getattr(cells.type, "tz", None)), safe=False)
        return moments.nanoseconds(
            stamps.to_numpy(zero_copy_only=False).astype("datetime64[ns]"), form, where
        )
    if pa.types.is_dictionary(cells.type):
        longest = pc.max(pc.binary_length(cells.dictionary)).as_py() or 0
        if longest > 4 * moments.LONGEST:
            raise InputError(f"a text of {longest} bytes, expected a date and time", where=where)
        cells = cells.dictionary_decode()
    return moments.nanoseconds(cells.to_pylist(), form, where, first)
