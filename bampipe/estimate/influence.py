"""How far each stretch of time moves the parameters of a least-squares fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.bounded import invert_scaled
from bampipe.estimate.least_squares import LeastSquares, Problem

Array = NDArray[np.float64]

_SD_OF_MEDIAN = 1.4826
"""Standard deviation over median size, of a Gaussian."""


@dataclass(frozen=True)
class RemovedStretch:
    """A stretch of a trial and what the fit would be without it.

    Attributes:
        trial: its number among those fitted; start_s: since the start of the trial, s.
        move: (n_free,) change of the parameters without it, in the standard deviations that the
            rest leaves them.
        typical: (n_free,) what a stretch changes that tells as much, by the median over all.
    """

    trial: int
    start_s: float
    move: Array
    typical: Array


def find_worst_stretch(
    problem: Problem, found: LeastSquares, length_s: float = 1.0
) -> RemovedStretch:
    """Return the stretch without which some parameter would move most.

    To first order: the inverse of all information times the score of the stretch (Cook 1977). A
    stretch that alone makes the scatter of a sandwich would hide in it, and moves by no more than
    one of its deviations; so its own part is taken off, down to what typical stretches scatter.

    Args:
        problem: as fitted; found: the fit to its trials; length_s: of a stretch, s.
    """
    band = problem.band
    samples = max(1, round(length_s * band.rate_hz / band.step))
    weight = 1.0 / np.maximum(found.residual_sd, 1e-150)
    information = np.diag(problem.precision)
    for stacked in found.measured:
        slope = stacked.slope * weight[None, :, None]
        information += np.einsum("tqi,tqj->ij", slope, slope)
    inverse = invert_scaled(information)
    sd = np.sqrt(np.diag(found.covariance))
    parts: list[Array] = []
    shares: list[Array] = []
    places: list[tuple[int, int]] = []
    for trial, stacked in enumerate(found.measured):
        slope = stacked.slope * weight[None, :, None] @ inverse
        starts = np.arange(0, len(slope), samples)
        part = np.einsum("tqi,tq->ti", slope, stacked.residual * weight)
        parts.append(np.add.reduceat(part, starts, axis=0))
        shares.append(np.add.reduceat(np.sum(slope**2, axis=1), starts, axis=0))
        places += [(trial, int(start)) for start in starts]
    # What white noise of its size would make of each stretch, as the typical one scatters.
    with np.errstate(divide="ignore", invalid="ignore"):
        moves = np.nan_to_num(np.concatenate(parts) / sd, posinf=0.0, neginf=0.0)
        expected = np.nan_to_num(np.sqrt(np.concatenate(shares)) / sd, posinf=0.0)
        size = np.where(expected > 0.0, np.abs(moves) / expected, np.nan)
        typical = _SD_OF_MEDIAN * np.nanmedian(size, axis=0) * expected
        rest = np.sqrt(np.maximum(1.0 - moves**2, np.minimum(np.sum(typical**2, axis=0), 1.0)))
        moves, typical = (np.nan_to_num(each / rest, posinf=0.0) for each in (moves, typical))
    worst = int(np.argmax(np.abs(moves).max(axis=1)))
    trial, start = places[worst]
    start_s = band.margin_s + start * band.step / band.rate_hz
    return RemovedStretch(trial, start_s, moves[worst], typical[worst])
