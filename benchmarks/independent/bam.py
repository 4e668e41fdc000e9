"""The brake-actuated manipulator under a hand, by Newton's and Euler's laws.

Yaw and pitch carry a rod that slides along itself; a person drags its grip along a wanted motion.
The acceleration of the rod's centre of gravity is written in spherical coordinates and its rotation
by Euler's equations in rod axes, one step of the integrator is 0.1 ms, friction is set-valued.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from scipy.signal import butter, lfilter, sosfiltfilt

from independent.friction import MEMORY, blank_laws, push_along, remember, resist, set_law
from independent.person import follow, free_motion
from independent.sensors import (
    GOOD,
    Conditions,
    hold_back,
    read_force,
    sample_steps,
    tell_truth,
    write_session,
    write_trial,
)

STEP = 1e-4
AXES = ("yaw", "pitch", "extension")
COMPONENTS = ("x", "y", "z")
GRAVITY, GRIP_TO_CENTRE, DESIGN_MASS = 9.81, 0.461, 3.56
INERTIA = np.array(
    [[0.821, -0.801e-3, 0.783e-3], [-0.801e-3, 0.826, 0.052e-3], [0.783e-3, 0.052e-3, 0.01025]]
)
"""Of the rod about its centre of gravity, in rod axes, kg.m2."""

DRIVES = np.array([187e-3 + 4.313e-3 + 25 * 15.52e-3, 28.8e-3 + 4.313e-3 + 25 * 15.52e-3, 0.0])
"""Of turret, guide box and cable drives about yaw and pitch, kg.m2."""

REDUCER = 25 * 15.52e-3
"""The part of a rotary drive that lies behind its cable, kg.m2."""

COUNTS = {"yaw": (21333.3333, 12000), "pitch": (10191.0828, -4000), "extension": (33333.3333, 3000)}
CALIBRATION = np.array([[12.0, 0.15, -0.1], [0.1, 11.5, 0.2], [-0.05, 0.1, 24.0]])
ZERO_V = np.array([0.021, -0.034, 0.012])
NOISE = 0.05
FIELD = 40.0
"""Cartesian damping that the brakes render in viscous trials, N.s/m."""
MIDDLE, REACH = np.array([0.0, 0.0, 1.1]), np.array([1.2, 0.7, 0.38])
HASTE = np.array([12.0, 12.0, 5.0])
SIGN_WIDTHS = np.array([5e-4, 5e-4, 1.25e-4])

MACHINE = np.dtype(
    [
        (name, np.float64)
        for name in (
            "mass", "payload", "inertia_yaw", "inertia_pitch", "inertia_extension",
            "tilt_x", "tilt_z", "compensator_gain", "compensator_lag", "compensator_speed",
            "brake_lag", "field", "hand_frequency", "hand_lag", "gap", "contact", "loose_axis",
            "remanence", "remanence_decay", "hum_torque", "hum_frequency",
            "hose", "hose_rest", "hose_root",
        )
    ]
)  # fmt: skip

LAWS = {
    "stribeck": {"stribeck": (1.0, 1.3, 2.6), "stribeck_speed": (0.05, 0.05, 0.02)},
    "presliding": {"dahl": (0.7, 1.3, 2.2), "dahl_distance": (0.025, 0.025, 0.01)},
    "asymmetric_coulomb": {"dry_difference": (0.3, 0.5, 0.9),
                           "viscous_difference": (0.25, 0.3, 1.5)},
    "quadratic_drag": {"drag": (1.0, 1.2, 8.0)},
    "position_dependent_friction": {"ripple": (0.45, 0.6, 1.3), "wavenumber": (18.0, 18.0, 60.0),
                                    "ripple_phase": (0.6, 0.6, 0.6)},
    "load_dependent_friction": {"load_share": (0.07, 0.09, 0.0), "side_share": (0.0, 0.0, 0.1)},
    "thermal_damping": {"softening": (0.05, 0.06, 0.06), "warming_time": (6.0, 6.0, 6.0)},
    "return_spring": {"spring": (2.0, 2.5, 12.0), "spring_rest": (0.15, 0.1, 1.05)},
    "detent": {"detent": (1.2, 1.5, 3.0), "detent_at": (0.15, 0.1, 1.12),
               "detent_width": (0.05, 0.05, 0.02)},
    "shear_thinning": {"thinning": (3.0, 3.5, 15.0), "thinning_speed": (0.3, 0.3, 0.15)},
    "maxwell_slip": {"slip": (0.8, 1.3, 2.2), "slip_distance": (0.012, 0.012, 0.005)},
    "upper_stop": {"stop": (14.0, 20.0, 90.0), "stop_at": (0.3, 0.2, 1.25)},
    "rough_patch": {"rough": (1.0, 1.3, 2.5), "rough_at": (0.15, 0.1, 1.12),
                    "rough_width": (0.08, 0.08, 0.03)},
    "winding_cable": {"cable": (4.0, 5.0, 25.0), "cable_time": (1.5, 1.5, 1.5)},
    "slack_spring": {"slack_spring": (5.0, 8.0, 40.0), "slack": (0.2, 0.12, 0.08),
                     "slack_at": (0.1, 0.05, 1.1)},
    "speed_band": {"band": (1.0, 1.3, 2.5), "band_at": (0.5, 0.35, 0.2),
                   "band_width": (0.12, 0.1, 0.06)},
    "tightening": {"tightening": (1.2, 2.5, 8.0), "tightening_from": (-0.8, -0.5, 0.9)},
    "imbalance": {"cogging": (1.0, 1.5, 4.0), "cogging_wavenumber": (2.5, 2.5, 6.0),
                  "cogging_phase": (0.6, 0.6, 0.6)},
}  # fmt: skip
"""Effects of one axis: their laws, typical for yaw, pitch and extension."""

OUTSIDE = (
    "detent", "rough_patch", "winding_cable", "hum", "slack_spring", "speed_band", "tightening",
    "imbalance", "sensor_hysteresis", "hose",
)  # fmt: skip
EFFECTS = (
    *(f"{name}:{axis}" for name in LAWS if name not in OUTSIDE for axis in AXES),
    "backlash:yaw", "backlash:pitch", "inertia_mismatch:yaw", "inertia_mismatch:pitch",
    "transmission_compliance:yaw", "transmission_compliance:pitch", "handle_payload", "base_tilt",
    "gravity_compensator_lag", "gravity_compensator_rate_limit", "gravity_compensator_mistuned",
    *(f"force_{kind}:{c}" for kind in ("bias", "gain", "drift") for c in COMPONENTS),
    "force_crosstalk:xy", "force_crosstalk:zx", "force_delay", "encoder_scale:yaw",
    "encoder_scale:extension", "friction_by_pose:yaw-extension", "brake_lag",
    "brake_residual_torque:yaw",
)  # fmt: skip
UNKNOWN = (
    "detent:yaw", "detent:pitch", "detent:extension", "rough_patch:yaw", "rough_patch:pitch",
    "rough_patch:extension", "winding_cable:yaw", "winding_cable:extension", "hum:yaw",
    "speed_band:extension", "tightening:pitch", "imbalance:yaw", "sensor_hysteresis:x", "hose:yaw",
)  # fmt: skip
"""Not the spring with slack, which is the sum of two stops of the library."""


@njit(cache=True)
def _rod(m, q, v, yaw_rate, pitch_rate, away_rate):
    """Generalised forces (yaw, pitch, extension) that accelerate rod, payload and drives.

    Gravity is in them: without motion they hold the arm.
    """
    s, c = np.sin(q[1]), np.cos(q[1])
    s_yaw, c_yaw = np.sin(q[0]), np.cos(q[0])
    # Gravity in base axes (x lateral, y up, z forward), the base tilted about x, then z.
    down_x = -np.sin(m.tilt_z) * np.cos(m.tilt_x)
    down_y = -np.cos(m.tilt_z) * np.cos(m.tilt_x)
    down_z = np.sin(m.tilt_x)
    # In the directions of lateral, rising and outward motion.
    g_side = GRAVITY * (down_x * c_yaw - down_z * s_yaw)
    g_rise = GRAVITY * (-down_x * s * s_yaw + down_y * c - down_z * s * c_yaw)
    g_out = GRAVITY * (down_x * c * s_yaw + down_y * s + down_z * c * c_yaw)
    yaw = (DRIVES[0] + m.inertia_yaw) * yaw_rate
    pitch = (DRIVES[1] + m.inertia_pitch) * pitch_rate
    extension = m.inertia_extension * away_rate
    for body in range(2):
        mass = m.mass if body == 0 else m.payload
        d = q[2] - GRIP_TO_CENTRE if body == 0 else q[2]
        side = d * c * yaw_rate + 2.0 * v[2] * v[0] * c - 2.0 * d * v[0] * v[1] * s
        rise = d * pitch_rate + 2.0 * v[2] * v[1] + d * v[0] * v[0] * s * c
        away = away_rate - d * v[1] * v[1] - d * v[0] * v[0] * c * c
        yaw += mass * d * c * (side - g_side)
        pitch += mass * d * (rise - g_rise)
        extension += mass * (away - g_out)
    # Euler's equations in rod axes.
    w_x, w_y, w_z = -v[1], v[0] * c, v[0] * s
    r_x = -pitch_rate
    r_y = yaw_rate * c - v[0] * v[1] * s
    r_z = yaw_rate * s + v[0] * v[1] * c
    spin_x = INERTIA[0, 0] * w_x + INERTIA[0, 1] * w_y + INERTIA[0, 2] * w_z
    spin_y = INERTIA[1, 0] * w_x + INERTIA[1, 1] * w_y + INERTIA[1, 2] * w_z
    spin_z = INERTIA[2, 0] * w_x + INERTIA[2, 1] * w_y + INERTIA[2, 2] * w_z
    moment_x = INERTIA[0, 0] * r_x + INERTIA[0, 1] * r_y + INERTIA[0, 2] * r_z
    moment_y = INERTIA[1, 0] * r_x + INERTIA[1, 1] * r_y + INERTIA[1, 2] * r_z
    moment_z = INERTIA[2, 0] * r_x + INERTIA[2, 1] * r_y + INERTIA[2, 2] * r_z
    yaw += c * (moment_y + w_z * spin_x - w_x * spin_z)
    yaw += s * (moment_z + w_x * spin_y - w_y * spin_x)
    pitch -= moment_x + w_y * spin_z - w_z * spin_y
    return yaw, pitch, extension


@njit(cache=True)
def _move(m, laws, wanted, wanted_rate, log_at, braked):
    """Integrate one trial; returns position seen behind the drives, grip, force, brake at samples.

    ``wanted`` (steps, 3) is where the hand would like the arm to be.
    """
    h = STEP
    memory = np.zeros(3, MEMORY)
    q, v = wanted[0].copy(), np.zeros(3)
    for i in range(3):
        memory[i].cable = q[i]
    half, load, user, rate_of = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    own, lever, mean = np.zeros(3), np.ones(3), np.zeros(3)
    force, push, command = np.zeros(3), np.zeros(3), np.zeros(3)
    delivered, magnet = np.zeros(3), np.zeros(3)
    carriage = q[2] - GRIP_TO_CENTRE
    loose = int(m.loose_axis)
    drive_q, drive_v = 0.0, 0.0
    if loose >= 0:
        drive_q = q[loose]
    n = len(log_at)
    seen, true_force, brakes = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    k_log = 0
    for k in range(len(wanted)):
        if k_log < n and log_at[k_log] == k:
            seen[k_log] = q
            if loose >= 0:
                seen[k_log, loose] = drive_q
            true_force[k_log] = force
            brakes[k_log] = command
            k_log += 1
        # The hand: a spring and a damper to the wanted grip, behind two equal muscle lags.
        c = np.cos(q[1])
        lever[0], lever[1] = q[2] * c, q[2]
        stiff = 3.2 * m.hand_frequency**2
        for i in range(3):
            aim = lever[i] * (
                stiff * (wanted[k, i] - q[i]) + 6.4 * m.hand_frequency * (wanted_rate[k, i] - v[i])
            )
            push[i] += (aim - push[i]) * h / m.hand_lag
            step = (push[i] - force[i]) * h / m.hand_lag
            mean[i] = force[i] + 0.5 * step
            force[i] += step
            user[i] = lever[i] * mean[i]
        # The brakes render a Cartesian damping at the grip.
        for i in range(3):
            command[i] = m.field * lever[i] ** 2 * abs(v[i]) if braked else 0.0
            delivered[i] += (command[i] - delivered[i]) * min(h / m.brake_lag, 1.0)
            if command[i] > magnet[i]:
                magnet[i] += (command[i] - magnet[i]) * h / 0.02
            else:
                magnet[i] += (command[i] - magnet[i]) * h / m.remanence_decay
            half[i] = q[i] + 0.5 * h * v[i]
        hold_yaw, hold_pitch, hold_extension = _rod(m, half, v, 0.0, 0.0, 0.0)
        m_yaw, m_cross, _ = _rod(m, half, v, 1.0, 0.0, 0.0)
        _, m_pitch, _ = _rod(m, half, v, 0.0, 1.0, 0.0)
        _, _, m_extension = _rod(m, half, v, 0.0, 0.0, 1.0)
        m_yaw, m_cross, m_pitch = m_yaw - hold_yaw, m_cross - hold_pitch, m_pitch - hold_pitch
        m_extension -= hold_extension
        load[0], load[1] = user[0] - hold_yaw, user[1] - hold_pitch
        load[2] = user[2] - hold_extension
        error = half[2] - GRIP_TO_CENTRE - carriage
        speed = error / m.compensator_lag
        carriage += h * min(max(speed, -m.compensator_speed), m.compensator_speed)
        load[1] += m.compensator_gain * DESIGN_MASS * GRAVITY * carriage * np.cos(half[1])
        load[0] += m.hum_torque * np.sin(2.0 * np.pi * m.hum_frequency * k * h)
        # A hose along the rod pulls the turret back, the more the farther the rod is out.
        load[0] -= m.hose * (half[2] - m.hose_root) * (half[0] - m.hose_rest)
        contact = 0.0
        for i in range(3):
            if i != loose:
                load[i] += push_along(laws[i], half[i], memory[i])
        if loose >= 0:
            # Hand and arm on one side of the play; encoder, friction, brake, reducer on the other.
            gap = half[loose] - (drive_q + 0.5 * h * drive_v)
            if abs(gap) > 0.5 * m.gap:
                pressed = gap - np.sign(gap) * 0.5 * m.gap
                contact = m.contact * pressed + 0.3 * np.sqrt(m.contact) * (v[loose] - drive_v)
            load[loose] -= contact
            if loose == 0:
                m_yaw -= REDUCER
            else:
                m_pitch -= REDUCER
        # Yaw and pitch are coupled, extension is not (the rod slides through its own axis).
        det = m_yaw * m_pitch - m_cross * m_cross
        rate_of[0] = (m_pitch * load[0] - m_cross * load[1]) / det
        rate_of[1] = (m_yaw * load[1] - m_cross * load[0]) / det
        rate_of[2] = load[2] / m_extension
        own[0], own[1], own[2] = det / m_pitch, det / m_yaw, m_extension
        side = np.sqrt(mean[0] ** 2 + mean[1] ** 2)
        for i in range(3):
            law = laws[i]
            across = side if i == 2 else 0.0
            drag = delivered[i] + m.remanence * magnet[i] * (i == 0)
            if i == loose:
                free = drive_v + h * (contact + push_along(law, drive_q, memory[i])) / REDUCER
                impulse = resist(
                    law, memory[i], free, drive_v, h, REDUCER, drive_q, user[i], across, half[2]
                )
                new = free + impulse / REDUCER
                if drag > 0.0:
                    new = np.sign(new) * max(abs(new) - drag * h / REDUCER, 0.0)
                remember(law, memory[i], drive_q, 0.5 * (drive_v + new), h)
                drive_q += 0.5 * h * (drive_v + new)
                drive_v = new
                v[i] += h * rate_of[i]
                q[i] = half[i] + 0.5 * h * v[i]
                continue
            free = v[i] + h * rate_of[i]
            impulse = resist(
                law, memory[i], free, v[i], h, own[i], half[i], user[i], across, half[2]
            )
            new = free + impulse / own[i]
            if drag > 0.0:
                new = np.sign(new) * max(abs(new) - drag * h / own[i], 0.0)
            remember(law, memory[i], half[i], new, h)
            v[i] = new
            q[i] = half[i] + 0.5 * h * new
    return seen, true_force, brakes


def _draw_wanted(
    rng: np.random.Generator, steps: int, share: float, pace: float
) -> tuple[Any, Any]:
    """Where the hand wants to be, (steps, 3), and its rate: noise of 0.1 to 1.3 Hz, from rest.

    Both frequencies are times ``pace``.
    """
    coarse = 50  # drawn at 200 Hz
    n = steps // coarse + 2
    sections = butter(2, [0.1 * pace, 1.3 * pace], "bandpass", fs=1 / (STEP * coarse), output="sos")
    # Reaching far is slow: more of the slow part than a flat spectrum has.
    noise = lfilter([1.0], [1.0, -0.985], rng.standard_normal((n + 4000, 3)), axis=0)
    wave = sosfiltfilt(sections, noise, axis=0)[2000 : 2000 + n]
    rate = np.gradient(wave, STEP * coarse, axis=0)
    haste = np.abs(np.gradient(rate, STEP * coarse, axis=0)).max(axis=0)
    reach = REACH * share * rng.uniform(0.75, 1.0, 3) / np.abs(wave).max(axis=0)
    wave *= np.minimum(reach, HASTE / haste)
    rise = np.clip(np.arange(n) * STEP * coarse / 1.5, 0.0, 1.0)[:, None]
    wave = wave[0] + rise**3 * (10 - 15 * rise + 6 * rise**2) * (wave - wave[0])
    fine, knots = np.arange(steps) / coarse, np.arange(n)
    smooth = np.column_stack([np.interp(fine, knots, column) for column in wave.T])
    rates = np.gradient(wave, STEP * coarse, axis=0)
    return smooth + MIDDLE, np.column_stack([np.interp(fine, knots, r) for r in rates.T])


class _Specimen:
    """One arm with its hidden effects: laws, machine, sensors, and what must be identified."""

    def __init__(self, rng: np.random.Generator, effects: Mapping[str, float], creep: bool) -> None:
        self.laws = blank_laws(3)
        self.laws["creep"] = creep * SIGN_WIDTHS
        self.laws["viscous"] = rng.uniform([3.2, 2.8, 10.5], [5.2, 4.6, 16.0])
        self.laws["coulomb"] = rng.uniform([0.85, 1.6, 2.8], [1.4, 2.6, 4.2])
        machine = np.zeros(1, MACHINE)
        machine["mass"] = rng.uniform(3.3, 3.8)
        machine["compensator_gain"], machine["compensator_lag"] = 1.0, STEP
        machine["compensator_speed"], machine["brake_lag"] = np.inf, STEP
        machine["remanence_decay"], machine["loose_axis"] = 1.0, -1.0
        self.machine = machine[0]
        self.bias, self.drift, self.mix = np.zeros(3), np.zeros(3), np.eye(3)
        self.hysteresis, self.hysteresis_width = np.zeros(3), np.ones(3)
        self.delay, self.scale, self.compliance = 0.0, np.ones(3), np.zeros(3)
        self.truth = {"mass": float(self.machine["mass"])}
        self.hidden_laws: dict[str, dict[str, float]] = {}
        self.stiffness = rng.uniform([2000.0, 1900.0, 95e3], [2600.0, 2300.0, 120e3])
        for i, axis in enumerate(AXES):
            self.truth[f"viscous.{axis}"] = self.laws["viscous"][i]
            self.truth[f"coulomb.{axis}"] = self.laws["coulomb"][i]
        for name, strength in effects.items():
            self._hide(name, strength, rng)

    def _hide(self, full: str, strength: float, rng: np.random.Generator) -> None:
        name, _, at = full.partition(":")
        size = strength * rng.uniform(0.85, 1.15)
        sign = rng.choice([-1.0, 1.0])
        axis = AXES.index(at) if at in AXES else -1
        component = COMPONENTS.index(at[0]) if at and at[0] in COMPONENTS else -1
        m, laws = self.machine, self.laws
        if name in LAWS:
            typical = {key: values[axis] for key, values in LAWS[name].items()}
            self.truth |= set_law(laws[axis], full, typical, size, rng)
            self.hidden_laws[full] = {key: float(laws[axis][key]) for key in typical}
        elif name == "backlash":
            m["gap"], m["contact"], m["loose_axis"] = 0.03 * size, 2e4, axis
        elif name == "inertia_mismatch":
            m[f"inertia_{at}"] = self.truth[f"{name}.{at}.inertia"] = 0.25 * size
        elif name == "transmission_compliance":
            self.compliance[axis] = self.truth[f"{name}.{at}.compliance"] = 0.002 * size
        elif name == "handle_payload":
            m["payload"] = self.truth["handle_payload.payload"] = 0.3 * size
        elif name == "base_tilt":
            m["tilt_x"], m["tilt_z"] = 0.02 * size * sign, 0.04 * size * rng.choice([-1.0, 1.0])
        elif name == "gravity_compensator_lag":
            m["compensator_lag"] = 0.3 * size
        elif name == "gravity_compensator_rate_limit":
            m["compensator_lag"], m["compensator_speed"] = 0.05, 0.12 / size
        elif name == "gravity_compensator_mistuned":
            m["compensator_gain"] = 1.0 + 0.06 * size * sign
            self.truth["gravity_compensator_mistuned.error"] = 0.06 * size * sign
        elif name == "force_bias":
            self.bias[component] = self.truth[f"{name}.{at}.bias"] = size * sign
        elif name == "force_drift":
            self.drift[component] = self.truth[f"{name}.{at}.rate"] = 0.12 * size * sign
        elif name == "hose":
            law = {"hose": 6.0 * size, "hose_rest": 0.1, "hose_root": 0.8 * rng.uniform(0.95, 1.05)}
            for key, value in law.items():
                m[key] = value
            self.hidden_laws[full] = law
        elif name == "sensor_hysteresis":
            self.hysteresis[component] = 0.8 * size
            self.hysteresis_width[component] = 4.0 * rng.uniform(0.85, 1.15)
            self.hidden_laws[full] = {
                "height": float(self.hysteresis[component]),
                "width": float(self.hysteresis_width[component]),
            }
        elif name == "force_gain":
            self.mix[component, component] = 1.0 + 0.06 * size * sign
        elif name == "force_crosstalk":
            self.mix[component, COMPONENTS.index(at[1])] = 0.06 * size * sign
        elif name == "force_delay":
            self.delay = self.truth["force_delay.delay"] = 0.015 * size
        elif name == "encoder_scale":
            self.scale[axis] = 1.0 / (1.0 + 0.05 * size * sign)
            self.truth[f"{name}.{at}.error"] = 0.05 * size * sign
        elif name == "brake_lag":
            m["brake_lag"] = self.truth["brake_lag.time_constant"] = 0.06 * size
        elif name == "brake_residual_torque":
            m["remanence"], m["remanence_decay"] = 0.05 * size, 5.0
        elif name == "friction_by_pose":
            laws["reach_share"][0], laws["reach_rest"][0] = 2.0 * size, MIDDLE[2]
            self.truth[f"{name}.{at}.coulomb_slope"] = 2.0 * size
        elif name == "hum":
            m["hum_torque"], m["hum_frequency"] = 0.6 * size, rng.uniform(2.0, 4.0)
        else:
            raise ValueError(f"the arm has no effect {full!r}")

    def read(self, rng: np.random.Generator, t: Any, q: Any, force: Any, c: Conditions) -> Any:
        """Counts (T, 3) and volts (T, 3) of a trial."""
        lever = np.column_stack([q[:, 2] * np.cos(q[:, 1]), q[:, 2], np.ones(len(q))])
        seen = (q - self.compliance * lever * force) * self.scale
        counts = [
            np.floor((seen[:, i] * per_unit / c.coarse) + zero / c.coarse).astype(np.int64)
            for i, (per_unit, zero) in enumerate(COUNTS.values())
        ]
        late = np.column_stack([np.interp(t - self.delay, t, f) for f in force.T])
        true = late @ self.mix.T + self.bias + self.drift * t[:, None]
        for i in np.flatnonzero(self.hysteresis):
            true[:, i] += self.hysteresis[i] * hold_back(late[:, i], self.hysteresis_width[i])
        read = read_force(rng, t, true, NOISE, c)
        return counts, np.round(np.linalg.solve(CALIBRATION, read.T).T + ZERO_V, 6)


def _hold(specimen: _Specimen, rng: np.random.Generator, axis: int) -> tuple[Any, Any, Any, Any]:
    """A locked trial: the transmission of ``axis`` winds up under the hand, in a loop."""
    t = np.arange(12000) / 500.0
    stiffness = specimen.stiffness[axis]
    wind = np.sin(2 * np.pi * t / rng.uniform(3.5, 4.0)) * (40.0, 40.0, 100.0)[axis] / stiffness
    loop = np.zeros(len(t))
    for k, step in enumerate(np.diff(wind)):
        aim = np.sign(step)
        loop[k + 1] = aim + (loop[k] - aim) * np.exp(-abs(step) / (0.1 * np.abs(wind).max()))
    q = np.tile(MIDDLE + 0.03, (len(t), 1))
    q[:, axis] += wind
    lever = (q[:, 2] * np.cos(q[:, 1]), q[:, 2], 1.0)[axis]
    force = np.sin(2 * np.pi * 0.2 * t[:, None] + rng.uniform(0.0, 6.0, 3))
    force[:, axis] = (stiffness * wind + specimen.laws["coulomb"][axis] * loop) / lever
    brake = np.zeros((len(t), 3))
    brake[:, axis] = 200.0
    return t, q, force, brake


def _head(c: Conditions, rate_hz: float) -> str:
    units = {"extension": "m"}
    encoders = "\n".join(
        f'{axis} = {{ column = "enc_{axis}", counts_per_unit = {per_unit / c.coarse!r}, '
        f'zero_counts = {round(zero / c.coarse)}, unit = "{units.get(axis, "rad")}" }}'
        for axis, (per_unit, zero) in COUNTS.items()
    )
    return f"""device = "bam"
recorded_at = 2026-10-03T10:12:00Z
sample_rate_hz = {rate_hz!r}

[encoders]
{encoders}

[force]
columns = ["force_x_v", "force_y_v", "force_z_v"]
unit = "V"
frame = "handle"
calibration_n_per_v = {CALIBRATION.tolist()}
zero_v = {ZERO_V.tolist()}
noise_sd_n = {NOISE}

[brakes]
columns = ["brake_yaw", "brake_pitch", "brake_extension"]
unit = "N.m, N.m, N"
"""


def record(
    folder: Path, seed: int, effects: Mapping[str, float], conditions: Conditions | None = None
) -> dict[str, Any]:
    """Write a session of the arm; see ``independent.record``."""
    c = conditions or GOOD
    rng = np.random.default_rng([seed, 0])
    specimen = _Specimen(rng, effects, c.creep)
    rate_hz = c.rate_hz or 500.0
    steps = round((c.seconds or 16.0) / STEP)
    trials: list[dict[str, Any]] = []

    def log(kind: str, t: Any, q: Any, force: Any, brake: Any, **more: Any) -> None:
        counts, volts = specimen.read(rng, t, q, force, c)
        file = f"trials/t{len(trials) + 1:02d}_{kind}.csv"
        trials.append({"file": file, "kind": kind, **more})
        columns = {"time_us": np.rint(t * 1e6).astype(np.int64)}
        columns |= {f"enc_{axis}": counts[i] for i, axis in enumerate(AXES)}
        columns |= {f"force_{name}_v": volts[:, i] for i, name in enumerate(COMPONENTS)}
        columns |= {f"brake_{axis}": brake[:, i] for i, axis in enumerate(AXES)}
        write_trial(folder / trials[-1]["file"], columns)

    usual = (5 if c.trials is None else c.trials, c.viscous_trials)
    kinds = [(kind == 1, None) for kind in (0, 1) for _ in range(usual[kind])]
    for number, (braked, task) in enumerate([*kinds, *((t.brakes > 0.0, t) for t in c.tasks)]):
        rng = np.random.default_rng([seed, 1 + number])
        length, kind, reach, pace = free_motion(task, number, steps, STEP, c.pace)
        if kind is not None:
            share = 0.6 if braked else 1.0
            wanted, rate = _draw_wanted(rng, length, share * reach, pace)
        elif task is not None:
            wanted, rate = follow(rng, task, AXES, STEP)
        machine = specimen.machine
        machine["hand_frequency"], machine["hand_lag"] = rng.uniform(8.0, 11.0), 0.012
        field = FIELD if task is None else FIELD * task.brakes
        machine["field"] = field
        at = sample_steps(rng, len(wanted), 1.0 / (rate_hz * STEP), c)
        q, force, brake = _move(machine, specimen.laws, wanted, rate, at, braked)
        more = {"viscous_n_s_per_m": field} if braked else {}
        log("viscous" if braked else "free", at * STEP, q, force, brake, **more)
    for i, axis in enumerate(AXES if c.locked_trials else ()):
        rng = np.random.default_rng([seed, 100 + i])
        log("locked", *_hold(specimen, rng, i), locked_axis=axis)
    truth = tell_truth("bam", seed, effects, OUTSIDE, specimen.truth, c)
    truth["hidden_laws"] = specimen.hidden_laws
    truth["stiffness"] = dict(zip(AXES, specimen.stiffness.tolist(), strict=True))
    write_session(folder, _head(c, rate_hz), trials, truth)
    return truth
