"""The table ``[time]`` and the sample rate, from the columns that increase as a clock does."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from bampipe.data import guesses
from bampipe.data.quality.clock import spread_stamps, unroll
from bampipe.data.session import SECONDS
from bampipe.data.survey import Survey, SurveyedColumn, words
from bampipe.data.units import spelled
from bampipe.errors import InputError
from bampipe.setup.proposal.notes import UNKNOWN, Notes, quoted

_RECORDED = ":@time"
"""End of the name under which the reader of ROS bags has the time of recording."""
_LIKELY_RATE_HZ = 100.0
"""Assumed for the other guesses where nothing shows the rate."""
_COUNTERS = frozenset(["tick", "ticks", "cycle", "cycles", "timestep", "timesteps", "cyccnt"])
"""Words in the name of a clock that counts at a rate of its own."""
_SECONDS = {"sec", "secs", "seconds"}
_NANOSECONDS = {"nanosec", "nsec", "nsecs", "nanosecs", "nanoseconds"}
_FALLING = 0.9
"""Share of steps at which the time of a log that is written backwards falls, the least."""
_SLOW_HZ = 40.0
"""Below, accelerations of a joint that stops within a tenth of a second are not seen."""
_OF_ROWS = (
    "the logger's set-up has it; else the number of rows over the seconds that the recording took"
)


@dataclass(frozen=True)
class ProposedClock:
    """The time of the first log, and how the session file says it.

    Attributes:
        t: (T,) time stamps, s.
        columns: names of the columns that the time takes up.
        lines: the table ``[time]``.
        rate: the line on the sample rate, which stands above all tables.
    """

    t: np.ndarray
    columns: tuple[str, ...]
    lines: tuple[str, ...]
    rate: str


def clock_of(found: Survey, notes: Notes) -> ProposedClock:
    """Propose a clock: by stamps in one column or two, else by counting samples."""
    counters = [c for c in found.columns if not c.role and not _COUNTERS.isdisjoint(words(c.name))]
    unnamed = [c for c in found.columns if not c.role and c not in counters and _counts_on(c)]
    times = [*found.of("time"), *counters, *unnamed]
    whole = [(c, {*words(c.name)}) for c in times if c.is_integer]
    seconds = [c for c, said in whole if said & _SECONDS and np.all(np.diff(c.values) >= 0)]
    on_top = [c for c, said in whole if said & _NANOSECONDS]
    rest = [c for c in on_top if np.all((c.values >= 0) & (c.values < 1e9))]
    if seconds and rest:
        return _in_two_columns(seconds[-1], rest[-1], notes)
    # When a message was recorded is the second best to when it was stamped.
    topics = {c.name.partition(":")[0] for c in found.of("position") if c.name[:1] == "/"}

    def rank(c: SurveyedColumn) -> tuple[bool, bool, bool]:
        # Motion that is interpolated is worse off than what drives it.
        beside = c.name.partition(":")[0] in topics or not topics
        return c.name.endswith(_RECORDED), "stamp" not in words(c.name), not beside

    stamped = [*sorted(found.of("time"), key=rank), *counters, *unnamed]
    column = next((c for c in stamped if _increases(c.values)), None)
    return _counted(found, notes) if column is None else _in_one_column(column, notes)


def _in_one_column(column: SurveyedColumn, notes: Notes) -> ProposedClock:
    start = column.values[np.isfinite(column.values)][0]
    stamps = column.values - start
    known, rows = np.isfinite(stamps), np.arange(len(stamps))
    stamps = np.interp(rows, rows[known], spread_stamps(unroll(stamps[known])[0])[0])
    named = f"column = {quoted(column.name)}"
    counter = not _COUNTERS.isdisjoint(words(column.name)) or column.role != "time"
    kind = "" if counter else guesses.time_unit(stamps + start, column.unit)
    tick = re.search(r"(?<!\d)(\d+) ?_?(ns|us|ms)(?![A-Za-z])", column.name)
    if counter and tick:
        size = float(tick[1]) * SECONDS[tick[2]]
        note = notes.guess(f"a count of {column.name} is {tick[0]}, by its name")
        table = _table(named, 'unit = "ticks"', f"ticks_per_s = {1.0 / size:.10g}{note}")
        rate = _stamped_rate(guesses.sample_rate(stamps * size), notes)
        return ProposedClock(stamps * size, (column.name,), table, rate)
    if not kind:
        if counter:
            step = float(np.median(np.diff(stamps)))
            note = notes.ask(
                f"ticks_per_s, what {column.name} counts in a second, and sample_rate_hz, a"
                f" {step:.6g}th of it",
                "the clock of the timer or processor, in its data sheet or firmware; else what it"
                " counted over the seconds that the recording took",
            )
            table = _table(named, 'unit = "ticks"', f"ticks_per_s = 0.0{note}")
        else:
            note = notes.ask("the unit of time: no unit gives a likely rate", _OF_ROWS)
            table = _table(named, f'unit = "{UNKNOWN}"{note}')
        rate = f'sample_rate_hz = "{UNKNOWN}"'
        samples = np.arange(len(stamps)) / _LIKELY_RATE_HZ
        return ProposedClock(samples, (column.name,), table, rate)
    t = stamps * SECONDS.get(kind, 1.0)
    said = kind == "datetime" or spelled(column.unit, tuple(SECONDS)) == kind
    note = "" if said else notes.guess(f"time in {kind}, by the rate that it gives")
    rate = _stamped_rate(guesses.sample_rate(t), notes)
    return ProposedClock(t, (column.name,), _table(named, f'unit = "{kind}"{note}'), rate)


def _in_two_columns(seconds: SurveyedColumn, rest: SurveyedColumn, notes: Notes) -> ProposedClock:
    """Whole seconds and the nanoseconds on top of them, as ROS has them."""
    t = seconds.values - seconds.values[0] + 1e-9 * (rest.values - rest.values[0])
    rate_hz = guesses.sample_rate(t)
    note = notes.guess(f"seconds in {seconds.name}, nanoseconds on top in {rest.name}")
    lines = (
        f"column = {quoted(seconds.name)}",
        'unit = "s"',
        f"nanoseconds = {quoted(rest.name)}{note}",
    )
    return ProposedClock(
        t, (seconds.name, rest.name), _table(*lines), _stamped_rate(rate_hz, notes)
    )


def _counted(found: Survey, notes: Notes) -> ProposedClock:
    """No column is a clock; a number beside the samples may give the rate."""
    samples = np.arange(len(found.columns[0].values))
    steps = [
        (guesses.interval_of(column.name, float(column.values[0])), column.name)
        for column in found.columns
        if column.is_constant
    ]
    step_s, name = max(steps, default=(0.0, ""))
    if step_s > 0.0:
        note = notes.guess(f"samples are counted, and {name} sets the rate")
        rate = f"sample_rate_hz = {1.0 / step_s:g}"
        return ProposedClock(step_s * samples, (name,), _table(f'unit = "samples"{note}'), rate)
    stamps = next((column for column in found.of("time") if not column.is_constant), None)
    if stamps is not None and _FALLING < np.mean(np.diff(stamps.values) < 0.0):
        raise InputError(
            f"{stamps.name} falls from row to row: the log is written backwards",
            where=found.trials[0].file,
            remedy="turn the order of its rows round",
        )
    why = "no column increases like a time" if stamps is None else _describe_stamps(stamps)
    note = notes.guess(f"samples are counted: {why}")
    rate = f'sample_rate_hz = "{UNKNOWN}"' + notes.ask("sample_rate_hz, rows a second", _OF_ROWS)
    return ProposedClock(samples / _LIKELY_RATE_HZ, (), _table(f'unit = "samples"{note}'), rate)


def _describe_stamps(column: SurveyedColumn) -> str:
    """Why the stamps of a column that is called a time are none."""
    steps = np.diff(column.values[np.isfinite(column.values)])
    falls, stops = int(np.sum(steps < 0)), int(np.sum(steps == 0))
    what = f"falls at {falls}" if falls > stops else f"does not change at {stops}"
    return f"{column.name} {what} of {len(steps)} steps"


def _counts_on(column: SurveyedColumn) -> bool:
    """Whether a column whose name says nothing rises evenly, otherwise than as a number of rows."""
    steps = np.diff(column.values)
    rises = len(steps) > 3 and bool(np.all(steps > 0.0))
    return rises and bool(np.ptp(steps) < np.median(steps)) and float(np.median(steps)) != 1.0


def _table(*lines: str) -> tuple[str, ...]:
    return ("[time]", *lines, "")


def _stamped_rate(rate_hz: float, notes: Notes) -> str:
    slowest, fastest = guesses.RATES_HZ
    doubt = "" if rate_hz > _SLOW_HZ else "; too slow for inertia and quick reversals: log faster"
    if not slowest <= rate_hz <= fastest:
        doubt = "; motion is not logged so: is its unit right?"
    note = notes.guess(f"{rate_hz:g} Hz, from the time stamps{doubt}")
    return f"sample_rate_hz = {rate_hz:g}{note}"


def _increases(values: np.ndarray) -> bool:
    known = values[np.isfinite(values)]
    known = spread_stamps(unroll(known)[0])[0] if len(known) > 3 else known
    return len(known) > 3 and float(np.mean(np.diff(known) > 0)) > 0.9
