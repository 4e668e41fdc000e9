"""A body that a log shows far heavier than it is drawn, and the payload that it suggests."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.heavier_body import HeavierBody, find_heavier_body, fit_point_mass
from bampipe.physics.robot import Robot
from bampipe.setup.drawn_bodies import Comparison
from bampipe.setup.mounting import Mounting

Array = NDArray[np.float64]


def find_heavy(compared: Comparison, mounting: Mounting) -> HeavierBody | None:
    """The body that alone is far heavier than drawn, as all drives, N.m or N, have it."""
    if not mounting.gravity.any():
        return None
    return find_heavier_body(_signed_drives(compared, mounting), compared.by_body(mounting))


def _signed_drives(compared: Comparison, mounting: Mounting) -> list[Array]:
    signs = [-1.0 if drive.is_turned else 1.0 for drive in compared.hold(mounting)]
    return [sign * loss.drive for sign, loss in zip(signs, compared.losses, strict=True)]


def describe_heavy(
    compared: Comparison,
    mounting: Mounting,
    found: HeavierBody,
    in_tip: Callable[[Array], Array] | None = None,
) -> str:
    """Say which body is heavier than drawn; of the last one, with the payload that it suggests.

    Args:
        compared: drives with the drawn bodies; mounting: of the joints and the base.
        found: the body.
        in_tip: makes of a place in the frame of the last joint, (3,), one in that of the tip.
    """
    robot = compared.robot
    said, joint = robot.describe_mass(found.place, found.factor), robot.joints[found.place]
    if joint is not robot.joints[-1] or robot.payload is not None or in_tip is None:
        return said
    pairs = zip(_signed_drives(compared, mounting), compared.by_body(mounting), strict=True)
    mass, center = fit_point_mass(
        [drive - forces.sum(axis=1) for drive, forces in pairs],
        compared.by_number(mounting, found.place),
        (found.factor - 1.0) * joint.mass,
        np.array(joint.center),
    )
    place = ", ".join(f"{value:.2g}" for value in in_tip(center))
    return f"{said} mass = {mass:.3g}, center = [{place}]"


def with_heavier_body(robot: Robot, found: HeavierBody) -> Robot:
    """The robot with that body as heavy as it was found."""
    joints = list(robot.joints)
    one = joints[found.place]
    joints[found.place] = one.model_copy(
        update={
            "mass": found.factor * one.mass,
            "inertia": tuple(found.factor * number for number in one.inertia),
        }
    )
    return robot.model_copy(update={"joints": tuple(joints)})
