"""`bampipe init` on a folder with a URDF and a log of all joints."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from binary_logs import to_parquet
from independent import arm

import bampipe
from bampipe.data.device_file import read_device_file
from bampipe.data.session import read_session
from bampipe.diagnosis.candidates import list_candidates
from bampipe.errors import InputError
from bampipe.files import read_json
from bampipe.physics import Model, compile_model, registry
from bampipe.physics.robot import Motor
from bampipe.setup.drawn_bodies import WIDE, Drive, Losses
from bampipe.setup.proposal import ProposedSession, propose, write_proposal

Pair = tuple[float, float]
URDF = """<?xml version="1.0"?><robot name="arm">
<link name="base"/>
<link name="upper"><inertial><origin xyz="0.25 0 0"/><mass value="3"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
<link name="lower"><inertial><origin xyz="0.2 0 0"/><mass value="2"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.05" iyz="0" izz="0.05"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="40" velocity="3"/></joint>
<joint name="elbow" type="revolute"><origin xyz="0.5 0 0"/><parent link="upper"/>
<child link="lower"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="20" velocity="3"/>
</joint></robot>"""


def write_log(
    folder: Path, gains: Pair = (1.0, 1.0), swings: Pair = (1.0, 1.0), dry: float = 0.8
) -> pd.DataFrame:
    """A log of both joints at 200 Hz, 20 s; ``gains``: of the logged torque over the joint's."""
    (folder / "arm.urdf").write_text(URDF)
    (folder / "x.toml").write_text('name = "arm"\n[robot]\nurdf = "arm.urdf"\n')
    device = registry.device_from(read_device_file(folder / "x.toml"))
    (folder / "x.toml").unlink()
    system = compile_model(Model(device))
    t = np.arange(4000) / 200.0
    size, w = swings * np.array([0.7, 0.5]), 0.6 * np.pi * np.array([1.1, 1.7])
    turn = np.outer(t, w) + np.array([0.3, 1.1])
    q, qd, qdd = size * np.sin(turn), size * w * np.cos(turn), -size * w**2 * np.sin(turn)
    p = system.prior
    for axis in ("shoulder", "elbow"):
        p[system.index(f"viscous.{axis}")], p[system.index(f"coulomb.{axis}")] = 0.5, dry
    u = np.zeros((len(t), len(system.inputs)))
    torque = system.required(q, qd, qdd, np.zeros((len(t), 0)), u, p)
    torque = (torque + np.random.default_rng(0).normal(0.0, 0.05, torque.shape)) * gains
    table = {"time_s": t, "q1": q[:, 0], "q2": q[:, 1], "tau1": torque[:, 0], "tau2": torque[:, 1]}
    # An acceleration beside them is never taken for a drive.
    frame = pd.DataFrame(table | {"acc1": qdd[:, 0], "acc2": qdd[:, 1]})
    frame.to_parquet(folder / "log.parquet")
    return frame


def record_logs(folder: Path, *arm_of: Any, **how: Any) -> dict[str, Any]:
    """Logs of the simulator as Parquet; one trial tells as much as three. Returns the truth."""
    truth = arm.record_logs(folder, *arm_of, **{"trials": 1} | how)
    to_parquet(folder)
    return truth


def proposed(folder: Path) -> ProposedSession:
    proposal = propose(folder)
    write_proposal(folder, proposal)
    return proposal


def motors_of(folder: Path) -> dict[str, Motor]:
    """The motors in the proposed device file."""
    return registry.device_from(read_device_file(folder / "device.toml")).robot.motors


def about(proposal: ProposedSession, column: str) -> list[str]:
    own = (line for line in proposal.check if line.startswith(f"{column} is "))
    return [line for line in own if "drawing" in line]


def test_signs_and_reductions_are_tested_against_weight_and_inertia(tmp_path: Path) -> None:
    write_log(tmp_path, gains=(-1.0, 0.01))
    proposal = proposed(tmp_path)
    (sign,), (size,) = about(proposal, "tau1"), about(proposal, "tau2")
    assert "its sign is turned; or that of shoulder is the wrong one" in sign
    assert "the torque of a motor with a reduction of about" in size
    assert float(size.rpartition(" ")[2]) == pytest.approx(100.0, rel=0.1)


@pytest.mark.parametrize(("gain", "said"), [(1.0, "it is right"), (-1.0, "it is turned")])
def test_where_next_to_nothing_hangs_on_a_joint_friction_tells_the_sign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gain: float, said: str
) -> None:
    heavy = '<mass value="2"/>\n<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.05" iyz="0" izz="0.05"/>'
    light = heavy.replace('"2"', '"0.002"').replace('"0.01"', '"5e-5"').replace('"0.05"', '"5e-5"')
    assert heavy in URDF
    monkeypatch.setattr("test_robot_proposal.URDF", URDF.replace(heavy, light))
    write_log(tmp_path, gains=(1.0, gain))
    proposal = proposed(tmp_path)
    assert any(f"to tell its sign; by its friction {said}" in line for line in proposal.check)
    scale = {c.name: c.scale for c in read_session(tmp_path).channels}["torque_elbow"]
    assert scale == gain


def test_an_axis_that_its_drive_holds_keeps_its_priors(tmp_path: Path) -> None:
    write_log(tmp_path, swings=(1.0, 0.0))
    proposed(tmp_path)
    run = bampipe.run_session(tmp_path, runs=tmp_path / "runs", last="validate")
    found = read_json(run.root / "models/base/identify.json")["parameters"]
    held = [found[f"{name}.elbow"] for name in ("viscous", "coulomb")]
    assert all(abs(one["estimate"]) <= 1e-6 * one["sd"] for one in held), held
    names = list_candidates(registry.device_from(read_device_file(tmp_path / "device.toml")), ())
    others = [name for name in names if not name.startswith(("stribeck:", "quadratic_drag:"))]
    bampipe.diagnose(run, replicates=4, jobs=1, without=others)
    axes = read_json(run.root / "models/base/diagnose.json")["axes"]
    assert [axes[k]["verdict"] for k in ("shoulder", "elbow")] == ["nothing_missing", "no_verdict"]


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_slide_whose_mass_its_drive_may_have_is_turned_by_friction_alone(way: float) -> None:
    rate, change = np.random.default_rng(0).normal(size=(2, 500))
    columns = np.column_stack([change, rate, np.sign(rate)])
    powers = np.array([0.0, np.mean(rate**2), np.mean(np.abs(rate))])
    losses = Losses.of(columns, powers, way * (columns @ [3.0, 2.0, 1.0]), has_offset=False)
    held = losses.beside(losses.sums(change[None]), np.ones(1), 1.0, WIDE)
    assert held.is_turned == (way < 0.0) and held.share == 0.0 and not held.is_sure


def test_weight_that_would_make_friction_drive_the_joint_tells_no_sign() -> None:
    drive = Drive(share=-3.8, error=0.5, left=0.3, losses=40.0)
    assert not drive.is_sure and not drive.is_turned
    assert Drive(share=-0.9, error=0.1, left=0.1, losses=-40.0).is_turned
    assert Drive(share=-0.9, error=0.1, left=0.1, losses=0.5).is_turned


def test_a_position_beyond_the_range_is_said_with_what_may_explain_it(tmp_path: Path) -> None:
    write_log(tmp_path, swings=(8.0, 8.0))
    assert any("is the range of the drawing right?" in line for line in proposed(tmp_path).check)
    for name in ("session.toml", "device.toml"):
        (tmp_path / name).unlink()
    table = write_log(tmp_path)
    rng = np.random.default_rng(0)
    table[["q1", "q2"]] *= 50.0
    table[["tau1", "tau2"]] = rng.normal(size=(len(table), 2))
    table.to_parquet(tmp_path / "log.parquet")
    assert any("a position of the motor," in line for line in proposed(tmp_path).check)


NAMES = ("base_yaw", "shoulder", "elbow", "forearm", "wrist_pitch", "wrist_yaw", "flange")


def paired(folder: Path) -> tuple[dict[str, str], dict[str, str], ProposedSession]:
    """Columns of positions and of drives by joint, as proposed for a log of the simulator."""
    proposal = proposed(folder)
    session = read_session(folder)
    drives = {c.name.partition("_")[2]: c.column for c in session.channels}
    return {e.name: e.column for e in session.encoders}, drives, proposal


def test_columns_with_the_names_of_joints_go_to_these_joints(tmp_path: Path) -> None:
    # Speeds of the joints differ little: what follows the motion of one fits others, too.
    record_logs(tmp_path / "log", 3, "ZYZYZYZ", style="joint_states", turned=["elbow"])
    positions, drives, proposal = paired(tmp_path / "log")
    assert positions == {name: f"/joint_states/{name}/position" for name in NAMES}
    assert drives == {name: f"/joint_states/{name}/effort" for name in NAMES}
    turned = {c.name for c in read_session(tmp_path / "log").channels if c.scale < 0.0}
    assert turned == {"torque_elbow"}
    assert proposal.fill_in == []


def test_columns_called_as_the_joints_are_positions_and_files_tell_what_is_in_them(
    tmp_path: Path,
) -> None:
    frame = write_log(tmp_path)
    frame = frame.rename(
        columns={"q1": "shoulder", "q2": "elbow", "tau1": "T1_Nm", "tau2": "F2_Nm"}
    )
    frame.drop(columns=["acc1", "acc2"]).to_parquet(tmp_path / "log.parquet")
    positions, drives, _ = paired(tmp_path)
    assert positions == {"shoulder": "shoulder", "elbow": "elbow"}
    assert drives == {"shoulder": "T1_Nm", "elbow": "F2_Nm"}
    other = tmp_path / "other"
    other.mkdir()
    (tmp_path / "arm.urdf").rename(other / "arm.urdf")
    for name, columns in (("angles", ["shoulder", "elbow"]), ("torques", ["T1_Nm", "F2_Nm"])):
        part = frame[["time_s", *columns]].set_axis(["time", "field.j1", "field.j2"], axis=1)
        part.to_parquet(other / f"run_joint_{name}.parquet")
    drives = {"shoulder": "joint_torques:field.j1", "elbow": "joint_torques:field.j2"}
    assert paired(other)[1] == drives


def test_numbers_without_names_may_count_joints_in_alphabetical_order(tmp_path: Path) -> None:
    record_logs(tmp_path / "log", 4, "ZYYX", style="indexed")
    positions, drives, proposal = paired(tmp_path / "log")
    order = {name: place for place, name in enumerate(sorted(NAMES[:4]))}
    assert positions == {name: f"position[{place}]" for name, place in order.items()}
    assert drives == {name: f"effort[{place}]" for name, place in order.items()}
    (said,) = (line for line in proposal.check if "alphabetical order" in line)
    here, there = (float(share) for share in re.findall(r"([\d.]+)%", said))
    assert here > 95.0 > there


def test_degrees_and_millimetres_of_numbered_joints(tmp_path: Path) -> None:
    arm.record_logs(tmp_path / "log", 5, "ZYyX", style="numbered", turned=["shoulder"])
    positions, drives, _ = paired(tmp_path / "log")
    units = ("deg", "deg", "mm", "deg")
    assert list(positions.values()) == [f"q_{k} [{u}]" for k, u in enumerate(units, 1)]
    units = ("Nm", "Nm", "N", "Nm")
    assert list(drives.values()) == [f"tau_{k} [{u}]" for k, u in enumerate(units, 1)]
    assert [c.unit for c in read_session(tmp_path / "log").channels] == ["N.m", "N.m", "N", "N.m"]
    bampipe.run_session(tmp_path / "log", runs=tmp_path / "runs", last="ingest")


def test_torque_constants_are_proposed_by_the_drawing(tmp_path: Path) -> None:
    truth = record_logs(tmp_path / "log", 6, "ZYYX", style="controller", drawing_error=0.02)
    positions, drives, _ = paired(tmp_path / "log")
    assert list(positions.values()) == [f"actual_q_{k}" for k in range(4)]
    assert list(drives.values()) == [f"actual_current_{k}" for k in range(4)]
    constants = [motor.torque_constant for motor in motors_of(tmp_path / "log").values()]
    np.testing.assert_allclose(constants, truth["constants"], rtol=0.1)


@pytest.mark.slow
def test_all_torque_constants_but_one_are_estimated(tmp_path: Path) -> None:
    """A drawing that is off gives constants that are off, each by its own: drives would lack it."""
    truth = record_logs(tmp_path / "log", 6, "ZYYX", style="controller", drawing_error=0.15)
    paired(tmp_path / "log")
    motors = motors_of(tmp_path / "log")
    (known,) = [k for k, m in enumerate(motors.values()) if m.torque_constant_sd is None]
    bampipe.run_session(tmp_path / "log", runs=tmp_path / "runs", last="identify")
    found = read_json(tmp_path / "runs/log/models/base/identify.json")["parameters"]
    guesses = np.array([motor.torque_constant for motor in motors.values()])
    estimates = [
        found[f"torque_constant_{name}"]["estimate"] if k != known else guesses[k]
        for k, name in enumerate(motors)
    ]
    scale, estimated = (x / np.array(truth["constants"]) for x in (guesses, estimates))
    assert np.ptp(scale) > 0.05
    np.testing.assert_allclose(estimated, scale[known], rtol=0.01)


@pytest.mark.long
def test_the_torque_constant_of_a_last_joint_stays_where_noise_is_large(tmp_path: Path) -> None:
    """Nothing behind that joint tells its scale but its drawing, and its model lacks an offset."""
    truth = record_logs(
        tmp_path / "log", 71003, "ZYYX", {"drive_offset:forearm": 1.0}, style="controller",
        trials=2, seconds=8.0, rate_hz=125.0, noise=0.2,
    )  # fmt: skip
    paired(tmp_path / "log")
    bampipe.run_session(tmp_path / "log", runs=tmp_path / "runs", last="identify")
    identified = read_json(tmp_path / "runs/log/models/base/identify.json")
    found = identified["parameters"]
    scale = {
        name: found[f"torque_constant_{name}"]["estimate"] / constant
        for name, constant in zip(arm.NAMES, truth["constants"], strict=False)
        if name != "base_yaw"
    }
    assert scale["elbow"] == pytest.approx(scale["shoulder"], rel=0.02)
    assert scale["forearm"] > 0.2
    # Nor does it go to zero where a trial is left out.
    for moves in identified["influence"]["trials"].values():
        assert all(abs(moves[f"torque_constant_{name}"]) < 1.0 for name in scale)


def test_reductions_of_a_log_from_the_motors_side_follow_from_the_drawing(tmp_path: Path) -> None:
    truth = record_logs(
        tmp_path / "log", 7, "ZYY", style="motor", drawing_error=0.03, turned=["elbow"]
    )
    _, _, proposal = paired(tmp_path / "log")
    session = read_session(tmp_path / "log")
    gears = [encoder.gear_ratio for encoder in session.encoders]
    np.testing.assert_allclose(gears, truth["ratio"], rtol=0.05)
    turns = [next(iter(motor.turns.values())) for motor in motors_of(tmp_path / "log").values()]
    np.testing.assert_allclose(turns, gears, rtol=0.01)
    assert {c.name for c in session.channels if c.scale < 0.0} == {"torque_elbow"}
    assert proposal.fill_in == []


def test_reductions_of_a_device_file_beside_the_logs_are_taken(tmp_path: Path) -> None:
    """Also of currents, of which the drawing tells no reductions, and of a motor that is turned."""
    folder = tmp_path / "log"
    truth = record_logs(folder, 41, "ZYYX", style="motor", drawing_error=0.1)
    turns = [*truth["ratio"]]
    turns[2] *= -1.0
    table = pd.read_parquet(folder / "log_01.parquet")
    table.columns = table.columns.str.replace("_nm", "_A")
    table["act_pos_mot_deg_2"] *= (turns[1] + 0.0625) / turns[1]
    turns[1] += 0.0625
    for column in ("act_pos_mot_deg_3", "act_torque_mot_A_3"):
        table[column] *= -1.0
    table.to_parquet(folder / "log_01.parquet")
    lines = ['name = "arm"', "[robot]", 'urdf = "arm.urdf"']
    for name, ratio in zip(NAMES[:4], turns, strict=True):
        lines += [f"[robot.motors.{name}]", f"turns = {{ {name} = {ratio} }}"]
        lines += ["torque_constant = 1.0"]
    (folder / "device.toml").write_text("\n".join(lines))
    _, _, proposal = paired(folder)
    session = read_session(folder)
    assert [encoder.gear_ratio for encoder in session.encoders] == turns
    assert all(encoder.zero == 0.0 for encoder in session.encoders)
    assert all(channel.scale == 1.0 for channel in session.channels)
    assert any("as the device file says" in line for line in proposal.check)
    assert proposal.device == ""


@pytest.mark.parametrize(
    ("gain", "dry"), [(0.01, 20.0), (0.01, 0.8), pytest.param(1.0, 0.8, marks=pytest.mark.long)]
)
def test_many_radians_of_a_motor_are_no_degrees_though_these_stay_in_the_range(
    tmp_path: Path, gain: float, dry: float
) -> None:
    """A hundred turns read as degrees are 1.7 times the joint's angle; torques are of either."""
    table = write_log(tmp_path, (gain, gain), dry=dry)
    table[["q1", "q2"]] *= 100.0
    ends = {"q1": "q1_rad", "q2": "q2_rad"} if dry > 1.0 else {}
    table.rename(columns=ends).to_parquet(tmp_path / "log.parquet")
    proposed(tmp_path)
    encoders = read_session(tmp_path).encoders
    assert [encoder.stated_unit for encoder in encoders] == ["rad"] * 2
    np.testing.assert_allclose([e.gear_ratio for e in encoders], 100.0, rtol=0.03)
    assert [encoder.scale_sd for encoder in encoders] == [0.1] * 2


@pytest.mark.parametrize("names", [("tau1", "tau2"), ("effort_shoulder", "effort_elbow")])
def test_a_drive_that_was_not_logged_is_asked_for_and_the_other_stays_where_it_is(
    tmp_path: Path, names: tuple[str, str]
) -> None:
    table = write_log(tmp_path).drop(columns="tau1")
    table.rename(columns={"tau2": names[1]}).to_parquet(tmp_path / "log.parquet")
    proposal = proposed(tmp_path)
    assert "the column of torque_shoulder in N.m. To find it: see the" in proposal.fill_in[0]
    assert f'torque_elbow = {{ column = "{names[1]}"' in proposal.session
    with pytest.raises(InputError, match="fill in the name of the column") as caught:
        read_session(tmp_path)
    assert "channels.torque_shoulder.column" in str(caught.value)
    (tmp_path / "session.toml").unlink()
    table = write_log(tmp_path).rename(columns={"tau1": "shoulder_moment", "tau2": names[1]})
    table.to_parquet(tmp_path / "log.parquet")
    assert 'torque_shoulder = { column = "shoulder_moment"' in propose(tmp_path).session


FINGERS = """<link name="left"/><link name="right"/>
<joint name="finger_left" type="prismatic"><parent link="lower"/><child link="left"/></joint>
<joint name="finger_right" type="prismatic"><parent link="lower"/><child link="right"/></joint>
</robot>"""


def test_a_robot_with_fingers_that_rest_ends_before_them(tmp_path: Path) -> None:
    """And joints in units of their own, with encoders on both sides of their gears, are paired."""
    log = write_log(tmp_path)
    (tmp_path / "arm.urdf").write_text(URDF.replace("</robot>", FINGERS))
    moved = {"q1_deg": np.rad2deg(log["q1"]), "q2_rad": log["q2"], "finger_left_pos": 0.02}
    motors = {f"motor_q{k}": 50.0 * log[f"q{k}"] for k in (1, 2)}
    drives = {"torque_1": log["tau1"], "force_2": log["tau2"]}
    table = log[["time_s", "acc1", "acc2"]].assign(**moved, **motors, **drives)
    table.to_parquet(tmp_path / "log.parquet")
    proposal = proposed(tmp_path)
    session = read_session(tmp_path)
    encoders = [(e.column, e.stated_unit) for e in session.encoders]
    assert encoders == [("q1_deg", "deg"), ("q2_rad", "rad")] and proposal.fill_in == []
    assert [c.column for c in session.channels] == ["torque_1", "force_2"]
    assert any("agree with weight and inertia" in line for line in proposal.check)
    assert any("the robot ends at lower" in line for line in proposal.check)
    device = registry.device_from(read_device_file(tmp_path / "device.toml"))
    assert [c.name for c in device.coordinates] == ["shoulder", "elbow"]


def test_files_of_which_none_is_that_of_the_robot_are_refused(tmp_path: Path) -> None:
    write_log(tmp_path)
    (tmp_path / "other.urdf").write_text(URDF)
    with pytest.raises(InputError, match=r"2 files of robots: arm.urdf, other.urdf"):
        propose(tmp_path)
    (tmp_path / "other.urdf").unlink()
    (tmp_path / "arm.urdf").rename(tmp_path / "arm.urdf.xacro")
    with pytest.raises(InputError, match=r"macros that are no URDF yet; expand it first: xacro"):
        propose(tmp_path)


def test_columns_may_lack_what_all_joints_are_called(tmp_path: Path) -> None:
    names = {"q1": "Shoulder angle", "q2": "Elbow angle", "tau1": "Shoulder Nm", "tau2": "Elbow Nm"}
    table = write_log(tmp_path).rename(columns=names)
    table[[*table.columns[[0, 2, 1, 4, 3]]]].to_parquet(tmp_path / "log.parquet")
    urdf = URDF.replace('name="shoulder"', 'name="shoulder_lift"')
    (tmp_path / "arm.urdf").write_text(urdf.replace('name="elbow"', 'name="elbow_lift"'))
    session = propose(tmp_path).session
    assert 'elbow_lift = { column = "Elbow angle"' in session
    assert 'torque_shoulder_lift = { column = "Shoulder Nm"' in session


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<mujoco><worldbody><body></worldbody>", "not XML: mismatched tag"),
        (f"<mujoco>{'<body>' * 300}{'</body>' * 300}</mujoco>", "nested more than 200 deep"),
    ],
)
def test_an_mjcf_that_cannot_be_read_is_not_skipped(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "arm.xml").write_text(text)
    t = np.arange(400) / 100.0
    table = pd.DataFrame({"t": t, "position": np.sin(t), "current": np.cos(t)})
    table.to_parquet(tmp_path / "log.parquet")
    with pytest.raises(InputError, match=said) as caught:
        propose(tmp_path)
    assert "take it out of the folder" in str(caught.value)
    (tmp_path / "arm.xml").write_text("<recording><channel></recording>")
    assert propose(tmp_path)


QUARTER = np.pi / 2.0


@pytest.mark.parametrize(
    ("counted", "turned"),
    [
        pytest.param({}, [], id="as drawn"),
        pytest.param(
            {"shoulder": (1.0, -QUARTER), "elbow": (1.0, QUARTER)}, [],
            id="two quarter turns", marks=pytest.mark.long,
        ),
        pytest.param({"elbow": (1.0, np.pi)}, ["shoulder"], id="half a turn, a drive turned"),
        pytest.param(
            {"shoulder": (-1.0, QUARTER)}, [], id="the other way round", marks=pytest.mark.long
        ),
        pytest.param(
            {"shoulder": (-1.0, 0.0), "elbow": (1.0, QUARTER)}, ["shoulder"], id="as if hanging"
        ),
    ],
)  # fmt: skip
def test_joints_counted_otherwise_than_drawn(
    tmp_path: Path, counted: dict[str, tuple[float, float]], turned: list[str]
) -> None:
    """Six joints; without their zeros half of the drives look turned, and none is."""
    arm = (7, "ZYY") if set(turned) & set(counted) else (21, "ZYYXYX")
    record_logs(tmp_path / "log", *arm, style="joint_states", turned=turned)
    table = pd.read_parquet(tmp_path / "log/log_01.parquet")
    for joint, (direction, zero) in counted.items():
        column = f"/joint_states/{joint}/position"
        table[column] = direction * table[column] + zero
        table[column.replace("position", "velocity")] *= direction
    table.to_parquet(tmp_path / "log/log_01.parquet")
    _, _, proposal = paired(tmp_path / "log")
    session = read_session(tmp_path / "log")
    for encoder in session.encoders:
        direction, zero = counted.get(encoder.name, (1.0, 0.0))
        assert encoder.gear_ratio == direction
        off = np.remainder(encoder.zero - zero + 0.1, 2.0 * np.pi)
        assert off < 0.2, (encoder.name, encoder.zero)
    drives = {c.name.partition("_")[2] for c in session.channels if c.scale < 0.0}
    assert drives == set(turned)
    said = [line for line in proposal.check if "by weight and inertia as drawn: look it up" in line]
    assert len(said) == len(counted)


@pytest.mark.parametrize(
    "down",
    [
        pytest.param((1.0, 0.0, 0.0), id="side", marks=pytest.mark.long),
        pytest.param((0.0, 0.0, 1.0), id="ceiling", marks=pytest.mark.long),
        pytest.param((0.0, 1.0, -1.0), id="tilted"),
    ],
)
def test_gravity_of_a_base_that_lies(tmp_path: Path, down: tuple[float, float, float]) -> None:
    """With a joint that counts the other way, and a drive that is turned."""
    gravity = 9.81 * np.array(down) / np.linalg.norm(down)
    record_logs(
        tmp_path / "log", 21, "ZYYX", style="joint_states", turned=["shoulder"],
        gravity=gravity,
    )  # fmt: skip
    table = pd.read_parquet(tmp_path / "log/log_01.parquet")
    table[["/joint_states/elbow/position", "/joint_states/elbow/velocity"]] *= -1.0
    table.to_parquet(tmp_path / "log/log_01.parquet")
    _, _, proposal = paired(tmp_path / "log")
    assert any("in the frame of the base, by weight and inertia" in line for line in proposal.check)
    device = read_device_file(tmp_path / "log/device.toml")
    assert device["robot"]["gravity"] == pytest.approx(list(gravity), abs=0.01)
    session = read_session(tmp_path / "log")
    assert [e.name for e in session.encoders if e.gear_ratio < 0.0] == ["elbow"]
    assert [c.name for c in session.channels if c.scale < 0.0] == ["torque_shoulder"]


def test_a_heavy_tool_is_said_with_the_payload_that_it_suggests(tmp_path: Path) -> None:
    record_logs(
        tmp_path / "log", 6, "ZYYX", style="joint_states", drawing_error=0.0,
        heavier={"forearm": 4.0},
    )  # fmt: skip
    _, _, proposal = paired(tmp_path / "log")
    (said,) = (line for line in proposal.check if "times as heavy as drawn" in line)
    assert "on forearm is about 4 times" in said
    true = arm.build("ZYYX", 6)
    mass, center = re.search(r"mass = (.*), center = \[(.*)\]", said).groups()  # type: ignore[union-attr]
    assert float(mass) == pytest.approx(3.0 * true.mass[3], rel=0.1)
    placed = [float(v) for v in center.split(",")]
    assert placed == pytest.approx(list(true.center[3]), abs=0.05)


HAND = "".join(
    f'''<link name="{side}"/><joint name="{side}_finger" type="prismatic"><parent link="lower"/>
<child link="{side}"/><axis xyz="0 1 0"/><limit lower="0" upper="0.1" effort="1" velocity="1"/>
</joint>'''
    for side in ("left", "right")
)


def test_a_robot_whose_urdf_shows_more_ends_with_the_last_joint_logged(tmp_path: Path) -> None:
    """A service robot: wheels on the base, fingers behind the arm."""
    write_log(tmp_path)
    wheel = HAND.replace("lower", "base").replace("left", "wheel_a").replace("right", "wheel_b")
    (tmp_path / "arm.urdf").write_text(URDF.replace("</robot>", HAND + wheel + "</robot>"))
    with pytest.raises(InputError, match=r"write device\.toml beside the logs") as refused:
        propose(tmp_path)  # q1 and q2 name no joint
    assert "tip = " in str(refused.value)
    names = {
        f"{c}{k}": f"{j}_{c}" for k, j in ((1, "shoulder"), (2, "elbow")) for c in ("q", "tau")
    }
    table = pd.read_parquet(tmp_path / "log.parquet").rename(columns=names)
    table.to_parquet(tmp_path / "log.parquet")
    proposal = proposed(tmp_path)
    assert 'tip = "lower"' in proposal.device
    assert {e.name: e.column for e in read_session(tmp_path).encoders} == {
        "shoulder": "shoulder_q", "elbow": "elbow_q"
    }  # fmt: skip


def test_joint_states_in_a_bag_go_to_the_joints_that_they_name(tmp_path: Path) -> None:
    """Joints are named in brackets there, where tables have units."""
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    table = write_log(tmp_path, gains=(1.0, -1.0))
    (tmp_path / "log.parquet").unlink()
    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    state, header, time = (store.types[kind] for kind in kinds)
    with Writer(tmp_path / "rec", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topic = bag.add_connection("/joint_states", kinds[0], typestore=store)
        for late, row in enumerate(table.itertuples()):
            nanoseconds = round(row.time_s * 1e9)
            stamp = time(100 + nanoseconds // 10**9, nanoseconds % 10**9)
            pairs = ((row.q2, row.q1), (row.q2 * 0.0, row.q1 * 0.0), (row.tau2, row.tau1))
            values = [np.array(pair) for pair in pairs]  # in the order of the alphabet
            message = state(header(stamp, ""), ["elbow", "shoulder"], *values)
            recorded = 100 * 10**9 + nanoseconds + (late % 7) * 10**5
            bag.write(topic, recorded, store.serialize_cdr(message, kinds[0]))
    proposal = proposed(tmp_path)
    session = read_session(tmp_path)
    assert 'column = "/joint_states:header.stamp"' in proposal.session
    joints = ("shoulder", "elbow")
    assert {e.name: e.column for e in session.encoders} == {
        name: f"/joint_states:position[{name}]" for name in joints
    }
    assert {c.name: c.column for c in session.channels} == {
        f"torque_{name}": f"/joint_states:effort[{name}]" for name in joints
    }
    assert [c.scale for c in session.channels] == [1.0, -1.0]
    assert proposal.fill_in == []


@pytest.mark.long
def test_zeros_of_a_log_from_the_motors_side(tmp_path: Path) -> None:
    """Reductions and zeros hide each other: neither alone lets the drawing explain the drives."""
    truth = record_logs(
        tmp_path / "log", 22, "ZYYX", style="motor", drawing_error=0.03, turned=["elbow"]
    )
    counted = {"shoulder": (1.0, -QUARTER), "elbow": (-1.0, QUARTER)}
    table = pd.read_parquet(tmp_path / "log/log_01.parquet")
    for number, name in enumerate(NAMES[:4], 1):
        direction, zero = counted.get(name, (1.0, 0.0))
        column, turns = f"act_pos_mot_deg_{number}", truth["ratio"][number - 1]
        table[column] = direction * table[column] + np.rad2deg(zero) * turns
    table.to_parquet(tmp_path / "log/log_01.parquet")
    paired(tmp_path / "log")
    for encoder, turns in zip(read_session(tmp_path / "log").encoders, truth["ratio"], strict=True):
        direction, zero = counted.get(encoder.name, (1.0, 0.0))
        assert encoder.gear_ratio == pytest.approx(direction * turns, rel=0.05)
        assert encoder.zero == pytest.approx(np.rad2deg(zero) * turns, rel=0.05, abs=1e-9)
    turned = {c.name for c in read_session(tmp_path / "log").channels if c.scale < 0.0}
    assert turned == {"torque_elbow"}


def test_what_nothing_tells_of_counts_currents_and_shares_is_asked_once(tmp_path: Path) -> None:
    table = write_log(tmp_path)
    for name, per in (("tau{} (%)", "%"), ("torque_pct_{}", "pct")):
        share = table.rename(columns={f"tau{n}": name.format(n) for n in (1, 2)})
        share.to_parquet(tmp_path / "log.parquet")
        (asked,) = propose(tmp_path).fill_in
        assert asked.startswith(f"the scale of torque_shoulder and torque_elbow, N.m for one {per}")
    table[["q1", "q2"]] = np.rint(652.0 * table[["q1", "q2"]])
    table.columns = table.columns.str.replace("tau", "current")
    table.to_parquet(tmp_path / "log.parquet")
    constants, counts = proposed(tmp_path).fill_in
    assert constants.startswith("torque_constant of each motor in device.toml")
    assert counts.startswith("counts_per_unit of shoulder and elbow, the counts in one rad")
    with pytest.raises(InputError, match=r'torque_constant: found "\?"'):
        registry.device_from(read_device_file(tmp_path / "device.toml"))


def test_joints_called_otherwise_are_in_order_unless_a_name_contradicts(tmp_path: Path):
    table = write_log(tmp_path)
    for first, last, fits in (("base", "elbow", True), ("elbow", "tip", False)):
        ends = ("pos_rad", "torque_Nm", "acc")
        table.columns = ["time_s", *(f"{j}_{x}" for x in ends for j in (first, last))]
        table.to_parquet(tmp_path / "log.parquet")
        proposed = propose(tmp_path)
        assert "are taken in the order of their columns" in " ".join(proposed.check) or not fits
        assert bool(proposed.fill_in) is not fits
