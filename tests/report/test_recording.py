"""Recordings of a run for Foxglove and Rerun, opened by the readers of those formats."""

import io
import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import synthetic_run
from made_results import write_result

from bampipe.data.run_folder import RunFolder
from bampipe.data.store import write_parquet
from bampipe.declarations import mcap_file, recording, rerun_file
from bampipe.errors import InputError
from bampipe.results.ingest import IngestResult

CHILD = "base_stribeck_yaw"
ARM = """<?xml version="1.0"?><robot name="arm">
<link name="tool"/><link name="base"/><link name="upper"/><link name="carriage"/>
<joint name="grip" type="fixed"><parent link="carriage"/><child link="tool"/>
<origin xyz="0.1 0.2 0.3" rpy="0.3 -0.2 1.1"/></joint>
<joint name="extension" type="prismatic"><parent link="upper"/><child link="carriage"/>
<origin xyz="0 0.3 0.1" rpy="0.2 0.4 -0.7"/><axis xyz="0 0.6 0.8"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="yaw" type="revolute"><parent link="base"/><child link="upper"/>
<origin xyz="0.2 0 0.4" rpy="-0.5 0.1 0.9"/><axis xyz="1 0 0"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"""


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    return RunFolder(synthetic_run.write_all(tmp_path / "s01"))


def residuals(run: RunFolder, model: str) -> pd.DataFrame:
    return pd.read_parquet(run.path(f"models/{model}/residuals.parquet"))


def test_a_recording_has_every_model_and_a_marker_at_every_worst_window(run: RunFolder) -> None:
    mixed = residuals(run, synthetic_run.CHILD).iloc[::-1]
    write_parquet(run.path(f"models/{synthetic_run.CHILD}/residuals.parquet"), mixed)
    found = recording.gather_recording(run)
    times, columns = found.signals["yaw"]
    assert set(columns) == {
        "measured", "predicted_base", "residual_base", f"predicted_{CHILD}", f"residual_{CHILD}",
    }  # fmt: skip
    assert found.units["yaw"] == "N.m" and found.units["extension"] == "N"
    child = residuals(run, synthetic_run.CHILD).sort_values(["trial_id", "t"])
    np.testing.assert_allclose(columns[f"residual_{CHILD}"], child["residual_yaw"])
    np.testing.assert_allclose(
        columns[f"predicted_{CHILD}"], child["torque_measured_yaw"] - child["residual_yaw"]
    )
    assert np.all(np.diff(times) > 0.0), "trials follow one another"
    starts = [m.time for m in found.markers if m.text.startswith("trial ")]
    first = child["t"].groupby(child["trial_id"]).min()
    assert len(starts) == 3 and starts == sorted(starts)
    diagnosis = json.loads(run.path("models/base/diagnose.json").read_text())
    for window in diagnosis["worst_windows"]:
        trial = list(first.index).index(window["trial_id"])
        at = starts[trial] + window["t_start"] - first.iloc[trial]
        assert any(m.warns and abs(m.time - at) < 1e-6 for m in found.markers)
    assert any(m.warns and diagnosis["axes"]["yaw"]["sentence"] in m.text for m in found.markers)


def test_mcap_holds_what_was_gathered(run: RunFolder) -> None:
    reader = pytest.importorskip("mcap.reader")
    write_result(run.root, IngestResult, **{
        **json.loads(run.path("ingest/session.json").read_text()),
        "recorded_at": "2026-10-03T10:12:00Z",
    })  # fmt: skip
    run.path("ingest/robot.xml").write_text(ARM)
    run = RunFolder(run.root)
    found = recording.gather_recording(run)
    opened = reader.make_reader(io.BytesIO(mcap_file.pack_recording(found)))
    messages: dict[str, list[tuple[int, dict]]] = {}
    schemas = {}
    for schema, channel, message in opened.iter_messages():
        assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
        fields = json.loads(schema.data)["properties"]
        content = json.loads(message.data)
        assert set(content) <= set(fields)
        stamp = content["timestamp"]
        assert stamp["sec"] * 10**9 + stamp["nsec"] == message.log_time
        messages.setdefault(channel.topic, []).append((message.log_time, content))
        schemas[channel.topic] = schema.name
    assert schemas["/markers"] == "foxglove.Log" and schemas["/tf"] == "foxglove.FrameTransforms"
    assert schemas["/robot_description"] == "std_msgs/String"
    base = residuals(run, "base")
    got = [content for _, content in messages["/yaw"]]
    assert [c["measured"] for c in got] == base["torque_measured_yaw"].tolist()
    assert [c["residual_base"] for c in got] == base["residual_yaw"].tolist()
    assert messages["/yaw"][0][0] // 10**9 >= 1790935920  # 2026-10-03T10:12:00Z
    assert [c["message"] for _, c in messages["/markers"]] == [m.text for m in found.markers]
    assert {c["level"] for _, c in messages["/markers"]} == {2, 3}
    (attached,) = opened.iter_attachments()
    assert attached.data.decode() == ARM


def test_rrd_holds_what_was_gathered(run: RunFolder, tmp_path: Path) -> None:
    chunks = pytest.importorskip("rerun.chunk")
    run.path("ingest/robot.xml").write_text(ARM)
    found = recording.gather_recording(run)
    path = tmp_path / "s01.rrd"
    path.write_bytes(rerun_file.pack_recording(found))
    columns: dict[str, list] = {}
    for chunk in chunks.RrdReader(path).stream():
        batch = chunk.to_record_batch().to_pydict()
        for name, values in batch.items():
            if name in ("time", "Scalars:scalars", "TextLog:text", "LineStrips3D:strips"):
                columns.setdefault(f"{chunk.entity_path}:{name}", []).extend(values)
    base = residuals(run, "base")
    got = [value for (value,) in columns["/yaw/residual/residual_base:Scalars:scalars"]]
    assert got == base["residual_yaw"].tolist()
    times = [moment.total_seconds() for moment in columns["/yaw/measured:time"]]
    np.testing.assert_allclose(times, found.signals["yaw"][0], atol=1e-6)
    assert [t for (t,) in columns["/markers:TextLog:text"]] == [m.text for m in found.markers]
    strips = np.array(columns["/robot:LineStrips3D:strips"])
    assert strips.shape == (len(found.times), 3, 2, 3)
    assert np.ptp(strips[:, 1, 1], axis=0).min() > 0.0, "the carriage moves"


def test_links_are_where_pinocchio_puts_them(run: RunFolder) -> None:
    pin = pytest.importorskip("pinocchio")
    run.path("ingest/robot.xml").write_text(ARM)
    found = recording.gather_recording(run)
    motion = pd.read_parquet(run.path("filter/kinematics.parquet"))
    model = pin.buildModelFromXML(ARM)
    data = model.createData()
    step = round(len(motion) / len(found.times))
    assert {frame.child for frame in found.frames} == {"upper", "carriage", "tool"}
    for k in (0, 17, len(found.times) - 1):
        row = motion.iloc[k * step]
        q = np.array([row[f"q_{name}"] for name in model.names[1:]])
        pin.framesForwardKinematics(model, data, q)
        placed = {"base": pin.SE3.Identity()}
        for frame in found.frames:
            turn = pin.Quaternion(frame.turns[k]).matrix()
            placed[frame.child] = placed[frame.parent] * pin.SE3(turn, frame.places[k])
            expected = data.oMf[model.getFrameId(frame.child)]
            np.testing.assert_allclose(placed[frame.child].homogeneous, expected.homogeneous)


def test_the_command_writes_a_recording_and_says_what_it_lacks(
    run: RunFolder, command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    code, said, errors = command("export", run.root, "--as", "mcap", "--out", tmp_path / "a.mcap")
    assert code == 0, errors
    assert said.startswith(f"{tmp_path / 'a.mcap'}: s01, ")
    assert (tmp_path / "a.mcap").read_bytes().startswith(b"\x89MCAP0")
    code, _, errors = command("export", run.root, "--as", "mcp")
    assert code == 2 and "mcap" in errors
    monkeypatch.setitem(sys.modules, "rerun", None)
    code, _, errors = command("export", run.root, "--as", "rrd", "--out", tmp_path / "a.rrd")
    assert code == 2 and "pip install 'bampipe[rerun]'" in errors
    assert not (tmp_path / "a.rrd").exists()
    for path in run.root.glob("models/*/residuals.parquet"):
        path.unlink()
    with pytest.raises(InputError, match="no model has been validated yet"):
        recording.gather_recording(RunFolder(run.root))
