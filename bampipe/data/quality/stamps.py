"""What a clock and a logger do to samples: counters that roll over, coarse stamps, held rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bampipe.arrays import Array

COARSEST_STAMP = 0.05
"""Share of a step to which time stamps may be rounded: their scatter is a third of it."""
_BITS, _SCALES = (32, 24, 16), (1.0, 1e-3, 1e-6, 1e-9)
"""Widths of counters, and what the stamps of one may have been multiplied by."""
_NEAR_ROLL = 5.0
"""Steps within which a stamp that rolled over goes on where the one before stopped."""
_OF_ONE_LATTICE = 1e-3
"""Of the mean step: what may be a rounding of numbers in the file."""
_UNEVEN = 0.05
"""Share of the steps that rounding makes unlike the others, the least."""
_LEAST_HELD = 0.15
"""Share of rows that are held, the least."""
_REGULAR = 0.7
"""Share of the intervals between new readings that are as long as their median, the least."""
_NO_COUNT = 5.0
"""Median change of a new reading over the least: what is held at regular intervals and then changes
by one count is an encoder that moves slowly."""


def unroll(t: Array) -> tuple[Array, int, NDArray[np.intp]]:
    """Undo the roll-over of a counter of 16, 24 or 32 bits, in whatever unit its stamps are.

    Args:
        t: (T,) stamps.

    Returns:
        Stamps (T,) that go on, the bits of the counter, 0 where none rolls over, and the rows of
        the first stamps after each.
    """
    steps = np.diff(t)
    drops = np.flatnonzero(steps < 0.0)
    ahead = steps[steps > 0.0]
    if len(drops) and len(ahead):
        usual = float(np.median(ahead))
        for bits in _BITS:
            for scale in _SCALES:
                period = scale * 2.0**bits
                goes_on = steps[drops] + period
                if (
                    np.ptp(t) <= period
                    and usual < 0.1 * period
                    and np.all((goes_on > 0.0) & (goes_on < _NEAR_ROLL * usual))
                ):
                    turns = np.zeros(len(t))
                    turns[drops + 1] = period
                    return t + np.cumsum(turns), bits, drops + 1
    return t, 0, np.empty(0, dtype=np.intp)


def spread_stamps(t: Array) -> tuple[Array, float]:
    """Stamps of evenly sampled rows that were rounded, spread evenly again.

    A line through rows and stamps that no stamp leaves by more than its rounding is the clock;
    where rows were lost, rows that share a stamp are spread up to the next.

    Args:
        t: (T,) stamps that do not decrease.

    Returns:
        Stamps (T,) and what they were rounded to; as they stand and 0 where they are fine enough,
        or do not tell.
    """
    steps = np.diff(t)
    step = float(np.sum(steps)) / max(len(steps), 1)
    if len(t) < 8 or not step > 0.0 or steps.min() < 0.0:
        return t, 0.0
    # Where few steps are unlike the others, samples are lost or stand twice.
    usual = float(np.median(steps))
    if usual > 0.0 and np.mean(np.abs(steps - usual) > COARSEST_STAMP * step) < _UNEVEN:
        return t, 0.0
    lengths = np.unique(np.concatenate([[0.0], steps]))
    gaps = np.diff(lengths)
    gaps = gaps[gaps > _OF_ONE_LATTICE * step]
    rounding = float(gaps.min()) if len(gaps) else 0.0
    if rounding < COARSEST_STAMP * step:
        return t, 0.0
    if np.any(np.abs(steps / rounding - np.rint(steps / rounding)) > 0.1):
        return t, 0.0
    rows, first = np.arange(len(t), dtype=np.float64), np.flatnonzero(steps > 0.0) + 1
    # All rows of a stamp would tilt the line by where the first and the last stamp are cut.
    slope, start = np.polyfit(rows[first], t[first] - t[0], 1) if len(first) > 2 else (step, 0.0)
    if np.ptp(t - t[0] - slope * rows) <= 1.2 * rounding:
        return t[0] + start + slope * rows, rounding
    if len(first) < 3 or len(t) < 2 * len(first):
        return t, 0.0
    # Where rows are lost, the others of that stamp would be spread over the gap.
    width = np.minimum(np.diff(t[first]) / np.diff(first), 1.5 * step)
    rate = np.concatenate([np.repeat(width, np.diff(first)), np.full(len(t) - first[-1], step)])
    within = rows[first[0] :] - np.repeat(first, np.diff(np.append(first, len(t))))
    ends = np.repeat(t[first], np.diff(np.append(first, len(t)))) + rate * within
    before = t[first[0]] - step * np.arange(first[0], 0, -1)
    return np.concatenate([before, ends]), rounding


def find_fresh_rows(columns: Sequence[Array]) -> NDArray[np.intp] | None:
    """Rows with new readings, where a logger that is faster than its source repeats them.

    Args:
        columns: (T,) readings that belong together, such as positions.

    Returns:
        Numbers of the rows to keep; where all rests, those at the rate of the source. None where
        rows are not held at regular intervals, or are an encoder's that moves slowly.
    """
    if not columns or len(columns[0]) < 8:
        return None
    changes = np.abs(np.diff(np.stack([np.nan_to_num(column) for column in columns])))
    new = np.flatnonzero((changes > 0.0).any(axis=0)) + 1
    if len(new) < 4:
        return None
    rows = np.concatenate([[0], new])
    held = np.diff(np.append(rows, changes.shape[1] + 1))
    usual = float(np.median(held))
    regular = np.abs(held - usual) <= max(1.0, 0.25 * usual)
    if regular.mean() < _REGULAR:
        return None
    # What rests for longer is read at the rate of the source, too.
    every = float(held[regular].mean())
    parts = np.where(held > 2.0 * usual + 1.0, np.maximum(np.rint(held / every), 1.0), 1.0)
    index = np.repeat(np.arange(len(rows)), parts.astype(int))
    within = np.arange(len(index)) - np.repeat(np.cumsum(parts) - parts, parts.astype(int))
    kept = np.rint(rows[index] + within * held[index] / parts[index]).astype(np.intp)
    if len(kept) > (1.0 - _LEAST_HELD) * (changes.shape[1] + 1):
        return None
    least = np.array([row[row > 0.0].min() if row.any() else np.inf for row in changes])
    after_hold = rows[1:][(held[:-1] > 1) & regular[:-1]]
    sizes = (changes[:, after_hold - 1] / least[:, None]).max(axis=0)
    return kept if len(sizes) and np.median(sizes) >= _NO_COUNT else None
