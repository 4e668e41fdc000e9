"""A body that a log shows far heavier than it is drawn, and the payload that it suggests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bampipe.data.chain import frame_of_tip, read_tree
from bampipe.estimate.heavier_body import find_heavier_body, fit_point_mass
from bampipe.proposal.drawing import Comparison
from bampipe.proposal.mounting import Mounting


def describe_heavier_body(compared: Comparison, mounting: Mounting, folder: Path) -> str:
    """Say which body is far heavier than drawn; "" where none is, or no torque tells.

    Args:
        compared: drives, N.m or N, with the drawn bodies.
        mounting: of the joints and the base; folder: of the robot's file.
    """
    robot = compared.robot
    if compared.device.force_unit == "A" or not mounting.gravity.any():
        return ""
    signs = np.array([-1.0 if drive.is_turned else 1.0 for drive in compared.hold(mounting)])
    drives = [sign * loss.drive for sign, loss in zip(signs, compared.losses, strict=True)]
    columns = compared.by_number(mounting)
    drawn = [joint.inertial for joint in robot.joints]
    bodies = [
        np.column_stack([by @ numbers for by, numbers in zip(row, drawn, strict=True)])
        for row in columns
    ]
    found = find_heavier_body(drives, bodies)
    if found is None:
        return ""
    joint = robot.joints[found.place]
    said = robot.describe_mass(found.place, found.factor)
    if joint is not robot.joints[-1] or robot.payload is not None:
        return said
    rest = [drive - forces.sum(axis=1) for drive, forces in zip(drives, bodies, strict=True)]
    mass, center = fit_point_mass(
        rest,
        [row[found.place] for row in columns],
        (found.factor - 1.0) * joint.mass,
        np.array(joint.center),
    )
    if robot.urdf is not None:
        turn, offset = frame_of_tip(read_tree(folder / robot.urdf), robot.base, robot.tip)
        center = turn.T @ (center - offset)
    place = ", ".join(f"{value:.2g}" for value in center)
    return f"{said} mass = {mass:.3g}, center = [{place}]"
