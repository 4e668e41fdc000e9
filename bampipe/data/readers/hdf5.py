"""HDF5 files, and MATLAB files of version 7.3, which are HDF5 inside.

A column is the path of a dataset (``log/force``), a field of a compound one (``log/samples.force``)
or a column of a matrix (``log/pose[2]``). What lies outside the file is not followed.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from bampipe.data.readers import moments
from bampipe.data.readers.arrays import (
    RUN,
    columns_of_arrays,
    labels,
    pick,
    read_arrays,
    recorded,
    split_index,
)
from bampipe.data.readers.trial import RawTrial, Wanted, check_columns, check_size
from bampipe.errors import InputError

SIGNATURE = b"\x89HDF\r\n\x1a\n"
_MOST_DATASETS = 2000
_BLOCK_ROWS = 1 << 14
_COLUMNS = ("columns", "channels", "names", "column_names", "labels", "fields")
"""Attributes with the names of the columns of a matrix."""


def read(path: Path, wanted: Wanted, name: str, what: str = "dataset") -> RawTrial:
    """The wanted columns of an HDF5 file, whose parts are called ``what`` in messages.

    Raises:
        InputError: damaged, a column missing, not a vector, or not of numbers.
    """
    import h5py  # heavy: only for these files

    matlab = what == "variable"
    with h5py.File(path, "r") as file:
        if any("[:]" in column for column in wanted.columns):
            return read_arrays(_vectors(file), wanted, name, what)
        known = _list_columns(file)
        arrays: dict[str, np.ndarray | None] = {}
        units: dict[str, str] = {}
        for column in wanted.columns:
            where = f"{name}, {what} '{column}'"
            own, index = split_index(column, known)
            # A field of a struct of MATLAB is a path here.
            own = next((n for n in (own, own.replace(".", "/")) if n in known), own)
            _require_column(file, own, [*known], name, where)
            data, field, place = known[own]
            check_size(math.prod(data.shape), wanted, name)
            kind = _kind(data, field)
            text = kind.kind in "OS" or data.attrs.get("MATLAB_class") == b"char"
            arrays[column] = None
            if column in wanted.datetimes if text else kind.kind in "iufb":
                if kind.kind == "S" and kind.itemsize > moments.LONGEST:
                    what = f"a text of {kind.itemsize} bytes, expected a date and time"
                    raise InputError(what, where=where)
                cells = data[()] if field is None else _read_field(data, field)
                cells = pick(cells, index if place is None else place, where)
                arrays[column] = np.array(_texts(cells), dtype=object) if text else cells
            unit = "" if matlab else _unit(data)
            units |= {column: unit} if unit else {}
    return replace(read_arrays(arrays, wanted, name, what), units=units)


def columns(path: Path, name: str) -> dict[str, str]:
    """Names and units of the vectors of numbers that were recorded together."""
    import h5py  # heavy: only for these files

    shapes: dict[str, tuple[int, ...]] = {}
    units: dict[str, str] = {}
    named: dict[str, str] = {}
    with h5py.File(path, "r") as file:
        for column, (data, field, place) in _list_columns(file).items():
            numeric = _kind(data, field).kind in "iufb"
            if place is None and numeric and data.attrs.get("MATLAB_class") != b"char":
                shapes[column] = data.shape
                units |= dict.fromkeys(labels(column, data.shape), _unit(data))
            elif place is not None:
                named[f"{column.rpartition('/')[0]}[{place}]"] = column
        if any(map(RUN.fullmatch, shapes)):
            runs = columns_of_arrays(_vectors(file))
            if any("[:]" in column for column in runs):
                return runs
    return {named.get(column, column): units[column] for column in recorded(shapes)}


def _list_columns(file: Any) -> dict[str, tuple[Any, str | None, int | None]]:
    """Every column of a file by its name: its dataset, which field and which column of it.

    A matrix is one, each of its columns that has a name another.
    """
    found: dict[str, tuple[Any, str | None, int | None]] = {}
    for label, data in _datasets(file):
        for field in data.dtype.names or (None,):
            found[label if field is None else f"{label}.{field}"] = data, field, None
        found |= {f"{label}/{text}": (data, None, k) for k, text in enumerate(_names(data))}
    return found


def _kind(data: Any, field: str | None) -> Any:
    return data.dtype if field is None else data.dtype[field]


def _vectors(file: Any) -> dict[str, np.ndarray | None]:
    """The vectors of numbers of a file, by their path."""
    found = dict(_datasets(file))
    return {
        label: data[()]
        for label, data in found.items()
        if data.dtype.kind in "iufb" and max(data.shape, default=0) == data.size
    }


def _datasets(group: Any, prefix: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Every dataset of the file itself, by its path; links are not followed."""
    import h5py

    for count, key in enumerate(group):
        if count > _MOST_DATASETS or key.startswith("#"):
            continue
        if not isinstance(group.get(key, getlink=True), h5py.HardLink):
            continue
        item = group[key]
        label = f"{prefix}{key}"
        if isinstance(item, h5py.Dataset):
            if not item.external and not item.is_virtual:
                yield label, item
        elif depth < 8:
            yield from _datasets(item, f"{label}/", depth + 1)


def _require_column(file: Any, column: str, known: Sequence[str], name: str, where: str) -> None:
    """Refuse a column that is not among those ``known``."""
    import h5py

    if column in known:
        return
    for path in accumulate(column.split("/"), "{}/{}".format):
        if isinstance(file.get(path, getlink=True), h5py.SoftLink | h5py.ExternalLink):
            raise InputError("a link, expected numbers in this file", where=where)
    inside = [other for other in known if other.startswith((f"{column}/", f"{column}."))]
    if inside:
        raise InputError(
            "a structure, expected a vector of numbers",
            where=where,
            remedy=f"name what is in it: {', '.join(inside[:6])}",
        )
    check_columns(known, [column], name)


def _names(data: Any) -> list[str]:
    """Names that the file gives to the columns of a matrix: beside it, or as pandas stores them."""
    items = data.name.removesuffix("_values") + "_items"
    width = min((extent for extent in data.shape if extent != 1), default=0)
    found = next((data.attrs[key] for key in _COLUMNS if key in data.attrs), ())
    beside = dict(_datasets(data.parent)).get(items.rpartition("/")[2])
    if not len(found) and beside is not None and beside.shape == (width,):
        found = beside[()]
    texts = _texts(found)
    return texts if data.ndim == 2 and len(texts) == width and len(set(texts)) == width else []


def _read_field(data: Any, field: str) -> np.ndarray:
    """A field of all rows, in blocks: rows may be wide, and memory that HDF5 lacks ends it."""
    starts = range(0, max(data.shape[:1], default=0), _BLOCK_ROWS)
    parts = [data[k : k + _BLOCK_ROWS][field] for k in starts]
    return np.concatenate(parts) if parts else np.asarray(data[field])


def _texts(cells: Iterable[Any]) -> list[str]:
    return [x.decode("utf-8", "replace") if isinstance(x, bytes) else str(x) for x in cells]


def _unit(data: Any) -> str:
    """Unit that the file states for a dataset."""
    for key in ("unit", "units", "Unit", "Units"):
        value = data.attrs.get(key)
        if isinstance(value, bytes):
            value = value.decode("utf-8", "replace")
        if isinstance(value, str):
            return value
    return ""
