"""Coverage-guided fuzzing of everything that reads what a user or a logger wrote (atheris).

Inputs are mutated towards code not reached before. Nothing but `InputError` may come out, each
input must be dealt with in a few seconds, and an expression that is accepted must consist of
known functions and names only. What is found goes into the tests as a case; inputs that failed
are left in the working folder as crash-*, slow-unit-* or timeout-*.

Usage: pip install atheris; python benchmarks/fuzz.py TARGET --seconds 120
       TARGET: toml, session, effect, device, expression, csv, parquet, mat, hdf5, json, tdms, bag,
       db3, mcap, mcap_json
"""

from __future__ import annotations

import argparse
import io
import os
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["bampipe", "tomllib", "nptdms", "mcap", "rosbags"]):
    import mcap.writer
    import nptdms
    from rosbags.rosbag1 import Writer as Ros1Writer
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Ros2Writer
    from rosbags.typesys import Stores, get_typestore

    from bampipe.data.readers import columns_of, read_trial
    from bampipe.data.session import session_from
    from bampipe.physics import expression, registry
    from bampipe.physics.effect import Effect
    from bampipe.physics.units import check_device, check_effect

import h5py
import numpy as np
import pandas as pd
import scipy.io
import sympy as sp

from bampipe.errors import InputError
from bampipe.files import read_toml

ROOT = Path(__file__).parent.parent
COLUMNS = ("time_us", "enc", "force_v")
TOPIC = ("/force:@time", "/force:vector.x", "/force:header.stamp")
NAMES = ("yaw", "pitch", "force", "speed")
SYMBOLS = {name: sp.Symbol(name, real=True) for name in NAMES}
SPECIAL = {"sgn": sp.sign, "ddt": lambda value: sp.diff(value, SYMBOLS["yaw"])}
LONGEST_INPUT = 4096
LONGEST_SECONDS = 10

Check = Callable[[bytes], object]


def from_file(folder: Path, ending: str, columns: tuple[str, ...] = COLUMNS) -> Check:
    """Say what a trial file of this ending holds, and read it."""
    path = folder / f"trial{ending}"

    def check(data: bytes) -> None:
        path.write_bytes(data)
        with suppress(InputError):
            columns_of(path, name="trial")
        trial = read_trial(path, columns, name="trial")
        lengths = {len(values) for values in trial.columns.values()}
        assert len(lengths) == 1 and set(trial.columns) == set(columns)

    return check


def from_toml(folder: Path, use: Callable[[dict[str, object]], object]) -> Check:
    """Read a TOML file, and what it says."""
    path = folder / "file.toml"

    def check(data: bytes) -> None:
        path.write_bytes(data)
        use(read_toml(path))

    return check


def check_expression(data: bytes) -> None:
    """Parse and rebuild an expression."""
    tree = expression.parse(data.decode("utf-8", "replace"), "here")
    value = expression.build(tree, SYMBOLS, "here", SPECIAL)
    assert value.free_symbols <= set(SYMBOLS.values()), value


def use_effect(effect: Effect) -> None:
    """Check an effect in the first place where the BAM can have it."""
    device = registry.device("bam")
    for place in effect.targets(device)[:1]:
        check_effect(effect, device, place)


def sample_table() -> pd.DataFrame:
    """A small sound trial."""
    t = np.arange(12)
    return pd.DataFrame({"time_us": 2000 * t, "enc": t - 5, "force_v": 0.125 * t})


def binary(write: Callable[[io.BytesIO], object]) -> bytes:
    stream = io.BytesIO()
    write(stream)
    return stream.getvalue()


def robot_log(folder: Path, ending: str, packed: bool = False) -> bytes:
    """Five stamped vectors, as ROS 1 (.bag) or ROS 2 (.db3, .mcap) records them."""
    store = get_typestore(Stores.ROS1_NOETIC if ending == ".bag" else Stores.ROS2_HUMBLE)
    types = store.types
    path = folder / f"seed{ending[1:]}{packed:d}"
    if ending == ".bag":
        path = path.with_suffix(".bag")
        writer, write = Ros1Writer(path), store.serialize_ros1
        if packed:
            writer.set_compression(Ros1Writer.CompressionFormat.BZ2)
    else:
        plugin = StoragePlugin.MCAP if ending == ".mcap" else StoragePlugin.SQLITE3
        writer, write = Ros2Writer(path, version=9, storage_plugin=plugin), store.serialize_cdr
    with writer:
        kind = "geometry_msgs/msg/Vector3Stamped"
        link = writer.add_connection("/force", kind, typestore=store)
        for n in range(5):
            more = {"seq": n} if ending == ".bag" else {}
            stamp = types["builtin_interfaces/msg/Time"](n, 10)
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="", **more)
            vector = types["geometry_msgs/msg/Vector3"](0.1 * n, 0.0, 0.0)
            writer.write(link, 10**9 * n, write(types[kind](header, vector), kind))
    if ending != ".bag":
        path = path / f"{path.name}{ending}"
    return path.read_bytes()


def json_log(stream: io.BytesIO) -> None:
    """An MCAP file with JSON messages."""
    writer = mcap.writer.Writer(stream)
    writer.start()
    schema = writer.register_schema("state", "jsonschema", b'{"type": "object"}')
    channel = writer.register_channel("/force", "json", schema)
    for n in range(5):
        data = b'{"vector": {"x": %d}, "header": {"stamp": {"sec": %d, "nanosec": 1}}}' % (n, n)
        writer.add_message(channel, n, data, n)
    writer.finish()


def waves(stream: io.BytesIO) -> None:
    """A TDMS file of two segments."""
    table = sample_table()
    with nptdms.TdmsWriter(stream) as writer:
        for rows in (table[:6], table[6:]):
            channels = [nptdms.ChannelObject("log", c, rows[c].to_numpy()) for c in COLUMNS]
            writer.write_segment(channels)


def datasets(stream: io.BytesIO) -> None:
    """An HDF5 file with plain and packed vectors and text."""
    table = sample_table()
    with h5py.File(stream, "w") as file:
        for name in COLUMNS:
            file.create_dataset(name, data=table[name].to_numpy(), compression="gzip")
        file["when"] = [f"2026-10-03T10:12:0{n % 10}" for n in range(len(table))]


def target(name: str, folder: Path) -> tuple[Check, list[bytes]]:
    """Return what to do with an input, and sound inputs to start from."""
    table = sample_table()
    devices = [p.read_bytes() for p in (ROOT / "bampipe/physics/devices").glob("*.toml")]
    effects = [p.read_bytes() for p in (ROOT / "bampipe/physics/effects").glob("*.toml")]
    sessions = [p.read_bytes() for p in ROOT.glob("sample_runs/*/session.toml")]
    csv = table.to_csv(index=False)
    spoken = [csv, csv.replace(",", ";").replace(".", ","), csv.replace(",", "\t")]
    expressions = [b"-force * exp(-(yaw / speed)**2) * sgn(yaw)", b"clip(yaw, 0, 1) + ddt(yaw)"]
    columns = {name: table[name].to_numpy() for name in COLUMNS}
    channels = tuple(f"log/{name}" for name in COLUMNS)
    targets: dict[str, tuple[Check, list[bytes]]] = {
        "toml": (from_toml(folder, lambda table: table), sessions + effects),
        "session": (from_toml(folder, lambda t: session_from(t, folder, "here")), sessions),
        "device": (
            from_toml(folder, lambda t: check_device(registry.device_from(t, "here"))),
            devices,
        ),
        "effect": (
            from_toml(
                folder,
                lambda t: use_effect(registry.effect_from(t, "here")),
            ),
            effects,
        ),
        "expression": (check_expression, expressions),
        "csv": (from_file(folder, ".csv"), [s.encode() for s in spoken]),
        "json": (
            from_file(folder, ".json"),
            [table.to_json(orient=o).encode() for o in ("records", "split", "columns")],
        ),
        "parquet": (from_file(folder, ".parquet"), [binary(table.to_parquet)]),
        "mat": (
            from_file(folder, ".mat"),
            [
                binary(partial(scipy.io.savemat, mdict=content, do_compression=packed))
                for content in (columns, {"log": columns})
                for packed in (False, True)
            ],
        ),
        "hdf5": (from_file(folder, ".h5"), [binary(datasets)]),
        "tdms": (from_file(folder, ".tdms", channels), [binary(waves)]),
        "mcap_json": (from_file(folder, ".mcap", TOPIC), [binary(json_log)]),
    }
    if name in ("bag", "db3", "mcap"):
        seeds = [robot_log(folder, f".{name}")]
        if name == "bag":
            seeds.append(robot_log(folder, ".bag", packed=True))
        targets[name] = from_file(folder, f".{name}", TOPIC), seeds
    if name not in targets:
        sys.exit(f"no target {name!r}; choose from {', '.join(targets)}")
    return targets[name]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("target")
    parser.add_argument("--seconds", type=int, default=120)
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix=f"bampipe-fuzz-{options.target}-"))
    check, seeds = target(options.target, folder)
    corpus = folder / "corpus"
    corpus.mkdir()
    for number, seed in enumerate(seeds):
        (corpus / f"seed{number}").write_bytes(seed)

    def one(data: bytes) -> None:
        try:
            check(data)
        except InputError as error:
            line = str(error)
            assert line and "\n" not in line and len(line) < 2000, line

    os.chdir(folder)
    print(f"working in {folder}", flush=True)
    arguments = [sys.argv[0], str(corpus), f"-max_total_time={options.seconds}"]
    longest = max(LONGEST_INPUT, 2 * max(map(len, seeds)))
    arguments += [f"-max_len={longest}", f"-timeout={LONGEST_SECONDS}", "-rss_limit_mb=4096"]
    atheris.Setup(arguments, one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
