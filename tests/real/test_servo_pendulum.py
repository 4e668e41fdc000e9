"""A servo with a motor model, from its raw JSON logs; one position gain is held out throughout."""

import json
import shutil
from pathlib import Path

import pytest
from conftest import misfits
from measured import REAL, bampipe, estimates, need, result

from bampipe.data.store import read_parquet

pytestmark = pytest.mark.long

HELD_OUT_GAIN = 200
FULL_DUTY = 885.0
"""Count at which the motor is always on: the manual's limit of the pulse width."""
HEAD = """
schema = "bampipe.session/1"
session_id = "{name}"
device = "servo_pendulum"
sample_rate_hz = 188.0
[time]
column = "timestamp"
unit = "s"
[encoders]
joint = {{ column = "position", unit = "rad", resolution = 1.5339807878853584e-3 }}
[channels]
duty = {{ column = "load", unit = "", scale = {duty!r}, wrap_bits = 16 }}
supply = {{ column = "input_volts", unit = "V" }}
goal = {{ column = "goal_position", unit = "rad" }}
"""


def write_session(folder: Path, logs: list[Path], name: str) -> Path:
    folder.mkdir()
    text = HEAD.format(name=name, duty=1.0 / FULL_DUTY)
    for log in logs:
        shutil.copy(log, folder / log.name)
        text += f'[[trials]]\nfile = "{log.name}"\nkind = "free"\n'
    (folder / "session.toml").write_text(text)
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> tuple[Path, Path]:
    """Runs of the logs to learn from, and of those at the gain held out.

    Logs in which the motor is let go are left out: a motor without current is another device.
    """
    folder = need(REAL / "servo_pendulum" / "raw")
    root = tmp_path_factory.mktemp("servo")
    logs: dict[bool, list[Path]] = {False: [], True: []}
    for log in sorted(folder.glob("*.json")):
        content = json.loads(log.read_text())
        if all(entry["torque_enable"] for entry in content["entries"]):
            logs[content["kp"] == HELD_OUT_GAIN].append(log)
    for name, held in (("learnt", False), ("held", True)):
        session = write_session(root / f"session_{name}", logs[held], name)
        bampipe("run", session, "--runs", root, "--until", "filter")
    bampipe("identify", root / "learnt", "--method", "least-squares")
    return root / "learnt", root / "held"


def test_logs_come_in_with_their_signed_register(runs):
    learnt, _ = runs
    trials = read_parquet(learnt / "ingest/trials.parquet")
    assert len(trials) == 9 and trials.status.isin(["ok", "repaired"]).all()
    samples = read_parquet(learnt / "ingest/samples.parquet")
    assert samples.duty.min() == pytest.approx(-1.0) and samples.duty.max() == pytest.approx(1.0)
    assert samples.supply.between(4.0, 10.0).all()


def test_the_motor_model_lifts_the_mass_that_was_weighed(runs):
    found = estimates(runs[0])
    # 0.49 kg weighed; the stall torque of the data sheet leaves room for a factor.
    assert 0.7 < found["load_mass"] / 0.49 < 1.4
    assert 0.0 <= found["armature"] < 0.02 and found["coulomb.joint"] > 0.0


def test_the_diagnosis_ranks_what_the_load_costs_first(runs):
    few = [f"--set={name}" for name in ("replicates=4", "most_effects=1", "jobs=2")]
    bampipe("diagnose", runs[0], *few)
    best = result(runs[0], "models/base/diagnose.json")["ranking"][0]
    assert best["effect"] in ("load_dependent_friction:joint", "gear_loss:joint")
    assert best["p_value"] < 0.01
    assert best["held_out_rmse_after"] < best["held_out_rmse_before"]
    assert misfits(runs[0]) == []
