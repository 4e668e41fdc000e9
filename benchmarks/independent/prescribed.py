"""A joint whose motion is given, as by a stiff position controller: the torque is what it takes.

Friction is Fc tanh(v / 1 mrad/s) + Fv v; the torque that is logged may be the command of a drive
that acts late, and friction may differ by direction, or fall with the speed.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from independent.sensors import GOOD, Conditions, tell_truth, write_session, write_trial

SIGN_WIDTH = 1e-3
EFFECTS = ("asymmetric_coulomb:joint", "actuator_delay", "stribeck:joint")
UNKNOWN = ("falling_friction:joint",)
DEVICE = """schema = "bampipe.device/1"
name = "joint"
[coordinates.joint]
kind = "rotary"
sign_width = 1e-3
[energy]
kinetic = "inertia*ddt(joint)**2/2"
potential = "-moment*cos(joint) + moment_across*sin(joint)"
[torque]
joint = "-offset"
[inputs]
force = ["force_drive"]
force_unit = "N.m"
drive = true
[applied]
joint = "force_drive"
[friction.joint]
viscous = { unit = "N.m.s/rad", prior = 0.5, sd = 2.5, lower = 0.0 }
coulomb = { unit = "N.m", prior = 0.5, sd = 2.5, lower = 0.0 }
[parameters]
inertia = { unit = "kg.m2", prior = 0.2, sd = 1.0, lower = 0.01 }
offset = { unit = "N.m", prior = 0.0, sd = 1.0 }
moment = { unit = "N.m", prior = 2.0, sd = 10.0 }
moment_across = { unit = "N.m", prior = 0.0, sd = 10.0 }
"""


def _waves(
    rng: np.random.Generator, t: np.ndarray, pace: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity and acceleration of a sum of sines, rad."""
    rate = pace * 2.0 * np.pi * rng.uniform(0.08, 1.0, 5)
    size = pace * rng.uniform(0.3, 1.0, 5) / rate
    angle = rate * t[:, None] + rng.uniform(0.0, 2.0 * np.pi, 5)
    parts = (size * np.sin(angle), size * rate * np.cos(angle), -size * rate**2 * np.sin(angle))
    q, v, a = (part.sum(axis=1) for part in parts)
    return q, v, a


def record(
    folder: Path, seed: int, effects: Mapping[str, float], conditions: Conditions | None = None
) -> dict[str, Any]:
    """Write a session of the joint; see ``independent.record``."""
    c = conditions or GOOD
    rng = np.random.default_rng(seed)
    truth = {
        "inertia": rng.uniform(0.05, 0.5), "moment": rng.uniform(0.5, 6.0), "moment_across": 0.0,
        "offset": 0.0, "viscous.joint": rng.uniform(0.1, 1.5),
        "coulomb.joint": rng.uniform(0.2, 1.5),
    }  # fmt: skip
    hidden = {name.partition(":")[0]: strength for name, strength in effects.items()}
    uneven = hidden.get("asymmetric_coulomb", 0.0) * rng.uniform(0.1, 0.3)
    falls = hidden.get("stribeck", 0.0) * rng.uniform(0.4, 0.8) * truth["coulomb.joint"]
    falls_evenly = hidden.get("falling_friction", 0.0) * truth["coulomb.joint"]
    falls_over, late = rng.uniform(0.1, 0.35), hidden.get("actuator_delay", 0.0)
    rate_hz = c.rate_hz or float(rng.choice([200.0, 500.0]))
    late *= rng.uniform(0.004, 0.015)
    noise = rng.uniform(2e-3, 2e-2) * c.noise_factor
    count = 2.0 * np.pi / float(rng.choice([8192, 65536, 2**20]))
    trials = []
    for number in range(c.trials or 4):
        own = np.random.default_rng([seed, 1 + number])
        t = np.arange(0.0, c.seconds or 12.0, 1.0 / rate_hz)
        state = own.bit_generator.state
        q = _waves(own, t, c.pace)[0]
        own.bit_generator.state = state
        x, u, w = _waves(own, t + late, c.pace)  # a command acts `late` seconds after it is logged
        sign = np.tanh(u / SIGN_WIDTH)
        dry = truth["coulomb.joint"] + falls * np.exp(-((u / falls_over) ** 2))
        torque = truth["inertia"] * w + truth["moment"] * np.sin(x) + dry * sign
        torque += falls_evenly * np.exp(-np.abs(u) / falls_over) * sign
        torque += truth["viscous.joint"] * u + uneven * (0.4 * sign**2 + 0.3 * np.abs(u))
        torque += noise * own.standard_normal(t.size)
        columns = {"t": t, "q": np.rint(q / count) * count, "tau": torque}
        trials.append({"file": f"trials/t{number + 1:02d}.csv", "kind": "free"})
        write_trial(folder / trials[-1]["file"], columns)
    head = (
        f'device = "joint.toml"\nsample_rate_hz = {rate_hz}\n\n[time]\ncolumn = "t"\nunit = "s"\n\n'
        '[encoders]\njoint = { column = "q", unit = "rad" }\n\n[force]\ncolumns = ["tau"]\n'
        'components = ["drive"]\nunit = "N.m"\n'
    )
    told = tell_truth("prescribed", seed, effects, ("falling_friction",), truth, c)
    write_session(folder, head, trials, told)
    (folder / "joint.toml").write_text(DEVICE, encoding="utf-8")
    return told
