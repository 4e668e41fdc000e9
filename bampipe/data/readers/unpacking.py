"""What compressed data would unpack to, found before a library allocates it.

A small file can unpack to gigabytes: by damage, or because somebody made it so. A part of a file
may unpack to `MARGIN` or to three times its trial in memory, whichever is more.
"""

from __future__ import annotations

import bz2
import heapq
import struct
import zlib
from io import BytesIO
from pathlib import Path
from typing import IO, BinaryIO

from bampipe.data.readers.extras import need
from bampipe.errors import InputError

MARGIN = 256 << 20
"""Bytes that a chunk, page or text column may take beside its trial: loggers write chunks of some
MB, those with images some tens of MB."""

_STEP = 1 << 20


def check_unpacked(size: int, trial_bytes: int, where: str, what: str) -> None:
    """Raise InputError where ``size`` bytes are far more than a trial of ``trial_bytes`` needs."""
    if size > max(3 * trial_bytes, MARGIN):
        raise InputError(
            f"{what} would unpack to {size / 1e6:.0f} MB, for samples of"
            f" {trial_bytes / 1e6:.3g} MB",
            where=where,
            remedy="is it damaged? export it again, with parts of some MB",
        )


def inflated_size(data: bytes, limit: int) -> int:
    """Bytes that a zlib stream unpacks to; where more than ``limit``, some number above it.

    Raises:
        zlib.error: it is no such stream.
    """
    inflate, size = zlib.decompressobj(), 0
    while data and size <= limit:
        size += len(inflate.decompress(data, _STEP))
        data = inflate.unconsumed_tail
    return size


def check_ros1(path: Path, name: str) -> None:
    """Raise InputError where a chunk of a ROS 1 bag unpacks to more than `MARGIN`.

    A damaged bag raises what struct and the codecs raise.
    """
    with path.open("rb") as stream:
        end = stream.seek(0, 2)
        stream.seek(len("#ROSBAG V2.0\n"))
        while stream.tell() < end:
            (length,) = struct.unpack("<I", stream.read(4))
            header = _ros1_fields(_exactly(stream, length, end))
            (length,) = struct.unpack("<I", stream.read(4))
            codec = header.get(b"compression", b"none").decode("ascii", "replace")
            if header.get(b"op") == b"\x05" and codec != "none":
                _chunk_size(_exactly(stream, length, end), codec, name)
            elif stream.seek(length, 1) > end:
                raise ValueError("a record ends after the file")


def check_mcap(path: Path, largest_bytes: int, name: str) -> None:
    """Raise InputError where an MCAP file unpacks to too much.

    A chunk, and chunks that overlap in time and so are held together, may unpack to `MARGIN`;
    chunks without an index, which are read at once, to ``largest_bytes``. A damaged file raises
    what struct and the codecs raise.
    """
    sizes: dict[int, int] = {}
    spans: list[tuple[int, int, int]] = []
    starts = {0}
    summary = 0
    with path.open("rb") as stream:
        end = stream.seek(0, 2)
        stream.seek(8)
        while stream.tell() < end - 8:
            start = stream.tell()
            starts.add(start)
            kind, length = struct.unpack("<BQ", stream.read(9))
            if stream.tell() + length > end:
                raise ValueError("a record ends after the file")
            if kind == 0x06:
                record = stream.read(length)
                (letters,) = struct.unpack_from("<I", record, 28)
                codec = record[32 : 32 + letters].decode("ascii", "replace")
                sizes[start] = _chunk_size(record[40 + letters :], codec, name) if codec else 0
            elif kind == 0x08:
                record = stream.read(length)
                spans.append(struct.unpack_from("<QQQ", record))
                (packed,) = struct.unpack_from("<Q", record, length - 16)
                if packed > end:
                    raise ValueError("the index names a chunk that is longer than the file")
            elif kind == 0x02:
                (summary,) = struct.unpack("<Q", stream.read(8))
                stream.seek(length - 8, 1)
            else:
                stream.seek(length, 1)
    if summary not in starts:
        raise ValueError("the summary does not begin with a record")
    if not spans:
        check_unpacked(sum(sizes.values()), largest_bytes // 3, name, "a file without an index")
    held: list[tuple[int, int]] = []
    together = 0
    for first, last, offset in sorted(spans):
        if offset not in sizes:
            raise ValueError("the index names a chunk that is not there, or one twice")
        while held and held[0][0] < first:
            together -= heapq.heappop(held)[1]
        size = sizes.pop(offset)
        heapq.heappush(held, (last, size))
        together += size
        check_unpacked(together, 0, name, "chunks of the same time")


def _chunk_size(data: bytes, codec: str, name: str) -> int:
    """Bytes that a chunk unpacks to.

    Raises:
        InputError: more than `MARGIN`, or compressed in an unknown way.
    """
    size = 0
    with _unpacked(data, codec, name) as stream:
        while part := stream.read(_STEP):
            size += len(part)
            if size > MARGIN:
                raise InputError(
                    f"a chunk of {len(data) / 1e3:.1f} kB would unpack to more than"
                    f" {MARGIN >> 20} MB",
                    where=name,
                    remedy="is it damaged? copy it again, or record with smaller chunks",
                )
    return size


def _unpacked(data: bytes, codec: str, name: str) -> IO[bytes]:
    """What ``data`` unpacks to, as a stream."""
    if codec == "bz2":
        return bz2.BZ2File(BytesIO(data))
    if codec == "lz4":
        lz4: IO[bytes] = need("lz4.frame", "ros", name).LZ4FrameFile(BytesIO(data))
        return lz4
    if codec == "zstd":
        decompressor = need("zstandard", "ros", name).ZstdDecompressor()
        zstd: IO[bytes] = decompressor.stream_reader(BytesIO(data), read_across_frames=True)
        return zstd
    raise InputError(f"chunks are compressed as {codec!r:.20}", where=name)


def _ros1_fields(header: bytes) -> dict[bytes, bytes]:
    fields, offset = {}, 0
    while offset < len(header):
        (length,) = struct.unpack_from("<I", header, offset)
        key, _, value = header[offset + 4 : offset + 4 + length].partition(b"=")
        fields[key] = value
        offset += 4 + length
    return fields


def _exactly(stream: BinaryIO, length: int, end: int) -> bytes:
    if stream.tell() + length > end:
        raise ValueError("a record ends after the file")
    return stream.read(length)
