"""Survey of a folder of logs, before anyone has said what its columns mean."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from bampipe.data.guesses import MOST_IN_TURN, describe, find_roles, is_time, take_turns
from bampipe.data.log_files import LogFiles
from bampipe.data.names import DRIVERS, FACTOR, REFERENCE_WORDS, role_of, unit_of, words
from bampipe.data.readers import is_text, lerobot
from bampipe.data.readers.trial import Dialect
from bampipe.data.recording import read_recording
from bampipe.data.refusals import refusal
from bampipe.data.session import TrialEntry
from bampipe.data.session.channels import CLOCK_UNITS, Clock
from bampipe.data.stated_rate import intervals_stated
from bampipe.data.units import spelled, unit
from bampipe.data.vocabulary import VOCABULARY
from bampipe.errors import InputError
from bampipe.lists import join_names

_ON_CIRCLE = 0.01
"""Largest deviation of two readings from a cosine and a sine."""
_RISES = 0.8
"""Share of samples at which a clock rises, if what else it does is an accident."""


@dataclass(frozen=True)
class SurveyedColumn:
    """One column that all logs of a folder have.

    Attributes:
        name: as the reader calls it.
        stated: unit that the file gives, "" if it gives none.
        role: time, position, velocity, acceleration, force, current, voltage, brake, reference,
            or "".
        unit: unit by the file, else by the name, "" if neither says.
        values: (T,) of the first log.
        by_looks: whether its name says nothing and its role is what it looks like.
        quantity: what the file calls that of which it gives this unit.
    """

    name: str
    stated: str
    role: str
    unit: str
    values: np.ndarray
    by_looks: bool = False
    quantity: str = ""

    @property
    def si(self) -> str | None:
        """SI unit of its quantity; None if it has no known unit."""
        known = unit(self.unit) if self.unit else None
        return known.si if known is not None else None

    @property
    def scale(self) -> float:
        """What makes SI of its values, 1 where that is not known."""
        known = unit(self.unit)
        return known.scale if known is not None else 1.0

    @property
    def is_foreign(self) -> bool:
        """Whether the file states a unit that is not known."""
        return bool(self.stated) and self.si is None

    @property
    def is_integer(self) -> bool:
        """Whether all values are integers, as counts are."""
        known = self.values[np.isfinite(self.values)]
        return bool(len(known)) and bool(np.all(known == np.rint(known)))

    @property
    def is_constant(self) -> bool:
        """Whether the value never changes."""
        known = self.values[np.isfinite(self.values)]
        return len(known) == 0 or bool(np.ptp(known) == 0.0)

    @property
    def may_number_rows(self) -> bool:
        """Whether it rises by 1 a row, and nothing says that this is a time."""
        timed = self.si == "s" or self.unit == "datetime"
        return not timed and bool(np.all(np.diff(self.values) == 1.0))


@dataclass(frozen=True)
class Survey:
    """The logs of a folder.

    Attributes:
        trials: the recordings that have the same columns, of one file or of several.
        columns: what they hold, from the first of them.
        remarks: what was guessed about them, a sentence each.
        passed: other files, and why each is left out.
        intervals: between samples, s, that files state where no column has the time, by file and
            name of the number.
    """

    trials: tuple[TrialEntry, ...]
    columns: tuple[SurveyedColumn, ...]
    remarks: tuple[str, ...]
    passed: tuple[tuple[str, str], ...]
    intervals: Mapping[str, float] = field(default_factory=dict)

    def of(self, *roles: str) -> list[SurveyedColumn]:
        """The columns with one of these roles."""
        return [column for column in self.columns if column.role in roles]


def survey(folder: Path, names: Sequence[str] = (), episodes: str = "") -> Survey:
    """Look through the logs in ``folder`` and the folders in it.

    ``names``: of the columns of texts without a header; ``episodes``: see `lerobot.find_episodes`.

    Raises:
        InputError: no such folder, no log in it, too many, or none that can be read.
    """
    logs = LogFiles(folder, Dialect(names=tuple(names)), lerobot.find_episodes(folder, episodes))
    logs.look_through()
    trials, common = logs.choose()
    read: tuple[SurveyedColumn, ...] = ()
    beside: dict[str, str] = {}
    sound = []
    for trial in trials:
        try:
            several = logs.recordings(trial)
            read, beside = (read, beside) if read else _read(logs, several[0], common)
            sound += several
        except InputError as error:
            logs.passed.append((trial.file, str(error)))
    if not read:
        raise logs.fault()
    known, said = _of_angles(read)
    columns, guessed = _by_looks(_with_commands(known), folder)
    # The first unit of a quantity is that of the first column which looks like it.
    units = [(x, u) for x, u in reversed(beside.items()) if unit(u) is not None]
    of: dict[str, Any] = {role_of(x, u): {"quantity": x, "unit": u} for x, u in units}
    columns = tuple(
        replace(c, **of.pop(c.role), by_looks=False) if c.by_looks and c.role in of else c
        for c in columns
    )
    if logs.episodes is not None:
        logs.remarks = [VOCABULARY["remarks"]["lerobot"]]
    remarks = (*logs.remarks, *said, *guessed)
    times = [c for c in columns if c.role == "time"]
    timed = any(not (c.is_constant or c.may_number_rows) for c in times)
    stated = {} if timed else intervals_stated(folder, {trial.file for trial in sound})
    return Survey(tuple(sound), columns, remarks, tuple(logs.passed), stated)


def _read(
    logs: LogFiles, trial: TrialEntry, wanted: Sequence[str]
) -> tuple[tuple[SurveyedColumn, ...], dict[str, str]]:
    """The columns of one recording, and units of quantities that are no columns."""
    labels = logs.labels(trial)
    times = [column for column in wanted if role_of(column, labels[column]) == "time"]
    moments = [column for column in times if labels[column] == "datetime"]
    dropped = [c for c in wanted if labels[c] == "datetime" and c not in moments[:1]]
    # A reader of several topics takes the first column for the time.
    ordered = sorted((c for c in wanted if c not in dropped), key=lambda c: c not in times)
    clock = Clock(unit="samples")
    if times:
        column = (moments or times)[0]
        said = "datetime" if moments else spelled(labels[column], CLOCK_UNITS)
        clock = Clock(column=column, unit=next((u for u in CLOCK_UNITS if u == said), "s"))
    # If there are several rates, that of the positions counts.
    first = sorted(ordered, key=lambda c: (c not in times, role_of(c, labels[c]) != "position"))
    raw = read_recording(logs.folder, trial, first, clock, logs.dialect)
    sound = _complete_rows(raw.columns, clock.column)
    if not (trial.parts or trial.recording or is_text(trial.file)):
        logs.remarks += raw.remarks
    # Times of one name, beside the readings that each is of.
    times = [c for c in times if c in raw.columns]
    end = {c: re.sub(r" \(\d+\)$", "", c).rpartition(".")[2] for c in times}
    for one, other in combinations(times if times and times[0][:1] != "/" else (), 2):
        here, there = (raw.columns[c][sound] for c in (one, other))
        step = abs(np.nanmedian(np.diff(here))) if len(here) > 1 else 0.0
        if end[one] == end[other] and step and np.nanmax(np.abs(here - there)) > step:
            raise refusal("own_times", trial.file, one=one, other=other)
    found = []
    # Elsewhere, _in may be an input.
    imperial = any(re.search(r"(\b|_)(lbs?|lbf|kip|psi)\b", f"{c} {labels[c]}") for c in ordered)
    for column in ordered:
        said = raw.units.get(column, labels[column])
        role = role_of(column, said)
        if role and clock.column != column and re.search(r":column_\d+$|\[0\]$|^t_", column):
            # A column without a header, or of a matrix, may be named after the others; t_tau too.
            role = "time" if is_time(raw.columns[column][sound]) else role
        # The number of a message is named by its topic, like the readings beside it.
        own, steps = role_of(re.split("[:.]", column)[-1], said), np.diff(raw.columns[column])
        counts = len(steps) > 3 and np.ptp(steps) < 1e-6 * np.min(steps)
        role = "" if counts and role not in ("time", "reference", own) else role
        unit = unit_of(column, said, role)
        if imperial and role == "position" and column.endswith("_in"):
            unit = unit or "in"
        factor = FACTOR.search(column)
        if unit and factor and factor[0] not in unit:
            unit = said = f"{unit}, {factor[0].strip('_. (')}"
        found.append(SurveyedColumn(column, said, role, unit, raw.columns[column][sound]))
    keys = [c.values for c in found if c.is_integer and c.role not in ("time", "position")]
    nameless = [c for c in found if not c.role and len(np.unique(c.values)) > MOST_IN_TURN]
    moves = [c for c in found if c.role == "position"] or nameless
    for moved in (c for c in moves if take_turns(c.values, keys)):
        signal = "" if moved.role else " or signal"
        raise refusal("in_turn", trial.file, column=moved.name, signal=signal)
    beside = {x.rpartition(":")[2]: u for x, u in raw.units.items() if x not in raw.columns}
    return tuple(found), beside


def _complete_rows(columns: Mapping[str, np.ndarray], clock: str) -> np.ndarray:
    """Rows (T,) in which no column lacks a number, those columns apart that mostly lack one.

    Of a clock that nearly always increases, only rows in which it does.
    """
    known = [np.isfinite(values) for values in columns.values()]
    if clock in columns:
        t = np.nan_to_num(columns[clock], nan=-np.inf)
        rises = np.concatenate([[True], t[1:] > np.maximum.accumulate(t)[:-1]])
        known += [rises] if rises.mean() > _RISES else []
    kept = [mask for mask in known if 2 * mask.sum() > len(mask)]
    complete = np.logical_and.reduce(kept) if kept else np.ones(len(known[0]), dtype=bool)
    return complete if 2 * complete.sum() > len(complete) else np.ones_like(complete)


def _by_looks(
    columns: tuple[SurveyedColumn, ...], folder: Path
) -> tuple[tuple[SurveyedColumn, ...], list[str]]:
    """Columns whose names say nothing with the roles that they look like, and that in words.

    InputError where no column has a name, and none looks like a position.
    """
    # Volts are those of any sensor.
    nameless = (c for c in columns if not role_of(c.name, "" if c.si == "V" else c.stated))
    unnamed = [c for c in nameless if not c.is_constant]
    if any(c.role in ("position", "velocity") for c in columns) or not unnamed:
        return columns, []
    times = [c.values for c in columns if c.role == "time" and not c.is_constant]
    roles = find_roles({c.name: c.values for c in unnamed}, times[0] if times else None)
    if any(c.role in DRIVERS for c in columns):
        roles = {name: role for name, role in roles.items() if role != "force"}
    if "position" not in roles.values():
        numbered = (re.fullmatch(r"(.*:)?column_\d+", c.name) for c in columns)
        if len(unnamed) < len(columns) or not all(numbered):
            return columns, []
        listed = ", ".join(describe(c.name, c.values) for c in columns[:12])
        raise refusal("nameless", str(folder), listed=listed)
    named: dict[str, list[str]] = {}
    for name, role in roles.items():
        named.setdefault("what drives the motion" if role == "force" else role, []).append(name)
    said = "; ".join(f"{role}: {join_names(names, 4)}" for role, names in named.items())
    way = " (--names gives some)" * (columns[0].name == "column_1")
    guessed = f"columns without names{way} by what they look like: {said}"
    return tuple(
        replace(c, role=roles[c.name], by_looks=True) if c.name in roles else c for c in columns
    ), [guessed]


def _of_angles(columns: Sequence[SurveyedColumn]) -> tuple[list[SurveyedColumn], list[str]]:
    """The columns, cosines and sines of one angle without a role, and these in words."""
    within = [c for c in columns if re.search("(?i)cos|sin", c.name) and not c.is_constant]
    off = [(x, y, np.hypot(x.values, y.values) - 1.0) for x, y in combinations(within, 2)]
    pairs = [(x.name, y.name) for x, y, each in off if np.max(np.abs(each)) < _ON_CIRCLE]
    said = VOCABULARY["remarks"]["circle"]
    parts = {name for pair in pairs for name in pair}
    plain = [replace(c, role="") if c.name in parts else c for c in columns]
    return plain, [said.format(one=one, other=other) for one, other in pairs]


def _with_commands(columns: list[SurveyedColumn]) -> tuple[SurveyedColumn, ...]:
    """The columns, with commanded forces, currents or voltages for inputs if none was measured.

    Many controllers log what they ask of the drive and nothing of what it gives. Beside a measured
    one, the command is a reference like that of a position; but beside one force, the current that
    is asked of the coil of a brake or damper is all that tells of it.
    """
    measured = [column.role for column in columns if column.role in DRIVERS]
    wanted = ("current",) if measured == ["force"] else () if measured else DRIVERS
    found = []
    for column in columns:
        bare = "_".join(word for word in words(column.name) if word not in REFERENCE_WORDS)
        role = role_of(bare, column.stated)
        commands = column.role == "reference" and role in wanted
        found.append(replace(column, role=role) if commands else column)
    return tuple(found)
