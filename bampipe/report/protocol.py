"""A plan of trials as one printed page for the bench."""

from __future__ import annotations

from bampipe.report import typeset, wording
from bampipe.report.document import Block, Bullets, Document, Paragraph, Section, Table
from bampipe.report.sections.next_trial import confusion_table, sd_table
from bampipe.results.next import Plan

_BY_HAND = "Tare the force sensor with the hand off the handle."
_BY_DRIVE = "Check the way for obstacles: the model knows none."
_BEFORE = (
    "Start the log, wait two seconds, then move.",
    "Better a little slower and a little less far than faster and farther.",
    "Add each file to session.toml as a free trial, and run the session again.",
)


def protocol_sheet(plan: Plan, session: str, model: str, by_hand: bool) -> bytes:
    """Return the PDF of a plan: the same plan gives the same bytes.

    Args:
        plan: what to record; session, model: that it is for.
        by_hand: whether a person moves the device, or else its drives.
    """
    before = (_BY_HAND if by_hand else _BY_DRIVE, *_BEFORE)
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
        (Section("Before each trial", (Bullets(before),)), Section("The trials", tuple(blocks))),
    )
    return typeset.pdf(document, 0)
