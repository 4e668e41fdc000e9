"""Building of the report's files from a run folder."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

from bampipe.files import atomic_writer, write_text
from bampipe.report import page, style, typeset
from bampipe.report.document import Document, Figure, Section
from bampipe.report.explorer.page import explorer_page
from bampipe.report.run_results import Results
from bampipe.report.sections import SECTIONS


@dataclass(frozen=True)
class Report:
    """The files of a report.

    Attributes:
        html: the page for a browser.
        explorer: the page for exploring; "" for a report over several sessions.
        figures: SVG text by name.
        sections: titles, in order.
    """

    pdf: bytes
    html: str
    explorer: str
    figures: dict[str, str]
    sections: tuple[str, ...]

    @classmethod
    def from_document(cls, document: Document, recorded: int, explorer: str = "") -> Self:
        """Return the files of ``document``; see `typeset.render_pdf` for ``recorded``."""
        blocks = (block for section in document.sections for block in section.blocks)
        figures = {block.name: block.svg for block in blocks if isinstance(block, Figure)}
        titles = tuple(section.title for section in document.sections)
        html = page.render_page(document, "explore.html" if explorer else "")
        return cls(typeset.render_pdf([document], recorded), html, explorer, figures, titles)

    def write(self, folder: Path) -> None:
        """Write the files below ``folder``, each whole or not at all."""
        with atomic_writer(folder / "report.pdf", durable=False) as stream:
            stream.write(self.pdf)
        texts = {"report.html": self.html, "explore.html": self.explorer}
        texts |= {f"figures/{name}.svg": svg for name, svg in self.figures.items()}
        for name, text in texts.items():
            if text:
                write_text(folder / name, text, durable=False)


def build_run_report(results: Results, progress: Callable[[float, str], None]) -> Report:
    """Return the report of ``results``; ``progress``: called with the share done."""
    sections = []
    for number, name in enumerate(SECTIONS):
        progress(0.7 * number / len(SECTIONS), name)
        module = importlib.import_module(f"bampipe.report.sections.{name}")
        with style.use_style():
            sections.append(Section.gather(module.TITLE, module.list_blocks(results)))
    session, seconds = results.session, 0
    parts = ["simulated"] if session.simulated else []
    parts.append(f"device {session.device} {session.device_serial}".rstrip())
    if session.recorded_at:
        when = datetime.fromisoformat(session.recorded_at)
        parts.append(f"recorded {when:%Y-%m-%d %H:%M}{' UTC' * (not when.utcoffset())}")
        seconds = max(0, int((when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()))
    if session.operator:
        parts.append(f"by {session.operator}")
    shown = tuple(section for section in sections if section.blocks)
    document = Document(f"Session {session.session_id}", ", ".join(parts), shown)
    progress(0.7, "page for exploring")
    explorer = explorer_page(results, document.subtitle)
    progress(0.85, "typesetting")
    return Report.from_document(document, seconds, explorer)
