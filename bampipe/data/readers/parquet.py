"""Parquet files: one row a sample; columns of vectors element by element."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from bampipe.data.readers import lerobot, moments
from bampipe.data.readers.nested import leaves
from bampipe.data.readers.trial import RawTrial, Wanted, check_columns, check_size
from bampipe.data.units import units_beside
from bampipe.errors import InputError, located

BATCH_ROWS = 1 << 16
_BUFFER = 1 << 20
_NUMBERS = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_boolean)
_MOMENTS = (pa.types.is_timestamp, pa.types.is_date, pa.types.is_string, pa.types.is_large_string)


def read(path: Path, wanted: Wanted) -> RawTrial:
    """The wanted columns of a Parquet file.

    Raises:
        InputError: damaged, too large, a column missing or not of numbers.
    """
    # Text stays as a dictionary, so that it takes as much memory as in the file.
    with pq.ParquetFile(
        path, memory_map=False, buffer_size=_BUFFER, read_dictionary=[*wanted.datetimes]
    ) as file:
        schema = file.schema_arrow
        vectors = lerobot.vector_columns(path, schema)
        check_columns([*schema.names, *vectors], wanted.columns)
        places = {column: vectors.get(column, (column, None)) for column in wanted.columns}
        for column, (_, place) in places.items():
            if place is None:
                _check_kind(schema.field(column).type, column in wanted.datetimes, column)
        stored = list(dict.fromkeys(where for where, _ in places.values()))
        rows = file.metadata.num_rows
        check_size(rows, wanted)
        values = {
            column: np.empty(rows, np.int64 if column in wanted.datetimes else np.float64)
            for column in wanted.columns
        }
        done = 0
        for batch in file.iter_batches(BATCH_ROWS, columns=stored, use_threads=False):
            for column, (where, place) in places.items():
                cells = batch.column(where)
                if place is not None:
                    cells = pc.list_element(cells, place)
                with located(f"column '{column}'"):
                    numbers = _numbers(cells, wanted.datetimes.get(column), done + 1)
                values[column][done : done + batch.num_rows] = numbers
            done += batch.num_rows
    if done != rows:
        raise InputError(f"{done} rows, where it claims {rows}")
    for column in wanted.datetimes:
        values[column] = moments.seconds(values[column])
    return RawTrial(values, first_row=1, begun=lerobot.episodes_begin(path))


def columns(path: Path) -> dict[str, str]:
    """Names of the columns that hold numbers or moments; the unit is "datetime" for these."""
    schema = pq.read_schema(path)
    found = dict.fromkeys(lerobot.vector_columns(path, schema), "")
    attributes = json.loads((schema.metadata or {}).get(b"PANDAS_ATTRS", b"{}"))
    beside = units_beside({k: u for k, u in leaves(attributes) if isinstance(u, str)})
    for field in schema:
        if field.name in lerobot.NO_READINGS and lerobot.EPISODE in schema.names:
            continue
        if any(check(field.type) for check in _NUMBERS):
            own = field.metadata or {}
            stated = (own.get(b"unit") or own.get(b"units") or b"").decode("utf-8", "replace")
            found[field.name] = stated or beside.get(field.name, "")
        elif pa.types.is_timestamp(field.type):
            found[field.name] = "datetime"
    return found


def _check_kind(kind: pa.DataType, moment: bool, column: str) -> None:
    if moment and pa.types.is_dictionary(kind):
        kind = kind.value_type
    if not any(check(kind) for check in (_MOMENTS if moment else _NUMBERS)):
        stamped = pa.types.is_timestamp(kind)
        raise InputError(
            f"holds {kind}, expected {'dates and times' if moment else 'numbers'}",
            where=f"column '{column}'",
            remedy='is it the time? then say unit = "datetime" under [time]' if stamped else "",
        )


def _numbers(cells: pa.Array, form: str | None, first: int) -> np.ndarray:
    if form is None:
        if pa.types.is_boolean(cells.type):
            cells = cells.cast(pa.uint8())
        numbers = cells.cast(pa.float64(), safe=False)
        return np.asarray(numbers.to_numpy(zero_copy_only=False))
    if pa.types.is_timestamp(cells.type) or pa.types.is_date(cells.type):
        stamps = cells.cast(pa.timestamp("ns", getattr(cells.type, "tz", None)), safe=False)
        plain = stamps.to_numpy(zero_copy_only=False).astype("datetime64[ns]")
        return moments.nanoseconds(plain, form)
    if pa.types.is_dictionary(cells.type):
        longest = pc.max(pc.binary_length(cells.dictionary)).as_py() or 0
        if longest > 4 * moments.LONGEST:
            raise InputError(f"a text of {longest} bytes, expected a date and time")
        cells = cells.dictionary_decode()
    return moments.nanoseconds(cells.to_pylist(), form, first)
