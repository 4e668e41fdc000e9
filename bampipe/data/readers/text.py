"""Tables as text: CSV in all its dialects (see :mod:`bampipe.data.readers.dialect`).

Rows are counted as an editor does: the first line of the file is row 1.
"""

from __future__ import annotations

import codecs
import re
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv

from bampipe.data.readers import dialect as dialects
from bampipe.data.readers import moments
from bampipe.data.readers.dialect import HEAD, NULLS, TableLayout
from bampipe.data.readers.trial import Dialect, RawTrial, Wanted, check_size, joined
from bampipe.errors import InputError
from bampipe.files import temporary_space

BLOCK = 1 << 20
_UTF16 = (b"\xff\xfe", b"\xfe\xff")
_WESTERN = "cp1252"
_TAKEN_AS = "not UTF-8: names and units are taken as Windows-1252"


class _Stretch:
    """A binary file of which only the bytes from ``start`` to ``end`` are seen."""

    def __init__(self, stream: BinaryIO, start: int, end: int) -> None:
        stream.seek(start)
        self._stream = stream
        self._left = max(end - start, 0)
        self.closed = False

    def read(self, size: int = -1) -> bytes:
        size = self._left if size < 0 else min(size, self._left)
        data = self._stream.read(size)
        self._left -= len(data)
        return data

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return False

    def writable(self) -> bool:
        return False

    def close(self) -> None:
        self.closed = True


class _SingleBlanks(_Stretch):
    """The same with one blank in place of several, and none at the ends of a line."""

    _held = b"\n"

    def read(self, size: int = -1) -> bytes:
        while True:
            data = super().read(size)
            text = self._held + data
            body = text.rstrip(b" \t\r\n") if data else text.rstrip(b" \t")
            self._held = text[len(body) :]
            body = re.sub(rb"[ \t]*([\r\n]+)[ \t]*", rb"\1", re.sub(rb"[ \t]+", b" ", body))
            if body or not data:
                return body


def read(path: Path, wanted: Wanted, name: str) -> RawTrial:
    """The wanted columns of a text file.

    Raises:
        InputError: binary data, a wrong layout, or a cell that is not a number; names the row.
    """
    with opened(path, wanted.dialect, name) as (stream, said):
        layout = _layout(stream, wanted, name)
        end, notes = _sound_end(stream, layout)
        values, rows = _read_samples(stream, layout, end, wanted, name)
    if rows == 0:
        raise InputError("a header but no samples", where=name)
    units = {column: layout.units[column] for column in wanted.columns if column in layout.units}
    return RawTrial(values, layout.first_line, notes, (*said, *layout.remarks), units)


def columns(path: Path, name: str, dialect: Dialect | None = None) -> dict[str, str]:
    """Names and units of the columns of numbers, or of moments (unit "datetime").

    Raises:
        InputError: as :func:`read`.
    """
    dialect = dialect or Dialect()
    with opened(path, dialect, name) as (stream, _):
        head = _head(stream, name)
    layout = dialects.find_layout(head, (), dialect, name)
    return {
        column: "datetime" if is_moment else layout.units.get(column, "")
        for column, is_moment in dialects.readable_columns(head, layout).items()
    }


@contextmanager
def opened(path: Path, dialect: Dialect, name: str) -> Iterator[tuple[BinaryIO, tuple[str, ...]]]:
    """The file as UTF-8, itself or a copy of it in a file without a name; and what to say of it.

    Raises:
        InputError: it is not in the encoding that it claims.
    """
    with path.open("rb") as stream:
        head = stream.read(HEAD)
        stream.seek(0)
        encoding = dialect.encoding or _encoding(head)
        if encoding == "utf-8":
            yield stream, ()
            return
        with ExitStack() as stack:
            with temporary_space():
                copy = stack.enter_context(tempfile.TemporaryFile())
                _transcode(stream, copy, encoding, name)
                copy.seek(0)
            yield copy, (_TAKEN_AS,) if encoding == _WESTERN and not dialect.encoding else ()


def _encoding(head: bytes) -> str:
    """UTF-16 by its byte order mark, or by the zeros in every other byte; else UTF-8.

    What is not UTF-8 is taken as the Western European text that older loggers write, if it can
    be: names and units such as a degree sign depend on that, numbers do not.
    """
    if head.startswith(_UTF16):
        return "utf-16"
    even, odd = head[0::2].count(0), head[1::2].count(0)
    if min(even, odd) == 0 and max(even, odd) > 0.4 * len(head):
        return "utf-16-be" if even else "utf-16-le"
    for encoding in ("utf-8", _WESTERN):
        try:
            codecs.getincrementaldecoder(encoding)().decode(head)
        except UnicodeDecodeError:
            continue
        return encoding
    return "utf-8"


def _transcode(stream: BinaryIO, copy: BinaryIO, encoding: str, name: str) -> None:
    decoder = codecs.getincrementaldecoder(encoding)()
    try:
        while block := stream.read(BLOCK):
            copy.write(decoder.decode(block).encode("utf-8", "replace"))
        copy.write(decoder.decode(b"", final=True).encode("utf-8", "replace"))
    except UnicodeDecodeError as error:
        raise InputError(
            f"not sound {encoding.upper()} text ({error.reason})",
            where=name,
            remedy="save it as UTF-8, or say another encoding under [csv]",
        ) from error


def _head(stream: BinaryIO, name: str) -> bytes:
    """The first 64 kB, if they can be lines of a table."""
    head = stream.read(HEAD)
    if b"\0" in head:
        raise InputError("binary data, not text", where=name, remedy="export the log as CSV")
    line = re.split(rb"[\r\n]", head, maxsplit=1)[0]
    if len(line) == HEAD:
        raise InputError("no line end in the first 64 kB: not a table", where=name)
    text = line.decode("utf-8", "ignore").removeprefix("\ufeff")
    if not text.isprintable() and "\t" not in text:
        raise InputError("binary data, not text", where=name, remedy="export the log as CSV")
    return head


def _layout(stream: BinaryIO, wanted: Wanted, name: str) -> TableLayout:
    return dialects.find_layout(_head(stream, name), wanted.columns, wanted.dialect, name)


def _read_samples(
    stream: BinaryIO, layout: TableLayout, end: int, wanted: Wanted, name: str
) -> tuple[dict[str, np.ndarray], int]:
    """The wanted columns of the samples before byte ``end``, and how many samples there are."""
    kinds = {c: pa.string() if c in wanted.datetimes else pa.float64() for c in wanted.columns}
    header = layout.header
    parts: dict[str, list[np.ndarray]] = {column: [] for column in wanted.columns}
    rows = 0
    seen = _SingleBlanks if layout.delimiter == " " else _Stretch
    source = pa.PythonFile(seen(stream, layout.start, end), mode="r")
    try:
        reader = pa_csv.open_csv(
            source,
            read_options=pa_csv.ReadOptions(
                use_threads=False,
                block_size=BLOCK,
                # Names that are not wanted may be repeated or empty: a number stands for them.
                column_names=[c if c in kinds else f"\0{n}" for n, c in enumerate(header)],
            ),
            parse_options=pa_csv.ParseOptions(delimiter=layout.delimiter),
            convert_options=pa_csv.ConvertOptions(
                column_types=kinds,
                include_columns=list(kinds),
                null_values=[*NULLS, *wanted.dialect.missing],
                strings_can_be_null=True,
                decimal_point=layout.decimal,
            ),
        )
        for batch in reader:
            for column in wanted.columns:
                cells = batch.column(column)
                if column in wanted.datetimes:
                    form = wanted.datetimes[column]
                    where = f"{name}, column '{column}'"
                    first = layout.first_line + rows
                    parts[column].append(moments.nanoseconds(cells.to_pylist(), form, where, first))
                    continue
                values = cells.to_numpy(zero_copy_only=False)
                parts[column].append(np.array(values, dtype=np.float64))
            rows += batch.num_rows
            check_size(rows, wanted, name)
    except pa.ArrowInvalid as error:
        if "Empty CSV file" in str(error):
            return {}, 0
        raise _fault(stream, str(error), layout, name) from error
    values = joined(parts)
    for column in wanted.datetimes:
        values[column] = moments.seconds(values[column])
    return values, rows


def _sound_end(stream: BinaryIO, layout: TableLayout) -> tuple[int, tuple[str, ...]]:
    """Byte where the last whole row ends, and what is said about the rest.

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
    if not last:
        return size, ()
    row = _split(last, layout)
    short = len(row) < len(layout.header)
    if not short and not ended and cut >= 0:
        above = _split(re.split(rb"[\r\n]+", content[:cut].rstrip(b"\r\n"))[-1], layout)
        sign = layout.decimal.encode()
        decimals = [cells[-1].strip().partition(sign) for cells in (row, above)]
        short = not (decimals[0][1] and len(decimals[0][2]) == len(decimals[1][2]))
    if not short:
        return size, ()
    return start + cut + 1, ("last line is cut off: 1 row dropped",)


def _split(line: bytes, layout: TableLayout) -> list[bytes]:
    return line.split() if layout.delimiter == " " else line.split(layout.delimiter.encode())


def _fault(stream: BinaryIO, message: str, layout: TableLayout, name: str) -> InputError:
    """The plain form of what Arrow says about a text file."""
    torn = re.search(
        r"Row #(\d+): Expected (\d+) columns, got (\d+): (.*?)(?: \.\.\.)?$", message, re.DOTALL
    )
    if torn:
        row, expected, actual, text = int(torn[1]), int(torn[2]), int(torn[3]), torn[4]
        commas = actual > expected and re.fullmatch(r'[\s"0-9,+-]*', text)
        clock = re.search(r"\d+:\d\d:\d\d,\d+", text) if layout.delimiter == "," else None
        remedy = "the line is damaged"
        if commas:
            remedy = (
                "decimal commas? export with semicolons between columns, or points as decimal sign"
            )
        elif clock and actual > expected:
            remedy = (
                f"the comma in '{clock[0]}' separates columns, too: export with semicolons between"
                " columns, or a point before the fraction of a second"
            )
        return InputError(
            f"{actual} cells, where the header has {expected}",
            where=f"{name}, row {_line(stream, layout, row)}",
            remedy=remedy,
        )
    cell = re.search(
        r"In CSV column #(\d+): (?:Row #(\d+): )?.*invalid value '(.*)'", message, re.DOTALL
    )
    if cell is None:
        what = "a line is far too long" if "straddl" in message else message
        return InputError(what, where=name)
    column, row_number, value = layout.header[int(cell[1])], cell[2], cell[3]
    shown = value if value.isprintable() and len(value) <= 40 else ascii(value)[1:41]
    other = "," if layout.decimal == "." else "."
    sign = re.fullmatch(rf"\s*[-+]?\d+{re.escape(other)}\d+\s*", value)
    at = f", row {_line(stream, layout, int(row_number))}" if row_number else ""
    remedy = ""
    if sign:
        remedy = f"export with one decimal sign; '{layout.decimal}' was taken from the first rows"
    elif value.strip().strip('"') == column:
        remedy = (
            "the header once more: several recordings in one file? put each into one of its own"
        )
    elif moments.is_moment(value):
        remedy = 'is it the time? then say unit = "datetime" under [time]'
    elif shown == value and re.fullmatch(r"[^\d\"\\]+", value.strip()):
        remedy = f'if that means no reading, say missing = ["{value.strip()}"] under [csv]'
    elif re.fullmatch(r"[-+]?[\d.,]+(e[-+]?\d+)?\s+[^\d\s]\S*", value.strip(), re.IGNORECASE):
        remedy = "export numbers without their units"
    return InputError(
        f"found '{shown}', expected a number",
        where=f"{name}{at}, column '{column}'",
        remedy=remedy,
    )


def _line(stream: BinaryIO, layout: TableLayout, row: int) -> int:
    """Line of the file that holds Arrow's row ``row``: Arrow does not count blank lines."""
    stream.seek(layout.start)
    full = 0
    for number, line in enumerate(stream, layout.first_line):
        full += bool(line.strip(b"\r\n"))
        if full == row:
            return number
    return layout.first_line + row
