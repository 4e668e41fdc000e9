"""Data sets in the layout of LeRobot v3.0: vectors by name, an episode a trial."""

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from bampipe.data.readers import columns_of, read_trial
from bampipe.data.recording import read_recording
from bampipe.data.session import TrialEntry
from bampipe.data.session.channels import Clock
from bampipe.data.survey import survey
from bampipe.errors import InputError
from bampipe.setup.proposal import propose

FPS, PER_FILE = 50, 3
JOINTS = ["shoulder_pan.pos", "elbow_flex.pos"]
COUNTS = ("frame_index", "episode_index", "index", "task_index")


def write_dataset(root, episodes, names, version="v3.0"):
    """Write ``episodes``, each vectors (T, n) by feature, as LeRobot writes them: files of several
    episodes under data/, their rows under meta/episodes, the names in meta/info.json."""
    for folder in ("meta/episodes/chunk-000", "data/chunk-000"):
        (root / folder).mkdir(parents=True)
    rows, at = [], 0
    for file, first in enumerate(range(0, len(episodes), PER_FILE)):
        parts = []
        for number in range(first, min(first + PER_FILE, len(episodes))):
            episode = episodes[number]
            n = len(episode["observation.state"])
            columns = {
                name: pa.FixedSizeListArray.from_arrays(
                    pa.array(values.astype(np.float32).ravel()), values.shape[1]
                )
                for name, values in episode.items()
            }
            columns["timestamp"] = pa.array((np.arange(n) / FPS).astype(np.float32))
            counts = (np.arange(n), np.full(n, number), np.arange(at, at + n), np.zeros(n, int))
            columns |= dict(zip(COUNTS, map(pa.array, counts), strict=True))
            parts.append(pa.table(columns))
            rows.append({
                "episode_index": number, "tasks": ["move"], "length": n, "data/chunk_index": 0,
                "data/file_index": file, "dataset_from_index": at, "dataset_to_index": at + n,
            })  # fmt: skip
            at += n
        pq.write_table(pa.concat_tables(parts), root / f"data/chunk-000/file-{file:03d}.parquet")
    pq.write_table(pa.Table.from_pylist(rows), root / "meta/episodes/chunk-000/file-000.parquet")
    pq.write_table(pa.table({"task_index": [0]}), root / "meta/tasks.parquet")
    features = {
        name: {"dtype": "float32", "shape": [values.shape[1]], "names": names.get(name)}
        for name, values in episodes[0].items()
    }
    features |= {name: {"dtype": "int64", "shape": [1], "names": None} for name in COUNTS}
    info = {"codebase_version": version, "fps": FPS, "total_frames": at, "features": features}
    (root / "meta/info.json").write_text(json.dumps(info))
    (root / "meta/stats.json").write_text("{}")


def make_episodes(lengths=(300, 12, 250, 400, 350)):
    """Joints that follow goals with a lag of 0.1 s, and the current that inertia and damping ask
    for; the lengths of the episodes differ, and one is shorter than any trial."""
    rng, found = np.random.default_rng(1), []
    for n in lengths:
        t = np.arange(n) / FPS
        phase, speed = rng.uniform(0, 6, 2), rng.uniform(2.0, 5.0, 2)
        late = t[:, None] - 0.1
        rate = speed * 0.5 * np.cos(speed * late + phase)
        push = -(speed**2) * 0.5 * np.sin(speed * late + phase)
        found.append({
            "observation.state": 0.5 * np.sin(speed * late + phase),
            "observation.current": 0.2 * push + 0.8 * rate,
            "action": 0.5 * np.sin(speed * t[:, None] + phase),
        })  # fmt: skip
    return found


NAMES = {"observation.state": JOINTS, "action": {"motors": JOINTS}}


def test_elements_of_vectors_have_the_names_of_info_json_and_numbers_without(tmp_path):
    episodes = make_episodes()
    write_dataset(tmp_path, episodes, NAMES)
    path = tmp_path / "data/chunk-000/file-000.parquet"
    found = columns_of(path)
    assert set(found) == {
        "timestamp", "observation.state.shoulder_pan.pos", "observation.state.elbow_flex.pos",
        "action.shoulder_pan.pos", "action.elbow_flex.pos", "observation.current[0]",
        "observation.current[1]",
    }  # fmt: skip
    wanted = ["timestamp", "observation.current[1]", "observation.state.elbow_flex.pos"]
    raw = read_trial(path, wanted)
    for column, feature in ((1, "observation.current"), (2, "observation.state")):
        expected = np.concatenate([e[feature][:, 1] for e in episodes[:3]])
        np.testing.assert_allclose(raw.columns[wanted[column]], expected, atol=1e-6)


def test_an_episode_is_a_trial_however_short_the_one_before_it(tmp_path):
    episodes = make_episodes()
    write_dataset(tmp_path, episodes, NAMES)
    trials = survey(tmp_path, episodes="1:4").trials
    assert [(t.file[-11:], t.recording) for t in trials] == [
        ("000.parquet", 2), ("000.parquet", 3), ("001.parquet", 1),
    ]  # fmt: skip
    column = "observation.state.shoulder_pan.pos"
    whole = TrialEntry(file=trials[0].file, kind="free")
    with pytest.raises(InputError, match="another recording begins: 3 recordings in one file"):
        read_recording(tmp_path, whole, [column], Clock(unit="samples"))
    clock = Clock(column="timestamp", unit="s")
    for trial, episode in zip(trials, episodes[1:4], strict=True):
        raw = read_recording(tmp_path, trial, ["timestamp", column], clock)
        np.testing.assert_allclose(raw.columns[column], episode["observation.state"][:, 0], 1e-5)
        assert raw.columns["timestamp"][0] == 0.0


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_state_action_and_current_are_told_apart(tmp_path, version):
    write_dataset(tmp_path, make_episodes(), NAMES, version)
    found = survey(tmp_path)
    assert [c.name for c in found.of("position")] == [f"observation.state.{j}" for j in JOINTS]
    assert [c.name for c in found.of("reference")] == [f"action.{j}" for j in JOINTS]
    assert [c.name for c in found.of("current")] == [f"observation.current[{k}]" for k in (0, 1)]
    assert len(found.trials) == 5 and found.passed == ()


def test_a_data_set_without_a_drive_is_refused_with_what_can_be_found(tmp_path):
    episodes = [{k: v for k, v in e.items() if "current" not in k} for e in make_episodes()]
    write_dataset(tmp_path, episodes, NAMES)
    with pytest.raises(InputError, match="inertia, weight and friction cannot be found") as error:
        propose(tmp_path)
    assert "shoulder_pan.pos 0.10 s, as a first-order lag of 1.6 Hz" in str(error.value)
    page = Path(__file__).parents[2] / "docs/raw_log_format.md"
    tables = re.findall(r"```toml\n(.*?)```", page.read_text(), re.S)
    (servo,) = (table for table in tables if 'name = "servo"' in table)
    (tmp_path / "servo.toml").write_text(servo.replace("elbow", "elbow_flex"))
    proposed = propose(tmp_path, "servo.toml")
    assert proposed.fill_in[0].startswith("the column of goal")
    assert 'elbow_flex = { column = "observation.state.elbow_flex.pos"' in proposed.session


@pytest.mark.parametrize(
    ("asked", "said"), [("7:9", "no episode 7:9; it has 0 to 4"), ("a", "no episode a; it has 0")]
)
def test_episodes_that_are_not_there_are_refused(tmp_path, asked, said):
    write_dataset(tmp_path, make_episodes(), NAMES)
    with pytest.raises(InputError, match=said):
        propose(tmp_path, episodes=asked)
    with pytest.raises(InputError, match="no data set of LeRobot"):
        propose(tmp_path / "data", episodes="0:2")


def test_init_and_ingest_take_the_episodes_of_a_data_set(tmp_path, command, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "set"
    one = [{k: v[:, :1] for k, v in e.items()} for e in make_episodes((300, 260, 280))]
    write_dataset(folder, one, {k: ["elbow.pos"] for k in ("observation.state", "action")})
    code, said, _ = command("init", "set", "--episodes", "0:2")
    assert code == 0 and "an episode a trial" in said
    assert "[coordinates.elbow]" in (folder / "device.toml").read_text()
    code, said, errors = command("ingest", "set", "--json")
    assert code == 0, errors
    trials = pd.read_parquet("runs/set/ingest/trials.parquet")
    assert list(trials.status) == ["ok", "ok"]
    np.testing.assert_allclose(trials.duration_s, [299 / FPS, 259 / FPS], atol=0.03)
