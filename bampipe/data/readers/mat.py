"""MATLAB files of version 5 to 7.2, and of 7.3 (:mod:`.hdf5`)."""

import math
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from bampipe.data.readers import hdf5
from bampipe.data.readers.arrays import TIME, ArrayReader, Opened, Stored, called_signals, stored
from bampipe.data.readers.trial import Wanted
from bampipe.data.refusals import refusal

_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"}
_NUMBERS |= {12: "i8", 13: "u8"}
_CELL_CLASS, _STRUCT_CLASS, _TEXT_CLASS, _NUMERIC_CLASSES, _OPAQUE_CLASS = 1, 2, 4, range(6, 16), 17
_COMPLEX = 0x0800
_DEEPEST = 8
_MOST_FIELDS = 4096


@contextmanager
def _opened(path: Path, wanted: Wanted | None) -> Iterator[Opened]:
    """The variables of a file; ``S.q`` is a field of ``S``. InputError of another version."""
    for column in wanted.datetimes if wanted else ():
        raise refusal("matlab_moments", f"variable '{column}'")
    if _is_level_5(path):
        arrays, root = _arrays(path)
        whole = {f"{root}{label}": array for label, array in arrays.items()} if wanted else {}
        yield whole | arrays, ()
    else:
        with hdf5.opened(path, wanted) as (known, notes):
            words = {label: array.load() for label, array in known.items() if array.kind == "U"}
            texts = {
                x: "".join(map(chr, w.ravel())) for x, w in words.items() if w.dtype.kind == "u"
            }
            called = called_signals(known, texts)
            yield (
                {
                    name: replace(known[x], unit=known[x].unit or u)
                    for x, (name, u) in called.items()
                },
                notes,
            )


READER = ArrayReader("variable", _opened)


def _is_level_5(path: Path) -> bool:
    with path.open("rb") as stream:
        head = stream.read(1024)
    if hdf5.SIGNATURE in (head[:8], head[512:520]):  # the latter behind MATLAB's user block
        return False
    if len(head) >= _HEADER and head[126:128] in (b"IM", b"MI"):
        return True
    raise refusal("old_matlab")


def _arrays(path: Path) -> tuple[dict[str, Stored], str]:
    """Arrays of a file, each struct followed by what is in it; and what is left out of the names.

    A struct that is all of the file and has a number in its name, as recorders count their files,
    is left out of the names.

    scipy.io reads the same files, but past its buffers where a damaged one lies about a length,
    which ends the process without a word. Source: MathWorks, MAT-File Format, level 5.
    """
    data = memoryview(path.read_bytes())
    order = "<" if bytes(data[126:128]) == b"IM" else ">"
    found: dict[str, np.ndarray | str | None] = {}
    at = _HEADER
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(order + "II", data, at)
        body, at = data[at + 8 : at + 8 + size], at + 8 + size
        if kind == _COMPRESSED:
            kind, body = _Elements(memoryview(zlib.decompress(body)), order).take()
        if kind != _MATRIX or at > len(data):
            raise ValueError("an element is not what it says")
        found |= {label: a for label, a in _Elements(body, order).arrays("", 0) if label}
    return _called(found)


def _called(found: dict[str, np.ndarray | str | None]) -> tuple[dict[str, Stored], str]:
    texts = {label: text for label, text in found.items() if isinstance(text, str) and text}
    lists: dict[str, dict[int, str]] = {}
    for label, text in texts.items():
        if item := re.fullmatch(r"(.+)\[(\d+)\]", label):
            lists.setdefault(item[1], {})[int(item[2])] = text
    for label, value in [*found.items()]:
        sides = value.shape if isinstance(value, np.ndarray) and value.ndim == 2 else (0,)
        inner = label.rpartition(".")[0]
        fitting = (own for x, own in lists.items() if x.rpartition(".")[0] == inner)
        own = next((own for own in fitting if len(set(own.values())) == min(sides) > 1), {})
        if own and isinstance(value, np.ndarray):  # column headers, as importdata stores them
            del found[label]
            table = value if sides[0] >= sides[1] else value.T
            found |= {f"{label}.{own[k]}": table[:, k] for k in sorted(own)}
    whole = {label.partition(".")[0] for label in found}
    root = f"{whole.pop()}." if len(whole) == 1 else ""
    root = root if re.search(r"\d", root) else ""
    arrays: dict[str, Stored] = {}
    for label, (name, unit) in called_signals(found, texts).items():
        value = found[label]
        array = None if isinstance(value, str) else value
        arrays[name.removeprefix(root)] = stored(array, unit)
        # Of several clocks in a struct X, the signals in Y say which is theirs, as dSPACE has it.
        owner, number = label.rpartition(".")[0], found.get(f"{label.removesuffix('Data')}XIndex")
        if isinstance(number, np.ndarray) and number.size == 1:
            clock = f"{owner.rpartition('Y[')[0]}X[{number.item() - 1:.0f}].Data"
            if isinstance(times := found.get(clock), np.ndarray):
                arrays[name.removeprefix(root) + TIME] = stored(times)
    return arrays, root


class _Elements:
    """The elements of an array, one after the other, every length checked."""

    def __init__(self, data: memoryview, order: str) -> None:
        self._data, self._order, self._at = data, order, 0

    def take(self) -> tuple[int, memoryview]:
        """Type and data of the next element."""
        word, size = struct.unpack_from(self._order + "II", self._data, self._at)
        start = self._at + 8
        self._at = start + size + -size % 8
        if word >> 16:  # a small element has its data in the second half of its head
            word, size, self._at, start = word & 0xFFFF, word >> 16, start, start - 4
        if start + size > min(len(self._data), self._at):
            raise ValueError("an element ends early")
        return word, self._data[start : start + size]

    def numbers(self) -> np.ndarray:
        """The next element, of numbers."""
        kind, data = self.take()
        if kind not in _NUMBERS:
            raise ValueError("an element holds no numbers")
        return np.frombuffer(data, dtype=self._order + _NUMBERS[kind])

    def text(self) -> str:
        """The next element, of letters."""
        return bytes(self.take()[1]).decode("utf-8", "replace")

    def arrays(self, label: str, depth: int) -> Iterator[tuple[str, np.ndarray | str | None]]:
        """This array, called ``label`` or as it says itself, and those in its fields."""
        flags = int(self.numbers()[0])
        kind = flags & 0xFF
        extents = [] if kind == _OPAQUE_CLASS else self.numbers().tolist()
        name = self.text()
        label = label or name
        if kind in _NUMERIC_CLASSES and not flags & _COMPLEX:
            yield label, self.numbers().reshape(extents, order="F")
            return
        if kind == _TEXT_CLASS:
            letters = self.take()
            encoding = "utf-16-le" if letters[0] in (4, 17) else "utf-8"
            yield label, bytes(letters[1]).decode(encoding, "replace").strip("\0 ")
            return
        yield label, None
        count, fields = math.prod(extents), [""]
        if kind not in (_CELL_CLASS, _STRUCT_CLASS) or depth >= _DEEPEST:
            return
        if kind == _STRUCT_CLASS:
            width, names = int(self.numbers()[0]), self.text()
            starts = range(0, len(names), width)
            fields = ["." + names[k : k + width].partition("\0")[0] for k in starts]
        if count * len(fields) > _MOST_FIELDS:
            return
        for number in range(count):
            own = label if count == 1 and kind == _STRUCT_CLASS else f"{label}[{number}]"
            for field in fields:
                body = self.take()[1]
                if len(body):
                    yield from _Elements(body, self._order).arrays(own + field, depth + 1)
