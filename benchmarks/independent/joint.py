"""One rotary joint with gravity, driven by a motor current that is logged at about 94 Hz.

The clock jitters and its stamps are rounded to a millisecond, the current is read in steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from independent.person import follow, free_motion
from independent.sensors import (
    GOOD,
    Conditions,
    read_force,
    sample_steps,
    tell_truth,
    write_session,
    write_trial,
)
from independent.single_axis import STEP, Specimen, describe_log, draw_moves, draw_waves, move

RATE_HZ, TORQUE_PER_AMPERE = 93.7, 10.0
COUNT, CURRENT_STEP, NOISE = 5e-5, 2e-3, 0.015
SIGN_WIDTH = 1e-3
LAWS = {
    "stribeck": {"stribeck": 3.0, "stribeck_speed": 0.06},
    "presliding": {"dahl": 5.0, "dahl_distance": 0.01},
    "asymmetric_coulomb": {"dry_difference": 1.2, "viscous_difference": 1.0},
    "quadratic_drag": {"drag": 3.0},
    "position_dependent_friction": {"ripple": 1.5, "wavenumber": 15.0, "ripple_phase": 0.6},
    "load_dependent_friction": {"load_share": 0.08},
    "thermal_damping": {"softening": 0.02, "warming_time": 8.0},
    "return_spring": {"spring": 4.0, "spring_rest": 0.3},
    "torque_ripple": {"cogging": 1.2, "cogging_wavenumber": 20.0, "cogging_phase": 0.6},
    "detent": {"detent": 4.0, "detent_at": 0.3, "detent_width": 0.08},
    "shear_thinning": {"thinning": 12.0, "thinning_speed": 0.3},
    "maxwell_slip": {"slip": 4.0, "slip_distance": 0.004},
    "upper_stop": {"stop": 40.0, "stop_at": 0.6},
    "rough_patch": {"rough": 4.0, "rough_at": 0.3, "rough_width": 0.1},
    "winding_cable": {"cable": 12.0, "cable_time": 2.0},
    "slack_spring": {"slack_spring": 15.0, "slack": 0.4, "slack_at": 0.2},
    "speed_band": {"band": 3.0, "band_at": 0.6, "band_width": 0.15},
    "tightening": {"tightening": 2.5, "tightening_from": -1.5},
}
MOTOR = {"actuator_delay": 0.02, "actuator_lag": 0.03, "drive_sag": 0.003}
OUTSIDE = (
    "detent", "rough_patch", "winding_cable", "slack_spring", "speed_band", "tightening",
)  # fmt: skip
EFFECTS = (
    *(f"{name}:joint" for name in LAWS if name not in OUTSIDE),
    "actuator_delay", "actuator_lag:current", "drive_sag:joint",
)  # fmt: skip
BY_NAME = ("loose_load:joint", "loose_drive:joint")
UNKNOWN = tuple(f"{name}:joint" for name in OUTSIDE if name != "slack_spring")
"""A spring with slack is the sum of two stops of the library."""
DEVICE = f"""schema = "bampipe.device/1"
name = "joint"
summary = "One joint of an arm, driven by a motor current"
source = "a simulator"

[coordinates.joint]
kind = "rotary"
symbol = "q"
sign_width = {SIGN_WIDTH}

[constants]
torque_per_ampere = {{ value = {TORQUE_PER_AMPERE}, unit = "N.m/A", source = "data sheet" }}

[energy]
kinetic = "inertia*ddt(joint)**2/2"
potential = "-moment*cos(joint) + moment_across*sin(joint)"

[torque]
joint = "-offset"

[inputs]
force = ["current"]
force_unit = "A"
drive = true

[applied]
joint = "torque_per_ampere*current"

[friction.joint]
viscous = {{ unit = "N.m.s/rad", prior = 5.0, sd = 10.0, lower = 0.0 }}
coulomb = {{ unit = "N.m", prior = 5.0, sd = 10.0, lower = 0.0 }}

[parameters]
inertia = {{ unit = "kg.m2", prior = 2.0, sd = 3.0, lower = 0.05 }}
moment = {{ unit = "N.m", prior = 20.0, sd = 20.0 }}
moment_across = {{ unit = "N.m", prior = 0.0, sd = 20.0 }}
offset = {{ unit = "N.m", prior = 0.0, sd = 5.0 }}

[limits]
joint = {{ lower = -1.5, upper = 1.5, speed = 3.0 }}
"""


def _draw_specimen(
    rng: np.random.Generator, effects: Mapping[str, float], c: Conditions
) -> Specimen:
    mechanism = {
        "inertia": rng.uniform(1.5, 3.0), "moment": rng.uniform(15.0, 35.0),
        "moment_across": rng.uniform(-8.0, 8.0), "offset": rng.uniform(-0.5, 0.5),
    }  # fmt: skip
    control = {"position_gain": 12.0, "velocity_gain": 60.0, "feed_forward": 1.0,
               "limit": 150.0, "hold": 1e-3 if c.hold else STEP}  # fmt: skip
    friction = {"viscous": rng.uniform(5.0, 12.0), "coulomb": rng.uniform(4.0, 8.0),
                "creep": c.creep * SIGN_WIDTH}  # fmt: skip
    specimen = Specimen("joint", mechanism | control, friction, play=0.024)
    specimen.truth |= mechanism
    specimen.hide(effects, LAWS, MOTOR, rng)
    # What hangs behind a coupling is not in the inertia that moves with the encoder.
    if not specimen.machine["gap"]:
        specimen.truth["inertia"] = mechanism["inertia"] - float(specimen.machine["load_inertia"])
    return specimen


def record(
    folder: Path, seed: int, effects: Mapping[str, float], conditions: Conditions | None = None
) -> dict[str, Any]:
    """Write a session of the joint; see ``independent.record``."""
    c = conditions or GOOD
    specimen = _draw_specimen(np.random.default_rng([seed, 0]), effects, c)
    rate_hz = c.rate_hz or RATE_HZ
    steps = round((c.seconds or 15.0) / STEP)
    trials = []
    for number, task in enumerate([*(None,) * (5 if c.trials is None else c.trials), *c.tasks]):
        rng = np.random.default_rng([seed, 1 + number])
        length, kind, reach, pace = free_motion(task, number, steps, STEP, c.pace)
        if kind is None and task is not None:
            goal, rate = (column[:, 0] for column in follow(rng, task, ("joint",), STEP))
        elif (kind or 0) % 2:
            goal, rate = draw_moves(rng, length, 1.2 * reach, 1.8 * pace * reach, 0.15)
        else:
            goal, rate = draw_waves(rng, length, 1.2 * reach, 0.8 * pace)
        at = sample_steps(rng, len(goal), 1.0 / (rate_hz * STEP), c, jitter=0.08)
        # The stamps have whole milliseconds and are true to that.
        at = np.unique(np.rint(at / 10).astype(np.int64) * 10)
        at = at[at < len(goal)]
        motion = move(specimen.machine, specimen.law, goal, rate, np.zeros(len(goal)), at)
        t = at * STEP
        current = read_force(rng, t, motion[:, 1:] / TORQUE_PER_AMPERE, NOISE, c)[:, 0]
        step = COUNT * c.coarse
        columns = {
            "t": np.round(t, 3),
            "q": np.floor(motion[:, 0] / step) * step,
            "i": np.round(current / CURRENT_STEP) * CURRENT_STEP,
        }
        trials.append({"file": f"trials/t{number + 1:02d}.csv", "kind": "free"})
        write_trial(folder / trials[-1]["file"], columns)
    head = describe_log("joint.toml", rate_hz, "joint", COUNT * c.coarse,
                        'current = { column = "i", unit = "A" }')  # fmt: skip
    truth = tell_truth("joint", seed, effects, OUTSIDE, specimen.truth, c)
    truth["hidden_laws"] = specimen.hidden_laws
    write_session(folder, head, trials, truth)
    (folder / "joint.toml").write_text(DEVICE, encoding="utf-8")
    return truth
