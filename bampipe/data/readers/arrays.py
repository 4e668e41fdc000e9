"""Arrays of a file by their names: vectors, and columns of a matrix named as ``X[0]``.

The readers of such formats say what a file holds; what is wanted of it is read here. So are the
arrays that NumPy saves: of ``.npy`` one, and of ``.npz`` several by name; fields of a structured
array are columns, too. Pickled objects, which may run any program, are not read.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate
from pathlib import Path

import numpy as np

from bampipe.data.readers import moments, trial
from bampipe.data.readers.trial import RawTrial, Wanted, aligned, check_columns, check_size
from bampipe.data.refusals import refusal
from bampipe.data.units import SCALES, in_steps, units_beside, units_in
from bampipe.data.vocabulary import word_set
from bampipe.errors import InputError, located
from bampipe.lists import join_names

LARGEST_WIDTH = 64
_RUN = re.compile(
    rf"(?i)(.+?(?=\[)|(?:.*[./_])?(?:{'|'.join(sorted(word_set('recordings')))})s?[ _]?(?=\d))"
    r"(?:\[([^\[\]:]+)\]|(\d+))[./_]([^\[\]]+)"
)
"""Name of an array of one of several recordings in a file."""
TIME = "@time"
"""End of the name of the times of a channel that has its own."""
_CLOCK = re.compile(r"(?i)(?:.*[._/@])?(?:t|\w*time|\w*stamp)(?:_[a-z]+|\d+)?\Z")
_SCALE = re.compile(
    rf"(?i)(?:\A|[ _./])(?:{'|'.join(SCALES[:-1])}|scale_?factor|(offset))\Z|[./]gain\Z"
)
"""End of the name of what others are multiplied by, or of what comes on top of them."""
_NUMBERS, _STAMPED, LINK, STATED = "iufb", "MOSU", "link", "stated"
"""Kinds of arrays of numbers, of moments or text, of what is elsewhere, of no more than a unit."""


@dataclass(frozen=True)
class Stored:
    """An array in a file, which is read when it is wanted.

    Attributes:
        shape: of the array; kind: of its type, as NumPy has it, or what else it is; texts that are
            known to be dates and times are of theirs.
        load: reads it; texts come as objects.
        unit: that the file states, "" if it does not.
    """

    shape: tuple[int, ...]
    kind: str
    load: Callable[[], np.ndarray]
    unit: str = ""


NAMES = ("name", "label", "signalname", "signal", "channel")
_VALUES = ("values", "value", "data")
"""Fields that hold the name of a signal, and its samples."""
Arrays = Mapping[str, Stored]
"""Content of a file, by name."""
Opened = tuple[Arrays, tuple[str, ...]]


def stored(array: np.ndarray | None, unit: str = "", kind: str = "") -> Stored:
    """An array that is in memory, or what is none."""
    held = np.empty(0, "V1") if array is None else array
    return Stored(held.shape, kind or held.dtype.kind, lambda: held, unit)


def read_arrays(arrays: Arrays, wanted: Wanted, what: str) -> RawTrial:
    """The wanted columns of the arrays of a file, runs of one recording end to end.

    ``what``: an array of such a file is called in messages.

    Raises:
        InputError: an array is missing, not a vector of numbers, or not as long as the others.
    """
    arrays = _in_steps(arrays)
    units = {name: array.unit for name, array in arrays.items() if array.kind == STATED}
    arrays = {name: array for name, array in arrays.items() if name not in units}
    at_one_rate = _at_one_rate(arrays)
    joined, begun = _join_runs(at_one_rate)
    known: Arrays = {**arrays, **joined}
    values = dict[str, np.ndarray]()
    for column in wanted.columns:
        variable, index = split_index(column, known)
        array = known.get(variable)
        if array is None or array.kind not in _NUMBERS + _STAMPED:
            raise _fault(column if array is None else variable, known, f"{what} '{column}'")
        check_size(math.prod(array.shape), wanted)
        with located(f"{what} '{column}'"):
            values[column] = _read_column(array, index, wanted.datetimes.get(column))
        units |= {column: array.unit} if array.unit else {}
    called = (split_index(column, known)[0] for column in wanted.columns)
    starts = next((begun[name] for name in called if name in begun), ())
    own = [c for c in wanted.columns if at_one_rate.get(c) is not arrays.get(c)]
    said = f"interpolated linearly at the times of the longest: {join_names(own)}"
    remarks = (said,) if own else ()
    columns = aligned(values, what)
    rows = np.arange(1, 1 + len(next(iter(columns.values()), ())))
    return RawTrial(columns, rows, remarks=remarks, units=units, begun=starts)


def _read_column(array: Stored, index: int | None, form: str | None) -> np.ndarray:
    """An array or a column of it, dates and times of a ``form`` as s since the first."""
    if form is not None and array.kind in _NUMBERS:
        raise InputError("not text, expected dates and times")
    if form is None and array.kind in _STAMPED:
        raise refusal("no_numbers")
    cells = pick(array.load(), index)
    if form is None:
        return np.array(cells, dtype=np.float64)  # a copy: what stands in a file is not written to
    stamps = cells if cells.dtype.kind == "M" else cells.tolist()
    return moments.seconds(moments.nanoseconds(stamps, form))


def _fault(variable: str, known: Arrays, where: str) -> InputError:
    """Error on a variable that is missing, or is no array of numbers, moments or texts."""
    within = (f"{variable}.", f"{variable}/", f"{variable}[0].")
    if inside := [other for other in known if other.startswith(within)]:
        return refusal("structure", where, inside=", ".join(inside[:8]))
    paths = accumulate(variable.split("/"), "{}/{}".format)
    if any(known[path].kind == LINK for path in paths if path in known):
        return InputError("a link, expected numbers in this file", where=where)
    if variable not in known:
        check_columns(list(known), [variable])
    return refusal("no_vector", where)


def columns_of_arrays(arrays: Arrays) -> dict[str, str]:
    """Names and units of the columns that were recorded together; of moments, it is "datetime".

    And of numbers that stand alone. Beside a log a file may keep what belongs to no sample: gains
    by axis, a table of settings.
    """
    joined = _join_runs(_at_one_rate(_in_steps(arrays)))[0]
    found = {name: array for name, array in joined.items() if array.kind in _NUMBERS + "M"}
    by_length: dict[int, list[str]] = {}
    for name, array in found.items():
        by_length.setdefault(max(array.shape, default=1), []).extend(labels(name, array.shape))
    longer = [length for length in by_length if length > 1]
    samples = max(longer, key=lambda length: (len(by_length[length]), length), default=1)
    kept = {*by_length.get(1, ()), *by_length.get(samples, ())}
    return {
        column: "datetime" if array.kind == "M" else array.unit
        for name, array in found.items()
        for column in labels(name, array.shape)
        if column in kept
    }


def _in_steps(arrays: Arrays) -> Arrays:
    """The arrays, those with a scale beside them in steps of it: ``position_scale``, ``q.lsb``.

    That is their unit, and none that is known where it may have been applied already, as to numbers
    that are no integers, or may be of another array in its group.
    """
    found, held = dict(arrays), [n for n, array in arrays.items() if array.kind != STATED]
    for label, number in arrays.items():
        said = _SCALE.search(label)
        if not said or number.kind not in _NUMBERS or math.prod(number.shape) > LARGEST_WIDTH:
            continue
        owner, sizes = re.escape(label[: said.start()]), sorted({*number.load().ravel().tolist()})
        tied = [n for n in held if re.fullmatch(rf"(?i){owner}([./]({'|'.join(_VALUES)}))?", n)]
        tied = tied or namesakes(label[: said.start()], held)
        group = (n for n in held if re.match(f"{owner}[./]" if owner else "", n))
        for name in tied or (name for name in group if not _CLOCK.match(name)):
            known, values = found[name], np.empty(0)
            values = known.load() if known.kind in _NUMBERS else values
            whole = bool(np.all(values == np.rint(values)))
            if values.size > len(sizes) and (tied or whole) and not said[1]:
                step = in_steps(values, sizes, known.unit, sure=bool(tied))
                found[name] = replace(known, unit=step)
            elif values.size > 1 and tied and whole and said[1] and known.unit and any(sizes):
                found[name] = replace(known, unit=f"{known.unit}, offset {sizes}")
    return found


def namesakes(owner: str, labels: Iterable[str]) -> list[str]:
    """The label with the last name of an ``owner`` elsewhere: data.q of meta.q; [] of several."""
    name = re.split(r"[./]", owner)[-1]
    found = [label for label in labels if re.split(r"[./]", label)[-1] == name != ""]
    return found if len(found) == 1 else []


def called_signals(labels: Iterable[str], texts: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Names and units of arrays by their labels, out of the ``texts`` beside them.

    Structs of a list that say what they are called go by that name, and units beside an array are
    its own: so scopes and recorders write their channels.
    """
    names, units, labels = dict[str, str](), units_beside(texts), [*labels]
    for label, text in texts.items():
        owner, _, key = label.rpartition(".")
        if key.lower() in NAMES and owner.endswith("]"):
            names.setdefault(owner, re.sub(r"[^\w ./+-]|[\[\]]", "", text))
        if key.lower() in NAMES and (said := units_in([text])):
            units.setdefault(owner, said[text])
    several = Counter((owner.rpartition("[")[0], name) for owner, name in names.items())
    of_names = {names.get(owner, owner): unit for owner, unit in units.items()}
    far = {own[0]: u for x, u in of_names.items() if (own := namesakes(x, labels))}
    found: dict[str, tuple[str, str]] = {}
    for label in labels:
        owner, _, key = label.rpartition(".")
        kept, sampled, name = owner.rpartition("[")[0], key.lower() in _VALUES, label
        if owner in names and several[kept, names[owner]] == 1:
            name = f"{kept}.{names[owner]}" + ("" if sampled else f".{key}")
        beside = units.get(owner, "") if sampled else ""
        found[label] = name, units.get(label) or beside or far.get(label, "")
    return found


def split_index(column: str, names: Container[str]) -> tuple[str, int | None]:
    """``("X", 2)`` for ``X[2]``, where there is no variable of that whole name."""
    match = re.fullmatch(r"(.+)\[(\d{1,3})\]", column)
    if column in names or match is None:
        return column, None
    return match[1], int(match[2])


def pick(values: np.ndarray, index: int | None) -> np.ndarray:
    """The vector, or column ``index`` of a matrix (counted along its shorter side, from 0).

    Raises:
        InputError: a matrix without an index, or an index that is too large.
    """
    sides = [extent for extent in values.shape if extent != 1] if 0 not in values.shape else []
    if index is None:
        if len(sides) > 1:
            raise refusal("matrix" if len(sides) == 2 else "array", shape=_by(values.shape))
        return values.ravel()
    if len(sides) > 2 or not sides:
        raise InputError("has no columns to choose from")
    table = values.reshape(sides) if len(sides) == 2 else values.reshape(-1, 1)
    table = table if table.shape[0] >= table.shape[1] else table.T
    if index >= table.shape[1]:
        raise InputError(f"has {table.shape[1]} columns, [{index}] is not among them")
    return np.ascontiguousarray(table[:, index])


def _by(shape: Iterable[int]) -> str:
    return " by ".join(map(str, shape))


def labels(name: str, shape: tuple[int, ...]) -> list[str]:
    """Names of the columns of a variable: its own, or ``name[0]``, ``name[1]``, ..."""
    sides = [extent for extent in shape if extent != 1]
    if 0 in shape or len(sides) > 2:
        return []
    if len(sides) < 2:
        return [name]
    return [f"{name}[{k}]" for k in range(min(sides))] if min(sides) <= LARGEST_WIDTH else []


def _at_one_rate(arrays: Arrays) -> Arrays:
    """The arrays, those of signals with fewer samples between theirs at the times of the longest.

    Of groups that each have a time, and one signal or others than the rest; else they are trials.
    """
    if sum(map(bool, map(_CLOCK.match, arrays))) < 2:  # nothing is loaded to compare them
        return arrays
    groups: dict[str, dict[str, str]] = {}
    for name, array in arrays.items():
        owner, dot, key = name.rpartition("/" if "/" in name else ".")
        if (stem := name.removesuffix(TIME)) + TIME in arrays:  # a channel with times of its own
            owner, dot, key = stem, "", name.removeprefix(stem)
        sampled = array.kind in _NUMBERS and max(array.shape, default=1) > 1
        if sampled and not _RUN.fullmatch(name):
            groups.setdefault(owner + dot, {})[key] = name
    tracks = [track for own in groups.values() for track in _by_clock(own, arrays)]
    kinds = [frozenset(track) for track in tracks]
    alone = [own.rpartition("/")[2] for own in groups if own + TIME in arrays]
    trials = len({*kinds}) < len(kinds) and max(map(len, kinds)) > 2
    if len(tracks) < 2 or trials or len({*alone}) < len(alone):
        return arrays
    clocks = [arrays[next(iter(track.values()))] for track in tracks]
    longest = max(clocks, key=lambda clock: math.prod(clock.shape))
    found = dict(arrays)
    for times, track in zip(clocks, tracks, strict=True):
        clock, *signals = track.values()
        if times.shape != longest.shape and signals:
            del found[clock]
            for name in signals:
                array = arrays[name]
                width = math.prod(array.shape) // math.prod(times.shape)
                load = partial(_resampled, longest, times, array)
                shape = (math.prod(longest.shape), *([width] if width > 1 else []))
                found[name] = replace(array, shape=shape, load=load)
    return found


def _by_clock(names: Mapping[str, str], arrays: Arrays) -> list[dict[str, str]]:
    """The arrays of a group, by key, behind the clock of each; of clocks, that of its length."""
    length = {key: max(arrays[name].shape) for key, name in names.items()}
    clocks = dict[int, str]()
    for key, name in names.items():
        called = _CLOCK.match(name) and labels("", arrays[name].shape) == [""]
        t = arrays[name].load().ravel() if called else np.zeros(1)
        if np.all(np.diff(t) >= 0) and t[-1] > t[0]:
            clocks.setdefault(length[key], key)
    return [
        {x: names[x] for x in (key, *names) if x == key or length[x] == own}
        for own, key in clocks.items()
    ]


def _resampled(at: Stored, times: Stored, values: Stored) -> np.ndarray:
    t, own = (array.load().astype(float).ravel() for array in (at, times))
    if max(t[0], own[0]) > min(t[-1], own[-1]) or not 0.01 < np.ptp(own) / np.ptp(t) < 100.0:
        raise refusal("clocks_apart", first=own[0], last=own[-1], start=t[0], end=t[-1])
    table = values.load().astype(float)
    columns = (table if len(table) == own.size else table.T).reshape(own.size, -1).T
    return np.column_stack([trial.interpolated(t, own, column) for column in columns])


def _join_runs(arrays: Arrays) -> tuple[dict[str, Stored], dict[str, tuple[int, ...]]]:
    """Vectors of one name in all structs of a list, end to end: ``runs[:].q`` of ``runs[0].q``.

    And of groups that are called trials by a number, as ``run1.q``. Of structs that each have a
    time, or are as long as no other; others are rather joints. All arrays, and by the name of each
    that was joined the samples before which one begins.
    """
    found = dict(arrays)
    begun: dict[str, tuple[int, ...]] = {}
    runs: dict[str, dict[str, str]] = {}
    for label, array in found.items():
        match = _RUN.fullmatch(label)
        if match and labels("", array.shape) and math.prod(array.shape) > 1:
            runs.setdefault(f"{match[1]}[:].{match[4]}", {})[match[3] or f"[{match[2]}]"] = label
    timed = {name.partition("[")[0]: list(own) for name, own in runs.items() if _CLOCK.match(name)}
    for name, own in runs.items():
        parts = [found[label] for label in own.values()]
        sizes = [math.prod(part.shape) for part in parts]
        times = timed.get(name.partition("[")[0])
        # Groups that are called trials are no joints, whatever their lengths.
        alike = len(set(sizes)) == 1 and times is None and not all(map(str.isdigit, own))
        widths = {len(labels("", part.shape)) for part in parts}
        if alike or len(widths) > 1 or len(own) < 2 or list(own) != (times or list(own)):
            continue
        found = {label: array for label, array in found.items() if label not in own.values()}
        width = widths.pop()
        shape = (sum(sizes) // width, *([width] if width > 1 else []))
        found[name] = replace(parts[0], shape=shape, load=partial(_end_to_end, parts, shape))
        begun[name] = tuple(accumulate(size // width for size in sizes[:-1]))
    return found, begun


def _end_to_end(parts: Iterable[Stored], shape: tuple[int, ...]) -> np.ndarray:
    tables = (part.load().reshape(-1, *shape[1:]) for part in parts)
    return np.concatenate([*tables])


@dataclass(frozen=True)
class ArrayReader:
    """A reader of a format whose files hold arrays by name.

    Attributes:
        what: an array of such a file is called in messages.
        opened: what a file holds, while it is open, and what was left out, a sentence each; for
            what is wanted of it, or to list it.
        begun: samples from which on another recording stands in a file without runs.
    """

    what: str
    opened: Callable[[Path, Wanted | None], AbstractContextManager[Opened]]
    begun: Callable[[Path], tuple[int, ...]] = lambda path: ()

    def read(self, path: Path, wanted: Wanted) -> RawTrial:
        """The wanted columns; `InputError` as `read_arrays`, or where the file is damaged."""
        with self.opened(path, wanted) as (arrays, notes):
            trial = read_arrays(arrays, wanted, self.what)
            return replace(trial, notes=notes, begun=trial.begun or self.begun(path))

    def columns(self, path: Path) -> dict[str, str]:
        """Names and units of the columns that were recorded together; see `columns_of_arrays`."""
        with self.opened(path, None) as (arrays, _):
            shapes = {x: a.shape for x, a in arrays.items() if a.kind in _NUMBERS}
            sampled = [x for x, shape in shapes.items() if math.prod(shape) > LARGEST_WIDTH]
            blocks = [x for x in sampled if not labels("", shapes[x])]
            if blocks and len(blocks) == len(sampled):
                raise refusal("block", name=blocks[0], shape=_by(shapes[blocks[0]]))
            return columns_of_arrays(arrays)


@contextmanager
def _opened(path: Path, wanted: Wanted | None) -> Iterator[Opened]:
    """The arrays of a file; the one of a ``.npy`` is called ``data``."""
    try:
        loaded = np.load(path, allow_pickle=False)
        whole = {"data": loaded} if isinstance(loaded, np.ndarray) else dict(loaded)
    except ValueError as error:
        raise refusal("pickled") from error
    found: dict[str, Stored] = {}
    units = units_beside({x: str(a.ravel()[0]) for x, a in whole.items() if a.size == 1})
    for key, array in whole.items():
        parts = _fields(key, array)
        found |= {n: stored(np.atleast_1d(x), units.get(n, "")) for n, x in parts}
    yield found, ()


def _fields(name: str, array: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """An array of numbers itself; of records, their contents."""
    if array.dtype.names is None:
        yield name, array
    for field in array.dtype.names or ():
        yield from _fields(f"{name}.{field}", array[field])


READER = ArrayReader("array", _opened)
