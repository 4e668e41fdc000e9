"""Savitzky-Golay: a polynomial fitted by least squares to a sliding window."""

from functools import partial

import numpy as np
from scipy.signal import savgol_filter

from bampipe.arrays import Array
from bampipe.estimate.differentiation import Derivatives, differentiate_linearly

_DEGREE = 4


def window_length(cutoff_hz: float, rate_hz: float) -> int:
    """Return the odd window, samples, whose half-power frequency is nearest ``cutoff_hz``.

    Schafer 2011, eq. 12: with M = (window - 1)/2 the half-power frequency in units of half the
    sampling rate is (degree + 1) / (3.2 M - 4.6).
    """
    half = ((_DEGREE + 1) * 0.5 * rate_hz / cutoff_hz + 4.6) / 3.2
    return 2 * max(round(half), _DEGREE // 2 + 1) + 1


def polynomial(values: Array, rate_hz: float, window: int) -> tuple[Array, Array, Array]:
    """Return the fitted value and its two derivatives at every sample of ``values``, each (T,).

    Within half a window of either end the polynomial of the outermost window is used.

    Raises:
        ValueError: the window is longer than the record.
    """
    if not _DEGREE < window <= len(values):
        raise ValueError(f"a window of {window} samples does not fit {len(values)} samples")
    position, velocity, acceleration = (
        np.asarray(
            savgol_filter(values, window, _DEGREE, deriv=k, delta=1.0 / rate_hz, mode="interp"),
            dtype=np.float64,
        )
        for k in range(3)
    )
    return position, velocity, acceleration


def smooth_mean(signal: Array, rate_hz: float, cutoff_hz: float) -> tuple[Array, Array, Array]:
    """Return what :func:`smooth` does, without the error bands, which take most of its time."""
    return polynomial(signal, rate_hz, _window(signal, rate_hz, cutoff_hz))


def smooth(position: Array, rate_hz: float, cutoff_hz: float, noise_sd: float) -> Derivatives:
    """`polynomial` by `differentiate_linearly`."""
    window = _window(position, rate_hz, cutoff_hz)
    method = partial(polynomial, rate_hz=rate_hz, window=window)
    return differentiate_linearly(method, position, window // 2, noise_sd)


def _window(signal: Array, rate_hz: float, cutoff_hz: float) -> int:
    longest = len(signal) - (len(signal) + 1) % 2
    return min(window_length(cutoff_hz, rate_hz), longest)
