"""Uncertainty of a filter: covariance from its own increments, noise from its likelihood.

A filter's covariance is right only if its noise is white and of the size that it was given. In
information form, the filter shows the contribution of each stretch of time to the estimate. Their
scatter, relative to the expected one, gives the sandwich covariance, which holds for any noise as
long as the stretches are independent of each other.
"""

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

from bampipe.arrays import Array
from bampipe.estimate.unscented import Stored

_BLOCKS = 3
"""Fewest blocks per parameter: the scores of fewer hardly scatter, because they add up to zero."""
_ROUNDS, _STEPS = 2, 12
"""Largest number of passes over all noise levels, and of steps of one level in one pass."""
_SILENT = 1e-20
"""Fraction of the filter's variance below which no block has information on a parameter."""


def sandwich_covariance(
    trials: Sequence[Stored], n_states: int, theta: Array, covariance: Array
) -> tuple[Array, int]:
    """Covariance of the filter's final parameters from the scatter of blocks of time.

    With information matrix ``L = P^-1`` and vector ``e = L theta`` at both ends of a block, the
    block alone contributes ``dL`` and ``de`` and its score at the final estimate is ``de - dL
    theta``. The meat of the sandwich is the sum of their squares. If the result is smaller than the
    filter's standard deviation, the latter is kept, as for a parameter about which no block has
    information.

    Args:
        trials: filtered trials in order, at the ends of blocks, parameters not walking.
        n_states: length of the state in front of the parameters.
        theta, covariance: (nt,) and (nt, nt) before the first of them, on the scale of estimation.

    Returns:
        (nt, nt) covariance, which is the filter's own if there are no more blocks than parameters;
        and the number of blocks.
    """
    information = np.linalg.inv(covariance)
    vector = information @ theta
    gains: list[tuple[Array, Array]] = []
    for trial in trials:
        for row in range(trial.t.size):
            after = np.linalg.inv(trial.covariance[row][n_states:, n_states:])
            end = after @ trial.mean[row][n_states:]
            gains.append((after - information, end - vector))
            information, vector = after, end
    final = trials[-1].mean[-1][n_states:]
    model = trials[-1].covariance[-1][n_states:, n_states:]
    if len(gains) <= final.size:
        return model, len(gains)
    scores = np.array([gain - matrix @ final for matrix, gain in gains])
    meat = scores.T @ scores * (len(gains) / (len(gains) - final.size))
    found = model @ meat @ model
    filter_variance, variance = np.diag(model), np.diag(found)
    silent = variance <= _SILENT * filter_variance
    widen = np.sqrt(np.maximum(filter_variance / np.where(silent, filter_variance, variance), 1.0))
    found = found * np.outer(widen, widen)
    found[silent] = found[:, silent] = 0.0
    found[silent, silent] = filter_variance[silent]
    return np.asarray(found), len(gains)


def choose_block(seconds: Sequence[float], parameters: int, longest_s: float) -> float:
    """Return the shortest block length, s, that gives enough blocks for a sandwich.

    Args:
        seconds: length of each trial; its last block takes the rest.
        parameters: number of estimated parameters. longest_s: the length for long trials.
    """
    return min(longest_s, sum(seconds) / (_BLOCKS * parameters + len(seconds)))


def at_block_ends(trial: Stored, block_s: float) -> Stored:
    """Return the stored distributions of a trial at the ends of blocks of time.

    Args:
        trial: filtered; block_s: shortest length of a block, s; the last one takes the rest.
    """
    t = trial.t
    count = max(1, int((t[-1] - t[0]) / block_s))
    rows = np.append(np.searchsorted(t, t[0] + block_s * np.arange(1, count)), len(t) - 1)
    return Stored(t[rows], trial.mean[rows], trial.covariance[rows])


def climb(
    log_likelihood: Callable[[Array], float], start: Array, step: Array, lower: Array
) -> tuple[Array, float]:
    """Maximise a likelihood over a few noise levels, one at a time, by doubling steps.

    Noise levels matter by their order of magnitude, so a coarse grid is enough: every coordinate
    moves by its step while the likelihood rises, first up, then down. ``log_likelihood``, minus
    infinity where it fails, takes logarithms (k,), as are ``start``, ``step`` and the ``lower``
    bounds. Returns the best logarithms (k,) and the likelihood there.
    """
    likely = cache(lambda *levels: log_likelihood(np.array(levels)))  # passes repeat some points
    best, value = start.copy(), likely(*start)
    for _ in range(_ROUNDS):
        before = value
        for k in range(start.size):
            for sign in (1.0, -1.0):
                first = value
                for _ in range(_STEPS):
                    tried = best.copy()
                    tried[k] = max(tried[k] + sign * step[k], lower[k])
                    candidate = likely(*tried)
                    if not candidate > value:
                        break
                    best, value = tried, candidate
                if value > first:
                    break
        if value == before:
            break
    return best, value
