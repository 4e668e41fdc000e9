"""A magnetorheological damper on a testing machine: given stroke, measured force, coil current.

Half the tests are sines and chirps, half are noise whose force lies mostly above 20 Hz.
"""

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

STEP = 1e-4
RATE_HZ, COUNT, NOISE, YIELD_SPEED = 500.0, 1e-6, 1.0, 2e-3
MACHINE = np.dtype(
    [
        (name, np.float64)
        for name in (
            "viscous", "coulomb", "viscous_gain", "coulomb_gain", "mass", "preload",
            "share", "distance", "symmetry", "coil_lag", "bend", "sharpness", "stiffness",
            "rest", "drag", "dry_difference", "viscous_difference",
            "bumper", "bumper_at", "thinning", "thinning_speed", "oil_spring", "dead_travel",
            "yield_speed", "seal", "seal_speed", "softening", "warming_time",
            "gas", "gas_length", "polytropic",
        )
    ]
)  # fmt: skip
OUTSIDE = ("soft_oil", "dead_travel")
EFFECTS = (
    "hysteresis:piston", "channel_lag:current", "channel_saturation:current",
    "return_spring:piston", "quadratic_drag:piston", "asymmetric_coulomb:piston",
    "upper_stop:piston", "shear_thinning:piston",
)  # fmt: skip
BY_NAME = ("thermal_damping:piston", "stribeck:piston", "gas_spring:piston")
"""Hidden where they are asked for: what seeds draw stays what it was."""
UNKNOWN = ("soft_oil:piston", "dead_travel:piston")


@njit(cache=True)
def _turning(symmetry, moved, z):
    """Growth of the hysteresis ``z`` per travel in the direction of ``moved``."""
    return 1.0 - symmetry * np.sign(moved) * z - (1.0 - symmetry) * abs(z)


@njit(cache=True)
def _press(m, x, v, a, current, log_at):
    """Force on the damper along a prescribed stroke, at the samples."""
    out = np.zeros(len(log_at))
    z, coil, oil, free, heat, k_log = 0.0, current[0], 0.0, 0.0, 0.0, 0
    for k in range(len(x)):
        if m.coil_lag > 0.0 and k > 0:
            coil = current[k - 1] + (coil - current[k - 1]) * np.exp(-STEP / m.coil_lag)
        else:
            coil = current[k]
        i = coil / (1.0 + (m.bend * coil) ** m.sharpness) ** (1.0 / m.sharpness)
        speed = v[k]
        if m.oil_spring > 0.0:
            # A part of the stroke compresses the oil, the rest of it flows.
            rate = m.oil_spring / (m.viscous + m.viscous_gain * abs(i))
            oil = (oil + STEP * speed) / (1.0 + STEP * rate)
            speed = rate * oil
        sign = np.tanh(speed / m.yield_speed) if m.yield_speed > 0.0 else np.sign(speed)
        seal = m.seal * np.exp(-((speed / m.seal_speed) ** 2)) * sign
        moves = abs(sign)
        if m.share > 0.0:
            if k > 0:
                moved = 0.5 * STEP * (v[k - 1] + v[k]) / m.distance
                z += moved * _turning(
                    m.symmetry, moved, z + 0.5 * moved * _turning(m.symmetry, moved, z)
                )
            sign += m.share * (z - sign)
        dry = m.coulomb + m.coulomb_gain * abs(i)
        force = (m.viscous + m.viscous_gain * abs(i)) * speed + dry * sign + seal
        force -= m.softening * heat * m.viscous * speed
        power = m.viscous * speed**2 + m.coulomb * abs(speed)
        heat += STEP * (power - heat) / m.warming_time
        if m.dead_travel > 0.0:
            # After a reversal the oil only flows round once the piston has moved the dead travel.
            free = min(max(free + STEP * speed, -m.dead_travel), m.dead_travel)
            force *= abs(free) / m.dead_travel if free * speed > 0.0 else 0.0
        force += m.mass * a[k] + m.preload + m.stiffness * (x[k] - m.rest)
        force += m.drag * speed * abs(speed)
        force += m.thinning * speed / (1.0 + (speed / m.thinning_speed) ** 2) ** 0.35
        force += m.dry_difference * moves**2
        force += m.viscous_difference * abs(speed)
        if m.gas > 0.0:
            # A closed volume; the piston's rod presses it together as it comes in.
            force += m.gas * ((1.0 - x[k] / m.gas_length) ** -m.polytropic - 1.0)
        if x[k] > m.bumper_at:
            force += m.bumper * (x[k] - m.bumper_at)
        if k_log < len(log_at) and log_at[k_log] == k:
            out[k_log] = force
            k_log += 1
    return out


def _hide(
    m: np.ndarray, effects: Mapping[str, float], rng: np.random.Generator
) -> dict[str, float]:
    """Hide the effects; returns what an identification must find."""
    truth = {}
    for full, strength in effects.items():
        name = full.partition(":")[0]
        size = strength * rng.uniform(0.85, 1.15)
        shape = rng.uniform(0.85, 1.15)
        sign = rng.choice([-1.0, 1.0])
        laws = {
            "hysteresis": {"share": min(0.9 * size, 1.0), "distance": 0.002 * shape,
                           "symmetry": 0.6},
            "channel_lag": {"coil_lag": 0.04 * size},
            "channel_saturation": {"bend": 0.5 * size, "sharpness": 1.5},
            "return_spring": {"stiffness": 3000.0 * size, "rest": 0.0},
            "quadratic_drag": {"drag": 1500.0 * size},
            "asymmetric_coulomb": {"dry_difference": 15.0 * size * sign,
                                   "viscous_difference": 60.0 * size * sign},
            "upper_stop": {"bumper": 6e4 * size, "bumper_at": 0.004},
            "shear_thinning": {"thinning": 1500.0 * size, "thinning_speed": 0.02 * shape},
            "stribeck": {"seal": 25.0 * size, "seal_speed": 0.012 * shape},
            "thermal_damping": {"softening": 0.15 * size, "warming_time": 6.0 * shape},
            "gas_spring": {"gas": 250.0 * size, "gas_length": 0.04 * shape, "polytropic": 1.3},
            "soft_oil": {"oil_spring": 6e4 / size},
            "dead_travel": {"dead_travel": 0.0006 * size},
        }[name]  # fmt: skip
        for key, value in laws.items():
            m[key] = value
        theirs = {
            "coil_lag": "time_constant",
            "drag": "coefficient",
            "dry_difference": "difference",
            "bumper": "stiffness",
            "bumper_at": "position",
            "seal": "force",
            "seal_speed": "speed",
            "warming_time": "time_constant",
        }
        if name in (
            "upper_stop",
            "hysteresis",
            "channel_lag",
            "quadratic_drag",
            "channel_saturation",
            "stribeck",
            "thermal_damping",
        ):
            prefix = full.replace(":", ".")
            truth |= {f"{prefix}.{theirs.get(k, k)}": v for k, v in laws.items()}
        elif name == "gas_spring":
            truth["gas_spring.piston.end"] = laws["gas_length"]
        elif name == "return_spring":
            truth["return_spring.piston.stiffness"] = laws["stiffness"]
    return truth


def _draw_stroke(
    rng: np.random.Generator, steps: int, test: int, pace: float
) -> tuple[Any, Any, Any]:
    """Position, velocity and acceleration of a test, (steps,) each, exact derivatives."""
    t = np.arange(steps) * STEP
    if test % 2:
        # Noise: lines of equal speed from 1 to 60 Hz, random phases.
        speed, x, v, a = 0.09 * np.sqrt(2.0 / 60), np.zeros(steps), np.zeros(steps), np.zeros(steps)
        for w in 2 * np.pi * pace * (np.arange(60) + rng.uniform(0.5, 1.5, 60)):
            turn = w * t + rng.uniform(0.0, 2 * np.pi)
            wave, slope = np.sin(turn), np.cos(turn)
            x += speed / w * wave
            v += speed * slope
            a -= speed * w * wave
        return x, v, a
    size, low, high = (
        rng.uniform(0.004, 0.015),
        pace * rng.uniform(0.3, 0.8),
        pace * rng.uniform(1.5, 3.0),
    )
    sweep = (high - low) / (steps * STEP)
    turn = 2 * np.pi * (low * t + 0.5 * sweep * t**2)
    w = 2 * np.pi * (low + sweep * t)
    return (
        size * np.sin(turn),
        size * w * np.cos(turn),
        size * (2 * np.pi * sweep * np.cos(turn) - w**2 * np.sin(turn)),
    )


def record(
    folder: Path, seed: int, effects: Mapping[str, float], conditions: Conditions | None = None
) -> dict[str, Any]:
    """Write a session of the damper; see ``independent.record``."""
    c = conditions or GOOD
    rng = np.random.default_rng([seed, 0])
    parameters = {
        "viscous": rng.uniform(250.0, 450.0), "coulomb": rng.uniform(30.0, 60.0),
        "viscous_gain": rng.uniform(300.0, 550.0), "coulomb_gain": rng.uniform(200.0, 320.0),
        "mass": rng.uniform(0.9, 1.6), "preload": rng.uniform(-30.0, 30.0),
    }  # fmt: skip
    machine = np.zeros(1, MACHINE)[0]
    machine["sharpness"] = machine["distance"] = machine["thinning_speed"] = 1.0
    machine["seal_speed"] = machine["warming_time"] = 1.0
    machine["yield_speed"] = 0.0 if c.stop else YIELD_SPEED
    machine["bumper_at"] = np.inf
    for name, value in parameters.items():
        machine[name] = value
    places = {"viscous": "viscous.piston", "coulomb": "coulomb.piston"}
    found = {places.get(name, name): value for name, value in parameters.items()}
    found |= _hide(machine, effects, rng)
    rate_hz = c.rate_hz or RATE_HZ
    steps = round((c.seconds or 10.0) / STEP)
    trials = []
    for test in range(c.trials or 6):
        rng = np.random.default_rng([seed, 1 + test])
        x, v, a = _draw_stroke(rng, steps, test, c.pace)
        levels = rng.uniform(0.0, 2.0, 40)
        current = levels[(np.arange(steps) * STEP / (1.0 if test % 2 else 1.7)).astype(int)]
        at = sample_steps(rng, steps, 1.0 / (rate_hz * STEP), c)
        t = at * STEP
        force = _press(machine, x, v, a, current, at)[:, None]
        step = COUNT * c.coarse
        columns = {
            "t": np.round(t, 6),
            "x": np.floor(x[at] / step) * step * 1e3,
            "f": read_force(rng, t, force, NOISE, c)[:, 0],
            "i": current[at] + 0.002 * rng.standard_normal(len(at)),
        }
        trials.append({"file": f"trials/t{test + 1:02d}.csv", "kind": "free"})
        write_trial(folder / trials[-1]["file"], columns)
    head = f"""device = "magnetic_damper"
sample_rate_hz = {rate_hz!r}

[time]
column = "t"
unit = "s"

[encoders]
piston = {{ column = "x", unit = "mm", resolution = {COUNT * c.coarse * 1e3!r} }}

[force]
columns = ["f"]
components = ["load_cell"]
unit = "N"
noise_sd_n = {NOISE}

[channels]
current = {{ column = "i", unit = "A" }}
"""
    truth = tell_truth("damper", seed, effects, OUTSIDE, found, c)
    write_session(folder, head, trials, truth)
    return truth
