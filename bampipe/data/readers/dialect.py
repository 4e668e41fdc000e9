"""Layout of a text file of numbers: found in its first lines, or refused.

Labs write tables with commas, semicolons, tabs, bars or blanks between columns, with points or
commas as decimal signs, with lines of remarks above the header and a line of units below it. What
can be read in two ways is refused, with the setting that decides: a guess must not change numbers.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import zip_longest

import numpy as np

from bampipe.data.readers import heads
from bampipe.data.readers.heads import DELIMITERS, NULLS, Header, Line, cells
from bampipe.data.readers.moments import is_moment
from bampipe.data.readers.trial import Dialect
from bampipe.data.refusals import refusal
from bampipe.data.units import bare, in_steps, unit, units_in
from bampipe.errors import InputError

_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+\Z")
_GROUPED = re.compile(r"[-+]?(\d{1,3}(,\d{3})+\.\d*|\d{1,3}(\.\d{3})+,\d*)\Z")
_WORD = re.compile(r"[^\W\d_]{2}")
_UNIT = re.compile(r"[\[(]?\s*(?=.*[A-Za-z%°Ωµμ#1\-])[A-Za-z0-9%°Ωµμ#./*^²³· _\-]{0,16}\s*[\])]?\Z")
_MOTION = re.compile(r"(?i)\binDegrees\s*=\s*yes\b")
_NO_ANGLE = re.compile(
    r"(?i)force|moment|torque|power|activation|excitation|fiber|length|[_.][tpv][xyz]\Z|\Atime\Z"
)
_SCALES = re.compile(r"(?i)scal(e|ing)[ _]?(factor)?|factor|faktor|skalierung|lsb")
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

    def begins_another(self, text: str) -> bool:
        """Whether a line among the samples is a header of other columns, with the same clock."""
        row, own = self.cells(text), self.cells(self.title)
        same = len(row) == len(own) > 1 and row[0] == own[0] and "=" not in text
        return same and self.is_chatter(text)

    def is_remark(self, text: str) -> bool:
        """Whether a line begins with a word, where samples begin with a number or a time."""
        return heads.is_remark(text) or _WORD.match(next(iter(self.cells(text)), "")) is not None

    def ends_in_words(self, text: str) -> bool:
        """Whether words, such as what an operator noted, stand behind the last cell of a line."""
        behind = [cell for cell in self.cells(text)[len(self.header) :] if cell]
        return bool(behind) and all(map(_WORD.match, behind))

    def is_chatter(self, text: str) -> bool:
        """Whether a line among the samples is text without a number in any cell, or ends in it."""
        row = [cell for cell in self.cells(text) if cell not in NULLS]
        count = heads.count_readings(row)
        # The title of a block may hold its number.
        titled = len(self.cells(text)) != len(self.header) and self.is_remark(text)
        plain = 2 * count <= len(row) if titled else not count
        wordy = plain and text.expandtabs().isprintable() and any(map(str.isalpha, text))
        return wordy or heads.is_remark(text) or self.ends_in_words(text)


def find_layout(head: bytes, columns: Sequence[str], dialect: Dialect) -> TableLayout:
    """Layout of the text file that begins with ``head``: its first 64 kB, or all of it, as UTF-8.

    The header must have ``columns``; any will do where these are empty.

    Raises:
        InputError: no header, a column missing, or a layout that can be read in two ways.
    """
    lines = heads.split_lines(head)
    if not lines:
        raise InputError("the file holds no text")
    header = heads.find_header(lines, columns, dialect)
    delimiter, given = header.delimiter, bool(dialect.names)
    remarks = []
    if delimiter != "," and not dialect.delimiter:
        remarks.append(f"columns are separated by {DELIMITERS[delimiter]}")
    if header.at > 0:
        remarks.append(f"{header.at} lines above the header passed over")
    units = _units_above(lines[: header.at + 1], header, given)
    end, units, scales, said = _read_below(lines, header, columns, units)
    body, remarks = lines[end:], remarks + said
    names = _padded(header.names, body, delimiter)
    decimal = dialect.decimal or _decimal(body, names, columns, delimiter)
    if decimal == "," and not dialect.decimal:
        remarks.append("decimal commas")
    for name, scale in scales.items():
        rows = (cells(line.text, delimiter) for line in body[: heads.TRIED])
        read = [row[names.index(name)] for row in rows if len(row) == len(names)]
        plain = [cell.replace(decimal, ".") for cell in read]
        values = np.array([float(cell) for cell in plain if heads.POINT.match(cell)])
        units[name] = in_steps(values, [scale], units.get(name, ""))
    number, start = lines[-1].number + 1, lines[-1].end
    if body:
        number, start = body[0].number, body[0].start
    title = "" if given or header.at < 0 else lines[header.at].text
    return TableLayout(delimiter, decimal, tuple(names), number, start, (*remarks,), units, title)


def readable_columns(head: bytes, layout: TableLayout) -> dict[str, bool]:
    """Columns that hold numbers, or dates and times, where the first lines hold anything.

    A log of two rates has the readings of each in rows of their own.

    Returns:
        Their names, and whether it is dates and times.
    """
    lines = [line for line in heads.split_lines(head) if line.number >= layout.first_line]
    rows = [layout.cells(line.text) for line in lines[: heads.TRIED]]
    found = {}
    for name, column in zip(layout.header, zip_longest(*rows, fillvalue=""), strict=False):
        numbers = sum(heads.is_number(cell, layout.decimal) for cell in column)
        moments, held = sum(map(is_moment, column)), sum(cell not in NULLS for cell in column)
        enough = max(numbers, moments) > max(0.5 * held, _LEAST_FILLED * len(rows))
        if name and enough and layout.header.count(name) == 1:
            found[name] = moments > numbers
    return found


def share_of_rows(head: bytes) -> float:
    """Share of the first lines that are rows of numbers, of more than one; prose has hardly any."""
    lines = [line.text for line in heads.split_lines(head)[: heads.SEARCHED]]

    def is_row(row: list[str], mark: str) -> bool:
        return heads.count_readings(row) >= max(
            min(2, len(row)), (0.5 if mark == " " else 0.25) * len(row), 1
        )

    rows = max(sum(is_row(cells(text, mark), mark) for text in lines) for mark in DELIMITERS)
    return rows / len(lines) if rows > 1 else 0.0


def _padded(header: list[str], body: list[Line], delimiter: str) -> list[str]:
    """The header with a nameless column: lines end with a delimiter, or begin with their number."""
    rows = [cells(line.text, delimiter) for line in body[: heads.TRIED]]
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
    read = [
        (cell, line.number, column)
        for line in body[: heads.TRIED]
        for column, cell in zip(header, cells(line.text, delimiter), strict=False)
        if not columns or column in columns
    ]
    for cell, number, column in read:
        if _GROUPED.match(cell):
            raise refusal("thousands", f"row {number}, column '{column}'", cell=cell)
    commas = [each for each in read if "," in each[0] and heads.is_number(each[0], ",")]
    points = [each for each in read if "." in each[0] and heads.is_number(each[0], ".")]
    if not commas or (delimiter == "," and points):
        return "."
    (comma, row, _), *_ = commas
    if points:
        (point, other, _), *_ = points
        raise refusal("two_decimals", comma=comma, row=row, point=point, other=other)
    if all(_THOUSANDS.match(cell) for cell, _, _ in commas):
        raise refusal("either_decimal", f"row {row}", cell=comma)
    return ","


def _read_below(
    lines: list[Line], header: Header, columns: Sequence[str], units: dict[str, str]
) -> tuple[int, dict[str, str], dict[str, float], list[str]]:
    """Read what stands between the names and the samples, beside the ``units`` of what is above.

    Returns:
        The number of lines above the samples, units and scales by column, and remarks.
    """
    body, names, end = lines[header.at + 1 :], header.names, header.at + 1
    first = heads.find_starts(body, [header.delimiter])[0][0]
    scales, remarks, given = dict[str, float](), list[str](), False
    for at, line in enumerate(body):
        remark = heads.is_remark(line.text)
        row = cells(heads.without_mark(line.text) if remark else line.text, header.delimiter)
        if header.delimiter == " " and 1 < len(row) < len(names) and heads.are_units(row):
            row = _under_names(line.text, names, lines[header.at].text)
        key = row[0] if row else ""
        row, is_property = heads.of_properties(row)
        is_property &= at < first < len(body)
        if _SCALES.fullmatch(key) and key not in row:
            is_property = True
            scales = {h: float(x) for h, x in zip(names, row, strict=False) if heads.POINT.match(x)}
        has_units = (
            _is_unit_row(row, names, columns)
            and (not remark or heads.are_units(row))
            and (not is_property or all(unit(x) for x in row if x and not x[0].isdigit()))
        )
        if not (remark or is_property or (has_units and not given)):
            break
        end += 1
        if has_units and not given:
            said = {h: bare(u) for h, u in zip(names, row, strict=False) if bare(u)}
            units = said | units if is_property else units | said
            remarks.append(f"row {line.number} gives units")
            given = not is_property
    return end, units, scales, remarks


def _units_above(lines: list[Line], header: Header, given: bool) -> dict[str, str]:
    """Units in the names, the last of ``lines``, and in what stands above these."""
    above, names = lines[:-1], header.names
    written = "\n".join(line.text for line in lines)
    # Not the joint whose name was put in brackets.
    units = {h: u for h, u in units_in(names).items() if given or u in written}
    units |= _units_of_motion([line.text for line in above], names)
    for line in above:
        row = cells(line.text, header.delimiter)
        if len(row) == len(names) and re.search(r"(?i)(\b|V)units?:?\Z", row[0]):
            units = {h: u for h, u in zip(names[1:], row[1:], strict=True) if u} | units
    return units


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
        and not any(heads.POINT.match(cell) and cell != "1" for cell in said)
        and any(re.search(r"[A-Za-z%°Ωµμ]", cell) and len(bare(cell)) <= 10 for cell in said)
    )


def _under_names(text: str, header: list[str], title: str) -> list[str]:
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


def _units_of_motion(above: list[str], header: list[str]) -> dict[str, str]:
    """Units of the angles and speeds in a motion file of OpenSim, by its preamble ``above``."""
    if not any(text.strip().lower() == "endheader" for text in above):
        return {}
    angle = "deg" if any(map(_MOTION.search, above)) else "rad"
    units = {name: angle for name in header if not _NO_ANGLE.search(name)}
    units |= {name: f"{angle}/s" for name in units if re.search(r"(?i)speed|velocit|_u\Z", name)}
    units |= {name: f"{angle}/s2" for name in units if re.search(r"(?i)acc", name)}
    return units | {name: "s" for name in header if name.lower() == "time"}
