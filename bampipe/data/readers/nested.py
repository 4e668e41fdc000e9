"""Values inside others, by their path: ``state.q[0]``, ``wrench.force.x``, ``position[elbow]``.

For parsed JSON and for the message objects of rosbags alike.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from bampipe.errors import InputError

MISSING = object()
"""What `find` returns where there is nothing, which is not the same as null."""

_MOST_ITEMS = 64
_DEEPEST = 6


def find(value: Any, path: str) -> Any:
    """What stands at ``path``; an item of a list by its number, or by a list ``name`` beside it."""
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


def _names_beside(parent: Any, values: Any) -> list[str]:
    """Names of the items of ``values``, from a list ``name`` of as many texts; [] without one."""
    names = _part(parent, "name")
    fits = isinstance(names, list | tuple) and names is not values and len(names) == len(values)
    return list(names) if fits and all(isinstance(name, str) for name in names) else []


def _keys(value: Any) -> list[str]:
    """Names of what an object or a table holds."""
    if isinstance(value, Mapping):
        return [str(key) for key in value]
    return [key for key in getattr(value, "__dataclass_fields__", {}) if not key.startswith("_")]


def _part(value: Any, key: str) -> Any:
    if isinstance(value, Mapping):
        return value.get(key, MISSING)
    return getattr(value, key, MISSING) if key in _keys(value) else MISSING


def as_number(cell: Any, where: str) -> float:
    """A value as a number: null is missing, true is 1.

    Raises:
        InputError: it is no number.
    """
    if cell is None:
        return float("nan")
    if not isinstance(cell, bool | int | float | np.number | np.bool_):
        raise InputError(f"found {str(cell)[:40]!r}, expected a number", where=where)
    try:
        return float(cell)
    except OverflowError as error:
        raise InputError("found a number beyond all range", where=where) from error
