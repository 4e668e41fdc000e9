"""Layout of a text file of numbers: found in its first lines, or refused.

Labs write tables with commas, semicolons, tabs, bars or blanks between columns, with points or
commas as decimal signs, with lines of remarks above the header and a line of units below it. What
can be read in two ways is refused, with the setting that decides: a guess must not change numbers.
"""

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice, pairwise, product, zip_longest

import numpy as np

from bampipe.data.readers.moments import is_moment
from bampipe.data.readers.trial import NUMBER, Dialect, check_columns
from bampipe.data.refusals import refusal
from bampipe.data.units import bare, in_steps, unit, units_in
from bampipe.data.vocabulary import word_set
from bampipe.errors import InputError

HEAD = 1 << 16
NULLS = ("", "nan", "NaN", "NAN", "NA", "N/A", "n/a", "#N/A", "null", "NULL", "None")
"""Cells that mean: no number here."""

DELIMITERS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "blanks"}
_POINT = re.compile(rf"{NUMBER}\Z")
_COMMA = re.compile(r"[-+]?(\d+,\d*|,\d+)([eE][-+]?\d+)?\Z")
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+\Z")
_GROUPED = re.compile(r"[-+]?(\d{1,3}(,\d{3})+\.\d*|\d{1,3}(\.\d{3})+,\d*)\Z")
_UNIT = re.compile(r"[\[(]?\s*(?=.*[A-Za-z%°Ωµμ#1\-])[A-Za-z0-9%°Ωµμ#./*^²³· _\-]{0,16}\s*[\])]?\Z")
_REMARK = re.compile(r"\s*(#|%|//|\"#)+\s?")
_MOTION = re.compile(r"(?i)\binDegrees\s*=\s*yes\b")
_NO_ANGLE = re.compile(
    r"(?i)force|moment|torque|power|activation|excitation|fiber|length|[_.][tpv][xyz]\Z|\Atime\Z"
)
_NUMBERED = "column_"
_NAME_KEYS = word_set("name_keys")
_LISTED = re.compile(
    r"(?i)\W*(?:name|column|channel|signal|ch|col|spalte|kanal)?[ _#]*(\d+)(?:[ _]?name)?\s*[:=)]"
    r"\s*([^\W\d_].*)"
)
_SCALES = re.compile(r"(?i)scal(e|ing)[ _]?(factor)?|factor|faktor|skalierung|lsb")
_SEARCHED = 200
_TRIED = 400
_ALIKE = 0.97
"""Share of the most numbers in cells that is as good: words above samples may hold a number."""
_FEW_UNITS = 3
"""Units of a line, of which each has to be known."""
_LEAST_FILLED = 0.04
"""Least share of the first lines in which a column holds something."""


@dataclass(frozen=True)
class TableLayout:
    """Start and notation of the samples of a text file.

    Attributes:
        first_line: number of the line with the first sample, as an editor counts.
        start: bytes before that line.
        remarks: differences from a plain table with commas, a sentence each.
        units: units that the header or a line below it gives, by column.
        title: the header as a line, "" if there is none.
    """

    delimiter: str
    decimal: str
    header: tuple[str, ...]
    first_line: int
    start: int
    remarks: tuple[str, ...] = ()
    units: dict[str, str] = field(default_factory=dict)
    title: str = ""

    def cells(self, text: str) -> list[str]:
        """The cells of one line."""
        return cells(text, self.delimiter)

    def is_header(self, text: str) -> bool:
        """Whether a line among the samples is the header once more."""
        plain = text.removeprefix("\ufeff")  # of a file that was appended
        return bool(self.title) and self.cells(plain) == self.cells(self.title)

    def is_remark(self, text: str) -> bool:
        """Whether a line begins with a word, where samples begin with a number or a time."""
        first = next(iter(self.cells(text)), "")
        return _is_remark(text) or bool(re.match(r"[^\W\d_]{2}", first))

    def ends_in_words(self, text: str) -> bool:
        """Whether words, such as what an operator noted, stand behind the last cell of a line."""
        behind = [cell for cell in self.cells(text)[len(self.header) :] if cell]
        return bool(behind) and all(re.match(r"[^\W\d_]{2}", cell) for cell in behind)

    def is_chatter(self, text: str) -> bool:
        """Whether a line among the samples is text without a number in any cell, or ends in it."""
        row = [cell for cell in self.cells(text) if cell not in NULLS]
        count = sum(_is_number(cell, self.decimal) or is_moment(cell) for cell in row)
        # The title of a block may hold its number.
        titled = len(self.cells(text)) != len(self.header) and self.is_remark(text)
        plain = 2 * count <= len(row) if titled else not count
        wordy = plain and text.expandtabs().isprintable() and any(map(str.isalpha, text))
        return wordy or _is_remark(text) or self.ends_in_words(text)


@dataclass(frozen=True)
class Line:
    """A line of a file: its number, its bytes in the file, and its text without the line end."""

    number: int
    start: int
    end: int
    text: str


def cells(text: str, delimiter: str) -> list[str]:
    """The cells of one line, without the blanks around them."""
    if delimiter == " ":
        return text.split()
    row = next(csv.reader([text.replace("\r", " ")], delimiter=delimiter), [])
    return [cell.strip() for cell in row]


def find_layout(head: bytes, columns: Sequence[str], dialect: Dialect) -> TableLayout:
    """Layout of the text file that begins with ``head``: its first 64 kB, or all of it, as UTF-8.

    The header must have ``columns``; any will do where these are empty.

    Raises:
        InputError: no header, a column missing, or a layout that can be read in two ways.
    """
    lines = _lines(head)
    if not _filled(lines):
        raise InputError("the file holds no text")
    delimiters: list[str] = [dialect.delimiter] if dialect.delimiter else list(DELIMITERS)
    index, delimiter, header = _header(lines, columns, dialect, delimiters)
    body = lines[index + 1 :]
    named = lines[max(index, 0)].text
    # Not the joint whose name was put in brackets.
    written = "\n".join(line.text for line in lines[: index + 1])
    units = {h: u for h, u in units_in(header).items() if dialect.names or u in written}
    units |= _units_of_motion([line.text for line in lines[:index]], header)
    for line in lines[: max(index, 0)]:
        row = cells(line.text, delimiter)
        if len(row) == len(header) and re.search(r"(?i)(\b|V)units?:?\Z", row[0]):
            units = {h: u for h, u in zip(header[1:], row[1:], strict=True) if u} | units
    remarks, scales = [], dict[str, float]()
    if delimiter != "," and not dialect.delimiter:
        remarks.append(f"columns are separated by {DELIMITERS[delimiter]}")
    above = len(_filled(lines[: max(index, 0)]))
    if above:
        remarks.append(f"{above} lines above the header passed over")
    passed = index
    first = _guess(body, [delimiter])[0][0]
    for at, line in enumerate(body):
        remark = _is_remark(line.text)
        row = cells(_REMARK.sub("", line.text, count=1) if remark else line.text, delimiter)
        if delimiter == " " and 1 < len(row) < len(header) and _are_units(row):
            row = _below(line.text, header, named)
        key = row[0] if row else ""
        row, property_row = _of_properties(row)
        property_row &= at < first < len(body)
        if _SCALES.fullmatch(key) and key not in row:
            property_row = True
            scales = {h: float(x) for h, x in zip(header, row, strict=False) if _POINT.match(x)}
        if (
            _is_unit_row(row, header, columns)
            and not dialect.names
            and not (remark and not _are_units(row))
            and not (property_row and not all(unit(x) for x in row if x and not x[0].isdigit()))
        ):
            said = {h: bare(u) for h, u in zip(header, row, strict=False) if bare(u)}
            units = said | units if property_row else units | said
            remarks.append(f"row {line.number} gives units")
            passed += 1
            if not property_row:
                break
            continue
        if line.text.strip() and not remark and not property_row:
            break
        passed += 1
    body = lines[passed + 1 :]
    header = _padded(header, body, delimiter)
    decimal = dialect.decimal or _decimal(body, header, columns, delimiter)
    if decimal == "," and not dialect.decimal:
        remarks.append("decimal commas")
    for place, name in enumerate(header):
        if name in scales:
            rows = (cells(line.text, delimiter) for line in body[:_TRIED])
            read = [row[place].replace(decimal, ".") for row in rows if len(row) == len(header)]
            values = np.array([float(cell) for cell in read if _POINT.match(cell)])
            units[name] = in_steps(values, [scales[name]], units.get(name, ""))
    start = lines[passed].end if passed >= 0 else _mark(head)
    number = lines[passed].number + 1 if passed >= 0 else 1
    title = lines[index].text if index >= 0 and not dialect.names else ""
    return TableLayout(delimiter, decimal, tuple(header), number, start, (*remarks,), units, title)


def readable_columns(head: bytes, layout: TableLayout) -> dict[str, bool]:
    """Columns that hold numbers, or dates and times, where the first lines hold anything.

    A log of two rates has the readings of each in rows of their own.

    Returns:
        Their names, and whether it is dates and times.
    """
    lines = _lines(head)[layout.first_line - 1 : layout.first_line + _TRIED]
    rows = [layout.cells(line.text) for line in lines if line.text.strip()]
    found = {}
    for name, column in zip(layout.header, zip_longest(*rows, fillvalue=""), strict=False):
        numbers = sum(_is_number(cell, layout.decimal) for cell in column)
        moments, filled = sum(map(is_moment, column)), sum(cell not in NULLS for cell in column)
        enough = max(numbers, moments) > max(0.5 * filled, _LEAST_FILLED * len(rows))
        if name and enough and layout.header.count(name) == 1:
            found[name] = moments > numbers
    return found


def share_of_rows(head: bytes) -> float:
    """Share of the first lines that are rows of numbers, of more than one; prose has hardly any."""
    lines = [line.text for line in _lines(head) if line.text.strip()][:_SEARCHED]

    def is_row(row: list[str], mark: str) -> bool:
        numbers = sum(_is_number(cell, ",") or is_moment(cell) for cell in row)
        return numbers >= max(min(2, len(row)), (0.5 if mark == " " else 0.25) * len(row), 1)

    rows = max(sum(is_row(cells(text, mark), mark) for text in lines) for mark in DELIMITERS)
    return rows / len(lines) if rows > 1 else 0.0


def _is_number(cell: str, decimal: str) -> bool:
    return bool(_POINT.match(cell) or (decimal == "," and _COMMA.match(cell)))


def _mark(head: bytes) -> int:
    return 3 if head.startswith(b"\xef\xbb\xbf") else 0


def _lines(head: bytes) -> list[Line]:
    """The whole lines of ``head``, and the last one where it is all there is."""
    found: list[Line] = []
    start = _mark(head)
    for number, match in enumerate(re.finditer(rb"[^\r\n]*(\r\n|\n|\r|\Z)", head[start:]), 1):
        end = start + match.end()
        if (end == len(head) and len(head) >= HEAD and found) or match.start() == match.end():
            break
        try:
            text = match[0].decode("utf-8")
        except UnicodeDecodeError as error:
            if number <= 2 and not any(line.text.strip() for line in found):
                raise refusal("header_encoding", f"row {number}") from error
            text = match[0].decode("utf-8", "replace")
        found.append(Line(number, start + match.start(), end, text.rstrip("\r\n")))
    return found


def _header(
    lines: list[Line], columns: Sequence[str], dialect: Dialect, delimiters: list[str]
) -> tuple[int, str, list[str]]:
    """Place of the header among the lines (-1 where the session gives the names), and its cells."""
    if dialect.names:
        check_columns(dialect.names, columns, "csv.names")
        first, delimiter = _guess(lines, delimiters)[0]
        return max(_filled(lines[:first]), default=-1), delimiter, list(dialect.names)
    guesses = _guess(lines, delimiters)
    at, mark = guesses[0]
    width = len(cells(lines[at].text, mark)) if at < len(lines) else 0

    def names(index: int, delimiter: str) -> list[str]:
        row = _names(lines[index].text, delimiter, lines[index + 1 :], lines[:index])
        row = _trimmed(row, width)
        # It may be written otherwise than the samples.
        fits = len(row) in (width, width - 1)
        return row if fits else next(iter(_otherwise(lines[index].text, width)), row)

    # A remark above the header may have a name among its words.
    for whole, (index, line) in product(
        (True, False), enumerate(lines[: _SEARCHED * any(columns)])
    ):
        for delimiter in delimiters:
            row = names(index, delimiter)
            if set(columns) <= set(row) and (not whole or width - 1 <= len(row) <= width):
                check_columns(row, columns, f"row {line.number}")
                first, below = _guess(lines[index + 1 :], delimiters)[0]
                rows = lines[index + 1 + first :]  # may be separated otherwise than the header
                fits = len(row) > 1 and rows and len(cells(rows[0].text, below)) == len(row)
                return index, below if fits else delimiter, row
    found = [(_above(lines, first, delimiter), delimiter) for first, delimiter in guesses]
    index, delimiter = next((each for each in found if each[0] >= 0), (-1, ""))
    listed, row = _listed(lines[:at]), names(index, delimiter) if index >= 0 else []
    unnamed = sum(bool(re.search(r"\w", name)) for name in row) < width
    if unnamed and len(listed) == width > 1 and {*columns} <= {*listed}:
        check_columns(listed, columns, "the list of columns")
        return max(_filled(lines[:at])), mark, listed
    if index < 0:
        first, delimiter = guesses[0]
        row = [f"{_NUMBERED}{n}" for n, _ in enumerate(cells(lines[first].text, delimiter), 1)]
        if set(columns) <= set(row):
            return max(_filled(lines[:first]), default=-1), delimiter, row
        place, said = f"row {lines[0].number}", ",".join(columns)
        raise refusal("no_header", place, columns=said, first=row[0], last=row[-1])
    check_columns(row, columns, f"row {lines[index].number}")
    return index, delimiter, row


def _listed(above: list[Line]) -> list[str]:
    """Names of the columns where they are listed a line each above the samples, by number."""
    found = [match for line in above if (match := _LISTED.match(line.text))]
    in_order = {int(after[1]) - int(match[1]) for match, after in pairwise(found)} == {1}
    return [match[2].strip() for match in found] if in_order else []


def _filled(lines: list[Line]) -> list[int]:
    """Places of the lines that are not blank."""
    return [n for n, line in enumerate(lines) if line.text.strip()]


def _trimmed(row: list[str], width: int) -> list[str]:
    """A header without what is behind a last delimiter that the ``width`` cells below lack."""
    return row[:-1] if len(row) == width + 1 and not row[-1] else row


def _otherwise(text: str, width: int) -> list[list[str]]:
    """The names in a header of ``width`` cells, by each delimiter that separates so many."""
    plain = _REMARK.sub("", text, count=1).strip()
    split = [cells(plain, delimiter) for delimiter in DELIMITERS]
    split += [re.split(r"\s{2,}", plain), re.split(r"\s+(?![\[(])", plain)]
    split += [[item for name in plain.split() for item in _counted(name)]]
    return [row for row in split if len(row) == width > 1]


def _counted(name: str) -> list[str]:
    """The names of as many columns as a name says behind it: ``q[2]`` is q[0] and q[1]."""
    match = re.fullmatch(r"(\S+)\[(\d{1,2})\]", name)
    return [f"{match[1]}[{k}]" for k in range(int(match[2]))] if match else [name]


def _names(text: str, delimiter: str, below: list[Line], above: list[Line]) -> list[str]:
    """Names in a header, which may be written as a remark: ``# t x`` has two names or three."""
    plain, bare = (cells(t, delimiter) for t in (text, _REMARK.sub("", text, count=1)))
    written = (line.text for line in below if line.text.strip() and not _is_remark(line.text))
    rows = list(islice(written, _SEARCHED))
    if len(plain) == len(bare):
        row = bare if _is_remark(text) and plain[0].strip("#%/") else plain
    else:
        row = plain if rows and len(cells(rows[0], delimiter)) == len(plain) else bare
    if delimiter == " ":
        row = [name.rstrip(",;") or name for name in row]
    row = [name.strip("\"'") for name in row]
    beside = cells(above[-1].text, delimiter) if above else []
    if len(beside) == len(row) and sum(map(bool, beside)) > 1:
        # The names of an index stand below those of the columns, as pandas writes them; else a cell
        # of the line above goes on where this one is empty.
        apart = all(bool(a) != bool(b) for a, b in zip(row, beside, strict=True))
        groups = cells(above[-2].text, delimiter) if apart and len(above) > 1 else []
        groups = groups if len(groups) == len(row) else [""] * len(row)
        row = [a or f"{g} {b}".strip() for a, b, g in zip(row, beside, groups, strict=True)]
    if beside and len(beside) == len(row) and re.match(r"(?i)labels?\b", beside[0]):
        row = [
            f"{name} {label}".strip() for name, label in zip(row, ["", *beside[1:]], strict=True)
        ]
    if _is_key_of_names(row):
        row = ["Time" if name == row[0] else name for name in row]
    row = _named_items(row, rows, delimiter)
    unnamed = len(row) > 1 and not row[0]
    first = [cells(text, delimiter)[0] for text in rows] if unnamed else []
    if first and all("." in x or is_moment(x) for x in first):
        row[0] = "index" if "time" in row else "time"  # of a frame of pandas; R numbers its rows
    return _told_apart(row, beside)


def _is_key_of_names(row: list[str]) -> bool:
    """Whether a line says of itself that it holds names: before each of them, or once."""
    key = row[0].lower() if row else ""
    return key.rstrip("=:") in _NAME_KEYS and (
        row.count(row[0]) > 1 or key[-1] in "=:" or key == "path"
    )


def _told_apart(header: list[str], above: list[str]) -> list[str]:
    """The header with names that stand more than once below those of groups, else with a number."""
    count = Counter(name for name in header if name)
    if len(above) == len(header) and not any(map(_POINT.match, above)):
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
        if match and len(said) == 1 and not _POINT.match(name := said.pop()) and name:
            of[match[1], match[2]] = name
    named = []
    for column in header:
        match = re.fullmatch(r"(.*?)(\w*?[A-Za-z_])(\d+)", column) if of else None
        item = of.get((match[1], match[3])) if match and match[2] != "name" else None
        named.append(f"{match[1]}{match[2]}[{item}]" if match and item else column)
    return named


def _guess(lines: list[Line], delimiters: list[str]) -> list[tuple[int, str]]:
    """Candidate starts of the samples and delimiters of their columns that are equally good."""
    ranked: list[tuple[float, int, str]] = []
    tried = [line for line in lines[-_TRIED:] if line.text.strip()]
    for delimiter in delimiters:
        rows = [cells(line.text, delimiter) for line in tried]
        width = Counter(map(len, rows)).most_common(1)[0][0] if rows else 0
        alike = [row for row in rows if len(row) == width]
        found_numbers = sum(_number_cells(row, delimiter) for row in alike)
        share = found_numbers / (width * len(rows)) if width else 0.0
        ranked.append((share * width if width > 1 else 0.0, width, delimiter))
    found = []
    best = max(score for score, _, _ in ranked)
    for _, width, delimiter in (each for each in ranked if each[0] >= _ALIKE * best):
        split = [cells(line.text, delimiter) for line in lines]
        numbers = [_number_cells(row, delimiter) if len(row) == width else 0 for row in split]
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
        # Rows logged before all sensors had answered are samples with empty cells.
        while 0 < first < len(lines) and _is_sparse(cells(lines[first - 1].text, delimiter), width):
            first -= 1
        found.append((first, delimiter))
    return found


def _is_sparse(row: list[str], width: int) -> bool:
    """Whether a line is a sample in which cells are empty: numbers and moments, nothing else."""
    return len(row) == width > 1 and all(
        cell in NULLS or _is_number(cell, ",") or is_moment(cell) for cell in row
    )


def _number_cells(row: list[str], delimiter: str) -> int:
    """Number of cells that are numbers or moments; a comma inside one is a decimal sign."""
    decimal = "." if delimiter == "," else ","
    return sum(_is_number(cell, decimal) or is_moment(cell) for cell in row)


def _above(lines: list[Line], first: int, delimiter: str) -> int:
    """Place of the header above the first sample, -1 where there is none."""
    if first >= len(lines):
        return next(iter(_filled(lines)), -1)
    width, above = len(cells(lines[first].text, delimiter)), _filled(lines[:first])[-4:]
    bare = {n: cells(_REMARK.sub("", lines[n].text, count=1), delimiter) for n in above}
    rows = {n: _trimmed(row, width) for n, row in bare.items()}
    for n in above[-2:]:
        row = rows[n]
        if not width - 1 <= len(row) <= width:
            rows[n] = next(iter(_otherwise(lines[n].text, width)), row)
    # Below the names stands nothing with fewer cells: that is what a logger says as it starts.
    apart = [n for n, row in rows.items() if len(row) < width - 1 and not _is_remark(lines[n].text)]
    fitting = [
        n
        for n, row in rows.items()
        if width - 1 <= len(row) <= width
        and n > max(apart, default=-1)
        and not all(map(_POINT.match, row))
        and all(any(map(str.isalnum, cell)) for cell in row if cell)
    ]
    while len(fitting) > 1 and any(re.match(r"[A-Za-z ]+:\s+\S", c) for c in rows[fitting[-1]]):
        fitting.pop()  # Type: double
    while len(fitting) > 1 and all(rows[fitting[-2]]) and _says_more(rows[fitting[-1]]):
        fitting.pop()
    for n in reversed(_filled(lines[:first])):
        row = cells(lines[n].text, delimiter)
        sample = cells(lines[first].text, delimiter)
        begun = not sample[0] and re.search(r"(?i)(names?:?|waves/?\w?)\Z", row[0])
        if width - (not sample[-1]) <= len(row) <= width and (begun or _is_key_of_names(row)):
            return n
    wordy = [n for n in fitting if not any(map(_POINT.match, rows[n]))]
    if wordy and wordy[-1] != fitting[-1]:
        return wordy[-1]  # what is below has numbers, and cells that are empty
    above_units = (
        over for over, n in pairwise(fitting) if _are_units(rows[n]) and len(rows[over]) == width
    )
    return next(above_units, fitting[-1] if fitting else -1)


def _says_more(row: list[str]) -> bool:
    """Whether a line below the names holds units or numbers behind a key, or the key alone."""
    said = [cell for cell in _of_properties(row)[0] if cell]
    return not said or (len(said) < len(row) and all(unit(x) or _POINT.match(x) for x in said))


def _padded(header: list[str], body: list[Line], delimiter: str) -> list[str]:
    """The header with a nameless column: lines end with a delimiter, or begin with their number."""
    rows = [cells(line.text, delimiter) for line in body[:_TRIED] if line.text.strip()]
    longer = [row for row in rows if len(row) == len(header) + 1]
    if not rows or len(longer) < len(rows):
        return header
    if not any(row[-1] for row in longer):
        return [*header, ""]
    numbers = [row[0].strip('"') for row in longer]  # of the rows, as R writes them
    counted = all(map(str.isdigit, numbers)) and int(numbers[-1]) - int(numbers[0]) == len(rows) - 1
    return ["", *header] if counted else header


def _decimal(body: list[Line], header: list[str], columns: Sequence[str], delimiter: str) -> str:
    """Decimal sign of the first lines; InputError where there are both, or digits in thousands."""
    seen: dict[str, tuple[str, int]] = {}
    plain = False
    for line in body[:_TRIED]:
        for column, cell in zip(header, cells(line.text, delimiter), strict=False):
            if columns and column not in columns:
                continue
            if _GROUPED.match(cell):
                place = f"row {line.number}, column '{column}'"
                raise refusal("thousands", place, cell=cell)
            if _COMMA.match(cell):
                seen.setdefault(",", (cell, line.number))
                plain = plain or not _THOUSANDS.match(cell)
            elif _POINT.match(cell) and "." in cell:
                seen.setdefault(".", (cell, line.number))
    if "," not in seen or (delimiter == "," and "." in seen):
        return "."
    if "." in seen:
        (comma, row_1), (point, row_2) = seen[","], seen["."]
        raise refusal("two_decimals", comma=comma, row=row_1, point=point, other=row_2)
    if not plain:
        raise refusal("either_decimal", f"row {seen[','][1]}", cell=seen[","][0])
    return ","


# Remarks and units


def _is_remark(text: str) -> bool:
    return bool(_REMARK.match(text) or re.fullmatch(r"\s*[-=_*~]{3,}[-=_*~+|\s]*", text))


def _of_properties(row: list[str]) -> tuple[list[str], bool]:
    """A row below the header without its keys, and whether it has such: ``Unit``, ``Type: double``.

    Programs for measurements write what they know of a channel there.
    """
    said = [cell for cell in row if cell]
    keys = [match for cell in said if (match := re.match(r"([A-Za-z ]+):\s+\S", cell))]
    if len(keys) >= 0.5 * len(said) > 0:
        return [re.sub(r"^[A-Za-z ]+:\s+", "", cell) for cell in row], True
    key = row[0] if row else ""
    listed = re.match(r"[^\W\d_]{3}", key) is not None and key.lower() not in ("sec", "rad", "deg")
    alone = row.count(key) > 1 or unit(key) is None
    if not (listed and alone):
        return row, False
    return ["" if cell == key else cell for cell in row], True


def _is_unit_row(row: list[str], header: list[str], columns: Sequence[str]) -> bool:
    """Whether a line below the header names units: no number in it, a unit for what is wanted."""
    pairs = zip(header, row, strict=False)
    wanted = [cell for name, cell in pairs if name in columns or not columns]
    said = [cell for cell in wanted if cell]
    return (
        len(row) == len(header)
        and 2 * len(said) >= len(wanted)
        and bool(said)
        and all(_UNIT.match(cell) and cell not in NULLS for cell in said)
        and not any(_POINT.match(cell) and cell != "1" for cell in said)
        and any(re.search(r"[A-Za-z%°Ωµμ]", cell) and len(bare(cell)) <= 10 for cell in said)
    )


def _below(text: str, header: list[str], title: str) -> list[str]:
    """The words of a line, each in the cell of the name above it; ``title``: the line of names."""
    row, at, middles = [""] * len(header), 0, []
    for name in header:
        at = max(title.find(name, at), at)
        middles.append(at + 0.5 * len(name))
        at += len(name)
    for word in re.finditer(r"\S+", text):
        far = [abs(0.5 * (word.start() + word.end()) - middle) for middle in middles]
        row[far.index(min(far))] = word[0]
    return row


def _are_units(row: list[str]) -> bool:
    """Whether every cell is a unit that is known, or stands in brackets; one of many may not."""
    said = [cell for cell in row if cell]
    known = sum(bool(re.match(r"[\[(]", cell)) or unit(cell) is not None for cell in said)
    return bool(said) and known >= len(said) - (len(said) > _FEW_UNITS)


def _units_of_motion(above: list[str], header: list[str]) -> dict[str, str]:
    """Units of the angles and speeds in a motion file of OpenSim, by its preamble ``above``."""
    if not any(text.strip().lower() == "endheader" for text in above):
        return {}
    angle = "deg" if any(map(_MOTION.search, above)) else "rad"
    units = {name: angle for name in header if not _NO_ANGLE.search(name)}
    units |= {name: f"{angle}/s" for name in units if re.search(r"(?i)speed|velocit|_u\Z", name)}
    units |= {name: f"{angle}/s2" for name in units if re.search(r"(?i)acc", name)}
    return units | {name: "s" for name in header if name.lower() == "time"}
