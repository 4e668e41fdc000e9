"""A document as a PDF, made by typst with the fonts of its wheel."""

import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import typst

from bampipe.errors import InputError
from bampipe.files import temporary_space
from bampipe.report.document import (
    Block,
    Callout,
    Document,
    Figure,
    Table,
    number_blocks,
    split_spans,
)

_TEMPLATE = Path(__file__).parent / "templates" / "report.typ"
_NORMAL_SIZE, _SMALL_SIZE = 9.0, 8.0
_MANY_COLUMNS = 7
_MANY_ROWS, _MANY_LETTERS = 14, 1500
"""Size beyond which a table may continue on the next page."""
_VERBATIM = ("name", "tone", "lines", "columns")
"""Fields of blocks without inline marks."""


def render_pdf(versions: Iterable[Document], recorded: int = 0) -> bytes:
    """Return as PDF the first of ``versions`` that fits on one page, else the last.

    The same documents give the same bytes.

    Args:
        versions: of one document, the fullest first.
        recorded: seconds since 1970, the date in the file; ``SOURCE_DATE_EPOCH`` replaces it.

    Raises:
        InputError: ``SOURCE_DATE_EPOCH`` is set, but not to whole seconds.
    """
    printed = b""
    for document in versions:
        printed, pages = _print(document, recorded)
        if pages == 1:
            break
    return printed


def _print(document: Document, recorded: int) -> tuple[bytes, int]:
    """Return the PDF and its number of pages."""
    stamp = os.environ.get("SOURCE_DATE_EPOCH", str(recorded))
    if not stamp.isdecimal():
        raise InputError(
            f"not a number of seconds: {stamp!r}",
            where="SOURCE_DATE_EPOCH",
            remedy="unset it, or give whole seconds since 1970",
        )
    sections = [
        {"title": section.title, "blocks": [_describe_block(*pair) for pair in blocks]}
        for section, blocks in number_blocks(document)
    ]
    described: dict[str, Any] = {
        "title": document.title,
        "subtitle": document.subtitle,
        "scale": document.scale,
        "sections": sections,
        "floating": [],
    }
    with temporary_space(), tempfile.TemporaryDirectory(prefix="bampipe-report-") as folder:
        root = Path(folder)
        (root / "figures").mkdir()
        for section in document.sections:
            for block in section.blocks:
                if isinstance(block, Figure):
                    (root / f"figures/{block.name}.svg").write_text(block.svg, encoding="utf-8")
        source = root / _TEMPLATE.name
        shutil.copyfile(_TEMPLATE, source)
        compiler = typst.Compiler(source, root=root, ignore_system_fonts=True)
        while True:
            (root / "document.json").write_text(json.dumps(described), encoding="utf-8")
            layout = json.loads(compiler.query("<layout>", field="value"))[0]
            if layout["late"] is None:
                break
            described["floating"].append(layout["late"])
        printed = compiler.compile(format="pdf", timestamp=int(stamp))
        assert isinstance(printed, bytes)  # other formats return a list of pages
        return printed, layout["pages"]


def _describe_block(block: Block, number: str) -> dict[str, Any]:
    """Return the block as the template reads it, its text split into spans."""
    if isinstance(block, str | tuple):
        kind, name = ("paragraph", "text") if isinstance(block, str) else ("bullets", "items")
        return {"kind": kind, "number": number, name: _split_spans(block)}
    shown: dict[str, Any] = {"kind": type(block).__name__.lower(), "number": number}
    for name, value in vars(block).items():
        if isinstance(block, Callout) and name == "text":
            value = value.splitlines()
        if name != "svg":
            shown[name] = value if name in _VERBATIM else _split_spans(value)
    if isinstance(block, Table):
        columns = block.read_columns()
        letters = sum(len(cell) for row in block.rows for cell in row)
        shown |= {
            "head": [_split_spans(column.title) for column in columns],
            "align": [column.side for column in columns],
            "widths": [column.width for column in columns],
            "size": _NORMAL_SIZE if len(columns) < _MANY_COLUMNS else _SMALL_SIZE,
            "breakable": len(block.rows) > _MANY_ROWS or letters > _MANY_LETTERS,
        }
    return shown


def _split_spans(text: str | Sequence[Any]) -> list[Any]:
    """Return the spans of a text, or of each in a sequence: a link is its words."""
    if not isinstance(text, str):
        return [_split_spans(item) for item in text]
    shown = []
    for kind, body in split_spans(text):
        words = body.partition("\n")[0] if kind == "link" else body
        shown.append(("plain" if kind == "link" else kind, words))
    return shown or [("plain", "")]
