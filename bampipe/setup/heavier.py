"""A body that a log shows far heavier than it is drawn, and the payload that it suggests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from bampipe.arrays import Array
from bampipe.physics.robot import Robot
from bampipe.setup.drawn_bodies import Comparison
from bampipe.setup.mounting import Mounting

_FAR = 2.0
"""Factor from which a mass is no longer what a drawing is wrong by."""
_LEAST_LEFT = 3e-3
"""Share of a drive's mean square below which no drawing is believed to be better than another."""
_WORTH = np.log(4.0)
"""What a body must gain of the sum over the joints of the logarithm of what is left."""
_EXPLAINED = 0.3
"""Share of the mean square of all drives together that it leaves at most."""


@dataclass(frozen=True)
class HeavierBody:
    """A body that explains the drives where it is heavier than drawn.

    Attributes:
        place: number of the body; factor: of its mass and inertia over those drawn.
    """

    place: int
    factor: float


def find_heavy(compared: Comparison, mounting: Mounting) -> HeavierBody | None:
    """The one body whose mass lets the drawing explain all drives, N.m or N; None where none does.

    A drive in another unit, or all of them, is one number, too: a body must explain more.
    """
    if not mounting.gravity.any():
        return None
    drives, bodies = _signed_drives(compared, mounting), compared.by_body(mounting)
    size = [max(float(np.mean(drive**2)), np.finfo(float).tiny) for drive in drives]

    def misfit(left: Sequence[Array]) -> Array:
        shares = [float(np.mean(rest**2)) / s for rest, s in zip(left, size, strict=True)]
        return np.log(np.array(shares) + _LEAST_LEFT)

    whole = [columns.sum(axis=1) for columns in bodies]
    rest = [drive - force for drive, force in zip(drives, whole, strict=True)]
    drawn, scaled = misfit(rest), misfit(_fitted(rest, whole, size)[1])
    alone = misfit([_fitted([r], [w], [1.0])[1][0] for r, w in zip(rest, whole, strict=True)])
    least = min(float(scaled.sum()), float(drawn.sum() + (alone - drawn).min()))
    best: tuple[float, HeavierBody, list[Array]] | None = None
    for place in range(bodies[0].shape[1]):
        change, left = _fitted(rest, [columns[:, place] for columns in bodies], size)
        score = float(misfit(left).sum())
        if 1.0 + change > _FAR and score < (best[0] if best else least - _WORTH):
            best = score, HeavierBody(place, 1.0 + change), left
    if best is None:
        return None
    share = sum(float(np.mean(one**2)) for one in best[2]) / sum(size)
    return best[1] if share < _EXPLAINED else None


def _fitted(
    rest: Sequence[Array], columns: Sequence[Array], size: Sequence[float]
) -> tuple[float, list[Array]]:
    """How much of a column, (K,) by joint, brings ``rest`` closest to zero, and what it leaves."""
    weights = [1.0 / (s * len(one)) for s, one in zip(size, rest, strict=True)]
    along = sum(w * float(c @ r) for w, c, r in zip(weights, columns, rest, strict=True))
    square = sum(w * float(c @ c) for w, c in zip(weights, columns, strict=True))
    change = along / max(square, np.finfo(float).tiny)
    return change, [r - change * c for r, c in zip(rest, columns, strict=True)]


def _fit_point_mass(
    rest: Sequence[Array], columns: Sequence[Array], mass: float, center: Array
) -> tuple[float, Array]:
    """Mass, kg, and place, (3,), m, of a point on a body that explains most of the drives.

    Args:
        rest: by joint, what is left of its drive, (K,).
        columns: by joint, what one of each of the body's ten inertial numbers adds, (K, 10).
        mass, center: where to start.
    """
    size = [max(float(np.linalg.norm(one)), np.finfo(float).tiny) for one in rest]

    def left(x: Array) -> Array:
        m, c = x[0], x[1:]
        about = m * (c @ c * np.eye(3) - np.outer(c, c))
        numbers = np.array([m, *(m * c), *about[np.triu_indices(3)]])
        parts = zip(rest, columns, size, strict=True)
        held = 1e-3 * (x - start)
        return np.concatenate([*((one - by @ numbers) / s for one, by, s in parts), held])

    start = np.array([mass, *center])
    found = least_squares(left, start, x_scale=[mass, 0.1, 0.1, 0.1])
    return float(found.x[0]), np.asarray(found.x[1:])


def _signed_drives(compared: Comparison, mounting: Mounting) -> list[Array]:
    signs = [-1.0 if drive.is_turned else 1.0 for drive in compared.hold(mounting)]
    return [sign * loss.drive for sign, loss in zip(signs, compared.losses, strict=True)]


def describe_heavy(
    compared: Comparison, mounting: Mounting, found: HeavierBody, in_tip: Callable[[Array], Array]
) -> str:
    """Say which body is heavier than drawn; of the last one, with the payload that it suggests.

    Args:
        compared: drives with the drawn bodies; mounting: of the joints and the base.
        found: the body.
        in_tip: makes of a place in the frame of the last joint, (3,), one in that of the tip.
    """
    robot = compared.robot
    said, joint = robot.describe_mass(found.place, found.factor), robot.joints[found.place]
    if joint is not robot.joints[-1] or robot.payload is not None:
        return said
    pairs = zip(_signed_drives(compared, mounting), compared.by_body(mounting), strict=True)
    mass, center = _fit_point_mass(
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
