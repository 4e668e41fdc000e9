"""A plan of trials as one printed page for the bench."""

from __future__ import annotations

from bampipe.report import typeset, wording
from bampipe.report.document import Block, Bullets, Document, Paragraph, Section, Table
from bampipe.results.next import Plan

_BEFORE = (
    "Tare the force sensor with the hand off the handle.",
    "Start the log, wait two seconds, then move.",
    "Better a little slower and a little less far than faster and farther.",
    "Add each file to session.toml as a free trial, and run the session again.",
)


def protocol_sheet(plan: Plan, session: str, model: str) -> bytes:
    """Return the PDF of a plan: the same plan gives the same bytes.

    Args:
        plan: what to record; session, model: that it is for.
    """
    rows = tuple(
        (
            f"{trial.times} times" if trial.times > 1 else "once",
            trial.sentence,
            "",
        )
        for trial in plan.trials
    )
    trials = Table("Trials", ("", "What to do", "Files"), rows, "lll", (0.0, 3.0, 1.0))
    reached = tuple(
        (
            f"`{name}`",
            wording.significant(entry.before, 2),
            wording.significant(entry.after, 2),
            wording.significant(entry.asked, 2),
            wording.unit(entry.unit),
        )
        for name, entry in plan.sd.items()
    )
    blocks: list[Block] = [Paragraph(plan.sentence), trials]
    if reached:
        blocks.append(
            Table(
                "Standard deviations",
                ("Parameter", "now", "expected", "asked", "Unit"),
                reached,
                "lrrrl",
            )
        )
    if plan.confusion:
        pairs = tuple(
            (
                " or ".join(f"`{name}`" for name in pair.between),
                wording.percent(pair.before),
                wording.percent(pair.after),
            )
            for pair in plan.confusion
        )
        blocks.append(Table("Chance of confusion", ("Effects", "now", "expected"), pairs, "lrr"))
    document = Document(
        f"Trials to record: {session}",
        f"Model {model}, {wording.plain(plan.seconds, 0)} s in all",
        (Section("Before each trial", (Bullets(_BEFORE),)), Section("The trials", tuple(blocks))),
    )
    return typeset.pdf(document, 0)
