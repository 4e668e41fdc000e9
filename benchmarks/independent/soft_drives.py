"""An arm whose drives follow a path softly, so that dry friction holds its joints where they turn.

Dry friction is solved for in each step, as the impulse within its bounds that stops a joint, or
else opposes it: a joint stands still, and does not creep.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit

Array = np.ndarray

STEP = 1e-3
SWEEPS, ENOUGH = 200, 1e-12


def follow(
    forces: Callable[[Array, Array, Array], tuple[Array, Array]],
    viscous: Array,
    path: tuple[Array, Array],
    soft_hz: float,
    late_s: Array,
) -> tuple[Array, Array]:
    """Positions and drives, each (T, n), every ``STEP`` s from rest at the start of the path.

    Positions and half steps of velocity leap over each other: second order where nothing sticks.

    Args:
        forces: required force without friction, and level of dry friction, each (m, n), at
            positions, rates and accelerations (m, n).
        viscous: (n,); path: (T, n) positions and rates that the drives want.
        soft_hz: natural frequency of a joint under its drive; late_s: (n,) by which each acts late.

    Raises:
        ValueError: with this delay the drives do not hold the path.
    """
    wanted, wanted_rate = path
    count, n = wanted.shape
    q, v, before = wanted[0].copy(), np.zeros(n), np.zeros(n)
    units, h = np.vstack([np.zeros(n), np.eye(n)]), STEP
    rows, zeros = np.ones((n + 1, 1)), np.zeros((n + 1, n))
    load, _ = forces(rows * q, zeros, units)
    inertia, held = np.diag(load[1:] - load[0]), load[0]
    w = 2.0 * np.pi * soft_hz
    behind = np.round(late_s / h).astype(int)
    out, drives = np.empty((count, n)), np.empty((count, n))
    farthest = np.ptp(wanted, axis=0)
    impulse = np.zeros(n)
    for k in range(count):
        drive = held + inertia * (w * w * (wanted[k] - q) + 2.0 * w * (wanted_rate[k] - v))
        out[k], drives[k] = q, drive
        acting = drives[np.maximum(k - behind, 0), np.arange(n)]
        load, dry = forces(rows * q, rows * (v + 0.5 * h * before), units)
        mass = (load[1:] - load[0]).T
        damped = np.linalg.inv(mass + 0.5 * h * np.diag(viscous))
        free = damped @ (mass @ v - 0.5 * h * viscous * v + h * (acting - load[0]))
        new = _rub(free, damped, h * dry[0], impulse)
        before, v = (new - v) / h, new
        q = q + h * v
        if np.any(np.abs(q - wanted[k]) > farthest):
            raise ValueError(f"drives of {soft_hz} Hz are unstable when they act {late_s} s late")
    return out, drives


@njit(cache=True)
def _rub(free, response, most, impulse):
    """Velocities (n,) after friction; its impulse (n,) is where the search starts, and ends."""
    v = free - response @ impulse
    for _ in range(SWEEPS):
        moved = 0.0
        for i in range(len(v)):
            new = min(max(impulse[i] + v[i] / response[i, i], -most[i]), most[i])
            change = new - impulse[i]
            impulse[i] = new
            v -= response[:, i] * change
            moved = max(moved, abs(change * response[i, i]))
        if moved < ENOUGH:
            break
    for i in range(len(v)):
        if abs(impulse[i]) < most[i]:
            v[i] = 0.0
    return v
