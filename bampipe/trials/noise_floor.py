"""The noise floor: the error of a model that is the whole truth, by replays of enough trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array
from bampipe.trials.motion import Motion, trial_sizes

ENOUGH_SAMPLES = 250_000
"""Samples up to which all trials are taken: the noise floor of so many is known to about 1 %."""
LEAST_DRAWN = 50
"""Fewest trials that stand for all of a long session: the errors of trials differ by a third."""
_SEED = 0
_SD_OF_DEVIATION = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
FEWEST_REPLAYS, MOST_REPLAYS = 3, 6
"""Replays are repeated until they hold `ENOUGH_SAMPLES`, within these."""


@dataclass(frozen=True)
class NoiseFloor:
    """Error of replays.

    Attributes:
        level: median over replays, by axis, (n_q,), N.m or N.
        sd: scatter of one replay, from the median deviation.
        replays: how many.
    """

    level: Array
    sd: Array
    replays: int

    @classmethod
    def of_errors(cls, errors: Sequence[Array]) -> NoiseFloor:
        """Median and scatter of the errors (n_q,) of replays."""
        found = np.array(errors)
        level = np.median(found, axis=0)
        return cls(level, _SD_OF_DEVIATION * np.median(np.abs(found - level), axis=0), len(found))


def floor_replays(motions: Sequence[Motion]) -> int:
    """How many replays of these trials give the floor."""
    total = sum(trial_sizes(motions))
    return int(np.clip(-(-ENOUGH_SAMPLES // max(total, 1)), FEWEST_REPLAYS, MOST_REPLAYS))


def draw_trials(sizes: Sequence[int]) -> list[int]:
    """Numbers of the trials that stand for all of a long session, in order.

    They hold `ENOUGH_SAMPLES`, and are `LEAST_DRAWN` or more; ``sizes`` are in samples.
    """
    total = sum(sizes)
    if total <= ENOUGH_SAMPLES:
        return list(range(len(sizes)))
    count = -(-len(sizes) * ENOUGH_SAMPLES // total)
    drawn = np.random.default_rng(_SEED).permutation(len(sizes))[: max(count, LEAST_DRAWN)]
    return sorted(int(number) for number in drawn)
