"""Trials fetched when they are wanted: memory grows with the longest of them, not their number."""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar, overload

Item = TypeVar("Item")

MOST_SAMPLES = 500_000
"""Most samples in memory: all of a usual session (0.2 kB each)."""
_SHARE_OF_LONG = 0.1
"""Of that, those used last, of a session that does not fit: it is gone through from its first trial
to its last, so that none would still be there when its turn comes again."""


class TrialCache(Sequence[Item], Generic[Item]):
    """A sequence whose items are fetched by their place, and forgotten when others need the room.

    Args:
        fetch: returns the item at a place; the same one every time.
        count: number of items.
        samples: size of an item, in samples.
        most: samples in memory at most; the item used last always stays.
        names: of the items, where they are known without fetching any.
        in_all: size of all items, where that is known.
    """

    def __init__(
        self,
        fetch: Callable[[int], Item],
        count: int,
        samples: Callable[[Any], int],
        most: int = MOST_SAMPLES,
        names: Sequence[str] = (),
        in_all: int = 0,
    ) -> None:
        self.names = tuple(names)
        self._fetch = fetch
        self._count = count
        self._samples = samples
        self._overflown = in_all > most
        self._most = round(_SHARE_OF_LONG * most) if self._overflown else most
        self._size = 0
        self._items: OrderedDict[int, Item] = OrderedDict()
        self._sizes: dict[int, int] = {}

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, place: int) -> Item: ...
    @overload
    def __getitem__(self, place: slice) -> list[Item]: ...

    def __getitem__(self, place: int | slice) -> Item | list[Item]:
        if isinstance(place, slice):
            return [self[number] for number in range(*place.indices(self._count))]
        if place < 0:
            place += self._count
        if not 0 <= place < self._count:
            raise IndexError(place)
        if place in self._items:
            self._items.move_to_end(place)
            return self._items[place]
        item = self._fetch(place)
        size = self._sizes[place] = self._samples(item)
        if self._items and self._size + size > self._most and not self._overflown:
            self._overflown, self._most = True, round(_SHARE_OF_LONG * self._most)
        while self._items and self._size + size > self._most:
            _, old = self._items.popitem(last=False)
            self._size -= self._samples(old)
        self._items[place] = item
        self._size += size
        return item

    def size(self, place: int) -> int:
        """Samples of the item at a place, which is fetched if it never was."""
        if place not in self._sizes:
            _ = self[place]
        return self._sizes[place]
