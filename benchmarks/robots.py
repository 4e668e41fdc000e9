"""Sessions of measured arms, for `measured_sets.py`, `kr300.py` and `beside_figaroh.py`.

Four recordings that others published, each a folder of files:

- staubli_tx40 (thanhndv212/figaroh-examples, Apache-2.0): pos_read_data.csv, curr_data.csv, a URDF;
- kuka_kr300 (JonasWeigand/Robot_Identification, MIT): A.mat, B.mat, C.mat, robot.toml;
- dfki_double_pendulum (dfki-ric-underactuated-lab/double_pendulum, BSD-3): *.csv;
- tiago (thanhndv212/figaroh-examples, Apache-2.0): tiago_*.csv, a URDF.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.io import loadmat

BAND_HZ = {"staubli_tx40": 40.0, "kuka_kr300": 10.0, "dfki_double_pendulum": 10.0, "tiago": 5.0}


def write_session(
    folder: Path,
    joints: Sequence[str],
    rate: float,
    trials: Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]],
    device: str,
    units: Mapping[str, str] | None = None,
    held_out: Sequence[str] = (),
    inputs: Sequence[str] = (),
) -> None:
    """Write a session of positions and drive torques.

    Args:
        joints: names; rate: Hz; device: text of the device file.
        trials: time (T,), positions (T, n) and inputs (T, m) by name.
        units: of a joint's position, where it is not rad; held_out: trials for judging only.
        inputs: names of the input columns; ``torque_<joint>`` where empty. ``second_<joint>`` is
            the joint's encoder on the other side of the gear.
    """
    inputs = inputs or [f"torque_{joint}" for joint in joints]
    (folder / "device.toml").write_text(device)
    lines = [
        'schema = "bampipe.session/1"', f'session_id = "{folder.name}"', 'device = "device.toml"',
        f"sample_rate_hz = {rate}", "[time]", 'column = "t"', 'unit = "s"',
    ]  # fmt: skip
    for joint in joints:
        unit = (units or {}).get(joint, "rad")
        lines += [f"[encoders.{joint}]", f'column = "{joint}"', f'unit = "{unit}"']
    for name in inputs:
        lines += [f"[channels.{name}]", f'column = "{name}"']
        axis = name.partition("second_")[2]
        lines += ['unit = "rad"', f'second_encoder_of = "{axis}"'] if axis else ['unit = "N.m"']
    for name, (t, q, torque) in trials.items():
        table = np.column_stack([t, q, torque])
        frame = pd.DataFrame(table, columns=["t", *joints, *inputs])
        frame.to_csv(folder / f"{name}.csv", index=False, float_format="%.10g")
        lines += ["[[trials]]", f'file = "{name}.csv"', 'kind = "free"']
        lines += ["hold_out = true"] if name in held_out else []
    (folder / "session.toml").write_text("\n".join(lines) + "\n")


def tx40_joints(source: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, 6), rad, and torques (T, 6), N.m, on the side of the joints."""
    motor = pd.read_csv(source / "pos_read_data.csv").to_numpy()
    drive = pd.read_csv(source / "curr_data.csv").to_numpy()
    turns = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
    turns[5, 4] = 32.0
    q = np.linalg.solve(turns, motor.T).T + np.array([0, -0.5, 0.5, 0, 0, 0]) * np.pi
    return q, drive @ turns


def staubli_tx40(source: Path, folder: Path) -> None:
    """Six joints at 5 kHz; the wrist's kinematic coupling is taken out, its friction is not."""
    q, torque = tx40_joints(source)
    urdf = next(source.glob("*.urdf"))
    (folder / "arm.urdf").write_bytes(urdf.read_bytes())
    joints = [f"joint_{k}" for k in range(1, 7)]
    trial = np.arange(len(q)) / 5000.0, q, torque
    device = 'name = "tx40"\n[robot]\nurdf = "arm.urdf"\n'
    write_session(folder, joints, 5000.0, {"log": trial}, device)


KR300_AXES = [f"axis_{k}" for k in range(1, 7)]
KR300_ZERO = np.deg2rad([0.0, -90.0, 90.0, 0.0, 0.0, 0.0])
"""Of the drawing, which stands upright where the encoders count from; its base is upside down."""


def kr300_device(drawing: Path, uncertainty: float = 0.02) -> str:
    """Text of the device file: bodies, gears and motors by their drawing."""
    drawn = tomllib.loads(drawing.read_text())
    lines = ['name = "kr300"', "[robot]", "gravity = [0.0, 0.0, 9.81]"]
    lines += [f"uncertainty = {uncertainty}"]
    for joint, link in zip(KR300_AXES, drawn["links"], strict=True):
        xx, yy, zz, xy, yz, xz = (float(v) for v in link["inertia"])
        lines += [
            f"[robot.dh.{joint}]", f"d = {link['d']}", f"a = {link['a']}",
            f"alpha = {float(np.deg2rad(link['alpha_deg']))}",
            f"offset = {float(np.deg2rad(link['offset_deg']))}",
            f"mass = {link['mass']}", f"center = {link['com']}",
            f"inertia = {[xx, xy, xz, yy, yz, zz]}",
        ]  # fmt: skip
    for joint, link in zip(KR300_AXES, drawn["links"], strict=True):
        lines += [
            f"[robot.motors.{joint}]", f"turns = {{ {joint} = {link['gear']} }}",
            f"rotor_inertia = {link['motor_inertia']}",
        ]  # fmt: skip
    return "\n".join(lines) + "\n"


def kuka_kr300(source: Path, folder: Path) -> None:
    """Six axes at 250 Hz: A to identify, B and C to judge; bodies by their drawing."""
    trials, joints = {}, KR300_AXES
    for name in "ABC":
        record = loadmat(source / f"{name}.mat", struct_as_record=False, squeeze_me=True)["rec"]
        q = np.deg2rad(record.act_pos_mot_deg.T) + KR300_ZERO
        t = np.asarray(record.time_cont, dtype=float)
        second = np.deg2rad(record.act_pos_se_deg.T[:, :3]) + KR300_ZERO[:3]
        trials[name] = t - t[0], q, np.hstack([record.act_torque_abs_nm.T, second])
    inputs = [*(f"torque_{joint}" for joint in joints), *(f"second_{j}" for j in joints[:3])]
    device = kr300_device(source / "robot.toml")
    write_session(folder, joints, 250.0, trials, device, held_out="BC", inputs=inputs)


def dfki_double_pendulum(source: Path, folder: Path) -> None:
    """Two joints, six recordings: of the links only the length of the first is taken as known."""
    device = (
        'name = "double_pendulum"\n[robot]\ngravity = [9.81, 0.0, 0.0]\nuncertainty = 1.0\n'
        "[robot.dh.shoulder]\na = 0.3\nmass = 0.6\ncenter = [-0.05, 0.0, 0.0]\n"
        "inertia = [0.001, 0.0, 0.0, 0.005, 0.0, 0.005]\n"
        "[robot.dh.elbow]\na = 0.2\nmass = 0.6\ncenter = [-0.05, 0.0, 0.0]\n"
        "inertia = [0.001, 0.0, 0.0, 0.005, 0.0, 0.005]\n"
    )
    trials = {}
    for number, path in enumerate(sorted(source.glob("*.csv"))):
        table = pd.read_csv(path)
        t = table["time"].to_numpy()
        q = table[["pos_meas1", "pos_meas2"]].to_numpy()
        trials[f"t{number}"] = t - t[0], q, table[["tau_meas1", "tau_meas2"]].to_numpy()
    write_session(folder, ["shoulder", "elbow"], 500.0, trials, device)


def tiago(source: Path, folder: Path) -> None:
    """Torso and seven joints of an arm at about 100 Hz, by motor current."""
    joints = ["torso_lift_joint", *(f"arm_{k}_joint" for k in range(1, 8))]
    position, effort = (
        pd.read_csv(source / f"tiago_{what}.csv").iloc[921:6791] for what in ("position", "effort")
    )
    turns = np.array([1.0, 100.0, 100.0, 100.0, 100.0, 336.0, 336.0, 336.0])
    constant = np.array([1.0, 0.136, 0.136, -0.087, -0.087, -0.0613, -0.0613, -0.0613])
    t = position["t"].to_numpy()
    q, current = (frame.to_numpy()[:, -8:] for frame in (position, effort))
    urdf = next(source.glob("*.urdf"))
    (folder / "arm.urdf").write_bytes(urdf.read_bytes())
    device = (
        'name = "tiago"\n[robot]\nurdf = "arm.urdf"\nbase = "torso_fixed_link"\n'
        'tip = "arm_tool_link"\n'
    )
    trial = t - t[0], q, current * turns * constant
    write_session(folder, joints, 100.0, {"log": trial}, device, {"torso_lift_joint": "m"})
