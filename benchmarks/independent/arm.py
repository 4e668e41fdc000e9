"""An arm of revolute and prismatic joints with geared motors, its log and its drawing (URDF).

Motions are prescribed, so nothing is integrated but under soft drives: bodies are followed in the
axes of the base, and a joint carries the force and moment of everything behind it. ``record_logs``
writes what a lab has, a folder with a URDF and CSV files, and tells the truth beside it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from independent.soft_drives import STEP, follow

GRAVITY = np.array([0.0, 0.0, -9.81])
CREEP = 2e-3
PAIRS = ("xx", "xy", "xz", "yy", "yz", "zz")
COUNT = 2.0 * np.pi / 2**17
RAMP_S = 1.0
NAMES = ("base_yaw", "shoulder", "elbow", "forearm", "wrist_pitch", "wrist_yaw", "flange")

Array = np.ndarray


@dataclass
class Arm:
    """A serial arm; letters of ``kinds`` are the axes of its joints: XYZ turn, xyz slide.

    Attributes:
        kinds: one letter a joint, in the axes of the base where all joints are at zero.
        names: of the joints.
        frames: rotation of each joint's frame against the base's at zero, (n, 3, 3).
        steps: from one joint to the next in the axes of the base at zero, (n, 3), m.
        mass: (n,) kg; center: (n, 3) m and inertia: (n, 3, 3) kg.m2 about it, in the joint's frame.
        ratio: motor turns for one of the joint; rotor: inertia at the joint, kg.m2 or kg.
        viscous, coulomb: at the joint; reach: (n, 2) range, rad or m.
        effort: largest drive, N.m or N; speed: rad/s or m/s.
        creep: speed over which dry friction comes up where nothing sticks, rad/s or m/s.
        gravity: in the axes of the base, m/s2, (3,).
        hidden: effects by name, with the numbers that they have.
    """

    kinds: str
    names: list[str]
    frames: Array
    steps: Array
    mass: Array
    center: Array
    inertia: Array
    ratio: Array
    rotor: Array
    viscous: Array
    coulomb: Array
    reach: Array
    effort: Array
    speed: Array
    creep: float = CREEP
    gravity: Array = field(default_factory=GRAVITY.copy)
    hidden: dict[str, dict[str, float]] = field(default_factory=dict)

    @property
    def axes(self) -> Array:
        return np.eye(3)[["xyz".index(k.lower()) for k in self.kinds]]

    def rigid(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Force of each joint that bodies and gravity require, (T, n) from (T, n)."""
        n, samples = len(self.kinds), len(q)
        turn = np.broadcast_to(np.eye(3), (samples, 3, 3))
        place, velocity_w, rate_w, acceleration = (np.zeros((samples, 3)) for _ in range(4))
        acceleration = acceleration - self.gravity
        pivots, axes, forces, moments = [], [], [], []
        for k in range(n):
            # To the joint, on the body before it.
            arm = turn @ self.steps[k]
            place = place + arm
            acceleration = acceleration + np.cross(rate_w, arm)
            acceleration = acceleration + np.cross(velocity_w, np.cross(velocity_w, arm))
            axis = turn @ self.axes[k]
            if self.kinds[k].isupper():
                spin, spin_up = axis * qd[:, [k]], axis * qdd[:, [k]]
                rate_w = rate_w + spin_up + np.cross(velocity_w, spin)
                velocity_w = velocity_w + spin
                about = Rotation.from_rotvec(q[:, [k]] * self.axes[k]).as_matrix()
                turn = turn @ about
            else:
                slid = axis * q[:, [k]]
                place = place + slid
                acceleration = acceleration + np.cross(rate_w, slid)
                acceleration = acceleration + np.cross(velocity_w, np.cross(velocity_w, slid))
                acceleration = acceleration + 2.0 * np.cross(velocity_w, axis * qd[:, [k]])
                acceleration = acceleration + axis * qdd[:, [k]]
            attitude = turn @ self.frames[k]
            lever = attitude @ self.center[k]
            of_center = acceleration + np.cross(rate_w, lever)
            of_center = of_center + np.cross(velocity_w, np.cross(velocity_w, lever))
            inertia = attitude @ self.inertia[k] @ attitude.transpose(0, 2, 1)
            spun = np.einsum("tij,tj->ti", inertia, velocity_w)
            moment = np.einsum("tij,tj->ti", inertia, rate_w) + np.cross(velocity_w, spun)
            force = self.mass[k] * of_center
            pivots.append(place)
            axes.append(axis)
            forces.append(force)
            moments.append(moment + np.cross(place + lever, force))  # about the base's origin
        found = np.zeros((samples, n))
        for k in range(n):
            force, moment = sum(forces[k:]), sum(moments[k:])
            carried = force if self.kinds[k].islower() else moment - np.cross(pivots[k], force)
            found[:, k] = np.einsum("ti,ti->t", axes[k], carried)
        return found

    def required(self, q: Array, qd: Array, qdd: Array) -> Array:
        """What the drives must give, friction and hidden effects included, (T, n)."""
        load, dry = self.carried(q, qd, qdd)
        found = load + self.viscous * qd + dry * np.tanh(qd / self.creep)
        for full, v in self.hidden.items():
            name, _, at = full.partition(":")
            if name == "friction_of_sum":
                a, b = (self.names.index(joint) for joint in at.split("-"))
                rate = qd[:, a] + qd[:, b]
                shared = v["viscous"] * rate + v["coulomb"] * np.tanh(rate / self.creep)
                found[:, a] += shared
                found[:, b] += shared
        return found

    def carried(self, q: Array, qd: Array, qdd: Array) -> tuple[Array, Array]:
        """What the drives must give without friction, and the level of dry friction, (T, n)."""
        load = self.rigid(q, qd, qdd) + self.rotor * qdd
        dry = np.tile(self.coulomb, (len(q), 1))
        for full, v in self.hidden.items():
            name, _, at = full.partition(":")
            k = self.names.index(at) if at in self.names else -1
            x, rate = q[:, k], qd[:, k]
            if name == "return_spring":
                load[:, k] += v["stiffness"] * x - v["offset"]
            elif name == "cable":
                load[:, k] += v["pull"] * np.log1p(np.exp((x - v["taut_at"]) / v["width"]))
            elif name == "counterbalance":
                load[:, k] -= v["sine"] * np.sin(x) + v["cosine"] * np.cos(x)
            elif name == "stribeck":
                dry[:, k] += v["force"] * np.exp(-((rate / v["speed"]) ** 2))
        for full, v in self.hidden.items():
            name, _, at = full.partition(":")
            if name == "load_dependent_friction":
                k = self.names.index(at)
                dry[:, k] += v["coefficient"] * np.abs(load[:, k])
        return load, dry


EFFECTS = (
    "actuator_delay", "drive_offset", "return_spring", "cable", "counterbalance", "stribeck",
    "friction_of_sum", "load_dependent_friction",
)  # fmt: skip


def build(kinds: str, seed: int, names: Sequence[str] = ()) -> Arm:
    """An arm with random bodies, frames, gears and friction."""
    rng = np.random.default_rng([seed, 0])
    n = len(kinds)
    turns = np.array([k.isupper() for k in kinds])
    roll, yaw = rng.choice([-90.0, 0.0, 90.0, 180.0], (2, n))
    against = Rotation.from_euler("xz", np.column_stack([roll, yaw]), degrees=True).as_matrix()
    frames = np.array(list(accumulate(against, np.matmul)))
    steps = np.zeros((n, 3))
    steps[0, 2] = 0.2
    steps[1:] = rng.uniform(-0.05, 0.05, (n - 1, 3))
    steps[1:, 0] += rng.uniform(0.05, 0.35, n - 1)
    steps[1:, 2] += rng.uniform(0.0, 0.2, n - 1)
    mass = 9.0 * 0.68 ** np.arange(n) * rng.uniform(0.8, 1.2, n)
    center = rng.uniform(-0.03, 0.03, (n, 3))
    center[:, 0] += rng.uniform(0.05, 0.2, n)
    sides = np.column_stack([rng.uniform(0.15, 0.4, n), rng.uniform(0.06, 0.12, (n, 2))])
    inertia = np.array([m * np.diag(s @ s - s**2) / 12.0 for m, s in zip(mass, sides, strict=True)])
    # Bodies were laid out along the base's axes; a URDF has them in the joint's frame.
    center = np.einsum("kji,kj->ki", frames, center)
    inertia = frames.transpose(0, 2, 1) @ inertia @ frames
    ratio = np.where(turns, rng.integers(5, 16, n) * 10.0 + 1.0, 1.0)
    reach = np.where(turns, rng.uniform(1.6, 2.6, n), 0.3)[:, None] * [-1.0, 1.0]
    outboard = np.cumsum(mass[::-1])[::-1]
    size = np.where(turns, 0.4 * outboard, 12.0 * outboard)
    return Arm(
        kinds=kinds,
        names=list(names or NAMES[:n]),
        frames=frames,
        steps=steps,
        mass=mass,
        center=center,
        inertia=inertia,
        ratio=ratio,
        rotor=np.where(turns, 0.03, 0.5) * outboard * rng.uniform(0.5, 1.5, n),
        viscous=size * rng.uniform(0.2, 0.5, n),
        coulomb=size * rng.uniform(0.2, 0.5, n),
        reach=reach,
        effort=np.round(size * 15.0),
        speed=np.where(turns, 3.0, 0.8),
    )


def hide(arm: Arm, effects: Mapping[str, float], rng: np.random.Generator) -> None:
    """Hide ``effects``, ``name:joint`` with their strength; 1 is a fifth to a third of friction."""
    for full, strength in effects.items():
        name, _, at = full.partition(":")
        first = at.partition("-")[0]
        if first not in arm.names:
            raise ValueError(f"the arm has no joint {first!r}")
        size = strength * rng.uniform(0.85, 1.15)
        dry, wet = (float(values[arm.names.index(first)]) for values in (arm.coulomb, arm.viscous))
        arm.hidden[full] = {
            "actuator_delay": {"delay": 0.015 * size},  # below zero, it is logged late
            "drive_offset": {"bias": 1.2 * dry * size},
            "return_spring": {"stiffness": 1.5 * dry * size, "offset": 0.5 * dry * size},
            "cable": {"pull": 1.2 * dry * size, "taut_at": 0.3, "width": 0.1},
            "counterbalance": {"sine": 4.0 * dry * size, "cosine": 2.0 * dry * size},
            "stribeck": {"force": 0.6 * dry * size, "speed": 0.08},
            "friction_of_sum": {"viscous": 0.6 * wet * size, "coulomb": 0.6 * dry * size},
            "load_dependent_friction": {"coefficient": 0.08 * size},
            "gear_windup": {"stiffness": 2e3 * dry / size, "play": 1e-3 * size},
        }[name]


def draw_motion(arm: Arm, rng: np.random.Generator, seconds: float) -> Any:
    """A Fourier series a joint, fading in and out; returns a function of time (T,)."""
    n = len(arm.names)
    base = 2.0 * np.pi * 0.1
    w = base * np.arange(1, 6)
    sine, cosine = rng.normal(size=(2, n, 5))
    width = 0.5 * np.diff(arm.reach)[:, 0]
    size = np.hypot(sine, cosine).sum(axis=1)
    scale = width * rng.uniform(0.7, 1.0, n) / size
    middle = arm.reach.mean(axis=1) + rng.uniform(-0.1, 0.1, n) * width
    sine, cosine = sine * scale[:, None], cosine * scale[:, None]

    def motion(t: Array) -> tuple[Array, Array, Array]:
        x = np.clip(np.minimum(t, seconds - t) / RAMP_S, 0.0, 1.0)
        way = np.where(t < seconds / 2.0, 1.0, -1.0) / RAMP_S
        r = (x**3 * (10.0 - 15.0 * x + 6.0 * x**2))[:, None]
        rd = (30.0 * x**2 * (1.0 - x) ** 2 * way)[:, None]
        rdd = (60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / RAMP_S**2)[:, None]
        s, c = np.sin(np.outer(t, w)), np.cos(np.outer(t, w))
        f = s @ sine.T + c @ cosine.T
        fd = (w * c) @ sine.T - (w * s) @ cosine.T
        fdd = -(w**2 * s) @ sine.T - (w**2 * c) @ cosine.T
        return middle + r * f, rd * f + r * fd, rdd * f + 2.0 * rd * fd + r * fdd

    return motion


def wind(arm: Arm, motion: tuple[Array, Array, Array]) -> Array:
    """How far motors lead their joints, in joint angles, (T, n): what elastic gears and play do."""
    carried = arm.rigid(*motion)
    found = np.zeros_like(carried)
    for full, v in arm.hidden.items():
        name, _, at = full.partition(":")
        if name == "gear_windup":
            load = carried[:, arm.names.index(at)]
            closed = np.tanh(load / (0.01 * np.abs(load).max()))
            found[:, arm.names.index(at)] = load / v["stiffness"] + 0.5 * v["play"] * closed
    return found


def measure(
    arm: Arm,
    rng: np.random.Generator,
    seconds: float,
    rate_hz: float,
    noise: float,
    soft_hz: float = 0.0,
) -> tuple[Array, Array, Array, Array]:
    """Time (T,), positions (T, n) of joints and motors, drives (T, n): as they are logged.

    A joint follows its path exactly, or with ``soft_hz`` as softly as that (`soft_drives`).

    Raises:
        ValueError: what is hidden cannot be had under soft drives.
    """
    unfit = {full.partition(":")[0] for full in arm.hidden} & {"friction_of_sum", "gear_windup"}
    if soft_hz and unfit:
        raise ValueError(f"not under soft drives: {', '.join(unfit)}")
    motion = draw_motion(arm, rng, seconds)
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    late = np.zeros(len(arm.names))
    for full, v in arm.hidden.items():
        name, _, at = full.partition(":")
        if name == "actuator_delay":  # what acts late is logged early
            late[arm.names.index(at)] = v["delay"]
    if soft_hz:
        every = round(1.0 / (rate_hz * STEP))
        path = motion(np.arange(len(t) * every) * STEP)[:2]
        q, drive = (x[::every] for x in follow(arm.carried, arm.viscous, path, soft_hz, late))
        motor = q
    else:
        drive = arm.required(*motion(t))
        for k in np.flatnonzero(late):
            drive[:, k] = arm.required(*motion(t + late[k]))[:, k]
        q = motion(t)[0]
        motor = q + wind(arm, motion(t))
    for full, v in arm.hidden.items():
        name, _, at = full.partition(":")
        if name == "drive_offset":
            drive[:, arm.names.index(at)] += v["bias"]
    drive += noise * arm.coulomb * rng.standard_normal(drive.shape)
    return t, np.floor(q / COUNT) * COUNT, np.floor(motor / COUNT) * COUNT, drive


def urdf(arm: Arm, rng: np.random.Generator | None = None, error: float = 0.0) -> str:
    """The drawing: mass, centre and inertia within ``error`` of the truth, relative."""
    n = len(arm.names)
    draw = rng.normal(size=(n, 5)) * error if rng is not None else np.zeros((n, 5))
    lines = ['<?xml version="1.0"?>', '<robot name="arm">', '  <link name="base_link"/>']
    before = np.eye(3)
    for k, name in enumerate(arm.names):
        turn = before.T @ arm.frames[k]
        rpy, xyz = Rotation.from_matrix(turn).as_euler("xyz"), before.T @ arm.steps[k]
        parent = "base_link" if k == 0 else f"link_{k}"
        scale = 1.0 + draw[k, 0]
        c = arm.center[k] * (1.0 + draw[k, 1:4])
        moments = arm.inertia[k] * scale * (1.0 + draw[k, 4])
        six = {p: moments["xyz".index(p[0]), "xyz".index(p[1])] for p in PAIRS}
        axis = arm.frames[k].T @ arm.axes[k]
        kind = "revolute" if arm.kinds[k].isupper() else "prismatic"
        lines += [
            f'  <link name="link_{k + 1}"><inertial>',
            f'    <origin xyz="{_row(c)}"/><mass value="{arm.mass[k] * scale:.9g}"/>',
            "    <inertia " + " ".join(f'i{p}="{v:.9g}"' for p, v in six.items()) + "/>",
            "  </inertial></link>",
            f'  <joint name="{name}" type="{kind}">',
            f'    <parent link="{parent}"/><child link="link_{k + 1}"/>',
            f'    <origin xyz="{_row(xyz)}" rpy="{_row(rpy)}"/><axis xyz="{_row(axis)}"/>',
            f'    <limit lower="{arm.reach[k, 0]:.4g}" upper="{arm.reach[k, 1]:.4g}"'
            f' effort="{arm.effort[k]:.4g}" velocity="{arm.speed[k]:.4g}"/>',
            "  </joint>",
        ]
        before = arm.frames[k]
    return "\n".join([*lines, "</robot>", ""])


def _row(values: Array) -> str:
    return " ".join(f"{value:.10g}" for value in np.where(np.abs(values) < 1e-12, 0.0, values))


def headed(
    arm: Arm, style: str, t: Array, q: Array, drive: Array, constants: Array
) -> dict[str, Array]:
    """Columns as a lab's controller heads them.

    Styles: ``joint_states`` (by name, in the order of the alphabet) and ``indexed`` (the same by
    number), ``numbered`` (degrees, from 1), ``controller`` (from 0, with targets, currents in A),
    ``motor`` (motor side, in degrees).
    """
    n, columns = len(arm.names), {}
    turns = [kind.isupper() for kind in arm.kinds]
    qd, qdd = np.gradient(q, t, axis=0), np.gradient(np.gradient(q, t, axis=0), t, axis=0)
    if style == "joint_states":
        columns["/joint_states/header/stamp"] = 1.7e9 + t
        for name in sorted(arm.names):
            k = arm.names.index(name)
            columns[f"/joint_states/{name}/position"] = q[:, k]
            columns[f"/joint_states/{name}/velocity"] = qd[:, k]
            columns[f"/joint_states/{name}/effort"] = drive[:, k]
    elif style == "indexed":
        columns["stamp"] = 1.7e9 + t
        order = [arm.names.index(name) for name in sorted(arm.names)]
        for what, values in (("position", q), ("effort", drive)):
            for place, k in enumerate(order):
                columns[f"{what}[{place}]"] = values[:, k]
    elif style == "numbered":
        columns["time [ms]"] = 1e3 * t
        for what, values in (("q", q), ("dq", qd), ("ddq", qdd), ("tau", drive)):
            for k in range(n):
                unit = ("deg" if turns[k] else "mm") if what != "tau" else "Nm" if turns[k] else "N"
                scale = (np.rad2deg(1.0) if turns[k] else 1e3) if what != "tau" else 1.0
                unit += {"dq": "/s", "ddq": "/s^2"}.get(what, "")
                columns[f"{what}_{k + 1} [{unit}]"] = scale * values[:, k]
    elif style == "controller":
        columns["timestamp"] = 5213.408 + t
        for what, values in (
            ("target_q", q + 0.002), ("target_qd", qd), ("target_qdd", qdd),
            ("target_current", 0.95 * drive / constants), ("actual_q", q), ("actual_qd", qd),
            ("actual_current", drive / constants),
        ):  # fmt: skip
            for k in range(n):
                columns[f"{what}_{k}"] = values[:, k]
    elif style == "motor":
        columns["t"] = t
        for k in range(n):
            columns[f"act_pos_mot_deg_{k + 1}"] = np.rad2deg(q[:, k] * arm.ratio[k])
        for k in range(n):
            columns[f"act_torque_mot_nm_{k + 1}"] = drive[:, k] / arm.ratio[k]
    else:
        raise ValueError(f"there is no style {style!r}")
    return columns


def record_logs(
    folder: Path,
    seed: int,
    kinds: str = "ZYYX",
    effects: Mapping[str, float] | None = None,
    style: str = "numbered",
    trials: int = 3,
    seconds: float = 10.0,
    rate_hz: float = 200.0,
    noise: float = 0.03,
    drawing_error: float = 0.1,
    turned: Sequence[str] = (),
    soft_hz: float = 0.0,
    creep: float = CREEP,
    gravity: Sequence[float] = tuple(GRAVITY),
    heavier: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Write ``arm.urdf`` and CSV logs into ``folder``; returns the truth, written beside it.

    Args:
        folder, seed: of the recording.
        kinds: axes of the joints, see `Arm`; effects: strength by ``name:joint``, 1 is typical.
        style: of the headers, see `headed`; trials: files; seconds, rate_hz: of each.
        noise: of the drives, share of the joint's dry friction.
        drawing_error: relative error of the drawn bodies.
        turned: joints whose drive is logged with the other sign.
        soft_hz: how softly drives follow their path, natural frequency; 0 for exactly. Softly
            led joints stick where they turn round.
        creep: as of the arm; gravity: as of the arm, of which the drawing says nothing.
        heavier: by joint, how often its body is as heavy as it is drawn.
    """
    rng = np.random.default_rng([seed, 1])
    arm = build(kinds, seed)
    arm.creep, arm.gravity = creep, np.array(gravity)
    hide(arm, effects or {}, np.random.default_rng([seed, 2]))
    constants = rng.uniform(5.0, 12.0, len(kinds))
    sign = np.array([-1.0 if name in turned else 1.0 for name in arm.names])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.urdf").write_text(urdf(arm, rng, drawing_error))
    for name, factor in (heavier or {}).items():
        arm.mass[arm.names.index(name)] *= factor
        arm.inertia[arm.names.index(name)] *= factor
    for number in range(trials):
        t, q, motor, drive = measure(arm, rng, seconds, rate_hz, noise, soft_hz)
        columns = headed(arm, style, t, q, sign * drive, constants)
        if any(full.startswith("gear_windup") for full in arm.hidden):
            columns |= {f"motor_side_{j}_rad": motor[:, k] for k, j in enumerate(arm.names)}
        table = pd.DataFrame(columns)
        table.to_csv(folder / f"log_{number + 1:02d}.csv", index=False, float_format="%.14g")
    truth = {
        "machine": "arm",
        "seed": seed,
        "kinds": kinds,
        "effects": arm.hidden,
        "turned": list(turned),
        "style": style,
        "constants": list(constants),
        "ratio": list(arm.ratio),
        "parameters": {
            f"{what}.{name}": float(values[k])
            for what, values in (("viscous", arm.viscous), ("coulomb", arm.coulomb))
            for k, name in enumerate(arm.names)
        },
    }
    beside = folder.with_name(f"{folder.name}.truth.json")
    beside.write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    return truth
