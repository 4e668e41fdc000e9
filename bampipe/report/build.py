"""From a run folder to the report's files."""

from __future__ import annotations

import datetime
import importlib
from collections.abc import Callable
from dataclasses import dataclass, replace

from bampipe.report import page, style, typeset
from bampipe.report.document import Block, Callout, Document, Figure, Section
from bampipe.report.explorer.page import explorer_page
from bampipe.report.results import Results
from bampipe.report.sections import SECTIONS
from bampipe.results.setup import SetupResult


@dataclass(frozen=True)
class Report:
    """The files of a report.

    Attributes:
        pdf: the printed form.
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
    def of(cls, document: Document, recorded: int, explorer: str = "") -> Report:
        """Return the files of ``document``; see `typeset.pdf` for ``recorded``."""
        figures = {
            block.name: block.svg
            for section in document.sections
            for block in section.blocks
            if isinstance(block, Figure)
        }
        titles = tuple(section.title for section in document.sections)
        return cls(
            typeset.pdf(document, recorded),
            page.page(document, "explore.html" if explorer else ""),
            explorer,
            figures,
            titles,
        )


def build(results: Results, progress: Callable[[float, str], None]) -> Report:
    """Return the report of ``results``.

    Args:
        results: the run folder's.
        progress: called with the share done and what is under way.

    Raises:
        InputError: ingest has not run, or a result is damaged.
    """
    sections = []
    for number, name in enumerate(SECTIONS):
        progress(0.7 * number / len(SECTIONS), name)
        module = importlib.import_module(f"bampipe.report.sections.{name}")
        with style.look():
            section: Section | None = module.section(results)
        if section is not None:
            sections.append(section)
    sections[0] = replace(sections[0], blocks=(*_warnings(results), *sections[0].blocks))
    document = Document(
        f"Session {results.session.session_id}", _subtitle(results), tuple(sections)
    )
    progress(0.7, "page for exploring")
    explorer = explorer_page(results, document.subtitle)
    progress(0.85, "typesetting")
    return Report.of(document, _recorded(results), explorer)


def _warnings(results: Results) -> tuple[Block, ...]:
    """Return what must be known before anything else is read."""
    return (*_setup(results), *_outdated(results))


def _setup(results: Results) -> tuple[Block, ...]:
    setup = results.read(SetupResult)
    if setup is None:
        return ()
    blocks: list[Block] = []
    for mistake in setup.mistakes:
        text = f"Set right, {mistake.evidence}."
        if mistake.alternatives:
            others = "; ".join(other.sentence for other in mistake.alternatives)
            text += f" The trials cannot tell it from: {others}."
        text += " Nothing below counts before the session file is corrected."
        blocks.append(Callout("attention", f"Set-up: {mistake.sentence}", text))
    if setup.warnings:
        text = " ".join(f"{line}." for line in setup.warnings)
        blocks.append(Callout("note", "Doubtful set-up", text))
    return tuple(blocks)


def _outdated(results: Results) -> tuple[Block, ...]:
    if not results.outdated:
        return ()
    steps = ", ".join(f"`{step}`" for step in results.outdated)
    text = f"Run these again before relying on what they say: {steps}."
    return (Callout("attention", "Some results are older than what they were made from", text),)


def _subtitle(results: Results) -> str:
    session = results.session
    serial = f" {session.device_serial}" if session.device_serial else ""
    parts = ["simulated"] if session.simulated else []
    parts.append(f"device {session.device}{serial}")
    recorded = results.session.recorded_at
    if recorded:
        when = datetime.datetime.fromisoformat(recorded)
        parts.append(f"recorded {when:%Y-%m-%d %H:%M}{' UTC' if _is_utc(when) else ''}")
    if session.operator:
        parts.append(f"by {session.operator}")
    return ", ".join(parts)


def _is_utc(when: datetime.datetime) -> bool:
    return when.utcoffset() == datetime.timedelta(0)


def _recorded(results: Results) -> int:
    """Return when the session was recorded, in seconds since 1970; 0 where that is not known."""
    recorded = results.session.recorded_at
    if not recorded:
        return 0
    when = datetime.datetime.fromisoformat(recorded)
    if when.tzinfo is None:
        when = when.replace(tzinfo=datetime.UTC)
    return max(0, int(when.timestamp()))
