"""A document as one self-contained page for a browser, light and dark."""

import html
import re
from pathlib import Path
from string import Template

from bampipe.report import style
from bampipe.report.document import (
    Block,
    Callout,
    Document,
    Figure,
    Formulas,
    Subheading,
    Table,
    number_blocks,
    split_spans,
)

_TEMPLATE = Path(__file__).parent / "templates" / "page.html"


def render_page(document: Document, beside: str = "") -> str:
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
        blocks = "\n".join(_render_block(*pair) for pair in numbered)
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


def _render_spans(text: str, *, breaking: bool = False) -> str:
    """Return HTML for text with marks; ``breaking``: names may break after their marks."""
    parts = []
    for kind, body in split_spans(text):
        if kind == "link":
            words, _, target = body.partition("\n")
            parts.append(f'<a href="{html.escape(target)}">{html.escape(words)}</a>')
            continue
        safe = html.escape(body)
        if breaking and kind == "code":
            safe = re.sub(r"(?<=[._+:])", "<wbr>", safe)
        parts.append(safe if kind == "plain" else f"<{kind}>{safe}</{kind}>")
    return "".join(parts)


def _render_block(block: Block, number: str) -> str:
    match block:
        case str():
            return f"<p>{_render_spans(block)}</p>"
        case Subheading(text):
            return f"<h3>{_render_spans(text)}</h3>"
        case tuple():
            rows = "".join(f"<li>{_render_spans(item)}</li>" for item in block)
            return f"<ul>{rows}</ul>"
        case Formulas(lines):
            rows = "".join(f"<div>{html.escape(line)}</div>" for line in lines)
            return f'<div class="formulas">{rows}</div>'
        case Callout(tone, title, text):
            rest = "".join(f"<p>{_render_spans(line)}</p>" for line in text.splitlines())
            verdict = f'<p class="verdict">{_render_spans(title)}</p>'
            return f'<div class="callout {tone}">{verdict}{rest}</div>'
        case Table():
            return _render_table(block, number)
        case Figure(name, caption, svg):
            return (
                f"<figure>{_embed_drawing(svg, name, caption)}"
                f"<figcaption><strong>{number}</strong> {_render_spans(caption)}"
                "</figcaption></figure>"
            )


def _render_table(table: Table, number: str) -> str:
    columns = table.read_columns()
    head = "".join(
        f'<th scope="col" class="{column.side}">{_render_spans(column.title)}</th>'
        for column in columns
    )
    looks = [column.side if column.width else f"{column.side} whole" for column in columns]

    def render_cell(look: str, text: str) -> str:
        return f'<td class="{look}">{_render_spans(text, breaking=True)}</td>'

    rows = "\n".join(f"<tr>{''.join(map(render_cell, looks, row))}</tr>" for row in table.rows)
    note = f'<p class="remark">{_render_spans(table.note)}</p>' if table.note else ""
    return (
        f'<div class="scroll"><table><caption class="caption"><strong>{number}</strong> '
        f"{_render_spans(table.caption)}</caption><thead><tr>{head}</tr></thead>\n"
        f"<tbody>{rows}</tbody></table></div>{note}"
    )


def _embed_drawing(svg: str, name: str, caption: str) -> str:
    """Return the drawing for use inside a page: with unique ids and colours of the style sheet."""
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
