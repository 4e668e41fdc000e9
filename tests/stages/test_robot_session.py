"""A robot from URDF and log to parameters, beside a truth that Pinocchio simulates."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import bampipe
from bampipe.data.device_file import read_device_file
from bampipe.data.run_folder import RunFolder
from bampipe.files import read_json
from bampipe.physics.base_parameters import base_parameters
from bampipe.physics.registry import device_from

pin = pytest.importorskip("pinocchio")

JOINTS = ("turn", "lift", "bend")
VISCOUS, COULOMB, ROTOR = np.array([2.0, 1.5, 0.8]), np.array([1.5, 1.2, 0.6]), 0.05
RATE, STEP = 250.0, 5e-4
ENCODER, SENSOR = 2e-5, 0.05

LINK = """<link name="{name}"><inertial><origin xyz="{x} 0.02 {z}" rpy="0.1 0 0"/>
<mass value="{mass}"/><inertia ixx="{i}" ixy="0" ixz="0.001" iyy="{j}" iyz="0" izz="{j}"/>
</inertial></link>"""
JOINT = """<joint name="{name}" type="revolute"><origin xyz="{x} 0 0.1" rpy="{roll} 0 0"/>
<parent link="{parent}"/><child link="{name}_link"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="60" velocity="4"/></joint>"""


def urdf(heavier: float) -> str:
    """The arm; ``heavier``: by how much its bodies differ from the drawing."""
    parts, parent = ['<link name="base"/>'], "base"
    for k, name in enumerate(JOINTS):
        mass = (4.0 - k) * heavier
        size = {"i": 0.01 * mass, "j": 0.03 * mass}
        parts.append(LINK.format(name=f"{name}_link", x=0.15 / heavier, z=0.03, mass=mass, **size))
        roll = -1.57079632679 if k == 1 else 0.0
        parts.append(JOINT.format(name=name, parent=parent, x=0.3 if k else 0.0, roll=roll))
        parent = f"{name}_link"
    return f'<robot name="arm">{"".join(parts)}</robot>'


def wanted(t: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    waves = [(a, f, rng.uniform(0, 6.28, 3)) for a, f in ((0.5, 0.21), (0.25, 0.53), (0.12, 1.1))]
    shift = 1.0 + 0.13 * np.arange(3)
    return sum(a * np.sin(2 * np.pi * f * shift * t[:, None] + phase) for a, f, phase in waves)


def simulate(seed: int, seconds: float) -> pd.DataFrame:
    """The true arm under a controller, integrated in small steps, read by its sensors."""
    model = pin.buildModelFromXML(urdf(1.15))
    model.armature = np.full(3, ROTOR)
    data = model.createData()
    t = np.arange(0.0, seconds, STEP)
    goal = wanted(t, seed)
    q, qd = goal[0].copy(), np.gradient(goal[:2], STEP, axis=0)[0]
    skip = round(1.0 / RATE / STEP)
    rows, torque = [], np.zeros(3)
    for i in range(len(t)):
        if i % skip == 0:  # held between samples, as a drive holds it
            speed = (goal[min(i + skip, len(t) - 1)] - goal[i]) / (skip * STEP)
            torque = 900.0 * (goal[i] - q) + 40.0 * (speed - qd)
            rows.append([t[i], *q, *torque])
        friction = VISCOUS * qd + COULOMB * np.tanh(qd / 1e-3)
        qd = qd + STEP * pin.aba(model, data, q, qd, torque - friction)
        q = q + STEP * qd
    table = np.array(rows)
    rng = np.random.default_rng([seed, 1])
    table[:, 1:4] = np.round(table[:, 1:4] / ENCODER) * ENCODER
    table[:, 4:] += rng.normal(0.0, SENSOR, table[:, 4:].shape)
    names = ["t_s", *(f"q_{j}_rad" for j in JOINTS), *(f"torque_{j}" for j in JOINTS)]
    return pd.DataFrame(table, columns=names)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    folder = tmp_path_factory.mktemp("robot") / "arm"
    folder.mkdir()
    (folder / "arm.urdf").write_text(urdf(1.0))
    (folder / "device.toml").write_text('name = "arm"\n[robot]\nurdf = "arm.urdf"\n')
    lines = [
        'schema = "bampipe.session/1"', 'session_id = "arm"', 'device = "device.toml"',
        f"sample_rate_hz = {RATE}", "[time]", 'column = "t_s"', 'unit = "s"',
    ]  # fmt: skip
    for joint in JOINTS:
        lines += [f"[encoders.{joint}]", f'column = "q_{joint}_rad"', 'unit = "rad"']
        lines += [f"[channels.torque_{joint}]", f'column = "torque_{joint}"', 'unit = "N.m"']
    for seed in range(3):
        simulate(seed, 12.0).to_parquet(folder / f"t{seed}.parquet")
        lines += ["[[trials]]", f'file = "t{seed}.parquet"', 'kind = "free"']
    (folder / "session.toml").write_text("\n".join(lines) + "\n")
    bampipe.run_session(folder, runs=folder.parent / "runs", last="validate")
    return RunFolder(folder.parent / "runs" / "arm")


def true_numbers(tmp_path: Path) -> dict[str, float]:
    (tmp_path / "arm.urdf").write_text(urdf(1.15))
    (tmp_path / "device.toml").write_text('name = "arm"\n[robot]\nurdf = "arm.urdf"\n')
    robot = device_from(read_device_file(tmp_path / "device.toml")).robot
    assert robot is not None
    return {p.name: p.prior for p in robot.parameters}


@pytest.mark.slow
def test_friction_and_base_parameters_are_those_of_the_truth(
    run: RunFolder, tmp_path: Path
) -> None:
    found = read_json(run.path("models/base/identify.json"))
    assert found["method"] == "least-squares"
    for k, joint in enumerate(JOINTS):
        for term, truth in (("viscous", VISCOUS[k]), ("coulomb", COULOMB[k])):
            entry = found["parameters"][f"{term}.{joint}"]
            assert abs(entry["estimate"] - truth) < max(4.0 * entry["sd"], 0.03 * truth)
    truth = true_numbers(tmp_path)
    robot = device_from(read_device_file(tmp_path / "device.toml")).robot
    assert robot is not None
    checked = 0
    for base, entry in zip(base_parameters(robot), found["base_parameters"], strict=True):
        # The first inertia and that of the drive are one number to any motion.
        if entry["shown"] and "inertia_zz" not in entry["combination"]:
            expected = sum(factor * truth[name] for name, factor in base.terms.items())
            off = abs(entry["estimate"] - expected)
            assert off < 4.0 * entry["sd"] + 0.02 * abs(expected), entry["combination"]
            checked += 1
    assert checked >= 4


@pytest.mark.slow
def test_nothing_is_left_but_noise(run: RunFolder) -> None:
    axes = read_json(run.path("models/base/validate.json"))["axes"]
    for axis in JOINTS:
        assert axes[axis]["held_out_rmse"] < 1.5 * axes[axis]["noise_floor"]
        assert axes[axis]["fit_percent"] > 95.0
