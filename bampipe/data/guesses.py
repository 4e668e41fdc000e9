"""Guesses from the data themselves: time unit, rate, what follows what, and what drives what."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bampipe.data.angle_torque import AngleTorque, angle_torque, least_squares
from bampipe.data.quality.clock import rate_of
from bampipe.data.session import SECONDS
from bampipe.data.smoothing import SmoothedMotion

RATES_HZ = (4.0, 30_000.0)
"""Sample rates at which motion is logged."""

_NICE = (1, 1.2, 1.25, 1.5, 2, 2.5, 3, 4, 5, 6, 7.5, 8)


def time_unit(t: np.ndarray, said: str) -> str:
    """Unit of a time column: as said, else the one that gives a rate at which motion is logged."""
    if said in (*SECONDS, "datetime"):
        return said
    steps = np.diff(t[np.isfinite(t)])
    step = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
    if step <= 0.0:
        return ""
    order = ("us", "ms", "ns", "s") if np.all(t == np.rint(t)) else ("s", "ms", "us", "ns")
    fitting = [u for u in order if RATES_HZ[0] <= 1.0 / (step * SECONDS[u]) <= RATES_HZ[1]]
    return fitting[0] if fitting else ""


def likely_unit(si: str, values: np.ndarray) -> str:
    """Unit of a column that is ``si`` or a multiple, by the size of its values; "" if it is ``si``.

    No joint turns by ten turns while it is logged, no bench-top axis is five metres long, and no
    small motor takes a hundred amperes.
    """
    known = values[np.isfinite(values)]
    span = float(np.ptp(known)) if len(known) else 0.0
    limit, other = {"rad": (62.8, "deg"), "m": (5.0, "mm"), "A": (100.0, "mA")}.get(si, (0, ""))
    return other if other and span > limit else ""


def interval_of(name: str, value: float) -> float:
    """Sampling interval, s, that a number beside the samples gives (``Ts``, ``fs``), else 0."""
    plain = name.lower().replace("_", "")
    if value > 0.0 and plain in ("ts", "dt", "tsample", "sampletime", "samplingtime"):
        return value
    if value > 0.0 and plain in ("fs", "samplerate", "samplingrate", "fsample"):
        return 1.0 / value
    return 0.0


def sample_rate(t: np.ndarray) -> float:
    """Rate of time stamps ``t`` (T,), s, in Hz: a round number where one is within 1 %."""
    rate = rate_of(t[np.isfinite(t)])
    decade = 10.0 ** math.floor(math.log10(rate))
    nearest = min((n * decade for n in (*_NICE, 10)), key=lambda nice: abs(nice - rate))
    return float(f"{nearest:.6g}") if abs(nearest / rate - 1) < 0.01 else float(f"{rate:.4g}")


def follows(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether ``second`` does what ``first`` did a little earlier, as a machine its reference."""
    slope = 0.5 * (np.gradient(first) + np.gradient(second))
    return float((first - second) @ slope) > 0.0


@dataclass(frozen=True)
class Driven:
    """How a column goes with the motion of an axis, by least squares on one log.

    Attributes:
        share: part of its variance that acceleration, velocity, its sign and position explain,
            0 to 1; a force, a current or a voltage that moves a mass with friction has much.
        inertia, viscous, coulomb: what multiplies acceleration, velocity and its sign.
        pose: what follows the position where that is an angle; None where it is none.
    """

    share: float
    inertia: float = 0.0
    viscous: float = 0.0
    coulomb: float = 0.0
    pose: AngleTorque | None = None


def driven(t: np.ndarray, q: np.ndarray, column: np.ndarray, angle: bool = False) -> Driven:
    """Hold a column against the motion.

    Args:
        t: (T,) s; q: (T,) position; column: (T,).
        angle: whether the position is an angle in rad, on which gravity may depend.
    """
    motion = SmoothedMotion.of(t, q)
    if motion is None:
        return Driven(0.0)
    moving = np.column_stack([motion.moving, np.ones_like(q)])[motion.inner]
    position = motion.position[motion.inner]
    target = motion.smooth(column)[motion.inner]
    spread = float(np.sum((target - target.mean()) ** 2)) if len(target) else 0.0
    if spread == 0.0:
        return Driven(0.0)
    found, rest = least_squares(np.column_stack([moving, position]), target)
    share = max(0.0, 1.0 - float(rest @ rest) / spread)
    pose = angle_torque(moving, position, target) if angle else None
    if pose is not None and pose.is_gravity:
        # Friction apart, this is what a link that hangs on the axis shows most.
        found = pose.beside
    inertia, viscous, coulomb = (float(value) for value in found[:3])
    return Driven(share, inertia, viscous, coulomb, pose)


def signed_register(values: np.ndarray) -> int:
    """Bits of an unsigned register that holds signed numbers, 0 where it is none."""
    known = values[np.isfinite(values)]
    if len(known) == 0 or known.min() < 0 or not np.all(known == np.rint(known)):
        return 0
    for bits in (16, 32):
        top, half = 2.0**bits, 2.0 ** (bits - 1)
        if half < known.max() < top and np.any(known < half) and np.any(known > 0.75 * top):
            middle = np.mean((known > 0.25 * top) & (known < 0.75 * top))
            return bits if middle < 0.01 else 0
    return 0


def signed(values: np.ndarray, bits: int) -> np.ndarray:
    """What an unsigned register of so many bits stands for; the values themselves where 0."""
    return np.where(values >= 2.0 ** (bits - 1), values - 2.0**bits, values) if bits else values


def stretches(t: np.ndarray, q: np.ndarray) -> list[float]:
    """Where to cut one record into parts, s: at rests near even spacing; none if it is short.

    Args:
        t: (T,) s from 0; q: (T,) position.
    """
    parts = min(5, int(t[-1] // 4.0))
    if parts < 2:
        return []
    speed = np.abs(np.gradient(q))  # a sample: stamps may stand twice
    cuts = []
    for k in range(1, parts):
        near = np.abs(t - t[-1] * k / parts) < 0.15 * t[-1] / parts
        slowest = np.flatnonzero(near)[int(np.argmin(speed[near]))]
        cuts.append(round(float(t[slowest]), 2))
    return cuts
