"""Texts of samples that are no table yet, made into one line by line, so that rows keep their
numbers: ``q=0.1 tau=2`` of a terminal, the stamps that a serial monitor puts before a line, cells
with their units, and tables with the names of signals in a column of their own.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from bampipe.data.units import unit

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_PAIR = re.compile(rf"""["']?([A-Za-z_][\w./]*)["']?\s*[=:]\s*({_NUMBER})(?![\w.:])""")
_STAMPED = re.compile(r"\s*(\d{1,2}:\d\d:\d\d[.,]\d+)\s*->\s*(.*)")
_WITH_UNIT = re.compile(
    rf'(?P<quote>"?)(?P<number>{_NUMBER})[ \u00a0]?(?P<unit>[^\W\d_]\S*|[%°]\S*)'
)
_SIGNS = {"\u2212": "-", "\u00a0": " ", "\u202f": " ", "\u2009": " "}
"""Minus and blanks of typesetters."""
_MOST = 0.8
"""Share of the first lines that are written alike, the least."""
_TRIED, _FEWEST = 400, 5
_MOST_SIGNALS = 64
_DELIMITERS = (";", "\t", ",", "|")


@dataclass(frozen=True)
class Form:
    """How the lines of a text become rows of a table.

    Attributes:
        said: what the text is, for its reader.
        rewrite: the row for a line.
        names: of the columns, where no line holds them.
    """

    said: str
    rewrite: Callable[[str], str]
    names: tuple[str, ...] = ()


def find_form(head: str) -> Form | None:
    """The form of a text that begins with ``head`` (whole lines); None of a table as it is."""
    lines = [line for line in head.splitlines() if line.strip()][-_TRIED:]
    if len(lines) < _FEWEST:
        return None
    odd = "".join(sign for sign in _SIGNS if sign in head)
    if odd:
        plain = str.maketrans({sign: _SIGNS[sign] for sign in odd})
        inner = find_form(head.translate(plain))
        rewrite = inner.rewrite if inner else str
        said = "typeset minus signs and blanks are read as plain ones"
        return Form(
            f"{said}; {inner.said}" if inner else said,
            lambda line: rewrite(line.translate(plain)),
            inner.names if inner else (),
        )
    if sum(_STAMPED.match(line) is not None for line in lines) > _MOST * len(lines):
        return _stamped(lines)
    return _pairs(lines) or _with_units(lines) or _long(head.splitlines())


def _stamped(lines: list[str]) -> Form:
    inner = [match[2] for match in map(_STAMPED.match, lines) if match]
    pairs = _pairs(inner)
    delimiter = next(
        (d for d in _DELIMITERS if sum(d in x for x in inner) > _MOST * len(inner)), " "
    )

    def rewrite(line: str) -> str:
        match = _STAMPED.match(line)
        if match is None:
            return line
        rest = pairs.rewrite(match[2]) if pairs else match[2]
        stamp = match[1].replace(",", ".") if re.search(r"\d", rest) else "time"
        return f"{stamp}{',' if pairs else delimiter}{rest}"

    return Form("times stand before each line", rewrite, ("time", *pairs.names) if pairs else ())


def _pairs(lines: list[str]) -> Form | None:
    found = Counter(tuple(name for name, _ in _PAIR.findall(line)) for line in lines)
    names, count = found.most_common(1)[0] if found else ((), 0)
    if len(names) < 2 or len(set(names)) < len(names) or count <= _MOST * len(lines):
        return None

    def rewrite(line: str) -> str:
        pairs = _PAIR.findall(line)
        alike = tuple(name for name, _ in pairs) == names
        return ",".join(value for _, value in pairs) if alike else line

    return Form("lines of names with their values", rewrite, names)


def _with_units(lines: list[str]) -> Form | None:
    """Cells of a column that all end with the same unit."""
    for delimiter in _DELIMITERS:
        rows = [line.split(delimiter) for line in lines]
        width = Counter(map(len, rows)).most_common(1)[0][0]
        if width < 2:
            continue
        units = []
        for column in range(width):
            ends = Counter(
                match["unit"].rstrip('"')
                for row in rows
                if len(row) == width and (match := _WITH_UNIT.fullmatch(row[column].strip()))
            )
            end, count = ends.most_common(1)[0] if ends else ("", 0)
            units.append(end if count > _MOST * len(rows) and unit(end) else "")
        if any(units):
            return Form("numbers with their units", _without_units(delimiter, units))
    return None


def _without_units(delimiter: str, units: list[str]) -> Callable[[str], str]:
    def rewrite(line: str) -> str:
        cells = line.split(delimiter)
        if len(cells) != len(units):
            return line
        for k, end in enumerate(units):
            cell = cells[k].strip()
            match = _WITH_UNIT.fullmatch(cell) if end else None
            if match and match["unit"].rstrip('"') == end:
                cells[k] = match["number"]
            elif end and cell and not re.search(r"\d", cell):
                cells[k] = f"{cell.strip(chr(34))} [{end}]"  # the header
        return delimiter.join(cells)

    return rewrite


def _long(lines: list[str]) -> Form | None:
    """A table of three columns with a reading a row: its time, its signal, its value."""
    for delimiter in _DELIMITERS:
        header, *rows = (line.split(delimiter) for line in lines if line.strip())
        rows = [[cell.strip().strip('"') for cell in row] for row in rows if len(row) == 3]
        if len(header) != 3 or len(rows) < _FEWEST:
            continue
        number = [
            sum(bool(re.fullmatch(_NUMBER, r[k])) for r in rows) / len(rows) for k in (0, 1, 2)
        ]
        at = next((k for k in (1, 0) if number[k] == 0.0 and number[2] > _MOST), None)
        signals = Counter(row[at] for row in rows) if at is not None else Counter()
        if not 1 < len(signals) <= _MOST_SIGNALS or min(signals.values()) < _FEWEST:
            continue
        names = list(signals)

        def rewrite(line: str, delimiter: str = delimiter, at: int = at or 0) -> str:
            row = [cell.strip().strip('"') for cell in line.split(delimiter)]
            if len(row) != 3:
                return line
            if row == [cell.strip().strip('"') for cell in header]:
                return delimiter.join([row[1 - at], *names])
            places = ["" for _ in names]
            if row[at] in signals:
                places[names.index(row[at])] = row[2]
            return delimiter.join([row[1 - at], *places])

        return Form(f"a reading a row, of {', '.join(names)} in turn", rewrite)
    return None
