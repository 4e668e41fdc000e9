"""A motion smoothed for regressions, and what of a drive follows the angle of its axis."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import fdtrc

from bampipe.arrays import Array

_SMOOTHED_S = 0.06
"""Length of the window over which motion and input are smoothed before they are compared, s."""
MOST_ROWS = 20_000
"""Most rows of a log that guesses take."""
Reading = Literal["gravity", "either", "both", "spring", "nothing"]

_LEFT = 0.8
"""Share of the sum of squares, at most, that position must leave of what motion alone leaves. On
joints without weight their friction, as roughly as it is fitted here, left 0.86 and more."""
_CHANCE, _CHANCE_OF_TWO = 1e-4, 1e-3
"""Probability below which position shows at all; and sine beside line, or line beside sine."""
_PLAINLY = 0.9
"""Share of what sine and cosine leave that a line may leave at most, to be a spring beside them or
in their place: friction that is fitted roughly leaves a little that resembles one."""
_WINDOW = 5.0
"""Correlation is summed up to so many times what it sums up to (Sokal 1997)."""


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
    def of(cls, t: Array, q: Array) -> "SmoothedMotion | None":
        """Smooth a position ``q`` (T,) at ``t`` (T,), s; None if it is too short."""
        step = float(np.median(np.diff(t)))
        width = max(5, round(_SMOOTHED_S / step) | 1)
        if len(t) < 4 * width + 20:
            return None
        window = np.hanning(width + 2)[1:-1]
        window = window / window.sum()
        once = np.convolve(q, window, "same")
        qd = np.gradient(once, step)
        sides = [np.gradient(qd, step), qd, np.sign(qd), once]
        *moving, position = (np.convolve(values, window, "same") for values in sides)
        inner = slice(2 * width, -2 * width or None)
        return cls(window, inner, np.column_stack(moving), position)

    def smooth(self, values: Array) -> Array:
        """``values`` (T,) smoothed as often as the motion."""
        return np.convolve(np.convolve(values, self.window, "same"), self.window, "same")


@dataclass(frozen=True)
class AngleTorque:
    """What least squares find over the angle of an axis.

    Attributes:
        reading: ``gravity``: a sine, to which a straight line adds nothing; ``spring``: the other
            way round; ``both``: each adds to the other, as of a link with a cable or a ripple;
            ``either``: over so short a travel they look alike; ``nothing``: too little shows.
        moments: what multiplies the sine and the cosine of the angle.
        beside: what then multiplies acceleration, velocity and its sign, (3,).
    """

    reading: Reading
    moments: tuple[float, float]
    beside: np.ndarray

    @property
    def is_gravity(self) -> bool:
        """Whether weight is what shows, or what a joint has rather than a spring."""
        return self.reading in ("gravity", "either", "both")


def angle_torque(moving: np.ndarray, angle: np.ndarray, drive: np.ndarray) -> AngleTorque:
    """Regress a drive (T,) on its motion with sine and cosine of the angle, with it, with both.

    ``moving``: acceleration, velocity, its sign and 1, (T, 4); ``angle``: (T,) rad.
    """
    line, wave = angle[:, None], np.column_stack([np.sin(angle), np.cos(angle)])
    swinging, resting = np.column_stack([moving, wave]), np.column_stack([moving, line])
    whole = np.column_stack([swinging, line])
    found, of_wave = least_squares(swinging, drive)
    _, alone = least_squares(moving, drive)
    _, of_line = least_squares(resting, drive)
    _, of_both = least_squares(whole, drive)
    beside, moments = found[:3], (float(found[4]), float(found[5]))

    shown = any(
        after @ after < _LEFT * (alone @ alone) and _chance(alone, after, 4 + more, more) < _CHANCE
        for after, more in ((of_wave, 2), (of_line, 1), (of_both, 3))
    )
    if not shown:
        return AngleTorque("nothing", moments, beside)
    wave_adds = _chance(of_line, of_both, 7, 2) < _CHANCE_OF_TWO
    line_adds = (
        of_both @ of_both < _PLAINLY * (of_wave @ of_wave)
        and _chance(of_wave, of_both, 7, 1) < _CHANCE_OF_TWO
    )
    reading: Reading = "either"
    if wave_adds:
        reading = "both" if line_adds else "gravity"
    elif line_adds and of_line @ of_line < _PLAINLY * (of_wave @ of_wave):
        reading = "spring"
    return AngleTorque(reading, moments, beside)


def least_squares(design: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (P,) and residual (T,) of a regression; columns of any size."""
    size = np.maximum(np.linalg.norm(design, axis=0), np.finfo(float).tiny)
    found = np.linalg.lstsq(design / size, target, rcond=None)[0] / size
    return found, target - design @ found


def _chance(before: np.ndarray, after: np.ndarray, columns: int, more: int) -> float:
    """Probability (F test) that ``more`` columns, which mean nothing, leave as little as they do.

    ``before`` and ``after``: residuals (T,) without and with them; ``columns``: of both together.
    """
    left = float(after @ after)
    if left <= 0.0:
        return 0.0
    freedom = max(len(after) / correlated(after) - columns, 1.0)
    f = (float(before @ before) / left - 1.0) * freedom / more
    return float(fdtrc(more, freedom, f))


def correlated(rest: np.ndarray) -> float:
    """Samples of a residual (T,) that say as much as one: neighbours err alike."""
    n = len(rest)
    power = np.abs(np.fft.rfft(rest - rest.mean(), 2 * n)) ** 2
    covariance = np.fft.irfft(power)[:n]
    if covariance[0] <= 0.0:
        return 1.0
    total = 2.0 * np.cumsum(covariance / covariance[0]) - 1.0
    within = np.flatnonzero(np.arange(n) >= _WINDOW * total)
    return max(1.0, float(total[within[0]] if len(within) else total[-1]))
