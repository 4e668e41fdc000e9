"""The files of a folder: which of them are logs, and which belong together."""

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bampipe.data import readers
from bampipe.data.names import DRIVERS, role_of, unit_of, words
from bampipe.data.parts import axes_of, join_parts, read_columns
from bampipe.data.readers import columns_of, extension_of, is_log, is_text
from bampipe.data.readers.trial import Dialect
from bampipe.data.recording import starts_of
from bampipe.data.refusals import refusal
from bampipe.data.session import TrialEntry, lexically_inside
from bampipe.data.stated_rate import SMALL, units_stated
from bampipe.data.units import unit
from bampipe.data.vocabulary import by_word, word_set
from bampipe.errors import InputError
from bampipe.lists import join_names

MOST_FILES = 500
_MOST_COLUMNS = 500
"""Of a table of samples, unless it has many rows."""
_OTHER_DATA = by_word("unreadable")
"""What to do with files of data that are not read."""
_MOST_SCANNED = 1 << 30
"""Bytes of text in which other recordings are looked for; reading them takes some seconds."""
_OTHER = "other columns, for another session"
_WHOLE = 2
"""Of logs that hold both a motion and what drives it."""
_AXES = word_set("axes")
"""Words for the column that tells of which axis a row is."""
_ASKED = word_set("asked")
_TWINS = _ASKED | word_set("measured")
"""Words in the name of a file of what was asked for, and in that of the measurement beside it."""
_JOINED = {"rows": "row by row", "time": "by their times", "start": "as if begun together"}


@dataclass
class LogFiles:
    """The files of a folder while it is found out which are logs, and which belong together.

    ``episodes``: see `lerobot.find_episodes`; ``found``: columns and their units, by file;
    ``passed``, ``remarks``: see `Survey`.
    """

    folder: Path
    dialect: Dialect
    episodes: Mapping[str, Sequence[int]] | None = None
    found: dict[str, dict[str, str]] = field(default_factory=dict)
    passed: list[tuple[str, str]] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    scanned: int = 0

    def look_through(self) -> None:
        """Find the columns of every file; files that are no logs are left out, with the reason."""
        for name in self.episodes or self._names():
            path = self.folder / name
            try:
                lexically_inside(name, where="")
                columns = columns_of(path, name=name, dialect=self.dialect)
                if not columns:
                    raise InputError(f"no table: no column of numbers in it{_like(path)}")
                small = path.stat().st_size < SMALL and is_text(name)
                wide, first = len(columns) > _MOST_COLUMNS, next(iter(columns))
                rows = 2
                if small or wide:
                    rows = len(read_columns(self.folder, name, columns, [first], self.dialect))
                if wide and 0 < 10 * rows < len(columns):
                    raise refusal("wide", rows=rows, columns=len(columns))
                if small and rows < 2:
                    raise InputError("one row of numbers is no log")
                self.found[name] = columns
            except InputError as error:
                self.passed.append((name, str(error)))
        if not self.found:
            raise self.fault()
        # Columns that state no unit have that of notes beside the logs.
        known = {(c, u) for own in self.found.values() for c, u in own.items()}
        unsaid = {c for c, u in known if not u and not unit_of(c, "", role_of(c, ""))}
        said = units_stated(self.folder, self.found, unsaid)
        for own in self.found.values():
            own |= {c: said[c][0] for c, u in own.items() if c in said and not u}
        self.remarks += [f"{c} is in {u}, as {file} says" for c, (u, file) in sorted(said.items())]

    def _names(self) -> list[str]:
        """The files that may be logs; others that hold data are left out by name."""
        folder = self.folder
        if not folder.is_dir():
            raise InputError("no such folder", where=str(folder))
        paths = [path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file()]
        files = [p.as_posix() for p in paths if not any(part[0] == "." for part in p.parts)]
        other = {name: end for name in files if (end := extension_of(name)) in _OTHER_DATA}
        names = [name for name in files if name not in other and is_log(folder / name)]
        self.passed += [(x, f"*{end} is not read: {_OTHER_DATA[end]}") for x, end in other.items()]
        if not names:
            shown = join_names([*other] or files, 4)
            but = shown and f" that can be read, but {shown}"
            remedy = f"supported file extensions are {', '.join(readers.EXTENSIONS)}"
            remedy = next((why for _, why in self.passed), remedy)
            raise InputError(f"no log in this folder{but}", where=str(folder), remedy=remedy)
        if len(names) > MOST_FILES:
            raise InputError(f"{len(names)} logs are more than {MOST_FILES}", where=str(folder))
        return names

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
            shared = [set(self.labels(trial)) for trial in trials]
            best = max(shared, key=lambda own: (shared.count(own), len(own)), default=set())
            trials = [trial for trial, has in zip(trials, shared, strict=True) if best <= has]
            if trials and (axes or self._completeness(self.labels(trials[0])) == _WHOLE):
                used = {p for t in trials for p in (t.file, *(x.file for x in t.parts))}
                self._leave_out(self.found.keys() - used)
                ways = join_names(dict.fromkeys(_JOINED[part.join] for part in trials[0].parts))
                files = join_names([trials[0].file, *(part.file for part in trials[0].parts)])
                self.remarks += [f"{files} are taken as one recording, joined {ways}"]
                return trials, [c for c in self.labels(trials[0]) if c in best]
            if not whole:
                self._refuse_parted(names[0], reasons)
        if axes:
            # No joint has the inertia and friction of the next.
            axis = Counter(axes.values()).most_common(1)[0][0]
            others = [name for name in names if axes[name] != axis]
            self._leave_out(others, f"not of {axis}, by name: for another session")
            names = [name for name in names if name not in others]
        trials, wanted = [], [c for c in stated if c in common]
        for name in [*names, *(n for n in self.found if n not in names)]:
            own = {c: c for c in wanted} if name in names else self._renamed(names[0], name, wanted)
            if own:
                units = {c: self._unit(name, x) for c, x in own.items()}
                usual = {c: unit(self._unit(names[0], c)) for c in wanted}
                other = {c: said for c, said in units.items() if said and unit(said) != usual[c]}
                own = {c: x for c, x in own.items() if c != x}
                trials.append(TrialEntry(file=name, kind="free", columns=own, units=other))
                continue
            lacking = [c for c in wanted if c not in self.found[name]]
            why = f"{_OTHER}, without {join_names(lacking, 3)}"
            if [*self.found[name]] == [f"column_{n}" for n, _ in enumerate(stated, 1)]:
                why = f"no header; to read it like {names[0]}: --names {','.join(stated)}"
            self._leave_out([name], why)
        return trials, wanted

    def _unit(self, file: str, column: str) -> str:
        """Unit of a column by its file, else by its name."""
        stated = self.found[file][column]
        return unit_of(column, stated, role_of(column, stated))

    def _renamed(self, first: str, other: str, wanted: Sequence[str]) -> dict[str, str]:
        """Columns of another file by those of the first, alike but for words of the file's name.

        And but for units of one quantity. None unless it has all.
        """

        def bare(file: str, columns: Collection[str], whole: bool) -> dict[tuple[str, ...], str]:
            own = {*re.findall(r"[a-z]+|\d+", "" if whole else file.rpartition(".")[0].lower())}
            found = dict[tuple[str, ...], str]()
            for c in columns:
                known = unit(said) if (said := self._unit(file, c)) else None
                plain = "".join(c.rpartition(said)[::2]) if known else c
                split = re.findall(r"[^\W\d_]+|\d+|%", plain.lower())
                of = known.si if known else self.found[file][c]
                found[(of, *(w for w in split if w not in own))] = c
            return found

        for whole in (True, False):
            here, there = bare(first, wanted, whole), bare(other, self.found[other], whole)
            if len(here) == len(wanted) and here.keys() <= there.keys():
                return {column: there[key] for key, column in here.items()}
        return {}

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

    def labels(self, trial: TrialEntry) -> dict[str, str]:
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
        wanted = [column, *moving]
        raw = read_columns(self.folder, trial.file, columns, wanted, self.dialect)
        starts = starts_of(raw, column if times else "")
        if len(starts) == 1:
            return [trial]
        heads = {int(raw.rows[0]) - 1, *(int(raw.rows[at]) for at in starts)}
        with path.open(encoding="utf-8", errors="replace") as file:
            numbered = enumerate(file if is_text(trial.file) else (), 1)
            lines = [re.split("[,;\t]", x.strip()) for n, x in numbered if n in heads]
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


def _like(path: Path) -> str:
    """What the lines of a text that is no table look like, in a few words."""
    if not is_text(path.name):
        return ""
    with path.open("rb") as stream:
        head = stream.read(1 << 12).decode("utf-8", "replace")
    line = next((x.strip() for x in reversed(head.splitlines()[:20]) if x.strip()), "")
    shown = f"{line[:48]}..." if len(line) > 48 else line
    return f"; a line reads '{shown}'" if shown.isprintable() and re.search(r"\d", shown) else ""
