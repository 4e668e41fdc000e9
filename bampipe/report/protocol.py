"""A plan of trials as one printed page for the bench."""

from __future__ import annotations

from dataclasses import replace

from bampipe.report import typeset, wording
from bampipe.report.document import Block, Bullets, Document, Paragraph, Section, Table
from bampipe.report.sections.next_trial import confusion_table, sd_table
from bampipe.results.next import Plan, PlannedSd

_BY_HAND = "Tare the force sensor with the hand off the handle."
_BY_DRIVE = "Check the way for obstacles: the model knows none."
_BEFORE = (
    "Start the log, wait two seconds, then move.",
    "Better a little slower and a little less far than faster and farther.",
)
_AFTER = (
    "Add each file to session.toml, as a free trial or, with brakes on, as a viscous one.",
    "Then run the session again.",
)
_VERSIONS = ((1.0, 100), (0.9, 30), (0.9, 12), (0.8, 12), (0.8, 6), (0.7, 3))
"""Scale of the type, and how many parameters are listed: the first that fits on a page is printed.
What to do goes before what it is expected to give."""


def protocol_sheet(plan: Plan, session: str, model: str, by_hand: bool) -> bytes:
    """Return the PDF of a plan: the same plan gives the same bytes.

    Args:
        plan: what to record; session, model: that it is for.
        by_hand: whether a person moves the device, or else its drives.
    """
    versions = [_sheet(plan, session, model, by_hand, listed) for _, listed in _VERSIONS]
    return typeset.sheet(
        [replace(one, scale=scale) for one, (scale, _) in zip(versions, _VERSIONS, strict=True)], 0
    )


def _sheet(plan: Plan, session: str, model: str, by_hand: bool, listed: int) -> Document:
    """The sheet with at most so many parameters ``listed``."""
    blocks: list[Block] = [Paragraph(plan.sentence)]
    if plan.trials:
        rows = tuple(
            (f"{trial.times} times" if trial.times > 1 else "once", trial.sentence, "")
            for trial in plan.trials
        )
        blocks.append(Table("Trials", ("", "What to do", "Files"), rows, "lll", (0.0, 4.0, 1.0)))
    if plan.sd:
        blocks.append(_uncertainties(plan, model, listed))
    if plan.confusion:
        heads = ("Effects", "now", "expected")
        blocks.append(confusion_table("Chance of confusion", heads, plan.confusion))
    before = (_BY_HAND if by_hand else _BY_DRIVE, *_BEFORE)
    sections = [Section("The trials", tuple(blocks))]
    if plan.trials:
        first, last = (
            Section(title, (Bullets(items),))
            for title, items in (("Before each trial", before), ("After the last one", _AFTER))
        )
        sections = [first, *sections, last]
    return Document(
        f"Trials to record: {session}",
        f"Model {model}, {wording.plain(plan.seconds, 0)} s in all",
        tuple(sections),
    )


def _uncertainties(plan: Plan, model: str, listed: int) -> Table:
    """Standard deviations of the parameters that stay farthest from what is asked."""

    def left(entry: PlannedSd) -> float:
        return entry.after / entry.asked if entry.asked > 0.0 else 0.0

    far = set(sorted(plan.sd, key=lambda name: -left(plan.sd[name]))[:listed])
    table = sd_table("Standard deviations", {n: e for n, e in plan.sd.items() if n in far})
    if len(far) == len(plan.sd):
        return table
    rest = (
        f"Of {len(plan.sd)} parameters, those farthest from what is asked;"
        f" models/{model}/next.json has them all."
    )
    return replace(table, note=f"{rest} {table.note}".rstrip())
