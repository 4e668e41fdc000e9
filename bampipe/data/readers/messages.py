"""Numbers and times inside the messages of a robot log: objects of rosbags, or parsed JSON."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bampipe.data.readers.moments import NANOSECONDS
from bampipe.errors import InputError

RECORDED = "@time"
STAMP = "header.stamp"
_MOST_ITEMS = 64
_DEEPEST = 6


@dataclass(frozen=True)
class Field:
    """One number of the messages of a topic.

    Attributes:
        topic: name of the topic.
        path: of the number in the message, such as ``wrench.force.x`` or ``position[elbow]``.
    """

    topic: str
    path: str

    @property
    def is_time(self) -> bool:
        """Whether it says when the message was recorded or stamped."""
        return self.path in (RECORDED, STAMP)

    def moment(self, message: Any) -> int | None:
        """Time stamp in the message, ns since 1970; None where it has none."""
        stamp = _get(message, self.path)
        sec = _part(stamp, "sec")
        nanosec = _part(stamp, "nanosec")
        nanosec = _part(stamp, "nsec") if nanosec is None else nanosec
        if not isinstance(sec, int | np.integer) or not isinstance(nanosec, int | np.integer):
            return None
        return int(sec) * NANOSECONDS + int(nanosec)

    def number(self, message: Any, where: str) -> float:
        """The number in a message; NaN where it is null.

        Raises:
            InputError: it is not there, or is no number.
        """
        value = _get(message, self.path)
        if value is None:
            near = [leaf for leaf in leaves(message) if leaf != STAMP][:8]
            raise InputError(
                f"no field '{self.path}'", where=where, remedy=f"it has {', '.join(near)}"
            )
        if isinstance(value, bool | int | float | np.number | np.bool_):
            return float(value)
        raise InputError(f"found {str(value)!r:.40}, expected a number", where=where)


def leaves(message: Any, prefix: str = "", depth: int = 0) -> Iterator[str]:
    """Paths of the numbers and of the time stamp in a message."""
    if prefix == STAMP:
        yield prefix
        return
    names = _part(message, "name")
    for key in _parts(message):
        value = _part(message, key)
        path = f"{prefix}.{key}" if prefix else key
        if isinstance(value, bool | int | float | np.number):
            yield path
        elif isinstance(value, list | tuple | np.ndarray):
            items = list(value)
            numbers = bool(items) and isinstance(items[0], int | float | np.number)
            if not numbers or len(items) > _MOST_ITEMS:
                continue
            named = _is_names(names) and len(names) == len(items)
            yield from (f"{path}[{names[n] if named else n}]" for n in range(len(items)))
        elif depth < _DEEPEST and _parts(value):
            yield from leaves(value, path, depth + 1)


def _is_names(value: Any) -> bool:
    return isinstance(value, list | tuple) and all(isinstance(item, str) for item in value)


def _parts(value: Any) -> list[str]:
    """Names of what an object or a table holds."""
    if isinstance(value, Mapping):
        return [str(key) for key in value]
    return [key for key in getattr(value, "__dataclass_fields__", {}) if not key.startswith("_")]


def _part(value: Any, key: str) -> Any:
    if isinstance(value, Mapping):
        return value.get(key)
    return getattr(value, key, None) if key in _parts(value) else None


def _get(message: Any, path: str) -> Any:
    """What stands at ``path``, None where there is nothing."""
    value, parent = message, message
    for key, item in re.findall(r"([^.\[\]]+)|\[([^\]]+)\]", path):
        if key:
            value, parent = _part(value, key), value
        elif value is not None:
            names = _part(parent, "name")
            place = names.index(item) if _is_names(names) and item in names else None
            if place is None and item.isdigit():
                place = int(item)
            value = value[place] if place is not None and place < len(value) else None
        if value is None:
            return None
    return value
