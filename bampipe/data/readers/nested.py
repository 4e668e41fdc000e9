"""Values inside others, by their path: ``state.q[0]``, ``wrench.force.x``, ``position[elbow]``.

For parsed JSON and for the message objects of rosbags alike.
"""

import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from bampipe.data.readers.trial import NUMBER
from bampipe.errors import InputError

MISSING = object()
"""Returned by `find` where there is nothing, which is not the same as null."""

_MOST_ITEMS = 64
_DEEPEST = 6
_SPREAD = re.compile(
    r"(?P<list>[^\[\]]+)\[(?::|(?P<start>\d+)::(?P<step>[1-9]\d*))\](?:\.(?P<inner>.+))?"
)


def find(value: Any, path: str) -> Any:
    """Value at ``path``; items of a list go by number, or by a list ``name`` beside it."""
    if isinstance(value, Mapping) and path in value:
        return value[path]
    parent = value
    for key, item in re.findall(r"([^.\[\]]+)|\[([^\]]+)\]", path):
        if key:
            value, parent = _part(value, key), value
        elif isinstance(value, list | tuple | np.ndarray):
            names = _names_beside(parent, value)
            index = names.index(item) if item in names else int(item) if item.isdigit() else -1
            value = value[index] if 0 <= index < len(value) else MISSING
        else:
            return MISSING
    return value


def items(value: Any, path: str) -> list[Any]:
    """Values at ``path`` in every item of a list: ``q[:]``, ``samples[:].q``, ``data[1::3]``.

    The last is every third item from the second on, as of rows of three numbers.
    """
    match = _SPREAD.fullmatch(path)
    if match is None:
        return [find(value, path)]
    found = find(value, match["list"])
    if not isinstance(found, list | tuple | np.ndarray):
        return []
    chosen = found[int(match["start"] or 0) :: int(match["step"] or 1)]
    return [find(item, match["inner"]) for item in chosen] if match["inner"] else list(chosen)


def spread(value: Any, path: str = "") -> Iterator[str]:
    """Paths of the numbers in the items of long lists, for `items`."""
    for key in _keys(value):
        part, inner = _part(value, key), f"{path}.{key}" if path else key
        if isinstance(part, list | tuple | np.ndarray):
            if len(part) <= _MOST_ITEMS:
                continue
            if is_number(part[0]):
                width = _width(value, len(part))
                ends = [f"[{k}::{width}]" for k in range(width)] if width > 1 else ["[:]"]
                yield from (inner + end for end in ends)
            else:
                numbers = (leaf for leaf, item in leaves(part[0]) if is_number(item))
                yield from (f"{inner}[:].{leaf}" for leaf in numbers)
        elif path.count(".") < _DEEPEST:
            yield from spread(part, inner)


def _width(parent: Any, count: int) -> int:
    """Numbers in a row of an array that is written row by row, by the dimensions beside it."""
    sizes = [find(parent, f"layout.dim[{k}].size") for k in range(2)]
    fits = all(isinstance(size, int | np.integer) for size in sizes)
    return int(sizes[1]) if fits and sizes[0] * sizes[1] == count and sizes[1] <= _MOST_ITEMS else 1


def leaves(value: Any, path: str = "", parent: Any = None) -> Iterator[tuple[str, Any]]:
    """Paths of the numbers and texts in ``value``, and these; long lists are left out."""
    if path.count(".") + path.count("[") > _DEEPEST:
        return
    if isinstance(value, list | tuple | np.ndarray):
        if len(value) <= _MOST_ITEMS:
            names = _names_beside(parent, value) or map(str, range(len(value)))
            for name, item in zip(names, value, strict=True):
                yield from leaves(item, f"{path}[{name}]")
    elif isinstance(value, Mapping) or _keys(value):
        for key in _keys(value):
            yield from leaves(_part(value, key), f"{path}.{key}" if path else key, value)
    elif path:
        yield path, value


def names_in(message: Any) -> tuple[str, ...]:
    """The list ``name`` of a message, where it is one of texts; else nothing."""
    names = _part(message, "name")
    listed = isinstance(names, list | tuple) and all(isinstance(name, str) for name in names)
    return tuple(names) if listed else ()


def _names_beside(parent: Any, values: Any) -> list[str]:
    """Names of the items of ``values``, from a list ``name`` of as many texts; [] without one."""
    names = names_in(parent)
    return list(names) if len(names) == len(values) and list(names) != list(values) else []


def _keys(value: Any) -> list[str]:
    """Names in an object or a table."""
    if isinstance(value, Mapping):
        return [str(key) for key in value]
    return [key for key in getattr(value, "__dataclass_fields__", {}) if not key.startswith("_")]


def _part(value: Any, key: str) -> Any:
    if isinstance(value, Mapping):
        return value.get(key, MISSING)
    return getattr(value, key, MISSING) if key in _keys(value) else MISSING


def is_number(value: Any) -> bool:
    """Whether a value is a number rather than a text of one."""
    return isinstance(value, int | float | np.number)


def reads_as_number(value: Any) -> bool:
    """Whether a value is a number, or a text of one, as some programs write them into JSON."""
    return is_number(value) or (isinstance(value, str) and bool(re.fullmatch(NUMBER, value)))


def as_number(cell: Any, where: str) -> float:
    """A value as a number: null is missing, true is 1.

    Raises:
        InputError: it is no number.
    """
    if cell is None:
        return float("nan")
    if not (reads_as_number(cell) or isinstance(cell, np.bool_)):
        raise InputError(f"found {str(cell)[:40]!r}, expected a number", where=where)
    try:
        return float(cell)
    except OverflowError as error:
        raise InputError("found a number beyond all range", where=where) from error
