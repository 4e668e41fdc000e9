"""The unscented filter fed sample by sample: the batch filter's numbers, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.unscented import FilterModel, FilterSettings, Trial, lower_root, run_kernel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Innovations:
    """What the filter expected of some samples and what came.

    Attributes:
        innovation: (T, ny) reading minus prediction, NaN where a reading is missing.
        innovation_sd: (T, ny); nis: (T,) squared innovation in its own covariance.
    """

    innovation: Array
    innovation_sd: Array
    nis: Array


class OnlineFilter:
    """A filter of `unscented` that takes samples as they come.

    However they are cut into portions, the estimates are those of `filter_trials` on all of them:
    the same compiled function carries mean and root on. Inputs run straight between samples, for
    how they curve takes samples to come.

    Attributes:
        mean: (n,) state and parameters on the scale of estimation.
    """

    def __init__(
        self,
        model: FilterModel,
        settings: FilterSettings,
        x: Array,
        x_sd: Array,
        theta: Array,
        covariance: Array,
    ) -> None:
        """Start before the first sample.

        Args:
            model: the compiled model; settings: noise and numerical settings, its stride unused.
            x, x_sd: (nx,) state at the first sample and its standard deviation.
            theta, covariance: (nt,) and (nt, nt) parameters, on the scale of estimation.
        """
        nx = model.n_states
        lower, upper = model.range
        joint = np.zeros((x.size + theta.size, x.size + theta.size))
        joint[:nx, :nx] = np.diag(np.square(x_sd))
        joint[nx:, nx:] = covariance
        self._model, self._settings = model, settings
        self._root = lower_root(joint)
        self._last: tuple[float, Array] | None = None
        self.mean = np.concatenate([x, np.clip(theta, lower, upper)])

    @property
    def covariance(self) -> Array:
        """(n, n) covariance of `mean`."""
        return np.asarray(self._root @ self._root.T)

    def advance(self, t: Array, u: Array, y: Array) -> Innovations:
        """Take samples; the very first one only starts the clock.

        Args:
            t: (T,) s, increasing; u: (T, nu) inputs; y: (T, ny) readings, NaN where missing.

        Raises:
            FilterFailure: the filter lost the motion; `mean` is then of no use.
        """
        ny = y.shape[1]
        if self._last is not None:
            t = np.concatenate([[self._last[0]], t])
            u = np.vstack([self._last[1], u])
            y = np.vstack([np.full(ny, np.nan), y])
        samples = Trial(t, u, y, np.zeros(0), np.zeros(0))
        found = run_kernel(
            self._model, self._settings, samples, self.mean, self._root, stride=t.size
        )
        skipped = 0 if self._last is None else 1
        self._last = (float(t[-1]), np.array(u[-1]))
        return Innovations(
            found.innovation[skipped:], found.innovation_sd[skipped:], found.nis[skipped:]
        )
