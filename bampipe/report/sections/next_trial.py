"""What to record next, what it is expected to give, and what the trials would not have shown."""

from __future__ import annotations

from collections.abc import Mapping

from bampipe.report import wording
from bampipe.report.document import Block, Bullets, Callout, Paragraph, Section, Table
from bampipe.report.results import Results
from bampipe.results.forecast import compare_forecast
from bampipe.results.identify import IdentifyResult
from bampipe.results.next import Detectable, ExpectedConfusion, ExpectedSd, NextResult

TITLE = "What to record next"


def section(results: Results) -> Section | None:
    """Return the section; None where nobody asked."""
    found = results.read(NextResult)
    if found is None:
        return None
    blocks: list[Block] = [
        Callout("note", "The next trial", found.sentence),
        Paragraph(f"{found.why} {found.expected}"),
    ]
    identified = results.read(IdentifyResult)
    came = compare_forecast(found, identified, None) if identified is not None else ()
    if came:
        blocks.append(Bullets(tuple(line.replace("RUN", results.root.name) for line in came)))
    best = found.proposals[0]
    if best.confusion:
        blocks.append(_confusion(best.confusion))
    if best.sd:
        blocks.append(_sd(best.sd))
    if found.sensitivity:
        blocks.append(_sensitivity(found.sensitivity))
    return Section(TITLE, tuple(blocks))


def _confusion(pairs: tuple[ExpectedConfusion, ...]) -> Table:
    rows = tuple(
        (
            " or ".join(f"`{name}`" for name in pair.between),
            wording.percent(pair.before),
            wording.percent(pair.after),
        )
        for pair in pairs
    )
    return Table(
        "Chance of taking one effect for the other",
        ("Effects", "with the trials at hand", "with the next one"),
        rows,
        "lrr",
    )


def _sd(entries: Mapping[str, ExpectedSd]) -> Table:
    rows = tuple(
        (
            f"`{name}`",
            wording.significant(entry.before, 2),
            wording.significant(entry.after, 2),
            wording.significant(entry.after_at_worst, 2),
            wording.unit(entry.unit),
        )
        for name, entry in entries.items()
    )
    return Table(
        "Standard deviation of each parameter, now and once the trial has been recorded",
        ("Parameter", "now", "expected", "in nine of ten", "Unit"),
        rows,
        "lrrrl",
        note="In nine of ten: of the ways in which people follow such a sentence, nine are better.",
    )


def _sensitivity(table: Mapping[str, Detectable]) -> Table:
    def factor(entry: Detectable) -> float:
        return float("inf") if entry.smallest is None else entry.smallest / entry.typical

    order = sorted(table.items(), key=lambda pair: -factor(pair[1]))
    rows = tuple(
        (
            f"`{name}`",
            entry.axis or "–",
            f"`{entry.parameter.rpartition('.')[2]}`",
            wording.significant(entry.smallest, 2),
            wording.significant(entry.with_proposal, 2),
            wording.significant(entry.typical, 2),
            wording.unit(entry.unit),
        )
        for name, entry in order
    )
    return Table(
        "The smallest strength of each effect that these trials would have revealed",
        ("Effect", "Axis", "Strength", "now", "with the next", "typical", "Unit"),
        rows,
        "lllrrrl",
        note="With 90 % probability, the shape of the effect being typical. A dash: trials like "
        "these do not show it at any size, or the model's own parameters imitate it. Typical: "
        "where it is clearly there.",
    )
