"""A document as one self-contained page for a browser, light and dark."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from pathlib import Path
from string import Template

from bampipe.report import style
from bampipe.report.document import (
    Block,
    Bullets,
    Callout,
    Document,
    Figure,
    Formulas,
    Paragraph,
    Subheading,
    Table,
    number_blocks,
    spans,
)

_TEMPLATE = Path(__file__).parent / "templates" / "page.html"
_TAGS = {"strong": "strong", "code": "code"}


def page(document: Document, beside: str = "") -> str:
    """Return ``document`` as HTML with its figures inside.

    Args:
        document: what to show.
        beside: name of the page for exploring in the same folder, which the contents then link.
    """
    contents, body = [], []
    if beside:
        contents.append(f'<li><a href="{beside}"><strong>Explore the data</strong></a></li>')
    for section, numbered in number_blocks(document):
        anchor = re.sub(r"[^a-z0-9]+", "-", section.title.lower()).strip("-")
        contents.append(f'<li><a href="#{anchor}">{html.escape(section.title)}</a></li>')
        blocks = "\n".join(_block(*pair) for pair in numbered)
        body.append(
            f'<section aria-labelledby="{anchor}">\n'
            f'<h2 id="{anchor}">{html.escape(section.title)}</h2>\n{blocks}\n</section>'
        )
    return Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        title=html.escape(document.title),
        subtitle=html.escape(document.subtitle),
        contents="\n".join(contents),
        body="\n".join(body),
    )


def _rich(text: str, *, breaking: bool = False) -> str:
    """Return HTML for text with marks; ``breaking``: names may break behind their marks."""
    parts = []
    for kind, body in spans(text):
        if kind == "link":
            words, _, target = body.partition("\n")
            parts.append(f'<a href="{html.escape(target)}">{html.escape(words)}</a>')
            continue
        safe = html.escape(body)
        if breaking and kind == "code":
            safe = re.sub(r"(?<=[._+:])", "<wbr>", safe)
        parts.append(f"<{_TAGS[kind]}>{safe}</{_TAGS[kind]}>" if kind in _TAGS else safe)
    return "".join(parts)


def _block(block: Block, number: str) -> str:
    match block:
        case Paragraph(text):
            return f"<p>{_rich(text)}</p>"
        case Subheading(text):
            return f"<h3>{_rich(text)}</h3>"
        case Bullets(items):
            return "<ul>" + "".join(f"<li>{_rich(item)}</li>" for item in items) + "</ul>"
        case Formulas(lines):
            rows = "".join(f"<div>{html.escape(line)}</div>" for line in lines)
            return f'<div class="formulas">{rows}</div>'
        case Callout(tone, title, text):
            rest = "".join(f"<p>{_rich(line)}</p>" for line in text.splitlines())
            return f'<div class="callout {tone}"><p class="verdict">{_rich(title)}</p>{rest}</div>'
        case Table():
            return _table(block, number)
        case Figure(name, caption, svg):
            return (
                f"<figure>{_inline(svg, name, caption)}"
                f"<figcaption><strong>{number}</strong> {_rich(caption)}</figcaption></figure>"
            )


def _table(table: Table, number: str) -> str:
    columns = table.read_columns()
    head = "".join(
        f'<th scope="col" class="{column.side}">{_rich(column.title)}</th>' for column in columns
    )
    looks = [column.side if column.width else f"{column.side} whole" for column in columns]
    rows = "\n".join(f"<tr>{_cells(looks, row)}</tr>" for row in table.rows)
    note = f'<p class="remark">{_rich(table.note)}</p>' if table.note else ""
    return (
        f'<div class="scroll"><table><caption class="caption"><strong>{number}</strong> '
        f"{_rich(table.caption)}</caption><thead><tr>{head}</tr></thead>\n"
        f"<tbody>{rows}</tbody></table></div>{note}"
    )


def _cells(looks: Sequence[str], row: Sequence[str]) -> str:
    return "".join(
        f'<td class="{look}">{_rich(cell, breaking=True)}</td>'
        for look, cell in zip(looks, row, strict=True)
    )


def _inline(svg: str, name: str, caption: str) -> str:
    """Return the drawing for use inside a page: ids of its own, colours from the style sheet."""
    drawing = svg[svg.index("<svg") :]
    drawing = re.sub(r"<metadata>.*?</metadata>", "", drawing, flags=re.DOTALL)
    drawing = re.sub(r'\bid="', f'id="{name}-', drawing)
    drawing = re.sub(r'(url\(#|href="#)', rf"\g<1>{name}-", drawing)
    for word, colour in style.COLOURS.items():
        drawing = drawing.replace(colour, f"var(--{word})")
    width = re.search(r'\bwidth="([\d.]+)pt"', drawing)
    share = min(1.0, float(width[1]) / 72.0 / style.WIDTH) if width else 1.0
    title = html.escape(re.sub(r"[*`]", "", caption), quote=True)
    words = f'role="img" aria-label="{title}" style="max-width: {100.0 * share:.1f}%"'
    return drawing.replace("<svg ", f"<svg {words} ", 1)
