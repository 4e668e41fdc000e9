"""The reductions of a log on the side of the motors, by weight and inertia as drawn."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bampipe.physics.device import Device
from bampipe.physics.robot import Robot
from bampipe.proposal.drawing import (
    FEW_ROWS,
    MOST_ROWS,
    Comparison,
    Drive,
    JointMotion,
    fits,
    mean_left,
    motion_along,
    positions_of,
    range_of,
)
from bampipe.proposal.joints import Group
from bampipe.proposal.mounting import Mounting, find_mounting

Array = NDArray[np.float64]

BEYOND = 1.5
"""Times its range that a joint must travel for the position to be another's."""
DOUBTED = 0.01
"""Of the drives' variance: what other units and zeros are tried from."""
_MARGINS = (1.05, 1.4, 2.0)
"""Of its range over what a motor travels: how much of its range a joint is thought to use."""
_DRAWN = 0.05
"""Weight of the size of the drawn bodies beside the shape of the drives."""
_SURE_LEFT = 0.02
"""Of the drives' variance: what the right reductions leave at most where zeros are guessed, too."""
_ALTERNATIONS = 2
"""How often zeros are sought with the reductions found so far, and reductions with these zeros."""


@dataclass(frozen=True)
class Gears:
    """Motors that turn joints.

    Attributes:
        ratio: turns of each motor for one of its joint, (n,).
        mounting: of the joints and the base.
        drives: what they make of the drives.
    """

    ratio: Array
    mounting: Mounting
    drives: list[Drive]


def find_best_mounting(few: Comparison, many: Comparison) -> tuple[Mounting, list[Drive]]:
    """The mounting that lets the drawing explain most by a few rows, and the drives by many."""
    judged = many.hold(many.drawn)
    if max(drive.left for drive in judged) < DOUBTED:
        return many.drawn, judged
    mounting = find_mounting(few.turning, few.drawn, few.misfit)
    return mounting, many.hold(mounting) if mounting.is_changed else judged


def known_gears(
    device: Device, robot: Robot, positions: Group, drives: Group, t: Array, turns: Array
) -> Gears | None:
    """Positions on the side of motors whose ``turns`` for one of the joint, (n,), are known.

    None where they leave a joint beyond its range, or the log is incomplete.
    """
    q = positions_of(device, positions, t)
    widths = np.array([range_of(device, c.name) for c in device.coordinates])
    if (np.ptp(q / turns, axis=0) > BEYOND * widths).any():
        return None
    few, many = (motion_along(q / turns, t, rows) for rows in (FEW_ROWS, MOST_ROWS))
    if few is None or many is None:
        return None
    mounting, judged = find_best_mounting(
        *(Comparison(device, robot, drives, turns, motion) for motion in (few, many))
    )
    turned = replace(mounting, direction=mounting.direction * np.sign(turns))
    return Gears(np.abs(turns), turned, judged)


def find_gears(
    device: Device, robot: Robot, positions: Group, drives: Group, t: Array
) -> Gears | None:
    """Turns of each motor for one of its joint, by positions on the side of the motors.

    Weight goes with the sine of the joint's angle, so only the right reductions and zeros let the
    drawing explain the drives. None where none do well.
    """
    q = positions_of(device, positions, t)
    span = np.ptp(q, axis=0)
    least = span / np.array([range_of(device, c.name) for c in device.coordinates])
    moved, at_joint = least > BEYOND, np.ones(len(least))
    few, many = (motion_along(q, t, rows) for rows in (FEW_ROWS, MOST_ROWS))
    if not moved.any() or few is None or many is None:
        return None
    in_torque = device.force_unit == "N.m"

    def held(motors: JointMotion, ratio: Array) -> Comparison:
        return Comparison(device, robot, drives, at_joint, motors.scaled(1.0 / ratio))

    def fitted(ratio: Array, mounting: Mounting) -> tuple[float, Array]:
        """Cost and reductions of the fit that starts at ``ratio``."""

        def misfit(x: Array) -> Array:
            tried = at_joint.copy()
            tried[moved] = np.exp(x)
            judged = held(few, tried).hold(mounting)
            left = np.sqrt([max(drive.left, 1e-12) for drive in judged])
            if not in_torque:
                return np.asarray(left)
            # A torque of the motor is that of the joint over the reduction, as well as it is drawn.
            size = np.array([max(abs(drive.share), 1e-9) for drive in judged])
            return np.concatenate([left, _DRAWN * np.log(size[moved] * tried[moved])])

        found = least_squares(misfit, np.log(ratio[moved]), diff_step=1e-3, max_nfev=40)
        best = at_joint.copy()
        best[moved] = np.exp(found.x)
        return float(found.cost), best

    def sound(ratio: Array, mounting: Mounting) -> Gears | None:
        judged = held(many, ratio).hold(mounting)
        # A gear that speeds up would take the joint further beyond its range than the log goes.
        return Gears(ratio, mounting, judged) if fits(judged) and ratio.min() >= 1.0 else None

    starts = [np.where(moved, factor * least, 1.0) for factor in _MARGINS]
    drawn = held(few, at_joint).drawn
    ratio = min((fitted(start, drawn) for start in starts), key=lambda one: one[0])[1]
    found = sound(ratio, drawn)
    for start in starts if found is None else ():
        ratio = start
        for _ in range(_ALTERNATIONS):
            with_gears = held(few, ratio)
            mounting = find_mounting(with_gears.turning, drawn, with_gears.misfit, stands=True)
            ratio = fitted(ratio, mounting)[1]
            found = sound(ratio, mounting)
            # Wrong zeros with reductions to match them explain much; only the right ones all.
            if found is not None and mean_left(found.drives) < _SURE_LEFT:
                return found
    return found if found is not None and not found.mounting.is_changed else None
