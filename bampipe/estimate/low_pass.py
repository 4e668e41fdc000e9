"""Zero-phase low-pass of many columns, evaluated at few samples: the inner loop of comparisons."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import float64, int64
from scipy.signal import butter, sosfilt_zi

from bampipe.arrays import Array, Indices
from bampipe.compiled import njit

_V = float64[::1]
_M = float64[:, ::1]


_TOGETHER = 4
"""Columns that go through the filter at once: each waits for its own last sample, so that several
side by side take hardly longer than one."""


@njit(_M(_M, _V, _V, int64[::1]))
def _run(values, section, start, kept):  # type: ignore[no-untyped-def]
    count, columns = values.shape
    y, out = np.zeros((count, _TOGETHER)), np.empty((len(kept), columns))
    b0, b1, b2, a1, a2 = section[0], section[1], section[2], section[4], section[5]
    s0, s1 = np.empty(_TOGETHER), np.empty(_TOGETHER)
    for first in range(0, columns, _TOGETHER):
        width = min(_TOGETHER, columns - first)
        for i in range(count):
            for j in range(width):
                y[i, j] = values[i, first + j]
        for last, step in ((count - 1, 1), (0, -1)):
            first_row = count - 1 - last
            for j in range(_TOGETHER):
                s0[j], s1[j] = start[0] * y[first_row, j], start[1] * y[first_row, j]
            for i in range(first_row, last + step, step):
                for j in range(_TOGETHER):
                    x = y[i, j]
                    v = b0 * x + s0[j]
                    s0[j] = b1 * x - a1 * v + s1[j]
                    s1[j] = b2 * x - a2 * v
                    y[i, j] = v
        for i in range(len(kept)):
            for j in range(width):
                out[i, first + j] = y[kept[i], j]
    return out


@lru_cache(maxsize=64)
def _design(cutoff_hz: float, rate_hz: float) -> tuple[Array, Array]:
    section = np.asarray(butter(2, cutoff_hz, fs=rate_hz, output="sos"))
    return section[0].copy(), np.asarray(sosfilt_zi(section))[0].copy()


def low_pass_at(values: Array, cutoff_hz: float, rate_hz: float, kept: Indices) -> Array:
    """Low-pass columns (T, k) forwards and backwards; return the rows ``kept``, (K, k).

    It is a second-order Butterworth filter in each direction, with ``cutoff_hz`` the half-power
    frequency of one pass, started in the steady state of the first (last) sample. The caller keeps
    no samples near the ends, which contain the transient.

    Raises:
        ValueError: the cut-off is not between 0 and half the sampling rate.
    """
    section, start = _design(cutoff_hz, rate_hz)
    return np.asarray(_run(np.ascontiguousarray(values), section, start, kept))


@dataclass(frozen=True)
class Band:
    """The low-pass that residuals go through, axis by axis.

    Attributes:
        rate_hz: sampling rate of what comes in.
        cutoff_hz: half-power frequency of each of the two passes, by axis, (n_q,), Hz; a fifth of
            the sampling rate where that is lower.
        margin_s: left out at both ends of a trial, where the filter lacks past or future.
    """

    rate_hz: float
    cutoff_hz: tuple[float, ...]
    margin_s: float = 0.2

    def __post_init__(self) -> None:
        most = 0.2 * self.rate_hz
        object.__setattr__(self, "cutoff_hz", tuple(min(float(f), most) for f in self.cutoff_hz))

    @property
    def step(self) -> int:
        """Samples from one thinned value to the next: five a period of the highest cut-off."""
        return max(1, int(self.rate_hz / (5.0 * max(self.cutoff_hz))))

    @property
    def independent_share(self) -> Array:
        """Share of the thinned samples that are independent, by axis, (n_q,).

        A low-pass leaves two independent samples a period of its cut-off.
        """
        spacing = self.step * 2.0 * np.array(self.cutoff_hz) / self.rate_hz
        return np.minimum(1.0, spacing)

    def passed_power(self, count: int) -> Array:
        """Return the transmitted share of the power at ``count`` frequencies, (count, n_q).

        They are evenly spaced below half the rate of the thinned samples.
        """
        at = np.tan(0.5 * np.pi / self.step * (np.arange(count) + 0.5) / count)[:, None]
        edge = np.tan(np.pi * np.array(self.cutoff_hz) / self.rate_hz)
        return np.asarray((1.0 + (at / edge) ** 4) ** -2.0)

    def thinned_rows(self, count: int) -> Indices:
        """Indices of the samples that thinning keeps of ``count``."""
        margin = int(self.margin_s * self.rate_hz)
        return np.arange(margin, count - margin, self.step, dtype=np.int64)

    def thin(self, values: Array, axes: Sequence[int] | Indices | None = None) -> Array:
        """Low-pass (T, k) without phase and keep the rows `kept`.

        Args:
            values: on a uniform grid.
            axes: the axis whose cut-off each column has, (k,); by default column i has that of
                axis i modulo n_q.
        """
        kept, cutoffs = self.thinned_rows(len(values)), np.array(self.cutoff_hz)
        which = np.arange(values.shape[1]) % cutoffs.size if axes is None else np.asarray(axes)
        by_column = cutoffs[which]
        distinct = np.unique(by_column)
        if distinct.size == 1:
            return low_pass_at(values, float(distinct[0]), self.rate_hz, kept)
        out = np.empty((len(kept), values.shape[1]))
        for cutoff in distinct:
            chosen = by_column == cutoff
            out[:, chosen] = low_pass_at(values[:, chosen], float(cutoff), self.rate_hz, kept)
        return out

    def thin_trials(self, trials: Iterable[Array], axes: Sequence[int]) -> list[Array]:
        """Apply `thin` to the same columns, each (T, k), of several trials."""
        return [self.thin(values, axes) for values in trials]

    def thin_input(self, values: Array) -> Array:
        """Apply `thin` with the highest cut-off to columns (T, k) that belong to no axis."""
        widest = int(np.argmax(self.cutoff_hz))
        return self.thin(values, [widest] * values.shape[1])
