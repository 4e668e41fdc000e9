"""The unscented filter for samples as they arrive: the batch filter's numbers, bounded memory."""

from dataclasses import replace

import numpy as np

from bampipe.arrays import Array
from bampipe.estimate.square_root import FilterSettings
from bampipe.estimate.unscented import FilteredTrial, FilterModel, Trial, join_roots, run_kernel


class OnlineFilter:
    """A filter of `unscented` that takes samples as they arrive.

    For any division into portions, the estimates are those of `filter_trials` on all samples,
    because the same compiled function propagates mean and root. Inputs are linear between samples,
    since their curvature would require later samples.

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
        self._model, self._settings = model, settings
        self._root = join_roots(x_sd, covariance)
        self._last: tuple[float, Array] | None = None
        self.mean = np.concatenate([x, np.clip(theta, *model.range)])

    @property
    def covariance(self) -> Array:
        """(n, n) covariance of `mean`."""
        return np.asarray(self._root @ self._root.T)

    def advance(self, t: Array, u: Array, y: Array) -> FilteredTrial:
        """Take samples; the first one of all only sets the time.

        Times ``t`` (T,), s, increase; inputs are (T, nu), readings (T, ny), NaN where missing.
        Returns the innovations of these samples, and the distribution at the first one.

        Raises:
            FilterFailure: the filter lost the motion; `mean` is then meaningless.
        """
        ny = y.shape[1]
        if self._last is not None:
            t = np.concatenate([[self._last[0]], t])
            u = np.vstack([self._last[1], u])
            y = np.vstack([np.full(ny, np.nan), y])
        samples = Trial(t, u, y, np.zeros(0), np.zeros(0))
        settings = self._settings._replace(stride=t.size)
        found = run_kernel(self._model, settings, samples, self.mean, self._root)
        own = slice(0 if self._last is None else 1, None)
        self._last = (float(t[-1]), np.array(u[-1]))
        by_sample = ("innovation", "innovation_sd", "nis", "log_likelihood")
        return replace(found, **{name: getattr(found, name)[own] for name in by_sample})
