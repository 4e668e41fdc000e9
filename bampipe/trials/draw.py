"""A part of a long session that stands for all of it, where all would say no more."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

ENOUGH_SAMPLES = 250_000
"""Samples up to which all trials are taken: the noise floor of so many is known to about 1 %."""
LEAST_DRAWN = 50
"""Fewest trials that stand for all of a long session: the errors of trials differ by a third."""
_SEED = 0


def draw_trials(sizes: Sequence[int]) -> list[int]:
    """Numbers of the trials that stand for all, in order.

    Of a longer session than `ENOUGH_SAMPLES`, so many samples, in `LEAST_DRAWN` trials or more
    drawn from all.

    Args:
        sizes: of the trials, in samples.
    """
    total = sum(sizes)
    if total <= ENOUGH_SAMPLES:
        return list(range(len(sizes)))
    count = -(-len(sizes) * ENOUGH_SAMPLES // total)
    drawn = np.random.default_rng(_SEED).permutation(len(sizes))[: max(count, LEAST_DRAWN)]
    return sorted(int(number) for number in drawn)
