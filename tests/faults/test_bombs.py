"""Small files that unpack to gigabytes: refused, or read, in the memory that their trial takes."""

import bz2
import json
import os
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from binary_logs import write_mcap

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read from /proc")

ROWS = 20_000


def packed_zeros(pack: Any, size: int) -> bytes:
    """``size`` zeros through a compressor object."""
    zeros = bytes(1 << 20)
    return b"".join([*(pack.compress(zeros) for _ in range(size >> 20)), pack.flush()])


def wide_text(path: Path) -> None:
    """500 MB of text in a fixed width."""
    with h5py.File(path, "w") as file:
        file["x"] = np.zeros(ROWS)
        when = file.create_dataset(
            "when", (ROWS,), dtype="S25000", chunks=(1000,), compression="gzip"
        )
        chunk = packed_zeros(zlib.compressobj(), 25_000_000)
        for start in range(0, ROWS, 1000):
            when.id.write_direct_chunk((start,), chunk)


def wide_chunk(path: Path) -> None:
    """Samples with 400 MB of padding in one chunk."""
    kind = np.dtype([("when", "S32"), ("x", "f8"), ("padding", "V20000")])
    with h5py.File(path, "w") as file:
        file.create_dataset(
            "log", (ROWS,), dtype=kind, chunks=(ROWS,), compression="gzip", fillvalue=None
        )
        file["log"].id.write_direct_chunk((0,), packed_zeros(zlib.compressobj(), 1 << 20))


def page(path: Path) -> None:
    """One text of 150 MB in a page."""
    table = pa.table({"when": [" " * 150_000_000], "x": [0.0]})
    pq.write_table(table, path, compression="zstd", use_dictionary=False, write_statistics=False)


def mcap(path: Path) -> None:
    """A chunk of 150 MB, compressed by zstd."""
    size = 150 << 20
    messages = [(0, b'{"x": 1.0}'), (10**9, b'{"x": 1.0' + b" " * size + b"}")]
    with path.open("wb") as stream:
        write_mcap(stream, "/state", messages, chunk_size=size // 2)


def ros1(path: Path) -> None:
    """A chunk of 150 MB."""

    def record(fields: dict[bytes, bytes], data: bytes) -> bytes:
        parts = [struct.pack("<I", len(k + v) + 1) + k + b"=" + v for k, v in fields.items()]
        header = b"".join(parts)
        return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data

    size = 150 << 20
    data = packed_zeros(bz2.BZ2Compressor(), size)
    fields = {b"op": b"\x05", b"compression": b"bz2", b"size": struct.pack("<I", size)}
    start = {b"op": b"\x03", b"index_pos": struct.pack("<Q", 0)}
    start |= {b"conn_count": struct.pack("<I", 0), b"chunk_count": struct.pack("<I", 1)}
    path.write_bytes(b"#ROSBAG V2.0\n" + record(start, b" " * 4027) + record(fields, data))


def messages(kind: str, *fields: str) -> Callable[[Path], None]:
    """A message of 12 bytes that claims billions of items of a type with these fields."""

    def write(path: Path) -> None:
        pytest.importorskip("rosbags")
        from rosbags.rosbag1 import Writer as Ros1Writer
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Ros2Writer
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        store = get_typestore(Stores.EMPTY)
        inner = "\n".join(fields)
        text = f"float64 x\nx/Item[{kind}] items\n{'=' * 80}\nMSG: x/Item\n{inner}"
        store.register(get_types_from_msg(text, "x/msg/Log"))
        writer: Any
        if path.suffix == ".bag":
            writer, made = Ros1Writer(path), path
        else:
            folder = path.with_suffix("")
            plugin = StoragePlugin.MCAP
            writer = Ros2Writer(folder, version=9, storage_plugin=plugin)
            made = folder / path.name
        with writer:
            link = writer.add_connection("/state", "x/msg/Log", typestore=store)
            start = b"" if path.suffix == ".bag" else b"\0\1\0\0"
            writer.write(link, 1, start + struct.pack("<dI", 1.0, 2**31 - 1))
        made.replace(path)

    return write


def brackets(path: Path) -> None:
    """Empty objects: 45 MB of text are 1.2 GB of objects."""
    with path.open("wb") as stream:
        stream.write(b"[{}")
        for _ in range(15):
            stream.write(b",{}" * 1_000_000)
        stream.write(b"]")


def deep_struct(path: Path) -> None:
    """A compressed struct of 240 MB."""
    content = {"when": np.zeros(20), "x": {"q": np.zeros(30_000_000)}}
    scipy.io.savemat(path, content, do_compression=True)


def sound_hdf5(path: Path) -> None:
    """A sound trial of 32 MB in a small file."""
    with h5py.File(path, "w") as file:
        for name in ("when", "x"):
            file.create_dataset(name, data=np.zeros(2_000_000), chunks=True, compression="gzip")


SAMPLES = ("when", "x")
STATE = ("/state:@time", "/state:x")
LACK = ("does not fit into memory", "not a sound")
"""What is said where the memory that a file may take does not suffice, by us or by a library."""
BOMBS: dict[str, tuple[Callable[[Path], None], str, tuple[str, ...]]] = {
    "wide_text.h5": (wide_text, "dates", ("a text of 25000 bytes, expected a date",)),
    "wide_chunk.h5": (wide_chunk, "log", LACK),
    "page.parquet": (page, "dates", LACK),
    "chunk.mcap": (mcap, "state", LACK),
    "bz2.bag": (ros1, "state", LACK),
    "list.bag": (messages(""), "state", LACK),
    "array.mcap": (messages("300000000", "float64 y"), "state", LACK),
    "brackets.json": (brackets, "", LACK),
    "struct.mat": (deep_struct, "", LACK),
    "sound.h5": (sound_hdf5, "", ("2000000 samples",)),
}
MEASURE = """
import json, re, sys
from pathlib import Path
from bampipe.data import readers
from bampipe.errors import InputError
import pandas, h5py, nptdms, mcap.reader, rosbags.highlevel, lz4.frame, zstandard

def memory(kind):
    text = Path("/proc/self/status").read_text()
    return int(re.search(kind + r":\\s*(\\d+) kB", text)[1]) * 1024

readers._LEAST_ROOM, readers._MOST_UNPACKED = 100 << 20, 10
for line in sys.stdin:
    path, columns, options = json.loads(line)
    Path("/proc/self/clear_refs").write_text("5")
    before = memory("VmRSS")
    try:
        trial = readers.read_trial(Path(path), columns, name=Path(path).name, **options)
        said = f"{len(trial.columns[columns[0]])} samples"
        del trial
    except InputError as error:
        said = str(error)
    print(json.dumps([said, memory("VmHWM") - before]), flush=True)
"""


@pytest.fixture(scope="module")
def reader() -> Iterator[subprocess.Popen[str]]:
    """A process that lets small files take 100 MB, reads files and says what came of it."""
    with subprocess.Popen(
        [sys.executable, "-c", MEASURE],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env={**os.environ, "MALLOC_ARENA_MAX": "1", "ARROW_DEFAULT_MEMORY_POOL": "system"},
    ) as process:  # fmt: skip
        yield process
        process.stdin.close()


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_does_not_go_off(name: str, tmp_path: Path, reader: subprocess.Popen[str]) -> None:
    write, kind, words = BOMBS[name]
    path = tmp_path / name
    write(path)
    columns = {"state": STATE, "log": ("log.when", "log.x")}.get(kind, SAMPLES)
    options = {"datetimes": {columns[0]: ""}} if kind in ("dates", "log") else {}
    assert reader.stdin is not None and reader.stdout is not None
    reader.stdin.write(json.dumps([str(path), columns, options]) + "\n")
    reader.stdin.flush()
    line = reader.stdout.readline()
    assert line, "the process died"
    said, peak = json.loads(line)
    assert any(each in said for each in words) and "\n" not in said, said
    assert said.endswith("samples") or said.startswith(name)
    room = max(100 << 20, 10 * path.stat().st_size)
    assert peak < room + (20 << 20), f"{peak >> 20} MB"
