"""One recording: a log, one of several in a file, or several files joined; and a sound trial."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bampipe.data.quality import CleaningLimits, CleanTrial, clean
from bampipe.data.quality.clock import goes_on, unroll
from bampipe.data.readers import read_trial
from bampipe.data.readers.moments import NANOSECONDS
from bampipe.data.readers.trial import LARGEST_BYTES, Dialect, RawTrial, check_columns, interpolated
from bampipe.data.refusals import refusal
from bampipe.data.session import Part, Session, TrialEntry, inside
from bampipe.data.session.channels import SECONDS, Clock
from bampipe.errors import InputError
from bampipe.files import digest_file

MOST_APART = 0.01
"""Share of samples that one part may have more than another to be joined row by row."""
_LEAST = 20
"""Samples of a recording: time that falls sooner has not started again."""
_MOSTLY = 0.95
"""Least share of rows in which a column sampled with the others has a reading."""
_LOST = 5.0
"""Multiple of the usual step between readings beyond which some are lost."""
_FAR_OFF = 10.0
"""Distance of a recurring value, in ranges of all other readings, beyond which it is no reading."""
_PAGE = 3.0
"""Steps that a clock goes on by where the header stands again on a new page."""
_BACK = 0.02
"""Largest share of the time passed to which a clock that starts again falls back."""


def read_recording(
    root: Path,
    entry: TrialEntry,
    columns: Sequence[str],
    clock: Clock,
    dialect: Dialect | None = None,
    largest_bytes: int = LARGEST_BYTES,
) -> RawTrial:
    """Read the columns of one trial, those of its parts at the samples of its file.

    Columns of a part are called ``part:column``; ``largest_bytes`` is for one file.

    Raises:
        InputError: as :func:`read_trial`; files that do not belong together, or a file that holds
            several recordings where ``entry`` does not say which.
    """
    places = {column: _place(entry.columns.get(column, column), entry) for column in columns}
    own_time = _place(entry.columns.get(clock.column, clock.column), entry)[1]

    def read(name: str, file: str, time: str, unit: str) -> RawTrial:
        wanted = dict.fromkeys([time, *(bare for part, bare in places.values() if part == name)])
        wanted.pop("", None)
        raw = read_trial(
            inside(root, file, where=file),
            list(wanted),
            name=file,
            largest_bytes=largest_bytes,
            datetimes={time: clock.format} if unit == "datetime" and time else {},
            dialect=dialect,
        )
        raw = _forwards(raw, time) if unit == "datetime" else raw
        called = {bare: column for column, (part, bare) in places.items() if part == name}
        return replace(
            raw,
            columns={called.get(bare, bare): values for bare, values in raw.columns.items()},
            units={called.get(bare, f"{name}:{bare}"): u for bare, u in raw.units.items()},
            since={called.get(bare, bare): first for bare, first in raw.since.items()},
        )

    timed = any(part.join != "rows" for part in entry.parts)
    in_own = places.get(clock.column, ("", ""))[0] == ""
    raw = read("", entry.file, own_time if clock.column and (timed or in_own) else "", clock.unit)
    for part in entry.parts:
        if all(name != part.name for name, _ in places.values()):
            continue
        time = (part.time or own_time) if part.join != "rows" else ""
        if part.join == "rows" and places.get(clock.column, ("", ""))[0] == part.name:
            time = places[clock.column][1]
        other = read(part.name, part.file, time, part.time_unit or clock.unit)
        if not raw.columns:
            raw = other
            continue
        if part.join == "rows":
            start, stop, remark = _by_rows(raw, other, entry, part)
        else:
            start, stop, remark = _by_time(raw, other, entry, part, clock, time)
        raw = replace(
            raw,
            columns={**raw.columns, **other.columns},
            units={**raw.units, **other.units},
            notes=(*raw.notes, *other.notes),
            remarks=(*raw.remarks, remark),
        ).between(start, stop)
    raw = replace(raw, columns={column: raw.columns[column] for column in columns})
    return _at_one_rate(_without_codes(_filled(_one_of(raw, entry, clock), clock), clock), clock)


def _forwards(raw: RawTrial, time: str) -> RawTrial:
    """The rows in the order of their ``time``, where a data base gave the newest first.

    It is one of dates and times: a number may count down.
    """
    t = raw.columns.get(time, np.empty(0))
    if len(t) < 2 or not np.all(np.diff(t) < 0.0):
        return raw
    columns = {name: values[::-1] for name, values in raw.columns.items()}
    columns[time] = columns[time] - t[-1]
    since = {name: first + round(t[-1] * NANOSECONDS) for name, first in raw.since.items()}
    notes = (*raw.notes, "the newest row stands first: all are turned round")
    return replace(raw, columns=columns, rows=raw.rows[::-1], since=since, notes=notes)


def _without_codes(raw: RawTrial, clock: Clock) -> RawTrial:
    """The readings without a number that stands for none, such as -9999: the same one, far off."""
    columns, notes = dict(raw.columns), list(raw.notes)
    names = sorted(columns.keys() - {clock.column, clock.nanoseconds})
    zero = np.all([columns[name] == 0.0 for name in names], axis=0)
    if names[1:] and 0 < zero.sum() < zero.size and all(_leaps(columns[n], zero) for n in names):
        columns |= {name: np.where(zero, np.nan, columns[name]) for name in names}
        notes.append(f"{zero.sum()} rows of zeros, to which all readings leap, are taken for none")
    for name in names:
        for side in (-1.0, 1.0):
            values = columns[name]
            code = side * float(np.max(side * values, initial=-np.inf, where=np.isfinite(values)))
            others = values[np.isfinite(values) & (values != code)]
            count = int(np.sum(values == code))
            if not 2 <= count < len(others) or np.ptp(others) == 0.0:
                continue
            far = np.min(np.abs(others - code)) > _FAR_OFF * np.ptp(others)
            if far and len(np.unique(others)) >= _LEAST:  # not -1 of a register at rest
                columns[name] = np.where(values == code, np.nan, values)
                notes.append(f"column '{name}': {count} readings of {code:g} are taken for none")
    return replace(raw, columns=columns, notes=tuple(notes))


@np.errstate(invalid="ignore")
def _leaps(values: np.ndarray, where: np.ndarray) -> bool:
    """Whether readings (T,) leap where rows ``where`` (T,) begin and end, and rarely elsewhere."""
    steps, ends = np.abs(np.diff(values)), np.diff(where)
    return bool(np.nanmedian(steps[ends]) > _FAR_OFF * np.nanmedian(steps[~ends & ~where[1:]]))


def _filled(raw: RawTrial, clock: Clock) -> RawTrial:
    """The rows before those at the end that a logger made room for and never filled."""
    t = raw.columns.get(clock.column, np.empty(0))
    held = int(np.argmax(t[::-1] != t[-1])) if len(t) else 0
    end = len(t) - held
    if held < _LEAST or not t[-1] < t[end - 1]:
        return raw
    note = f"{held} rows from row {raw.rows[end]} on were never filled: left out"
    return replace(raw.between(0, end), notes=(*raw.notes, note))


def _at_one_rate(raw: RawTrial, clock: Clock) -> RawTrial:
    """The rows with a reading of the first column; others between theirs, if in rows of their own.

    So are logs of several rates: sensors write rows in turn, and leave the cells of others empty.
    """
    t = raw.columns.get(clock.column)
    known = {
        name: np.isfinite(values)
        for name, values in raw.columns.items()
        if name not in (clock.column, clock.nanoseconds)
    }
    some = np.any(list(known.values()), axis=0) if known else np.empty(0)
    sparse = any(_is_sparse(mask[some]) for mask in known.values())
    empty = 1.0 - some.mean() if len(some) else 0.0
    if t is None or clock.nanoseconds or raw.begun or not (sparse or 0.01 < empty < 0.5):
        return raw
    first = next(iter(known))
    rows = known[first] if sparse else some
    columns = {name: values[rows] for name, values in raw.columns.items()}
    remarks = [f"{empty:.0%} of the rows hold nothing of these columns"] if empty > 0.0 else []
    for name, mask in known.items():
        if sparse and mask[rows].mean() < _MOSTLY:
            stamps = t[mask]
            columns[name] = interpolated(t[rows], stamps, raw.columns[name][mask])
            # Between readings that are lost, there is nothing to go by.
            steps = np.diff(stamps)
            after = np.clip(np.searchsorted(stamps, t[rows]), 1, len(steps))
            columns[name][steps[after - 1] > _LOST * np.median(steps)] = np.nan
            remarks.append(
                f"'{name}' stands in rows of its own: interpolated linearly at the times of"
                f" '{first}' (at most {np.max(steps):.3g} s apart)"
            )
    remarks = [*raw.remarks, *remarks]
    return replace(raw, columns=columns, rows=raw.rows[rows], remarks=tuple(remarks))


def _is_sparse(known: np.ndarray) -> bool:
    """Whether readings (T,) come every few rows, steadily."""
    steps = np.diff(np.flatnonzero(known))
    usual = float(np.median(steps)) if len(steps) >= _LEAST else 0.0
    return usual >= 2.0 and float(np.quantile(steps, _MOSTLY)) <= 3.0 * usual


def starts_of(raw: RawTrial, clock: str) -> list[int]:
    """Samples at which the recordings in a file begin: with the header, or time starts again."""
    starts = {0, *raw.begun}
    t = raw.columns.get(clock)
    if t is not None:
        # If time goes on across a header, that is the header of a page.
        ahead = {at: float(t[at] - t[at - 1]) for at in raw.begun}
        usual = float(np.nanmedian(np.diff(t))) if len(t) > 1 else 0.0
        starts -= {at for at, step in ahead.items() if 0.0 < step < _PAGE * usual}
        begin, rolled = 0, unroll(t)[2]
        moving = [values for name, values in raw.columns.items() if name != clock]
        # If a counter merely rolls over, the signals continue.
        rolls = bool(len(rolled)) and all(goes_on(values, rolled) for values in moving)
        for at in () if rolls else np.flatnonzero(np.diff(t) < 0.0) + 1:
            begin = max([start for start in starts if start <= at], default=begin)
            passed = t[at - 1] - t[begin]
            rises = len(t) - at >= _LEAST and bool(np.all(np.diff(t[at : at + _LEAST]) > 0.0))
            back = abs(t[at] - t[begin]) <= _BACK * passed
            # A lone stamp that is wrong leaves those around it in order.
            stays = at >= 2 and at + 1 < len(t) and bool(t[at + 1] < t[at - 2])
            if at - begin >= _LEAST and back and rises and stays:
                starts.add(int(at))
    return sorted(starts)


def _place(column: str, entry: TrialEntry) -> tuple[str, str]:
    """The part that a column belongs to, "" for the trial's file, and its name there."""
    name, colon, bare = column.partition(":")
    if colon and name == entry.part:
        return "", bare
    if colon and any(name == part.name for part in entry.parts):
        return name, bare
    return "", column


def _by_rows(raw: RawTrial, other: RawTrial, entry: TrialEntry, part: Part) -> tuple[int, int, str]:
    """Samples, from and to, in which a part stands beside those of the file; and that in words."""
    counts = len(raw), len(other)
    least, most = min(counts), max(counts)
    if most - least > max(1, MOST_APART * most):
        raise refusal("other_count", part.file, here=counts[1], main=entry.file, there=counts[0])
    remark = f"{part.file} joined to {entry.file} row by row"
    if most > least:
        longer = entry.file if counts[0] == most else part.file
        remark += f"; the last {most - least} of {longer} left out"
    return 0, least, remark


def _by_time(
    raw: RawTrial, other: RawTrial, entry: TrialEntry, part: Part, clock: Clock, time: str
) -> tuple[int, int, str]:
    """As `_by_rows`, of a part whose columns it puts between their samples, by its ``time``."""
    t, u = raw.columns[clock.column], other.columns.pop(time)
    t_0, u_0 = (float(x[np.isfinite(x)][:1].sum()) for x in (t, u))
    ticks = [SECONDS.get(unit, 1.0) for unit in (clock.unit, part.time_unit or clock.unit)]
    at, stamps = (t - t_0) * ticks[0], (u - u_0) * ticks[1]
    if part.join == "time":
        moments = other.since.get(time, 0) - raw.since.get(clock.column, 0)
        stamps += u_0 * ticks[1] - t_0 * ticks[0] + moments / NANOSECONDS
    span = min(np.nanmax(at), np.nanmax(stamps)) - max(np.nanmin(at), np.nanmin(stamps))
    if not span > 0.0:
        raise refusal("no_common_time", part.file, main=entry.file, late=np.nanmin(stamps))
    for name, values in other.columns.items():
        other.columns[name] = interpolated(at, stamps, values)
    remark = f"{part.file} interpolated linearly at the times of {entry.file}"
    remark += f" (at most {np.nanmax(np.diff(stamps)):.3g} s apart)"
    within = np.flatnonzero((at >= np.nanmin(stamps)) & (at <= np.nanmax(stamps)))
    return int(within[0]), int(within[-1]) + 1, remark


def _one_of(raw: RawTrial, entry: TrialEntry, clock: Clock) -> RawTrial:
    """The recording of the file that the trial is."""
    starts = starts_of(raw, clock.column)
    count = len(starts)
    if entry.recording is None and count == 1:
        return raw
    if entry.recording is None or entry.recording > count:
        at = starts[min(1, count - 1)]
        begun = "another recording begins" if at in raw.begun else "time starts again"
        name = "several_recordings" if count > 1 else "one_recording"
        raise refusal(name, f"{entry.file}, row {raw.rows[at]}", begun=begun, count=count)
    said = f"recording {entry.recording} of {count} in the file"
    part = raw.between(*[*starts, len(raw)][entry.recording - 1 : entry.recording + 1])
    return replace(part, remarks=(*raw.remarks, said))


def find_copies(session: Session) -> dict[str, str]:
    """Why trials are refused as the same file or content as another, by their names."""
    same: dict[str, list[TrialEntry]] = defaultdict(list)
    for entry in session.trials:
        try:
            path = inside(session.root, entry.file, where="")
        except InputError:
            continue  # said when the trial's turn comes
        if path.stat().st_size > 0:
            same[digest_file(path)].append(entry)
    reasons: dict[str, str] = {}
    for trials in same.values():
        entries = [e for e in trials if any(e.overlaps(one) for one in trials if one is not e)]
        alike = len({(entry.kind, entry.locked_axis, entry.viscous) for entry in entries}) == 1
        for entry in entries[1:] if alike else entries:
            other = next(e for e in entries if e is not entry)
            what = "file" if other.file == entry.file else "content"
            reasons[entry.name] = f"the same {what} as trial {other.name}" + (
                ": used once" if alike else f", which is declared {other.kind}"
            )
    return reasons


def describe_spans(spans: Mapping[str, Mapping[str, float]]) -> Iterator[str]:
    """Sentences on trials in which an axis goes as much farther as another unit would make it.

    ``spans``: what each axis covers, by name of the trial and of the axis.
    """
    for name, own in spans.items():
        for axis, span in own.items():
            others = [other[axis] for trial, other in spans.items() if trial != name]
            ratio = span / max(float(np.median(others)), 1e-300) if len(others) > 1 else 1.0
            size = max(ratio, 1.0 / max(ratio, 1e-300))
            if any(low < size < 2.0 * low for low in (40.0, 700.0)):
                much = f"{ratio:.3g} times as far as in the others"
                yield f"{name}: {axis} goes {much}: is it logged in another unit?"


def read_sound_trial(
    session: Session, entry: TrialEntry, limits: CleaningLimits, largest_bytes: int
) -> CleanTrial:
    """One sound trial in SI units.

    Raises:
        InputError: the trial is to be set aside, with the reason.
    """
    clock = session.clock
    raw = read_recording(
        session.root, entry, session.columns, clock, session.dialect, largest_bytes
    )
    if clock.nanoseconds:
        columns = dict(raw.columns)
        seconds, fraction = columns[clock.column], columns.pop(clock.nanoseconds)
        # Seconds since 1970 leave no room for nanoseconds in a double: the first goes first.
        columns[clock.column] = seconds - np.fmin.reduce(seconds)
        columns[clock.column] += SECONDS[clock.fraction_unit] * fraction
        raw = replace(raw, columns=columns)
    if not clock.column:
        count = len(raw.columns[session.columns[0]])
        note = f"no time stamps: samples counted at {session.sample_rate:g} Hz"
        raw = replace(
            raw,
            columns={clock.column: np.arange(count, dtype=float), **raw.columns},
            remarks=(*raw.remarks, note),
        )
    trial = clean(raw, session, entry, limits)
    for name in entry.negated:
        known = {column.removeprefix("q_"): column for column in trial.columns}
        check_columns(list(known), [name], f"{entry.file}, negated")
        trial.columns[known[name]] = -trial.columns[known[name]]
        trial.repairs.append(f"{name} negated, as the session says")
    return trial
