"""The page for exploring in one file that asks for nothing: records, channels, style, scripts."""

from __future__ import annotations

import html
import json
from pathlib import Path
from string import Template

from bampipe.report import verdicts
from bampipe.report.document import strip_marks
from bampipe.report.explorer.content import gather_content
from bampipe.report.explorer.packing import Packer
from bampipe.report.results import Results

_ASSETS = Path(__file__).parent / "assets"
SCRIPTS = ("data", "statistics", "figure", "traces", "maps", "charts", "tables", "main")
"""The page's own scripts, in the order in which they are read."""


def explorer_page(results: Results, subtitle: str) -> str:
    """Return the page for exploring ``results``.

    Args:
        results: the run folder's.
        subtitle: device and date.
    """
    packer = Packer()
    content = gather_content(results, packer)
    verdict = verdicts.judge_session(results)
    lines = [strip_marks(line) for line in verdict.text.splitlines()]
    title = strip_marks(verdict.title)
    content["verdict"] = {"tone": verdict.tone, "title": title, "lines": lines}
    content["session"] = results.session.session_id
    return assemble_page(content, packer, subtitle)


def assemble_page(content: dict[str, object], packer: Packer, subtitle: str) -> str:
    """Return the page that shows ``content``, whose columns ``packer`` holds."""
    scripts = "\n".join(_read_asset(f"{name}.js") for name in SCRIPTS)
    blocks = "\n".join(
        f'<script type="text/plain" id="block-{number}">{text}</script>'
        for number, text in enumerate(packer.blocks)
    )
    return Template(_read_asset("explorer.html")).substitute(
        title=html.escape(f"Session {content['session']}"),
        subtitle=html.escape(subtitle),
        uplot_licence=_read_asset("uPlot-LICENSE.txt").strip(),
        uplot_style=_read_asset("uPlot.min.css").strip(),
        uplot=_read_asset("uPlot.iife.min.js").strip(),
        style=_read_asset("explorer.css"),
        content=json.dumps(content, allow_nan=False).replace("<", "\\u003c"),
        blocks=blocks,
        scripts=f'(() => {{\n"use strict";\n{scripts}\n}})();',
    )


def _read_asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")
