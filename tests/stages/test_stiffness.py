"""Stiffness of locked axes, and of gears with encoders on their two sides."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from binary_logs import to_parquet
from conftest import schema_misfits
from identified_run import AXES
from independent import arm
from run_folders import write_ingested

import bampipe
from bampipe.data.run_folder import RunFolder
from bampipe.data.store import read_parquet
from bampipe.errors import InputError
from bampipe.files import read_json
from bampipe.progress import silent
from bampipe.report.document import Table
from bampipe.report.run_results import Results
from bampipe.report.sections import stiffness as report_section
from bampipe.setup.proposal import propose, write_proposal
from bampipe.stages import stiffness


def locked_trial(axis: str, stiffness: float, *, creep: float = 0.0, seed: int = 0) -> pd.DataFrame:
    """Return 20 s of loading a locked axis; bilinear loop with little friction."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 20.0, 0.002)
    pose = {"yaw": 0.1, "pitch": 0.3, "extension": 1.2}
    arm = {"yaw": 1.2 * np.cos(0.3), "pitch": 1.2, "extension": 1.0}[axis]
    amplitude = 100.0 if axis == "extension" else 45.0
    torque = amplitude * np.sin(2 * np.pi * t / 4.0)
    frame = pd.DataFrame({"t": t})
    for name, entry in AXES.items():
        deflection = (torque / stiffness + creep * t) if name == axis else 0.0 * t
        counts = np.floor((pose[name] + deflection) / entry["resolution"])
        frame[f"q_{name}"] = counts * entry["resolution"]
    for component, name in zip("xyz", AXES, strict=True):
        push = torque / arm if name == axis else 0.0
        frame[f"force_{component}"] = push + 0.05 * rng.standard_normal(len(t))
    for name in AXES:
        frame[f"brake_{name}"] = 200.0 if name == axis else 0.0
    return frame


def run_trials(folder: Path, trials: dict[str, pd.DataFrame], axis: str = "yaw") -> dict:
    """Execute the stage on trials in which ``axis`` was locked; return stiffness.json, checked."""
    return run_stage(write_ingested(folder, trials, dict.fromkeys(trials, ("locked", axis)), AXES))


def run_stage(run: RunFolder) -> dict:
    """Execute the stage in the run folder; return stiffness.json, checked."""
    stiffness.execute(run, run.root, stiffness.Config(), silent)
    content = read_json(run.path("stiffness/stiffness.json"))
    assert schema_misfits(content, "stiffness") == []
    return content


def test_every_axis_through_the_device(tmp_path: Path) -> None:
    truth = {"yaw": 2000.0, "pitch": 1800.0, "extension": 90e3}
    frames = {f"locked_{axis}": locked_trial(axis, k) for axis, k in truth.items()}
    kinds = {f"locked_{axis}": ("locked", axis) for axis in truth}
    content = run_stage(write_ingested(tmp_path / "run", frames, kinds, AXES))
    for axis, k in truth.items():
        entry = content["axes"][axis]
        assert entry["stiffness"] == pytest.approx(k, rel=0.005)
        assert entry["unit"] == ("N/m" if axis == "extension" else "N.m/rad")
        assert entry["n_cycles"] == len(entry["cycles"]) == 4
        here = entry["bandwidths"]["recorded"]
        assert here["rad_s"] == pytest.approx(np.sqrt(entry["stiffness"] / here["inertia"]))
        assert entry["bandwidth_hz"] == pytest.approx(entry["bandwidth_rad_s"] / (2 * np.pi))
        assert entry["poses"]["recorded"]["pitch"] == pytest.approx(0.3, abs=1e-3)
    assert content["axes"]["extension"]["bandwidths"]["recorded"]["inertia"] == pytest.approx(3.56)
    assert content["notes"] == []
    loops = read_parquet(tmp_path / "run/stiffness/loops.parquet")
    assert set(loops["branch"]) == {"rising", "falling"}
    assert loops.groupby("axis").size().min() > 5000
    assert loops["post_yield"].mean() > 0.3


def test_trials_that_slip_repeat_or_lack_what_is_needed_are_said(tmp_path: Path) -> None:
    content = run_trials(tmp_path / "run", {"a": locked_trial("yaw", 2000.0, creep=5e-4)})
    assert any("brake slips" in note for note in content["notes"])
    frames = {name: locked_trial("yaw", 2000.0, seed=k) for k, name in enumerate("ab")}
    entry = run_trials(tmp_path / "run", frames)["axes"]["yaw"]
    assert entry["n_cycles"] == 8
    assert set(entry["trials"]) == {"a", "b"}
    frames = {"a": locked_trial("yaw", 2000.0)}
    content = run_stage(write_ingested(tmp_path / "run", frames, {"a": ("free", None)}, AXES))
    assert content["axes"] == {}
    assert "No locked trials" in content["headline"]
    assert len(read_parquet(tmp_path / "run/stiffness/loops.parquet")) == 0
    frame = locked_trial("yaw", 2000.0)
    frame["q_yaw"] = 0.1
    content = run_trials(tmp_path / "run", {"a": frame})
    assert content["axes"] == {}
    assert content["notes"][0].startswith("a: ")
    with pytest.raises(InputError, match="roll"):
        run_trials(tmp_path / "run", {"a": locked_trial("yaw", 2000.0)}, "roll")


SECOND = """
[channels.second_{axis}]
column = "motor_side_{axis}_rad"
unit = "rad"
second_encoder_of = "{axis}"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A session of an arm whose log has positions of joints and motors."""
    folder, windup = tmp_path / "arm", {"gear_windup:elbow": 1.0}
    arm.record_logs(folder, 41, "ZYY", windup, style="joint_states", trials=2, seconds=8.0)
    write_proposal(folder, propose(to_parquet(folder)))
    return folder


def test_wind_up_and_play_of_a_gear_are_those_of_the_truth(folder: Path, tmp_path: Path) -> None:
    with (folder / "session.toml").open("a") as file:
        file.write(SECOND.format(axis="elbow") + SECOND.format(axis="base_yaw"))
    bampipe.run_session(folder, runs=tmp_path / "runs", last="stiffness")
    found = read_json(tmp_path / "runs/arm/stiffness/stiffness.json")
    truth = read_json(tmp_path / "arm.truth.json")["effects"]["gear_windup:elbow"]
    gear = found["gears"]["elbow"]
    assert gear["side"] == "motor" and gear["unit"] == "N.m/rad"
    off = abs(gear["stiffness"] - truth["stiffness"])
    assert off < max(4 * gear["sd"], 0.05 * gear["stiffness"])
    if gear["play"] is not None:
        assert abs(gear["play"] - truth["play"]) < max(4 * gear["play_sd"], 0.1 * truth["play"])
    assert gear["explained"] > 0.95
    assert "gear of elbow" in found["headline"]
    # Its motor follows the base's joint exactly.
    assert found["gears"]["base_yaw"]["stiffness"] is None
    assert any(note.startswith("base_yaw: its two encoders") for note in found["notes"])
    blocks = report_section.list_blocks(Results(tmp_path / "runs/arm"))
    (table,) = (block for block in blocks if isinstance(block, Table) and block.rows)
    assert [row[0] for row in table.rows] == ["base_yaw", "elbow"]
    assert table.rows[0][1] == "not seen" and table.rows[1][5] == "motor"


def test_a_second_encoder_is_of_an_axis_and_in_its_unit(folder: Path, tmp_path: Path) -> None:
    text = (folder / "session.toml").read_text()
    for change, said in (
        (('second_encoder_of = "elbow"', 'second_encoder_of = "elbo"'), "no axis 'elbo'"),
        (('unit = "rad"', 'unit = "m"'), "a unit of m, expected one of rad"),
    ):
        (folder / "session.toml").write_text(text + SECOND.format(axis="elbow").replace(*change))
        with pytest.raises(InputError, match=said):
            bampipe.run_session(folder, runs=tmp_path / "runs", last="ingest")
