"""HDF5 files, and MATLAB files of version 7.3, which are HDF5 inside.

A column is the path of a dataset (``log/force``), a field of a compound one (``log/samples.force``)
or a column of a matrix (``log/pose[2]``). What lies outside the file is not followed.
"""

import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bampipe.data.readers import moments
from bampipe.data.readers.arrays import LINK, ArrayReader, Opened, Stored, pick, split_index, stored
from bampipe.data.readers.trial import Wanted
from bampipe.data.units import SCALES, in_steps
from bampipe.errors import InputError

SIGNATURE = b"\x89HDF\r\n\x1a\n"
ENDINGS = (".h5", ".hdf5", ".hdf", ".nc")
"""File extensions."""
_MOST_DATASETS, _DEEPEST = 2000, 8
_BLOCK_ROWS = 1 << 14
_COLUMNS = re.compile(
    r"(?i)(?:(?:column|channel|signal|variable)s?[ _]?)?(?:names|labels)|columns|channels|fields"
)
"""Attributes with the names of the columns of a matrix."""
_PACKED = {"scale_factor": 1.0, "add_offset": 0.0}
"""Attributes by which netCDF packs numbers into integers, and their defaults."""


@contextmanager
def opened(path: Path, wanted: Wanted | None) -> Iterator[Opened]:
    """Content of an HDF5 file."""
    import h5py  # heavy: only for these files

    with h5py.File(path, "r") as file:
        known = dict(_arrays(file, alone=wanted is None))
        for column in wanted.columns if wanted else ():
            own, _ = split_index(column, known)  # a field of a struct of MATLAB is a path here
            known |= {own: known[at]} if (at := own.replace(".", "/")) in known else {}
        yield known, ()


READER = ArrayReader("dataset", opened)


def numbers_of(path: Path) -> dict[str, float]:
    """Single numbers in the attributes of a file and of its contents, by name."""
    import h5py

    found: dict[str, Any] = {}
    with h5py.File(path, "r") as file, suppress(RuntimeError):  # where a group is damaged
        found |= file.attrs
        file.visititems(
            lambda label, item: found.update({f"{label}.{k}": v for k, v in item.attrs.items()})
        )
    kept = {k: np.asarray(value) for k, value in found.items()}
    return {k: float(x.item()) for k, x in kept.items() if x.size == 1 and x.dtype.kind in "iuf"}


def _arrays(file: Any, alone: bool) -> Iterator[tuple[str, Stored]]:
    """Yield content by name: datasets, fields of compound ones, columns of a matrix with names.

    Such a matrix is yielded itself, too, unless its columns are wanted ``alone``.
    """
    known = dict(_datasets(file))
    for label, data in known.items():
        if data is None:
            yield label, stored(None, kind=LINK)
            continue
        names = _names(data, known.get(f"{label.removesuffix('_values')}_items"))
        kind = "U" if data.attrs.get("MATLAB_class") == b"char" else data.dtype.kind
        for at, field in enumerate(data.dtype.names or (None,)):
            kind = data.dtype[field].kind if field else kind
            load = partial(_read, data, field)
            array = Stored(data.shape, kind, load, _unit(data, at, load))
            if not (alone and names):
                yield label if field is None else f"{label}.{field}", array
            for place, name in enumerate(names):
                load = partial(_read, data, None, place)
                said = _unit(data, place, load)
                yield f"{label}/{name}", Stored((max(data.shape),), array.kind, load, said)


def _datasets(group: Any, prefix: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Every dataset of the file itself, by its path; None for links, which are not followed."""
    import h5py

    for count, key in enumerate(group):
        if count > _MOST_DATASETS or key.startswith("#"):
            continue
        label = f"{prefix}{key}"
        if not isinstance(group.get(key, getlink=True), h5py.HardLink):
            yield label, None
            continue
        item, inner = group[key], depth + 1
        held = {label: item}
        if isinstance(item, h5py.Dataset) and h5py.check_ref_dtype(item.dtype) is h5py.Reference:
            # Cells, and fields of arrays of structs, as MATLAB keeps them; they may go in circles.
            own = f"{prefix[:-1]}[{{}}].{key}" if prefix else f"{key}[{{}}]"
            at = enumerate(item[()].ravel()[:_MOST_DATASETS])
            held, inner = {own.format(n): group[x] for n, x in at if x}, _DEEPEST
        for name, within in held.items():
            if isinstance(within, h5py.Dataset):
                if not within.external and not within.is_virtual:
                    yield name, within
            elif depth < _DEEPEST:
                yield from _datasets(within, f"{name}/", inner)


def _names(data: Any, beside: Any) -> list[str]:
    """Names that the file gives to the columns of a matrix: with it, or ``beside`` it by pandas."""
    width = min((extent for extent in data.shape if extent != 1), default=0)
    found = next((data.attrs[key] for key in data.attrs if _COLUMNS.fullmatch(key)), ())
    if not np.size(found) and beside is not None and beside.shape == (width,):
        found = beside[()]
    texts = _texts(np.ravel(found))
    return texts if data.ndim == 2 and len(texts) == width and len(set(texts)) == width else []


def _read(data: Any, field: str | None, place: int | None = None) -> np.ndarray:
    """A dataset, a field of all its rows, or its column at a place; texts as objects."""
    kind = data.dtype if field is None else data.dtype[field]
    if kind.kind == "S" and kind.itemsize > moments.LONGEST:
        raise InputError(f"a text of {kind.itemsize} bytes, expected a date and time")
    if field is None:
        cells = np.asarray(data[()])
    else:  # in blocks: rows may be wide, and memory that HDF5 lacks ends it
        starts = range(0, max(data.shape[:1], default=0), _BLOCK_ROWS)
        parts = [data[k : k + _BLOCK_ROWS][field] for k in starts]
        cells = np.concatenate(parts) if parts else np.asarray(data[field])
    if kind.kind in "OS":
        return np.array(_texts(cells), dtype=object)
    if field is None and not _PACKED.keys().isdisjoint(data.attrs):
        scale, offset = (np.ravel(data.attrs.get(*each))[0] for each in _PACKED.items())
        cells = scale * cells + offset
    return cells if place is None else pick(cells, place)


def _texts(cells: Iterable[Any]) -> list[str]:
    return [x.decode("utf-8", "replace") if isinstance(x, bytes) else str(x) for x in cells]


def _unit(data: Any, place: int, load: Callable[[], np.ndarray]) -> str:
    """Unit that the file states for what ``load`` reads, or in a list for columns or fields."""
    said, sizes = (
        np.ravel(next((data.attrs[key] for key in keys if key in data.attrs), []))
        for keys in (("unit", "units", "Unit", "Units"), SCALES)
    )
    texts = _texts(said)
    text = texts[0] if len(texts) == 1 else texts[place] if place < len(texts) else ""
    size = sizes[place if len(sizes) > 1 else 0 :][:1].tolist()
    return in_steps(load(), size, text) if size and sizes.dtype.kind in "iuf" else text
