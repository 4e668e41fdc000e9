"""The noise floor: the error that a model without any deficiency would have, from replicates."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from bampipe.arrays import Array
from bampipe.trials.motion import Motion, trial_sizes

ENOUGH_SAMPLES = 250_000
"""Sessions up to this size are used whole: they determine the noise floor to about 1 %."""
LEAST_DRAWN = 50
"""Smallest random selection of trials from a long session: errors differ by a third by trial."""
_SEED = 0
_SD_OF_DEVIATION = 1.4826
"""Standard deviation of a normal distribution divided by its median absolute deviation."""
FEWEST_REPLICATES, MOST_REPLICATES = 3, 6
"""Replicates are added until they hold `ENOUGH_SAMPLES`, within these limits."""


@dataclass(frozen=True)
class NoiseFloor:
    """Error of replicates.

    Attributes:
        level: median over replicates, by axis, (n_q,), N.m or N.
        sd: standard deviation of one replicate, from the median absolute deviation, (n_q,).
        replicates: their number.
    """

    level: Array
    sd: Array
    replicates: int

    @classmethod
    def of_errors(cls, errors: Sequence[Array]) -> Self:
        """Median and scatter of the errors (n_q,) of replicates."""
        found = np.array(errors)
        level = np.median(found, axis=0)
        return cls(level, _SD_OF_DEVIATION * np.median(np.abs(found - level), axis=0), len(found))


def count_floor_replicates(motions: Sequence[Motion]) -> int:
    """Number of replicates of these trials that determine the noise floor."""
    total = sum(trial_sizes(motions))
    return int(np.clip(-(-ENOUGH_SAMPLES // max(total, 1)), FEWEST_REPLICATES, MOST_REPLICATES))


def draw_trials(sizes: Sequence[int]) -> list[int]:
    """Select trials that represent a long session, by number, in order.

    They hold about `ENOUGH_SAMPLES` and are at least `LEAST_DRAWN`; ``sizes`` are in samples.
    """
    total = sum(sizes)
    if total <= ENOUGH_SAMPLES:
        return list(range(len(sizes)))
    count = -(-len(sizes) * ENOUGH_SAMPLES // total)
    chosen = np.random.default_rng(_SEED).permutation(len(sizes))[: max(count, LEAST_DRAWN)]
    return sorted(int(number) for number in chosen)
