"""Zero-phase Butterworth filter and central differences."""

from functools import lru_cache

import numpy as np

from bampipe.arrays import Array
from bampipe.estimate.differentiation import Derivatives, extend
from bampipe.estimate.low_pass import low_pass_at

_REACH = 6
"""Samples on either side from which a derivative of an input is computed."""


def zero_phase(values: Array, rate_hz: float, cutoff_hz: float) -> tuple[Array, Array, Array]:
    """Return ``values`` (T,) low-passed forwards and backwards, and its two derivatives, each (T,).

    The derivatives are central differences of fourth order, which follow the true derivative to
    0.1 % up to 6 % of the sampling rate (the common two-point difference loses 2 % there). At
    ``cutoff_hz``, the half-power frequency of one pass, both passes transmit half of the amplitude.
    """
    x, added = _low_passed(values, rate_hz, cutoff_hz)
    return x[added : added + len(values)], *_differences(x, added, rate_hz, 2)


def rates(values: Array, rate_hz: float, cutoff_hz: float, count: int) -> list[Array]:
    """Return the first ``count`` time derivatives of ``values`` (T,), each (T,), band-limited.

    Each pass of the filter gives two orders, so that higher ones are smoothed more. The central
    differences are of twelfth order and exact to 0.1 % up to a fifth of the sampling rate, the
    highest cut-off of residuals. Those of :func:`zero_phase` lose 7 % there, so that a delay would
    look like a lag.
    """
    found: list[Array] = []
    while len(found) < count:
        x, added = _low_passed(found[-1] if found else values, rate_hz, cutoff_hz)
        found += _differences(x, added, rate_hz, _REACH)
    return found[:count]


def _differences(x: Array, added: int, rate_hz: float, reach: int) -> tuple[Array, Array]:
    """Return two derivatives of ``x`` without the samples ``added`` at its ends, each (T,)."""
    padded, inner = np.pad(x, reach, mode="edge"), slice(added, len(x) - added)
    first, second = (np.convolve(padded, w[::-1], mode="valid") for w in _find_weights(reach))
    return rate_hz * first[inner], rate_hz**2 * second[inner]


@lru_cache
def _find_weights(reach: int) -> tuple[Array, Array]:
    """Weights (2 reach + 1,) of samples in central differences, first and second order.

    They follow from the polynomial through all samples (Fornberg 1988, Mathematics of Computation
    51, 699).
    """
    at = np.arange(-reach, reach + 1)
    inverse = np.linalg.inv(np.vander(at.astype(float), increasing=True))
    return np.asarray(inverse[1]), np.asarray(2.0 * inverse[2])


def _low_passed(values: Array, rate_hz: float, cutoff_hz: float) -> tuple[Array, int]:
    """Extend ``values`` (T,) at both ends and low-pass them; return also the samples added per end.

    Raises:
        ValueError: the cut-off is not between 0 and half the sampling rate.
    """
    if not 0.0 < cutoff_hz < 0.5 * rate_hz:
        raise ValueError(f"cut-off {cutoff_hz:g} Hz is not between 0 and half of {rate_hz:g} Hz")
    reach = int(np.ceil(4.0 * rate_hz / cutoff_hz)) + 2
    longer = extend(values, reach, max(4, int(np.ceil(1.5 * rate_hz / cutoff_hz))))
    added = (len(longer) - len(values)) // 2
    everything = np.arange(len(longer))
    return low_pass_at(longer[:, None], cutoff_hz, rate_hz, everything)[:, 0], added


def smooth(position: Array, rate_hz: float, cutoff_hz: float, noise_sd: float) -> Derivatives:
    """Return the motion behind ``position`` (T,), with error bands for white noise of ``noise_sd``.

    The bands do not cover motion above the cut-off, which is lost.
    """
    length = len(position)
    # Near the ends the noise gain differs from that in the middle.
    edge = min(int(np.ceil(1.5 * rate_hz / cutoff_hz)), (length + 1) // 2)
    window = min(length, 4 * edge + 1)
    squares = sum(np.square(zero_phase(impulse, rate_hz, cutoff_hz)) for impulse in np.eye(window))
    gains, full = np.sqrt(squares), np.empty((3, length))
    full[:] = gains[:, window // 2, None]
    full[:, :edge] = gains[:, :edge]
    full[:, length - edge :] = gains[:, window - edge :]
    return Derivatives(*zero_phase(position, rate_hz, cutoff_hz), *(noise_sd * full))
