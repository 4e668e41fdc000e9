"""The page for exploring as one self-contained file: records, channels, style, scripts."""

import html
import json
from pathlib import Path
from string import Template

from bampipe.report import verdicts
from bampipe.report.document import strip_marks
from bampipe.report.explorer.content import gather_content
from bampipe.report.explorer.packing import Packer
from bampipe.report.run_results import Results

_ASSETS = Path(__file__).parent / "assets"
SCRIPTS = (
    "data",
    "records",
    "statistics",
    "figure",
    "traces",
    "maps",
    "charts",
    "tables",
    "effects",
    "pose",
    "main",
)
"""The page's own scripts, in the order in which they are read."""


def explorer_page(results: Results, subtitle: str, beside: Results | None = None) -> str:
    """Return the page for exploring ``results``, and ``beside``, another session of the device."""
    packer = Packer()
    sessions = [results] if beside is None else [results, beside]
    content = gather_content(sessions, packer)
    names = [one.session.session_id for one in sessions]
    content["callouts"] = []
    for name, verdict in zip(names, map(verdicts.judge_session, sessions), strict=True):
        title = strip_marks(verdict.title if beside is None else f"{name}: {verdict.title}")
        lines = [strip_marks(line) for line in verdict.text.splitlines()]
        content["callouts"].append({"tone": verdict.tone, "title": title, "lines": lines})
    content["session"] = " and ".join(names)
    scripts = "\n".join(_read_asset(f"{name}.js") for name in SCRIPTS)
    blocks = "\n".join(
        f'<script type="text/plain" id="block-{number}">{text}</script>'
        for number, text in enumerate(packer.blocks)
    )
    return Template(_read_asset("explorer.html")).substitute(
        title=html.escape(f"Session{'s' * len(content['callouts'][1:])} {content['session']}"),
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
