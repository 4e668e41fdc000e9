"""What a report is made of, before it is typeset: sections of text, tables and figures.

Text may hold three kinds of inline mark: ``**strong**``, code between backticks, and a link to
a page of our own, ``[words](../s01/report/report.html)``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Literal

from bampipe.report.wording import prose

Span = tuple[Literal["plain", "strong", "code", "link"], str]
"""Kind and text; of a link its words and its target, with a line break between."""

_MARK = re.compile(
    r"\*\*(?P<strong>[^*]+)\*\*|`(?P<code>[^`]+)`"
    r"|\[(?P<words>[^\]]+)\]\((?P<page>[\w./%+-]+\.html)\)"
)


def spans(text: str) -> list[Span]:
    """Split ``text`` at its inline marks, in order."""
    found: list[Span] = []
    end = 0
    for match in _MARK.finditer(text):
        if match.start() > end:
            found.append(("plain", prose(text[end : match.start()])))
        if match["strong"] is not None:
            found.append(("strong", prose(match["strong"])))
        elif match["code"] is not None:
            found.append(("code", match["code"]))
        else:
            found.append(("link", f"{match['words']}\n{match['page']}"))
        end = match.end()
    if end < len(text):
        found.append(("plain", prose(text[end:])))
    return found


def plain_text(text: str) -> str:
    """Return ``text`` as printed, without its marks."""
    return "".join(body.partition("\n")[0] for _, body in spans(text))


@dataclass(frozen=True)
class Paragraph:
    """A paragraph."""

    text: str


@dataclass(frozen=True)
class Subheading:
    """A heading below that of the section."""

    text: str


@dataclass(frozen=True)
class Bullets:
    """A list of short sentences."""

    items: tuple[str, ...]


@dataclass(frozen=True)
class Formulas:
    """Lines of formulas, each as it is."""

    lines: tuple[str, ...]


@dataclass(frozen=True)
class Callout:
    """A verdict in a box.

    Attributes:
        tone: "good" (nothing to do), "attention" (something is missing), "unknown" (something
            that nothing explains) or "note" (not done yet).
        title: the verdict in a few words.
        text: one to three sentences, or a line for each axis.
    """

    tone: Literal["good", "attention", "unknown", "note"]
    title: str
    text: str


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        caption: what it shows.
        head: title of each column, units included.
        rows: the cells, formatted.
        align: one letter a column: "l" text, "r" numbers, "c" centred.
        widths: relative widths of columns whose text may wrap; 0 for as wide as needed.
        note: a sentence below, or "".
    """

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    align: str
    widths: tuple[float, ...] = ()
    note: str = ""

    def without_empty_columns(self) -> Table:
        """Return it without the columns in which no row has anything to say."""
        full = [k for k in range(len(self.head)) if any(row[k] for row in self.rows)]
        return replace(
            self,
            head=tuple(self.head[k] for k in full),
            rows=tuple(tuple(row[k] for k in full) for row in self.rows),
            align="".join(self.align[k] for k in full),
            widths=tuple(self.widths[k] for k in full) if self.widths else (),
        )


@dataclass(frozen=True)
class Figure:
    """A figure.

    Attributes:
        name: name of its file, without ending.
        caption: what it shows and how to read it.
        svg: the drawing, 17 cm wide or less.
    """

    name: str
    caption: str
    svg: str


Block = Paragraph | Subheading | Bullets | Formulas | Callout | Table | Figure


@dataclass(frozen=True)
class Section:
    """One section.

    Attributes:
        title: its heading.
        blocks: what it holds, in order.
    """

    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class Document:
    """A whole report.

    Attributes:
        title: its title.
        subtitle: session, device, date of recording.
        sections: in order, the summary first.
        scale: of its type in print.
    """

    title: str
    subtitle: str
    sections: tuple[Section, ...]
    scale: float = 1.0
