"""A document as a PDF, by typst with the fonts that its wheel carries."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

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
_MANY_ROWS = 8
"""Rows beyond which a table may break wherever it stands."""
_FEW_ROWS = 3
"""Rows up to which a table stays in one piece, hole or not."""
_PAGE_END_PT = 782.0
"""Where the text of a page ends, points from its upper edge: A4 less the margin of the template."""
_PAGE_TOP_PT = 65.0
"""Where it begins."""
_HOLE_PT = 85.0
"""White above the end of a page, 3 cm, from which a page looks unfinished."""
_PASSES = 48


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
        source = root / _TEMPLATE.name
        shutil.copyfile(_TEMPLATE, source)
        compiler = _lay_out(content(document), source)
        printed = compiler.compile(format="pdf", timestamp=int(stamp))
        assert isinstance(printed, bytes)  # a list of pages comes for other formats
        return printed


def _lay_out(shown: dict[str, Any], source: Path) -> typst.Compiler:
    """Return a compiler of what is ``shown``: no holes above figures and tables, figures in order.

    Pages fill from the first, and what is made loose on one moves all that comes later: each pass
    mends the first fault that is left.
    """
    blocks = [block for section in shown["sections"] for block in section["blocks"]]
    compiler = typst.Compiler(source, root=source.parent, ignore_system_fonts=True)
    for _ in range(_PASSES):
        (source.parent / "document.json").write_text(json.dumps(shown), encoding="utf-8")
        edges = json.loads(compiler.query("<edge>", field="value"))
        if found := first_below_a_hole(blocks, edges) or first_overtaking(blocks, edges):
            found["loose"] = True
        elif found := first_with_few_rows(blocks, edges):
            found["kept"] = True
        else:
            break
    return compiler


def first_below_a_hole(
    blocks: list[dict[str, Any]], edges: list[dict[str, Any]]
) -> dict[str, Any] | None:
    """Return the first block that went to a new page and left a hole on the one before.

    Args:
        blocks: those of `content`, in order.
        edges: what the template reports of them: block, edge ("start" or "end"), page, y in points.
    """
    starts = {edge["block"]: edge for edge in edges if edge["edge"] == "start"}
    ends = {edge["block"]: edge for edge in edges if edge["edge"] == "end"}
    page, filled = 1, _PAGE_END_PT
    for block in blocks:
        start, end = starts.get(block["id"]), ends.get(block["id"])
        hole = _PAGE_END_PT - filled > _HOLE_PT
        whole = block["kind"] == "table" and (block["kept"] or len(block["rows"]) <= _FEW_ROWS)
        if start and not (block["loose"] or whole) and start["page"] > page and hole:
            return block
        floats = block["kind"] == "figure" and block["loose"]
        if end and not floats:
            page, filled = end["page"], end["y"]
    return None


def first_overtaking(
    blocks: list[dict[str, Any]], edges: list[dict[str, Any]]
) -> dict[str, Any] | None:
    """Return the first figure that stands before an earlier one, which went to a later page.

    Args:
        blocks: those of `content`, in order.
        edges: as for `first_below_a_hole`.
    """
    starts = {edge["block"]: edge["page"] for edge in edges if edge["edge"] == "start"}
    page = 0
    for block in blocks:
        if block["kind"] == "figure" and block["id"] in starts:
            if starts[block["id"]] < page and not block["loose"]:
                return block
            page = max(page, starts[block["id"]])
    return None


def first_with_few_rows(
    blocks: list[dict[str, Any]], edges: list[dict[str, Any]]
) -> dict[str, Any] | None:
    """Return the first table that leaves one or two rows at the end of a page, and fits on one.

    Args:
        blocks: those of `content`, in order.
        edges: as for `first_below_a_hole`, with the edge "third row" of tables.
    """
    at = {(edge["block"], edge["edge"]): edge for edge in edges}
    for block in blocks:
        start, third, end = (at.get((block["id"], name)) for name in ("start", "third row", "end"))
        if not (start and third and end) or block["kept"]:
            continue
        high = _PAGE_END_PT - start["y"] + end["y"] - _PAGE_TOP_PT
        split = start["page"] < third["page"] and end["page"] == start["page"] + 1
        if split and high < _PAGE_END_PT - _PAGE_TOP_PT:
            return block
    return None


def content(document: Document) -> dict[str, Any]:
    """Return what the template reads: figures and tables numbered, text split into spans."""
    numbers, ids = numbering(), count()
    return {
        "title": document.title,
        "subtitle": document.subtitle,
        "sections": [
            {
                "title": section.title,
                "blocks": [
                    {"id": next(ids), **_block(block, next_number(numbers, block))}
                    for block in section.blocks
                ],
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


def _block(block: Block, number: str) -> dict[str, Any]:
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
                "lines": [_spans(line) for line in text.splitlines()],
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
                "loose": len(block.rows) > _MANY_ROWS,
                "kept": False,
            }
        case Figure(name, caption, _):
            return {
                "kind": "figure",
                "number": number,
                "name": name,
                "caption": _spans(caption),
                "alt": caption,
                "loose": False,
            }


def _spans(text: str) -> list[Span]:
    """Return the spans of a text for print: a link is its words, no line starts with a % sign."""
    return [
        ("plain", body.partition("\n")[0])
        if kind == "link"
        else (kind, body if kind == "code" else body.replace(" %", "\u00a0%"))
        for kind, body in spans(text)
    ]


def _cell(text: str) -> list[Span]:
    """Return the spans of a cell; an empty one still needs one."""
    return _spans(text) or [("plain", "")]
