"""Ingest of sound sessions: units, files, determinism, other devices, memory."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from made_session import COUNTS, SESSION, Made, free_trial, parquet

from bampipe.data.run_folder import RunFolder
from bampipe.data.store import read_parquet
from bampipe.errors import InputError
from bampipe.files import read_json, toml_text
from bampipe.progress import silent
from bampipe.run.state import configure
from bampipe.stages import ingest

SAMPLES = Path(__file__).parents[2] / "sample_runs"


def run_ingest(session: Path, out: Path, **settings: object):
    out.mkdir(exist_ok=True)
    config = ingest.Config(session=str(session), **settings)
    return ingest.execute(RunFolder(out), out, config, silent)


def test_samples_are_the_raw_columns_in_si_units_with_what_later_stages_need(tmp_path):
    made = Made()
    run_ingest(made.write(tmp_path / "session"), tmp_path / "out")
    frame = read_parquet(tmp_path / "out/ingest/samples.parquet", trial="t01")
    raw = made.tables["trials/t01.csv"]
    assert list(frame) == [
        "trial_id", "t", "q_yaw", "q_pitch", "q_extension", "force_x", "force_y", "force_z",
        "brake_yaw", "brake_pitch", "brake_extension",
    ]  # fmt: skip
    np.testing.assert_allclose(frame.t, raw["time_us"] * 1e-6, atol=1e-12)
    for axis, (per_unit, zero) in COUNTS.items():
        np.testing.assert_allclose(frame[f"q_{axis}"], (raw[f"enc_{axis}"] - zero) / per_unit)
    force = SESSION["force"]
    volts = np.column_stack([raw[name] for name in force["columns"]]) - force["zero_v"]
    expected = volts @ np.array(force["calibration_n_per_v"]).T
    np.testing.assert_allclose(frame[["force_x", "force_y", "force_z"]], expected, atol=1e-12)
    content = read_json(tmp_path / "out/ingest/session.json")
    assert content["session_id"] == "made" and content["device"] == "bam"
    extension = content["axes"]["extension"]
    assert extension["unit"] == "m" and extension["resolution"] == 1 / 33333.3333
    assert extension["resolution_measured"] == extension["resolution_stated"]
    assert extension["noise_sd"] == pytest.approx(1 / 33333.3333 / np.sqrt(12.0))
    force = content["force"]
    assert force["columns"] == ["force_x", "force_y", "force_z"] and force["unit"] == "N"
    assert force["noise_sd_stated"] == 0.05
    assert force["noise_sd"] == force["noise_sd_measured"]
    assert content["sample_rate_hz"] == 500.0
    assert content["recorded_at"] == "2026-10-03T10:12:00+00:00"


def test_the_time_column_rules_over_the_announced_rate(tmp_path):
    made = Made()
    made.session["sample_rate_hz"] = 400.0
    run_ingest(made.write(tmp_path / "session"), tmp_path / "out")
    content = read_json(tmp_path / "out/ingest/session.json")
    assert content["sample_rate_hz"] == pytest.approx(500.0)
    assert content["announced_rate_hz"] == 400.0


def test_trials_of_one_name_in_two_folders_keep_apart(tmp_path):
    made = Made()
    made.session["trials"][1]["file"] = "more/t01.csv"
    made.tables["more/t01.csv"] = made.tables.pop("trials/t02.parquet")
    run_ingest(made.write(tmp_path / "session"), tmp_path / "out")
    trials = read_parquet(tmp_path / "out/ingest/trials.parquet")
    assert trials.trial_id.tolist() == ["trials_t01_csv", "more_t01_csv", "t03"]


def test_a_limit_can_be_changed(tmp_path):
    session = Made().write(tmp_path / "session")
    with pytest.raises(InputError, match="less than 3 s"):
        run_ingest(session, tmp_path / "out", shortest_s=3.0)
    with pytest.raises(InputError, match=r"ingest\.gap_s: found -1.0, expected 0 or more"):
        configure("ingest", {"gap_s": -1.0})


# The built-in slider under a name of its own, its force that of a sensor.
SLED = files("bampipe.physics").joinpath("devices/slider.toml").read_text(encoding="utf-8")
SLED = SLED.replace('name = "slider"', 'name = "sled"').replace("drive = true", "drive = false")


def sled(unit: str = "N", motor: Callable[[np.ndarray], np.ndarray] = lambda force: force) -> Made:
    """A device of the lab's own: one axis in mm, a motor force in N, time in s, one channel.

    ``motor`` makes the column of the force of a force of +-1 N.
    """
    t = np.arange(1000) / 500.0
    table = {
        "t": t,
        "pos": 200.0 * np.sin(2 * np.pi * t),
        "motor": motor(np.sin(4 * np.pi * t)),
        "heat": 20.0 + t,
    }
    session = {
        "schema": "bampipe.session/1",
        "session_id": "sled-1",
        "device": "my/sled.toml",
        "sample_rate_hz": 500,
        "time": {"column": "t", "unit": "s"},
        "encoders": {"carriage": {"column": "pos", "unit": "mm", "resolution": 0.01}},
        "force": {"columns": ["motor"], "components": ["motor"], "unit": unit},
        "channels": {
            "temperature": {"column": "heat", "unit": "K", "scale": 1.0, "offset": 273.15}
        },
        "trials": [{"file": "one.parquet", "kind": "free"}],
    }
    return Made(session, {}, {"one.parquet": parquet(table), "my/sled.toml": SLED})


def test_a_device_of_another_kind(tmp_path):
    session = sled().write(tmp_path / "session")
    run_ingest(session, tmp_path / "out")
    frame = read_parquet(tmp_path / "out/ingest/samples.parquet")
    assert list(frame) == ["trial_id", "t", "q_carriage", "force_motor", "temperature"]
    assert np.ptp(frame.q_carriage) == pytest.approx(0.4, abs=1e-4)
    assert frame.temperature[0] == pytest.approx(293.15)
    content = read_json(tmp_path / "out/ingest/session.json")
    assert content["device"] == "sled" and content["device_file"] == "my/sled.toml"
    assert content["axes"]["carriage"]["unit"] == "m"
    assert content["axes"]["carriage"]["resolution"] == pytest.approx(1e-5)
    copy = tmp_path / "out/ingest/device.toml"
    assert copy.read_bytes() == (session / "my/sled.toml").read_bytes()


def test_a_number_that_was_to_be_filled_in_is_named(tmp_path):
    made = sled()
    made.files["my/sled.toml"] = SLED + (
        '\n[constants]\nratio = { value = 1.0, unit = "m/rad", source = "fill in: data sheet" }\n'
        'load = { value = 2.0, unit = "kg", source = "weighed" }\n'
    )
    summary = run_ingest(made.write(tmp_path / "session"), tmp_path / "out")
    content = read_json(tmp_path / "out/ingest/session.json")
    assert content["placeholders"] == ["device.constants.ratio"]
    (note,) = summary["notes"]
    assert note.startswith("device.constants.ratio: still a placeholder")


@pytest.mark.parametrize(
    ("unit", "offset", "size", "counts"),
    [("N", 2050.0, 240.0, True), ("N", 2600.0, 240.0, True), ("N", 2048.0, 1900.0, True),
     ("N", 300.0, 240.0, False), ("N", 0.0, 240.0, False), ("mN", 2050.0, 240.0, False),
     ("N", 2050.0, 6.0, False), ("N", 2050.5, 240.0, False)],
)  # fmt: skip
def test_a_force_in_counts_of_a_converter_is_said(tmp_path, unit, offset, size, counts):
    """Large, broken numbers are none."""
    made = sled(unit, lambda force: np.rint(size * force) + offset)
    summary = run_ingest(made.write(tmp_path / "session"), tmp_path / "out")
    said = [note for note in summary["notes"] if "counts of a converter" in note]
    content = read_json(tmp_path / "out/ingest/session.json")
    assert content["force"].get("look_like_counts", []) == (["force_motor"] if counts else [])
    assert said == [note for note in content["sensor_warnings"] if "converter" in note]
    assert len(said) == counts
    if counts:
        low, high = offset - size, offset + size
        assert f"force_motor: whole numbers from {low:.0f} to {high:.0f} look" in said[0]
        assert '[force] unit = "V", calibration_n_per_v with the force of one count' in said[0]


def test_a_force_in_another_unit_than_the_device_takes(tmp_path):
    session = sled("N.m").write(tmp_path / "session")
    with pytest.raises(InputError, match=r'force\.unit: found "N\.m", but device \'sled\' takes N'):
        run_ingest(session, tmp_path / "out")


@pytest.mark.parametrize("driven", [False, True])
def test_what_a_motor_is_told_may_rest_or_stand_at_its_limit_a_sensor_may_not(tmp_path, driven):
    made = sled("V")
    force = {"calibration_n_per_v": [[35.0, 1.0]], "zero_v": [0.0, 0.0]}
    made.session["force"] |= force | {"columns": ["motor", "pulse"]}
    table = pq.read_table(pa.BufferReader(made.files["one.parquet"])).to_pandas()
    table["motor"] = np.clip(2.0 * table["motor"], -1.0, 1.0)
    table["pulse"] = np.where(table.index < 700, 0.0, 40.0)
    made.files["one.parquet"] = parquet(table)
    if driven:
        made.files["my/sled.toml"] = SLED.replace("drive = false", "drive = true")
    session = made.write(tmp_path / "session")
    if not driven:
        with pytest.raises(InputError, match="frozen"):
            run_ingest(session, tmp_path / "out")
        return
    run_ingest(session, tmp_path / "out")
    assert read_json(tmp_path / "out/ingest/session.json")["dead"] == {}
    frame = read_parquet(tmp_path / "out/ingest/samples.parquet")
    np.testing.assert_allclose(frame.force_motor, 35.0 * table["motor"] + table["pulse"])


MEASURE = """
import json, re, sys
from bampipe.stages import ingest
from bampipe.data.run_folder import RunFolder
from bampipe.progress import silent
from pathlib import Path

def peak():
    # Not ru_maxrss: that one is inherited from the process which starts this one.
    return int(re.search(r"VmHWM:\\s*(\\d+) kB", Path("/proc/self/status").read_text())[1]) * 1024

peaks = []
for session in sys.argv[1:]:
    out = Path(session + "-out")
    out.mkdir()
    ingest.execute(RunFolder(out), out, ingest.Config(session=session), silent)
    peaks.append(peak())
print(json.dumps(peaks))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read from /proc")
def test_memory_stays_below_three_times_the_largest_trial(tmp_path):
    small, large = Made(), Made()
    table = free_trial(1, seconds=1200.0)
    # One row in a thousand is damaged, so that the repairs are counted in.
    table["force_x_v"][::997] = np.nan
    table["time_us"][1000::2000] = table["time_us"][999::2000]
    raw = sum(column.nbytes for column in table.values())
    made = small.write(tmp_path / "small"), large.write(tmp_path / "large")
    first = large.session["trials"][0]
    with open(made[1] / first["file"], "wb") as stream:
        pa.csv.write_csv(pa.table(table), stream)
    session = large.session | {"trials": [first]}
    (made[1] / "session.toml").write_text(toml_text(session))
    result = subprocess.run(
        [sys.executable, "-c", MEASURE, *map(str, made)],
        capture_output=True, text=True, check=True, env={**os.environ, "MALLOC_ARENA_MAX": "1"},
    )  # fmt: skip
    before, after = json.loads(result.stdout)
    status = read_parquet(tmp_path / "large-out/ingest/trials.parquet").status[0]
    assert status == "repaired"
    assert after - before < 3 * raw, f"{(after - before) / raw:.2f} times {raw >> 20} MB"


def test_a_channel_of_the_controller_has_the_unit_of_the_device(tmp_path):
    shutil.copytree(SAMPLES / "positioning_axis", tmp_path / "axis")
    file = tmp_path / "axis/session.toml"
    file.write_text(file.read_text().replace('"qg", unit = "m"', '"qg", unit = "N"'))
    with pytest.raises(InputError, match=r"channels\.goal\.unit: a unit of N, but .* takes m"):
        run_ingest(tmp_path / "axis", tmp_path / "out")
