"""A document as a PDF, by typst with the fonts that its wheel carries."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from itertools import count, pairwise
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
_PASSED = ("text", "bullets", "table")
"""Kinds of blocks above which a figure may go, within its section."""
_PAGE_END_PT = 782.0
"""Where the text of a page ends, points from its upper edge: A4 less the margin of the template."""
_PAGE_TOP_PT = 65.0
"""Where it begins."""
_HOLE_PT = 85.0
"""White above the end of a page, 3 cm, from which a page looks unfinished."""
_SECTION_HOLE_PT = 200.0
"""White that is better than a figure in a later section: a quarter of the page."""
_ROWS_HOLE_PT = 130.0
"""White that is better than a few rows by themselves."""
_PASSES = 96

_Shown = dict[str, Any]
"""A section or a block, as the template reads it."""
_Edge = dict[str, Any]
"""Where an edge of a block stands."""


def pdf(document: Document, recorded: int) -> bytes:
    """Return ``document`` as PDF: the same document gives the same bytes.

    Args:
        document: what to print.
        recorded: seconds since 1970, the date the file bears; ``SOURCE_DATE_EPOCH`` goes before it.

    Raises:
        InputError: ``SOURCE_DATE_EPOCH`` is set, but not to whole seconds.
    """
    return _print(document, recorded)[0]


def sheet(versions: Sequence[Document], recorded: int) -> bytes:
    """Return the first of ``versions`` that fits on one page as PDF; the last, where none does.

    Args:
        versions: of one document, the fullest first; recorded: as for `pdf`.
    """
    printed = b""
    for document in versions:
        printed, pages = _print(document, recorded)
        if pages == 1:
            break
    return printed


def _print(document: Document, recorded: int) -> tuple[bytes, int]:
    """Return the PDF, and how many pages it has."""
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
        return printed, max(edge["page"] for edge in _edges(compiler))


def _lay_out(shown: dict[str, Any], source: Path) -> typst.Compiler:
    """Return a compiler of what is ``shown``: no holes above figures and tables, figures in order.

    Pages fill from the first, and what is moved on one moves all that comes later: each pass mends
    the first fault that is left.
    """
    compiler = typst.Compiler(source, root=source.parent, ignore_system_fonts=True)
    for _ in range(_PASSES):
        (source.parent / "document.json").write_text(json.dumps(shown), encoding="utf-8")
        if not mend_first(shown["sections"], _edges(compiler)):
            break
    return compiler


def _edges(compiler: typst.Compiler) -> list[_Edge]:
    found: list[_Edge] = json.loads(compiler.query("<edge>", field="value"))
    return found


def mend_first(sections: list[_Shown], edges: list[_Edge]) -> bool:
    """Mend the first fault in place; whether there was one.

    Args:
        sections: those of `content`, changed in place.
        edges: what the template reports: block, edge (such as "start"), page, y in points. The
            start of a section bears the number of its first block.
    """
    order = [block["id"] for _, block in _each(sections)]
    faults = [
        (order.index(block["id"]), find, block)
        for find in (first_below_a_hole, first_overtaking, first_with_few_rows)
        if (block := find(sections, edges))
    ]
    if behind := first_left_behind(sections, edges):
        faults.append((order.index(behind["blocks"][-1]["id"]), first_left_behind, behind))
    if not faults:
        return False
    # What comes before it is as it will stay.
    _, find, found = min(faults, key=lambda fault: fault[0])
    if find is first_left_behind:
        found["held"] = True
    elif find is first_with_few_rows:
        found["kept"] = True
    elif not (find is first_below_a_hole and found["kind"] == "figure" and _raise(sections, found)):
        found["loose"] = True
    return True


def _raise(sections: list[_Shown], figure: _Shown) -> bool:
    """Put a figure above what stands before it in its section; back where it came from, if none."""
    blocks = next(section["blocks"] for section in sections if figure in section["blocks"])
    place = blocks.index(figure)
    if place > 0 and (passed := blocks[place - 1])["kind"] in _PASSED:
        if passed["kind"] == "table":  # where it stands now, it may break as if for the first time
            passed |= {"loose": len(passed["rows"]) > _MANY_ROWS, "kept": False}
        blocks[place - 1 : place + 1] = figure, passed
        figure["raised"] += 1
        return True
    blocks.insert(place + figure["raised"], blocks.pop(place))
    return False


def first_below_a_hole(sections: list[_Shown], edges: list[_Edge]) -> _Shown | None:
    """Return the first block that went to a new page and left a hole on the one before.

    Args:
        sections, edges: as for `mend_first`.
    """
    starts, ends = _at(edges, "start"), _at(edges, "end")
    page, filled = 0, _PAGE_END_PT
    for section, block in _each(sections):
        start, end = starts.get(block["id"]), ends.get(block["id"])
        first = block["kind"] == "figure" and block is section["blocks"][0]
        hole = _PAGE_END_PT - filled > (_SECTION_HOLE_PT if first else _HOLE_PT)
        whole = block["kind"] == "table" and (block["kept"] or len(block["rows"]) <= _FEW_ROWS)
        if start and not (block["loose"] or whole) and start["page"] > page and hole:
            return block
        floats = block["kind"] == "figure" and block["loose"] and not section["held"]
        if end and not floats:
            page, filled = max((page, filled), (end["page"], end["y"]))
    return None


def first_overtaking(sections: list[_Shown], edges: list[_Edge]) -> _Shown | None:
    """Return the first figure that stands before an earlier one, which went to a later page.

    Args:
        sections, edges: as for `mend_first`.
    """
    starts = _at(edges, "start")
    page = 0
    for _, block in _each(sections):
        if block["kind"] == "figure" and block["id"] in starts:
            if starts[block["id"]]["page"] < page and not block["loose"]:
                return block
            page = max(page, starts[block["id"]]["page"])
    return None


def first_with_few_rows(sections: list[_Shown], edges: list[_Edge]) -> _Shown | None:
    """Return the first table with one or two rows by themselves on a page, that fits on one.

    Args:
        sections, edges: as for `mend_first`.
    """
    starts, ends = _at(edges, "start"), _at(edges, "end")
    third, last_but_one = _at(edges, "third row"), _at(edges, "last but one")
    for _, block in _each(sections):
        if block["kind"] != "table" or block["kept"] or block["id"] not in third:
            continue
        start, end = starts[block["id"]], ends[block["id"]]
        left = _PAGE_END_PT - start["y"]
        high = left + end["y"] - _PAGE_TOP_PT
        if end["page"] != start["page"] + 1 or high > _PAGE_END_PT - _PAGE_TOP_PT:
            continue
        few = third[block["id"]]["page"] > start["page"]
        alone = last_but_one[block["id"]]["page"] == start["page"]
        if (few or alone) and left <= _ROWS_HOLE_PT:
            return block
    return None


def first_left_behind(sections: list[_Shown], edges: list[_Edge]) -> _Shown | None:
    """Return the first section with a figure in the one after it, where a small hole spares that.

    Args:
        sections, edges: as for `mend_first`.
    """
    heads, starts, ends = (_at(edges, name) for name in ("section", "start", "end"))
    for section, later in pairwise(sections):
        floating = [b for b in section["blocks"] if b["kind"] == "figure" and b["loose"]]
        pages = {starts[figure["id"]]["page"] for figure in floating}
        head = heads[later["blocks"][0]["id"]]["page"]
        text = [ends[b["id"]] for b in section["blocks"] if b not in floating and b["id"] in ends]
        filled = text[-1]["y"] if text else _PAGE_TOP_PT
        small = _PAGE_END_PT - filled <= _SECTION_HOLE_PT
        if not section["held"] and small and max(pages, default=0) == head + 1:
            return section
    return None


def _each(sections: list[_Shown]) -> Iterator[tuple[_Shown, _Shown]]:
    """Yield each block with its section before it."""
    return ((section, block) for section in sections for block in section["blocks"])


def _at(edges: list[_Edge], name: str) -> dict[int, _Edge]:
    """Return the edges of one name by block."""
    return {edge["block"]: edge for edge in edges if edge["edge"] == name}


def content(document: Document) -> dict[str, Any]:
    """Return what the template reads: figures and tables numbered, text split into spans."""
    numbers, ids = numbering(), count()
    return {
        "title": document.title,
        "subtitle": document.subtitle,
        "scale": document.scale,
        "sections": [
            {
                "title": section.title,
                "held": False,
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
                "raised": 0,
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
