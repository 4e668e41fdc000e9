"""One axis moved by a motor under position and velocity loops: a joint with gravity, or a carriage.

A part of what moves may hang behind an elastic coupling, or behind play: the load, with the encoder
on the motor, or the motor, with the encoder on the load. The motor may be late, slow or weak, and
the controller may hold its command for a while.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numba import njit

from independent.friction import MEMORY, blank_laws, push_along, remember, resist, set_law

STEP = 1e-4
MACHINE = np.dtype(
    [
        (name, np.float64)
        for name in (
            "inertia", "moment", "moment_across", "offset",          # of the mechanism
            "load_inertia", "load_frequency", "load_damping",        # of what hangs behind it
            "gap", "driven",             # play before that; whether the motor is what hangs there
            "delay", "lag", "sag",                                   # of the motor
            "position_gain", "velocity_gain", "feed_forward", "limit", "hold",  # of the controller
        )
    ]
)  # fmt: skip

GENTLE = 0.2
"""Gains of a controller that sees the load through play, over those of one that sees the motor."""
MOTOR = {
    "actuator_delay": ("delay", "delay"),
    "actuator_lag": ("lag", "time_constant"),
    "drive_sag": ("sag", "sag"),
}
"""Effects of the motor: the field here and the parameter in bampipe."""


@njit(cache=True)
def move(m, law, goal, goal_rate, kick, log_at):
    """Integrate one record; returns position and motor force command at the samples, (n, 2).

    ``kick`` (steps,) is added to the command after the controller, and is logged with it.
    """
    h = STEP
    memories = np.zeros(1, MEMORY)
    q, v = goal[0], 0.0
    memories[0].cable = q
    load_q, load_v = q, 0.0
    command, delivered = 0.0, 0.0
    hold, late = round(m.hold / h), round(m.delay / h)
    queue = np.zeros(late + 1)
    out = np.zeros((len(log_at), 2))
    k_log = 0
    for k in range(len(goal)):
        memory = memories[0]  # a record does not keep its array alive
        if k % hold == 0:
            command = m.velocity_gain * (
                m.position_gain * (goal[k] - q) + m.feed_forward * goal_rate[k] - v
            )
            command += m.moment * np.sin(goal[k]) + m.moment_across * np.cos(goal[k])
            command = min(max(command, -m.limit), m.limit)
        asked = command + kick[k - k % hold]
        if k_log < len(log_at) and log_at[k_log] == k:
            out[k_log, 0], out[k_log, 1] = q, asked
            k_log += 1
        queue[k % (late + 1)] = asked
        acting = queue[(k + 1) % (late + 1)]
        if m.lag > 0.0:
            # The mean over the step of what a first-order lag delivers.
            decay = np.exp(-h / m.lag)
            new = acting + (delivered - acting) * decay
            acting, delivered = 0.5 * (delivered + new), new
        acting /= 1.0 + m.sag * abs(acting)
        half = q + 0.5 * h * v
        push = push_along(law, half, memory) - m.offset
        own = m.inertia - m.load_inertia
        at_load = half
        if m.gap > 0.0 and m.driven == 0.0:
            at_load = load_q + 0.5 * h * load_v
        weight = m.moment * np.sin(at_load) + m.moment_across * np.cos(at_load)
        if m.load_inertia > 0.0:
            stretch = load_q + 0.5 * h * load_v - half
            closing = load_v - v if abs(stretch) > 0.5 * m.gap else 0.0
            pressed = stretch - min(max(stretch, -0.5 * m.gap), 0.5 * m.gap)
            pull = m.load_inertia * (
                m.load_frequency**2 * pressed + 2.0 * m.load_damping * m.load_frequency * closing
            )
            far = -pull
            if m.driven > 0.0:
                far, push = far + acting, push - weight
            elif m.gap > 0.0:
                far, push = far - weight, push + acting
            else:
                push += acting - weight
            push += pull
            load_q += 0.5 * h * load_v
            load_v += h * far / m.load_inertia
            load_q += 0.5 * h * load_v
        else:
            push += acting - weight
        free = v + h * push / own
        impulse = resist(law, memory, free, v, h, own, half, acting, 0.0, 0.0)
        v = free + impulse / own
        remember(law, memory, half, v, h)
        q = half + 0.5 * h * v
    return out


class Specimen:
    """One axis with its hidden effects.

    Attributes:
        machine: record of dtype MACHINE; law: of dtype ``friction.AXIS``; play: a typical gap.
        truth: what an identification of the right model must find.
        hidden_laws: by effect, the laws of ``friction`` that it switched on.
    """

    def __init__(
        self,
        axis: str,
        values: Mapping[str, float],
        friction: Mapping[str, float],
        play: float,
    ):
        self.axis, self.play = axis, play
        self.machine = np.zeros(1, MACHINE)[0]
        for name, value in values.items():
            self.machine[name] = value
        self.law = blank_laws(1)[0]
        for name, value in friction.items():
            self.law[name] = value
        self.truth = {f"{name}.{axis}": friction[name] for name in ("viscous", "coulomb")}
        self.hidden_laws: dict[str, dict[str, float]] = {}

    def hide(
        self,
        effects: Mapping[str, float],
        laws: Mapping[str, Mapping[str, float]],
        motor: Mapping[str, float],
        rng: np.random.Generator,
    ) -> None:
        """Hide ``effects``; ``laws`` and ``motor`` hold the typical values of all it can have."""
        for full, strength in effects.items():
            name, _, at = full.partition(":")
            size = strength * rng.uniform(0.85, 1.15)
            if name in laws and at == self.axis:
                self.truth |= set_law(self.law, full, laws[name], size, rng)
                self.hidden_laws[full] = {key: float(self.law[key]) for key in laws[name]}
            elif name in motor:
                field, theirs = MOTOR[name]
                self.machine[field] = size * motor[name]
                found = float(self.machine[field])
                if field == "delay":  # in whole steps, over each of which a command is held
                    found = (round(found / STEP) + 0.5) * STEP
                self.truth[f"{full.replace(':', '.')}.{theirs}"] = found
            elif name == "flexible_load":
                # Part of the inertia that the device states hangs behind the coupling.
                self.machine["load_inertia"] = min(0.25 * size, 0.6) * self.machine["inertia"]
                self.machine["load_frequency"] = 75.0 * rng.uniform(0.85, 1.15)
                self.machine["load_damping"] = 0.04
            elif name in ("loose_load", "loose_drive"):
                m, share = self.machine, rng.uniform(0.2, 0.8)
                m["load_inertia"], m["gap"] = share * m["inertia"], self.play * size
                # A gear is as stiff whatever it moves.
                stiffness = 130.0**2 * m["inertia"] / 4.0 * rng.uniform(0.7, 1.4)
                m["load_frequency"] = np.sqrt(stiffness / m["load_inertia"])
                m["load_damping"] = rng.uniform(0.1, 0.3)
                m["driven"] = float(name == "loose_drive")
                if m["driven"]:  # with gains for a stiff drive, the loop would hammer in the gap
                    for gain in ("velocity_gain", "position_gain"):
                        m[gain] *= GENTLE
                found = {n: m[f"load_{n}"] for n in ("frequency", "damping")}
                driven = share if m["driven"] else 1.0 - share
                found |= {"gap": m["gap"], "drive_inertia": driven * m["inertia"]}
                self.truth |= {f"{full.replace(':', '.')}.{n}": float(x) for n, x in found.items()}
            else:
                raise ValueError(f"the machine has no effect {full!r}")


def describe_log(device: str, rate_hz: float, axis: str, resolution: float, channel: str) -> str:
    """The head of the session file of a drive: its encoder ``q`` in rad and one channel."""
    return f"""device = "{device}"
sample_rate_hz = {rate_hz!r}

[time]
column = "t"
unit = "s"

[encoders]
{axis} = {{ column = "q", unit = "rad", resolution = {resolution!r} }}

[channels]
{channel}
"""


def draw_moves(
    rng: np.random.Generator, steps: int, reach: float, speed: float, pause: float
) -> tuple[Any, Any]:
    """Moves between random places, (steps,), and their rate: minimum jerk, rests of ``pause`` s."""
    goal, at, k = np.zeros(steps), 0.0, round(0.2 / STEP)
    while k < steps:
        to = rng.uniform(-reach, reach)
        length = max(round(1.9 * abs(to - at) / (speed * rng.uniform(0.2, 1.0)) / STEP), 800)
        s = np.linspace(0.0, 1.0, length)[: steps - k]
        goal[k : k + length] = at + (to - at) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        goal[k + length :] = to
        at, k = to, k + length + round(rng.uniform(0.0, 2.0 * pause) / STEP)
    return goal, np.gradient(goal, STEP)


def draw_waves(
    rng: np.random.Generator, steps: int, reach: float, highest_hz: float
) -> tuple[Any, Any]:
    """Five sines within ``reach``, slow ones larger, fading in over 1.5 s; and their rate."""
    t = np.arange(steps) * STEP
    goal = np.zeros(steps)
    for w in 2 * np.pi * rng.uniform(0.06, highest_hz, 5):
        goal += np.sin(w * t + rng.uniform(0.0, 6.0)) / (0.3 + w / 3.0)
    goal *= reach * rng.uniform(0.7, 1.0) / np.abs(goal).max()
    rise = np.minimum(t / 1.5, 1.0)
    goal = (goal - goal[0]) * rise**3 * (10.0 - 15.0 * rise + 6.0 * rise**2)
    return goal, np.gradient(goal, STEP)
