"""Variables that are vectors, or columns of a matrix named as ``X[0]``; arrays as NumPy saves them.

Of ``.npy`` with one array, and ``.npz`` with several by name; fields of a structured array are
columns, too. Pickled objects, which may run any program, are not read.
"""

import re
from collections.abc import Container, Mapping
from pathlib import Path

import numpy as np

from bampipe.data.readers import moments
from bampipe.data.readers.trial import RawTrial, Wanted, aligned, check_columns, check_size
from bampipe.errors import InputError

LARGEST_WIDTH = 64
_STAMPED = "MO"
"""Kinds of arrays of dates and times: NumPy's own, and of texts."""
RUN = re.compile(
    r"(?i)(.+?(?=\[)|(?:.*[./_])?(?:trial|run|rep|test|take|rec|recording|exp|experiment|measurement"
    r"|messung|versuch|essai|episode|demo|trajectory|traj|log)s?_?(?=\d))"
    r"(?:\[([^\[\]:]+)\]|(\d+))[./]([^\[\]]+)"
)
"""Name of an array of one of several recordings in a file."""
_TIMES = re.compile(r"(?i)\]\.(t|.*time.*|.*stamp.*)\Z")


def read_arrays(
    arrays: Mapping[str, np.ndarray | None], wanted: Wanted, name: str, what: str
) -> RawTrial:
    """The wanted columns of the arrays of a file, runs of one recording end to end.

    Args:
        arrays: by name, of numbers, moments, or texts that are moments; None for what is neither.
        wanted: columns; name, what: of the file and of its arrays, in messages.

    Raises:
        InputError: an array is missing, not a vector of numbers, or not as long as the others.
    """
    joined, begun = _join_runs(arrays)
    known, values = {**arrays, **joined}, {}
    for column in wanted.columns:
        variable, index = split_index(column, known)
        check_columns(list(known), [variable], name)
        array, where = known[variable], f"{name}, {what} '{column}'"
        if array is None:
            _refuse_kind(variable, known, where)
        elif column in wanted.datetimes:
            if array.dtype.kind not in _STAMPED:
                raise InputError("not text, expected dates and times", where=where)
            stamps = array if array.dtype.kind == "M" else array.tolist()
            stamps = moments.nanoseconds(stamps, wanted.datetimes[column], where)
            values[column] = moments.seconds(stamps)
        elif array.dtype.kind in _STAMPED:
            raise InputError(
                "found dates and times, or text; expected numbers",
                where=where,
                remedy='is it the time? then say unit = "datetime" under [time]',
            )
        else:
            check_size(array.size, wanted, name)
            # A copy: what stands in a file cannot be written to.
            values[column] = np.array(pick(array, index, where), dtype=np.float64)
    starts = next((begun[column] for column in wanted.columns if column in begun), ())
    return RawTrial(aligned(values, name, what), first_row=1, begun=starts)


def _refuse_kind(variable: str, known: Mapping[str, object], where: str) -> None:
    inside = [other for other in known if other.startswith((f"{variable}.", f"{variable}[0]."))]
    if inside:
        raise InputError(
            "a struct, expected a vector of numbers",
            where=where,
            remedy=f"name what is in it: {', '.join(inside[:8])}",
        )
    raise InputError(
        "not numbers, expected a vector of real numbers",
        where=where,
        remedy="save it as a numeric array: cells, tables and objects are not",
    )


def columns_of_arrays(arrays: Mapping[str, np.ndarray | None]) -> dict[str, str]:
    """Names of the columns that were recorded together; the unit of moments is "datetime"."""
    joined = _join_runs(arrays)[0]
    moment = {label for label, array in joined.items() if array.dtype.kind in _STAMPED}
    found = recorded({label: array.shape for label, array in joined.items()})
    return {column: "datetime" if column in moment else "" for column in found}


def split_index(column: str, names: Container[str]) -> tuple[str, int | None]:
    """``("X", 2)`` for ``X[2]``, where there is no variable of that whole name."""
    match = re.fullmatch(r"(.+)\[(\d{1,3})\]", column)
    if column in names or match is None:
        return column, None
    return match[1], int(match[2])


def pick(values: np.ndarray, index: int | None, where: str) -> np.ndarray:
    """The vector, or column ``index`` of a matrix (counted along its shorter side, from 0).

    Raises:
        InputError: a matrix without an index, or an index that is too large.
    """
    sides = [extent for extent in values.shape if extent != 1] if 0 not in values.shape else []
    if index is None:
        if len(sides) > 1:
            shown = " by ".join(map(str, values.shape))
            raise InputError(
                f"a {shown} array, expected a vector",
                where=where,
                remedy="name one of its columns, as in X[0]" if len(sides) == 2 else "",
            )
        return values.ravel()
    if len(sides) > 2 or not sides:
        raise InputError("has no columns to choose from", where=where)
    table = values.reshape(sides) if len(sides) == 2 else values.reshape(-1, 1)
    table = table if table.shape[0] >= table.shape[1] else table.T
    if index >= table.shape[1]:
        raise InputError(f"has {table.shape[1]} columns, [{index}] is not among them", where=where)
    return np.ascontiguousarray(table[:, index])


def labels(name: str, shape: tuple[int, ...]) -> list[str]:
    """What the columns of a variable are called: its name, or ``name[0]``, ``name[1]``, ..."""
    sides = [extent for extent in shape if extent != 1]
    if 0 in shape or len(sides) > 2:
        return []
    if len(sides) < 2:
        return [name]
    return [f"{name}[{k}]" for k in range(min(sides))] if min(sides) <= LARGEST_WIDTH else []


def _join_runs(
    arrays: Mapping[str, np.ndarray | None],
) -> tuple[dict[str, np.ndarray], dict[str, tuple[int, ...]]]:
    """Vectors of one name in all structs of a list, end to end: ``runs[:].q`` of ``runs[0].q``.

    And of groups that are called trials by a number, as ``run1.q``. Of structs that each have a
    time, or are as long as no other; others are rather joints. All arrays, and by the name of each
    that was joined the samples before which one begins.
    """
    found = {label: array for label, array in arrays.items() if array is not None}
    begun: dict[str, tuple[int, ...]] = {}
    runs: dict[str, dict[str, str]] = {}
    for label, array in found.items():
        match = RUN.fullmatch(label)
        if match and len(labels("", array.shape)) == 1 < array.size:
            runs.setdefault(f"{match[1]}[:].{match[4]}", {})[match[2] or match[3]] = label
    timed = {name.partition("[")[0]: list(own) for name, own in runs.items() if _TIMES.search(name)}
    for name, own in runs.items():
        parts = [found[label].ravel() for label in own.values()]
        times = timed.get(name.partition("[")[0])
        alike = len({part.size for part in parts}) == 1 and times is None
        if alike or len(own) < 2 or list(own) != (times or list(own)):
            continue
        found = {label: array for label, array in found.items() if label not in own.values()}
        found[name] = np.concatenate(parts)
        begun[name] = tuple(map(int, np.cumsum([part.size for part in parts[:-1]])))
    return found, begun


def _refuse_blocks(arrays: Mapping[str, np.ndarray | None], name: str) -> None:
    """Refuse a file whose arrays all have three dimensions or more."""
    blocks = {label: a.shape for label, a in arrays.items() if a is not None and a.ndim > 2}
    if blocks and len(blocks) == len(arrays):
        label, shape = next(iter(blocks.items()))
        raise InputError(
            f"'{label}' is a {' by '.join(map(str, shape))} array, of which no side is said to be"
            " the samples",
            where=name,
            remedy="save each trial as an array of its own, samples by channels",
        )


def recorded(shapes: Mapping[str, tuple[int, ...]]) -> list[str]:
    """Labels of the variables that were recorded together, and of numbers that stand alone.

    Beside a log a file may keep what belongs to no sample: gains by axis, a table of settings.
    """
    by_length: dict[int, list[str]] = {}
    for name, shape in shapes.items():
        by_length.setdefault(max(shape, default=1), []).extend(labels(name, shape))
    longer = [length for length in by_length if length > 1]
    samples = max(longer, key=lambda length: (len(by_length[length]), length), default=1)
    kept = {*by_length.get(1, ()), *by_length.get(samples, ())}
    return [x for name, shape in shapes.items() for x in labels(name, shape) if x in kept]


def read(path: Path, wanted: Wanted, name: str) -> RawTrial:
    """The wanted arrays; ``data[0]`` is the first column of the one array of a ``.npy``.

    Raises:
        InputError: damaged, pickled, an array missing, or not a vector of numbers.
    """
    return read_arrays(_arrays(path, name), wanted, name, "array")


def columns(path: Path, name: str) -> dict[str, str]:
    """Names of the vectors of numbers that were recorded together, or of columns; no units."""
    arrays = _arrays(path, name)
    _refuse_blocks(arrays, name)
    return columns_of_arrays(arrays)


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
            found[label] = np.atleast_1d(part) if part.dtype.kind in "iufbM" else None
    return found
