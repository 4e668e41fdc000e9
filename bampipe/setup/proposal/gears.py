"""The reductions of a log on the side of the motors, by weight and inertia as drawn."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from bampipe.arrays import Array
from bampipe.physics.device import Device
from bampipe.physics.robot import Robot
from bampipe.setup.drawn_bodies import Comparison, Drive, JointMotion, fits, mean_left
from bampipe.setup.mounting import Mounting, find_mounting
from bampipe.setup.proposal.joints import Group
from bampipe.setup.proposal.positions import position_in_si, scale_to

BEYOND = 1.5
"""Times its range that a joint must travel for the position to be another's."""
DOUBTED = 0.01
"""Of the drives' variance: what other units and zeros are tried from."""
MOST_ROWS, FEW_ROWS = 4000, 1000
_SMOOTHED_S = 0.1
"""Stretch of a record over which a parabola gives velocity and acceleration."""
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


@dataclass(frozen=True)
class Logged:
    """A robot with its log: device, robot, and time stamps, (T,), s."""

    device: Device
    robot: Robot
    t: Array

    @property
    def ranges(self) -> Array:
        """Width of what each joint can move through, (n,), rad or m; infinite if not known."""
        limits = [self.device.limits.get(c.name, (0.0, 0.0)) for c in self.device.coordinates]
        return np.array([high - low if high > low else np.inf for low, high in limits])

    def positions(self, group: Group) -> Array:
        """Positions (T, n) in SI, wherever their encoders sit."""
        columns = zip(self.device.coordinates, group.columns, strict=True)
        return np.column_stack([position_in_si(column, self.t, c.unit) for c, column in columns])

    def compare(self, q: Array, drives: Group, ratio: Array, most_rows: int) -> Comparison | None:
        """The drives beside the drawing along positions (T, n); None where these do not do."""
        step = float(np.median(np.diff(self.t)))
        window = max(5, 2 * round(0.5 * _SMOOTHED_S / step) + 1) if step > 0.0 else len(q)
        if not np.isfinite(q).all() or window >= len(q):
            return None
        rows, unit = slice(None, None, max(1, len(q) // most_rows)), self.device.force_unit
        motion = JointMotion(
            *(savgol_filter(q, window, 2, deriv=k, delta=step, axis=0)[rows] for k in range(3))
        )
        return Comparison(
            self.robot,
            tuple(c.unit == "rad" for c in self.device.coordinates),
            [motion],
            np.column_stack([scale_to(unit, c) * np.nan_to_num(c.values) for c in drives.columns])[
                rows
            ],
            ratio,
        )

    def explain(self, q: Array, drives: Group, ratio: Array) -> Gears | None:
        """How the drawing explains the drives, best mounted; None where they do not compare."""
        few, many = (self.compare(q, drives, ratio, rows) for rows in (FEW_ROWS, MOST_ROWS))
        if few is None or many is None:
            return None
        mounting, judged = many.drawn, many.hold(many.drawn)
        if max(drive.left for drive in judged) >= DOUBTED:
            mounting = find_mounting(few.turning, few.drawn, few.misfit)
            judged = many.hold(mounting) if mounting.is_changed else judged
        return Gears(ratio, mounting, judged)

    def explain_geared(self, q: Array, drives: Group, turns: Array) -> Gears | None:
        """Positions of motors whose ``turns`` for one of the joint, (n,), are known.

        None where they leave a joint beyond its range, or the log is incomplete.
        """
        if (np.ptp(q / turns, axis=0) > BEYOND * self.ranges).any():
            return None
        found = self.explain(q / turns, drives, turns)
        if found is None:
            return None
        turned = replace(found.mounting, direction=found.mounting.direction * np.sign(turns))
        return Gears(np.abs(turns), turned, found.drives)

    def find_gears(self, q: Array, drives: Group) -> Gears | None:
        """Turns of each motor for one of its joint, by positions on the side of the motors.

        Weight goes with the sine of the joint's angle, so only the right reductions and zeros let
        the drawing explain the drives. None where none do well.
        """
        least = np.ptp(q, axis=0) / self.ranges
        moved, at_joint = least > BEYOND, np.ones(len(least))
        few, many = (self.compare(q, drives, at_joint, rows) for rows in (FEW_ROWS, MOST_ROWS))
        if not moved.any() or few is None or many is None:
            return None
        base, in_torque = few, self.device.force_unit == "N.m"

        def fitted(ratio: Array, mounting: Mounting) -> tuple[float, Array]:
            """Cost and reductions of the fit that starts at ``ratio``."""

            def misfit(x: Array) -> Array:
                tried = at_joint.copy()
                tried[moved] = np.exp(x)
                judged = base.reread(np.diag(1.0 / tried)).hold(mounting)
                left = np.sqrt([max(drive.left, 1e-12) for drive in judged])
                if not in_torque:
                    return np.asarray(left)
                # A torque of the motor is that of the joint over the reduction, as drawn.
                size = np.array([max(abs(drive.share), 1e-9) for drive in judged])
                return np.concatenate([left, _DRAWN * np.log(size[moved] * tried[moved])])

            found = least_squares(misfit, np.log(ratio[moved]), diff_step=1e-3, max_nfev=40)
            best = at_joint.copy()
            best[moved] = np.exp(found.x)
            return float(found.cost), best

        def sound(ratio: Array, mounting: Mounting) -> Gears | None:
            judged = many.reread(np.diag(1.0 / ratio)).hold(mounting)
            # A gear that speeds up would take the joint further beyond its range than the log goes.
            return Gears(ratio, mounting, judged) if fits(judged) and ratio.min() >= 1.0 else None

        starts = [np.where(moved, factor * least, 1.0) for factor in _MARGINS]
        ratio = min((fitted(start, few.drawn) for start in starts), key=lambda one: one[0])[1]
        found = sound(ratio, few.drawn)
        for start in starts if found is None else ():
            ratio = start
            for _ in range(_ALTERNATIONS):
                geared = few.reread(np.diag(1.0 / ratio))
                mounting = find_mounting(geared.turning, few.drawn, geared.misfit, stands=True)
                ratio = fitted(ratio, mounting)[1]
                found = sound(ratio, mounting)
                # Wrong zeros with reductions to match explain much; only the right ones all.
                if found is not None and mean_left(found.drives) < _SURE_LEFT:
                    return found
        return found if found is not None and not found.mounting.is_changed else None
