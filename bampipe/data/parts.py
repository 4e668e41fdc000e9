"""Which files of a folder are parts of one recording, by their names, lengths and clocks."""

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import and_
from pathlib import Path
from typing import Literal, cast

import numpy as np

from bampipe.data import guesses
from bampipe.data.names import role_of
from bampipe.data.readers import read_trial
from bampipe.data.readers.moments import NANOSECONDS
from bampipe.data.readers.trial import Dialect, RawTrial
from bampipe.data.recording import MOST_APART
from bampipe.data.refusals import refusal
from bampipe.data.session import Part, TrialEntry
from bampipe.data.session.channels import SECONDS, TimeUnit
from bampipe.errors import InputError

Columns = Mapping[str, str]
_AXIS = re.compile(r"(?i)(?<![a-z])(joint|axis|link|servo|motor|dof|j)[ _-]?(\d+)(?!\d)")
_LONGEST = 40
"""Letters in the name of a part."""
_SAME_STAMP = 0.6
"""Share of a step by which two clocks may stamp the same samples differently."""
_OVERLAP = 0.5
"""Share of the shorter part that both must have in common on one clock."""
_TOO_FEW = 100
"""Samples of one part for one of another, beyond which nothing between those is known."""
_SAME_LENGTH = 0.2
"""Share by which lengths may differ of parts whose clocks are taken to start together."""


@dataclass(frozen=True)
class FileClock:
    """The time of one file.

    Attributes:
        samples: how many it has; column: its time column, "" if there is none; unit: of that.
        t: (T,) s; start: its first stamp, s, on a clock that files may share.
    """

    samples: int
    column: str = ""
    unit: str = ""
    t: np.ndarray | None = None
    start: float = 0.0


def join_parts(
    folder: Path, found: Mapping[str, Columns], dialect: Dialect
) -> tuple[list[TrialEntry], list[str]]:
    """Put together the files that are one recording.

    Args:
        folder, dialect: of the logs; found: columns and their units by file.

    Returns:
        The recordings, none where no files belong together, and for each file that seems to but
        does not fit, a sentence why.
    """
    if len(found) < 2:
        return [], []
    in_name = {name: _words(Path(name).name) for name in found}
    said = {
        name: tuple(w for w in own if _AXIS.fullmatch(w) or role_of(w, "") not in ("", "time"))
        for name, own in in_name.items()
    }
    # Files of a kind have the same columns, and the same quantities or axes in their names.
    kinds = {name: (frozenset(columns), said[name]) for name, columns in found.items()}
    # Words that all files of a kind have; numbers, if there are several, tell trials apart.
    own = {
        kind: reduce(and_, (Counter(_words(n)) for n in found if kinds[n] == kind))
        for kind in set(kinds.values())
    }
    shared = reduce(and_, own.values())
    groups: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for name, kind in kinds.items():
        words = Counter(w for w in _words(name) if w not in said[name]) - own[kind]
        groups[tuple(words.elements())].append(name)
    trials, reasons = [], []
    for names in groups.values():
        if len({kinds[name] for name in names}) != len(names) or len(names) < 2:
            continue
        called: dict[str, str] = {}
        for n in names:
            beyond = own[kinds[n]] - shared
            name = _called([w for w in own[kinds[n]] if w in beyond or w in said[n]])
            called[n] = f"{name}_{len(called)}" if name in called.values() else name
        roles = {n: {role_of(f"{called[n]}:{c}", u) for c, u in found[n].items()} for n in names}
        main = max(names, key=lambda n: ("position" in roles[n], -names.index(n)))
        parts, alike = [], set()
        own_clock = _read_clock(folder, main, found[main], dialect)
        for other in names:
            if other == main:
                continue
            clock = _read_clock(folder, other, found[other], dialect, own_clock)
            try:
                parts.append(_part(main, other, called[other], own_clock, clock))
            except InputError as error:
                turns, rest = divmod(own_clock.samples, clock.samples)
                if roles[other] == {"time"} and turns > 1 and rest == 0:
                    raise refusal("rows_in_turn", main, turns=turns, other=other) from error
                reasons.append(str(error))
                continue
            alike |= set(found[other]) & set(found[main]) - {own_clock.column}
        if parts:
            named = called[main] if alike else ""
            trials.append(TrialEntry(file=main, kind="free", part=named, parts=tuple(parts)))
    return trials, reasons


def read_columns(
    folder: Path, name: str, columns: Columns, wanted: Sequence[str], dialect: Dialect
) -> RawTrial:
    """Columns ``wanted`` of a file with ``columns``, of which those of moments become seconds."""
    moments = {column: "" for column in wanted if columns[column] == "datetime"}
    return read_trial(folder / name, wanted, name=name, datetimes=moments, dialect=dialect)


def axes_of(names: Sequence[str]) -> dict[str, str]:
    """The axis in each name of a file, such as ``joint1.csv``; none unless they differ by it."""
    bare = {_AXIS.sub("", name) for name in names}
    found = {name: match[0] for name in names if (match := _AXIS.search(name))}
    return found if len(bare) < len(names) == len(found) else {}


def _words(name: str) -> list[str]:
    """Words and numbers of a path without its extension; an axis with its number is one."""
    parts = re.findall(
        r"(?:joint|axis|link|servo|motor|dof|j)\d+|[A-Z]?[a-z]+|[A-Z]+|\d+",
        _AXIS.sub(lambda axis: f" {axis[1].lower()}{axis[2]} ", name.rpartition(".")[0]),
    )
    return [part.lower() for part in parts]


def _called(words: Iterable[str]) -> str:
    """Name of a part by words that its kind of file has in its name and others have not."""
    name = "_".join(words)
    return name[:_LONGEST] if re.match("[a-z]", name) else f"part_{name}".rstrip("_")[:_LONGEST]


def _part(main: str, other: str, called: str, first: FileClock, second: FileClock) -> Part:
    """Choose the join of ``other`` to ``main``; InputError if neither length nor clock shows it."""
    counts = sorted((first.samples, second.samples))
    rows = counts[1] - counts[0] <= max(1, MOST_APART * counts[1])
    join: Literal["rows", "time", "start", ""] = "rows" if rows else ""
    why = "no clock in common"
    if first.t is not None and second.t is not None:
        length, step = min(len(first.t), len(second.t)), float(np.median(np.diff(first.t)))
        apart = float(np.max(np.abs(first.t[:length] - second.t[:length])))
        same = rows and apart <= _SAME_STAMP * step
        ends = (first.start + first.t[-1], second.start + second.t[-1])
        overlap = min(ends) - max(first.start, second.start)
        spans = sorted((float(first.t[-1]), float(second.t[-1])))
        if not same:
            alike = _alike(*spans)
            join = "time" if overlap >= _OVERLAP * spans[0] else "start" if alike else ""
            if _TOO_FEW * counts[0] < counts[1]:
                join, why = "", "these are too few"
    if not join:
        of = {"here": second.samples, "main": main, "there": first.samples, "why": why}
        raise refusal("no_part", other, **of)
    timed = join != "rows"
    return Part(
        file=other,
        name=called,
        join=join,
        time=second.column if timed and second.column != first.column else "",
        time_unit=cast(TimeUnit, second.unit) if timed and second.unit != first.unit else "",
    )


def _alike(*lengths: float) -> bool:
    return min(lengths) >= (1.0 - _SAME_LENGTH) * max(lengths)


def _read_clock(
    folder: Path,
    name: str,
    columns: Columns,
    dialect: Dialect,
    beside: FileClock | None = None,
) -> FileClock:
    """The clock of a file, in the unit in which it lasts as long as one ``beside`` if unstated."""
    times = [column for column, unit in columns.items() if role_of(column, unit) == "time"]
    raw = read_columns(folder, name, columns, times or list(columns)[:1], dialect)
    for column in times:
        stamps = raw.columns[column]
        known = stamps[np.isfinite(stamps)]
        if len(known) > 1 and float(np.mean(np.diff(known) > 0)) > 0.9 and len(known) == len(raw):
            unit, length = guesses.time_unit(stamps, columns[column]), float(known[-1] - known[0])
            if beside is not None and beside.t is not None and not columns[column]:
                sizes = {u: SECONDS[u] * length for u in (unit, *SECONDS) if u in SECONDS}
                unit = next((u for u, x in sizes.items() if _alike(x, beside.t[-1])), unit)
            tick = SECONDS.get(unit, 1.0)
            start = raw.since.get(column, 0) / NANOSECONDS or float(known[0]) * tick
            return FileClock(len(raw), column, unit, (stamps - known[0]) * tick, start)
    return FileClock(len(raw))
