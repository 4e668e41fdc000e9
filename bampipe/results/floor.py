"""The status of a held-out error against its noise floor, the one definition of "at the floor".

Validate, diagnose and compare store it; reports, gates, the lab and the command line read it.
"""

import math
from typing import Literal

FloorStatus = Literal["at_floor", "above_floor", "floor_implausible", "floor_missing"]

AT_FLOOR = 1.2
"""Error over floor up to which a model explains all but sensor noise. No replicate is perfect:
clean axes reach 1.08 floors, and 1.16 where friction truly stops the arm; the weakest effects that
were found had 1.18."""
FLOOR_SDS = 3.0
"""Standard deviations of the floor over replicates that are allowed for. The status of no axis of
39 sessions changes from 1.9 to 3.0."""
IMPLAUSIBLE = 0.7
"""Error over floor below which the floor is wrong: the sensors are noisier than the data, or a
replicate does not resemble the machine. No axis of 39 sessions changes its status from 0.55 to
0.88."""

FLOOR_WRONG = ("floor_implausible", "floor_missing")
"""Statuses in which an error cannot be judged."""


def compare_with_floor(error: float, floor: float | None, floor_sd: float = 0.0) -> FloorStatus:
    """Compare a held-out error with its noise floor.

    Args:
        error: held-out error of one axis.
        floor: its noise floor in the same unit, None where there is none.
        floor_sd: scatter of the floor over replicates; `FLOOR_SDS` of it are allowed for.
    """
    if floor is None or not math.isfinite(floor) or not math.isfinite(error) or floor <= 0.0:
        return "floor_missing"
    if error < IMPLAUSIBLE * floor - FLOOR_SDS * floor_sd:
        return "floor_implausible"
    return "at_floor" if error <= AT_FLOOR * floor + FLOOR_SDS * floor_sd else "above_floor"
