"""The wrist of an arm: two balanced joints with a motor each, whose torques are logged at 1 kHz."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from independent.sensors import (
    GOOD,
    Conditions,
    read_force,
    sample_steps,
    tell_truth,
    write_session,
    write_trial,
)

STEP = 2e-5
RATE_HZ, COUNT, NOISE, CREEP = 1000.0, 2e-6, 0.02, 5e-3
MACHINE = np.dtype(
    [
        (name, np.float64)
        for name in (
            "inertia_a", "inertia_b", "viscous_a", "viscous_b", "coulomb_a", "coulomb_b",
            "sine", "cosine", "pose_slope", "detent", "detent_at", "detent_width",
        )
    ]
)  # fmt: skip
OUTSIDE = ("detent",)
EFFECTS = ("unbalance:a", "friction_by_pose:a-b")
UNKNOWN = ("detent:b",)
DEVICE = f"""schema = "bampipe.device/1"
name = "wrist"
summary = "Two joints of a wrist, the torques of their motors logged"
source = "a simulator"

[coordinates.a]
kind = "rotary"
sign_width = {CREEP}
[coordinates.b]
kind = "rotary"
sign_width = {CREEP}

[energy]
kinetic = "(inertia_a*ddt(a)**2 + inertia_b*ddt(b)**2)/2"

[inputs]
force = ["force_a", "force_b"]
force_unit = "N.m"
drive = true

[applied]
a = "force_a"
b = "force_b"

[friction.a]
viscous = {{ unit = "N.m.s/rad", prior = 1.0, sd = 3.0, lower = 0.0 }}
coulomb = {{ unit = "N.m", prior = 1.0, sd = 3.0, lower = 0.0 }}
[friction.b]
viscous = {{ unit = "N.m.s/rad", prior = 1.0, sd = 3.0, lower = 0.0 }}
coulomb = {{ unit = "N.m", prior = 1.0, sd = 3.0, lower = 0.0 }}

[parameters]
inertia_a = {{ unit = "kg.m2", prior = 0.3, sd = 0.5, lower = 0.01 }}
inertia_b = {{ unit = "kg.m2", prior = 0.3, sd = 0.5, lower = 0.01 }}
"""


@njit(cache=True)
def _turn(m, goal, rate, log_at):
    """Integrate one record under position loops; positions and motor torques at the samples."""
    h = STEP
    q_a, q_b, v_a, v_b = goal[0, 0], goal[0, 1], 0.0, 0.0
    out = np.zeros((len(log_at), 4))
    k_log = 0
    for k in range(len(goal)):
        torque_a = 60.0 * (goal[k, 0] - q_a) + 6.0 * (rate[k, 0] - v_a)
        torque_b = 60.0 * (goal[k, 1] - q_b) + 6.0 * (rate[k, 1] - v_b)
        if k_log < len(log_at) and log_at[k_log] == k:
            out[k_log] = np.array([q_a, q_b, torque_a, torque_b])
            k_log += 1
        dry_a = m.coulomb_a + m.pose_slope * q_b
        push_a = torque_a - m.viscous_a * v_a - dry_a * np.tanh(v_a / CREEP)
        push_a -= m.sine * np.sin(q_a) + m.cosine * np.cos(q_a)
        push_b = torque_b - m.viscous_b * v_b - m.coulomb_b * np.tanh(v_b / CREEP)
        x = (q_b - m.detent_at) / m.detent_width
        push_b -= m.detent * x * np.exp(0.5 - 0.5 * x * x)
        v_a += h * push_a / m.inertia_a
        v_b += h * push_b / m.inertia_b
        q_a += h * v_a
        q_b += h * v_b
    return out


def _hide(
    m: np.ndarray, effects: Mapping[str, float], rng: np.random.Generator
) -> dict[str, float]:
    """Hide the effects; returns what an identification must find."""
    truth = {}
    for full, strength in effects.items():
        size, shape = strength * rng.uniform(0.85, 1.15), rng.uniform(0.85, 1.15)
        name = full.partition(":")[0]
        laws = {
            "friction_by_pose": {"pose_slope": 0.6 * size},
            "unbalance": {"sine": 1.2 * size, "cosine": 0.5 * size},
            "detent": {"detent": 1.5 * size, "detent_at": 0.2 * shape, "detent_width": 0.06},
        }[name]
        for key, value in laws.items():
            m[key] = value
        if name not in OUTSIDE:
            prefix, theirs = full.replace(":", "."), {"pose_slope": "coulomb_slope"}
            truth |= {f"{prefix}.{theirs.get(k, k)}": v for k, v in laws.items()}
    return truth


def record(
    folder: Path, seed: int, effects: Mapping[str, float], conditions: Conditions | None = None
) -> dict[str, Any]:
    """Write a session of the wrist; see ``independent.record``."""
    c = conditions or GOOD
    rng = np.random.default_rng([seed, 0])
    parameters = {
        f"{name}_{axis}": rng.uniform(low, high)
        for axis in "ab"
        for name, low, high in (("inertia", 0.2, 0.4), ("viscous", 0.8, 2.0), ("coulomb", 0.6, 1.5))
    }
    machine = np.zeros(1, MACHINE)[0]
    machine["detent_width"] = 1.0
    for name, value in parameters.items():
        machine[name] = value
    found = {
        name if name.startswith("inertia") else name.replace("_", "."): value
        for name, value in parameters.items()
    }
    found |= _hide(machine, effects, rng)
    rate_hz = c.rate_hz or RATE_HZ
    steps = round((c.seconds or 8.0) / STEP)
    trials = []
    for number in range(c.trials or 4):
        rng = np.random.default_rng([seed, 1 + number])
        t = np.arange(steps) * STEP
        goal, rate = np.zeros((steps, 2)), np.zeros((steps, 2))
        for axis in range(2):
            for w in 2 * np.pi * c.pace * rng.uniform(0.1, 1.5, 6):
                turn, size = w * t + rng.uniform(0.0, 2 * np.pi), 0.25 / (1.0 + w / 3.0)
                goal[:, axis] += 2.0 * size * np.sin(turn)
                rate[:, axis] += 2.0 * size * w * np.cos(turn)
        at = sample_steps(rng, steps, 1.0 / (rate_hz * STEP), c)
        motion = _turn(machine, goal, rate, at)
        step = COUNT * c.coarse
        torque = read_force(rng, at * STEP, motion[:, 2:], NOISE, c)
        columns = {"t": np.round(at * STEP, 6)}
        for k, axis in enumerate("ab"):
            columns[f"q_{axis}"] = np.floor(motion[:, k] / step) * step
            columns[f"m_{axis}"] = torque[:, k]
        trials.append({"file": f"trials/t{number + 1:02d}.csv", "kind": "free"})
        write_trial(folder / trials[-1]["file"], columns)
    encoders = "\n".join(
        f'{axis} = {{ column = "q_{axis}", unit = "rad", resolution = {COUNT * c.coarse!r} }}'
        for axis in "ab"
    )
    head = f"""device = "wrist.toml"
sample_rate_hz = {rate_hz!r}

[time]
column = "t"
unit = "s"

[encoders]
{encoders}

[force]
columns = ["m_a", "m_b"]
components = ["a", "b"]
unit = "N.m"
noise_sd_n = {NOISE}
"""
    truth = tell_truth("wrist", seed, effects, OUTSIDE, found, c)
    write_session(folder, head, trials, truth)
    (folder / "wrist.toml").write_text(DEVICE, encoding="utf-8")
    return truth
