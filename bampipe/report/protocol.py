"""A plan of trials as one printed page for the bench."""

from __future__ import annotations

from bampipe.report import typeset, wording
from bampipe.report.document import Block, Bullets, Document, Paragraph, Section, Table
from bampipe.report.sections.next_trial import confusion_table, sd_table
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
    blocks: list[Block] = [Paragraph(plan.sentence), trials]
    if plan.sd:
        blocks.append(sd_table("Standard deviations", plan.sd))
    if plan.confusion:
        heads = ("Effects", "now", "expected")
        blocks.append(confusion_table("Chance of confusion", heads, plan.confusion))
    document = Document(
        f"Trials to record: {session}",
        f"Model {model}, {wording.plain(plan.seconds, 0)} s in all",
        (Section("Before each trial", (Bullets(_BEFORE),)), Section("The trials", tuple(blocks))),
    )
    return typeset.pdf(document, 0)
