"""Tables as text: CSV in all its dialects (see :mod:`bampipe.data.readers.dialect`).

Rows are counted as an editor does: the first line of the file is row 1.
"""

import codecs
import csv
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv

from bampipe.data.readers import dialect as dialects
from bampipe.data.readers import moments, rewriting
from bampipe.data.readers.dialect import TableLayout
from bampipe.data.readers.heads import HEAD, NULLS, Line
from bampipe.data.readers.trial import Dialect, RawTrial, Wanted, check_size, need, opened
from bampipe.data.refusals import refusal
from bampipe.data.vocabulary import VOCABULARY
from bampipe.errors import InputError, located

BLOCK = 1 << 20
_MOST_CHATTER = 50
"""Lines of text among the samples, messages of a logger, that are left out."""
_LEAST_ROWS, _MANY_ROWS = 0.05, 0.5
"""Share of rows of numbers in a table's first lines, and where its extension tells nothing."""
_UTF16 = (b"\xff\xfe", b"\xfe\xff")
_WESTERN = "cp1252"
_TAKEN_AS = {_WESTERN: "Windows-1252", "gb18030": "GBK", "shift_jis": "Shift-JIS"}
"""Encodings other than UTF-8, by their usual names."""


def read(path: Path, wanted: Wanted) -> RawTrial:
    """The wanted columns of a text file.

    Raises:
        InputError: binary data, a wrong layout, or a cell that is not a number; names the row.
    """
    with _opened(path, wanted.dialect) as (stream, dialect, said):
        layout = dialects.find_layout(_head(stream), wanted.columns, dialect)
        end, notes = _sound_end(stream, layout)
        samples = _Samples(wanted)
        _read_samples(stream, layout, end, samples)
    if samples.rows == 0:
        raise InputError("a header but no samples")
    units = {c: layout.units[c] for c in wanted.columns if c in layout.units}
    units = {c: unit for c, unit in units.items() if c not in wanted.datetimes}  # [hh:mm:ss]
    return RawTrial(
        samples.values(),
        samples.column(""),
        (*notes, *samples.notes),
        (*said, *layout.remarks),
        units,
        tuple(samples.begun),
        samples.since,
    )


def columns(path: Path, dialect: Dialect | None = None) -> dict[str, str]:
    """Names and units of the columns of numbers, or of moments (unit "datetime")."""
    head, dialect = _rewritten_head(path, dialect or Dialect())
    if dialects.share_of_rows(head) < _LEAST_ROWS:
        return {}
    layout = dialects.find_layout(head, (), dialect)
    return {
        column: "datetime" if is_moment else layout.units.get(column, "")
        for column, is_moment in dialects.readable_columns(head, layout).items()
    }


def above_samples(path: Path) -> str:
    """The text above the samples of a table."""
    head, dialect = _rewritten_head(path, Dialect())
    start = dialects.find_layout(head, (), dialect).start
    return head[:start].decode("utf-8", "replace")


def is_table(path: Path) -> bool:
    """Whether a file of an unknown extension is text with rows of numbers."""
    try:
        with path.open("rb") as file:
            _head(file)
        return dialects.share_of_rows(_rewritten_head(path, Dialect())[0]) > _MANY_ROWS
    except (OSError, InputError):
        return False


def _rewritten_head(path: Path, dialect: Dialect) -> tuple[bytes, Dialect]:
    with _opened(path, dialect) as (stream, dialect, _):
        return _head(stream), dialect


@contextmanager
def _opened(path: Path, dialect: Dialect) -> Iterator[tuple[BinaryIO, Dialect, tuple[str, ...]]]:
    """The file as a table in UTF-8, itself or a copy in memory; its dialect, and remarks on it.

    InputError where it is not in the encoding that it claims.
    """
    with opened(path) as file:
        stream = _sheet(file) if path.suffix.lower().startswith(".xls") else file
        head = stream.read(HEAD)
        stream.seek(max(path.stat().st_size - HEAD, 0))
        tail = stream.read()
        stream.seek(0)
        encoding = dialect.encoding or _encoding(head)
        if b"\0" in head + tail and not encoding.startswith("utf-16"):
            # A logger reserves space that it does not fill, or loses power before it has.
            stream = io.BytesIO(stream.read().replace(b"\0", b""))
        whole = head[: head.rfind(b"\n") + 1] or head
        plain = whole.decode(encoding, "ignore").removeprefix("\ufeff")
        names = rewriting.unbroken(plain)
        form, broken = rewriting.find_form(names), names != plain
        if encoding == "utf-8" and form is None and not broken:
            yield stream, dialect, ()
            return
        try:
            # A line cut off by a serial port may contain bytes that are not valid UTF-8.
            lenient = encoding == "utf-8" and not dialect.encoding
            text = stream.read().decode(encoding, "replace" if lenient else "strict")
        except UnicodeDecodeError as error:
            raise refusal("encoding", encoding=encoding.upper(), reason=error.reason) from error
        taken = "" if dialect.encoding else _TAKEN_AS.get(encoding, "")
        said = (f"not UTF-8: names and units are taken as {taken}",) if taken else ()
        text = rewriting.unbroken(text) if broken else text
        if form is not None:
            text = re.sub(r"[^\r\n]+", lambda line: form.rewrite(line[0]), text)
            said = (*said, form.said) if form.said else said
            if form.names and not dialect.names:
                dialect = dialect.model_copy(update={"names": form.names})
        yield io.BytesIO(text.encode("utf-8", "replace")), dialect, said


def _sheet(file: BinaryIO) -> BinaryIO:
    """The sheets of a workbook that have the header of the longest, as CSV, one below the other.

    Sheets that share their first column, such as time, add their other columns to those.
    InputError without openpyxl.
    """
    load = need("openpyxl", "xlsx").load_workbook
    book = load(file, read_only=True, data_only=True)
    sheets = [[*sheet.iter_rows(values_only=True)] for sheet in book.worksheets]
    longest = max(sheets, key=len, default=[])
    named = [row for row in longest if sum(isinstance(cell, str) for cell in row) > 1][:1]
    columns = zip_longest(*longest[longest.index(named[0]) :]) if named else iter(())
    for n, (name, *column) in enumerate(columns, 1):
        if name and column.count(None) == len(column) > 0:
            sheet = load(file, read_only=True).worksheets[sheets.index(longest)]
            last = sheet.iter_rows(len(longest), len(longest), n, n, values_only=True)
            if str(next(last)[0]).startswith("="):
                raise refusal("formulas", f"column '{name}'")
    text = io.StringIO(newline="")
    for rows in sheets if named else [longest]:
        if rows is longest or named[0] in rows:
            alike = [x for x in sheets if named and [r[:1] for r in x] == [r[:1] for r in rows]]
            at = rows.index(named[0]) if alike else 0
            new = [(x, c) for x in alike for c, name in enumerate(x[at]) if name not in rows[at]]
            wide = ([*row, *(x[n][c] for x, c in new)] for n, row in enumerate(rows))
            csv.writer(text).writerows(wide)
    return io.BytesIO(text.getvalue().encode())


def _encoding(head: bytes) -> str:
    """UTF-16 by its byte order mark, or by the zeros in every other byte; else UTF-8.

    What is not UTF-8 is taken as the Western European text that older loggers write, if it can
    be: names and units such as a degree sign depend on that, numbers do not.
    """
    if head.startswith(_UTF16):
        return "utf-16"
    asian = _asian(head)
    if asian:
        return asian
    even, odd = head[0::2].count(0), head[1::2].count(0)
    if min(even, odd) == 0 and max(even, odd) > 0.4 * len(head):
        return "utf-16-be" if even else "utf-16-le"
    return _WESTERN if not _sound(head, "utf-8") and _sound(head, _WESTERN) else "utf-8"


def _asian(head: bytes) -> str:
    """The Chinese or Japanese encoding in which all bytes beyond ASCII are letters, or ""."""
    runs = re.findall(rb"[\x80-\xff]+", head)
    if not runs or _sound(head, "utf-8"):
        return ""
    # Letters of Western Europe stand alone among others; below b0, GBK has dots and other signs.
    lone = re.search(rb"[A-Za-z][\xb0-\xff][\x80-\xff](?![\x80-\xff])", head)
    if not lone and all(len(run) % 2 == 0 for run in runs) and _sound(head, "gb2312"):
        return "gb18030"
    japanese = re.findall(rb"[\x82\x83\x88-\x9f][\x40-\xfc]", head)
    return "shift_jis" if len(japanese) > 2 and _sound(head, "shift_jis") else ""


def _sound(head: bytes, encoding: str) -> bool:
    try:
        codecs.getincrementaldecoder(encoding)().decode(head)
    except UnicodeDecodeError:
        return False
    return True


def _head(stream: BinaryIO) -> bytes:
    """The first 64 kB, if they can be lines of a table."""
    head = stream.read(HEAD)
    line = re.split(rb"[\r\n]", head, maxsplit=1)[0]
    text = line.decode("utf-8", "ignore").removeprefix("\ufeff")
    if b"\0" in head or not (text.isprintable() or "\t" in text):
        raise InputError("binary data, not text", remedy="export the log as CSV")
    if len(line) == HEAD:
        raise InputError("no line end in the first 64 kB: not a table")
    return head


@dataclass
class _Samples:
    """Samples read so far, in batches of the wanted columns and, as "", their lines."""

    wanted: Wanted
    nothing: list[str] = field(default_factory=list)
    batches: list[dict[str, np.ndarray]] = field(default_factory=list)
    rows: int = 0
    notes: list[str] = field(default_factory=list)
    resumed: bool = False
    begun: list[int] = field(default_factory=list)
    since: dict[str, int] = field(default_factory=dict)

    def add(self, batch: pa.RecordBatch, first_line: int) -> None:
        held = {"": np.arange(first_line, first_line + batch.num_rows)}
        for column in self.wanted.columns:
            cells = batch.column(column)
            if column in self.wanted.datetimes:
                form = self.wanted.datetimes[column]
                with located(f"column '{column}'"):
                    held[column] = moments.nanoseconds(cells.to_pylist(), form, first_line)
            else:
                held[column] = np.array(cells.to_numpy(zero_copy_only=False), dtype=np.float64)
        self.batches.append(held)
        self.rows += batch.num_rows
        check_size(self.rows, self.wanted)

    def passes_over(self, message: str, line: Line, layout: TableLayout) -> bool:
        """Whether a word stands where a number is expected: no reading, as "OVERLOAD" says."""
        cell = _CELL.search(message)
        if not cell or not _NO_READING.fullmatch(cell[2]) or len(self.nothing) == _MOST_WORDS:
            return False
        self.nothing.append(cell[2])
        column = layout.header[int(cell[1])]
        self.notes.append(
            f"column '{column}' says '{cell[2]}' from row {line.number} on: taken as no reading"
        )
        return True

    def column(self, name: str) -> np.ndarray:
        """A column, whose batches are let go of, so that no other is held twice meanwhile."""
        return np.concatenate([held.pop(name) for held in self.batches])

    def values(self) -> dict[str, np.ndarray]:
        values = {column: self.column(column) for column in self.wanted.columns}
        for column in self.wanted.datetimes:
            known = values[column][values[column] != np.iinfo(np.int64).min]
            self.since |= {column: int(known[0])} if len(known) else {}
            values[column] = moments.seconds(values[column])
        return values


def _read_samples(stream: BinaryIO, layout: TableLayout, end: int, samples: _Samples) -> None:
    """Read the samples before byte ``end``, past lines of text that hold none.

    InputError where a row is damaged, or too many lines are text.
    """
    while True:
        rows, batches = samples.rows, len(samples.batches)
        try:
            _read_stretch(stream, layout, end, samples)
            return
        except pa.ArrowInvalid as error:
            line = _faulty_line(stream, str(error), samples.rows - rows, layout)
            again = layout.is_header(line.text)
            samples.rows = rows
            del samples.batches[batches:]
            if not again and layout.begins_another(line.text):
                raise refusal("second_table", f"row {line.number}") from error
            if not again and _is_end(stream, line, end, layout):
                samples.notes.append(f"row {line.number} and what follows are no samples: left out")
                end = line.start
                continue
            if not (again or layout.is_chatter(line.text)):
                if samples.passes_over(str(error), line, layout):
                    continue
                if samples.resumed and line.number - layout.first_line < 5:
                    raise refusal("second_table", f"row {line.number}") from error
                raise _fault(str(error), layout, line) from error
            _read_samples(stream, layout, line.start, samples)
            if again:
                samples.begun += [samples.rows] if samples.rows else []
            elif len(samples.notes) == _MOST_CHATTER:
                raise refusal("chatter", f"row {line.number}", lines=_MOST_CHATTER) from error
            else:
                ends = layout.ends_in_words(line.text)
                what = "ends in words" if ends else "is text and no sample"
                samples.notes.append(f"row {line.number} {what}: left out")
            samples.resumed = True
            layout = replace(layout, start=line.end, first_line=line.number + 1)


def _read_stretch(stream: BinaryIO, layout: TableLayout, end: int, samples: _Samples) -> None:
    wanted = samples.wanted
    kinds = {c: pa.string() if c in wanted.datetimes else pa.float64() for c in wanted.columns}
    # Names that are not wanted may be repeated or empty: a number stands for them.
    names = [c if c in kinds else f"\0{n}" for n, c in enumerate(layout.header)]
    at, before, held = layout.start, samples.rows, b""
    # Block by block: Arrow's own reader of streams keeps a thread that a faulty row leaves waiting
    # for itself, and then the process never ends.
    while at < end or held:
        stream.seek(at)
        block = stream.read(min(BLOCK, end - at))
        held += block or b"\n"
        at, end = at + len(block), end if block else at  # the file may have become shorter
        cut = max(held.rfind(b"\n"), held.rfind(b"\r")) + 1
        whole, held = held[:cut], held[cut:]
        if len(held) > BLOCK:
            raise InputError("a line is far too long")
        if layout.delimiter == " ":
            whole = re.sub(
                rb"[ \t]*([\r\n]+)[ \t]*", rb"\1", re.sub(rb"[ \t]+", b" ", whole)
            ).strip(b" ")
        if not whole.strip():
            continue
        table = pa_csv.read_csv(
            pa.BufferReader(whole),
            pa_csv.ReadOptions(use_threads=False, block_size=len(whole) + 1, column_names=names),
            pa_csv.ParseOptions(delimiter=layout.delimiter),
            pa_csv.ConvertOptions(
                column_types=kinds,
                include_columns=list(kinds),
                null_values=[*NULLS, *wanted.dialect.missing, *samples.nothing],
                strings_can_be_null=True,
                decimal_point=layout.decimal,
            ),
        )
        for batch in table.to_batches():
            samples.add(batch, layout.first_line + samples.rows - before)


def _is_end(stream: BinaryIO, line: Line, end: int, layout: TableLayout) -> bool:
    """Whether this line and all that follow are words about the log, as a summary at its end."""
    if line.start <= layout.start or end - line.start > HEAD:
        return False
    stream.seek(line.start)
    rest = stream.read(end - line.start).decode("utf-8", "replace").splitlines()
    return all(layout.is_remark(text) for text in rest if text.strip())


def _sound_end(stream: BinaryIO, layout: TableLayout) -> tuple[int, tuple[str, ...]]:
    """Byte where the last whole row ends, and the remark on the rest.

    A last line is cut off when it has too few cells, or when it has no line end and its last
    cell does not have as many decimals as the one above.
    """
    size = stream.seek(0, 2)
    start = max(layout.start, size - HEAD)
    stream.seek(start)
    tail = stream.read(size - start)  # no further: the file may have grown since its size was taken
    content = tail.rstrip(b"\r\n")
    ended = len(content) < len(tail)
    cut = max(content.rfind(b"\n"), content.rfind(b"\r"))
    last = content[cut + 1 :]
    if not last or layout.is_remark(last.decode("utf-8", "replace")):
        return size, ()
    above = re.split(rb"[\r\n]+", content[: max(cut, 0)].rstrip(b"\r\n"))[-1]
    rows = [layout.cells(line.decode("utf-8", "replace")) for line in (last, above)]
    short = len(rows[0]) < len(layout.header)
    if not short and not ended and cut >= 0:
        decimals = ["".join(row[-1:]).partition(layout.decimal) for row in rows]
        short = not (decimals[0][1] and len(decimals[0][2]) == len(decimals[1][2]))
    if not short:
        return size, ()
    return start + cut + 1, ("last line is cut off: 1 row dropped",)


_NO_READING = re.compile(r"[^\d\s\"\\][^\d\"\\]{0,19}|[-+]?1[.,]#\w+|#[A-Z]+[/\d!?]*")
"""Words for no reading, numbers of old C libraries among them."""
_MOST_WORDS = 8
_ROW = re.compile(r"Row #(\d+): ")
_CELL = re.compile(r"In CSV column #(\d+): .*invalid value '(.*)'", re.DOTALL)


def _faulty_line(stream: BinaryIO, message: str, read: int, layout: TableLayout) -> Line:
    """The line that Arrow complains about, behind the rows ``read``: it does not count blank lines.

    InputError where it complains of none.
    """
    found = _ROW.search(message)
    row = read + int(found[1]) if found else -1
    stream.seek(layout.start)
    at, full = layout.start, 0
    for number, line in enumerate(stream, layout.first_line):
        full += bool(line.strip(b"\r\n"))
        if full == row:
            text = line.decode("utf-8", "replace").strip("\r\n")
            return Line(number, at, at + len(line), text)
        at += len(line)
    raise InputError(message)


def _fault(message: str, layout: TableLayout, line: Line) -> InputError:
    """The plain form of Arrow's message on a line of a text file."""
    where, cell = f"row {line.number}", _CELL.search(message)
    if cell is None:
        known = {"expected": len(layout.header), "actual": len(layout.cells(line.text))}
        clock = re.search(r"\d+:\d\d:\d\d,\d+", line.text) if layout.delimiter == "," else None
        if known["actual"] > known["expected"] and re.fullmatch(r'[\s"0-9,+-]*', line.text):
            return refusal("torn_at_decimals", where, **known)
        if known["actual"] > known["expected"] and clock:
            return refusal("torn_at_seconds", where, **known, clock=clock[0])
        if line.number == layout.first_line:
            return refusal("no_fit", where, **known)
        return refusal("torn", where, **known)
    column, value = layout.header[int(cell[1])], cell[2]
    shown = value if value.isprintable() and len(value) <= 40 else ascii(value)[1:41]
    fitting = (r for r in VOCABULARY["no_numbers"] if re.fullmatch(r["cell"], value.strip()))
    remedy = str(next(fitting, {"remedy": ""})["remedy"])
    if moments.is_moment(value):
        remedy = 'is it the time? then say unit = "datetime" under [time]'
    remedy = remedy.format(cell=value.strip(), decimal=layout.decimal)
    where = f"{where}, column '{column}'"
    return InputError(f"found '{shown}', expected a number", where=where, remedy=remedy)
