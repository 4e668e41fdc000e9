"""Readings at a rail: a sensor, a register or a converter that goes no further than it can."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bampipe.data.angle_torque import least_squares
from bampipe.data.quality.table import TrialTable, find_runs, longest_run
from bampipe.data.smoothing import SmoothedMotion
from bampipe.results.ingest import DeadStretch

Flags = NDArray[np.bool_]

_TIMES_BESIDE = 5
"""How much more often a rail is read than any level near it."""
_LONGEST_RUN = 5
"""Samples in a row at a rail, the least that its longest run has."""
_LEAST, _MOST = 0.005, 0.6
"""Share of the samples at rails: below, they are left; above, the column is rather a command."""
_FEWEST_LEVELS = 50
"""Different readings of a column that goes from one value to another rather than in steps."""
_BESIDE = 10
"""Levels next to a rail that it is held against."""
_EXPLAINED = 0.5
"""Share of the variance between the rails that the motion must explain to tell what is beyond."""
_BEYOND = 2.0
"""Times what it leaves there, by which the motion must ask for more than the rail, in the mean."""


def find_rails(values: np.ndarray) -> dict[float, Flags]:
    """Extremes at which readings (T,) pile up: the samples (T,) at each."""
    levels, counts = np.unique(values, return_counts=True)
    rails = {}
    for rail, pile, beside in (
        (levels[-1], counts[-1], counts[-1 - _BESIDE : -1]),
        (levels[0], counts[0], counts[1 : 1 + _BESIDE]),
    ):
        at_rail, piled = values == rail, len(beside) > 1 and pile > _TIMES_BESIDE * beside.max()
        if piled and longest_run(at_rail)[1] >= _LONGEST_RUN:
            rails[float(rail)] = at_rail
    return rails


def leave_out_rails(table: TrialTable) -> None:
    """Leave out what an input reads at a rail.

    A command that stands at its limit is all that the machine gets; a reading that does tells
    nothing. A sensor's volts are readings; of other inputs the motion says which of the two they
    are: regressed on it between the rails, an input goes on beyond them or does not.

    Raises:
        InputError: a sensor of a locked trial, which is used as a whole, is at a rail for long.
    """
    force, limits = table.session.force, table.limits
    sensed = force is not None and force.volts and limits.saturated_share < 1.0
    volts = force.columns if force is not None and sensed else ()
    motions = None
    for column in table.inputs:
        values = table.columns[column]
        rails = {rail: at for rail, at in find_rails(values).items() if rail != 0.0}
        share = float(sum(at.mean() for at in rails.values()))
        where = " and ".join(f"{rail:g}" for rail in sorted(rails))
        said = f"{share:.1%} of the samples stand at the rail {where}"
        most = limits.saturated_share if table.entry.kind == "locked" else _MOST
        if column in volts and share > most:
            raise table.fault(
                f"{said}: saturated, more than {most:.0%}",
                column=column,
                at=int(np.argmax(np.any(list(rails.values()), axis=0))),
                remedy="lower the gain or the load",
            )
        in_steps = len(np.unique(values)) < _FEWEST_LEVELS and column not in volts
        if not _LEAST <= share <= _MOST or in_steps:
            continue
        said = f"column '{column}': {said}"
        if column not in volts:
            motions = motions if motions is not None else _motions(table)
            farthest = _beyond(values, rails, motions)
            if not farthest:
                if farthest is None:
                    table.notes.append(
                        f"{said}; left in: the motion does not tell if it takes more"
                    )
                continue
            said += f", where the motion takes up to {farthest:.3g}"
        table.repairs.append(f"{said}: left out")
        for rail, at_rail in rails.items():
            for start, stop in zip(*find_runs(at_rail), strict=True):
                first, last = float(table.t[start]), float(table.t[stop - 1])
                table.dead.append(DeadStretch(column=column, start_s=first, end_s=last, rail=rail))


def _motions(table: TrialTable) -> list[SmoothedMotion]:
    found = []
    for encoder in table.session.encoders:
        q = (table.columns[encoder.column] - encoder.zero) * encoder.scale
        motion = SmoothedMotion.of(table.t, q)
        found += [motion] if motion is not None else []
    return found


def _beyond(
    values: np.ndarray, rails: dict[float, Flags], motions: list[SmoothedMotion]
) -> float | None:
    """How far the motion takes an input beyond its rails; 0 where it does not, None: not told."""
    if not motions:
        return None
    sides = [np.ones(len(values))]
    for motion in motions:
        angle = motion.position
        sides += [*motion.moving.T, angle, np.sin(angle), np.cos(angle)]
    design, target = np.column_stack(sides), motions[0].smooth(values)
    at_rail = np.any(list(rails.values()), axis=0)
    reached = np.convolve(at_rail, np.ones(2 * len(motions[0].window) + 1), "same") > 0.5
    between, inside = np.zeros(len(values), bool), np.zeros(len(values), bool)
    between[motions[0].inner], inside[motions[0].inner] = True, True
    between &= ~reached
    if between.sum() < 10 * design.shape[1]:
        return None
    found, rest = least_squares(design[between], target[between])
    left = float(np.std(rest))
    if left > np.sqrt(1.0 - _EXPLAINED) * float(np.std(target[between])):
        return None
    asked, farthest = design @ found, [0.0]
    for rail, here in rails.items():
        outwards = float(np.sign(rail - np.mean(values)))
        excess = outwards * (asked[here & inside] - rail)
        if len(excess) and np.mean(excess) > _BEYOND * left:
            farthest.append(rail + outwards * float(excess.max()))
    return max(farthest, key=abs)
