"""Arrays as NumPy saves them: ``.npy`` with one, ``.npz`` with several by name.

Fields of a structured array are columns, too. Pickled objects, which may run any program, are not
read.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bampipe.data.readers.arrays import columns_of_arrays, read_arrays
from bampipe.data.readers.trial import RawTrial, Wanted
from bampipe.errors import InputError


def read(path: Path, wanted: Wanted, name: str) -> RawTrial:
    """The wanted arrays; ``data[0]`` is the first column of the one array of a ``.npy``.

    Raises:
        InputError: damaged, pickled, an array missing, or not a vector of numbers.
    """
    return read_arrays(_arrays(path, name), wanted, name, "array")


def columns(path: Path, name: str) -> dict[str, str]:
    """Names of the vectors of numbers that were recorded together, or of columns; no units."""
    return columns_of_arrays(_arrays(path, name))


def _arrays(path: Path, name: str) -> dict[str, np.ndarray | None]:
    try:
        loaded = np.load(path, allow_pickle=False)
        stored = {"data": loaded} if isinstance(loaded, np.ndarray) else dict(loaded)
    except ValueError as error:
        raise InputError(
            "not sound, or pickled Python objects, which are not read",
            where=name,
            remedy="save arrays of numbers: np.savez(FILE, t=t, q=q, tau=tau)",
        ) from error
    found: dict[str, np.ndarray | None] = {}
    for key, array in stored.items():
        fields = array.dtype.names
        parts = {f"{key}.{part}": array[part] for part in fields} if fields else {key: array}
        for label, part in parts.items():
            stamped = part.dtype.kind == "M"
            part = part.astype(str).astype(object) if stamped else np.atleast_1d(part)
            found[label] = part if stamped or part.dtype.kind in "iufb" else None
    return found
