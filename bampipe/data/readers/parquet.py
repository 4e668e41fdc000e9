"""Parquet and Feather files: one row a sample; columns of vectors element by element."""

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import dataset

from bampipe.data.readers import lerobot, moments
from bampipe.data.readers.arrays import LARGEST_WIDTH, ArrayReader, Opened, Stored, stored
from bampipe.data.readers.nested import leaves
from bampipe.data.readers.trial import NUMBER, Wanted
from bampipe.data.units import SCALES, in_steps, units_beside
from bampipe.errors import InputError

_KINDS = {
    "f": (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_boolean),
    "M": (pa.types.is_timestamp,),
    "m": (pa.types.is_duration,),
    "O": (pa.types.is_date, pa.types.is_string, pa.types.is_large_string),
}
"""NumPy's kinds of arrays, by the test for the type of a column."""


@contextmanager
def _opened(path: Path, wanted: Wanted | None) -> Iterator[Opened]:
    """The columns of a file, each read as a whole when it is wanted."""
    # Text stays as a dictionary, so that it takes as much memory as in the file.
    texts = {*wanted.datetimes} if wanted else set()
    of_parquet = dataset.ParquetFileFormat(dictionary_columns=texts)
    is_parquet = path.suffix.lower() == ".parquet"
    file = dataset.dataset(path, format=of_parquet if is_parquet else "feather")
    schema, rows = file.schema, file.count_rows()
    counting = lerobot.NO_READINGS if wanted is None and lerobot.EPISODE in schema.names else ()
    while any(pa.types.is_struct(field.type) for field in schema):
        schema = schema.empty_table().flatten().schema
    attributes = json.loads((file.schema.metadata or {}).get(b"PANDAS_ATTRS", b"{}"))
    beside = units_beside({k: u for k, u in leaves(attributes) if isinstance(u, str)})

    @cache
    def read_column(name: str) -> pa.ChunkedArray:
        return file.to_table(columns=[name], use_threads=False).column(0)

    found = {}
    for field in (each for each in schema if each.name not in counting):
        kind = field.type.value_type if pa.types.is_dictionary(field.type) else field.type
        kind = next((k for k, checks in _KINDS.items() if any(x(kind) for x in checks)), "V")
        own = field.metadata or {}
        stated = (own.get(b"unit") or own.get(b"units") or b"").decode("utf-8", "replace")
        load = partial(_cells, read_column, field.name)
        said = stated or beside.get(field.name, "")
        sizes = (own.get(key.encode(), b"").decode("utf-8", "replace") for key in SCALES)
        if size := [float(text) for text in sizes if re.fullmatch(NUMBER, text)]:
            said = in_steps(load(), size, said)
        said, kind = (field.type.unit, "i") if kind == "m" else (said, kind)
        found[field.name] = Stored((rows,), kind, load, said)
    vectors = lerobot.vector_columns(path, schema, file)
    for name, (vector, place) in vectors.items():
        found[name] = Stored((rows,), "f", partial(_cells, read_column, vector, place))
    taken = {vector for vector, _ in vectors.values()}
    for field in schema if rows <= LARGEST_WIDTH else ():  # a trial a row
        numbers = pa.types.is_list(field.type) and _KINDS["f"][:2]
        if numbers and field.name not in taken and any(x(field.type.value_type) for x in numbers):
            cells = read_column(field.name).cast(pa.list_(pa.float64()))
            for k, row in enumerate(cells):
                values = row.values.to_numpy(zero_copy_only=False) if row.is_valid else np.empty(0)
                found[f"trial{k}.{field.name}"] = stored(values)
    yield found, ()


READER = ArrayReader("column", _opened, lerobot.episodes_begin)


def _cells(
    read_column: Callable[[str], pa.ChunkedArray], name: str, place: int | None = None
) -> np.ndarray:
    """A column, or an element of its vectors, (T,): numbers, moments or texts."""
    cells = read_column(name)
    if place is not None:
        cells = pc.list_element(cells, place)
    if pa.types.is_timestamp(cells.type) or pa.types.is_date(cells.type):
        cells = cells.cast(pa.timestamp("ns", getattr(cells.type, "tz", None)), safe=False)
        return np.asarray(cells.to_numpy(), dtype="datetime64[ns]")
    if pa.types.is_dictionary(cells.type):
        lengths = [pc.max(pc.binary_length(part.dictionary)).as_py() or 0 for part in cells.chunks]
        if max(lengths, default=0) > 4 * moments.LONGEST:
            raise InputError(f"a text of {max(lengths)} bytes, expected a date and time")
    elif not any(is_kind(cells.type) for is_kind in _KINDS["O"]):
        cells = cells.cast(pa.uint8()) if pa.types.is_boolean(cells.type) else cells
        cells = cells.cast(pa.int64()) if pa.types.is_duration(cells.type) else cells
        cells = cells.cast(pa.float64(), safe=False)
    return np.asarray(cells.to_numpy())
