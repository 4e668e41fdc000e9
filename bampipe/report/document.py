"""The document of a report before it is typeset: sections of text, tables and figures.

Text may hold three kinds of inline mark: ``**strong**``, code between backticks, and a link to
a page of our own, ``[words](../s01/report/report.html)``.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

from bampipe.report.wording import NONE, format_entry, format_prose

Tone = Literal["good", "attention", "unknown", "note"]
Span = tuple[Literal["plain", "strong", "code", "link"], str]
"""Kind and text; a link holds its words and its target, separated by a line break."""

_MARK = re.compile(
    r"\*\*(?P<strong>[^*]+)\*\*|`(?P<code>[^`]+)`"
    r"|\[(?P<words>[^\]]+)\]\((?P<page>[\w./%+-]+\.html)\)"
)

_BEFORE_UNIT = re.compile(r" (?=%)|(?<=±) |(?<=\d) (?=[kmµ]?(?:N|m|rad|s|g|Hz)\b)")
_COLUMN = re.compile(r"(?P<right>>?)(?P<title>.*?)(?: ~(?P<width>[\d.]+))?", re.DOTALL)
_FORM = re.compile(r" :(\S+)")


def split_spans(text: str) -> list[Span]:
    """Split ``text`` at its inline marks, in order; a unit stays on the line of its number."""

    def show(prose: str) -> str:
        return _BEFORE_UNIT.sub("\u00a0", format_prose(prose))

    found: list[Span] = []
    end = 0
    for match in _MARK.finditer(text):
        found.append(("plain", show(text[end : match.start()])))
        if match["strong"]:
            found.append(("strong", show(match["strong"])))
        elif match["code"]:
            found.append(("code", match["code"]))
        else:
            found.append(("link", f"{match['words']}\n{match['page']}"))
        end = match.end()
    return [span for span in (*found, ("plain", show(text[end:]))) if span[1]]


def strip_marks(text: str) -> str:
    """Return ``text`` as printed, without its marks."""
    return "".join(body.partition("\n")[0] for _, body in split_spans(text))


@dataclass(frozen=True)
class Subheading:
    """A heading one level below that of the section."""

    text: str


@dataclass(frozen=True)
class Formulas:
    """Lines of formulas, printed verbatim."""

    lines: tuple[str, ...]


@dataclass(frozen=True)
class Callout:
    """A verdict in a box.

    Attributes:
        tone: "good" (nothing to do), "attention" (something is missing), "unknown" (an
            unexplained residual) or "note" (not done yet).
        title: the verdict in a few words.
        text: one to three sentences, or a line for each axis.
    """

    tone: Tone
    title: str
    text: str


@dataclass(frozen=True)
class Column:
    """A column of a table: its title with unit, its side, and its relative width or 0."""

    title: str
    side: Literal["l", "r"]
    width: float


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        caption: what it shows.
        columns: titles, units included, joined by `` | ``. ``>`` before a title stands for a
            column of numbers; `` :p`` after it is the form of its cells (`wording.format_entry`),
            ``~2`` the relative width of a column whose text wraps.
        rows: the cells, which are text once the table is made.
        note: a sentence below, or "".
    """

    caption: str
    columns: str
    rows: Sequence[tuple[Any, ...]]
    note: str = ""

    def __post_init__(self) -> None:
        forms = [found[1] if (found := _FORM.search(c)) else "" for c in self.columns.split(" | ")]
        rows = tuple(tuple(map(format_entry, row, forms)) for row in self.rows)
        object.__setattr__(self, "rows", rows)
        object.__setattr__(self, "columns", _FORM.sub("", self.columns))

    def read_columns(self) -> list[Column]:
        """Return the columns."""
        found = map(_COLUMN.fullmatch, self.columns.split(" | "))
        return [
            Column(one["title"], "r" if one["right"] else "l", float(one["width"] or 0.0))
            for one in found
            if one
        ]

    def drop_empty_columns(self) -> Self:
        """Return the table without the columns that say nothing in any row."""
        titles = self.columns.split(" | ")
        full = [k for k in range(len(titles)) if {row[k] for row in self.rows} - {"", NONE}]
        rows = tuple(tuple(row[k] for k in full) for row in self.rows)
        return replace(self, columns=" | ".join(titles[k] for k in full), rows=rows)


@dataclass(frozen=True)
class Figure:
    """A figure.

    Attributes:
        name: name of its file, without ending.
        svg: the drawing, 17 cm wide or less.
    """

    name: str
    caption: str
    svg: str


Block = str | tuple[str, ...] | Subheading | Formulas | Callout | Table | Figure
"""Text is a paragraph, several texts are a list."""


@dataclass(frozen=True)
class Section:
    """One section: its heading and its blocks, in order."""

    title: str
    blocks: tuple[Block, ...]

    @classmethod
    def gather(cls, title: str, blocks: Iterable[Block | None]) -> Self:
        """Return a section of the ``blocks`` that say something: no empty text, list or table."""
        full = (b for b in blocks if b and not (isinstance(b, Table) and not b.rows))
        return cls(title, tuple(full))


@dataclass(frozen=True)
class Document:
    """A whole report.

    Attributes:
        subtitle: session, device, date of recording.
        scale: of the type in print.
    """

    title: str
    subtitle: str
    sections: tuple[Section, ...]
    scale: float = 1.0


def number_blocks(document: Document) -> Iterator[tuple[Section, list[tuple[Block, str]]]]:
    """Yield each section with its blocks, each with a number such as ``Figure 3``, or ""."""
    counts = {Figure: 0, Table: 0}
    for section in document.sections:
        blocks: list[tuple[Block, str]] = []
        for block in section.blocks:
            kind = type(block)
            if kind in counts:
                counts[kind] += 1
            blocks.append((block, f"{kind.__name__} {counts[kind]}" if kind in counts else ""))
        yield section, blocks
