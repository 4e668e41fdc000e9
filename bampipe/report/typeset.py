"""A document as a PDF, by typst with the fonts that its wheel carries."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import typst

from bampipe.errors import InputError
from bampipe.files import temporary_space
from bampipe.report.document import (
    Block,
    Bullets,
    Callout,
    Document,
    Figure,
    Formulas,
    Paragraph,
    Span,
    Subheading,
    Table,
    spans,
)

_TEMPLATE = Path(__file__).parent / "templates" / "report.typ"
_NORMAL_SIZE, _SMALL_SIZE = 9.0, 8.0
_MANY_COLUMNS = 7


def pdf(document: Document, recorded: int) -> bytes:
    """Return ``document`` as PDF: the same document gives the same bytes.

    Args:
        document: what to print.
        recorded: seconds since 1970, the date the file bears; ``SOURCE_DATE_EPOCH`` goes before it.

    Raises:
        InputError: ``SOURCE_DATE_EPOCH`` is set, but not to whole seconds.
    """
    stamp = os.environ.get("SOURCE_DATE_EPOCH", str(recorded))
    if not stamp.isdecimal():
        raise InputError(
            f"not a number of seconds: {stamp!r}",
            where="SOURCE_DATE_EPOCH",
            remedy="unset it, or give whole seconds since 1970",
        )
    with temporary_space(), tempfile.TemporaryDirectory(prefix="bampipe-report-") as folder:
        root = Path(folder)
        (root / "figures").mkdir()
        for section in document.sections:
            for block in section.blocks:
                if isinstance(block, Figure):
                    (root / f"figures/{block.name}.svg").write_text(block.svg, encoding="utf-8")
        (root / "document.json").write_text(json.dumps(content(document)), encoding="utf-8")
        source = root / _TEMPLATE.name
        shutil.copyfile(_TEMPLATE, source)
        compiler = typst.Compiler(source, root=root, ignore_system_fonts=True)
        printed = compiler.compile(format="pdf", timestamp=int(stamp))
        assert isinstance(printed, bytes)  # a list of pages comes for other formats
        return printed


def content(document: Document) -> dict[str, object]:
    """Return what the template reads: figures and tables numbered, text split into spans."""
    numbers = numbering()
    return {
        "title": document.title,
        "subtitle": document.subtitle,
        "sections": [
            {
                "title": section.title,
                "blocks": [_block(block, next_number(numbers, block)) for block in section.blocks],
            }
            for section in document.sections
        ],
    }


def numbering() -> dict[type, Iterator[str]]:
    """Return counters for figures and tables."""
    return {kind: map(f"{kind.__name__} {{}}".format, count(1)) for kind in (Figure, Table)}


def next_number(numbers: dict[type, Iterator[str]], block: Block) -> str:
    """Return "Figure 3" or "Table 2" for such a block, else ""."""
    return next(numbers[type(block)]) if type(block) in numbers else ""


def _block(block: Block, number: str) -> dict[str, object]:
    match block:
        case Paragraph(text):
            return {"kind": "text", "text": _spans(text)}
        case Subheading(text):
            return {"kind": "subheading", "text": _spans(text)}
        case Bullets(items):
            return {"kind": "bullets", "items": [_spans(item) for item in items]}
        case Formulas(lines):
            return {"kind": "formulas", "lines": list(lines)}
        case Callout(tone, title, text):
            return {
                "kind": "callout",
                "tone": tone,
                "title": _spans(title),
                "text": _spans(text),
            }
        case Table():
            return {
                "kind": "table",
                "number": number,
                "caption": _spans(block.caption),
                "head": [_spans(cell) for cell in block.head],
                "rows": [[_cell(cell) for cell in row] for row in block.rows],
                "align": list(block.align),
                "widths": list(block.widths or (0.0,) * len(block.head)),
                "note": _spans(block.note),
                "size": _NORMAL_SIZE if len(block.head) < _MANY_COLUMNS else _SMALL_SIZE,
            }
        case Figure(name, caption, _):
            return {
                "kind": "figure",
                "number": number,
                "name": name,
                "caption": _spans(caption),
                "alt": caption,
            }


def _spans(text: str) -> list[Span]:
    """Return the spans of a text for print, where a link is its words."""
    return [
        ("plain", body.partition("\n")[0]) if kind == "link" else (kind, body)
        for kind, body in spans(text)
    ]


def _cell(text: str) -> list[Span]:
    """Return the spans of a cell; an empty one still needs one."""
    return _spans(text) or [("plain", "")]
