"""Quality rules on one trial: repair what is safe and say so, refuse what is not.

:func:`clean` takes the raw columns of a trial and returns them in SI units. A trial that cannot
be trusted raises :class:`bampipe.errors.InputError`, whose line is the reason for which the
trial is set aside. Whatever was changed or left out is a sentence in ``repairs``; what was only
noticed is a sentence in ``notes``. Nothing is altered without one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from bampipe.data import velocity
from bampipe.data.readers import RawTrial
from bampipe.data.session import SECONDS, Channel, Encoder, Session, TrialEntry
from bampipe.data.units import unit
from bampipe.errors import InputError

FASTEST = {"rad": 20.0, "m": 4.0}
"""Speed below which a step is never taken for a wild reading, rad/s and m/s."""

VELOCITY_RATIO = 1.5
"""A recorded velocity further than this factor from the change of position is in another unit."""

LARGEST_VALUE = 1e6
"""No angle, force, torque or other input is as large as this in SI units."""


@dataclass(frozen=True)
class Limits:
    """What still counts as a sound trial.

    Attributes:
        shortest_s: least duration, s.
        gap_s: longest gap in the time stamps that is left to resampling, s.
        sound_share: least share of the trial that the longest stretch between gaps must hold.
        dropped_share: largest share of rows that may be dropped for their time stamps.
        nan_run: longest run of missing samples that is interpolated.
        nan_share: largest share of missing samples in a channel.
        saturated_share: largest share of samples at the rail of a force channel.
        frozen_share: largest share of the trial over which a force channel may stand still.
        still_rad, still_m: a free trial moves more than this on some axis.
        locked_rad, locked_m: a locked axis moves less than this.
        locked_steps: a locked axis deflects by at least this many encoder steps.
        brake_on: brake command above which a trial is not free, N.m or N.
    """

    shortest_s: float = 1.0
    gap_s: float = 0.25
    sound_share: float = 0.6
    dropped_share: float = 0.01
    nan_run: int = 5
    nan_share: float = 0.01
    saturated_share: float = 0.01
    frozen_share: float = 0.2
    still_rad: float = 0.005
    still_m: float = 0.0005
    locked_rad: float = 0.2
    locked_m: float = 0.02
    locked_steps: int = 5
    brake_on: float = 0.5


@dataclass
class CleanTrial:
    """A sound trial.

    Attributes:
        t: (T,) s, strictly increasing from 0.
        columns: (T,) a column in SI units: q_<axis>, force_<component>, brake_<axis>, channels.
        sample_rate: 1 / median step, Hz.
        repairs: what was changed or left out.
        notes: what was noticed and left as it is.
    """

    t: np.ndarray
    columns: dict[str, np.ndarray]
    sample_rate: float
    repairs: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


class _Table:
    """The columns of a trial while they are being cleaned, each row with its number in the file."""

    def __init__(self, raw: RawTrial, session: Session, entry: TrialEntry, limits: Limits) -> None:
        self.columns = raw.columns
        self.session = session
        self.entry = entry
        self.limits = limits
        self.clock = session.clock.column
        length = len(raw.columns[self.clock])
        self.rows = np.arange(raw.first_row, raw.first_row + length, dtype=np.int64)
        self.repairs = list(raw.notes)
        self.notes = list(raw.remarks)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def t(self) -> np.ndarray:
        return self.columns[self.clock]

    @t.setter
    def t(self, seconds: np.ndarray) -> None:
        self.columns[self.clock] = seconds

    def keep(self, which: np.ndarray | slice) -> None:
        """Keep only some rows; one column at a time, to hold little twice."""
        self.rows = self.rows[which].copy()
        for name in self.columns:
            self.columns[name] = self.columns[name][which].copy()

    def fault(
        self, what: str, *, column: str = "", at: int | None = None, remedy: str = ""
    ) -> InputError:
        row = "" if at is None else f", row {self.rows[at]}"
        where = f"{self.entry.file}{row}" + (f", column '{column}'" if column else "")
        return InputError(what, where=where, remedy=remedy)


def clean(raw: RawTrial, session: Session, entry: TrialEntry, limits: Limits) -> CleanTrial:
    """Check and repair one trial and bring it to SI units.

    The arrays of ``raw`` are used up.

    Args:
        raw: from :func:`bampipe.data.readers.read_trial`.
        session: what its columns mean.
        entry: what kind of trial it is.
        limits: what counts as sound.

    Raises:
        InputError: the trial must be set aside; says why, and where in the file.
    """
    table = _Table(raw, session, entry, limits)
    _refuse_other_units(table, raw.units)
    _time_to_seconds(table)
    _drop_backward_stamps(table)
    _cut_stretch(table)
    _keep_longest_stretch(table)
    for encoder in session.encoders:
        _refuse_fractions(table, encoder)
        _unwrap(table, encoder)
    for channel in session.channels:
        _to_signed(table, channel)
    _fill_missing(table)
    for encoder in session.encoders:
        _mend_jumps(table, encoder)
    table.t -= table.t[0]
    _refuse_short(table)
    _note_clock(table)
    for encoder in session.encoders:
        _hold_against_velocity(table, encoder)
    if session.force is not None and session.force.volts:
        for column in session.force.columns:
            _refuse_frozen(table, column)
            _refuse_saturated(table, column)
    columns = _to_si(table)
    _refuse_wrong_motion(table, columns)
    _refuse_wrong_brakes(table, columns)
    rate = float(1.0 / np.median(np.diff(table.t)))
    return CleanTrial(table.t, columns, rate, table.repairs, table.notes)


# Units


def _refuse_other_units(table: _Table, stated: Mapping[str, str]) -> None:
    """Refuse a column whose unit in the file is not that of the session file."""
    clock = table.session.clock
    declared = {**table.session.raw_units}
    if not clock.datetime:
        declared[clock.column] = {v: k for k, v in SECONDS.items()}.get(clock.seconds, "")
    for column, text in stated.items():
        found, expected = unit(text), unit(declared.get(column, ""))
        if found is None or expected is None or "" in (found.si, expected.si):
            continue
        if (found.si, found.scale) != (expected.si, expected.scale):
            raise table.fault(
                f"the file gives the unit {text}, session.toml {declared[column]}",
                column=column,
                remedy="correct session.toml",
            )


# Time


def _time_to_seconds(table: _Table) -> None:
    """Time stamps in s, whatever unit they are really in; rows without one are dropped."""
    missing = ~np.isfinite(table.t)
    count = int(missing.sum())
    if count:
        if count > _few(table, len(table)):
            at = int(np.argmax(missing))
            raise table.fault(f"{count} time stamps are missing", column=table.clock, at=at)
        table.keep(~missing)
        table.repairs.append(f"{_rows(count)} without a time stamp dropped")
    _unwrap_clock(table)
    steps = np.diff(table.t)
    steps = steps[steps > 0]
    if len(steps) == 0:
        falls = len(table) > 1 and table.t[-1] < table.t[0]
        raise table.fault(
            "time runs backwards throughout" if falls else "time stands still",
            column=table.clock,
            remedy="is this the time column?",
        )
    # The first stamp goes first: stamps since 1970 in s have no room for fractions of 1 us.
    table.t = (table.t - table.t[0]) * table.session.clock.seconds
    nominal = table.session.sample_rate
    ratio = float(np.median(steps)) * table.session.clock.seconds * nominal
    power = 3 * round(np.log10(ratio) / 3)
    if power in (-9, -6, -3, 3, 6, 9) and 0.5 < ratio / 10.0**power < 2.0:
        table.t = table.t * 10.0**-power
        unit = {seconds: name for name, seconds in SECONDS.items()}
        declared = unit[table.session.clock.seconds]
        real = unit.get(float(f"{table.session.clock.seconds * 10.0**-power:.0e}"))
        words = f"in {real}, not {declared}" if real else f"wrong by a factor of 1e{power}"
        table.repairs.append(f"time stamps are {words}, by the nominal rate: converted")
    elif not 0.1 < ratio < 10.0:
        raise table.fault(
            f"the median step of {ratio / nominal:.3g} s does not fit sample_rate_hz = {nominal:g}",
            column=table.clock,
            remedy="check the unit of the time column and sample_rate_hz",
        )


def _unwrap_clock(table: _Table) -> None:
    """Undo the roll-over of a clock that counts ticks in 32 bits."""
    drops = np.flatnonzero(np.diff(table.t) < -(2.0**32) * 0.9)
    if len(drops) and table.t.min() >= 0 and table.t.max() < 2.0**32:
        turns = np.zeros(len(table))
        turns[drops + 1] = 2.0**32
        table.t = table.t + np.cumsum(turns)
        table.repairs.append(f"clock rolls over at 32 bits {_times(len(drops))}: unrolled")


def _drop_backward_stamps(table: _Table) -> None:
    """Leave strictly increasing stamps where few rows are in the way; else refuse the trial."""
    t = table.t
    if np.all(np.diff(t) > 0):
        return
    total = len(table)
    # A single stamp that leaps ahead would put all that follow behind it: it goes first.
    ahead = np.zeros(total, dtype=bool)
    ahead[1:-1] = (t[1:-1] > t[2:]) & (t[:-2] < t[2:])
    if 0 < ahead.sum() <= _few(table, total):
        table.keep(~ahead)
        t = table.t
    else:
        ahead[:] = False
    before = np.maximum.accumulate(t)[:-1]
    repeated = np.concatenate([[False], t[1:] == before])
    behind = np.concatenate([[False], t[1:] < before])
    counts = int(repeated.sum()), int(behind.sum()) + int(ahead.sum())
    if sum(counts) > _few(table, total):
        at = int(np.argmax(repeated | behind))
        if counts[1] > counts[0]:
            raise table.fault(
                f"time runs backwards: {counts[1]} of {total} stamps are not after those before",
                column=table.clock,
                at=at,
                remedy="two recordings in one file?",
            )
        raise table.fault(
            f"{counts[0]} of {total} time stamps are repeated", column=table.clock, at=at
        )
    table.keep(~(repeated | behind))
    if counts[0]:
        table.repairs.append(f"{_rows(counts[0])} with a repeated time stamp dropped")
    if counts[1]:
        table.repairs.append(f"{_rows(counts[1])} with a time stamp out of order dropped")


def _cut_stretch(table: _Table) -> None:
    """Keep the stretch of the record that the session file gives to this trial."""
    start, end = table.entry.start_s, table.entry.end_s
    if start == 0.0 and np.isinf(end):
        return
    t = table.t - table.t[0]
    inside = (t >= start) & (t < end)
    if not inside.any():
        raise table.fault(
            f"start_s = {start:g} is after the last sample, at {t[-1]:.3f} s of the record",
            column=table.clock,
        )
    table.keep(inside)
    until = f"{end:g}" if end <= t[-1] else f"{t[-1]:.3f}"
    table.notes.append(f"from {start:g} to {until} s of the record")


def _keep_longest_stretch(table: _Table) -> None:
    steps = np.diff(table.t)
    if len(steps) == 0:
        return
    limit = max(table.limits.gap_s, 5 * float(np.median(steps)))
    gaps = np.flatnonzero(steps > limit)
    if len(gaps) == 0:
        return
    bounds = np.concatenate([[0], gaps + 1, [len(table)]])
    longest = int(np.argmax(np.diff(bounds)))
    start, stop = int(bounds[longest]), int(bounds[longest + 1])
    share = (stop - start) / len(table)
    widest = float(steps[gaps].max())
    words = f"{_counted(len(gaps), 'gap')} of up to {widest:.3g} s in the time stamps"
    if share < table.limits.sound_share:
        raise table.fault(
            f"{words}, and the longest stretch between them holds {share:.0%} of the samples,"
            f" less than {table.limits.sound_share:.0%}",
            column=table.clock,
            at=int(gaps[0]),
        )
    first, last = table.rows[start], table.rows[stop - 1]
    dropped = len(table) - (stop - start)
    table.keep(slice(start, stop))
    table.repairs.append(f"{words}: rows {first} to {last} kept, {_rows(dropped)} dropped")


def _refuse_short(table: _Table) -> None:
    # Each sample stands for one step: 500 samples at 500 Hz are 1 s.
    step = float(np.median(np.diff(table.t))) if len(table) > 1 else 0.0
    duration = float(table.t[-1]) + step
    if len(table) < 4 or duration < table.limits.shortest_s * (1 - 1e-6):
        raise table.fault(
            f"{_counted(len(table), 'sample')} over {duration:.3g} s,"
            f" less than {table.limits.shortest_s:g} s"
        )


def _note_clock(table: _Table) -> None:
    """Say what resampling has to deal with: small gaps, jitter, another rate than announced."""
    steps = np.diff(table.t)
    median = float(np.median(steps))
    gaps = steps > 1.6 * median
    if gaps.any():
        lost = int(np.sum(np.rint(steps[gaps] / median) - 1))
        table.notes.append(
            f"{_counted(int(gaps.sum()), 'small gap')} in the time stamps,"
            f" about {_counted(lost, 'sample')} missing, longest {steps.max():.3g} s"
        )
    jitter = float(np.std(steps[~gaps]))
    if jitter > 0.05 * median:
        table.notes.append(
            f"time stamps jitter by {jitter * 1e3:.3g} ms (standard deviation), from"
            f" {steps.min() * 1e3:.3g} to {steps[~gaps].max() * 1e3:.3g} ms between samples:"
            " put on a uniform grid by monotone cubic interpolation when filtered"
        )
    nominal = table.session.sample_rate
    if abs(1 / median - nominal) > 0.02 * nominal:
        table.notes.append(f"sampled at {1 / median:.4g} Hz, announced {nominal:g} Hz")


# Encoders


def _refuse_fractions(table: _Table, encoder: Encoder) -> None:
    if not encoder.counts:
        return
    values = table.columns[encoder.column]
    fractions = np.isfinite(values) & (values != np.rint(values))
    if fractions.any():
        at = int(np.argmax(fractions))
        raise table.fault(
            f"found {values[at]:g}, expected whole counts",
            column=encoder.column,
            at=at,
            remedy="columns swapped? or already in units (then leave counts_per_unit out)",
        )


def _unwrap(table: _Table, encoder: Encoder) -> None:
    """Undo the wrap-around of a counter of 16, 24 or 32 bits, or of an angle at a full turn."""
    if encoder.counts:
        periods = [(2.0**bits, f"at {bits} bits") for bits in (16, 24, 32)]
    elif encoder.unit == "rad":
        periods = [(2 * np.pi / encoder.scale, "at a full turn")]
    else:
        return
    values = table.columns[encoder.column]
    known = np.flatnonzero(np.isfinite(values))
    steps = np.diff(values[known])
    for period, words in periods:
        wraps = np.abs(steps) > period / 2
        near = np.abs(np.abs(steps) - period) < period / 16
        if not wraps.any() or not near[wraps].all() or np.ptp(values[known]) > period:
            continue
        turns = np.zeros(len(known))
        turns[1:][wraps] = -np.sign(steps[wraps]) * period
        values[known] += np.cumsum(turns)
        first = table.rows[known[int(np.argmax(wraps)) + 1]]
        table.repairs.append(
            f"column '{encoder.column}' wraps {words} {_times(int(wraps.sum()))},"
            f" first at row {first}: unwrapped"
        )
        return


def _mend_jumps(table: _Table, encoder: Encoder) -> None:
    """Interpolate isolated wild readings; refuse a lasting jump (lost counts, a reset).

    A step is wild when it is 20 times what all but one step in twenty stay below, and faster
    than any of these axes can go.
    """
    values = table.columns[encoder.column]
    if len(table) < 4:
        return
    steps = np.abs(np.diff(values))
    fastest = FASTEST[encoder.unit] * float(np.median(np.diff(table.t))) / encoder.scale
    limit = max(20 * float(np.quantile(steps, 0.95)), abs(fastest))
    jumps = np.flatnonzero(steps > limit)
    if len(jumps) == 0:
        return
    run, total = table.limits.nan_run, len(table)
    wild = np.zeros(total, dtype=bool)
    lasting = []
    number = 0
    while number < len(jumps):
        here = int(jumps[number])
        after = int(jumps[number + 1]) if number + 1 < len(jumps) else total
        if (
            after - here <= run
            and after + 1 < total
            and (abs(values[after + 1] - values[here]) <= limit)
        ):
            wild[here + 1 : after + 1] = True
            number += 2
            continue
        if here < run:
            wild[: here + 1] = True
        elif total - 1 - here <= run:
            wild[here + 1 :] = True
        else:
            lasting.append(here)
        number += 1
    if lasting or wild.sum() > table.limits.nan_share * total:
        at = lasting[0] if lasting else int(jumps[0])
        size = abs(values[at + 1] - values[at]) * abs(encoder.scale)
        raise table.fault(
            f"jumps by {size:.3g} {encoder.unit} from one sample to the next"
            f" ({_times(len(jumps))})",
            column=encoder.column,
            at=at + 1,
            remedy="counts lost, or the counter was reset",
        )
    values[wild] = np.nan
    table.repairs.append(
        f"column '{encoder.column}': {_counted(int(wild.sum()), 'wild reading')} taken out"
    )
    _fill_missing(table)


def _hold_against_velocity(table: _Table, encoder: Encoder) -> None:
    """Refuse an axis whose recorded velocity is in another unit, or of another sign."""
    if encoder.velocity is None:
        return
    speed = table.columns.pop(encoder.velocity.column) * encoder.velocity.scale
    position = (table.columns[encoder.column] - encoder.zero) * encoder.scale
    found = velocity.compare(table.t, position, speed)
    if found is None:
        return
    place = encoder.velocity.column
    if abs(found.correlation) < 0.9:
        table.notes.append(
            f"column '{place}' is not the velocity of {encoder.axis} by its position"
            f" (correlation {found.correlation:.2f}); it is not used"
        )
        return
    if not 1 / VELOCITY_RATIO < found.ratio < VELOCITY_RATIO:
        raise table.fault(
            f"is {found.ratio:.3g} times the change of '{encoder.column}'",
            column=place,
            remedy="check the units and signs of both in session.toml",
        )
    if not 0.95 < found.ratio < 1.05:
        table.notes.append(
            f"column '{place}' is {found.ratio:.3g} times the change of '{encoder.column}'"
        )


# Missing samples


def _fill_missing(table: _Table) -> None:
    """Interpolate short runs of missing samples; drop them at the ends; refuse long ones."""
    channels = [name for name in table.columns if name != table.clock]
    some = np.zeros(len(table), dtype=bool)
    for name in channels:
        missing = ~np.isfinite(table.columns[name])
        _refuse_missing(table, name, missing)
        some |= missing
    if not some.any():
        return
    sound = np.flatnonzero(~some)
    if len(sound) == 0:
        raise table.fault("no row is complete")
    start, stop = int(sound[0]), int(sound[-1]) + 1
    if start > 0 or stop < len(table):
        dropped = len(table) - (stop - start)
        table.keep(slice(start, stop))
        table.repairs.append(f"{_rows(dropped)} with missing samples at the ends dropped")
    for name in channels:
        values = table.columns[name]
        missing = ~np.isfinite(values)
        if missing.any():
            known = ~missing
            values[missing] = np.interp(table.t[missing], table.t[known], values[known])
            table.repairs.append(
                f"column '{name}': {_counted(int(missing.sum()), 'missing sample')} interpolated"
            )


def _refuse_missing(table: _Table, name: str, missing: np.ndarray) -> None:
    count = int(missing.sum())
    if count == 0:
        return
    if count == len(missing):
        raise table.fault("holds no number at all", column=name)
    start, length = _longest_run(missing)
    if length > table.limits.nan_run:
        raise table.fault(
            f"{length} samples in a row are missing, more than {table.limits.nan_run}",
            column=name,
            at=start,
        )
    if count > max(table.limits.nan_share * len(missing), table.limits.nan_run):
        raise table.fault(
            f"{count} of {len(missing)} samples are missing,"
            f" more than {table.limits.nan_share:.0%}",
            column=name,
            at=int(np.argmax(missing)),
        )


# Force


def _refuse_frozen(table: _Table, column: str) -> None:
    values = table.columns[column]
    start, length = _longest_run(np.diff(values) == 0)
    share = (length + 1) / len(values)
    seconds = float(table.t[min(start + length, len(table) - 1)] - table.t[start])
    if share > table.limits.frozen_share and seconds > table.limits.shortest_s / 2:
        raise table.fault(
            f"reads {values[start]:g} without a change for {seconds:.3g} s ({share:.0%} of the"
            " trial): frozen",
            column=column,
            at=start,
            remedy="check the sensor's cable",
        )


def _refuse_saturated(table: _Table, column: str) -> None:
    """Refuse a channel that piles up at its extreme: in runs, and far above the next level."""
    values = table.columns[column]
    levels, counts = np.unique(values, return_counts=True)
    if len(levels) < 3:
        return
    for rail, pile, beside in (
        (levels[-1], counts[-1], counts[-2]),
        (levels[0], counts[0], counts[1]),
    ):
        share = pile / len(values)
        if share <= table.limits.saturated_share or pile <= 5 * beside:
            continue
        start, length = _longest_run(values == rail)
        if length >= 5:
            raise table.fault(
                f"{share:.1%} of the samples are at the rail {rail:g}: saturated, more than"
                f" {table.limits.saturated_share:.0%}",
                column=column,
                at=start,
                remedy="lower the gain or the load",
            )


# SI units, and what kind of trial it is


def _to_si(table: _Table) -> dict[str, np.ndarray]:
    session, raw = table.session, table.columns
    si: dict[str, np.ndarray] = {}
    source: dict[str, str] = {}
    for encoder in session.encoders:
        values = raw.pop(encoder.column)
        values -= encoder.zero
        values *= encoder.scale
        si[f"q_{encoder.axis}"] = values
        source[f"q_{encoder.axis}"] = encoder.column
    if session.force is not None:
        force = session.force
        for column, zero in zip(force.columns, force.zero, strict=True):
            _refuse_wild(table, raw[column], f"reads {column}", column)
            raw[column] -= zero
        for name, column, gains in zip(force.names, force.columns, force.calibration, strict=True):
            total = np.zeros(len(table))
            for other, gain in zip(force.columns, gains, strict=True):
                if gain != 0.0:
                    total += gain * raw[other]
            si[name] = total
            source[name] = column
        for column in force.columns:
            del raw[column]
    for brake in session.brakes:
        si[f"brake_{brake.axis}"] = raw.pop(brake.column)
        source[f"brake_{brake.axis}"] = brake.column
    for channel in session.channels:
        values = raw.pop(channel.column)
        values *= channel.scale
        values += channel.offset
        si[channel.name] = values
        source[channel.name] = channel.column
    for name, values in si.items():
        _refuse_wild(table, values, f"gives {name}", source[name])
    return si


def _to_signed(table: _Table, channel: Channel) -> None:
    """Read the unsigned register of a signed number as what it stands for."""
    if not channel.wrap_bits:
        return
    values = table.columns[channel.column]
    beyond = (values < 0.0) | (values >= 2.0**channel.wrap_bits)
    if beyond.any():
        at = int(np.argmax(beyond))
        raise table.fault(
            f"found {values[at]:g}, expected 0 to {2**channel.wrap_bits - 1}",
            column=channel.column,
            at=at,
            remedy="a column that is signed already needs no wrap_bits",
        )
    values[values >= 2.0 ** (channel.wrap_bits - 1)] -= 2.0**channel.wrap_bits


def _refuse_wild(table: _Table, values: np.ndarray, words: str, column: str) -> None:
    wild = ~(np.abs(values) < LARGEST_VALUE)
    if wild.any():
        at = int(np.argmax(wild))
        raise table.fault(
            f"{words} = {values[at]:.3g}, which no such machine does",
            column=column,
            at=at,
            remedy="check the column and its calibration",
        )


def _refuse_wrong_motion(table: _Table, columns: dict[str, np.ndarray]) -> None:
    session, limits, entry = table.session, table.limits, table.entry
    travel = {e.axis: float(np.ptp(columns[f"q_{e.axis}"])) for e in session.encoders}
    still = {"rad": limits.still_rad, "m": limits.still_m}
    if entry.kind != "locked":
        if all(travel[e.axis] < still[e.unit] for e in session.encoders):
            shown = ", ".join(f"{e.axis} {travel[e.axis]:.2g} {e.unit}" for e in session.encoders)
            raise table.fault(
                f"declared {entry.kind}, but never moves ({shown})",
                remedy="were the encoders on? or is it a locked trial?",
            )
        for encoder in session.encoders:
            if travel[encoder.axis] == 0.0:
                raise table.fault(
                    "never changes while other axes move: frozen",
                    column=encoder.column,
                    remedy="check the encoder's cable",
                )
        return
    encoder = next(e for e in session.encoders if e.axis == entry.locked_axis)
    most = {"rad": limits.locked_rad, "m": limits.locked_m}[encoder.unit]
    moved = travel[encoder.axis]
    if moved > most:
        raise table.fault(
            f"{encoder.axis} is declared locked, but moves by {moved:.3g} {encoder.unit},"
            f" more than {most:g} {encoder.unit}",
            column=encoder.column,
            remedy="did the brake slip? or is it a free trial?",
        )
    if encoder.resolution is not None and moved < (limits.locked_steps - 0.5) * encoder.resolution:
        steps = _counted(round(moved / encoder.resolution), "encoder step")
        raise table.fault(
            f"locked {encoder.axis} deflects by {steps} only, too little for a stiffness",
            column=encoder.column,
            remedy="was another axis loaded? are the columns right?",
        )


def _refuse_wrong_brakes(table: _Table, columns: dict[str, np.ndarray]) -> None:
    entry, brakes = table.entry, table.session.brakes
    highest = {b.axis: float(np.abs(columns[f"brake_{b.axis}"]).max()) for b in brakes}
    for brake in brakes:
        if entry.kind == "free" and highest[brake.axis] > table.limits.brake_on:
            raise table.fault(
                f"declared free, but the brake is commanded up to {highest[brake.axis]:.3g}"
                f" {brake.unit}",
                column=brake.column,
                remedy='is its kind "locked" or "viscous"?',
            )
        if brake.axis == entry.locked_axis and highest[brake.axis] == 0.0:
            table.notes.append(f"brake of the locked axis {brake.axis} is never commanded")
    if entry.kind == "viscous" and brakes and not any(highest.values()):
        raise table.fault("declared viscous, but no brake is ever commanded")


# Words and runs


def _few(table: _Table, total: int) -> int:
    """How many rows may be dropped for their time stamps."""
    return max(3, int(table.limits.dropped_share * total))


def _longest_run(which: np.ndarray) -> tuple[int, int]:
    """Start and length of the longest run of True in a (T,) mask, (0, 0) where there is none."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], which, [False]]).astype(np.int8)))
    starts, stops = edges[0::2], edges[1::2]
    if len(starts) == 0:
        return 0, 0
    longest = int(np.argmax(stops - starts))
    return int(starts[longest]), int(stops[longest] - starts[longest])


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _rows(count: int) -> str:
    return _counted(count, "row")


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
