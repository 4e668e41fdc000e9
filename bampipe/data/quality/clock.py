"""Time stamps: seconds from whatever was logged, without steps back, gaps or a rolled counter."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bampipe.arrays import Array, find_runs
from bampipe.data.quality.table import TrialTable, in_times, longest_run
from bampipe.data.session.channels import SECONDS
from bampipe.lists import count_noun

COARSEST_STAMP = 0.05
"""Share of a step to which time stamps may be rounded: their scatter is a third of it."""
_PERIODS = (
    *((f"{n} bits", unit * 2.0**n) for n in (32, 24, 16, 8) for unit in (1.0, 1e-3, 1e-6, 1e-9)),
    *(("midnight", unit * 86_400.0) for unit in (1.0, 1e3, 1e6, 1e9)),
    *(("a full second", unit) for unit in (1.0, 1e3, 1e6, 1e9)),
)
"""Names and periods at which clocks roll over, by the factors stamps may be multiplied by."""
_NEAR_ROLL = 5.0
"""Steps within which a stamp that rolled over goes on where the one before stopped."""
_OF_ONE_LATTICE = 1e-3
"""Share of the mean step up to which a deviation may be a rounding of numbers in the file."""
_UNEVEN = 0.05
"""Least share of the steps that rounding makes unlike the others."""
_LEAST_HELD = 0.15
"""Least share of rows that are held."""
_REGULAR = 0.7
"""Least share of the intervals between new readings that are as long as their median."""
_NO_COUNT = 5.0
"""Median change of a new reading over the least: what is held at regular intervals and then changes
by one count is an encoder that moves slowly."""
LONGEST_TRIAL_S = 3.2e7
"""A year: no longer trial is recorded in one go, so the unit of its clock is wrong."""
_GAP = 1.6
"""Multiple of the median step beyond which samples are missing."""
_SMOOTHER = 0.8
"""Travel of the positions in the order of the stamps, over that in the order of the file: below,
rows were written late; above, the clock was set back."""
_UNLIKELY_TWICE = 0.1
"""Share of stamps that stand twice once rows are sorted, from which two recordings are mixed."""
_SEAM = 3.0
"""Times the largest step of a position, over which it goes on where a clock was set back."""


def goes_on(values: Array, rows: NDArray[np.intp]) -> bool:
    """Whether readings (T,) change into ``rows`` little more than anywhere else."""
    steps = np.abs(np.diff(np.nan_to_num(values)))
    return bool(np.max(steps[rows - 1]) <= _SEAM * np.max(np.delete(steps, rows - 1), initial=0.0))


def unroll(t: Array) -> tuple[Array, str, NDArray[np.intp]]:
    """Undo the roll-over of a counter of 8 to 32 bits, of a time of day or of a second.

    Args:
        t: (T,) stamps, in whatever unit.

    Returns:
        Stamps (T,) that go on, where they roll over, "" if they do not, and the rows of the first
        stamps after each.
    """
    steps = np.diff(t)
    drops = np.flatnonzero(steps < 0.0)
    ahead = steps[steps > 0.0]
    if len(drops) and len(ahead):
        usual = float(np.median(ahead))
        for where, period in _PERIODS:
            onward = steps[drops] + period
            near = np.all((onward > 0.0) & (onward < _NEAR_ROLL * usual))
            if near and np.ptp(t) <= period and usual < 0.1 * period:
                turned = np.cumsum(np.append(0.0, steps < 0.0))
                return t + period * turned, where, drops + 1
    return t, "", np.empty(0, dtype=np.intp)


def spread_stamps(t: Array) -> tuple[Array, float]:
    """Stamps (T,) of evenly sampled rows that were rounded, spread evenly again.

    A line through rows and stamps that no stamp leaves by more than its rounding is the clock;
    where rows were lost, rows that share a stamp are spread up to the next.

    Returns:
        Stamps (T,) and what they were rounded to; as they stand and 0 where they are fine enough,
        decrease, or do not tell.
    """
    steps = np.diff(t)
    step = float(np.sum(steps)) / max(len(steps), 1)
    if len(t) < 8 or not step > 0.0 or steps.min() < 0.0:
        return t, 0.0
    # If few steps are unlike the others, samples are lost or stand twice.
    usual = float(np.median(steps))
    if usual > 0.0 and np.mean(np.abs(steps - usual) > COARSEST_STAMP * step) < _UNEVEN:
        return t, 0.0
    lengths = np.unique(np.concatenate([[0.0], steps]))
    gaps = np.diff(lengths)
    gaps = gaps[gaps > _OF_ONE_LATTICE * step]
    rounding = float(gaps.min()) if len(gaps) else 0.0
    if rounding < COARSEST_STAMP * step:
        return t, 0.0
    rows, first = np.arange(len(t), dtype=np.float64), np.flatnonzero(steps > 0.0) + 1
    if len(first) < 2 or np.any(np.abs(steps / rounding - np.rint(steps / rounding)) > 0.1):
        return t, 0.0
    # All rows of a stamp would tilt the line by where the first and the last stamp are cut.
    slope, start = np.polyfit(rows[first], t[first] - t[0], 1)
    if np.ptp(t - t[0] - slope * rows) <= 1.2 * rounding:
        return t[0] + start + slope * rows, rounding
    if len(first) < 3 or len(t) < 2 * len(first):
        return t, 0.0
    # If rows are lost, the others of that stamp would be spread over the gap.
    width = np.minimum(np.diff(t[first]) / np.diff(first), 1.5 * step)
    rate = np.concatenate([np.repeat(width, np.diff(first)), np.full(len(t) - first[-1], step)])
    within = rows[first[0] :] - np.repeat(first, np.diff(np.append(first, len(t))))
    ends = np.repeat(t[first], np.diff(np.append(first, len(t)))) + rate * within
    before = t[first[0]] - step * np.arange(first[0], 0, -1)
    return np.concatenate([before, ends]), rounding


def find_fresh_rows(columns: Sequence[Array]) -> NDArray[np.intp] | None:
    """Rows with new readings, where a logger that is faster than its source repeats them.

    The readings (T,) belong together, such as positions; while all rest, rows are taken at the rate
    of the source. None if rows are not held at regular intervals, or an encoder moves slowly.
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
    # Longer rests are read at the rate of the source, too.
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


def keep_fresh_rows(table: TrialTable) -> None:
    """Drop rows that repeat the positions before them: a logger is faster than its source."""
    twice = np.logical_and.reduce([np.diff(values) == 0.0 for values in table.columns.values()])
    if twice.any() and twice.sum() == np.sum(np.diff(table.t) == 0.0):
        table.keep(np.concatenate([[True], ~twice]))
        table.repairs.append(f"{count_noun(int(twice.sum()), 'duplicate row')} left out")
    encoders = table.session.encoders
    kept = find_fresh_rows([table.columns[encoder.column] for encoder in encoders])
    if kept is not None:
        held = 1.0 - len(kept) / len(table)
        table.keep(kept)
        table.repairs.append(
            f"{held:.0%} of the rows repeat the positions before them: new readings alone are kept"
        )


def time_to_seconds(table: TrialTable) -> None:
    """Time stamps in s, whatever unit they are really in; rows without one are dropped."""
    blank = np.logical_and.reduce([~np.isfinite(values) for values in table.columns.values()])
    if blank.any() and not blank.all():
        table.keep(~blank)
        table.repairs.append(f"{count_noun(int(blank.sum()), 'row')} that hold no number dropped")
    missing = ~np.isfinite(table.t)
    count = int(missing.sum())
    if count:
        if count > _few(table, len(table)):
            at = int(np.argmax(missing))
            raise table.fault("stamps_missing", table.clock, at, count=count)
        table.keep(~missing)
        table.repairs.append(f"{count_noun(count, 'row')} without a time stamp dropped")
    _unwrap_clock(table)
    steps = np.diff(table.t)
    steps = steps[steps > 0]
    if len(steps) == 0:
        falls = len(table) > 1 and table.t[-1] < table.t[0]
        raise table.fault("time_falls" if falls else "time_stands", table.clock)
    room = float(np.spacing(np.median(np.abs(table.t))))
    if room > COARSEST_STAMP * float(np.median(steps)):
        near, step = np.median(table.t), np.median(steps)
        raise table.fault("stamps_rounded", table.clock, near=near, room=room, step=step)
    # The first stamp goes first: stamps since 1970 in s have no room for fractions of 1 us.
    table.t = (table.t - table.t[0]) * table.session.tick
    nominal = table.session.sample_rate
    ratio = float(np.median(steps)) * table.session.tick * nominal
    power = 3 * round(np.log10(ratio) / 3)
    if power in (-9, -6, -3, 3, 6, 9) and 0.5 < ratio / 10.0**power < 2.0:
        table.t = table.t * 10.0**-power
        unit = {seconds: name for name, seconds in SECONDS.items()}
        declared = table.session.clock.unit
        real = unit.get(float(f"{table.session.tick * 10.0**-power:.0e}"))
        words = f"in {real}, not {declared}" if real else f"wrong by a factor of 1e{power}"
        table.repairs.append(f"time stamps are {words}, by the nominal rate: converted")
    elif table.session.clock.unit != "samples" and not 0.1 < ratio < 10.0:
        raise table.fault("other_rate", table.clock, step=ratio / nominal, rate=nominal)


def _unwrap_clock(table: TrialTable) -> None:
    """Undo the roll-over of a clock that counts, and spread stamps of too few digits."""
    table.t, where, rows = unroll(table.t)
    if where:
        table.repairs.append(
            f"clock rolls over at {where} {in_times(len(rows))}, first at row"
            f" {table.rows[rows[0]]}: unrolled"
        )
    table.t, rounding = spread_stamps(table.t)
    if rounding:
        table.repairs.append(
            f"time stamps are rounded to {rounding * table.session.tick:.3g} s: spread evenly"
        )


def put_in_order(table: TrialTable) -> None:
    """Sort rows that were written late, and bridge where the clock was set back.

    Both let stamps fall. In the order of its stamps, the motion is smoother where rows are out of
    order, and two motions are mixed where the clock was set back.
    """
    t = table.t
    lone = np.zeros(len(table), dtype=bool)
    # A single stamp that leaps ahead would put all that follow behind it: it goes first.
    lone[1:-1] = (t[1:-1] > t[2:]) & (t[:-2] < t[2:])
    if 0 < lone.sum() <= _few(table, len(table)):
        table.keep(~lone)
        table.repairs.append(f"{count_noun(int(lone.sum()), 'row')} with a wild stamp dropped")
        t = table.t
    mixed = np.maximum.accumulate(t)[:-1] > np.minimum.accumulate(t[::-1])[::-1][1:]
    sources = [encoder.column for encoder in table.session.encoders]
    positions = np.stack([np.nan_to_num(table.columns[column]) for column in sources])
    order, late = np.arange(len(t)), 0
    for start, stop in zip(*find_runs(mixed), strict=True):
        rows = slice(start, stop + 1)
        place = start + np.argsort(t[rows], kind="stable")
        before, after = (np.abs(np.diff(positions[:, x])).sum() for x in (np.r_[rows], place))
        falls = start + np.flatnonzero(np.diff(t[rows]) < 0.0)
        # Two recordings one after the other fall once, and their stamps are the same.
        late_rows = len(falls) > 1 and np.mean(np.diff(t[place]) == 0.0) < _UNLIKELY_TWICE
        if late_rows and after < _SMOOTHER * before:
            order[rows] = place
            late += int(np.sum(place != np.arange(start, stop + 1)))
        elif len(falls) == 1:
            at, step = int(falls[0]), float(np.median(np.diff(t)))
            size = t[at] - t[at + 1] + step
            seam = np.array([at + 1])
            # After a lone stamp that is wrong, the clock is where it was.
            if (stop - at) * step > 0.5 * size and all(goes_on(own, seam) for own in positions):
                t[at + 1 :] += size
                table.repairs.append(
                    f"the clock is set back by {size:.3g} s at row {table.rows[at + 1]}: bridged"
                )
    if late:
        table.keep(order)
        table.repairs.append(f"{count_noun(late, 'row')} written out of order sorted by time")


def drop_backward_stamps(table: TrialTable) -> None:
    """Leave strictly increasing stamps where few rows are in the way; else refuse the trial."""
    if np.all(np.diff(table.t) > 0):
        return
    put_in_order(table)
    t, total = table.t, len(table)
    before = np.maximum.accumulate(t)[:-1]
    repeated = np.concatenate([[False], t[1:] == before])
    behind = np.concatenate([[False], t[1:] < before])
    counts = int(repeated.sum()), int(behind.sum())
    if sum(counts) > _few(table, total):
        name = "stamps_behind" if counts[1] > counts[0] else "stamps_repeated"
        at = int(np.argmax(repeated | behind))
        raise table.fault(name, table.clock, at, count=max(counts), total=total)
    table.keep(~(repeated | behind))
    faults = "a repeated time stamp", "a time stamp out of order"
    for count, what in zip(counts, faults, strict=True):
        if count:
            table.repairs.append(f"{count_noun(count, 'row')} with {what} dropped")


def cut_stretch(table: TrialTable) -> None:
    """Keep the stretch of the record that the session file gives to this trial."""
    start, end = table.entry.start_s, table.entry.end_s
    if start == 0.0 and np.isinf(end):
        return
    t = table.t - table.t[0]
    inside = (t >= start) & (t < end)
    if not inside.any():
        raise table.fault("starts_after", table.clock, start=start, last=t[-1])
    table.keep(inside)
    until = f"{end:g}" if end <= t[-1] else f"{t[-1]:.3f}"
    table.notes.append(f"from {start:g} to {until} s of the record")


def keep_longest_stretch(table: TrialTable) -> None:
    """Cut at gaps in the time stamps and keep the longest stretch, if it is most of the trial."""
    steps = np.diff(table.t)
    if len(steps) == 0:
        return
    limit = max(table.limits.gap_s, 5 * float(np.median(steps)))
    gaps = np.flatnonzero(steps > limit)
    if len(gaps) == 0:
        return
    start, within = longest_run(steps <= limit)
    stop = start + within + 1
    share = (stop - start) / len(table)
    words = f"{count_noun(len(gaps), 'gap')} of up to {steps.max():.3g} s in the time stamps"
    if share < table.limits.sound_share:
        of = {"gaps": words, "share": share, "least": table.limits.sound_share}
        raise table.fault("gaps", table.clock, int(gaps[0]), **of)
    first, last = table.rows[start], table.rows[stop - 1]
    dropped = count_noun(len(table) - (stop - start), "row")
    table.keep(slice(start, stop))
    table.repairs.append(f"{words}: rows {first} to {last} kept, {dropped} dropped")


def refuse_length(table: TrialTable) -> None:
    """A trial of a second or less tells nothing, and none takes a year."""
    # Each sample stands for one step: 500 samples at 500 Hz are 1 s.
    step = float(np.median(np.diff(table.t))) if len(table) > 1 else 0.0
    duration = float(table.t[-1]) + step
    of = {"samples": count_noun(len(table), "sample"), "seconds": duration}
    if len(table) < 4 or duration < table.limits.shortest_s * (1 - 1e-6):
        raise table.fault("too_short", **of, least=table.limits.shortest_s)
    if duration > LONGEST_TRIAL_S:
        raise table.fault("too_long", table.clock, **of)


def rate_of(t: np.ndarray) -> float:
    """Samples a second by time stamps (T,), s; gaps and stamps that do not increase left out.

    By the mean step, and not the median: a clock of whole milliseconds steps by 10 and 12 ms at 94
    Hz, one of a tenth by 0.2 and 0.3 ms at 4 kHz.
    """
    steps = np.diff(t)
    steps = steps[steps > 0]
    return 1.0 / float(np.mean(steps[steps <= _GAP * np.median(steps)]))


def note_clock(table: TrialTable) -> None:
    """Say what resampling has to deal with: small gaps, jitter, another rate than announced."""
    steps = np.diff(table.t)
    median = float(np.median(steps))
    gaps = steps > _GAP * median
    if gaps.any():
        lost = int(np.sum(np.rint(steps[gaps] / median) - 1))
        table.notes.append(
            f"{count_noun(int(gaps.sum()), 'small gap')} in the time stamps,"
            f" about {count_noun(lost, 'sample')} missing, longest {steps.max():.3g} s"
        )
    jitter = float(np.std(steps[~gaps]))
    if jitter > 0.05 * median:
        table.notes.append(
            f"time stamps jitter by {jitter * 1e3:.3g} ms (standard deviation), from"
            f" {steps.min() * 1e3:.3g} to {steps[~gaps].max() * 1e3:.3g} ms between samples:"
            " put on a uniform grid by a cubic spline when filtered"
        )
    nominal, rate = table.session.sample_rate, rate_of(table.t)
    if abs(rate - nominal) > 0.02 * nominal:
        table.notes.append(f"sampled at {rate:.4g} Hz, announced {nominal:g} Hz")


def _few(table: TrialTable, total: int) -> int:
    """Largest number of rows that may be dropped for their time stamps."""
    return max(3, int(table.limits.dropped_share * total))
