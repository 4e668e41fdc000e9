"""White noise and counting steps of a record whose signal is otherwise smooth.

A difference of order k of white noise of standard deviation s has standard deviation
s sqrt(binomial(2k, k)), while that of a smooth signal falls with every order. The least over
several orders therefore bounds the noise from above, and is the noise wherever the signal is smooth
over a few samples.
"""

from __future__ import annotations

from math import comb

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ORDERS = (2, 3, 4, 5, 6)
_SLOWEST_HZ, _COLOURED = 100.0, 2.0
"""A sensor's own low-pass keeps noise out of neighbouring samples that acts at the frequencies of
the motion all the same. Thinned to this rate, a record shows that noise; but its signal is less
smooth, so that the result counts from this factor on only."""
_NORMAL_MEDIAN = 0.6744897501960817
_FEWEST = 200
"""Samples below which noise is not measured."""


def white_noise_sd(record: Array, rate_hz: float = 0.0) -> float:
    """Standard deviation of the white noise on a record (T,) of a signal that is otherwise smooth.

    From the median absolute difference, which resists spikes and steps; NaN for records too short
    to tell.

    Args:
        record: on a uniform grid.
        rate_hz: sampling rate, to look for noise that is not white between neighbouring samples;
            0 to leave that out.
    """
    fine = _difference_noise(record)
    every = int(rate_hz / _SLOWEST_HZ)
    coarse = _difference_noise(record[::every]) if every > 1 else fine
    return coarse if coarse > _COLOURED * fine else fine


def _difference_noise(record: Array) -> float:
    """Least over several orders of the noise that differences of a record show."""
    if record.size < _FEWEST:
        return float("nan")
    found = []
    for order in _ORDERS:
        size = np.abs(np.diff(record, n=order))
        typical = float(np.median(size)) / _NORMAL_MEDIAN
        if typical == 0.0:  # more than half the differences are zero: coarse steps
            typical = float(np.sqrt(np.mean(np.square(size))))
        found.append(typical / np.sqrt(comb(2 * order, order)))
    return float(min(found))


def counting_step(record: Array) -> float:
    """Step of the counts that a record (T,) consists of; 0.0 where its values lie on no grid."""
    steps = np.abs(np.diff(record))
    steps = steps[steps > 1e-12 * max(float(np.ptp(record)), 1e-300)]
    if steps.size < _FEWEST // 4:
        return 0.0
    smallest = float(np.quantile(steps, 0.02))
    for step in (float(steps.min()), smallest):
        multiples = steps / step
        off = np.abs(multiples - np.round(multiples))
        if multiples.max() < 1e4 and np.mean(off < 0.05) > 0.95:
            return float(np.median(steps[np.round(multiples) == 1]))
    return 0.0
