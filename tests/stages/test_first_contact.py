"""``bampipe init`` over logs that say their clock, rate and sizes in unusual places."""

import json
from pathlib import Path

import numpy as np
import pytest
from test_proposal import machine, proposed, samples

T, Q, TAU = machine(3)
MS = np.rint(1e3 * (T - T[0])).astype(int) + 400


def write(folder: Path, columns: dict[str, np.ndarray], above: str = "") -> None:
    rows = np.column_stack([*columns.values(), np.rad2deg(Q), TAU])
    head = ",".join((*columns, "angle_deg", "torque_nm"))
    np.savetxt(folder / "a.csv", rows, "%.7f", ",", header=above + head, comments="")


@pytest.mark.parametrize(
    "clock",
    [{"sec": MS // 1000, "msec": MS % 1000}, {"millis": MS % 1000}],
    ids=["two columns", "restarts every second"],
)
def test_a_clock_that_starts_again_every_second_is_one_clock(tmp_path, clock):
    write(tmp_path, clock)
    session, proposal = proposed(tmp_path)
    assert not proposal.fill_in and "recording" not in session["trials"][0]
    found = samples(tmp_path, tmp_path / "out", None)
    assert len(found) == len(T)


@pytest.mark.parametrize("line", ["Sampling Rate (Hz),{hz:g}", "# dt: {dt:g}", "fs = {khz:g} kHz"])
def test_a_rate_above_the_table_is_that_of_its_samples(tmp_path, line: str):
    dt = float(np.median(np.diff(T)))
    write(tmp_path, {}, line.format(hz=1 / dt, dt=dt, khz=1e-3 / dt) + "\n")
    session, proposal = proposed(tmp_path)
    assert not proposal.fill_in and session["time"]["unit"] == "samples"
    assert session["sample_rate_hz"] == pytest.approx(1 / dt, rel=1e-5)


def test_what_json_says_of_a_channel_elsewhere_is_its_own(tmp_path):
    counts = {"angle": np.rint(np.rad2deg(Q) / 0.01), "torque": np.rint(1e3 * TAU)}
    channels = {"angle": {"gain": 0.01, "unit": "deg"}, "torque": {"gain": 0.001, "unit": "Nm"}}
    data = {name: values.astype(int).tolist() for name, values in counts.items()}
    meta = {"fs": 200, "channels": channels}
    (tmp_path / "a.json").write_text(json.dumps({"meta": meta, "data": data}))
    session, proposal = proposed(tmp_path)
    assert session["encoders"]["joint"]["unit"] == "0.01 deg" and not proposal.fill_in
    assert session["force"]["unit"] == "mN.m"
