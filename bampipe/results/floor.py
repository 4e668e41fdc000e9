"""The status of a held-out error against its noise floor, the one definition of "at the floor".

Validate, diagnose and compare store it; reports, gates, the lab and the command line read it.
"""

import math
from typing import Literal

FloorStatus = Literal["at_floor", "above_floor", "floor_implausible", "floor_missing"]

AT_FLOOR = 1.2
"""Largest error over floor of a model that explains all but sensor noise. No replicate is perfect:
clean axes reach 1.08 floors, and 1.16 if friction truly stops the arm; the weakest effects found
had 1.18."""
FLOOR_SDS = 3.0
"""Allowed standard deviations of the floor over replicates. Between 1.9 and 3.0, no axis of 39
sessions changes its status."""
IMPLAUSIBLE = 0.7
"""Least error over floor; below it the floor is wrong, because the stated sensor noise is too large
or a replicate does not resemble the machine. Between 0.55 and 0.88, no axis of 39 sessions changes
its status."""

FLOOR_WRONG = ("floor_implausible", "floor_missing")
"""Statuses without a valid floor."""


def compare_with_floor(error: float, floor: float | None, floor_sd: float = 0.0) -> FloorStatus:
    """Compare a held-out error with its noise floor.

    Args:
        error: held-out error of one axis.
        floor: its noise floor in the same unit, None without one.
        floor_sd: scatter of the floor over replicates; `FLOOR_SDS` of it are allowed for.
    """
    if floor is None or not math.isfinite(floor) or not math.isfinite(error) or floor <= 0.0:
        return "floor_missing"
    if error < IMPLAUSIBLE * floor - FLOOR_SDS * floor_sd:
        return "floor_implausible"
    return "at_floor" if error <= AT_FLOOR * floor + FLOOR_SDS * floor_sd else "above_floor"
