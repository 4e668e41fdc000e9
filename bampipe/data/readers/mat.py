"""MATLAB files of version 5 to 7.2 (:mod:`.level5`) and 7.3 (:mod:`.hdf5`)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bampipe.data.readers import hdf5, level5
from bampipe.data.readers.arrays import pick, recorded, split_index
from bampipe.data.readers.trial import RawTrial, Wanted, aligned, check_columns, check_size
from bampipe.errors import InputError

_FAULTS = (*hdf5.FAULTS, struct.error)


def is_hdf5(head: bytes) -> bool:
    """Whether a file that begins with ``head`` is HDF5, with or without MATLAB's user block."""
    return hdf5.SIGNATURE in (head[:8], head[512:520])


def read(path: Path, wanted: Wanted, name: str) -> RawTrial:
    """The wanted variables; ``X[0]`` is the first column of ``X``, ``S.q`` a field of ``S``.

    Raises:
        InputError: of another version, damaged, a variable missing, or not a vector of numbers.
    """
    for column in wanted.datetimes:
        raise InputError(
            "dates and times of MATLAB are not read",
            where=f"{name}, variable '{column}'",
            remedy="save seconds: t = seconds(stamp - stamp(1))",
        )
    if _is_level_5(path, name):
        return _read_level_5(path, wanted, name)
    return hdf5.read(path, wanted, name, "variable")


def columns(path: Path, name: str) -> dict[str, str]:
    """Names of the vectors of numbers that were recorded together, or of columns; no units.

    Raises:
        InputError: as :func:`read`.
    """
    if not _is_level_5(path, name):
        return hdf5.columns(path, name)
    with _faults_named(name):
        found = level5.variables(path)
    return dict.fromkeys(recorded({v.name: v.shape for v in found if v.real}), "")


def _is_level_5(path: Path, name: str) -> bool:
    with path.open("rb") as stream:
        head = stream.read(1024)
    if is_hdf5(head):
        return False
    if level5.is_level5(head):
        return True
    raise InputError(
        "not a MATLAB file of version 5 or newer",
        where=name,
        remedy="save it again from MATLAB (-v7)",
    )


def _read_level_5(path: Path, wanted: Wanted, name: str) -> RawTrial:
    with _faults_named(name):
        known = {variable.name: variable for variable in level5.variables(path)}
        values = {}
        for column in wanted.columns:
            variable_name, index = split_index(column, known)
            check_columns(list(known), [variable_name], name)
            variable = known[variable_name]
            where = f"{name}, variable '{column}'"
            inside = [other for other in known if other.startswith(f"{variable_name}.")]
            inside += [other for other in known if other.startswith(f"{variable_name}[0].")]
            if inside:
                raise InputError(
                    "a struct, expected a vector of numbers",
                    where=where,
                    remedy=f"name what is in it: {', '.join(inside[:8])}",
                )
            if not variable.real:
                raise InputError(
                    "not numbers, expected a vector of real numbers",
                    where=where,
                    remedy="save it as a numeric array: cells, tables and objects are not",
                )
            check_size(variable.length, wanted, name)
            flat = level5.values(path, variable)
            shaped = flat.reshape(variable.shape, order="F")
            values[column] = pick(shaped, index, where)
    return RawTrial(aligned(values, name, "variable"), first_row=1)


@contextmanager
def _faults_named(name: str) -> Iterator[None]:
    """Turn what damage raises into InputError."""
    try:
        yield
    except level5.TooLargeError as error:
        raise InputError(str(error), where=name, remedy="save fewer variables") from error
    except _FAULTS as error:
        raise InputError(
            "not a sound MATLAB file", where=name, remedy="save it again from MATLAB"
        ) from error
