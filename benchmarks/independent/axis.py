"""A linear positioning axis at 1 kHz, driven by a motor force that is logged as a voltage."""

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
from independent.single_axis import STEP, Specimen, draw_moves, move

RATE_HZ, NEWTON_PER_VOLT = 1000.0, 35.0
COUNT, NOISE = 1e-7, 0.5
SIGN_WIDTH = 2.5e-4
LAWS = {
    "stribeck": {"stribeck": 10.0, "stribeck_speed": 0.012},
    "presliding": {"dahl": 16.0, "dahl_distance": 4e-4},
    "asymmetric_coulomb": {"dry_difference": 2.0, "viscous_difference": 30.0},
    "quadratic_drag": {"drag": 400.0},
    "position_dependent_friction": {"ripple": 4.0, "wavenumber": 110.0, "ripple_phase": 0.6},
    "return_spring": {"spring": 60.0, "spring_rest": 0.05},
    "torque_ripple": {"cogging": 4.0, "cogging_wavenumber": 120.0, "cogging_phase": 0.6},
    "detent": {"detent": 12.0, "detent_at": 0.04, "detent_width": 0.005},
    "shear_thinning": {"thinning": 300.0, "thinning_speed": 0.03},
    "maxwell_slip": {"slip": 14.0, "slip_distance": 2e-4},
    "upper_stop": {"stop": 600.0, "stop_at": 0.02},
    "rough_patch": {"rough": 12.0, "rough_at": 0.04, "rough_width": 0.006},
    "winding_cable": {"cable": 150.0, "cable_time": 1.0},
}
MOTOR = {"actuator_delay": 0.004, "actuator_lag": 0.005}
OUTSIDE = ("detent", "rough_patch", "winding_cable")
EFFECTS = (
    *(f"{name}:carriage" for name in LAWS if name not in OUTSIDE),
    "actuator_delay", "actuator_lag:motor", "flexible_load:carriage",
)  # fmt: skip
BY_NAME = ("loose_load:carriage", "loose_drive:carriage")
UNKNOWN = tuple(f"{name}:carriage" for name in OUTSIDE)


def _draw_specimen(
    rng: np.random.Generator, effects: Mapping[str, float], c: Conditions
) -> Specimen:
    mechanism = {"mass": rng.uniform(70.0, 120.0), "offset": rng.uniform(-4.0, 4.0)}
    control = {"position_gain": 120.0, "velocity_gain": 240.0 * 35.0, "feed_forward": 0.0,
               "limit": 350.0, "hold": 1e-3 if c.hold else STEP}  # fmt: skip
    friction = {"viscous": rng.uniform(150.0, 260.0), "coulomb": rng.uniform(15.0, 27.0),
                "creep": c.creep * SIGN_WIDTH}  # fmt: skip
    machine = {"inertia": mechanism["mass"], "offset": mechanism["offset"]} | control
    specimen = Specimen("carriage", machine, friction, play=0.0024)
    specimen.truth |= mechanism
    specimen.hide(effects, LAWS, MOTOR, rng)
    # What hangs behind a coupling is not in the mass that moves with the encoder.
    if not specimen.machine["gap"]:
        specimen.truth["mass"] = mechanism["mass"] - float(specimen.machine["load_inertia"])
    return specimen


def record(
    folder: Path, seed: int, effects: Mapping[str, float], conditions: Conditions | None = None
) -> dict[str, Any]:
    """Write a session of the positioning axis; see ``independent.record``."""
    c = conditions or GOOD
    specimen = _draw_specimen(np.random.default_rng([seed, 0]), effects, c)
    rate_hz = c.rate_hz or RATE_HZ
    steps = round((c.seconds or 6.0) / STEP)
    trials = []
    for number, task in enumerate([*(None,) * (4 if c.trials is None else c.trials), *c.tasks]):
        rng = np.random.default_rng([seed, 1 + number])
        length, kind, reach, pace = free_motion(task, number, steps, STEP, c.pace)
        if kind is not None:
            goal, rate = draw_moves(rng, length, 0.12 * reach, 0.3 * pace * reach, 0.1)
        elif task is not None:
            goal, rate = (column[:, 0] for column in follow(rng, task, ("carriage",), STEP))
        kicks = rng.choice([-60.0, 0.0, 0.0, 60.0], len(goal) // 1500 + 1)
        kick = np.repeat(kicks, 1500)[: len(goal)]
        # With edges of 20 ms, samples determine what happens between them.
        kick = np.convolve(kick, np.hanning(200) / np.hanning(200).sum(), mode="same")
        at = sample_steps(rng, len(goal), 1.0 / (rate_hz * STEP), c)
        motion = move(specimen.machine, specimen.law, goal, rate, kick, at)
        t = at * STEP
        step = COUNT * c.coarse
        volts = read_force(rng, t, motion[:, 1:], NOISE, c)[:, 0] / NEWTON_PER_VOLT
        columns = {"t": np.round(t, 6), "q": np.floor(motion[:, 0] / step) * step, "u": volts}
        trials.append({"file": f"trials/t{number + 1:02d}.csv", "kind": "free"})
        write_trial(folder / trials[-1]["file"], columns)
    head = f"""device = "slider"
sample_rate_hz = {rate_hz!r}

[time]
column = "t"
unit = "s"

[encoders]
carriage = {{ column = "q", unit = "m", resolution = {COUNT * c.coarse!r} }}

[force]
columns = ["u"]
components = ["motor"]
unit = "V"
calibration_n_per_v = [[{NEWTON_PER_VOLT}]]
zero_v = [0.0]
noise_sd_n = {NOISE}
"""
    truth = tell_truth("axis", seed, effects, OUTSIDE, specimen.truth, c)
    truth["hidden_laws"] = specimen.hidden_laws
    write_session(folder, head, trials, truth)
    return truth
