"""Influence of each stretch of time on the parameters of a least-squares fit."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array, Indices

_SD_OF_MEDIAN = 1.4826
"""Standard deviation of a Gaussian divided by its median absolute value."""


@dataclass(frozen=True)
class RemovedStretch:
    """A stretch of a trial, and the change of the fit without it.

    Attributes:
        trial: its number among those fitted; start_s: since the start of the trial, s.
        move: (n,) change of the parameters without it, in the standard deviations that the
            remaining data give.
        typical: (n,) median change by stretches with as much information.
    """

    trial: int
    start_s: float
    move: Array
    typical: Array


def find_worst_stretch(
    rows: Iterable[tuple[Array, Array]],
    stretches: Sequence[Indices],
    places: Mapping[int, tuple[int, float]],
    sd: Array,
) -> RemovedStretch:
    """Return the stretch without which some parameter would move most.

    To first order, the change is the inverse of the total information times the score of the
    stretch (Cook 1977). A stretch that dominates the sandwich covariance would hide in it, since it
    moves a parameter by at most one of its standard deviations. Its own contribution is therefore
    subtracted, down to the scatter of typical stretches.

    Args:
        rows: by axis, the change of the parameters by each weighted sample, (n, k), and its
            weighted residual, (n,); stretches: by axis, (n,) the stretch of each sample.
        places: trial and start, s, of each stretch; sd: (k,) of the parameters.
    """
    count = 1 + max(places)
    parts, shares = np.zeros((2, count, sd.size))
    for (move, left), number in zip(rows, stretches, strict=True):
        np.add.at(parts, number, move * left[:, None])
        np.add.at(shares, number, move**2)
    # Scale the effect of white noise on each stretch to the typical scatter.
    with np.errstate(divide="ignore", invalid="ignore"):
        moves = np.nan_to_num(parts / sd, posinf=0.0, neginf=0.0)
        expected = np.nan_to_num(np.sqrt(shares) / sd, posinf=0.0)
        size = np.where(expected > 0.0, np.abs(moves) / expected, np.nan)
        known = np.isfinite(size).any(axis=0)
        typical = np.zeros_like(expected)
        typical[:, known] = (
            _SD_OF_MEDIAN * np.nanmedian(size[:, known], axis=0) * expected[:, known]
        )
        rest = np.sqrt(np.maximum(1.0 - moves**2, np.minimum(np.sum(typical**2, axis=0), 1.0)))
        moves, typical = (np.nan_to_num(each / rest, posinf=0.0) for each in (moves, typical))
    worst = int(np.argmax(np.abs(moves).max(axis=1)))
    return RemovedStretch(*places.get(worst, (0, 0.0)), moves[worst], typical[worst])
