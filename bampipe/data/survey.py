"""Survey of a folder of logs, before anyone has said what its columns mean."""

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from bampipe.data import readers
from bampipe.data.guesses import MOST_IN_TURN, describe, find_roles, is_time, take_turns
from bampipe.data.names import DRIVERS, FACTOR, REFERENCE_WORDS, role_of, unit_of, words
from bampipe.data.parts import axes_of, join_parts
from bampipe.data.readers import columns_of, extension_of, is_log, is_text, lerobot, read_trial
from bampipe.data.readers.trial import Dialect, RawTrial
from bampipe.data.recording import read_recording, starts_of
from bampipe.data.refusals import refusal
from bampipe.data.session import Clock, TrialEntry
from bampipe.data.session.channels import CLOCK_UNITS
from bampipe.data.session.file import lexically_inside
from bampipe.data.stated_rate import intervals_stated, units_stated
from bampipe.data.units import RecordedUnit, spelled, unit
from bampipe.data.vocabulary import VOCABULARY, by_word, word_set
from bampipe.errors import InputError
from bampipe.lists import join_names

MOST_FILES = 500
_MOST_COLUMNS = 500
"""Of a table of samples, unless it has many rows."""
_OTHER_DATA = by_word("unreadable")
"""What to do with files of data that are not read."""
_SMALL = 1 << 16
"""Bytes below which a text may be no log but a line of results."""
_MOST_SCANNED = 1 << 30
"""Bytes of text in which other recordings are looked for; reading them takes some seconds."""
_OTHER = "other columns, for another session"
_WHOLE = 2
"""Of logs that hold both a motion and what drives it."""
_ON_CIRCLE = 0.01
"""Largest deviation of two readings from a cosine and a sine."""
_RISES = 0.8
"""Share of samples at which a clock rises, if what else it does is an accident."""
_AXES = word_set("axes")
"""Words for the column that tells of which axis a row is."""
_ASKED = word_set("asked")
_TWINS = _ASKED | word_set("measured")
"""Words in the name of a file of what was asked for, and in that of the measurement beside it."""
_JOINED = {"rows": "row by row", "time": "by their times", "start": "as if begun together"}


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
    def conversion(self) -> RecordedUnit | None:
        """Conversion of its unit to SI; None if it has no known unit."""
        return unit(self.unit) if self.unit else None

    @property
    def si(self) -> str | None:
        """SI unit of its quantity; None if that is unknown."""
        return self.conversion.si if self.conversion is not None else None

    @property
    def scale(self) -> float:
        """What makes SI of its values, 1 where that is not known."""
        return self.conversion.scale if self.conversion is not None else 1.0

    @property
    def is_foreign(self) -> bool:
        """Whether the file states a unit that is not known."""
        return bool(self.stated) and self.conversion is None

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
    wanted = lerobot.find_episodes(folder, episodes)
    logs = _Logs(folder, Dialect(names=tuple(names)), wanted)
    logs.look_through([folder / file for file in wanted] if wanted else logs.paths())
    logs.hear_notes()
    trials, common = logs.choose()
    read: tuple[SurveyedColumn, ...] = ()
    sound = []
    for trial in trials:
        try:
            several = logs.recordings(trial)
            read = read or logs.read(several[0], common)
            sound += several
        except InputError as error:
            logs.passed.append((trial.file, str(error)))
    if not read:
        raise logs.fault()
    known, said = _of_angles(read)
    columns, guessed = _by_looks(_with_commands(known), folder)
    # The first unit of a quantity is that of the first column which looks like it.
    units = [(x, u) for x, u in reversed(logs.beside.items()) if unit(u) is not None]
    beside: dict[str, Any] = {role_of(x, u): {"quantity": x, "unit": u} for x, u in units}
    columns = tuple(
        replace(c, **beside.pop(c.role), by_looks=False) if c.by_looks and c.role in beside else c
        for c in columns
    )
    if wanted is not None:
        logs.remarks = [VOCABULARY["remarks"]["lerobot"]]
    remarks, timed = (*logs.remarks, *said, *guessed), any(c.role == "time" for c in columns)
    stated = {} if timed else intervals_stated(folder, {trial.file for trial in sound})
    return Survey(tuple(sound), columns, remarks, tuple(logs.passed), stated)


@dataclass
class _Logs:
    """The files of a folder while it is found out which are logs, and which belong together.

    ``episodes``: see `lerobot.find_episodes`; ``found``: columns and their units, by file;
    ``passed``, ``remarks``: see `Survey`; ``beside``: units of quantities that are no columns.
    """

    folder: Path
    dialect: Dialect
    episodes: Mapping[str, Sequence[int]] | None = None
    found: dict[str, dict[str, str]] = field(default_factory=dict)
    passed: list[tuple[str, str]] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    beside: dict[str, str] = field(default_factory=dict)
    scanned: int = 0

    def paths(self) -> list[Path]:
        """The files that may be logs; others that hold data are left out by name."""
        folder = self.folder
        if not folder.is_dir():
            raise InputError("no such folder", where=str(folder))
        files = sorted(
            path
            for path in folder.rglob("*")
            if path.is_file()
            and not any(part.startswith(".") for part in path.relative_to(folder).parts)
        )
        other = {p: end for p in files if (end := extension_of(p.name)) in _OTHER_DATA}
        paths = [path for path in files if path not in other and is_log(path)]
        for path, end in other.items():
            why = f"*{end} is not read: {_OTHER_DATA[end]}"
            self.passed.append((path.relative_to(folder).as_posix(), why))
        if not paths:
            others = [p.relative_to(folder).as_posix() for p in files]
            names = join_names([name for name, _ in self.passed] or others, 4)
            but = names and f" that can be read, but {names}"
            remedy = f"supported file extensions are {', '.join(readers.EXTENSIONS)}"
            remedy = next((why for _, why in self.passed), remedy)
            raise InputError(f"no log in this folder{but}", where=str(folder), remedy=remedy)
        if len(paths) > MOST_FILES:
            raise InputError(f"{len(paths)} logs are more than {MOST_FILES}", where=str(folder))
        return paths

    def look_through(self, paths: Sequence[Path]) -> None:
        """Find the columns of every file; files that are no logs are left out, with the reason."""
        for path in paths:
            name = path.relative_to(self.folder).as_posix()
            try:
                lexically_inside(name, where="")
                columns = columns_of(path, name=name, dialect=self.dialect)
                if not columns:
                    raise InputError(f"no table: no column of numbers in it{_like(path)}")
                small = path.stat().st_size < _SMALL and is_text(name)
                wide, first = len(columns) > _MOST_COLUMNS, next(iter(columns))
                rows = len(self._read_one(name, columns, first)) if small or wide else 2
                if wide and 0 < 10 * rows < len(columns):
                    raise refusal("wide", rows=rows, columns=len(columns))
                if small and rows < 2:
                    raise InputError("one row of numbers is no log")
                self.found[name] = columns
            except InputError as error:
                self.passed.append((name, str(error)))
        if not self.found:
            raise self.fault()

    def hear_notes(self) -> None:
        """Give columns that state no unit that of notes beside the logs."""
        known = {(c, u) for own in self.found.values() for c, u in own.items()}
        unsaid = {c for c, u in known if not u and not unit_of(c, "", role_of(c, ""))}
        said = units_stated(self.folder, self.found, unsaid)
        for own in self.found.values():
            own |= {c: said[c][0] for c, u in own.items() if c in said and not u}
        self.remarks += [f"{c} is in {u}, as {file} says" for c, (u, file) in sorted(said.items())]

    def _read_one(self, name: str, columns: Mapping[str, str], *wanted: str) -> RawTrial:
        moments = {column: "" for column in wanted if columns[column] == "datetime"}
        return read_trial(
            self.folder / name, wanted, name=name, datetimes=moments, dialect=self.dialect
        )

    def fault(self) -> InputError:
        """Error that no log can be read, with the reason of the first."""
        # The reasons of files that are no logs say least.
        idle = ("*", "no table", "one row", "other columns")
        name, why = min(
            self.passed,
            key=lambda p: next((k for k, x in enumerate(idle) if p[1].startswith(x)), -1),
        )
        remedy = why if name in why else f"{name}: {why}"
        if "a line reads" in why:
            remedy += "; export rows of numbers below a line of names"
        return InputError("no log that can be read", where=str(self.folder), remedy=remedy)

    def choose(self) -> tuple[list[TrialEntry], list[str]]:
        """The recordings to take, and the columns that all have.

        Logs with the same columns that hold a position and what drives it come before files that
        are parts of one recording; of several, those with the most bytes.
        """
        common = max(map(frozenset, self.found.values()), key=self._worth)
        whole = self._worth(common)[0] == _WHOLE
        if whole:
            self._leave_out(self._asked(self._with(common)), "asked for or simulated, by name")
        names = self._with(common)
        stated = self.found[names[0]]
        several = [role_of(column, stated[column]) for column in common].count("position") > 1
        axes = {} if several else axes_of(names)  # of which each has all joints are trials
        if not whole or axes:
            pool = {n: self.found[n] for n in names} if axes and whole else self.found
            trials, reasons = join_parts(self.folder, pool, self.dialect)
            shared = [set(self._labels(trial)) for trial in trials]
            best = max(shared, key=lambda own: (shared.count(own), len(own)), default=set())
            trials = [trial for trial, has in zip(trials, shared, strict=True) if best <= has]
            if trials and (axes or self._completeness(self._labels(trials[0])) == _WHOLE):
                used = {p for t in trials for p in (t.file, *(x.file for x in t.parts))}
                self._leave_out(self.found.keys() - used)
                ways = join_names(dict.fromkeys(_JOINED[part.join] for part in trials[0].parts))
                files = join_names([trials[0].file, *(part.file for part in trials[0].parts)])
                self.remarks += [f"{files} are taken as one recording, joined {ways}"]
                return trials, [c for c in self._labels(trials[0]) if c in best]
            if not whole:
                self._refuse_parted(names[0], reasons)
        if axes:
            # No joint has the inertia and friction of the next.
            axis = Counter(axes.values()).most_common(1)[0][0]
            others = [name for name in names if axes[name] != axis]
            self._leave_out(others, f"not of {axis}, by name: for another session")
            names = [name for name in names if name not in others]
        pairs = {n: self._renamed(names[0], n, common) for n in self.found if n not in names}
        renamed = {name: own for name, own in pairs.items() if own}
        for name in self.found.keys() - {*names, *renamed}:
            lacking = [c for c in stated if c in common - self.found[name].keys()]
            why = f"{_OTHER}, without {join_names(lacking, 3)}"
            if [*self.found[name]] == [f"column_{n}" for n, _ in enumerate(stated, 1)]:
                why = f"no header; to read it like {names[0]}: --names {','.join(stated)}"
            self._leave_out([name], why)
        trials = [TrialEntry(file=n, kind="free") for n in names]
        trials += [TrialEntry(file=n, kind="free", columns=own) for n, own in renamed.items()]
        return trials, [c for c in stated if c in common]

    def _renamed(self, first: str, other: str, common: frozenset[str]) -> dict[str, str]:
        """Columns of another file by those of the first, where words of its own name are in theirs.

        None unless it has all, with the same units.
        """

        def bare(file: str, columns: Collection[str]) -> dict[tuple[str, ...], str]:
            own = {*re.findall(r"[a-z]+|\d+", file.rpartition(".")[0].lower())}
            split = {c: re.findall(r"[^\W\d_]+|\d+|%", c.lower()) for c in columns}
            return {tuple(w for w in said if w not in own): c for c, said in split.items()}

        here, there = bare(first, common), bare(other, self.found[other])
        if len(here) < len(common) or not here.keys() <= there.keys():
            return {}
        pairs = {column: there[key] for key, column in here.items()}
        alike = all(self.found[first][x] == self.found[other][y] for x, y in pairs.items())
        return pairs if alike else {}

    def _leave_out(self, names: Collection[str], why: str = _OTHER) -> None:
        self.passed += [(name, why) for name in self.found if name in names]
        self.found = {name: own for name, own in self.found.items() if name not in names}

    def _with(self, columns: frozenset[str]) -> list[str]:
        """Files that have these columns; of columns without names, as many and no more."""
        named = not all(column.startswith("column_") for column in columns)
        having = {name: own for name, own in self.found.items() if columns <= set(own)}
        return [name for name, own in having.items() if named or len(own) == len(columns)]

    @staticmethod
    def _asked(names: Sequence[str]) -> list[str]:
        """Files of what was asked for, or simulated, in one with the same name but for that."""
        said = {name: set(words(name)) for name in names}
        bare = {name: (re.findall(r"\d+", name), said[name] - _TWINS) for name in names}
        sound = [bare[name] for name in names if not said[name] & _ASKED]
        return [name for name in names if said[name] & _ASKED and bare[name] in sound]

    def _worth(self, columns: frozenset[str]) -> tuple[int, int, int]:
        """How well files with these columns would do as logs: what they hold, and how much."""
        names = self._with(columns)
        stated = {column: self.found[names[0]][column] for column in columns}
        sizes = sum((self.folder / name).stat().st_size for name in names)
        # Without its time a log is worth half.
        timed = any(role_of(*column) == "time" for column in stated.items())
        return self._completeness(stated), (1 + timed) * sizes, len(columns)

    @staticmethod
    def _completeness(stated: Mapping[str, str]) -> int:
        roles = [role_of(*column) for column in stated.items()]
        moves, driven = {"position", "velocity"}, {*DRIVERS, "reference"}
        if moves & set(roles) and driven & set(roles):
            return _WHOLE
        return int(roles.count("") > 1)

    def _labels(self, trial: TrialEntry) -> dict[str, str]:
        """Names and units of the columns of a recording; of a time that all share only one."""
        labels: dict[str, str] = {}
        for name, file in ((trial.part, trial.file), *((p.name, p.file) for p in trial.parts)):
            for column, stated in self.found[file].items():
                timed = any(role_of(label, unit) == "time" for label, unit in labels.items())
                if file != trial.file and timed and role_of(column, stated) == "time":
                    continue
                labels[f"{name}:{column}" if name else column] = stated
        return labels

    def _refuse_parted(self, first: str, reasons: Sequence[str]) -> None:
        """Refuse logs that have their positions in one file and what drives them in another."""
        roles = {n: {role_of(*column) for column in c.items()} for n, c in self.found.items()}
        there = set(DRIVERS) if "position" in roles[first] else {"position"}
        parted = roles[first] & {"position", *DRIVERS} and not roles[first] & {*there, "reference"}
        other = next((n for n, own in roles.items() if parted and there & own), "")
        if other:
            why = next((f": {reason}" for reason in reasons if other in reason), "")
            raise refusal("parted", str(self.folder), first=first, other=other, why=why)

    def read(self, trial: TrialEntry, wanted: Sequence[str]) -> tuple[SurveyedColumn, ...]:
        """The columns of one recording."""
        labels = self._labels(trial)
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
        raw = read_recording(self.folder, trial, first, clock, self.dialect)
        self.beside = {
            x.rpartition(":")[2]: u for x, u in raw.units.items() if x not in raw.columns
        }
        sound = _complete_rows(raw.columns, clock.column)
        if not (trial.parts or trial.recording or is_text(trial.file)):
            self.remarks += raw.remarks
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
        imperial = any(
            re.search(r"(\b|_)(lbs?|lbf|kip|psi)\b", f"{c} {labels[c]}") for c in ordered
        )
        for column in ordered:
            said = raw.units.get(column, labels[column])
            role = role_of(column, said)
            if role and clock.column != column and re.search(r":column_\d+$|\[0\]$", column):
                # A column without a header, or of a matrix, may be named after the others.
                role = "time" if is_time(raw.columns[column][sound]) else role
            # The number of a message is named by its topic, like the readings beside it.
            if role not in ("time", "reference") and _is_count(raw.columns[column]):
                role = ""
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
        return tuple(found)

    def recordings(self, trial: TrialEntry) -> list[TrialEntry]:
        """The recordings that one file holds; those of bags, and of parts, as they are.

        Raises:
            InputError: it cannot be read.
        """
        if self.episodes is not None:
            places = self.episodes[trial.file]
            return [trial.model_copy(update={"recording": n}) for n in places]
        path = self.folder / trial.file
        self.scanned += path.stat().st_size
        columns = self.found[trial.file]
        times = [c for c, u in columns.items() if role_of(c, u) == "time"]
        several = is_text(trial.file) or any("[:]." in column for column in columns)
        several |= bool(times) and not times[0].startswith("/")  # of a bag
        if trial.parts or not several or self.scanned > _MOST_SCANNED:
            return [trial]
        column = (times or sorted(columns, key=lambda name: "[:]." not in name))[0]
        moving = [c for c, u in columns.items() if role_of(c, u) == "position"] if times else []
        raw = self._read_one(trial.file, columns, column, *moving)
        starts = starts_of(raw, column if times else "")
        if len(starts) == 1:
            return [trial]
        wanted = {int(raw.rows[0]) - 1, *(int(raw.rows[at]) for at in starts)}
        with path.open(encoding="utf-8", errors="replace") as file:
            numbered = enumerate(file if is_text(trial.file) else (), 1)
            lines = [re.split("[,;\t]", x.strip()) for n, x in numbered if n in wanted]
        for name, *axes in zip(*lines, strict=False):
            if {*words(name)} <= _AXES and words(name) and len({*axes}) > 1:
                listed, place = join_names(dict.fromkeys(axes), 4), f"{trial.file}, column '{name}'"
                raise refusal("axes_in_turn", place, axes=listed)
        rows = ", ".join(str(raw.rows[at]) for at in starts[1:4])
        self.remarks.append(
            f"{trial.file} holds {len(starts)} recordings, which begin again at row {rows}"
            + (", ..." if len(starts) > 4 else "")
        )
        return [trial.model_copy(update={"recording": n}) for n, _ in enumerate(starts, 1)]


def _is_count(values: np.ndarray) -> bool:
    """Whether values (T,) rise by the same step from each row to the next."""
    steps = np.diff(values)
    return len(steps) > 3 and bool(np.ptp(steps) < 1e-6 * np.min(steps))


def _like(path: Path) -> str:
    """What the lines of a text that is no table look like, in a few words."""
    if not is_text(path.name):
        return ""
    with path.open("rb") as stream:
        head = stream.read(1 << 12).decode("utf-8", "replace")
    line = next((x.strip() for x in reversed(head.splitlines()[:20]) if x.strip()), "")
    shown = f"{line[:48]}..." if len(line) > 48 else line
    return f"; a line reads '{shown}'" if shown.isprintable() and re.search(r"\d", shown) else ""


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
