"""Texts of samples that are no table yet, made into one line by line: rows keep their numbers.

Such are ``q=0.1 tau=2`` of a terminal, the stamps that a serial monitor puts before a line, cells
with their units or with lists, and tables with the names of signals in a column of their own.
"""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count, pairwise, zip_longest
from typing import Any

from bampipe.data.readers.heads import cells
from bampipe.data.readers.moments import is_moment
from bampipe.data.readers.trial import NUMBER
from bampipe.data.refusals import refusal
from bampipe.data.units import unit
from bampipe.data.vocabulary import VOCABULARY
from bampipe.errors import InputError

_PAIR = re.compile(
    rf"""["']?([A-Za-z_][\w./]*)["']?\s*[=:]\s*"""
    rf"(?:({NUMBER})(?![\w.:])|[\[(]\s*({NUMBER}(?:[,;\s]+{NUMBER})*)\s*[\])])"
)
_STAMPED = re.compile(
    r"\s*(?:\[?((?:\d{4}-\d\d-\d\d[ T])?\d{1,2}:\d\d:\d\d[.,]\d+)"
    r"(?:\]|\s*->|\s+(?:DEBUG|INFO|WARN\w*|ERROR)\b)|[EWIDV] \((\d+)\) \w+:)\s*(.*)"
)
_LINE_PROTOCOL = re.compile(r"[^\s,=]+(?:,\S+)? (\w[^\s=]*=\S+) (\d{10,19})\s*")
_ELEMENT = re.compile(r"<(\w+)((?:\s+\w+=\"[^\"]*\")+)\s*/?>|<(\w+)>([^<>]*)</")
_WITH_UNIT = re.compile(rf"({NUMBER})[ \u00a0]?([^\W\d_]\S*|[%°]\S*)")
_UNPADDED = re.compile(r"(-?\d+)\.(\d+)")
_FORTRAN = re.compile(r"(\d\.?\d*)[Dd]([-+]\d)")
_HEX = re.compile(r"(?i)(?<![\w.])0x[0-9a-f]{1,8}(?!\w)")
_NAMES = re.compile(r"(?i)(?:channel|signal|marker)_names?[\t;,]")
_LABVIEW = re.compile(
    r"(?:LabVIEW|[A-Z]\w*_[A-Z]\w*|Separator|X_Columns|Operator|Project|Description|Date|Time|Channels"
    r"|Samples|X0|\*\*\*End_of_Header)"
)
_BEHIND = re.compile(r"((?<![^\s;,|\"])\d+[.,]?\d*-|(?<=[\t;,|])\(\d+[.,]\d+\))(?![^\s;,|\"])")
_GROUPS = ((",", r"\."), (".", ","), (" ", "[.,]"), ("'", "[.,]"), ("’", "[.,]"))
"""Signs between thousands, and what may stand before the decimals then."""
_OF_MESSAGE = re.compile(r"( *)(?:- ?|(\w+): ?)(.*)")
_BROKEN = re.compile(r'(?<![^\n,;\t])"[^",;\t\r\n]*(?:[\r\n]+[^",;\t\r\n]*){1,3}"(?![^\r\n,;\t])')
_TYPESET = {"\u2212": "-", "\u00a0": " ", "\u202f": " ", "\u2009": " "}
"""Minus and blanks of typesetters."""
_MOST = 0.8
"""Least share of the first lines that are written alike."""
_TRIED, _FEWEST, _MOST_SIGNALS, _HEAD = 400, 5, 64, 1 << 14
_DELIMITERS = (";", "\t", ",", "|")


@dataclass(frozen=True)
class Form:
    """A form of text, described by ``said``, and the function that makes it a table.

    ``names`` are those of the columns, where no line holds them.
    """

    said: str
    rewrite: Callable[[str], str]
    names: tuple[str, ...] = ()


_ALIKE = {
    re.compile(r'\A\s*"[^"]*\d[,;\t][^"]*"\s*\Z'): Form(
        "quotes around whole lines left out", lambda line: line.strip().strip('"')
    ),
    _HEX: Form("hexadecimal numbers", lambda line: _HEX.sub(lambda n: str(int(n[0], 16)), line)),
    _FORTRAN: Form("exponents of Fortran", lambda line: _FORTRAN.sub(r"\1E\2", line)),
}
"""Forms of lines that are each written in one way."""


def unbroken(text: str) -> str:
    """The text with a line a sample: no line ends in quoted names, as spreadsheets write them.

    Messages as YAML with ``---`` between them, as ROS prints them, become a table; others that
    begin with the same line, such as ``<Rob>`` or ``data {``, stand on a line each.
    """
    text = text.replace("\f", "")
    lines = [line.strip() for line in text[:_HEAD].splitlines()]
    begins = Counter(line for line in lines if re.fullmatch(r"<.*>|\w+ *\{", line))
    begin, count = next(iter(begins.most_common(1)), ("", 0))
    if count > _FEWEST and all(re.search(r"[^\W\d]|[{}]|\A\Z", line) for line in lines):
        starts = re.split(rf"(?m)^(?=[ \t]*{re.escape(begin)}[ \t]*$)", text)
        text = "".join(f"{' '.join(message.split())}\n" for message in starts)
    messages = re.split(r"(?m)^---\s*$", text)
    lines = messages[0].splitlines() if len(messages) > _FEWEST else []
    if lines and all(map(_OF_MESSAGE.match, lines)):
        rows = [*map(_by_path, messages)]
        whole = [map(row.get, rows[0]) for row in rows if row.keys() == rows[0].keys()]
        return "".join(f"{','.join(map(str, row))}\n" for row in (rows[0], *whole))
    return _BROKEN.sub(lambda name: re.sub(r"[\r\n]+", " ", name[0]), text)


def _by_path(message: str) -> dict[str, str]:
    """Values of a YAML message by path; items of lists one by one, by a list ``name`` if any."""
    path, found = dict[int, str](), dict[str, list[str]]()
    for match in filter(None, map(_OF_MESSAGE.match, message.splitlines())):
        indent, key, said = match.groups()
        if key:
            path = {n: k for n, k in path.items() if n < len(indent)} | {len(indent): key}
        items = said.strip("[] ").split(",") if said[:1] == "[" else [said] * bool(said)
        found.setdefault(".".join(path.values()), []).extend(x.strip(" '\"") for x in items)
    names = found.pop("name", [])
    ends = {len(items): [f".{n}" for n in range(len(items))] for items in found.values()}
    ends |= {1: [""], len(names): [f".{name}" for name in names]}
    return {
        name + end: item
        for name, items in found.items()
        for end, item in zip(ends[len(items)], items, strict=True)
    }


def find_form(head: str) -> Form | None:
    """The form of a text that begins with ``head`` (whole lines); None of a table as it is.

    InputError where it is known, and no table can be made of it.
    """
    whole = [line for line in head.splitlines() if line.strip()]
    lines = whole[-_TRIED:]
    if len(lines) < _FEWEST:
        return None
    if any(sign in head for sign in _TYPESET):
        plain = str.maketrans(_TYPESET)
        inner = find_form(head.translate(plain)) or Form("", str)
        said = "; ".join(filter(None, ("typeset minus signs and blanks made plain", inner.said)))
        return Form(said, lambda line: inner.rewrite(line.translate(plain)), inner.names)
    if found := _of_program(head, whole):
        return found
    ended = [line for line in lines if re.search(r"^[^;]*[\w.] *;( *\.\.\.)?$", line)]
    apart = all(re.search(r"[,\t |]", line) for line in ended)
    of_matrix = re.fullmatch(r"[^\[]*\]\s*;?\s*", lines[-1])  # of MATLAB
    if of_matrix or (2 * len(ended) > len(lines) and apart):
        ends = re.compile(r"^\s*(\w+ *= *)?\[|[\s;]*((?<![^\W\d_])\])?[\s;]*(\.\.\.)?$")
        return Form("", lambda line: ends.sub("", line))
    if _are(_STAMPED, lines):
        return _stamped(lines)
    for kind, form in _ALIKE.items():
        if _are(kind, lines):
            return form
    for find in (_protocol_fields, _elements, _named):
        if pairs := _pairs(lines, find):
            return pairs
    behind = [match[0] for line in lines if (match := _BEHIND.search(line))]
    if len(behind) > max(_FEWEST, (1.0 - _MOST) * len(lines)):
        raise refusal("minus_behind", cell=behind[0])
    for delimiter in (*_DELIMITERS, " "):
        table = [cells(line, delimiter) for line in (*whole[:_TRIED], *lines)]
        width = Counter(map(len, table)).most_common(1)[0][0]
        rows = [row for row in table if len(row) == width > 1]
        if len(rows) <= _MOST * len(table):
            continue
        every = [row for row in (cells(x, delimiter) for x in whole) if len(row) == width]
        of_cells = _cells(rows[0], rows[1:], delimiter) if delimiter != " " else None
        if found := _grouped(every, delimiter) or of_cells:
            return found
    for line in (*whole[:_FEWEST], lines[-1]):
        for kind in VOCABULARY["no_tables"]:
            if any(re.match(pattern, line) for pattern in kind["lines"]):
                raise InputError(kind["what"], remedy=kind["remedy"])
    return None


def _of_program(head: str, whole: Sequence[str]) -> Form | None:
    """The form of a text of LabVIEW, AcqKnowledge, Qualisys or Weka; None of others."""
    if head.startswith("LabVIEW Measurement") and "\nX_Value" in head:
        stated = next((re.split(r"[\t,]", x)[1:] for x in whole if x.startswith("Y_Unit")), [])
        step, samples = re.search(r"\nDelta_X\t([^\t\r\n]+)", head), count()

        def rewrite(line: str) -> str:
            nonlocal samples
            if step and re.match(r"\t.*\d", line):  # no column of times
                stamp = f"{next(samples) * float(step[1].replace(',', '.')):.9f}"
                return (stamp.replace(".", ",") if "," in step[1] else stamp) + line
            if not line.startswith("X_Value"):
                return "" if _LABVIEW.match(line) else line
            samples = count()
            time, *names = re.split(r"[\t,]", re.sub(r"[\t,](Comment)?$", "", line))
            units = (f" [{u}]" if u and unit(u) else "" for u in (*stated, *names))
            return "\t".join([time, *(n + u for n, u in zip(names, units, strict=False))])

        return Form("heads of LabVIEW left out", rewrite)
    if match := re.match(r"[^\n]*\n[\d.]+ \w+/sample\s+(\d+) channels\s", head):
        end = 3 + 2 * int(match[1])
        channels = [f"{a} [{b}]" for a, b in zip(whole[3:end:2], whole[4:end:2], strict=False)]
        times = [f"time [{x}]" for x in whole[end].split(",") if x and not x.startswith("CH")]
        return Form("names of channels above the table", str, (*times, *channels))
    if attributes := re.findall(r"(?im)^@attribute\s+(['\"]?)(.+?)\1\s+\S+\s*$", head):
        return Form("names of attributes above the table", str, tuple(n for _, n in attributes))
    for line in whole[:_TRIED]:
        names = re.split(r"[\t;,]", line)[1:] if _NAMES.match(line) else []
        if names and len(names) == len(re.split(r"[\t;,]", whole[-1].strip())):
            return Form("", str, tuple(names))
    return None


def _grouped(table: Sequence[list[str]], delimiter: str) -> Form | None:
    """The form of a table with digits in thousands, where no number has their sign otherwise."""
    numbers = [x for row in table for x in row if re.match(r"[-+\d]", x) and not is_moment(x)]
    for sign, decimal in _GROUPS:
        if sign == delimiter == " ":
            continue
        group = re.compile(rf"[-+]?[1-9]\d{{0,2}}(?:{re.escape(sign)}\d{{3}})+(?:{decimal}\d*)?")
        # A sign of decimals alone would be that.
        sure = re.compile(rf".*{decimal}\d*" if sign in ",." else ".*")
        own = [cell for cell in numbers if sign in cell]
        if own and all(map(group.fullmatch, own)) and any(map(sure.fullmatch, own)):

            def rewrite(line: str, sign: str = sign, group: re.Pattern[str] = group) -> str:
                row = cells(line, delimiter)
                row = [x.replace(sign, "") if group.fullmatch(x) else x for x in row]
                return delimiter.join(f'"{x}"' if delimiter in x else x for x in row)

            return Form(f"digits in thousands, as in {own[-1]}", rewrite)
    return None


def _are(kind: re.Pattern[str], lines: Sequence[str]) -> bool:
    return sum(kind.search(line) is not None for line in lines) > _MOST * len(lines)


def _stamped(lines: Sequence[str]) -> Form:
    inner = [match[3] for match in map(_STAMPED.match, lines) if match]
    pairs = _pairs(inner, _named)
    sep = "," if pairs else next((d for d in _DELIMITERS if _are(re.compile(f"[{d}]"), inner)), " ")

    def rewrite(line: str) -> str:
        match = _STAMPED.match(line)
        if match is None:
            return line
        rest = pairs.rewrite(match[3]) if pairs else match[3]
        stamp = (match[1] or match[2]).replace(",", ".") if re.search(r"\d", rest) else "time"
        return f"{stamp}{sep}{rest}"

    return Form("times stand before each line", rewrite, ("time", *pairs.names) if pairs else ())


def _protocol_fields(line: str) -> list[tuple[str, str]]:
    """Fields and time of a line that a database of time series takes (InfluxDB, Telegraf)."""
    match = _LINE_PROTOCOL.fullmatch(line)
    pairs = [field.partition("=") for field in match[1].split(",")] if match else []
    named = [(name, value.rstrip("iu")) for name, _, value in pairs]
    return [*named, ("timestamp", match[2])] if match else []


def _elements(line: str) -> list[tuple[str, str]]:
    """Numbers in the elements of a line of XML, as robot controllers send it."""
    found = []
    for name, inner, single, content in _ELEMENT.findall(line):
        parts = re.findall(r'(\w+)="([^"]*)"', inner) if inner else [("", content)]
        found += [(f"{name}.{key}" if key else single, value) for key, value in parts]
    return [(name, value) for name, value in found if re.fullmatch(NUMBER, value)]


def _named(line: str) -> list[tuple[str, str]]:
    """Numbers behind their names; those of a list are numbered."""
    found = []
    for name, number, listed in _PAIR.findall(line):
        items = re.split(r"[,;\s]+", listed)
        found += [(f"{name}[{k}]", x) for k, x in enumerate(items) if x] or [(name, number)]
    return found


def _pairs(lines: Sequence[str], find: Callable[[str], list[tuple[str, str]]]) -> Form | None:
    found = Counter(tuple(name for name, _ in find(line)) for line in lines)
    names, count = found.most_common(1)[0] if found else ((), 0)
    if len(names) < 2 or len(set(names)) < len(names) or count <= _MOST * len(lines):
        return None

    def rewrite(line: str) -> str:
        pairs = find(line)
        alike = tuple(name for name, _ in pairs) == names
        return ",".join(value for _, value in pairs) if alike else line

    return Form("lines of names with their values", rewrite, names)


def _cells(header: list[str], rows: list[list[str]], delimiter: str) -> Form | None:
    """The form of a table whose cells are more than numbers."""
    units, widths, digits = [], [], []
    columns = [*zip(*rows, strict=True)]
    for column, title, beside in zip_longest(columns, header[1:], columns[1:], fillvalue=""):
        digits.append(_digits(column))
        ends = Counter(match[2] for cell in column if (match := _WITH_UNIT.fullmatch(cell)))
        end, count = ends.most_common(1)[0] if ends else ("", 0)
        if re.match(r"(?i)units?\b|einheit", title):
            end, count = Counter(beside).most_common(1)[0]
        units.append(end if count > _MOST * len(rows) and unit(end) else "")
        width, count = Counter(len(_items(cell)) for cell in column).most_common(1)[0]
        widths.append(width if count > _MOST * len(rows) else 0)
    if any(units):
        return Form("numbers with their units", _by_cell(delimiter, units, _without_unit))
    if any(widths):
        return Form(
            "cells that are lists", _by_cell(delimiter, _named_lists(rows, widths), _unpacked)
        )
    if any(digits):
        said = "zeros put before the fractions of seconds, which are not padded"
        return Form(said, _by_cell(delimiter, digits, _padded))
    for at in range(min(2, len(header) - 1)):
        names = Counter(row[at] for row in rows if row != header)
        numbers = sum(all(re.fullmatch(NUMBER, x) for x in row[2:]) for row in rows)
        in_turn = sum(one[at] != other[at] for one, other in pairwise(rows))
        if (
            1 < len(names) <= _MOST_SIGNALS
            and min(names.values()) >= _FEWEST
            and all(re.match(r"[^\W\d_]", name) for name in names)
            and min(numbers, 2 * in_turn) > _MOST * len(rows)
        ):
            return _in_turn(header, list(names), at, delimiter)
    return None


def _digits(column: Sequence[str]) -> int:
    """Digits of a fraction that was printed as a number of its own, 3 of ``12.5`` for 12.005 s.

    Such fractions never begin with a zero, but end in it. 0 of a column of other numbers.
    """
    ends = {match[2] for cell in column if (match := _UNPADDED.fullmatch(cell))}
    longest, shortest = (of(map(len, ends), default=0) for of in (max, min))
    fits = longest % 3 == 0 and shortest < longest and not any(re.match("0.", x) for x in ends)
    return longest if fits and any(re.search(".0$", x) for x in ends) else 0


def _padded(cell: str, digits: int) -> list[str]:
    match = _UNPADDED.fullmatch(cell)
    return [f"{match[1]}.{match[2].zfill(digits)}" if match else cell]


def _in_turn(header: list[str], names: list[str], at: int, delimiter: str) -> Form:
    """The form of a table whose cells ``at`` name the signal or the joint that a row is of."""

    def rewrite(line: str) -> str:
        row = cells(line, delimiter)
        if len(row) != len(header):
            return line
        time, own, values = row[1 - at], row[at], row[2:]
        if row == header:
            alone = len(values) == 1
            return delimiter.join(
                [time, *(n if alone else f"{n}.{x}" for x in values for n in names)]
            )
        return delimiter.join([time, *(x if n == own else "" for x in values for n in names)])

    return Form(f"a reading a row, of {', '.join(names)} in turn", rewrite)


def _by_cell(
    delimiter: str, of: Sequence[Any], act: Callable[[str, Any], list[str]]
) -> Callable[[str], str]:
    def rewrite(line: str) -> str:
        row = cells(line, delimiter)
        if len(row) != len(of):
            return line
        pairs = zip(row, of, strict=True)
        plain = [x for cell, own in pairs for x in (act(cell, own) if own else [cell])]
        return delimiter.join(f'"{x}"' if delimiter in x else x for x in plain)

    return rewrite


def _without_unit(cell: str, end: str) -> list[str]:
    match = _WITH_UNIT.fullmatch(cell)
    if match and match[2] == end:
        return [match[1]]
    return [f"{cell} [{end}]" if cell and not re.search(r"\d", cell) else cell]  # of the header


def _named_lists(rows: list[list[str]], widths: Sequence[int]) -> list[list[str]]:
    """Names of the items of cells that are lists: from a list of names, or numbers.

    Other cells have none.
    """
    words = (re.findall(r"[^\W\d][\w/]*", cell) for cell in rows[0] if cell[:1] in "[(")
    names = {len(own): [f".{x}" for x in own] for own in words if own}
    return [names.get(width, [f"[{k}]" for k in range(width)]) for width in widths]


def _unpacked(cell: str, names: Sequence[str]) -> list[str]:
    items, bare = _items(cell), re.sub(r"\[\d+\]\Z", "", cell)
    return items if len(items) == len(names) else [f"{bare}{x}" if bare else "" for x in names]


def _items(cell: str) -> list[str]:
    """The numbers of a list, in brackets or of three and more; none where it is none."""
    items = re.split(r"[,;\s]+", re.sub(r"\A[\[(](.*)[\])]\Z", r"\1", cell).strip())
    listed = cell[:1] in "[(" or len(items) > 2
    return items if listed and all(re.fullmatch(NUMBER, item) for item in items) else []
