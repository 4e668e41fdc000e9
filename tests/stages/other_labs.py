"""Logs such as other labs keep, made from known physics: a robot joint and a magnetic damper."""

import math
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd

INERTIA, VISCOUS, COULOMB, MOMENT, PER_AMPERE = 0.06, 0.25, 0.35, 0.8, 1.4


def joint_log(seed: int, seconds: float = 30.0) -> dict[str, np.ndarray]:
    """A motor joint that lifts a link, sampled at about 100 Hz: s, deg, deg/s, mA."""
    return dict(_joint_log(seed, seconds))


@cache
def _joint_log(seed: int, seconds: float) -> dict[str, np.ndarray]:
    rng = np.random.default_rng([31, seed])
    dt = 5e-4
    t = np.arange(0.0, seconds, dt)
    q, qd, current = ([0.0] * len(t) for _ in range(3))
    tones = [
        (a, 2 * np.pi * f, p)
        for a, f, p in zip(
            (0.5, 0.3, 0.2), rng.uniform(0.15, 0.9, 3), rng.uniform(0, 6.28, 3), strict=True
        )
    ]
    wanted = sum(a * (np.sin(w * t + p) - np.sin(p)) for a, w, p in tones).tolist()
    for k in range(len(t) - 1):
        current[k] = 25.0 * (wanted[k] - q[k]) - 1.5 * qd[k]
        friction = VISCOUS * qd[k] + COULOMB * math.tanh(qd[k] / 2e-3)
        torque = PER_AMPERE * current[k] - friction - MOMENT * math.sin(q[k])
        qd[k + 1] = qd[k] + dt * torque / INERTIA
        q[k + 1] = q[k] + dt * qd[k + 1]
    current[-1] = current[-2]
    stamps = np.cumsum(0.01 + rng.uniform(-0.0025, 0.0025, int(seconds * 100) - 5))
    stamps = stamps[stamps < seconds - 0.01]
    step = 2 * np.pi / 65536
    angle = np.interp(stamps, t, q)
    return {
        "stamp": 1.79e9 + stamps,
        "joint_angle": np.rad2deg(step * np.rint(angle / step)),
        "joint_velocity": np.rad2deg(np.interp(stamps, t, qd)),
        "motor_current": 1e3 * (np.interp(stamps, t, current) + rng.normal(0, 0.005, len(stamps))),
        "temperature": np.full(len(stamps), 31.0),
    }


def damper_log(seed: int, seconds: float = 12.0) -> dict[str, np.ndarray]:
    """A damper with a coil in a test stand, at 1 kHz: s, mm, mm/s, N, A."""
    rng = np.random.default_rng([37, seed])
    t = np.arange(0.0, seconds, 1e-3)
    f = rng.uniform(0.4, 1.6, 3)
    size = np.array([12.0, 5.0, 2.0]) * 1e-3
    phase = rng.uniform(0, 6.28, 3)
    w = 2 * np.pi * f
    angles = w * t[:, None] + phase
    x, v = np.sin(angles) @ size, np.cos(angles) @ (size * w)
    a = -np.sin(angles) @ (size * w * w)
    current = np.repeat(rng.permutation([0.0, 0.5, 1.0, 1.5]), len(t) // 4 + 1)[: len(t)]
    force = 2.0 * a + 450.0 * v + (30.0 + 220.0 * current) * np.tanh(v / 1e-3)
    return {
        "Time": t,
        "Displacement": 1e3 * x + rng.normal(0, 2e-3, len(t)),
        "Velocity": 1e3 * v,
        "Force": force + rng.normal(0, 1.0, len(t)),
        "Current": current + rng.normal(0, 2e-3, len(t)),
    }


def write_table(path: Path, table: dict[str, np.ndarray], form: str = "%.7g") -> None:
    """Columns of numbers with a header, between commas or as Parquet."""
    if path.suffix == ".parquet":
        pd.DataFrame(table).to_parquet(path)
        return
    rows = np.column_stack(list(table.values()))
    np.savetxt(path, rows, form, ",", header=",".join(table), comments="")


def write_joint_logs(folder: Path, count: int = 3) -> None:
    """Plain text with a header and blanks between columns."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(count):
        columns = joint_log(seed)
        names = " ".join(columns)
        table = np.column_stack(list(columns.values()))
        np.savetxt(folder / f"run_{seed}.txt", table, fmt="%.6f", header=names)
