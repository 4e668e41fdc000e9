"""Sequences of large items, such as trials: in memory if small, otherwise in a temporary file."""

import os
import pickle
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Generic, TypeVar, overload

import numpy as np

from bampipe.files import temporary_space

Item = TypeVar("Item")
Value = TypeVar("Value")

MOST_OF_TRIALS = 100_000_000
"""Limit for trials in memory, bytes: half a million samples, which few sessions exceed."""
_MOST = 10_000_000
"""Limit for each quantity computed from the trials, bytes: there are many of these."""


class KeptItems(Sequence[Item], Generic[Item]):
    """A sequence that moves to disk when it exceeds ``most`` bytes; the last item read stays.

    Items are picklable, and bitwise identical when read back. The file has no name: it disappears
    with the last process that holds it, however that process ends. If there is no room for it,
    `InputError` is raised.
    """

    def __init__(self, items: Iterable[Item], most: int = _MOST) -> None:
        self._items: list[Item] = []
        self._places: list[tuple[int, list[int]]] = []
        self._known: dict[Callable[[Item], Any], list[Any]] = {}
        self._last: tuple[int, Any] = (-1, None)
        size = 0
        for item in items:
            self._items.append(item)
            size += sum(part.nbytes for part in _serialise(item))
            if size > most:
                for each in self._items:
                    self._write(each)
                self._items = []

    def _write(self, item: Item) -> None:
        with temporary_space():
            if not self._places:
                with tempfile.TemporaryFile() as file:
                    self._file = os.dup(file.fileno())
                weakref.finalize(self, os.close, self._file)
            parts = _serialise(item)
            end = os.lseek(self._file, 0, os.SEEK_CUR)
            self._places.append((end, [part.nbytes for part in parts]))
            for part in parts:
                while part:
                    part = part[os.write(self._file, part) :]

    def __len__(self) -> int:
        return len(self._places) or len(self._items)

    @overload
    def __getitem__(self, place: int) -> Item: ...
    @overload
    def __getitem__(self, place: slice) -> list[Item]: ...

    def __getitem__(self, place: int | slice) -> Item | list[Item]:
        if isinstance(place, slice):
            return [self[number] for number in range(len(self))[place]]
        if not self._places:
            return self._items[place]
        place = range(len(self))[place]
        if self._last[0] != place:
            self._last = place, self._read(place)
        item: Item = self._last[1]
        return item

    def __iter__(self) -> Iterator[Item]:
        # Iteration holds one item at a time and leaves none in memory.
        return map(self._read, range(len(self))) if self._places else iter(self._items)

    def _read(self, place: int) -> Any:
        at, sizes = self._places[place]
        parts = [np.empty(size, dtype=np.uint8).data for size in sizes]
        for part in parts:
            # Read at an explicit position: worker processes share the file offset.
            while part:
                count = os.preadv(self._file, [part], at)
                part, at = part[count:], at + count
        return pickle.loads(parts[0], buffers=parts[1:])

    def each(self, of: Callable[[Item], Value]) -> list[Value]:
        """Apply a function to each item; the values are cached by function."""
        if of not in self._known:
            self._known[of] = [of(item) for item in self]
        return self._known[of]


def _serialise(item: object) -> list[memoryview]:
    """Pickle an item: the object structure first, then its arrays, which are not copied."""
    buffers: list[pickle.PickleBuffer] = []
    head = pickle.dumps(item, pickle.HIGHEST_PROTOCOL, buffer_callback=buffers.append)
    return [memoryview(head), *(buffer.raw() for buffer in buffers)]
