"""Readers of trial files, one module a format; :func:`read_trial` chooses by the file extension.

Every reader returns the wanted columns as float64, with NaN where a cell is empty, and raises
:class:`bampipe.errors.InputError` naming file, row and column where the file cannot be trusted.
Rows of a text file are counted as an editor does (the first line is row 1); samples of the other
files are counted from 1. Memory stays below three times what is returned; JSON, MATLAB files and
ROS bags apart, which have to be held as a whole. A small file can unpack to gigabytes, by damage or
because somebody made it so: no reader gets more memory than its file can be worth.
"""

import re
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType

from bampipe.data.readers import arrays, bag, hdf5, mat, objects, parquet, tdms, text
from bampipe.data.readers.trial import LARGEST_BYTES, Dialect, RawTrial, Wanted
from bampipe.data.refusals import refusal
from bampipe.data.units import unit, units_in
from bampipe.data.vocabulary import VOCABULARY
from bampipe.errors import InputError, located

TEXTS = (".csv", ".tsv", ".txt", ".dat", ".asc", ".log", ".mot", ".sto", ".lvm")
"""File extensions of tables as text."""
SHEETS = (".xlsx", ".xlsm")
"""File extensions of workbooks, whose first sheet with rows is read as text."""
_OBJECTS = (".json", ".jsonl", ".ndjson")
_AGAIN = "copy it again from the logger"
Reader = ModuleType | arrays.ArrayReader
_FORMATS: tuple[tuple[tuple[str, ...], Reader, str, str], ...] = (
    (TEXTS, text, "", ""),
    (SHEETS, text, "workbook of Excel", "save it again, or export the sheet as CSV"),
    ((".parquet",), parquet.READER, "Parquet file", _AGAIN),
    ((".feather", ".arrow"), parquet.READER, "Feather file", _AGAIN),
    ((".mat",), mat.READER, "MATLAB file", "save it again from MATLAB"),
    (hdf5.ENDINGS, hdf5.READER, "HDF5 file", _AGAIN),
    (_OBJECTS, objects.READER, "", ""),
    ((".tdms",), tdms.READER, "TDMS file", _AGAIN),
    ((".bag", ".db3"), bag, "bag", f"{_AGAIN}, with the message definitions in it"),
    ((".mcap",), bag, "MCAP file", f"{_AGAIN}, with the message definitions in it"),
    ((".npy", ".npz"), arrays.READER, "file of NumPy", "save it again with np.savez"),
)
"""File extensions, their reader, its name for the file, and the remedy if it cannot read one."""
_READERS = {extension: reader for own, reader, _, _ in _FORMATS for extension in own}
_FOREIGN = {extension: (kind, remedy) for own, _, kind, remedy in _FORMATS for extension in own}
_FOREIGN[".gz"] = "gzip archive", _AGAIN
EXTENSIONS = tuple(_READERS)
"""File extensions that can be read."""

_HEAD = 1 << 10
_MOST_UNPACKED, _LEAST_ROOM = 100, 2 << 30
"""Memory that reading a file may take: a multiple of its size, and bytes at least, if free."""
_KINDS = [(kind["bytes"].encode("latin-1"), kind) for kind in VOCABULARY["first_bytes"]]
"""First bytes of a kind of file, and its entry in the vocabulary."""


def read_trial(
    path: Path,
    columns: Sequence[str],
    *,
    name: str = "",
    largest_bytes: int = LARGEST_BYTES,
    datetimes: Mapping[str, str] | None = None,
    dialect: Dialect | None = None,
) -> RawTrial:
    """Read the wanted columns of one trial file; its extension gives the format.

    Args:
        path: the file.
        columns: names of the columns, the time first; see each format's module for how they are
            called there.
        name: what to call the file in messages (default: its path).
        largest_bytes, datetimes, dialect: see `Wanted`.

    Raises:
        InputError: empty, of another kind, cut off, too large, a column missing or twice, a
            cell that is not a number, or a library that is not installed.
    """
    path = Path(path)
    wanted = Wanted(tuple(columns), datetimes or {}, dialect or Dialect(), largest_bytes)
    with located(name or str(path)):
        reader = _reader(path)
        with _safely(path):
            trial: RawTrial = reader.read(path, wanted)
        if columns and len(trial) == 0:
            raise InputError("a header but no samples")
    return replace(trial, units={**_units_in_names(reader, trial.columns), **trial.units})


def is_log(path: Path) -> bool:
    """Whether a file may be a log: by its extension, or as text with rows of numbers."""
    return extension_of(path.name) in _READERS or text.is_table(path)


def is_text(name: str) -> bool:
    """Whether a log is read as text, as those are whose extension is not known."""
    return _READERS.get(extension_of(name), text) is text


def extension_of(name: str) -> str:
    """File extension in lower case; under gzip, that of the text or JSON inside."""
    path = Path(name)
    inner, own = Path(path.stem).suffix.lower(), path.suffix.lower()
    return inner if own == ".gz" and inner in (*TEXTS, *_OBJECTS) else own


def columns_of(path: Path, *, name: str = "", dialect: Dialect | None = None) -> dict[str, str]:
    """Names of all that can be read as a column of one trial file, with units it states.

    The unit is "datetime" for dates and times, "" if the file does not say. A ``dialect`` is
    that of a text.

    Raises:
        InputError: as :func:`read_trial`.
    """
    path = Path(path)
    with located(name or str(path)):
        reader = _reader(path)
        more = (dialect,) if reader is text else ()
        with _safely(path):
            columns: dict[str, str] = reader.columns(path, *more)
    named = _units_in_names(reader, columns)
    return {column: stated or named.get(column, "") for column, stated in columns.items()}


def _units_in_names(reader: Reader, names: Iterable[str]) -> dict[str, str]:
    """Units parsed from column names; the reader of text tables parses those of its header itself.

    Brackets may also hold an index or a joint name; in a bag they always do.
    """
    said = {} if reader in (text, bag) else units_in(names)
    return {name: u for name, u in said.items() if not u.isdigit() and unit(u) is not None}


@contextmanager
def _safely(path: Path) -> Iterator[None]:
    """Let this process take as much memory as the file may; where Linux is not, it takes any.

    InputError where it does not suffice, or the library that reads such files fails.
    """
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
        meminfo = Path("/proc/meminfo").read_text()
    except (ImportError, OSError):
        resource = None  # type: ignore[assignment]
    else:
        free = int(re.findall(r"MemAvailable:\s*(\d+) kB", meminfo)[0]) << 10
        room = min(free, max(_MOST_UNPACKED * path.stat().st_size, _LEAST_ROOM))
        before = resource.getrlimit(resource.RLIMIT_AS)
        limits = [pages * resource.getpagesize() + room, *(x for x in before if x >= 0)]
        resource.setrlimit(resource.RLIMIT_AS, (min(limits), before[1]))
    try:
        yield
    except MemoryError as error:
        raise refusal("no_memory") from error
    except InputError:
        raise
    except Exception as error:
        kind, remedy = _FOREIGN.get(path.suffix.lower(), ("", ""))
        if not kind:
            raise
        raise InputError(f"not a sound {kind}", remedy=remedy) from error
    finally:
        if resource is not None:
            resource.setrlimit(resource.RLIMIT_AS, before)


def _reader(path: Path) -> Reader:
    """The reader of a file by its extension, with which its first bytes must agree.

    InputError where it cannot be read, is empty, unsupported, or of another kind.
    """
    extension = extension_of(path.name)
    try:
        state = path.stat()
        if not stat.S_ISREG(state.st_mode):
            raise InputError("not a regular file")
        with path.open("rb") as stream:
            head = stream.read(_HEAD)
    except OSError as error:
        raise InputError(f"cannot be read: {(error.strerror or 'error').lower()}") from error
    if not is_log(path):
        raise refusal("unsupported", extension=extension, known=", ".join(EXTENSIONS))
    if state.st_size == 0:
        raise InputError("the file is empty")
    if head[512:520] == hdf5.SIGNATURE:  # behind a user block of MATLAB
        head = b"MATLAB"
    for magic, kind in _KINDS:
        right = kind["extensions"].split()
        if head.startswith(magic) and not {extension, path.suffix.lower()} & {*right}:
            remedy = kind.get("remedy", f"name it *{next(iter(right), '')}")
            raise InputError(f"this is {kind['what']}, not *{extension}", remedy=remedy)
    return _READERS.get(extension, text)
