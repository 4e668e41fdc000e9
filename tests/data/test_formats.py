"""HDF5, JSON, TDMS, ROS bags and MCAP: files that the libraries of their makers wrote."""

import json
import shutil
import sys
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from binary_logs import write_mcap
from pyarrow import feather

from bampipe.data.readers import columns_of, read_trial
from bampipe.errors import InputError

T = np.arange(50) / 100.0
Q = np.sin(T)
F = np.cos(2 * T)
ROWS = np.column_stack([T, Q, F]).tolist()
STARTED = 1_790_000_000_000_000_000


def refused(path, columns, **options):
    """The one line by which a file is refused."""
    with pytest.raises(InputError) as caught:
        read_trial(path, columns, name=path.name, **options)
    line = str(caught.value)
    assert "\n" not in line and line.startswith(path.name)
    return line


# HDF5


@pytest.fixture
def hdf5(tmp_path) -> Path:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["log/t"] = T
        file["log/force"] = F
        file["log/force"].attrs["unit"] = "N"
        file["log/pose"] = np.column_stack([Q, F, T])
        file["log/text"] = ["x"] * 50
        rows = np.zeros(50, dtype=[("q", "f8"), ("count", "i4")])
        rows["q"], rows["count"] = Q, np.arange(50)
        file["samples"] = rows
        file["soft"] = h5py.SoftLink("/log/t")
        file["far"] = h5py.ExternalLink("/etc/passwd", "/")
        file["short"] = T[:-1]
        file["packed"] = np.rint((Q - 0.5) / 1e-4).astype("i2")
        file["packed"].attrs.update(scale_factor=1e-4, add_offset=0.5, units="rad")
        file["when"] = [f"2026-10-03T10:12:00.{n:02}0" for n in range(50)]
    return path


def test_hdf5(hdf5):
    columns = ("log/t", "log/force", "samples.q", "samples.count", "log/pose[1]")
    trial = read_trial(hdf5, columns)
    for column, values in zip(columns, (T, F, Q, np.arange(50), F), strict=True):
        np.testing.assert_array_equal(trial.columns[column], values)
    assert trial.units == {"log/force": "N"}
    found = columns_of(hdf5)
    assert found["log/force"] == "N" and {*columns, "log/pose[0]", "log/pose[2]"} <= set(found)
    assert not {"soft", "far", "log/text"} & set(found)
    trial = read_trial(hdf5, ("when", "packed"), datetimes={"when": ""})
    np.testing.assert_array_equal(trial.columns["when"], T)
    np.testing.assert_allclose(trial.columns["packed"], Q, atol=6e-5)


@pytest.mark.parametrize(
    ("column", "said"),
    [
        ("log/farce", "no column 'log/farce', did you mean 'log/force'?"),
        ("log", "a structure, expected a vector of numbers; name what is in it: log/force"),
        ("log/pose", "a 50 by 3 array, expected a vector; name one of its columns, as in X[0]"),
        ("log/pose[3]", "has 3 columns, [3] is not among them"),
        ("log/text", "not numbers"),
        ("samples.w", "no column 'samples.w', did you mean"),
        ("soft", "a link, expected numbers in this file"),
        ("far", "a link, expected numbers in this file"),
        ("short", "49 values, where 'log/t' has 50"),
    ],
)
def test_hdf5_refused(hdf5, column, said):
    assert said in refused(hdf5, ("log/t", column))


@pytest.mark.parametrize("compressed", [False, True])
def test_fields_of_matlab_structs(tmp_path, compressed):
    path = tmp_path / "a.mat"
    pair = np.empty(2, dtype=object)
    pair[:] = [T, Q]
    content = {
        "log": {
            "time": T, "name": "run 3", "axis": {"q": Q[:, None], "X": np.column_stack([Q, F])},
            "none": np.empty((0, 0)), "count": np.arange(len(T), dtype=np.int16), "more": {"f": F},
        },
        "runs": np.rec.fromarrays([pair], names="q"),
        "cells": pair,
    }  # fmt: skip
    scipy.io.savemat(path, content, do_compression=compressed)
    wanted = ("log.time", "log.axis.q", "log.axis.X[1]", "log.count", "log.more.f", "runs[1].q")
    trial = read_trial(path, wanted)
    expected = (T, Q, F, np.arange(len(T)), F, Q)
    for name, values in zip(wanted, expected, strict=True):
        np.testing.assert_array_equal(trial.columns[name], values)
    assert {"log.time", "log.axis.X[0]", "log.more.f", "runs[0].q"} <= set(columns_of(path))
    runs = np.zeros(2, dtype=[("t", object), ("q", object)])
    runs[0], runs[1] = (T, Q), (T[:9], Q[:9])
    scipy.io.savemat(tmp_path / "runs.mat", {"runs": runs})
    assert list(columns_of(tmp_path / "runs.mat")) == ["runs[:].t", "runs[:].q"]
    joined = read_trial(tmp_path / "runs.mat", ("runs[:].t", "runs[:].q"))
    assert joined.begun == (len(T),) and len(joined) == len(T) + 9
    np.testing.assert_array_equal(joined.columns["runs[:].q"], np.concatenate([Q, Q[:9]]))
    assert "not numbers" in refused(path, ("log.time", "log.name"))
    assert "did you mean 'log.axis.q'" in refused(path, ("log.time", "log.axis.qq"))
    with h5py.File(tmp_path / "b.mat", "w", userblock_size=512) as file:
        file["log/axis/q"] = Q  # a struct as version 7.3 keeps it
        texts = (np.array([*map(ord, name)], np.uint16) for name in ("arm [deg]", "u [Nm]"))
        for key, pair in {"label": texts, "values": (Q, F)}.items():  # and an array of structs
            held = [file.create_dataset(f"#refs#/{key}{n}", data=x) for n, x in enumerate(pair)]
            for item in held:
                item.attrs["MATLAB_class"] = np.bytes_("char" if key == "label" else "double")
            file[f"log/signals/{key}"] = np.array([[item.ref] for item in held], h5py.ref_dtype)
    assert columns_of(tmp_path / "b.mat")["log/signals.u Nm"] == "Nm"
    trial = read_trial(tmp_path / "b.mat", ("log.axis.q", "log/signals.u Nm"))
    np.testing.assert_array_equal(trial.columns["log.axis.q"], Q)
    np.testing.assert_array_equal(trial.columns["log/signals.u Nm"], F)
    # Gains by axis belong to no sample, and an object of MATLAB has no extents.
    scipy.io.savemat(path, {"q": Q, "tau": F, "scale": 2.0, "gains": np.arange(6.0)})
    body = b"\x06\0\0\0\x08\0\0\0\x11" + bytes(7) + b"\x01\0\x03\0obj\0" + bytes(8)
    with path.open("ab") as file:
        file.write(b"\x0e\0\0\0" + len(body).to_bytes(4, "little") + body)
    assert list(columns_of(path)) == ["q", "tau", "scale"]


# JSON


def test_values_inside_others(tmp_path):
    path = tmp_path / "a.jsonl"
    lines = [
        {"when": f"2026-10-03T10:12:00.{n:02}0Z", "state": {"q": [q, -q]}, "a.b": n}
        for n, q in enumerate(Q)
    ]
    path.write_text("\n".join(map(json.dumps, lines)))
    trial = read_trial(path, ("when", "state.q[1]", "a.b"), datetimes={"when": ""})
    np.testing.assert_array_equal(trial.columns["state.q[1]"], -Q)
    np.testing.assert_array_equal(trial.columns["a.b"], np.arange(50))
    np.testing.assert_array_equal(trial.columns["when"], T)
    assert columns_of(path) == {
        "when": "datetime", "state.q[0]": "", "state.q[1]": "", "a.b": "",
    }  # fmt: skip
    assert "no column 'state.q[2]'" in refused(path, ("when", "state.q[2]"), datetimes={"when": ""})


# Parquet


def test_moments_in_parquet(tmp_path):
    path = tmp_path / "a.parquet"
    when = pd.to_datetime(STARTED + (T * 1e9).astype(np.int64), utc=True)
    pd.DataFrame({"when": when, "q": Q}).to_parquet(path)
    trial = read_trial(path, ("when", "q"), datetimes={"when": ""})
    np.testing.assert_allclose(trial.columns["when"], T, atol=1e-9)
    assert columns_of(path) == {"when": "datetime", "q": ""}
    assert 'say unit = "datetime" under [time]' in refused(path, ("when", "q"))


def test_a_trial_a_row_of_parquet_and_signals_at_rates_of_their_own(tmp_path):
    path, t = tmp_path / "a.parquet", np.arange(200.0)
    pd.DataFrame({"trial": [1, 2], "t": [t, t], "q": [t, -t]}).to_parquet(path)
    trial = read_trial(path, ("trial[:].t", "trial[:].q"))
    np.testing.assert_array_equal(trial.columns["trial[:].q"], np.concatenate([t, -t]))
    assert trial.begun == (200,)
    signals = {"q": {"Time": t, "Data": 2.0 * t}, "u": {"Time": t[::2], "Data": 3.0 * t[::2]}}
    scipy.io.savemat(tmp_path / "a.mat", {"out": signals})
    trial = read_trial(tmp_path / "a.mat", ("out.q.Time", "out.u.Data"))
    np.testing.assert_allclose(trial.columns["out.u.Data"][:-1], 3.0 * t[:-1])
    assert trial.remarks == ("interpolated linearly at the times of the longest: out.u.Data",)
    np.savez(tmp_path / "a.npz", t_q=t, q=2.0 * t, t1=t[::2], u=np.c_[3.0 * t[::2], t[::2]].T)
    assert list(columns_of(tmp_path / "a.npz")) == ["t_q", "q", "u[0]", "u[1]"]
    trial = read_trial(tmp_path / "a.npz", ("t_q", "q", "u[0]"))
    np.testing.assert_allclose(trial.columns["u[0]"][:-1], 3.0 * t[:-1])
    np.savez(tmp_path / "b.npz", t_q=t, q=t, t_u=1e3 * t[::2], u=t[::2])
    assert "its clock goes from 0 to 198000, and that" in refused(tmp_path / "b.npz", ("t_q", "u"))


# TDMS


@pytest.fixture
def tdms(tmp_path) -> Path:
    nptdms = pytest.importorskip("nptdms")
    path = tmp_path / "a.tdms"
    wave = {"wf_increment": 0.01, "wf_start_offset": 0.0, "unit_string": "N"}
    slow = wave | {"wf_increment": 0.02}
    start = np.datetime64("2026-10-03T10:12:00", "us")
    with nptdms.TdmsWriter(str(path)) as writer:
        for part in (slice(0, 30), slice(30, None)):
            writer.write_segment(
                [
                    nptdms.ChannelObject("Log", "Time", T[part]),
                    nptdms.ChannelObject("Log", "Angle", np.arange(50, dtype=np.int32)[part]),
                    nptdms.ChannelObject("DAQ", "Force", F[part], properties=wave),
                    nptdms.ChannelObject("DAQ", "Slow", T[part][::2], properties=slow),
                    nptdms.ChannelObject("Log", "When", start + (T * 1e6).astype(int)[part]),
                ]
            )
    return path


def test_tdms(tdms):
    columns = ("Log/Time", "Log/Angle", "DAQ/Force", "DAQ/Force@time", "DAQ/Slow")
    trial = read_trial(tdms, columns)
    slow = np.append(T[:49], np.nan)  # nothing beyond its last sample
    for column, values in zip(columns, (T, np.arange(50), F, T, slow), strict=True):
        np.testing.assert_allclose(trial.columns[column], values, atol=1e-12)
    assert trial.units == {"DAQ/Force": "N", "DAQ/Force@time": "s", "DAQ/Slow": "N"}
    found = columns_of(tdms)
    assert set(found) == {*columns, "Log/When"} and found["Log/When"] == "datetime"
    trial = read_trial(tdms, ("Log/When", "Log/Angle"), datetimes={"Log/When": ""})
    np.testing.assert_allclose(trial.columns["Log/When"], T, atol=1e-6)


def test_tdms_refused(tdms):
    assert "no column 'Log/Angel', did you mean" in refused(tdms, ("Log/Time", "Log/Angel"))
    assert "no column 'Log/Time@time'" in refused(tdms, ("Log/Time@time",))
    assert 'say unit = "datetime"' in refused(tdms, ("Log/When", "Log/Angle"))
    content = tdms.read_bytes()
    tdms.write_bytes(content[:100])
    refused(tdms, ("Log/Time",))
    tdms.with_suffix(".csv").write_bytes(content)
    assert "this is a TDMS file, not *.csv" in refused(tdms.with_suffix(".csv"), ("t",))


# Workbooks


def test_the_sheet_with_most_rows_of_a_workbook_is_read(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append(["notes of the day"])
    for sheet in (book.create_sheet("log"), book.create_sheet("log 2")):
        sheet.append(["Time [s]", "Force [N]"])
        for row in zip(T, F, strict=True):
            sheet.append([float(x) for x in row])
    path = tmp_path / "a.xlsx"
    book.save(path)
    trial = read_trial(path, ("Time [s]", "Force [N]"))
    np.testing.assert_array_equal(trial.columns["Force [N]"], np.tile(F, 2))
    assert trial.begun == (len(T),)
    beside = book.create_sheet("angle")
    for row in (["Time [s]", "Angle [deg]"], *zip(map(float, T), range(len(T)), strict=True)):
        beside.append(row)
    book.save(path)
    angle = read_trial(path, ("Time [s]", "Angle [deg]")).columns["Angle [deg]"]
    np.testing.assert_array_equal(angle, [*range(len(T)), *range(len(T))])
    path.write_bytes(path.read_bytes()[:900])
    assert "not a sound workbook of Excel" in refused(path, ("Time [s]",))
    book = openpyxl.Workbook()
    for row in (("t", "u", "force"), *((n, n, f"=B{n}*50") for n in range(2, 9))):
        book.active.append(row)
    book.save(path)
    assert "column 'force': formulas without their results" in refused(path, ("t",))


# ROS and MCAP


def write_ros(path: Path, kind: str) -> Path:
    """Joint states at 100 Hz, wrenches at 250 Hz; returns the file to read."""
    pytest.importorskip("rosbags")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    types = store.types
    second = 1_000_000_000

    def header(moment):
        more = {"seq": 0} if kind == "ros1" else {}
        stamp = types["builtin_interfaces/msg/Time"](moment // second, moment % second)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="", **more)

    messages = []
    for n, (q, f) in enumerate(zip(Q, F, strict=True)):
        moment = STARTED + 10_000_000 * n
        effort = np.array([f, 0.0])
        state = types["sensor_msgs/msg/JointState"](
            header(moment), ["elbow", "wrist"], np.array([q, 0.0]), np.empty(0), effort
        )
        messages.append((moment + 1_000_000, "/joint_states", state))
    vector, pair = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Wrench"]
    for n in range(125):
        moment = STARTED + 4_000_000 * n
        wrench = pair(vector(0.004 * n, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        stamped = types["geometry_msgs/msg/WrenchStamped"](header(moment), wrench)
        messages.append((moment + 2_000_000, "/ft/wrench", stamped))
    messages.sort(key=lambda item: item[0])
    if kind == "ros1":
        from rosbags.rosbag1 import Writer

        writer, write, result = Writer(path / "a.bag"), store.serialize_ros1, path / "a.bag"
    else:
        from rosbags.rosbag2 import StoragePlugin, Writer

        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        version = 8 if kind == "humble" else 9  # which records no definitions
        writer = Writer(path / "bag", version=version, storage_plugin=plugin)
        write = store.serialize_cdr
        result = path / "bag" / f"bag.{'mcap' if kind == 'mcap' else 'db3'}"
    with writer:
        links = {}
        for moment, topic, message in messages:
            if topic not in links:
                links[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
            writer.write(links[topic], moment, write(message, message.__msgtype__))
    return result


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "humble", "mcap"])
def test_ros(tmp_path, kind):
    path = write_ros(tmp_path, kind)
    columns = (
        "/joint_states:header.stamp", "/joint_states:position[elbow]", "/joint_states:effort[0]",
        "/ft/wrench:wrench.force.x",
    )  # fmt: skip
    trial = read_trial(path, columns)
    for column, values in zip(columns, (T, Q, F, T), strict=True):
        np.testing.assert_allclose(trial.columns[column], values, atol=1e-9)
    assert trial.remarks == (
        "/ft/wrench interpolated linearly at the times of /joint_states"
        " (at most 0.004 s between its messages)",
    )
    found = columns_of(path)
    assert {"/joint_states:@time", "/joint_states:position[wrist]", *columns[3:]} <= set(found)
    recorded = read_trial(path, ("/joint_states:@time", "/ft/wrench:wrench.force.x")).columns
    # Recorded 1 ms and 2 ms after the stamps; before the first wrench there is none.
    force = recorded["/ft/wrench:wrench.force.x"]
    assert np.isnan(force[0])
    np.testing.assert_allclose(force[1:], T[1:] - 1e-3, atol=1e-9)


def test_messages_in_lists_of_ros_messages(tmp_path):
    pytest.importorskip("rosbags")
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    point, kind = store.types["geometry_msgs/msg/Point32"], "geometry_msgs/msg/Polygon"
    with Writer(tmp_path / "a.bag") as writer:
        link = writer.add_connection("/corners", kind, typestore=store)
        for n in range(3):
            corners = store.types[kind]([point(0.0, 0.0, 0.0), point(float(n), 0.0, 0.0)])
            writer.write(link, n * 10**9, store.serialize_ros1(corners, kind))
    assert "/corners:points[1].x" in columns_of(tmp_path / "a.bag")
    trial = read_trial(tmp_path / "a.bag", ("/corners:@time", "/corners:points[1].x"))
    np.testing.assert_array_equal(trial.columns["/corners:points[1].x"], [0.0, 1.0, 2.0])


def test_ros_refused(tmp_path):
    path = write_ros(tmp_path, "ros1")
    state = "/joint_states:header.stamp"
    assert "did you mean '/joint_states'?" in refused(path, ("/joint_stats:@time",))
    line = refused(path, (state, "/joint_states:position[knee]"))
    assert "no field 'position[knee]'; it has " in line and "position[elbow]" in line
    assert "does not say which field" in refused(path, ("/joint_states",))
    assert "is no time; give /joint_states:@time" in refused(path, ("/joint_states:effort[0]",))
    path.write_bytes(path.read_bytes()[:3000])
    refused(path, (state,))


def write_json_mcap(path: Path, messages: list[tuple[float, dict]]) -> Path:
    """An MCAP file of JSON messages at times in s."""
    stamped = ((STARTED + round(1e9 * t), json.dumps(content).encode()) for t, content in messages)
    with path.open("wb") as stream:
        write_mcap(stream, "/state", stamped)
    return path


def test_two_publishers_on_a_topic_are_told_apart(tmp_path):
    true, false = [], []
    for t, q in zip(T, Q, strict=True):
        both = {"position": [q, 2 * q], "velocity": [], "effort": [3 * q, 4 * q]}
        true.append((t, {"name": ["elbow", "wrist"], **both}))
        zeros = {"position": [0.0, 0.0], "velocity": [], "effort": []}
        false.append((t + 0.003, {"name": ["wrist", "elbow"], **zeros}))
        false.append((t + 0.004, {"name": ["grip"], "position": [t], "velocity": [], "effort": []}))
    path = write_json_mcap(tmp_path / "a.mcap", sorted([*true, *false[:60]], key=lambda m: m[0]))
    names = ("/state:@time", "/state:position[elbow]", "/state:effort[wrist]")
    trial = read_trial(path, names)
    np.testing.assert_allclose(trial.columns[names[0]], T, atol=1e-9)
    np.testing.assert_allclose(trial.columns[names[1]], Q)
    np.testing.assert_allclose(trial.columns[names[2]], 4 * Q)
    (said,) = trial.remarks
    assert "3 kinds of messages on /state" in said and "60 of 110 with other names" in said
    assert "/state:position[grip]" in columns_of(path)
    more = read_trial(path, (*names, "/state:position[grip]"))  # at the times of the others
    inner = slice(1, 29)
    np.testing.assert_allclose(more.columns["/state:position[grip]"][inner], T[inner], atol=0.005)


def test_many_samples_in_a_message(tmp_path):
    """A message a second, with all samples since the one before."""
    t, rate = np.arange(1000) / 100.0, 100
    q = np.sin(t)
    messages = []
    for k in range(0, 1000, rate):
        rows = [{"q": x, "i": 2 * x} for x in q[k : k + rate]]
        dim = [{"size": rate}, {"size": 2}]
        flat = np.column_stack([q, -q])[k : k + rate].ravel().tolist()
        message = {"samples": rows, "t": t[k : k + rate].tolist(), "data": flat, "ok": 1}
        messages.append((float(t[k]), {**message, "layout": {"dim": dim}}))
    path = write_json_mcap(tmp_path / "a.mcap", messages)
    names = ("samples[:].q", "samples[:].i", "t[:]", "data[0::2]", "data[1::2]", "ok")
    assert set(columns_of(path)) >= {f"/state:{name}" for name in names}
    for clock in ("/state:@time", "/state:t[:]"):
        trial = read_trial(path, (clock, *(f"/state:{name}" for name in names if name != clock)))
        np.testing.assert_allclose(trial.columns[clock], t, atol=1e-9)
        np.testing.assert_allclose(trial.columns["/state:samples[:].i"], 2 * q)
        np.testing.assert_allclose(trial.columns["/state:data[1::2]"], -q)
        np.testing.assert_array_equal(trial.columns["/state:ok"], 1.0)


@pytest.mark.parametrize(
    ("content", "names"),
    [
        ({"data": ROWS}, ("data[0]", "data[1]", "data[2]")),
        ({"columns": ["t", "q", "f"], "data": ROWS}, ("t", "q", "f")),
        (
            {"t": T.tolist(), "arm": {"q": Q.tolist(), "f": F.tolist()}, "gains": [1, 2]},
            ("t", "arm.q", "arm.f"),
        ),
    ],
)
def test_json_of_arrays(tmp_path, content, names):
    path = tmp_path / "a.json"
    path.write_text(json.dumps(content | {"dt": 0.01}))
    assert tuple(columns_of(path)) == (*names, "dt")
    trial = read_trial(path, (*names, "dt"))
    for name, values in zip(names, (T, Q, F), strict=True):
        np.testing.assert_array_equal(trial.columns[name], values)
    np.testing.assert_array_equal(trial.columns["dt"], 0.01)
    assert len(read_trial(path, ())) == 0  # as for a file of which only parts are wanted
    assert "no column 'x'" in refused(path, ("x",))


@pytest.mark.parametrize(
    ("lie", "said"), [("summary", "not a sound MCAP file"), ("chunk", "does not fit into memory")]
)
def test_an_mcap_file_whose_summary_lies(tmp_path, lie, said):
    path = write_ros(tmp_path, "mcap")
    content = bytearray(path.read_bytes())
    start = int.from_bytes(content[-28:-20], "little")
    if lie == "summary":  # begins inside a record
        content[-28:-20] = (start + 3).to_bytes(8, "little")
    else:  # the first entry of the index gives the chunk more bytes than there are
        while content[start] != 0x08:
            start += 9 + int.from_bytes(content[start + 1 : start + 9], "little")
        end = start + 9 + int.from_bytes(content[start + 1 : start + 9], "little")
        content[end - 16 : end - 8] = (1 << 50).to_bytes(8, "little")
    path.write_bytes(content)
    assert said in refused(path, ("/joint_states:@time",))
    with pytest.raises(InputError, match=said):
        columns_of(path)


@pytest.mark.parametrize(
    ("ending", "module", "extra"),
    [
        (".tdms", "nptdms", "tdms"), (".bag", "rosbags.highlevel", "ros"),
        (".mcap", "mcap.reader", "ros"), (".xlsx", "openpyxl", "xlsx"),
    ],
)  # fmt: skip
def test_a_missing_extra_names_the_command(tmp_path, monkeypatch, ending, module, extra):
    monkeypatch.setitem(sys.modules, module, None)
    path = tmp_path / f"a{ending}"
    path.write_bytes(b"something")
    line = refused(path, ("/a:b",) if extra == "ros" else ("t",))
    package = module.partition(".")[0]
    assert f"needs {package}, which is not installed; pip install 'bampipe[{extra}]'" in line


def test_units_in_names_and_beside_the_columns_are_heard_in_every_format(tmp_path):
    table, units = {"t [ms]": T, "f (mN.m)": F, "q": Q}, {"q": "deg"}
    frame = pd.DataFrame(table)
    frame.attrs = {"units": units}
    frame.to_parquet(tmp_path / "a.parquet")
    (tmp_path / "b.json").write_text(json.dumps(frame.to_dict("list") | {"units": units}))
    (tmp_path / "c.json").write_text(json.dumps({"q_unit": "deg", "log": frame.to_dict("records")}))
    with h5py.File(tmp_path / "d.h5", "w") as file:
        file["log"] = frame.to_records(index=False)
        file["log"].attrs["units"] = ["", "", "deg"]
    scipy.io.savemat(tmp_path / "e.mat", {"log": {"q": Q, "units": units}})
    feather.write_feather(pq.read_table(tmp_path / "a.parquet"), tmp_path / "f.feather")
    shutil.copy(tmp_path / "d.h5", tmp_path / "g.nc")
    np.savez(tmp_path / "h.npz", q=Q, q_unit="deg")
    units |= {"t [ms]": "ms", "f (mN.m)": "mN.m"}
    for path in tmp_path.iterdir():
        found = {x.removeprefix("log."): unit for x, unit in columns_of(path).items()}
        assert units.items() >= found.items() and found["q"] == "deg"
    for name in ("a.parquet", "f.feather"):
        trial = read_trial(tmp_path / name, ("t [ms]", "q"))
        assert trial.units == {"t [ms]": "ms", "q": "deg"}
        np.testing.assert_array_equal(trial.columns["q"], Q)
    inner = pa.StructArray.from_arrays([pa.array(np.c_[Q, F].tolist())], ["x"])
    table = pa.table({"state": pa.StructArray.from_arrays([inner, pa.array(Q)], ["arm", "q"])})
    for write, name in ((pq.write_table, "k.parquet"), (feather.write_feather, "k.feather")):
        write(table, tmp_path / name)
        assert list(columns_of(tmp_path / name)) == ["state.q", "state.arm.x[0]", "state.arm.x[1]"]
        column = read_trial(tmp_path / name, ["state.arm.x[1]"]).columns["state.arm.x[1]"]
        np.testing.assert_array_equal(column, F)


def test_whole_numbers_are_in_steps_of_the_scale_beside_them(tmp_path):
    """And what may be multiplied already, or whose unit is not known, has no unit that is."""
    counts = np.arange(len(T))
    said = {"q": "0.001 N", "f": "steps of 0.5 of no stated unit", "u": "2.0 N, if not applied"}
    sizes = {"q": 1e-3, "f": 0.5, "u": 2.0}
    held, units = {"q": counts, "f": counts, "u": 0.3 * F}, {"q": "N", "u": "N"}
    beside = {f"{name}_scale": size for name, size in sizes.items()}
    beside |= {f"{name}_unit": unit for name, unit in units.items()}
    np.savez(tmp_path / "a.npz", **held, **beside)
    scipy.io.savemat(tmp_path / "b.mat", held | beside)
    plain = {name: values.tolist() for name, values in held.items()}
    (tmp_path / "c.json").write_text(json.dumps(plain | beside))
    signals = [{"name": n, "data": plain[n], "lsb": sizes[n]} for n in held]
    signals = [{**one, "unit": units.get(one["name"])} for one in signals]
    (tmp_path / "d.json").write_text(json.dumps({"log": signals}))
    with h5py.File(tmp_path / "e.h5", "w") as file:
        for name, values in held.items():
            file[name] = values
            file[name].attrs.update({"scale": sizes[name], "unit": units.get(name, "")})
    stated = {n: {"scale": str(x), "unit": units.get(n, "")} for n, x in sizes.items()}
    kinds = [pa.field(n, pa.array(v).type, metadata=stated[n]) for n, v in held.items()]
    pq.write_table(pa.table([*held.values()], schema=pa.schema(kinds)), tmp_path / "f.parquet")
    for path in sorted(tmp_path.iterdir()):
        found = {x.removeprefix("log."): u for x, u in columns_of(path).items()}
        assert said.items() <= found.items(), path
    np.savez(tmp_path / "g.npz", t=T, q=counts, u=0.3 * F, scale=0.5)
    assert columns_of(tmp_path / "g.npz")["q"].endswith("of no stated unit, if not applied")
    scipy.io.savemat(tmp_path / "h.mat", {"q": counts, "q_unit": "deg", "q_offset": 7})
    assert columns_of(tmp_path / "h.mat")["q"] == "deg, offset [7]"
    np.savez(tmp_path / "i.npz", ep1_t=T, ep1_q=Q, ep2_t=T[9:], ep2_q=Q[9:])
    joined = read_trial(tmp_path / "i.npz", ("ep[:].t", "ep[:].q"))
    np.testing.assert_array_equal(joined.columns["ep[:].q"], np.concatenate([Q, Q[9:]]))
