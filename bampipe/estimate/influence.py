"""How far each stretch of time moves the parameters of a least-squares fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.least_squares import LeastSquares, Problem

Array = NDArray[np.float64]

_SD_OF_MEDIAN = 1.4826
"""Standard deviation over median size, of a Gaussian."""


@dataclass(frozen=True)
class RemovedStretch:
    """A stretch of a trial and what the fit would be without it.

    Attributes:
        trial: its number among those fitted; start_s: since the start of the trial, s.
        move: (n_free,) change of the parameters without it, in their standard deviations.
        typical: (n_free,) scatter of that over all stretches, by its median.
    """

    trial: int
    start_s: float
    move: Array
    typical: Array


def find_worst_stretch(
    problem: Problem, found: LeastSquares, length_s: float = 1.0
) -> RemovedStretch:
    """Return the stretch without which some parameter would move most.

    To first order: the inverse of all information times the score of the stretch (Cook 1977).

    Args:
        problem: as fitted; found: the fit to its trials; length_s: of a stretch, s.
    """
    band = problem.band
    samples = max(1, round(length_s * band.rate_hz / band.step))
    weight = 1.0 / np.maximum(found.residual_sd, 1e-150)
    information = np.diag(problem.precision)
    scores: list[Array] = []
    places: list[tuple[int, int]] = []
    for trial, stacked in enumerate(found.stacked):
        slope = stacked.slope * weight[None, :, None]
        information += np.einsum("tqi,tqj->ij", slope, slope)
        score = np.einsum("tqi,tq->ti", slope, stacked.residual * weight)
        starts = np.arange(0, len(score), samples)
        scores.append(np.add.reduceat(score, starts, axis=0))
        places += [(trial, int(start)) for start in starts]
    sd = np.sqrt(np.diag(found.covariance))
    inverse = np.linalg.pinv(information, hermitian=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        moves = np.nan_to_num(np.concatenate(scores) @ inverse / sd, posinf=0.0, neginf=0.0)
    worst = int(np.argmax(np.abs(moves).max(axis=1)))
    trial, start = places[worst]
    return RemovedStretch(
        trial,
        band.margin_s + start * band.step / band.rate_hz,
        moves[worst],
        _SD_OF_MEDIAN * np.median(np.abs(moves), axis=0),
    )
