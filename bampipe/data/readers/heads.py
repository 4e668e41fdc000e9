"""Lines of a text table, what their cells hold, and which of them is the header with the names."""

import csv
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise, product
from typing import NamedTuple

from bampipe.data.readers.moments import is_moment
from bampipe.data.readers.trial import NUMBER, Dialect, check_columns
from bampipe.data.refusals import refusal
from bampipe.data.units import unit
from bampipe.data.vocabulary import word_set

HEAD = 1 << 16
TRIED, SEARCHED = 400, 200
"""Most lines from which the notation of samples is taken, and in which a header is looked for."""
NULLS = ("", "nan", "NaN", "NAN", "NA", "N/A", "n/a", "#N/A", "null", "NULL", "None")
"""Cells that mean: no number here."""
DELIMITERS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "blanks"}
POINT = re.compile(rf"{NUMBER}\Z")
_COMMA = re.compile(r"[-+]?(\d+,\d*|,\d+)([eE][-+]?\d+)?\Z")
_REMARK = re.compile(r"\s*(#|%|//|\"#)+\s?((?i:columns|fields): +(?=\w+ ?[\[(,]))?")
_BYTE_ORDER = b"\xef\xbb\xbf"
_PROPERTY = re.compile(r"\A[A-Za-z ]+:\s+(?=\S)")
"""Key before what a cell says of a channel: ``Type: double``."""
_PLAIN_NAME = re.compile(r"[^\W\d][\w./-]*(\s?[\[(].*[\])])?\Z")
_NUMBERED = "column_"
_NAME_KEYS = word_set("name_keys")
_LISTED = re.compile(
    r"(?i)\W*(?:name|column|channel|signal|ch|col|spalte|kanal)?[ _#]*(\d+)(?:[ _]?name)?\s*[:=)]"
    r"\s*([^\W\d_].*)"
)
_FEW_UNITS = 3
"""Units of a line, of which each has to be known."""
_ALIKE = 0.97
"""Share of the most numbers in cells that is as good: words above samples may hold a number."""


@dataclass(frozen=True)
class Line:
    """A line of a file: its number, its bytes in the file, and its text without the line end."""

    number: int
    start: int
    end: int
    text: str


def split_lines(head: bytes) -> list[Line]:
    """The whole lines of ``head`` that are not blank, and the last one where it is all there is.

    Raises:
        InputError: the first text is not UTF-8.
    """
    found: list[Line] = []
    start = len(_BYTE_ORDER) * head.startswith(_BYTE_ORDER)
    for number, match in enumerate(re.finditer(rb"[^\r\n]*(\r\n|\n|\r|\Z)", head[start:]), 1):
        end = start + match.end()
        if (end == len(head) and len(head) >= HEAD and found) or match.start() == match.end():
            break
        try:
            text = match[0].decode("utf-8")
        except UnicodeDecodeError as error:
            if number <= 2 and not found:
                raise refusal("header_encoding", f"row {number}") from error
            text = match[0].decode("utf-8", "replace")
        if text.strip():
            found.append(Line(number, start + match.start(), end, text.rstrip("\r\n")))
    return found


def cells(text: str, delimiter: str) -> list[str]:
    """The cells of one line, without the blanks around them."""
    if delimiter == " ":
        return text.split()
    row = next(csv.reader([text.replace("\r", " ")], delimiter=delimiter), [])
    return [cell.strip() for cell in row]


def is_remark(text: str) -> bool:
    """Whether a line is marked as a remark, or is a rule."""
    return bool(_REMARK.match(text) or re.fullmatch(r"\s*[-=_*~]{3,}[-=_*~+|\s]*", text))


def without_mark(text: str) -> str:
    """A line without the mark of a remark before it."""
    return _REMARK.sub("", text, count=1)


def is_number(cell: str, decimal: str) -> bool:
    """Whether a cell is a number with a point or, where that is the sign, a decimal comma."""
    return bool(POINT.match(cell) or (decimal == "," and _COMMA.match(cell)))


def count_readings(row: Iterable[str]) -> int:
    """Number of cells that are numbers, with whatever decimal sign, or dates and times."""
    return sum(is_number(cell, ",") or is_moment(cell) for cell in row)


def are_units(row: list[str]) -> bool:
    """Whether every cell is a unit that is known, or stands in brackets; one of many may not."""
    said = [cell for cell in row if cell]
    known = sum(bool(re.match(r"[\[(]", cell)) or unit(cell) is not None for cell in said)
    return bool(said) and known >= len(said) - (len(said) > _FEW_UNITS)


def of_properties(row: list[str]) -> tuple[list[str], bool]:
    """A row below the header without its keys, and whether it has such: ``Unit``, ``Type: double``.

    Programs for measurements write what they know of a channel there.
    """
    said = [cell for cell in row if cell]
    if len([*filter(_PROPERTY.match, said)]) >= 0.5 * len(said) > 0:
        return [_PROPERTY.sub("", cell) for cell in row], True
    key = row[0] if row else ""
    numbers = any(POINT.match(cell) and cell != "1" for cell in said)  # as the Min of a channel
    if not re.match(r"[^\W\d_]{3}", key) or not (numbers or unit(key) is None):
        return row, False
    return ["" if cell == key else cell for cell in row], True


class Header(NamedTuple):
    """Place of the header among the lines, -1 where there is none; delimiter of the samples."""

    at: int
    delimiter: str
    names: list[str]


def find_header(lines: list[Line], columns: Sequence[str], dialect: Dialect) -> Header:
    """The header that has ``columns``; of columns that the session names, the last line above.

    Raises:
        InputError: no header, a column missing or twice.
    """
    delimiters: list[str] = [dialect.delimiter] if dialect.delimiter else list(DELIMITERS)
    starts = find_starts(lines, delimiters)
    first, mark = starts[0]
    if dialect.names:
        check_columns(dialect.names, columns, "csv.names")
        return Header(first - 1, mark, list(dialect.names))
    samples = cells(lines[first].text, mark) if first < len(lines) else []
    width = len(samples)

    def names(index: int, delimiter: str) -> list[str]:
        row = _names(lines[index].text, delimiter, lines[index + 1 :], lines[:index])
        return _fitted(row, lines[index].text, width)

    # A remark above the header may have a name among its words.
    searched = enumerate(lines[: SEARCHED * any(columns)])
    for whole, (index, line) in product((True, False), searched):
        for delimiter in delimiters:
            row = names(index, delimiter)
            if set(columns) <= set(row) and (not whole or width - 1 <= len(row) <= width):
                check_columns(row, columns, f"row {line.number}")
                start, below = find_starts(lines[index + 1 :], delimiters)[0]
                rows = lines[index + 1 + start :]  # may be separated otherwise than the header
                fits = len(row) > 1 and rows and len(cells(rows[0].text, below)) == len(row)
                return Header(index, below if fits else delimiter, row)
    found = ((_find_above(lines, *start), start[1]) for start in starts)
    index, delimiter = next((each for each in found if each[0] >= 0), (-1, ""))
    row = names(index, delimiter) if index >= 0 else []
    numbered = [match for line in lines[:first] if (match := _LISTED.match(line.text))]
    in_order = {int(after[1]) - int(match[1]) for match, after in pairwise(numbered)} == {1}
    listed = [match[2].strip() for match in numbered] if in_order else []  # by number, a line each
    unnamed = sum(bool(re.search(r"\w", name)) for name in row) < width
    unnamed |= index >= 0 and _LISTED.match(lines[index].text) is not None
    if unnamed and len(listed) == width > 1 and {*columns} <= {*listed}:
        check_columns(listed, columns, "the list of columns")
        return Header(first - 1, mark, listed)
    if index < 0:
        above = cells(lines[first - 1].text, mark) if 0 < first < len(lines) else []
        if mark == "," and 2 * len(above) == width and "." not in lines[first].text:
            place, known = f"row {lines[first].number}", {"actual": width, "expected": len(above)}
            raise refusal("torn_at_decimals", place, **known)
        row = [f"{_NUMBERED}{n}" for n, _ in enumerate(samples, 1)]
        if set(columns) <= set(row):
            return Header(first - 1, mark, row)
        place, said = f"row {lines[0].number}", ",".join(columns)
        raise refusal("no_header", place, columns=said, first=row[0], last=row[-1])
    check_columns(row, columns, f"row {lines[index].number}")
    return Header(index, delimiter, row)


def find_starts(lines: list[Line], delimiters: list[str]) -> list[tuple[int, str]]:
    """Candidate starts of the samples and delimiters of their columns that are equally good."""
    ranked: list[tuple[float, int, str]] = []
    for delimiter in delimiters:
        rows = [cells(line.text, delimiter) for line in lines[-TRIED:]]
        width = Counter(map(len, rows)).most_common(1)[0][0] if rows else 0
        count = sum(count_readings(row) for row in rows if len(row) == width)
        ranked.append((count / len(rows) if width > 1 else 0.0, width, delimiter))
    found = []
    best = max(score for score, _, _ in ranked)
    for _, width, delimiter in (each for each in ranked if each[0] >= _ALIKE * best):
        split = [cells(line.text, delimiter) for line in lines]
        numbers = [count_readings(row) if len(row) == width else 0 for row in split]
        worded = [re.match(r"[^\W\d_]", row[0]) is not None if row else False for row in split]
        if 2 * sum(worded) < len(split):  # where samples begin with a number
            numbers = [0 if word else n for n, word in zip(numbers, worded, strict=True)]
        samples = [
            [n for n, row in enumerate(split) if numbers[n] > 0.5 * of(row)]
            for of in (len, lambda row: sum(map(bool, row)))  # of cells, or of those with something
        ]
        # Remarks above a log may be numbers, but not for several lines.
        most = next(filter(None, samples), [])
        first = next((n for n, end in zip(most, most[3:], strict=False) if end - n < 6), -1)
        first = first if first >= 0 else next(iter(most), len(lines))
        # Settings above the names may look like a sample.
        named = [n for n, row in enumerate(split[: first + 3]) if _are_names(row, width)]
        first = named[-1] + 1 if named and named[0] > first else first
        # Rows logged before all sensors had answered are samples with empty cells.
        while 0 < first < len(lines) and _is_sparse(split[first - 1], width):
            first -= 1
        found.append((first, delimiter))
    return found


def _is_sparse(row: list[str], width: int) -> bool:
    """Whether a line is a sample in which cells are empty: numbers and moments, nothing else."""
    return len(row) == width > 1 and all(cell in NULLS or count_readings([cell]) for cell in row)


def _are_names(row: list[str], width: int) -> bool:
    """Whether a line holds so many names, and no sentence."""
    return len(row) == width > 1 and all(map(_PLAIN_NAME.match, row))


def _find_above(lines: list[Line], first: int, delimiter: str) -> int:
    """Place of the header above the first sample, -1 where there is none."""
    if first >= len(lines):
        return 0
    sample, near = cells(lines[first].text, delimiter), range(max(first - 4, 0), first)
    width = len(sample)
    bare = {n: cells(without_mark(lines[n].text), delimiter) for n in near}
    rows = {n: _fitted(row, lines[n].text, width) for n, row in bare.items()}
    # Below names, unless they are plain, stands nothing with fewer cells: a logger says that first.
    apart = [n for n, row in rows.items() if len(row) < width - 1 and not is_remark(lines[n].text)]
    fitting = [
        n
        for n, row in rows.items()
        if width - 1 <= len(row) <= width
        and (n > max(apart, default=-1) or (delimiter != " " and _are_names(row, width)))
        and not all(map(POINT.match, row))
        and (are_units(row) or all(any(map(str.isalnum, cell)) for cell in row if cell))
    ]
    while len(fitting) > 1 and any(map(_PROPERTY.match, rows[fitting[-1]])):
        fitting.pop()
    while len(fitting) > 1 and all(rows[fitting[-2]]) and _says_more(rows[fitting[-1]]):
        fitting.pop()
    for n in reversed(range(first)):
        row = cells(lines[n].text, delimiter)
        begun = not sample[0] and re.search(r"(?i)(names?:?|waves/?\w?)\Z", row[0])
        if width - (not sample[-1]) <= len(row) <= width and (begun or _is_key_of_names(row)):
            return n
    wordy = [n for n in fitting if not any(map(POINT.match, rows[n]))]
    if wordy and wordy[-1] != fitting[-1]:
        return wordy[-1]  # what is below has numbers, and cells that are empty
    above_units = (
        over for over, n in pairwise(fitting) if are_units(rows[n]) and len(rows[over]) == width
    )
    return next(above_units, fitting[-1] if fitting else -1)


def _says_more(row: list[str]) -> bool:
    """Whether a line below the names holds units or numbers behind a key, or the key alone."""
    said = [cell for cell in of_properties(row)[0] if cell]
    return not said or (len(said) < len(row) and all(unit(x) or POINT.match(x) for x in said))


def _fitted(row: list[str], text: str, width: int) -> list[str]:
    """The names in a header over ``width`` cells, where it is separated otherwise than those, too.

    Without what is behind a last delimiter that they lack; its ``row`` where nothing fits.
    """
    row = row[:-1] if len(row) == width + 1 and not row[-1] else row
    if width - 1 <= len(row) <= width:
        return row
    plain = without_mark(text).strip()
    split = [cells(plain, delimiter) for delimiter in DELIMITERS]
    split += [re.split(r"\s{2,}", plain), re.split(r"\s+(?![\[(])", plain)]
    split += [[item for name in plain.split() for item in _counted(name)]]
    return next((names for names in split if len(names) == width > 1), row)


def _counted(name: str) -> list[str]:
    """The names of as many columns as a name says behind it: ``q[2]``, ``q(1:2)``."""
    match = re.fullmatch(r"(\S+)[\[(](?:1:)?(\d{1,2})[\])]", name)
    return [f"{match[1]}[{k}]" for k in range(int(match[2]))] if match else [name]


def _names(text: str, delimiter: str, below: list[Line], above: list[Line]) -> list[str]:
    """Names in a header, which may be written as a remark: ``# t x`` has two names or three."""
    plain, bare = (cells(t, delimiter) for t in (text, without_mark(text)))
    written = (line.text for line in below if not is_remark(line.text))
    rows = list(islice(written, SEARCHED))
    row = bare if is_remark(text) and plain[0].strip("#%/") else plain
    row = [(name.rstrip(",;") or name).strip("\"'") for name in row]
    beside = cells(above[-1].text, delimiter) if above else []
    if len(beside) == len(row) and sum(map(bool, beside)) > 1:
        # The names of an index stand below those of the columns, as pandas writes them; else a cell
        # of the line above goes on where this one is empty.
        apart = all(bool(a) != bool(b) for a, b in zip(row, beside, strict=True))
        groups = cells(above[-2].text, delimiter) if apart and len(above) > 1 else []
        groups = groups if len(groups) == len(row) else [""] * len(row)
        row = [a or f"{g} {b}".strip() for a, b, g in zip(row, beside, groups, strict=True)]
    if beside and len(beside) == len(row) and re.match(r"(?i)labels?\b", beside[0]):
        labels = ["", *beside[1:]]
        row = [f"{name} {label}".strip() for name, label in zip(row, labels, strict=True)]
    if _is_key_of_names(row):
        row = ["Time" if name == row[0] else name for name in row]
    row = _named_items(row, rows, delimiter)
    unnamed = len(row) > 1 and not row[0]
    first = [cells(text, delimiter)[0] for text in rows] if unnamed else []
    if first and all("." in x or is_moment(x) for x in first):
        row[0] = "index" if "time" in row else "time"  # of a frame of pandas; R numbers its rows
    return _told_apart(_spread(row, rows[0] if rows else "", delimiter), beside)


def _spread(header: list[str], below: str, delimiter: str) -> list[str]:
    """The header with ``q[0]``, ``q[1]`` where names stand over the first of as many columns."""
    starts = [n for n, name in enumerate(header) if name]
    spans = [(a, b) for a, b in pairwise([*starts, len(header)]) if b > a + 1]
    samples = cells(below, delimiter)
    filled = all(map(POINT.match, samples)) and len(samples) == len(header)
    if len(spans) > 1 and len({b - a for a, b in spans}) == 1 and filled:
        for a, b in spans:
            header = [*header[:a], *(f"{header[a]}[{k}]" for k in range(b - a)), *header[b:]]
    return header


def _is_key_of_names(row: list[str]) -> bool:
    """Whether a line says of itself that it holds names: before each of them, or once."""
    key = row[0].lower() if row else ""
    return key.rstrip("=:") in _NAME_KEYS and (
        row.count(row[0]) > 1 or key[-1] in "=:" or key == "path"
    )


def _told_apart(header: list[str], above: list[str]) -> list[str]:
    """The header with names that stand more than once below those of groups, else with a number."""
    count = Counter(name for name in header if name)
    if len(above) == len(header) and not any(map(POINT.match, above)):
        groups = [next(filter(None, above[n::-1]), "") for n in range(len(above))]
        pairs = zip(groups, header, strict=True)
        header = [f"{group} {name}".strip() if count[name] > 1 else name for group, name in pairs]
        count = Counter(name for name in header if name)
    seen = [header[: n + 1].count(name) for n, name in enumerate(header)]
    return [f"{x} ({n})" if count[x] > 1 else x for x, n in zip(header, seen, strict=True)]


def _named_items(header: list[str], below: list[str], delimiter: str) -> list[str]:
    """The header with ``field.effort[elbow]`` for ``field.effort0`` beside a ``field.name0``.

    So are messages with lists written by `rostopic echo -p`; the name has to be that of all rows.
    """
    of: dict[tuple[str, str], str] = {}
    matches = [re.fullmatch(r"(.*)name(\d+)", column) for column in header]
    rows = [cells(text, delimiter) for text in below] if any(matches) else []
    for at, match in enumerate(matches):
        said = {row[at].strip('"') for row in rows if at < len(row)}
        if match and len(said) == 1 and not POINT.match(name := said.pop()) and name:
            of[match[1], match[2]] = name
    named = []
    for column in header:
        match = re.fullmatch(r"(.*?)(\w*?[A-Za-z_])(\d+)", column) if of else None
        item = of.get((match[1], match[3])) if match and match[2] != "name" else None
        named.append(f"{match[1]}{match[2]}[{item}]" if match and item else column)
    return named
