"""The samples of a session that count, and the statistics of replicates at these samples."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array, Indices
from bampipe.trials.kept import KeptItems
from bampipe.trials.linearisation import Linearisation

_SPEEDS = 12
"""Classes of speed in which the variance of replicates is averaged, finer at low speeds."""
BIASES = (1.0, 0.0, 0.0)
"""Expected factors of the common bias, the stopping bias and the bias of a wider sign."""
MOST_BIAS = 1.5
"""Upper bound of these factors."""


@dataclass(frozen=True)
class Samples:
    """The samples of one axis that count, of all trials in order.

    Attributes:
        rows: indices among the thinned samples of all trials, (n,).
        trial: number of each sample's trial; block: number of its block of time; both (n,).
        independent: the equivalent number of independent samples.
    """

    rows: Indices
    trial: Indices
    block: Indices
    independent: float

    def take(self, values: Iterable[Array], axis: int) -> Iterator[Array]:
        """Yield the rows of one axis, (k,) or (k, m), of each trial's values (K, n_q[, m])."""
        end = 0
        for each in values:
            first, end = end, end + len(each)
            rows = self.rows[slice(*np.searchsorted(self.rows, (first, end)))]
            yield each[rows - first, axis]


def lay_out_samples(linearisation: Linearisation, block_s: float) -> tuple[Samples, ...]:
    """Return the samples of each axis that count, divided into blocks of ``block_s`` seconds."""
    band, sizes = linearisation.band, [len(r) for r in linearisation.residual]
    trial = np.repeat(np.arange(len(sizes), dtype=np.int32), sizes)
    seconds = np.concatenate([np.arange(n) * band.step / band.rate_hz for n in sizes])
    within = np.floor(seconds / block_s).astype(np.int64)
    block = np.unique(trial * (within.max() + 1) + within, return_inverse=True)[1].astype(np.int32)
    used = np.concatenate(linearisation.used)
    found = []
    for axis, share in enumerate(band.independent_share):
        rows = np.flatnonzero(used[:, axis])
        found.append(Samples(rows, trial[rows], block[rows], float(share) * rows.size))
    return tuple(found)


def take_samples(values: Iterable[Array], samples: Samples, axis: int) -> Array:
    """Return the rows of one axis, (n,) or (n, m), of the trials' values, each (K, n_q[, m])."""
    return np.concatenate([*samples.take(values, axis)])


@dataclass(frozen=True)
class Noise:
    """Statistics of the residuals of replicates, which lack nothing.

    Attributes:
        bias: mean of the replicates at each sample, by axis, each (n,), N.m or N.
        variance: variance of the replicates around it, averaged by speed, each (n,).
        reversals: stopping bias, of a noise-free replicate whose friction truly stops, and bias of
            friction whose sign is twice as wide, each (n, 2).
        residuals: by axis, each (replicates, n).
        speed: class of speed of each sample, by axis, each (n,).
    """

    bias: Sequence[Array]
    variance: Sequence[Array]
    reversals: Sequence[Array]
    residuals: Sequence[Array]
    speed: Sequence[Indices]

    def biases(self, axis: int) -> Array:
        """The common bias, the stopping bias and that of a wider sign, (n, 3), N.m or N."""
        return np.column_stack([self.bias[axis], self.reversals[axis]])

    def variance_of_bias(self, axis: int, y: Array) -> Array:
        """Variance of the biases in a residual ``y`` (n,) for a relative error of one, (n,).

        Half of it applies at the sample itself, and half is spread over samples of the same speed,
        because no replicate reverses at exactly the right instant.
        """
        b, c, at = self.bias[axis], self.reversals[axis][:, 0], self.speed[axis]
        both = np.column_stack([b, c]) / np.sqrt(self.variance[axis] + 1e-300)[:, None]
        target = y / np.sqrt(self.variance[axis] + 1e-300)
        factor = np.linalg.lstsq(both, target, rcond=1e-6)[0][1] if len(y) else 0.0
        square = b**2 + (np.clip(factor, 0.0, MOST_BIAS) * c) ** 2
        count = np.maximum(np.bincount(at, minlength=_SPEEDS), 1)
        return np.asarray(0.5 * (square + (np.bincount(at, square, minlength=_SPEEDS) / count)[at]))


def describe_noise(
    residuals: Sequence[Array],
    reversals: Sequence[Array],
    linearisation: Linearisation,
    samples: Sequence[Samples],
) -> Noise:
    """Compute the statistics of replicates.

    Args:
        residuals: of the replicates, by trial, each (K, n_q, replicates).
        reversals: of one whose friction truly stops, and of friction whose sign is twice as wide,
            by trial, each (K, n_q, 2).
        linearisation: the model on the measured trials; samples: those of it that count.
    """
    thinned = linearisation.band.thinned_rows
    speeds = [np.abs(m.qd[thinned(len(m.t))]) for m in linearisation.motions]
    by_axis = KeptItems(
        np.ascontiguousarray(take_samples(residuals, here, axis).T)
        for axis, here in enumerate(samples)
    )
    biases, variances, classes = [], [], []
    for axis, (here, left) in enumerate(zip(samples, by_axis, strict=True)):
        around = left.var(axis=0, ddof=1)
        speed = take_samples(speeds, here, axis)
        shares = np.linspace(0.0, 1.0, _SPEEDS + 1)[1:-1] ** 2
        at = np.searchsorted(np.quantile(speed, shares), speed) if speed.size else np.zeros(0, int)
        count = np.maximum(np.bincount(at, minlength=_SPEEDS), 1)
        biases.append(left.mean(axis=0))
        variances.append((np.bincount(at, around, minlength=_SPEEDS) / count)[at])
        classes.append(at.astype(np.int8))
    turns = [take_samples(reversals, here, axis) for axis, here in enumerate(samples)]
    return Noise(KeptItems(biases), KeptItems(variances), KeptItems(turns), by_axis, classes)
