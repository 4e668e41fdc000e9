"""A force sensor that is zeroed anew in each trial: its offsets are found, said and taken off."""

from pathlib import Path

import numpy as np
import pytest
from other_labs import write_table

from bampipe.data.run_folder import RunFolder
from bampipe.data.store import read_parquet
from bampipe.files import read_json
from bampipe.progress import silent
from bampipe.setup.proposal import propose, write_proposal
from bampipe.stages import filter as filter_stage
from bampipe.stages import ingest

OFFSETS = (0.0, -3.2, 2.6, -4.0)
LEVER = 0.31


def write_trial(path: Path, seed: int, offset: float, ways: float = 0.0) -> None:
    """A pendulum moved by hand at a lever: N; ``ways`` gives a steady turn and no way back."""
    rng = np.random.default_rng(seed)
    t = np.arange(2400) / 200.0
    q = 0.05 * np.sin(3.0 * t) + ways * t
    for f in rng.uniform(0.15, 0.8, 3) if ways == 0.0 else ():
        q = q + 0.3 * np.sin(2 * np.pi * f * t + rng.uniform(0.0, 6.0))
    qd = np.gradient(q, t)
    friction = 0.5 * np.tanh(qd / 2e-3) + 0.7 * qd
    torque = 0.3 * np.gradient(qd, t) + friction + (3.3 * np.sin(q) if ways == 0.0 else 0.0)
    force = torque / LEVER + offset + rng.normal(0.0, 0.05, len(t))
    write_table(path, {"time_s": t, "lever_angle_rad": q, "handle_force_N": force})


def filtered(folder: Path, out: Path, hold_out: bool = False) -> tuple[dict, dict]:
    """What ingest and filter make of the logs: the record and the summary."""
    write_proposal(folder, propose(folder))
    text = (folder / "session.toml").read_text().replace("lever_m = 0.0", f"lever_m = {LEVER}")
    (folder / "session.toml").write_text(text + ("hold_out = true\n" if hold_out else ""))
    ingest.execute(RunFolder(out), out, ingest.Config(session=str(folder)), silent)
    summary = filter_stage.execute(RunFolder(out), out, filter_stage.Config(), silent)
    return read_json(out / "filter/filter.json"), summary


@pytest.mark.parametrize("hold_out", [False, True])
def test_offsets_by_trial_are_found_and_taken_off(tmp_path: Path, hold_out: bool):
    for number, offset in enumerate(OFFSETS):
        write_trial(tmp_path / f"t{number}.parquet", number, offset)
    out = tmp_path / "out"
    result, summary = filtered(tmp_path, out, hold_out)
    fitted = OFFSETS[:-1] if hold_out else OFFSETS
    for number, offset in enumerate(OFFSETS):
        expected = LEVER * (offset - np.mean(fitted))
        found = result["force_offsets"][f"t{number}"]["force_drive"]
        assert found == pytest.approx(expected, abs=0.02)
        before = read_parquet(out / "ingest/samples.parquet", trial=f"t{number}")["force_drive"]
        after = read_parquet(out / "filter/kinematics.parquet", trial=f"t{number}")["force_drive"]
        assert before.mean() - after.mean() == pytest.approx(found, abs=0.01)
    (note,) = (line for line in summary["notes"] if "zeroed anew" in line)
    assert f"t1 {OFFSETS[1] - np.mean(fitted):+.2g}"[:6] in note and " N) were subtracted" in note


@pytest.mark.parametrize(
    ("offset", "speeds"), [(2.0, (0.0, 0.0, 0.0, 0.0)), (0.8, (0.5, -0.5, 0.9, -0.9))]
)
def test_one_offset_for_all_or_for_each_way_is_left_to_the_model(
    tmp_path: Path, offset: float, speeds: tuple[float, ...]
):
    """What friction differs by direction would pass for it."""
    for number, ways in enumerate(speeds):
        write_trial(tmp_path / f"t{number}.parquet", number, np.copysign(offset, ways), ways)
    assert filtered(tmp_path, tmp_path / "out")[0]["force_offsets"] == {}


def test_a_damper_that_is_stiffer_one_way_tells_no_offset(tmp_path: Path):
    """Its mean force grows with the speed of the trial, as if the sensor were zeroed anew."""
    t, rng = np.arange(6000) / 500.0, np.random.default_rng(3)
    for number, (hertz, travel) in enumerate([(0.3, 0.05), (1.6, 0.05), (3.0, 0.03), (6.0, 0.012)]):
        x = travel * np.sin(2 * np.pi * hertz * t) * np.minimum(1.0, t)
        v = np.gradient(x, t)
        force = np.where(v > 0.0, 2200.0, 1100.0) * v + 60.0 * np.tanh(v / 3e-3) - 800.0 * x
        force += rng.normal(0.0, 4.0, len(t))
        columns = {"time_s": t, "displacement_mm": 1e3 * x, "force_N": force}
        write_table(tmp_path / f"t{number}.parquet", columns)
    result, _ = filtered(tmp_path, tmp_path / "out")
    assert result["force_offsets"] == {}
    assert len(read_parquet(tmp_path / "out/filter/kinematics.parquet", trial="t3")) > 5000
