"""Test of a filter's consistency with its model, by windows of normalised innovations.

Over a window, the normalised innovation squared (NIS) of a consistent filter averages the number of
readings, and with white Gaussian noise its sum follows the chi-squared distribution (Bar-Shalom, Li
and Kirubarajan 2001, section 5.4). Encoder steps are not Gaussian and model errors are not white.
If some windows are known to be good, a gamma distribution with their mean and variance is therefore
used, of which chi-squared is a special case.
"""

import numpy as np
from scipy.special import gammaincinv

from bampipe.arrays import Array, Flags

FEWEST_READINGS = 0.1
"""Smallest fraction of a window in which a reading must be present; slow sensors leave gaps."""

FEWEST_WINDOWS = 10
"""Smallest number of good windows whose scatter is used."""


def find_threshold(probability: float, readings: int, good: Array | None = None) -> float:
    """Return the mean NIS per reading that a consistent window exceeds with ``probability``.

    Args:
        readings: number in a window.
        good: (n,) means over good windows, to which the distribution is fitted, with at least the
            variance of theory at their mean; fewer than `FEWEST_WINDOWS` leave that of theory.
    """
    mean, variance = 1.0, 2.0 / readings
    if good is not None and good.size >= FEWEST_WINDOWS:
        mean = float(np.mean(good))
        variance = max(float(np.var(good, ddof=1)), 2.0 * mean**2 / readings)
    return float(variance / mean * gammaincinv(mean**2 / variance, 1.0 - probability))


def window_means(nis: Array, n_readings: int, samples: int) -> Array:
    """Mean NIS per reading over whole windows of ``samples``, (windows,).

    Args:
        nis: (T,) NaN where no reading was taken; n_readings: per sample.
        samples: length of a window; windows less than half full are left out.
    """
    count = nis.size // samples
    windows = nis[: count * samples].reshape(count, samples)
    full = np.isfinite(windows).sum(axis=1)
    sums = np.sum(windows, axis=1, where=np.isfinite(windows))
    judged = full >= 0.5 * samples
    return np.asarray(sums[judged] / (full[judged] * n_readings))


class WindowTest:
    """Collects innovations into consecutive windows and averages each.

    Attributes:
        ratio: mean NIS per reading over the last complete window; NaN before the first, and
            infinite if a reading was unusable.
        by_reading: (ny,) mean square of each innovation in its own standard deviation, there.
        useless: (ny,) which readings were unusable there: absent, or beyond the range of the
            filter, in all but a tenth of the window.
        windows: number of windows judged.
    """

    def __init__(self, n_readings: int, samples: int) -> None:
        """Start the first window of ``samples`` samples, ``n_readings`` each."""
        self._samples = samples
        self.ratio = np.nan
        self.by_reading = np.full(n_readings, np.nan)
        self.useless = np.zeros(n_readings, dtype=bool)
        self.windows = 0
        self._waiting = np.zeros((0, 1 + 2 * n_readings))

    def take(self, nis: Array, squares: Array, present: Flags) -> list[float]:
        """Add samples; return the mean NIS per reading of each window completed by them.

        Args:
            nis: (T,); squares: (T, ny) squared innovations in their own variance; not finite
                where a reading was missing or unusable.
            present: (T, ny) whether a usable reading was present.
        """
        self._waiting = np.vstack([self._waiting, np.column_stack([nis, squares, present])])
        found, n = [], squares.shape[1]
        while len(self._waiting) >= self._samples:
            window, self._waiting = np.split(self._waiting, [self._samples])
            parts, there = window[:, 1 : 1 + n], window[:, 1 + n :]
            means = window_means(window[:, 0], n, self._samples)
            finite = np.isfinite(parts)
            self.useless = there.mean(axis=0) < FEWEST_READINGS
            if not means.size and not self.useless.any():
                continue
            self.by_reading = np.sum(parts, axis=0, where=finite) / np.maximum(finite.sum(0), 1)
            self.ratio = np.inf if self.useless.any() else float(means[0])
            self.windows += 1
            found.append(self.ratio)
        return found
