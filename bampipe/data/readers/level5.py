"""Real vectors in MATLAB files of version 5 to 7.2, read with every length checked.

scipy.io reads the same files, but writes and reads past its buffers where a damaged file lies
about a length, which ends the process without a word. Only what a log needs is read here: real
numeric arrays, also those in the fields of structs. Source: MathWorks, MAT-File Format, level 5.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"}
_NUMBERS |= {12: "i8", 13: "u8"}
_STRUCT_CLASS = 2
_NUMERIC_CLASSES = range(6, 16)
_OPAQUE_CLASS = 17
_COMPLEX = 0x0800
_HEADER = 128
_LARGEST_HEAD = 4096
_CHUNK = 1 << 16
_LARGEST_INFLATED = 8 << 30
"""Bytes of compressed variables that are gone through, at most: half a minute."""
_DEEPEST = 8
_MOST_FIELDS = 4096


class TooLargeError(Exception):
    """The variables of a file unpack to more than is gone through; the text says to what."""


@dataclass(frozen=True)
class MatVariable:
    """One variable of a file, or one field of a struct.

    Attributes:
        name: of the variable; of a field ``struct.field``, in an array of structs
            ``struct[0].field``.
        shape: of the array.
        real: whether it is an array of real numbers.
        start, size: of the element of the variable in the file, bytes.
        compressed: whether that element is compressed.
        within: bytes of that element, inflated, before the array itself.
    """

    name: str
    shape: tuple[int, ...]
    real: bool
    start: int
    size: int
    compressed: bool
    within: int = 0

    @property
    def length(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)


def is_level5(head: bytes) -> bool:
    """Whether a file that begins with ``head`` is of MATLAB 5 to 7.2 (or claims to be)."""
    return len(head) >= _HEADER and head[126:128] in (b"IM", b"MI")


def variables(path: Path) -> list[MatVariable]:
    """The variables of the file, in its order, each struct followed by what is in it.

    Raises:
        ValueError: the file is damaged.
        TooLargeError: it would unpack to gigabytes.
    """
    found = []
    inflated = 0
    with path.open("rb") as stream:
        order = _order(stream)
        end = stream.seek(0, 2)
        offset = _HEADER
        while offset + 8 <= end:
            stream.seek(offset)
            kind, size = struct.unpack(order + "II", stream.read(8))
            offset += 8
            if size > end - offset or kind not in (_MATRIX, _COMPRESSED):
                raise ValueError("an element is not what it says")
            source = _Source(stream, offset, size, kind == _COMPRESSED, order)
            variable = MatVariable("", (), False, offset, size, kind == _COMPRESSED)
            source.most = _LARGEST_INFLATED - inflated
            found += [item for item in _arrays(source, variable, "", 0) if item.name]
            inflated += source.position if variable.compressed else 0
            offset += size
    return found


def _arrays(
    source: _Source, variable: MatVariable, label: str, depth: int
) -> Iterator[MatVariable]:
    """The array that comes next, and where it is a struct, those in its fields.

    Args:
        source: at the beginning of an array.
        variable: that holds it, for where it is in the file.
        label: what the array is called; "" for a variable, which has a name of its own.
        depth: how many structs it is inside of.

    Raises:
        ValueError: the file is damaged.
    """
    within = source.position
    name, shape, real, kind = source.matrix_head()
    label = label or name
    yield replace(variable, name=label, shape=shape, real=real, within=within)
    if kind != _STRUCT_CLASS or depth >= _DEEPEST:
        return
    fields = source.field_names()
    count = math.prod(shape)
    if count * len(fields) > _MOST_FIELDS:
        return
    for number in range(count):
        own = label if count == 1 else f"{label}[{number}]"
        for field in fields:
            size = source.array_size()
            end = source.position + size
            if size:
                yield from _arrays(source, variable, f"{own}.{field}", depth + 1)
            source.skip(end - source.position)


def values(path: Path, variable: MatVariable) -> np.ndarray:
    """The elements of one real variable, in column-major order, as (n,) float64.

    Raises:
        ValueError: the file is damaged.
    """
    with path.open("rb") as stream:
        source = _Source(stream, variable.start, variable.size, variable.compressed, _order(stream))
        source.skip(variable.within)
        source.matrix_head()
        kind, data = source.element(8 * variable.length)
        if kind not in _NUMBERS:
            raise ValueError(f"'{variable.name}' holds no numbers")
        numbers = np.dtype(source.order + _NUMBERS[kind])
        if len(data) != variable.length * numbers.itemsize:
            raise ValueError(f"'{variable.name}' is not as long as it says")
        return np.frombuffer(data, dtype=numbers).astype(np.float64)


def _order(stream: BinaryIO) -> str:
    """Byte order of a file, as struct and numpy write it."""
    stream.seek(126)
    return "<" if stream.read(2) == b"IM" else ">"


class _Source:
    """The bytes of one variable's element, inflated where it is compressed."""

    def __init__(
        self, stream: BinaryIO, start: int, size: int, compressed: bool, order: str
    ) -> None:
        self._stream = stream
        self._next, self._left = start, size
        self._inflate = zlib.decompressobj() if compressed else None
        self._ahead = b""
        self.position = 0
        self.most = _LARGEST_INFLATED
        self.order = order
        if compressed and struct.unpack(order + "II", self._take(8))[0] != _MATRIX:
            raise ValueError("a compressed element holds no array")
        self.position = 0

    def matrix_head(self) -> tuple[str, tuple[int, ...], bool, int]:
        """Name and shape of the array, whether it holds real numbers, and its class."""
        _, flags = self.element(_LARGEST_HEAD)
        if len(flags) == 8 and struct.unpack(self.order + "II", flags)[0] & 0xFF == _OPAQUE_CLASS:
            _, name = self.element(_LARGEST_HEAD)  # an object of MATLAB, without extents
            return name.decode("utf-8", "replace"), (), False, _OPAQUE_CLASS
        _, shape = self.element(_LARGEST_HEAD)
        _, name = self.element(_LARGEST_HEAD)
        if len(flags) != 8 or len(shape) % 4 or len(shape) < 8:
            raise ValueError("an array is not what it says")
        word = struct.unpack(self.order + "II", flags)[0]
        extents = struct.unpack(f"{self.order}{len(shape) // 4}i", shape)
        if min(extents) < 0:
            raise ValueError("an array has a negative size")
        real = word & 0xFF in _NUMERIC_CLASSES and not word & _COMPLEX
        return name.decode("utf-8", "replace"), extents, real, word & 0xFF

    def field_names(self) -> list[str]:
        """Names of the fields of the struct whose head was read last."""
        _, width = self.element(_LARGEST_HEAD)
        _, names = self.element(_CHUNK)
        length = struct.unpack(self.order + "i", width)[0] if len(width) == 4 else 0
        if length < 1 or len(names) % length:
            raise ValueError("a struct is not what it says")
        parts = [names[k : k + length] for k in range(0, len(names), length)]
        return [part.partition(b"\0")[0].decode("utf-8", "replace") for part in parts]

    def array_size(self) -> int:
        """Bytes of the array in a field, whose tag comes next; 0 where the field is empty."""
        kind, size = struct.unpack(self.order + "II", self._take(8))
        if kind != _MATRIX:
            raise ValueError("a field holds no array")
        return int(size)

    def skip(self, size: int) -> None:
        """Pass over bytes."""
        if size < 0:
            raise ValueError("an array is longer than it says")
        while size:
            size -= len(self._take(min(size, _CHUNK)))

    def element(self, limit: int) -> tuple[int, bytes]:
        """Type and data of the next element, of ``limit`` bytes at most."""
        head = self._take(8)
        word, size = struct.unpack(self.order + "II", head)
        if word >> 16:  # a small element has its data in the second half of its head
            kind, size = word & 0xFFFF, word >> 16
            if size > 4:
                raise ValueError("a small element is larger than four bytes")
            return kind, head[4 : 4 + size]
        if size > limit:
            raise ValueError("an element is larger than it should be")
        data = self._take(size)
        if size <= _LARGEST_HEAD and size % 8:
            self._take(-size % 8, exactly=False)
        return word, data

    def _take(self, size: int, exactly: bool = True) -> bytes:
        inflate = self._inflate
        data = self._raw(size) if inflate is None else self._inflated(size, inflate)
        if exactly and len(data) != size:
            raise ValueError("an element ends early")
        self.position += len(data)
        return data

    def _raw(self, size: int) -> bytes:
        self._stream.seek(self._next)
        data = self._stream.read(min(size, self._left))
        self._next += len(data)
        self._left -= len(data)
        return data

    def _inflated(self, size: int, inflate: zlib._Decompress) -> bytes:
        if self.position + size > self.most:
            raise TooLargeError(
                f"its variables would unpack to more than {_LARGEST_INFLATED >> 20} MB"
            )
        parts = []
        while size:
            if not self._ahead:
                self._ahead = self._raw(_CHUNK)
            part = inflate.decompress(self._ahead, size)
            self._ahead = inflate.unconsumed_tail
            if not part and not self._ahead and not self._left:
                break
            parts.append(part)
            size -= len(part)
        return b"".join(parts)
