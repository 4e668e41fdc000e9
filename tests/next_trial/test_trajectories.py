"""Trajectories for drives, held against their limits by a reader of their files alone."""

import io
import json
from collections import namedtuple
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from bampipe.data.device_file import read_device_file
from bampipe.errors import InputError
from bampipe.next_trial.design_sentence import describe_design
from bampipe.next_trial.primitives import Envelope, Primitive, find_beyond
from bampipe.next_trial.rehearsal import Rehearsal
from bampipe.next_trial.trajectory import HZ, Points, list_trajectories, read_limits, require_limits
from bampipe.physics import Model, compile_model, registry
from bampipe.physics.device import Device
from bampipe.trials.kinematics import AxisFilter, Kinematics
from bampipe.trials.sensors import Sensors

INERTIAL = """<inertial><origin xyz="0.2 0.02 0.03" rpy="0.2 0 0.1"/><mass value="{}"/>
<inertia ixx="0.02" ixy="0.001" ixz="0" iyy="0.05" iyz="0" izz="0.04"/></inertial>"""
JOINT = """<joint name="{name}" type="{kind}"><origin xyz="0.3 0 0.1" rpy="0.3 0 0"/>
<parent link="{parent}"/><child link="{name}_link"/><axis xyz="{axis}"/>
<limit lower="{low}" upper="{high}" effort="{effort}" velocity="{speed}"/></joint>"""
JOINTS = (
    ("lift-1", "revolute", "base", "0 1 0", -1.5, 1.2, 60.0, 2.0),
    ("turn-2", "revolute", "lift-1_link", "0 0 1", -2.0, 2.5, 12.0, 3.0),
    ("slide-3", "prismatic", "turn-2_link", "1 0 0", -0.1, 0.3, 30.0, 0.4),
)
KEYS = ("name", "kind", "parent", "axis", "low", "high", "effort", "speed")
AXES = ("lift_1", "turn_2", "slide_3")
MASSES = (3.0, 2.0, 1.0)
VISCOUS, COULOMB, ROTOR = (2.0, 0.5, 4.0), (1.5, 0.8, 2.0), (0.2, 0.1, 0.5)
URDF = (
    '<robot name="arm"><link name="base"/>'
    + "".join(
        JOINT.format(**dict(zip(KEYS, row, strict=True)))
        + f'<link name="{row[0]}_link">{INERTIAL.format(mass)}</link>'
        for row, mass in zip(JOINTS, MASSES, strict=True)
    )
    + "</robot>"
)
SEEN = Envelope(
    low=np.array([-0.5, -0.6, 0.0]), high=np.array([0.4, 0.7, 0.1]),
    usual=np.array([0.0, 0.1, 0.05]), speed=np.array([0.8, 1.0, 0.15]),
    acceleration=np.array([4.0, 6.0, 1.2]), field=np.zeros(3), levels={},
)  # fmt: skip


def device_of(folder: Path, more: str = "", urdf: str = URDF) -> Device:
    (folder / "arm.urdf").write_text(urdf)
    (folder / "device.toml").write_text(f'name = "arm"\n[robot]\nurdf = "arm.urdf"\n{more}')
    return registry.device_from(read_device_file(folder / "device.toml"))


def rehearse(device: Device) -> Rehearsal:
    system = compile_model(Model(device))
    p = system.prior.copy()
    for axis, v, c, r in zip(AXES, VISCOUS, COULOMB, ROTOR, strict=True):
        for name, value in (("viscous", v), ("coulomb", c)):
            p[system.index(f"{name}.{axis}")] = value
        p[system.index(f"rotor_inertia_{axis}")] = r
    filters = {axis: AxisFilter(25.0, 1e-5, 3) for axis in AXES}
    sensors = Sensors(200.0, np.full(3, 1e-5), np.full(3, 1e-5), np.full(3, 0.05))
    bounds = np.array([device.limits[axis] for axis in AXES])
    speeds = np.array([device.speed_limits[axis] for axis in AXES])
    kinematics = Kinematics("kalman", 200.0, filters, 25.0)
    return Rehearsal(system, p, sensors, kinematics, SEEN.widen(bounds, speeds), 0)


Read = namedtuple("Read", "t q qd qdd effort")
"""A trajectory as its file has it: (T,) and (T, 3)."""


def from_csv(text: str) -> Read:
    table = pd.read_csv(io.StringIO(text))
    parts = ([f"{n}_{axis}" for axis in AXES] for n in Read._fields[1:])
    return Read(table["t"].to_numpy(), *(table[names].to_numpy() for names in parts))


def from_message(found: dict) -> Read:
    assert found["joint_names"] == [row[0] for row in JOINTS]
    assert set(found) == {"header", "joint_names", "points"}
    clock = [one["time_from_start"] for one in found["points"]]
    names = ("positions", "velocities", "accelerations", "effort")
    columns = (np.array([one[name] for one in found["points"]]) for name in names)
    return Read(np.array([c["sec"] + 1e-9 * c["nanosec"] for c in clock]), *columns)


@pytest.fixture(scope="module")
def rehearsal(tmp_path_factory: pytest.TempPathFactory) -> Rehearsal:
    return rehearse(device_of(tmp_path_factory.mktemp("arm")))


@pytest.fixture(scope="module")
def drawn(rehearsal: Rehearsal) -> list[Primitive]:
    limits = read_limits(rehearsal.system.model.device, rehearsal.seen)
    return list_trajectories(rehearsal, limits, 20.0, 8)


def test_a_trajectory_keeps_its_limits_and_is_smooth(
    rehearsal: Rehearsal, drawn: list[Primitive]
) -> None:
    pin = pytest.importorskip("pinocchio")
    arm = pin.buildModelFromXML(URDF)
    arm.armature = np.array(ROTOR)
    data, effort = arm.createData(), np.array([row[6] for row in JOINTS])
    used = np.zeros(3)
    for design in drawn:
        read = from_csv(Points.of_series(design.series, rehearsal).text("csv", {}, ""))
        dt = 1.0 / HZ
        assert np.diff(read.t) == pytest.approx(dt)
        assert read.t[-1] == pytest.approx(design.part_s)
        # Motion as whoever drives it would find it, by differences of the positions alone.
        speed = np.diff(read.q, axis=0) / dt
        acceleration = np.diff(speed, axis=0) / dt
        low, high, most = (np.array([row[k] for row in JOINTS]) for k in (4, 5, 7))
        assert (read.q >= low).all() and (read.q <= high).all()
        assert (np.abs(speed) <= 0.91 * most).all()
        assert (np.abs(acceleration) <= 0.91 * SEEN.acceleration).all()
        for side in (0, -1):
            assert np.abs(read.q[side] - read.q[0]).max() < 1e-8
            assert np.abs(speed[side]).max() < 1e-3 and np.abs(acceleration[side]).max() < 0.02
        # Smooth: the acceleration makes no step between two points.
        steps = np.abs(np.diff(acceleration, axis=0)).max(axis=0)
        assert (steps < 0.12 * SEEN.acceleration).all()
        np.testing.assert_allclose(speed, 0.5 * (read.qd[1:] + read.qd[:-1]), atol=2e-3)
        np.testing.assert_allclose(acceleration, read.qdd[1:-1], atol=0.05)
        torque = np.array(
            [pin.rnea(arm, data, *row) for row in zip(read.q, read.qd, read.qdd, strict=True)]
        )
        width = [c.sign_width for c in rehearsal.system.model.device.coordinates]
        torque += read.qd * VISCOUS + np.tanh(read.qd / width) * COULOMB
        assert (np.abs(torque) <= 0.85 * effort).all()
        inside = np.abs(read.qd) > 10.0 * np.array(width)
        np.testing.assert_allclose(read.effort[inside], torque[inside], atol=0.05)
        used = np.maximum(used, np.abs(speed).max(axis=0) / most)
        assert any(find_beyond(design, rehearsal.seen)) == (design.parts == 2)
    # The limits are used, and not only kept.
    assert {design.parts for design in drawn} == {1, 2}
    assert used.max() > 0.5


def test_all_forms_say_the_same_and_name_the_joints_as_drawn(
    rehearsal: Rehearsal, drawn: list[Primitive]
) -> None:
    points = Points.of_series(drawn[0].series, rehearsal)
    names = {axis: row[0] for axis, row in zip(AXES, JOINTS, strict=True)}
    table = from_csv(points.text("csv", names, ""))
    message = yaml.safe_load(points.text("yaml", names, "what to do"))
    assert message == json.loads(points.text("json", names, "what to do"))
    read = from_message(message)
    for column, same in zip(read, table, strict=True):
        np.testing.assert_allclose(column, same, rtol=1e-8, atol=1e-9)
    store = pytest.importorskip("rosbags.typesys")
    types = store.get_typestore(store.Stores.ROS2_HUMBLE).types
    fields = types["trajectory_msgs/msg/JointTrajectoryPoint"].__dataclass_fields__
    assert set(message["points"][0]) == set(fields) - {"__msgtype__"}


def test_a_sentence_says_that_drives_follow_it(drawn: list[Primitive], rehearsal: Rehearsal):
    said = describe_design(drawn[0], rehearsal.seen, rehearsal.system.model.device)
    assert said.startswith(
        "Let the drives follow the trajectory, for 20 s in 2 trials of 10 s; this takes"
    )
    assert said.endswith("farther and faster than so far: try the way slowly first.")


def test_what_is_stated_in_the_device_file_joins_what_is_drawn(tmp_path: Path) -> None:
    more = "[limits.turn_2]\nacceleration = 2.5\neffort = 5.0\n"
    device = device_of(tmp_path, more)
    found = read_limits(device, SEEN)["turn_2"]
    assert (found.lower, found.upper, found.speed) == (-2.0, 2.5, 3.0)
    assert (found.acceleration, found.effort) == (2.5, 5.0)
    assert read_limits(device, SEEN)["lift_1"].acceleration == SEEN.acceleration[0]


def test_without_motors_or_limits_a_trajectory_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no motors .*by hand; --plan"):
        require_limits(registry.device("bam"), "here")
    drawn = URDF.replace('effort="12.0"', 'effort="0"').replace('velocity="0.4"', 'velocity="0"')
    device = device_of(tmp_path, urdf=drawn)
    with pytest.raises(
        InputError, match=r"speed of slide_3, effort of turn_2.*\[limits\.slide_3\]"
    ):
        require_limits(device, "here")


def test_a_drive_too_weak_for_the_weight_is_said(tmp_path: Path) -> None:
    device = device_of(tmp_path, "[limits.lift_1]\neffort = 8.0\n")
    weak = rehearse(device)
    with pytest.raises(InputError, match="at rest the model needs more than 80 %"):
        list_trajectories(weak, read_limits(device, SEEN), 20.0, 2)
