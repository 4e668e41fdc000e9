"""Spectral lines far above their surroundings, mostly mains hum.

The fits use second differences, which remove a signal that is smooth over a few samples. The
differences of a sine are taken at the actual time stamps, so that uneven stamps distinguish it from
its aliases.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import median_filter

from bampipe.arrays import Array, Flags

LOWEST_LINE = 0.1
"""Lowest frequency of a line, cycles per sample: differences remove slower sines."""


_JUMP = 10.0
"""Multiple of the median above which a second difference is no part of a sine in noise."""
_UNEVEN = 1e-3
"""Relative variation of the sampling interval from which on aliases differ from a sine."""
_MOST, _ABOVE, _BESIDE = 6, 40.0, 31
"""Largest number of lines; smallest power of a line relative to the median of nearby frequencies,
exceeded by chance once in 10^17; number of these frequencies."""
_FOLDS = 4
"""Largest multiple of the rate up to which aliases of a sine are tried."""
_ALONE, _ALONE_HZ, _LEAKAGE = 4.0, 12.0, 3
"""Smallest power of a hum relative to everything else within so many Hz, and the neighbouring bins
that leakage fills: a periodic motion has lines at every multiple of its own frequency."""
_MAINS_HZ, _HARMONICS, _OFF = (50.0, 60.0), 5, 0.002
"""Mains frequencies, the number of their harmonics that are searched, and the largest relative
deviation: the grid is accurate to 0.0005, the clock of a recorder may be worse."""
_STRETCH, _STRETCH_S, _STRETCHES = 2000, 4.0, 8
"""The phase of mains drifts, so hum is fitted by stretches of at least so many samples and seconds,
and searched in at most so many of them."""
_FEWEST = 200
"""Smallest number of samples for a search."""


@dataclass(frozen=True)
class Line:
    """One sine.

    Attributes:
        hz: its frequency, in cycles per unit of the time stamps.
        values: (T,) the sine at the time stamps, in the unit of the record.
        alone: power relative to that of the strongest frequency around it.
    """

    hz: float
    values: Array
    alone: float


def find_lines(
    record: Array, t: Array, lowest: float, highest: float = 0.5, lag: int = 1
) -> list[Line]:
    """Find sines in a record (T,) with time stamps ``t`` (T,), the clearest first.

    Args:
        lowest, highest: range of their apparent frequencies, in cycles per sample; up to 0.5, it
            contains aliases of faster sines.
        lag: samples between those of which second differences are taken; noise counts least if a
            sine advances by a quarter to half a cycle in this time.
    """
    rate = _mean_rate(t)
    frequency = np.fft.rfftfreq(t.size - 2 * lag)
    high = (frequency > lowest) & (frequency <= highest)
    window = np.hanning(t.size - 2 * lag)
    beside = int(_ALONE_HZ / (rate * frequency[1]))
    lines: list[Line] = []
    while len(lines) < _MOST:
        wanted, even = _second_differences(record, lag)
        power = np.square(np.abs(np.fft.rfft(window * wanted * even)[high]))
        above = power / np.maximum(median_filter(power, _BESIDE), np.finfo(float).tiny)
        peak = int(np.argmax(above))
        if above[peak] <= _ABOVE / np.log(2.0):
            break
        around = power[max(peak - beside, 0) : peak + beside + 1].copy()
        own = min(peak, beside)
        around[max(own - _LEAKAGE, 0) : own + _LEAKAGE + 1] = 0.0
        middle, apart = frequency[high][peak], frequency[1]
        one = highest < 0.5 or _is_uniform(t)
        aliases = [middle, *(n + sign * middle for n in range(1, _FOLDS) for sign in (-1.0, 1.0))]
        fits = [_fit(record, t, rate * a, rate * apart, lag) for a in aliases[: 1 if one else None]]
        hz, values, _ = min(fits, key=lambda fit: fit[2])
        lines.append(Line(hz, values, float(power[peak] / max(around.max(), 1e-300))))
        record = record - values
    return lines


def remove_mains(
    record: Array, t: Array, moving: Sequence[Array] = ()
) -> tuple[Array, dict[float, float]]:
    """Subtract the mains hum from a record (T,) with time stamps ``t`` (T,), s.

    Args:
        moving: other records (T,) at the same stamps that mains do not reach, such as positions: a
            line that one of them shows as well is motion.

    Returns:
        The record without hum, and its amplitude, the median over the stretches, by the nominal
        frequency of the mains or a harmonic, Hz; empty if there is no hum.
    """
    if record.size < _FEWEST:
        return record, {}
    stretches = max(1, int(min(record.size / _STRETCH, float(t[-1] - t[0]) / _STRETCH_S)))
    edges = np.linspace(0, record.size, stretches + 1).astype(int)
    parts = [slice(*ends) for ends in pairwise(edges)]
    some = [parts[i] for i in np.unique(np.linspace(0, stretches - 1, _STRETCHES).astype(int))]
    shown = [_find_mains(record[part], t[part]) for part in some]
    seen = {hz: [lines[hz] for lines in shown if hz in lines] for hz in set().union(*shown)}
    hum = {hz: float(np.median(at)) for hz, at in seen.items() if 2 * len(at) > len(some)}
    if hum:
        moved = set().union(*(_find_mains(other[some[0]], t[some[0]]) for other in moving))
        hum = {hz: hum[hz] for hz in sorted(hum.keys() - moved)}
    clear = record.copy()
    sizes: dict[float, list[float]] = {hz: [] for hz in hum}
    for part in parts if hum else ():
        within = 1.0 / float(t[part][-1] - t[part][0])
        for hz, at in hum.items():
            _, values, _ = _fit(clear[part], t[part], at, within, _lag(t[part]))
            clear[part] -= values
            sizes[hz].append(float(np.sqrt(2.0) * np.std(values)))
    return clear, {hz: float(np.median(size)) for hz, size in sizes.items()}


def _find_mains(record: Array, t: Array) -> dict[float, float]:
    """Return the nominal mains frequencies, Hz, in a record (T,), each with the actual one."""
    rate = _mean_rate(t)

    def apparent(hz: float) -> float:
        return abs(hz - rate * round(hz / rate)) if _is_uniform(t) else hz

    found: dict[float, float] = {}
    nominal = [n * hz for hz in _MAINS_HZ for n in range(1, _HARMONICS + 1)]
    lowest = min(LOWEST_LINE, 0.9 * min(_MAINS_HZ) / rate)
    highest = min(1.1 * max(nominal) / rate, 0.5)
    for line in find_lines(record, t, lowest, highest, _lag(t)):
        alike = [hz for hz in nominal if abs(apparent(line.hz) - apparent(hz)) <= _OFF * hz]
        if alike and line.alone >= _ALONE:
            found.setdefault(min(alike), line.hz)
    return found


def _mean_rate(t: Array) -> float:
    return (t.size - 1) / float(t[-1] - t[0])


def _lag(t: Array) -> int:
    """Return the samples in an eighth of a mains cycle; one at a low rate."""
    return max(1, int(0.125 * _mean_rate(t) / min(_MAINS_HZ)))


def _is_uniform(t: Array) -> bool:
    """Return whether stamps (T,) are too even to distinguish a sine from its aliases."""
    steps = np.diff(t)
    return float(np.ptp(steps)) < _UNEVEN * float(np.mean(steps))


def _second_differences(record: Array, lag: int) -> tuple[Array, Flags]:
    """Return second differences of a record (T,), and which are not jumps of friction."""
    wanted = record[2 * lag :] - 2.0 * record[lag:-lag] + record[: -2 * lag]
    return wanted, np.abs(wanted) <= _JUMP * float(np.median(np.abs(wanted)))


def _fit(record: Array, t: Array, hz: float, within: float, lag: int) -> tuple[float, Array, float]:
    """Return frequency and values (T,) of the best-fitting sine of a record (T,), and its misfit.

    Args:
        hz, within: centre and half-width of the search, Hz; lag: see `find_lines`.
    """
    from scipy.optimize import minimize_scalar  # slow to import, and only needed if there is a hum

    wanted, even = _second_differences(record, lag)
    wanted = wanted[even]

    def fitted(frequency: float) -> tuple[Array, float]:
        phase = 2.0 * np.pi * frequency * t
        pair = np.column_stack([np.sin(phase), np.cos(phase)])
        columns = (pair[2 * lag :] - 2.0 * pair[lag:-lag] + pair[: -2 * lag])[even]
        size, *_ = np.linalg.lstsq(columns, wanted, rcond=None)
        left = wanted - columns @ size
        return pair @ size, float(left @ left)

    best = minimize_scalar(
        lambda frequency: fitted(frequency)[1], bounds=(hz - within, hz + within), method="bounded"
    )
    return float(best.x), *fitted(float(best.x))
