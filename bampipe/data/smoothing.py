"""A motion and what goes with it, smoothed alike, for regressions on logs as they come."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array

_SMOOTHED_S = 0.06
"""Length of the window over which motion and input are smoothed before they are compared, s."""


@dataclass(frozen=True)
class SmoothedMotion:
    """The motion of one axis.

    What one filter takes off the motion, `smooth` takes off what is compared with it.

    Attributes:
        window: (W,) weights; inner: samples that its ends do not reach.
        moving: (T, 3) acceleration, velocity and its sign; position: (T,).
    """

    window: Array
    inner: slice
    moving: Array
    position: Array

    @classmethod
    def of(cls, t: Array, q: Array) -> SmoothedMotion | None:
        """Smooth a position ``q`` (T,) at ``t`` (T,), s; None where it is too short."""
        step = float(np.median(np.diff(t)))
        width = max(5, round(_SMOOTHED_S / step) | 1)
        if len(t) < 4 * width + 20:
            return None
        window = np.hanning(width + 2)[1:-1]
        window = window / window.sum()
        once = _convolve(q, window)
        qd = np.gradient(once, step)
        sides = [np.gradient(qd, step), qd, np.sign(qd), once]
        *moving, position = (_convolve(values, window) for values in sides)
        inner = slice(2 * width, -2 * width or None)
        return cls(window, inner, np.column_stack(moving), position)

    def smooth(self, values: Array) -> Array:
        """``values`` (T,) smoothed as often as the motion."""
        return _convolve(_convolve(values, self.window), self.window)


def _convolve(values: Array, window: Array) -> Array:
    from scipy.signal import oaconvolve  # it takes half of the time in which ingest starts

    return np.asarray(oaconvolve(values, window, "same"))
