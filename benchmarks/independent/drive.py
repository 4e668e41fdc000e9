"""The drive of a small robot joint on a test bench: its friction is a hundred times its inertia.

Position and torque are logged at 234 Hz. Friction stops the rotor within microseconds, so that
whoever simulates its motion from the torque takes ever smaller steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from independent.sensors import (
    GOOD,
    Conditions,
    read_force,
    sample_steps,
    tell_truth,
    write_session,
    write_trial,
)
from independent.single_axis import STEP, Specimen, describe_log, draw_waves, move

RATE_HZ, TRIAL_S, COUNT, NOISE = 234.0, 22.5, 1e-5, 1e-3
SIGN_WIDTH = 2e-3
LAWS = {
    "stribeck": {"stribeck": 0.04, "stribeck_speed": 0.05},
    "quadratic_drag": {"drag": 0.01},
    "asymmetric_coulomb": {"dry_difference": 0.02, "viscous_difference": 0.004},
}
EFFECTS = tuple(f"{name}:rotor" for name in LAWS)
OUTSIDE: tuple[str, ...] = ()
UNKNOWN: tuple[str, ...] = ()
DEVICE = f"""schema = "bampipe.device/1"
name = "drive"
summary = "The drive of a joint on a test bench"
source = "a simulator"

[coordinates.rotor]
kind = "rotary"
symbol = "q"
sign_width = {SIGN_WIDTH}

[energy]
kinetic = "inertia*ddt(rotor)**2/2"
potential = "0"

[torque]
rotor = "-offset"

[inputs]
force = ["torque"]
force_unit = "N.m"
drive = true

[applied]
rotor = "torque"

[friction.rotor]
viscous = {{ unit = "N.m.s/rad", prior = 0.05, sd = 0.1, lower = 0.0 }}
coulomb = {{ unit = "N.m", prior = 0.1, sd = 0.2, lower = 0.0 }}

[parameters]
inertia = {{ unit = "kg.m2", prior = 2e-4, sd = 4e-4, lower = 1e-6 }}
offset = {{ unit = "N.m", prior = 0.0, sd = 0.05 }}
"""


def record(
    folder: Path, seed: int, effects: Mapping[str, float], conditions: Conditions | None = None
) -> dict[str, Any]:
    """Write a session of the drive; see ``independent.record``."""
    c, rng = conditions or GOOD, np.random.default_rng([seed, 0])
    mechanism = {"inertia": rng.uniform(0.8e-4, 1.5e-4), "offset": rng.uniform(-5e-3, 5e-3)}
    control = {"position_gain": 80.0, "velocity_gain": 0.4, "feed_forward": 1.0, "limit": 5.0,
               "hold": STEP}  # fmt: skip
    friction = {"viscous": rng.uniform(0.02, 0.04), "coulomb": rng.uniform(0.08, 0.16),
                "creep": c.creep * SIGN_WIDTH}  # fmt: skip
    specimen = Specimen("rotor", mechanism | control, friction, play=0.024)
    specimen.truth |= mechanism
    specimen.hide(effects, LAWS, {}, rng)
    steps, trials = round((c.seconds or TRIAL_S) / STEP), []
    for number in range(3 if c.trials is None else c.trials):
        rng = np.random.default_rng([seed, 1 + number])
        goal, rate = draw_waves(rng, steps, 1.5, 1.2)
        at = sample_steps(rng, len(goal), 1.0 / ((c.rate_hz or RATE_HZ) * STEP), c)
        motion = move(specimen.machine, specimen.law, goal, rate, np.zeros(len(goal)), at)
        t, step = at * STEP, COUNT * c.coarse
        columns = {
            "t": np.round(t, 5),
            "q": np.floor(motion[:, 0] / step) * step,
            "tau": read_force(rng, t, motion[:, 1:], NOISE, c)[:, 0],
        }
        trials.append({"file": f"trials/t{number + 1:02d}.csv", "kind": "free"})
        write_trial(folder / trials[-1]["file"], columns)
    head = describe_log("drive.toml", c.rate_hz or RATE_HZ, "rotor", COUNT * c.coarse,
                        'torque = { column = "tau", unit = "N.m" }')  # fmt: skip
    truth = tell_truth("drive", seed, effects, OUTSIDE, specimen.truth, c)
    truth["hidden_laws"] = specimen.hidden_laws
    write_session(folder, head, trials, truth)
    (folder / "drive.toml").write_text(DEVICE, encoding="utf-8")
    return truth
