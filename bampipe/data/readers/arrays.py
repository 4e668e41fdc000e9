"""Variables that are vectors, or columns of a matrix named as ``X[0]``."""

from __future__ import annotations

import re
from collections.abc import Container, Mapping

import numpy as np

from bampipe.errors import InputError

LARGEST_WIDTH = 64
_TIMES = re.compile(r"(?i)\]\.(t|.*time.*|.*stamp.*)\Z")


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


def join_runs(
    arrays: Mapping[str, np.ndarray],
) -> tuple[dict[str, np.ndarray], dict[str, tuple[int, ...]]]:
    """Vectors of one name in all structs of a list, end to end: ``runs[:].q`` of ``runs[0].q``.

    Of structs that each have a time, or are as long as no other; others are rather joints.

    Returns:
        All arrays, and by the name of each that was joined the samples before which one begins.
    """
    runs: dict[str, dict[int, str]] = {}
    for label in arrays:
        match = re.fullmatch(r"(.+?)\[(\d+)\]\.([^\[\]]+)", label)
        if match and len(labels("", arrays[label].shape)) == 1 < arrays[label].size:
            runs.setdefault(f"{match[1]}[:].{match[3]}", {})[int(match[2])] = label
    timed = {name.partition("[")[0] for name in runs if _TIMES.search(name)}
    found, begun = dict(arrays), {}
    for name, own in runs.items():
        parts = [arrays[label].ravel() for label in own.values()]
        alike = len({part.size for part in parts}) == 1 and name.partition("[")[0] not in timed
        if alike or len(own) < 2 or list(own) != list(range(len(own))):
            continue
        found = {label: array for label, array in found.items() if label not in own.values()}
        found[name] = np.concatenate(parts)
        begun[name] = tuple(map(int, np.cumsum([part.size for part in parts[:-1]])))
    return found, begun


def recorded(shapes: Mapping[str, tuple[int, ...]]) -> list[str]:
    """Labels of the variables that were recorded together, and of numbers that stand alone.

    Beside a log a file may keep what belongs to no sample: gains by axis, a table of settings.

    Args:
        shapes: by name of the variable.
    """
    by_length: dict[int, list[str]] = {}
    for name, shape in shapes.items():
        by_length.setdefault(max(shape, default=1), []).extend(labels(name, shape))
    longer = [length for length in by_length if length > 1]
    samples = max(longer, key=lambda length: (len(by_length[length]), length), default=1)
    kept = {*by_length.get(1, ()), *by_length.get(samples, ())}
    return [x for name, shape in shapes.items() for x in labels(name, shape) if x in kept]
