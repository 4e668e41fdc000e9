"""A plan of trials as one printed page for the bench."""

from dataclasses import replace

from bampipe.report import typeset
from bampipe.report.document import Block, Document, Section, Table
from bampipe.report.sections.next_trial import tabulate_confusion, tabulate_sds
from bampipe.report.wording import format_decimals
from bampipe.results.next import Plan

_BY_HAND = "Tare the force sensor with the hand off the handle."
_BY_DRIVE = "Check the path for obstacles: the model does not know them."
_BEFORE = (
    "Start the log, wait two seconds, then move.",
    "If in doubt, move more slowly and less far.",
)
_AFTER = (
    "Add each file to session.toml, as a free trial or, with brakes on, as a viscous one.",
    "Then run the session again.",
)
_VERSIONS = ((1.0, 100), (0.9, 30), (0.9, 12), (0.8, 12), (0.8, 6), (0.7, 3))
"""Type scale and number of listed parameters: the first version that fits on a page is printed."""


def protocol_sheet(plan: Plan, session: str, model: str, by_hand: bool) -> bytes:
    """Return the PDF of a plan: the same plan gives the same bytes.

    Args:
        plan: what to record; session, model: of the plan.
        by_hand: whether a person moves the device, or else its drives.
    """
    rows = [(f"{t.times} times" if t.times > 1 else "once", t.sentence, "") for t in plan.trials]
    before = (_BY_HAND if by_hand else _BY_DRIVE, *_BEFORE)
    about = f"Model {model}, {format_decimals(plan.seconds, 0)} s in all"

    def lay_out(scale: float, listed: int) -> Document:
        """Return the sheet with at most ``listed`` parameters."""
        blocks: list[Block] = [
            plan.sentence,
            Table("Trials", " | Motion ~4 | Files ~1", rows),
            _tabulate_uncertainties(plan, model, listed),
            tabulate_confusion("Probability of confusion", ("now", "expected"), plan.confusion),
        ]
        sections = [Section.gather("The trials", blocks)]
        if plan.trials:
            sections.insert(0, Section("Before each trial", (before,)))
            sections.append(Section("After the last one", (_AFTER,)))
        return Document(f"Trials to record: {session}", about, tuple(sections), scale)

    return typeset.render_pdf(lay_out(*version) for version in _VERSIONS)


def _tabulate_uncertainties(plan: Plan, model: str, listed: int) -> Table:
    """Tabulate the standard deviations farthest above the required limit."""
    left = {name: e.after / e.asked if e.asked > 0.0 else 0.0 for name, e in plan.sd.items()}
    far = set(sorted(left, key=lambda name: -left[name])[:listed])
    table = tabulate_sds("Standard deviations", {n: e for n, e in plan.sd.items() if n in far})
    if len(far) == len(plan.sd):
        return table
    rest = (
        f"Of {len(plan.sd)} parameters, those farthest above the limit asked;"
        f" models/{model}/next.json lists all."
    )
    return replace(table, note=f"{rest} {table.note}".rstrip())
