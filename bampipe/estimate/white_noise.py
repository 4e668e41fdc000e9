"""White noise and counting steps of a record whose signal is otherwise smooth.

A difference of order k, divided by the root of its squared weights, has the standard deviation of
white noise, while that of a smooth signal falls with every order. The smallest over several orders
therefore bounds the noise from above, and equals it if the signal is smooth over a few samples. Hum
is neither: at a low sampling rate no difference removes it, and it has almost no power at the
frequencies of the motion. It is fitted and subtracted first.
"""

import numpy as np

from bampipe.arrays import Array
from bampipe.estimate.spectral_lines import LOWEST_LINE, find_lines

_LOWEST_ORDER, _HIGHEST_ORDER = 2, 6
_SLOWEST_HZ = 100.0
"""A sensor's own low-pass correlates the noise of neighbouring samples, which still acts at the
frequencies of the motion. A record thinned to this rate shows that noise."""
_NORMAL_MEDIAN = 0.6744897501960817
_AGREE = 3.0
"""Two standard errors of the ratio of the noise by two orders, times the root of the samples."""
_CUT = 2.0
"""Multiple of the 90 % quantile of the magnitudes at which larger differences are clipped: 3.3
standard deviations of a normal distribution."""
_FEWEST = 200
"""Smallest number of samples from which noise is measured."""
_STRETCHES, _STRETCH = 8, 2000
"""Number of stretches, and their length, by which a longer record is sampled: enough for 1 %."""
_LAGS = range(-1, 16)
"""Delays, in samples, of a controller behind the readings that it acts on; the log may lead."""
_FEEDBACK_ORDER, _FEEDBACK_ROWS = 3, 16000
_REACHES, _OFF_GRID = (1.5, 10.0, 100.0), 0.05
"""Multiples of a step up to which it is refined, and the tolerance of values on the grid."""


def white_noise_sd(
    record: Array, t: Array | None = None, step: float = 0.0, *, pulsed: bool = False
) -> float:
    """Standard deviation of the white noise in a record (T,) of a signal that is otherwise smooth.

    It comes from the median absolute difference, which is robust against spikes and steps. It is
    NaN for records that are too short.

    Args:
        record: samples.
        t: (T,) their time stamps, s, which need not be uniform; a uniform record needs none.
        step: step of its counts; 0.0 if its values lie on no grid.
        pulsed: whether the noise comes in pulses, such as those of a controller that acts on
            encoder counts. The median misses them, so a clipped mean square is used.
    """
    return _without_dither(_difference_noise(_dithered(record, step), t, pulsed), step)


def slow_noise_sd(record: Array, t: Array, step: float = 0.0) -> float:
    """`white_noise_sd` of a record (T,) at stamps ``t`` (T,), thinned to `_SLOWEST_HZ`.

    It includes noise that a sensor's own low-pass correlates between neighbouring samples, and any
    signal that is not smooth from one kept sample to the next. Sines of the whole record are
    subtracted. It is NaN if the record is too short or no faster than that.
    """
    every = round(1.0 / (_SLOWEST_HZ * float(np.median(np.diff(t))))) if t.size > _FEWEST else 0
    if every < 2:
        return float("nan")
    length = min(record.size, every * _STRETCH // 4)
    record = _dithered(record, step)
    starts = np.linspace(0, record.size - length, min(_STRETCHES // 2, record.size // length))
    found = []
    for start in starts.astype(int):
        part = slice(start, start + length)
        clear = _without_lines(record[part], t[part], LOWEST_LINE / every)
        found.append(_difference_noise(clear[::every], t[part][::every]))
    return _without_dither(float(np.median(found)), step)


def without_feedback(records: Array, readings: Array) -> Array:
    """Return the part of ``records`` (T, n) that does not follow ``readings`` (T, n_q), (T', n).

    A controller derives its force from the readings, rounding included. That force acts on the
    machine, so it is not noise. The part linear in the last readings is found by least squares on
    differences, which keep the rounding and remove the motion. At most 16,000 samples from the
    middle are used.
    """
    first = max(0, (len(records) - _FEEDBACK_ROWS) // 2)
    part = slice(first, first + _FEEDBACK_ROWS)
    records, readings = records[part], readings[part]
    ends = slice(_LAGS.stop, len(records) + _LAGS.start)
    lagged = np.hstack([np.roll(readings - readings[0], lag, axis=0) for lag in _LAGS])[ends]
    rest = records[ends]
    changes, wanted = (np.diff(x, _FEEDBACK_ORDER, axis=0) for x in (lagged, rest))
    sound = np.isfinite(changes).all(axis=1) & np.isfinite(wanted).all(axis=1)
    if np.count_nonzero(sound) < max(_FEWEST, 10 * lagged.shape[1]):
        return rest
    size = np.maximum(np.sqrt(np.mean(changes[sound] ** 2, axis=0)), 1e-300)
    weights = np.linalg.lstsq(changes[sound] / size, wanted[sound], rcond=1e-10)[0]
    return np.asarray(rest - (lagged / size) @ weights)


def _dithered(record: Array, step: float) -> Array:
    """Add uniform dither to a record (T,) of counts, whose median would be a whole count."""
    return record + step * np.random.default_rng(0).uniform(-0.5, 0.5, record.size)


def _without_dither(noise: float, step: float) -> float:
    """Return the noise of a record from that of the dithered one."""
    return float(np.sqrt(np.maximum(noise**2 - step**2 / 12.0, 0.0)))


def _difference_noise(record: Array, t: Array | None, pulsed: bool = False) -> float:
    """Return the smallest noise that differences of several orders of a record show.

    Of orders that agree, it is that of the lowest, whose median scatters least: the smallest of
    several medians of white noise would lie below it.
    """
    if record.size < _FEWEST:
        return float("nan")
    if record.size > _STRETCHES * _STRETCH:
        starts = np.linspace(0, record.size - _STRETCH, _STRETCHES).astype(int)
        parts = (slice(start, start + _STRETCH) for start in starts)
        some = [_difference_noise(record[p], None if t is None else t[p], pulsed) for p in parts]
        return float(np.median(some))
    stamps = np.arange(record.size, dtype=float) if t is None else t / float(np.median(np.diff(t)))
    record = _without_lines(record, stamps, LOWEST_LINE)
    found = []
    # Divided differences remove every polynomial of lower degree, whatever the spacing; each order
    # follows from the one before, and so do its weights of the samples.
    differences, weights = record, np.ones((1, record.size))
    for order in range(1, _HIGHEST_ORDER + 1):
        gap = stamps[order:] - stamps[:-order]
        differences = np.diff(differences) / gap
        nothing = np.zeros((1, gap.size))
        weights = np.vstack([nothing, weights[:, 1:]]) - np.vstack([weights[:, :-1], nothing])
        weights /= gap
        if order < _LOWEST_ORDER:
            continue
        size = np.abs(differences) / np.sqrt(np.sum(weights**2, axis=0))
        typical = float(np.median(size)) / _NORMAL_MEDIAN
        if pulsed:
            most = _CUT * float(np.quantile(size, 0.9))
            typical = float(np.sqrt(np.mean(np.square(np.minimum(size, most)))))
        if typical == 0.0:  # more than half the differences are zero: coarse steps
            typical = float(np.sqrt(np.mean(np.square(size))))
        found.append(typical)
    agreed = (1.0 + _AGREE / np.sqrt(record.size)) * min(found)
    return float(next(noise for noise in found if noise <= agreed))


def _without_lines(record: Array, t: Array, lowest: float) -> Array:
    """Subtract the sines of a record (T,) at stamps ``t`` (T,): see `find_lines`."""
    for line in find_lines(record, t, lowest):
        record = record - line.values
    return record


def counting_step(record: Array) -> float:
    """Return the step of the counts in a record (T,); 0.0 if its values lie on no grid."""
    steps = np.abs(np.diff(record))
    steps = steps[steps > 1e-12 * max(float(np.ptp(record)), 1e-300)]
    if steps.size < _FEWEST // 4:
        return 0.0
    smallest = float(np.quantile(steps, 0.02))
    for guess in (float(steps.min()), smallest):
        step = guess
        for reach in _REACHES:  # a log rounds its counts: larger multiples are more exact
            near = steps[steps < reach * step]
            step = float(near.sum() / np.round(near / step).sum())
        off = np.abs(steps - step * np.round(steps / step))
        if steps.max() < 1e4 * step and np.mean(off < _OFF_GRID * step) > 0.95:
            return step
    return 0.0
