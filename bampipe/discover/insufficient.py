"""Rivals that leave an error where the effect found leaves no more than the sensors do.

Where no replay looks like the measurement, patterns of scores say little of which effect is right.
How much a model leaves still does: one that is as good as its sensors explains the trials, and one
that errs more lacks something else.
"""

from __future__ import annotations

from collections.abc import Collection

from bampipe.discover.bench import Bench
from bampipe.discover.influence import error_without_second
from bampipe.discover.polish import FittedSet, extend_set, reduce_set
from bampipe.results.standing import AT_FLOOR, standing
from bampipe.trials.noise_floor import NoiseFloor


def insufficient_rivals(
    bench: Bench,
    found: FittedSet,
    name: str,
    axis: int,
    rivals: Collection[str],
    floor: NoiseFloor,
) -> frozenset[str]:
    """Those of ``rivals`` that leave an axis above its floor, fitted in full in place of an effect.

    Without the worst second of each, as a verdict judges. None where the effect itself leaves more
    than the floor: then all of them lack something.

    Args:
        bench: the session.
        found: the set with the effect, fitted; name: the effect; axis: on which they are compared.
        rivals: effects that might be there in its place.
        floor: of the set.
    """
    level, scatter = float(floor.level[axis]), float(floor.sd[axis])

    def is_above(error: float) -> bool:
        return standing(error, level, scatter) == "above_floor"

    mine = error_without_second(found.evidence, axis)[1]
    if not rivals or is_above(mine):
        return frozenset()
    fewer = reduce_set(found, name)
    scores = bench.scores(fewer.recipe, fewer.evidence.p, list(rivals))
    behind = set()
    for rival, score in scores.items():
        other = extend_set(fewer, score)
        # What makes both sides of the equation small must not look like a small error.
        scale = float(found.slope_by_force[axis] / other.slope_by_force[axis])
        error = scale * error_without_second(other.evidence, axis)[1]
        # No replay is perfect: an error at its floor may differ from another one there by so much.
        if is_above(error) and error > AT_FLOOR * mine:
            behind.add(rival)
    return frozenset(behind)
