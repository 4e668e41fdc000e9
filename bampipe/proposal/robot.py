"""Whether the columns of a robot's log agree with its drawing: sign and size of the drives."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from bampipe.data.survey import SurveyedColumn
from bampipe.physics.device import Device
from bampipe.physics.newton_euler import Algebra, joint_forces
from bampipe.physics.robot import Robot, gravity_vector
from bampipe.proposal.positions import position_in_si, scale_to

Array = NDArray[np.float64]

_SMOOTHED_S = 0.1
"""Stretch of a record over which a parabola gives velocity and acceleration."""
_SURE = 5.0
"""Standard errors from which on the sign of a drive is known."""
_ALIKE = 3.0
"""Ratio of drive and drawing up to which they are taken to be of the same side."""
_BEYOND = 1.5
"""Times its range that a joint must travel for the position to be another's."""


def check_against_drawing(
    device: Device,
    robot: Robot,
    positions: Mapping[str, SurveyedColumn],
    drives: Mapping[str, SurveyedColumn],
    t: Array,
) -> list[str]:
    """Return what weight and inertia of the drawn bodies say of the columns, a sentence each.

    The drive of each joint is regressed on what its motion requires by the drawing, friction and
    an offset. A share near one is right; a negative one is a sign the wrong way round.

    Args:
        device, robot: the robot; positions: column of each joint's position; drives: of what
            drives it. Joints without either are left out.
        t: (T,) time, s.
    """
    joints = [c.name for c in device.coordinates]
    if set(positions) != set(joints):
        return []
    q = np.column_stack([position_in_si(positions[c.name], t, c.unit) for c in device.coordinates])
    if not np.isfinite(q).all() or len(q) < 50:
        return []
    beyond = _beyond_range(device, q)
    if beyond:
        return beyond
    step = float(np.median(np.diff(t)))
    window = max(5, 2 * round(0.5 * _SMOOTHED_S / step) + 1)
    if not step > 0.0 or window >= len(q):
        return []
    smooth = [savgol_filter(q, window, 2, deriv=k, delta=step, axis=0) for k in range(3)]
    rows = slice(None, None, max(1, len(q) // 4000))
    position, rate, change = (list(part[rows].T) for part in smooth)
    bodies = [list(joint.inertial) for joint in robot.joints]
    forces = joint_forces(
        Algebra.numbers(), robot.links, bodies, position, rate, change, gravity_vector(robot)
    )
    found = []
    for k, joint in enumerate(joints):
        if joint in drives:
            required = np.broadcast_to(forces[k], rate[k].shape)
            values = np.nan_to_num(drives[joint].values)[rows] * scale_to(
                device.force_unit, drives[joint]
            )
            share = _share(required, rate[k], change[k], values)
            found += _sentence(joint, drives[joint].name, *share)
    return found


def _beyond_range(device: Device, q: Array) -> list[str]:
    found = []
    for k, c in enumerate(device.coordinates):
        low, high = device.limits.get(c.name, (-np.inf, np.inf))
        if np.ptp(q[:, k]) > _BEYOND * (high - low):
            found.append(
                f"{c.name} travels {np.ptp(q[:, k]):.3g} {c.unit}, and its range is"
                f" {high - low:.3g}: a position of the motor? give counts_per_unit, its turns for"
                " one of the joint"
            )
    return found


def _share(required: Array, rate: Array, change: Array, drive: Array) -> tuple[float, float]:
    """How much of the drive goes with one of what is required, and its standard error.

    The inertia of the drive itself, of which a drawing says nothing, takes part.
    """
    sign = np.tanh(rate / max(0.02 * float(np.abs(rate).max()), 1e-9))
    columns = np.column_stack([required, change, rate, sign, np.ones_like(rate)])
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    values, _, rank, _ = np.linalg.lstsq(columns / size, drive, rcond=1e-9)
    if rank < columns.shape[1]:
        return 0.0, np.inf
    left = drive - columns / size @ values
    inverse = np.linalg.inv((columns / size).T @ (columns / size))
    # Neighbouring samples err alike: about one in ten counts.
    error = np.sqrt(10.0 * np.mean(left**2) * inverse[0, 0])
    return float(values[0] / size[0]), float(error / size[0])


def _sentence(joint: str, column: str, share: float, error: float) -> list[str]:
    if not abs(share) > _SURE * error:
        return [f"{column}: too little weight and inertia act on {joint} to tell its sign"]
    shown = f"{share:.2g} ± {error:.1g} times what the drawing requires"
    if share < 0.0:
        return [f"{column} is {shown}: turn its sign, or that of {joint}"]
    if not 1.0 / _ALIKE < share < _ALIKE:
        return [
            f"{column} is {shown}: another unit, or the torque of a motor with a reduction of about"
            f" {1.0 / share:.3g}"
        ]
    return []
