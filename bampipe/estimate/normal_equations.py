"""Linear least squares from sums of products by trial and axis.

A residual r + X b, linear in b, enters through X'X, X'r and r'r of every trial and axis. Any subset
of trials, with any weights of the axes and any bounds, is then solved without access to a sample.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from bampipe.arrays import Array, Flags
from bampipe.estimate.bounded import solve_bounded


@dataclass(frozen=True)
class NormalEquations:
    """Sums of products by trial and axis.

    Attributes:
        xx: X'X, (K, n_q, P, P).
        xy: -X'r, (K, n_q, P).
        yy: r'r, (K, n_q).
        count: number of samples summed, (K, n_q).
        precision: inverse variances of the priors, (P,); zero without a prior. known: their means,
            (P,), relative to the point at which the residual was linearised.
    """

    xx: Array
    xy: Array
    yy: Array
    count: Array
    precision: Array
    known: Array

    @classmethod
    def from_samples(
        cls,
        slopes: Sequence[Array],
        residuals: Sequence[Array],
        used: Sequence[Flags],
        precision: Array,
        known: Array,
    ) -> Self:
        """Sum over the samples of each trial.

        Args:
            slopes: X by trial, each (T, n_q, P), zero where a sample is not used.
            residuals: r by trial, each (T, n_q), zero where a sample is not used.
            used: which samples count, by trial, each (T, n_q).
            precision, known: of the first coefficients, (<= P,); the others have no prior.
        """
        xx, xy, yy = [], [], []
        for slope, residual in zip(slopes, residuals, strict=True):
            by_axis = np.ascontiguousarray(slope.transpose(1, 0, 2))
            right = np.ascontiguousarray(residual.T)
            xx.append(by_axis.transpose(0, 2, 1) @ by_axis)
            xy.append(-np.einsum("atp,at->ap", by_axis, right))
            yy.append(np.sum(right**2, axis=1))
        count = np.array([np.sum(u, axis=0, dtype=float) for u in used])
        free = np.zeros(slopes[0].shape[2] - precision.size)
        prior = [np.append(part, free) for part in (precision, known)]
        return cls(np.array(xx), np.array(xy), np.array(yy), count, *prior)

    def subset(self, trials: Sequence[int]) -> Self:
        """The sums of some trials."""
        chosen = list(trials)
        parts = {name: getattr(self, name)[chosen] for name in ("xx", "xy", "yy", "count")}
        return replace(self, **parts)

    def solve(self, weight: Array, lower: Array, upper: Array) -> Array:
        """Weighted least squares over all trials within bounds, (P,); see `solve_bounded`.

        Args:
            weight: weight of the squares of each axis, (n_q,).
            lower, upper: (P,); equal for a fixed coefficient.
        """
        normal = np.tensordot(weight, self.xx.sum(axis=0), 1) + np.diag(self.precision)
        moment = weight @ self.xy.sum(axis=0) + self.precision * self.known
        return solve_bounded(normal, moment, lower, upper)

    def mean_square(self, values: Array) -> Array:
        """Mean squared residual over all trials with coefficients ``values`` (P,), (n_q,).

        It is at least the rounding error, since it is a difference of large sums.
        """
        left = self.yy - 2.0 * self.xy @ values + (self.xx @ values) @ values
        least = np.finfo(float).eps * self.yy
        count = np.maximum(self.count.sum(axis=0), 1.0)
        return np.asarray(np.maximum(left, least).sum(axis=0) / count)
