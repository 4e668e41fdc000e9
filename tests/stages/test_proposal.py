"""``bampipe init``: what is proposed for folders of logs, and that it is then a session."""

import json
import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import Command
from other_labs import (
    COULOMB,
    INERTIA,
    MOMENT,
    PER_AMPERE,
    VISCOUS,
    damper_log,
    joint_log,
    write_joint_logs,
    write_table,
)

from bampipe.data import guesses
from bampipe.data.run_folder import RunFolder
from bampipe.data.session import read_session
from bampipe.data.store import read_parquet
from bampipe.errors import InputError
from bampipe.physics import registry
from bampipe.physics.units import check_device
from bampipe.progress import silent
from bampipe.setup.proposal import propose, write_proposal
from bampipe.setup.proposal.starter import Drive, starter_device
from bampipe.stages import ingest

ROOT = Path(__file__).resolve().parents[2]


def samples(folder: Path, out: Path, trial: str | None):
    """What ingest makes of a trial of the session in ``folder``, or of all."""
    ingest.execute(RunFolder(out), out, ingest.Config(session=str(folder)), silent)
    trials = read_parquet(out / "ingest/trials.parquet")
    assert (trials["status"] != "set_aside").all(), trials["reason"].tolist()
    return read_parquet(out / "ingest/samples.parquet", trial=trial)


def proposed(folder: Path, device: str = "") -> tuple[dict, object]:
    """Propose and write; the session as read back, and the proposal."""
    proposal = propose(folder, device)
    write_proposal(folder, proposal)
    return tomllib.loads((folder / "session.toml").read_text()), proposal


def proposed_for(log: dict[str, np.ndarray], folder: Path) -> tuple[dict, object]:
    """The same for a folder with one log."""
    folder.mkdir(exist_ok=True)
    write_table(folder / "a.parquet", log)
    return proposed(folder)


def test_a_joint_with_motor_current(tmp_path):
    write_joint_logs(tmp_path / "arm")
    session, proposal = proposed(tmp_path / "arm")
    assert session["sample_rate_hz"] == 100 and proposal.fill_in == []
    assert session["encoders"]["joint"] == {"column": "joint_angle", "unit": "deg"}
    assert session["channels"]["motor_current"] == {"column": "motor_current", "unit": "mA"}
    device = registry.device_from(tomllib.loads((tmp_path / "arm/device.toml").read_text()))
    assert check_device(device) == [] and device.force_unit == "A"
    # The priors come from a rough fit, here in A since the file leaves one ampere at one N.m.
    for p in device.parameters:
        truth = {"viscous.joint": VISCOUS, "coulomb.joint": COULOMB, "inertia": INERTIA}
        if p.name in truth:
            assert abs(truth[p.name] / PER_AMPERE - p.prior) < p.sd, p.name
    found = samples(tmp_path / "arm", tmp_path / "out", "run_1")
    truth = joint_log(1)
    np.testing.assert_allclose(found["q_joint"], np.deg2rad(truth["joint_angle"]), atol=1e-7)
    np.testing.assert_allclose(found["motor_current"], 1e-3 * truth["motor_current"], atol=1e-8)
    np.testing.assert_allclose(found["t"], truth["stamp"] - truth["stamp"][0], atol=2e-6)


@pytest.mark.parametrize(
    ("linear", "constant"), [(True, "force_per_volt"), (False, "torque_per_volt")]
)
def test_every_size_of_a_new_device_is_marked_as_a_guess(linear: bool, constant: str):
    found = guesses.Driven(0.9, inertia=3.0, viscous=200.0, coulomb=20.0)
    text = starter_device("pos", linear, Drive("voltage", "u"), found)
    device = registry.device_from(tomllib.loads(text))
    assert list(device.constants) == [constant]
    assert check_device(device) == []
    sizes = [line for line in text.splitlines() if re.search(r"(prior|sd|value|lower) =", line)]
    assert len(sizes) == 8 and all("# guess" in line for line in sizes)
    assert f"# Guessed with {constant} as above" in text


@pytest.mark.parametrize(
    ("step", "width"), [(4e-4, None), (4e-5, 1e-4), (1e-7, 5e-5)], ids=["coarse", "fine", "finest"]
)
def test_a_fine_encoder_allows_a_narrow_sign(tmp_path, step: float, width: float | None):
    t = np.arange(4000) / 125.0
    angle = np.round(0.8 * np.sin(1.3 * t) / step) * step
    pushed = 2.0 * np.sign(np.cos(1.3 * t)) + np.cos(1.3 * t)
    table = {"time_s": t, "joint_angle_rad": angle, "torque_nm": pushed}
    proposed_for(table, tmp_path)
    device = tomllib.loads((tmp_path / "device.toml").read_text())
    (axis,) = device["coordinates"].values()
    assert axis.get("sign_width") == width


@pytest.mark.parametrize(
    ("column", "role"),
    [
        ("command (N.m)", "force"), ("torque_cmd", "force"), ("i_ref", "current"),
        ("soll [V]", "voltage"),
    ],
)  # fmt: skip
def test_where_only_the_command_was_logged_it_is_the_input(tmp_path, column: str, role: str):
    log = joint_log(1)
    names = {"stamp": "time [s]", "joint_angle": "angle [deg]", "motor_current": column}
    session, proposal = proposed_for({new: log[name] for name, new in names.items()}, tmp_path)
    assert proposal.fill_in == [] and f"driven by a {role}" in proposal.device
    assert "drive = true" in proposal.device
    inputs = session.get("channels") or {"force": {"column": session["force"]["columns"][0]}}
    assert [given["column"] for given in inputs.values()] == [column]
    log["target_current"] = np.roll(log["motor_current"], -1)  # what was measured comes first
    session, _ = proposed_for(log, tmp_path / "b")
    assert session["channels"]["motor_current"]["column"] == "motor_current"


def test_a_damper_with_a_coil(tmp_path):
    units = ("s", "mm", "mm/s", "N", "A")
    for seed in (1, 2):
        columns = zip(damper_log(seed).items(), units, strict=True)
        table = {f"{name} [{unit}]": values for (name, values), unit in columns}
        write_table(tmp_path / f"versuch{seed}.parquet", table)
    session, proposal = proposed(tmp_path)
    assert session["sample_rate_hz"] == 1000 and proposal.fill_in == []
    (axis,) = session["encoders"].values()
    assert axis["column"] == "Displacement [mm]" and axis["unit"] == "mm"
    assert axis["velocity"] == {"column": "Velocity [mm/s]", "unit": "mm/s"}
    assert session["force"]["columns"] == ["Force [N]"] and session["force"]["unit"] == "N"
    assert session["channels"]["coil_current"] == {"column": "Current [A]", "unit": "A"}
    device = tomllib.loads((tmp_path / "device.toml").read_text())
    assert device["inputs"]["prescribed"] is True
    found = samples(tmp_path, tmp_path / "out", "versuch2")
    truth = damper_log(2)
    np.testing.assert_allclose(found["q_carriage"], 1e-3 * truth["Displacement"], atol=1e-8)
    np.testing.assert_allclose(found["force_drive"], truth["Force"], atol=1e-5)


def test_what_is_asked_of_a_coil_beside_a_measured_force_is_its_current(tmp_path):
    """Of a small brake, whose mass is below what is the least of a damper's."""
    table = damper_log(1)
    table["i_cmd"], table["Force"] = table.pop("Current"), 1e-3 * table["Force"]
    session, proposal = proposed_for(table, tmp_path)
    assert session["force"]["columns"] == ["Force"]
    assert session["channels"]["coil_current"]["column"] == "i_cmd"
    assert any(line.startswith("i_cmd is taken for the current") for line in proposal.check)


def test_tables_of_any_extension_are_read_and_prose_beside_them_is_no_table(tmp_path):
    for size, name in enumerate(("a.t", "b.res", "c"), 1):
        write_table(tmp_path / name, labelled("t,angle_rad,w,torque_nm", q=0.3 * size))
    (tmp_path / "README.txt").write_text("The rig, 24 V.\nRuns 1, 2 and 3: 10 to 40 rpm.\n")
    (tmp_path / "notes.txt").write_text("Run 1 is good. Run 2 is bad after 5 s.\nRun 3 1 2 3\n")
    (tmp_path / "LICENSE").write_text("Copyright 2019\nAll rights are kept.\n")
    session, proposal = proposed(tmp_path)
    assert [trial["file"] for trial in session["trials"]] == ["a.t", "b.res", "c"]
    left = dict(line.split(": ", 1) for line in proposal.passed)
    assert set(left) == {"README.txt", "notes.txt"}
    assert all(why.startswith("no table: ") for why in left.values())
    found = samples(tmp_path, tmp_path / "out", "b")
    whole = labelled("t,angle_rad,w,torque_nm", q=0.6)["angle_rad"][: len(found)]
    np.testing.assert_allclose(found["q_joint"], whole, atol=1e-5)


def test_joint_states_of_a_robot_that_wrap_at_half_a_turn(tmp_path):
    (tmp_path / "arm").mkdir()
    log = joint_log(1)
    turned = (np.deg2rad(log["joint_angle"]) + 3.0 + np.pi) % (2 * np.pi) - np.pi
    rows = ["header.stamp.sec,header.stamp.nanosec,name[0],position[0],effort[0]"]
    for t, q, current in zip(log["stamp"], turned, log["motor_current"], strict=True):
        nano = round((t - int(t)) * 1e9)
        rows.append(f"{int(t)},{nano},elbow,{q:.7f},{1e-3 * PER_AMPERE * current:.6f}")
    (tmp_path / "arm/a.csv").write_text("\n".join(rows) + "\n")
    session, _ = proposed(tmp_path / "arm")
    assert session["time"]["column"] == "header.stamp.sec" and session["sample_rate_hz"] == 100
    assert session["time"]["nanoseconds"] == "header.stamp.nanosec"
    device = registry.device_from(tomllib.loads((tmp_path / "arm/device.toml").read_text()))
    assert device.drive and check_device(device) == []
    prior = {p.name: p for p in device.parameters}
    # The zero of the encoder is turned by 3 rad from hanging down, and gravity with it.
    truth = {"moment": MOMENT * np.cos(3.0), "moment_across": -MOMENT * np.sin(3.0)}
    for name, value in truth.items():
        assert abs(prior[name].prior - value) < 0.5 * prior[name].sd
    found = samples(tmp_path / "arm", tmp_path / "out", "a")
    assert np.abs(np.diff(found["q_joint"])).max() < 0.1


def test_duty_cycle_and_supply_make_a_motor(tmp_path):
    t, q, _, torque = labelled("t,q,w,u").values()
    table = {"t": t, "present_angle_deg": np.rad2deg(q), "pwm_percent": 8 * torque}
    table["vbat"] = 12 + 0.01 * (np.arange(len(t)) % 3)
    session, proposal = proposed_for(table, tmp_path)
    assert session["encoders"]["joint"] == {"column": "present_angle_deg", "unit": "deg"}
    duty, supply = session["channels"]["duty"], session["channels"]["supply"]
    assert duty == {"column": "pwm_percent", "unit": "percent"}
    assert supply == {"column": "vbat", "unit": "V"}
    assert any("your own torque_constant and resistance" in x for x in proposal.check)
    device = registry.device_from(tomllib.loads((tmp_path / "device.toml").read_text()))
    assert check_device(device) == [] and device.force_unit == ""


def test_a_damper_whose_velocity_alone_was_kept_and_a_log_too_short_to_look_into(tmp_path):
    log = damper_log(1)
    table = {"V": log["Velocity"] / 10, "F": log["Force"], "Ts": np.full_like(log["Force"], 1e-3)}
    session, proposal = proposed_for(table, tmp_path)
    assert session["time"] == {"unit": "samples"} and session["sample_rate_hz"] == 1000
    (axis,) = session["encoders"].values()
    assert axis["column"] == "V" and any("integral of V" in line for line in proposal.check)
    assert session["force"]["columns"] == ["F"]
    short = {n: v[:6] for n, v in labelled("t,angle_deg,w,u_nm").items()}
    assert "encoders" in proposed_for(short, tmp_path / "b")[0]


def test_the_measured_axis_is_understood_from_its_motion(tmp_path):
    shutil.copytree(ROOT / "sample_runs/positioning_axis/trials", tmp_path / "axis")
    session, proposal = proposed(tmp_path / "axis", "slider")
    shipped = tomllib.loads((ROOT / "sample_runs/positioning_axis/session.toml").read_text())
    assert session["time"] == shipped["time"]
    column = shipped["encoders"]["carriage"]["column"]
    assert session["encoders"]["carriage"]["column"] == column
    assert session["force"]["columns"] == shipped["force"]["columns"]
    assert any("since the motion follows it" in line for line in proposal.check)
    assert len(session["trials"]) >= 4
    assert len(samples(tmp_path / "axis", tmp_path / "out", "record_2")) > 3000


def test_nothing_is_overwritten(tmp_path, command: Command):
    write_joint_logs(tmp_path, 1)
    (tmp_path / "device.toml").write_text("x = 1\n")
    code, out, err = command("init", tmp_path)
    assert (code, out) == (2, "") and "device.toml: is there already and is left alone" in err
    assert not (tmp_path / "session.toml").exists()
    (tmp_path / "device.toml").unlink()
    assert command("init", tmp_path, "--dry")[0] == 0 and not (tmp_path / "session.toml").exists()
    code, out, _ = command("init", tmp_path)
    assert code == 0 and out.rstrip().splitlines()[-1].startswith("next: bampipe ")
    before = (tmp_path / "session.toml").read_bytes()
    code, _, err = command("init", tmp_path)
    assert code == 2 and "there is a session.toml already; it is left alone" in err
    assert (tmp_path / "session.toml").read_bytes() == before


@pytest.mark.parametrize(
    ("files", "device", "said"),
    [
        (None, "", "no such folder"),
        ({}, "", "no log in this folder"),
        ({"a.csv": "", "b.txt": "\0"}, "", "no log that can be read"),
        ({"a.csv": "t,q,force\n" + "0,1,2\n" * 9}, "bma", "did you mean 'bam'"),
        ({"a.csv": "t,q,force\n" + "0,1,2\n" * 9}, "x.toml", "x.toml: no such file"),
        ({"a.csv": "t,a,b\n0,1,2\n1,2,3\n"}, "", "a position; say in order"),
        ({"a.json": '[{"a": 1, "b": 2}, {"a": 2}]'}, "", "a position; name them in the log"),
    ],
)
def test_folders_that_cannot_be_proposed_for(tmp_path, command: Command, files, device, said):
    folder = tmp_path / "logs"
    if files is not None:
        folder.mkdir()
        for name, text in files.items():
            (folder / name).write_text(text)
    code, out, err = command("init", folder, *(["--device", device] if device else []))
    assert (code, out) == (2, "") and said in err and len(err.splitlines()) == 1
    assert not (folder / "session.toml").exists()


def test_a_clock_of_no_likely_unit_is_left_open_and_costs_no_time(tmp_path):
    t = np.arange(1000) * 1e-9
    wave = np.arange(1000) / 50
    table = {"time": t, "angle_deg": np.sin(wave), "torque_nm": np.cos(wave)}
    write_table(tmp_path / "a.parquet", table)
    proposal = propose(tmp_path)
    assert 'unit = "?"' in proposal.session and "from the time stamps" not in proposal.session
    assert any("unit of time" in line for line in proposal.fill_in)
    (tmp_path / "session.toml").write_text(proposal.session)
    with pytest.raises(InputError, match="unit"):
        read_session(tmp_path)


def test_a_built_in_device_is_known_by_its_axes_and_each_has_a_velocity_of_its_own(tmp_path):
    t = np.arange(600) / 200.0
    columns = {
        "t_s": t,
        "yaw_rad": np.sin(t),
        "pitch_rad": np.cos(t),
        "extension": np.rint(33_333.0 + 3333.0 * np.sin(2 * t)),
        "pitch_velocity [deg/s]": np.rad2deg(-np.sin(t)),
    }
    forces = {f"force_{c}_v": np.sin(w * t) for c, w in (("x", 3), ("y", 4), ("z", 5))}
    write_table(tmp_path / "t01_locked_yaw.csv", columns | forces)
    proposal = propose(tmp_path)
    lines = proposal.session.splitlines()
    assert 'device = "bam"' in lines and 'locked_axis = "yaw"' in lines
    assert [line.split(" = ")[0] for line in lines if ", velocity = " in line] == ["pitch"]
    asked = [line.split()[0].strip(",") for line in proposal.fill_in]
    assert asked == ["counts_per_unit", "calibration_n_per_v", "zero_v"]


def stage_log() -> dict[str, np.ndarray]:
    """A slide on a test stand at 500 Hz: ms, mm, N, and the angle of a joint beside it in rad."""
    t = np.arange(4000) / 500.0
    x = 0.02 * np.sin(2 * np.pi * 0.7 * t) + 0.01 * np.sin(2 * np.pi * 1.3 * t)
    v = np.gradient(x, t)
    force = 8.0 * np.gradient(v, t) + 40.0 * v + 6.0 * np.tanh(v / 1e-3)
    force += np.random.default_rng(3).normal(0.0, 3.0, t.size)
    # The other joint goes with the velocity of the first better than any noisy force does.
    return {"ms": 1e3 * t, "pos_mm": 1e3 * x, "Joint 2 (rad)": 3.0 * v, "load_cell_N": force}


def test_a_rate_that_nobody_knows_is_refused_until_it_is_given(tmp_path):
    log = stage_log()
    pair = {name: log[name] for name in ("pos_mm", "load_cell_N")}
    _, proposal = proposed_for(pair, tmp_path / "a")
    (ask,) = proposal.fill_in
    assert ask.startswith("sample_rate_hz, rows a second. To find it: ")
    with pytest.raises(InputError, match=r'sample_rate_hz: found "\?"'):
        read_session(tmp_path / "a")
    # The position of another joint is no force.
    session, _ = proposed_for(log, tmp_path / "b")
    assert session["encoders"]["carriage"]["column"] == "pos_mm"
    assert session["force"]["columns"] == ["load_cell_N"]


def test_a_force_that_is_not_there_is_asked_for_where_it_is_read(tmp_path, command: Command):
    """A line under [channels] would be refused by the name of the device's own input."""
    t = 0.01 * np.arange(2000)
    table = {"time [s]": t, "position [rad]": np.sin(t), "current [A]": np.full_like(t, 1.25)}
    session, proposal = proposed_for(table, tmp_path)
    assert "the column of force_drive in N.m. To find it: see the headers" in proposal.fill_in[0]
    assert session["force"] == {"columns": ["?"], "components": ["drive"], "unit": "N.m"}
    code, _, err = command("ingest", tmp_path)
    assert code == 2 and "fill in the name of the column" in err


@pytest.mark.parametrize(
    "header", [["Logging to: B.CSV", "t,angle_rad,torque_nm"], ["\ufefft,angle_rad,torque_nm"], []]
)
def test_each_recording_of_a_file_is_a_trial(tmp_path, command: Command, header: list[str]):
    t = 0.01 * np.arange(1000)
    first, other = ([f"{a:.2f},{np.sin(w * a):.6f},{np.cos(a):.4f}" for a in t] for w in (1.0, 1.5))
    lines = ["t,angle_rad,torque_nm", *first, *header, *other]
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "b.csv").write_text("\n".join(["t,angle_rad,torque_nm", *first[:400]]) + "\n")
    session, proposal = proposed(tmp_path)
    assert [trial.get("recording") for trial in session["trials"]] == [1, 2, None]
    begins = 1002 + len(header)
    assert f"a.csv holds 2 recordings, which begin again at row {begins}" in proposal.check
    trials = samples(tmp_path, tmp_path / "out", None).groupby("trial_id")
    for trial, rate in (("a", 1.0), ("a_2", 1.5), ("b", 1.0)):
        found = trials.get_group(trial)
        np.testing.assert_allclose(found["t"], t[: len(found)], atol=1e-9)
        np.testing.assert_allclose(found["q_joint"], np.sin(rate * t[: len(found)]), atol=1e-6)
    text = re.sub("recording = .*", "", (tmp_path / "session.toml").read_text())
    (tmp_path / "session.toml").write_text(text)
    code, out, err = command("ingest", tmp_path, "--runs", tmp_path / "runs")
    assert code in (0, 2) and f"row {begins}: " in out + err
    assert "2 recordings in one file; give each a [[trials]] entry with recording = 1" in out + err


def two_joints(columns: dict[str, str]) -> dict[str, np.ndarray]:
    """Two joints in one log; ``columns``: names by what they hold."""
    one, two = (joint_log(seed) for seed in (1, 2))
    samples = min(len(one["stamp"]), len(two["stamp"]))
    held = {"time [s]": one["stamp"] - one["stamp"][0]}
    for number, log in ((1, one), (2, two)):
        held[f"q{number}"] = np.deg2rad(log["joint_angle"])
        held[f"tau{number}"] = 1e-3 * PER_AMPERE * log["motor_current"]
    return {columns.get(name, name): values[:samples] for name, values in held.items()}


def test_of_two_joints_without_a_drawing_a_position_has_its_own_drive(tmp_path):
    table = two_joints({"q1": "pos_meas1", "q2": "pos_meas2"})
    # The drive of the other joint, and what was asked of this one, follow the motion better.
    rng, samples = np.random.default_rng(0), len(table["tau1"])
    table["tau_con1"] = table["tau1"] - rng.normal(0.0, 1e-3, samples)
    table["tau1"] = table["tau1"] + rng.normal(0.0, 0.3, samples)
    table["tau2"] = table["tau_con1"]
    session, proposal = proposed_for(table, tmp_path)
    (ask,) = proposal.fill_in
    assert ask.startswith("which is meant, pos_meas1 or pos_meas2: are they of two joints, or")
    assert 'columns = { "pos_meas1" = "pos_meas2", "tau1" = "tau2" }' in ask
    assert session["encoders"]["joint"]["column"] == "?"
    assert session["force"]["columns"] == ["tau1"]


def test_a_stage_has_an_axis_for_each_letter_with_a_drive_of_its_own(tmp_path):
    log, names = stage_log(), ("X", "Y")
    table = {"t_ms": log["ms"]}
    for size, name in zip((1.0, 3.0), names, strict=True):
        table |= {
            f"{name}.pos [mm]": log["pos_mm"],
            f"{name}.current [A]": size * log["load_cell_N"],
        }
    session, proposal = proposed_for(table, tmp_path)
    device = registry.device_from(tomllib.loads(proposal.device))
    assert proposal.fill_in == [] and check_device(device) == []
    assert [c.name for c in device.coordinates] == [*device.friction] == ["x", "y"]
    assert [session["encoders"][axis]["column"] for axis in "xy"] == ["X.pos [mm]", "Y.pos [mm]"]
    assert session["channels"]["motor_current_y"] == {"column": "Y.current [A]", "unit": "A"}
    prior = {p.name: p.prior for p in device.parameters}
    assert prior["inertia_y"] == pytest.approx(3.0 * prior["inertia_x"], rel=0.05)
    found = samples(tmp_path, tmp_path / "out", "a")
    np.testing.assert_allclose(found["q_y"], 1e-3 * log["pos_mm"][: len(found)], atol=1e-9)


def test_the_files_of_one_recording_are_joined(tmp_path):
    """One quantity a file, as matrices without names; rows that one file has more are left out."""
    log = joint_log(3, seconds=10.0)
    for k in (1, 2):
        rows = np.column_stack([np.deg2rad(log["joint_angle"]), log["joint_velocity"]])
        np.savetxt(tmp_path / f"excit_ang_{k}.txt", rows[k:], "%.8f")
        np.savetxt(tmp_path / f"excit_torque_{k}.txt", log["motor_current"][k:-2, None], "%.6f")
    (tmp_path / "results.txt").write_text("RMSE 0.12\n")
    (tmp_path / "one.txt").write_text("1.0 2.0 3.0\n")
    (tmp_path / "empty.csv").write_text("")
    session, proposal = proposed(tmp_path)
    assert session["force"]["columns"] == ["torque:column_1"]
    assert session["encoders"]["joint"]["column"] == "ang:column_1"
    parts = [trial["parts"] for trial in session["trials"]]
    assert parts == [
        [{"file": f"excit_torque_{k}.txt", "name": "torque", "join": "rows"}] for k in (1, 2)
    ]
    assert [line.partition(":")[0] for line in proposal.passed] == [
        "empty.csv", "one.txt", "results.txt"
    ]  # fmt: skip
    assert "excit_ang_1.txt and excit_torque_1.txt are taken as one recording, joined row" in str(
        proposal.check
    )
    text = (tmp_path / "session.toml").read_text().replace('"?"', "100")
    (tmp_path / "session.toml").write_text(text)
    found = samples(tmp_path, tmp_path / "out", "excit_ang_1")
    force = next(found[name] for name in found if name.startswith("force_"))
    np.testing.assert_allclose(force, log["motor_current"][1:-2], atol=1e-6)


@pytest.mark.parametrize("shift", [0.0, 2.5, 500.0])
def test_motion_and_force_with_clocks_of_their_own_are_joined(tmp_path, shift: float):
    """Clocks that overlap are one; those that do not are taken as started together, and it said."""
    t, u = np.arange(0.0, 20.0, 0.01), np.arange(0.0, 20.0, 0.004)
    motion, force = np.sin(2.0 * t), np.cos(2.0 * (u + (shift if shift < 20 else 0.0)))
    write_table(tmp_path / "motion.parquet", {"t": t, "angle_rad": motion})
    write_table(tmp_path / "force.parquet", {"stamp_ms": 1e3 * (u + shift), "torque_nm": force})
    session, proposal = proposed(tmp_path)
    (part,) = session["trials"][0]["parts"]
    way = "start" if shift > 20 else "time"
    assert (
        part | {"file": "force.parquet", "join": way, "time": "stamp_ms", "time_unit": "ms"} == part
    )
    assert ("as if begun together" in str(proposal.check)) == (way == "start")
    found = samples(tmp_path, tmp_path / "out", None)
    (name,) = (column for column in found if column.startswith("force_"))
    stamps = t[round(shift / 0.01) if shift < 20 else 0 :][: len(found)]
    first = found["trial_id"] == found["trial_id"][0]
    count = min(500, int(first.sum()))
    np.testing.assert_allclose(found[name][first][:count], np.cos(2.0 * stamps[:count]), atol=2e-5)


def test_parts_that_no_clock_joins_are_refused(tmp_path, command: Command):
    table = two_joints({})
    write_table(tmp_path / "q.parquet", {"q1": table["q1"]})
    write_table(tmp_path / "tau.parquet", {"tau1": table["tau1"][::3]})
    code, _, errors = command("init", str(tmp_path))
    assert code == 2 and errors.count("\n") == 1
    assert "drives are in different files, such as q.parquet and tau.parquet" in errors
    assert "and no clock in common" in errors and "[[trials.parts]]" in errors


def labelled(names: str, **scales: float) -> dict[str, np.ndarray]:
    """The joint's log under other names, in the order time, position, velocity, drive."""
    log = joint_log(3)
    values = (
        log["stamp"] - log["stamp"][0], np.deg2rad(log["joint_angle"]),
        np.deg2rad(log["joint_velocity"]), PER_AMPERE * 1e-3 * log["motor_current"],
    )  # fmt: skip
    factors = (scales.get(what, 1.0) for what in ("t", "q", "qd", "u"))
    return {n: v * f for n, v, f in zip(names.split(","), values, factors, strict=True)}


def test_units_at_the_end_of_names_and_what_slides(tmp_path):
    table = labelled("t_ms,pos_deg,vel_deg_s,cur_mA", t=1e3, q=57.29578, qd=57.29578, u=1e3)
    session, proposal = proposed_for(table, tmp_path)
    assert session["time"] == {"column": "t_ms", "unit": "ms"}
    velocity = {"velocity": {"column": "vel_deg_s", "unit": "deg/s"}}
    assert session["encoders"]["joint"] == {"column": "pos_deg", "unit": "deg"} | velocity
    assert session["channels"]["motor_current"] == {"column": "cur_mA", "unit": "mA"}
    assert "driven by a current" in proposal.device
    session, proposal = proposed_for(labelled("t,dist,w,forc"), tmp_path / "b")
    assert session["force"]["unit"] == "N" and "linear axis" in " ".join(proposal.check)
    for n, head in enumerate(("t,lift.pos,w,force", "t,pos_x,w,current")):
        proposal = proposed_for(labelled(head), tmp_path / f"d{n}")[1]
        assert "linear axis" in " ".join(proposal.check)
    current = labelled("t,Pos.AngleValue,w,Pos.MotorCurrent")
    current["volts"] = 3.0 * current["Pos.MotorCurrent"] + 9.0 * current["w"]
    assert "driven by a current" in proposed_for(current, tmp_path / "e")[1].device
    session, _ = proposed_for(labelled("timer,stage pos mm,w,push_gf"), tmp_path / "c")
    assert session["time"]["column"] == "timer" and session["force"]["unit"] == "gf"


def test_a_current_position_is_no_current_and_an_acceleration_drives_nothing(tmp_path):
    table = labelled("t,current_position,acc_x,torque_nm")
    table["acc_x"] = np.gradient(np.gradient(table["current_position"], table["t"]), table["t"])
    session, _ = proposed_for(table, tmp_path)
    assert [e["column"] for e in session["encoders"].values()] == ["current_position"]
    assert session["force"]["columns"] == ["torque_nm"]
    del table["torque_nm"]
    session, _ = proposed_for(table, tmp_path / "b")
    assert session["force"]["columns"] == ["?"]


def test_names_can_be_given_to_a_log_without_a_header(tmp_path, command: Command):
    table = np.column_stack(list(labelled("t,q,dq,u").values()))[:1000]
    np.savetxt(tmp_path / "a.csv", table, "%.6f", ",")
    session = tomllib.loads(propose(tmp_path).session)
    assert session["time"]["column"] == "column_1"  # by what they look like
    assert session["encoders"]["joint"]["column"] == "column_2"
    assert "column_2, which looks like the position" in str(propose(tmp_path).fill_in)
    code, _, errors = command("init", str(tmp_path), "--names", "t,q_rad,dq,current_A")
    assert code == 0, errors
    session = tomllib.loads((tmp_path / "session.toml").read_text())
    assert session["csv"] == {"names": ["t", "q_rad", "dq", "current_A"]}
    assert session["channels"]["motor_current"]["column"] == "current_A"
    found = samples(tmp_path, tmp_path / "out", "a")
    np.testing.assert_allclose(found["q_joint"][:100], table[:100, 1], atol=1e-6)


@pytest.mark.parametrize("beside", ["input_volts", "current"])
def test_a_load_in_a_register_is_a_duty_cycle_and_no_force(tmp_path, beside: str):
    """Of a supply that is logged too, or beside the current: it is not that, then."""
    table = labelled("t,position,w,load")
    del table["w"]
    table["load"] = np.mod(np.rint(300.0 * table["load"]), 65536.0)
    table[beside] = 5.0 + 0.01 * (np.arange(len(table["t"])) % 3)
    session, proposal = proposed_for(table, tmp_path)
    assert "driven by a duty" in proposal.device and "force" not in session
    (drive,) = (c for c in session["channels"].values() if c["column"] == "load")
    assert drive["wrap_bits"] == 16
    (ask,) = proposal.fill_in
    assert ask.startswith("the scale of duty, 1 over the reading of load at full duty")
    session, proposal = proposed_for({"torque": table.pop("load"), **table}, tmp_path / "b")
    (drive,) = (c for c in session["channels"].values() if c["column"] == "torque")
    assert drive["wrap_bits"] == 16 and "driven by a force" in proposal.device


def pendulum(names: str, q: float, u: float) -> dict[str, np.ndarray]:
    """A joint that swings far: time, position and torque under other names, scaled."""
    t = np.arange(3000) / 100.0
    angle = 0.9 * np.sin(1.7 * t) + 0.5 * np.sin(4.1 * t + 1.0)
    speed = np.gradient(angle, t)
    torque = INERTIA * np.gradient(speed, t) + VISCOUS * speed + MOMENT * np.sin(angle)
    torque += COULOMB * np.tanh(speed / 2e-3) + np.random.default_rng(5).normal(0.0, 0.01, 3000)
    return dict(zip(names.split(","), (t, q * angle, u * torque), strict=True))


def test_sign_bits_of_a_servo_are_taken_off_and_its_counts_shown_by_its_weight(tmp_path):
    """Below zero the position reads 32768 and the magnitude, the load 1024 and the magnitude."""
    table = pendulum("time,pos,load", 4096 / (2.0 * np.pi), 250.0)
    signed = {name: np.rint(table[name]) for name in ("pos", "load")}
    for name, bit in (("pos", 15), ("load", 10)):
        table[name] = np.where(signed[name] < 0, 2.0**bit - signed[name], signed[name])
    session, proposal = proposed_for(table | {"voltage": 12.0 + 0.0 * table["time"]}, tmp_path)
    encoder = session["encoders"]["joint"]
    assert encoder["sign_bit"] == 15
    assert encoder["counts_per_unit"] == pytest.approx(4096 / (2.0 * np.pi), rel=1e-4)
    assert session["channels"]["duty"]["sign_bit"] == 10
    assert "pos is sign and magnitude: bit 15 stands for minus" in proposal.check
    assert [ask.split(",")[0] for ask in proposal.fill_in] == ["the scale of duty"]


@pytest.mark.parametrize(
    ("column", "unit"),
    [("handle_force_N", "N"), ("loadcell_kN", "kN"), ("kraft", "N"), ("pull_gf", "gf")],
)
def test_a_force_on_a_joint_needs_a_lever(tmp_path, command: Command, column: str, unit: str):
    scale = {"kN": 1e-3, "gf": 1e3 / 9.80665}.get(unit, 1.0)
    session, proposal = proposed_for(labelled(f"t,angle_rad,w,{column}", u=scale / 0.31), tmp_path)
    assert (session["force"]["unit"], session["force"]["lever_m"]) == (unit, 0.0)
    (ask,) = proposal.fill_in
    assert ask.startswith("lever_m, how far from the axis") and "measure it" in ask
    assert tomllib.loads(proposal.device)["parameters"]["inertia"]["lower"] < 0.1 * INERTIA
    code, _, err = command("ingest", tmp_path)
    assert code == 2 and "force.lever_m: found 0, expected the distance in m from the axis" in err
    text = (tmp_path / "session.toml").read_text().replace("lever_m = 0.0", "lever_m = 0.31")
    (tmp_path / "session.toml").write_text(text)
    found = samples(tmp_path, tmp_path / "out", "a")
    whole = labelled("t,q,w,u")["u"][: len(found)]
    np.testing.assert_allclose(found["force_drive"], whole, atol=2e-3)


def test_a_current_that_goes_with_the_torque_is_no_coil(tmp_path):
    table = labelled("t,angle_rad,w,torque_nm")
    rng = np.random.default_rng(1)
    table["current"] = table["torque_nm"] / 1.9 + rng.normal(0.0, 0.02, len(table["t"]))
    session, proposal = proposed_for(table, tmp_path)
    assert session["force"]["columns"] == ["torque_nm"] and "coil_current" not in proposal.device
    assert any("current goes with torque_nm" in line for line in proposal.check)


def test_the_gear_of_a_motor_is_what_the_weight_says_and_missed_in_its_torque(tmp_path):
    session, proposal = proposed_for(
        pendulum("t,motor_angle_deg,torque_nm", 70.0 * 57.29578, 1.0), tmp_path
    )
    assert session["encoders"]["joint"]["gear_ratio"] == pytest.approx(70.0, rel=0.02)
    assert any("times for one turn of it, by its weight" in line for line in proposal.check)
    assert "moment" in proposal.device and session["encoders"]["joint"]["scale_sd"] < 0.02
    near = pendulum("t,motor [rev],torque_nm", 6.0 / (2.0 * np.pi), 1.0)
    encoders = proposed_for(near, tmp_path / "d")[0]["encoders"]
    assert encoders["joint"]["gear_ratio"] == pytest.approx(6.0, rel=0.02)
    turned = pendulum("T.t,exp.position,exp.torque", 0.159155, 1.0)  # of no stated unit
    assert proposed_for(turned, tmp_path / "c")[0]["encoders"]["joint"]["unit"] == "rev"
    session, proposal = proposed_for(
        pendulum("t,motor_deg,motor_torque_mNm", 4000.0, 14.0), tmp_path / "b"
    )
    assert any('"motor_torque_mNm", the torque of a motor' in line for line in proposal.fill_in)
    assert session["force"]["unit"] == "?"


def test_of_joints_in_a_message_the_one_that_moves_is_the_axis(tmp_path):
    t = np.arange(3000) / 100.0
    table = pendulum("field.header.stamp,field.position1,field.effort1", 1.0, 1.0)
    frame = pd.DataFrame({"%time": np.rint(1e9 * t + 4e6), **table})
    frame["field.header.stamp"] = np.rint(1e9 * t)
    frame = frame.assign(**{"field.name0": "gripper", "field.name1": "elbow"})
    frame = frame.assign(**{"field.position0": 0.0, "field.effort0": 0.0})
    frame[sorted(frame.columns)].to_csv(tmp_path / "a.csv", index=False)
    session, _ = proposed(tmp_path)
    assert session["time"]["column"] == "field.header.stamp"
    assert session["encoders"]["elbow"]["column"] == "field.position[elbow]"
    assert session["force"]["columns"] == ["field.effort[elbow]"]


def test_recordings_in_a_list_are_trials(tmp_path):
    run = {n: [*map(float, v)] for n, v in pendulum("t,q,tau", 1.0, 1.0).items()}
    runs = [{"trial": 1, **run}, {"trial": 2, **run}]
    (tmp_path / "all.json").write_text(json.dumps({"rig": "a", "runs": runs}))
    session, proposal = proposed(tmp_path)
    assert [trial["recording"] for trial in session["trials"]] == [1, 2]
    assert session["encoders"]["joint"]["column"] == "runs[:].q"
    assert any("all.json holds 2 recordings" in line for line in proposal.check)
    assert len(samples(tmp_path, tmp_path / "out", "all_2")) == 3000
    (tmp_path / "b").mkdir()
    ends = [{name: run[name][:end] for name in ("q", "tau")} for end in (3000, 2000)]
    (tmp_path / "b/a.json").write_text(json.dumps({"rate": {"hz": 50}, "data": ends}))
    assert [t["recording"] for t in proposed(tmp_path / "b")[0]["trials"]] == [1, 2]


def test_held_rows_are_proposed_at_their_true_rate(tmp_path):
    log = labelled("t,angle_rad,w,torque_nm")
    rows = np.arange(10 * len(log["t"]))
    table = {name: values[rows // 10] for name, values in log.items()} | {"t": rows / 1000.0}
    session, proposal = proposed_for(table, tmp_path)
    assert session["sample_rate_hz"] == 100
    assert any(line.startswith("90% of the rows repeat the positions") for line in proposal.check)


def test_ticks_of_a_counter_and_slow_logs_are_asked_about(tmp_path):
    log = labelled("ticks,angle_rad,w,torque_nm", t=168e6)
    session, proposal = proposed_for(log | {"ticks": np.rint(log["ticks"] % 2.0**32)}, tmp_path)
    assert session["time"] == {"column": "ticks", "unit": "ticks", "ticks_per_s": 0.0}
    assert re.match("ticks_per_s, what ticks counts in a .*data sheet", *proposal.fill_in)
    for name, scale, time in (
        ("time [0.1 ms]", 1e4, {"unit": "ticks", "ticks_per_s": 1e4}),
        ("time in cycle [ms]", 1e3, {"unit": "ms"}),
        ("stamp", 1e7, {"unit": "ticks", "ticks_per_s": 1e7}),  # of Windows
    ):
        log = labelled(f"{name},angle_rad,w,torque_nm", t=scale)
        log[name] += 1.34e17 * (name == "stamp")
        session, proposal = proposed_for(log, tmp_path / f"{scale:g}")
        assert session["time"] == {"column": name, **time} and proposal.fill_in == []
    slow = {n: v[::10] for n, v in labelled("t,q,w,u").items()}
    assert "too slow for inertia" in str(proposed_for(slow, tmp_path / "b")[1].check)
    slow = proposed_for(labelled("t_s,q,w,u", t=1e3), tmp_path / "c")
    assert "0.1 Hz is no rate of motion" in str(slow[1].fill_in)


def machine(seed: int, size: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, angle and torque of a pendulum with friction, its motion given; all times ``size``."""
    rng, t = np.random.default_rng(seed), np.arange(1600) / 200.0
    rate, phase = 2.0 * np.pi * rng.uniform(0.1, 0.9, 4), rng.uniform(0.0, 6.0, 4)
    waves = rate * t[:, None] + phase
    q, v, a = (0.5 * np.sum(x, axis=1) for x in (
        np.sin(waves) / rate, np.cos(waves), -rate * np.sin(waves)
    ))  # fmt: skip
    torque = 0.3 * a + 4.0 * np.sin(q) + 0.9 * np.tanh(v / 1e-3) + 0.8 * v
    return t, q, size * torque + 0.02 * rng.standard_normal(t.size)


def test_trials_side_by_side_are_read_as_the_session_says(tmp_path):
    (t, *one), (_, *two) = machine(1), machine(2)
    names = ("time_s", "angle_1", "torque_1", "angle_2", "torque_2")
    _, proposal = proposed_for(dict(zip(names, [t, *one, *two], strict=True)), tmp_path)
    (ask,) = proposal.fill_in
    (columns,) = re.findall("columns = {.*}", ask)
    path = tmp_path / "session.toml"
    further = f'[[trials]]\nfile = "a.parquet"\nkind = "free"\n{columns}\n'
    path.write_text(f"{path.read_text().replace('?', 'angle_1')}\n{further}")
    read = samples(tmp_path, tmp_path / "out", "a_2")
    np.testing.assert_allclose(read["q_joint"], two[0], atol=1e-6)
    np.testing.assert_allclose(read["force_drive"], two[1], atol=1e-5)


def test_a_record_of_unknown_rate_is_not_cut_and_lost_rows_are_counted(tmp_path):
    _, q, u = machine(4)
    session, _ = proposed_for({"angle_rad": q, "torque_Nm": u}, tmp_path)
    assert len(session["trials"]) == 1 and session["sample_rate_hz"] == "?"
    kept = np.r_[0:500, 520:1600]
    table = {"sample": np.arange(1600.0)[kept], "angle_rad": q[kept], "torque_Nm": u[kept]}
    session, proposal = proposed_for(table, tmp_path / "b")
    assert session["time"] == {"column": "sample", "unit": "ticks", "ticks_per_s": 0.0}
    assert "sample numbers the rows, and some are lost" in proposal.fill_in[0]
    table |= {"sample": table["sample"] % 256.0, "fs": np.full(1580, 200.0)}
    kept = np.delete(np.arange(500, 1580), [99, 700])
    session, proposal = proposed_for({n: v[kept] for n, v in table.items()}, tmp_path / "c")
    assert session["time"]["ticks_per_s"] == 200.0 == session["sample_rate_hz"]


def test_what_needs_a_gain_gets_wide_priors(tmp_path):
    t, q, u = machine(5)
    named = {"torque_Nm": 1.0, "torque_percent": 9.0, "moment [Nm/kg]": 2.0, "motor_torque_Nm": 3.0}
    for name, scale in named.items():
        proposed_for({"time_s": t, "angle_rad": q, name: scale * u}, tmp_path / f"{scale}")
        device = tomllib.loads((tmp_path / f"{scale}/device.toml").read_text())
        inertia = device["parameters"]["inertia"]
        assert inertia["sd"] == pytest.approx((5, 100)[scale > 1] * inertia["prior"], rel=0.05)


def test_what_a_drive_moves_is_the_axis_and_a_named_force_comes_before_looks(tmp_path):
    t, q, u = machine(6)
    table = {"t": t, "x_mm": q, "F_pull_N": u.clip(0.0), "F_push_N": (-u).clip(0.0)}
    _, proposal = proposed_for(table, tmp_path / "c")
    assert any("F_push_N may act on the axis, too, and is not used" in x for x in proposal.check)
    table = {"t": t, "q_rad": q, "abs_torque": np.abs(u), "torque_dir": (u < 0.0).astype(float)}
    assert proposed_for(table, tmp_path / "d")[0]["force"]["columns"] == ["abs_torque"]
    table = {"time_s": t, "pole_angle": np.sin(3.0 * t), "cart_angle": q, "torque_Nm": u}
    encoders = proposed_for(table, tmp_path)[0]["encoders"]
    assert [encoder["column"] for encoder in encoders.values()] == ["cart_angle"]
    v = np.gradient(q, t)
    table = {"t": t, "A": np.gradient(v, t), "D": q, "V": v, "F": u}
    assert proposed_for(table, tmp_path / "b")[0]["force"]["columns"] == ["F"]


T, Q, TAU = machine(3)
MS = np.rint(1e3 * (T - T[0])).astype(int) + 400


def write_clocked(folder: Path, columns: dict[str, np.ndarray], above: str = "") -> None:
    rows = np.column_stack([*columns.values(), np.rad2deg(Q), TAU])
    head = ",".join((*columns, "angle_deg", "torque_nm"))
    np.savetxt(folder / "a.csv", rows, "%.7f", ",", header=above + head, comments="")


@pytest.mark.parametrize(
    "clock",
    [{"sec": MS // 1000, "msec": MS % 1000}, {"millis": MS % 1000}],
    ids=["two columns", "restarts every second"],
)
def test_a_clock_that_starts_again_every_second_is_one_clock(tmp_path, clock):
    write_clocked(tmp_path, clock)
    session, proposal = proposed(tmp_path)
    assert not proposal.fill_in and "recording" not in session["trials"][0]
    found = samples(tmp_path, tmp_path / "out", None)
    assert len(found) == len(T)


@pytest.mark.parametrize("line", ["Sampling Rate (Hz),{hz:g}", "# dt: {dt:g}", "fs = {khz:g} kHz"])
def test_a_rate_above_the_table_is_that_of_its_samples(tmp_path, line: str):
    dt = float(np.median(np.diff(T)))
    write_clocked(tmp_path, {}, line.format(hz=1 / dt, dt=dt, khz=1e-3 / dt) + "\n")
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
