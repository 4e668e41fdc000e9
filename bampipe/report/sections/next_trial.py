"""What to record next, what it is expected to give, and what the trials would not have shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from bampipe.report import wording
from bampipe.report.document import Block, Bullets, Callout, Paragraph, Section, Table
from bampipe.report.results import Results
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.forecast import compare_forecasts, read_forecasts
from bampipe.results.identify import IdentifyResult
from bampipe.results.next import (
    Detectable,
    ExpectedConfusion,
    ExpectedSd,
    NextResult,
    PlannedConfusion,
    PlannedSd,
)

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
    came: tuple[str, ...] = ()
    if identified is not None:
        forecasts = read_forecasts(results.root, results.model)
        came = compare_forecasts(forecasts, identified, results.read(DiagnoseResult))
    if came:
        blocks.append(Bullets(tuple(line.replace("RUN", results.root.name) for line in came)))
    best = found.proposals[0]
    if best.confusion:
        heads = ("Effects", "with the trials at hand", "with the next one")
        blocks.append(
            confusion_table("Chance of taking one effect for the other", heads, best.confusion)
        )
    if best.sd:
        blocks.append(
            sd_table(
                "Standard deviation of each parameter, now and once the trial has been recorded",
                best.sd,
            )
        )
    if found.sensitivity:
        blocks.append(_sensitivity(found.sensitivity))
    return Section(TITLE, tuple(blocks))


def confusion_table(
    title: str, heads: tuple[str, ...], pairs: Sequence[ExpectedConfusion | PlannedConfusion]
) -> Table:
    """Return the chance of taking one effect for another, without and with new trials."""
    rows = tuple(
        (
            " or ".join(f"`{name}`" for name in pair.between),
            wording.percent(pair.before),
            wording.percent(pair.after),
        )
        for pair in pairs
    )
    return Table(title, heads, rows, "lrr")


def sd_table(title: str, entries: Mapping[str, ExpectedSd]) -> Table:
    """Return the standard deviations of parameters, without and with new trials.

    Args:
        title: of the table; entries: by parameter; of a plan, what is asked is shown, too.
    """
    asked = [e.asked for e in entries.values() if isinstance(e, PlannedSd)]
    rows = tuple(
        (
            f"`{name}`",
            wording.significant(entry.before, 2),
            _expected(entry),
            *([wording.significant(asked[k], 2)] if asked else []),
            wording.unit(entry.unit),
        )
        for k, (name, entry) in enumerate(entries.items())
    )
    heads = ("Parameter", "now", "expected", *(["asked"] if asked else []), "Unit")
    note = "A range, where one number cannot be trusted: eight of ten lie in it."
    wide = not all(entry.is_sharp for entry in entries.values())
    return Table(title, heads, rows, "lrrrl" if asked else "lrrl", note=note if wide else "")


def _expected(entry: ExpectedSd) -> str:
    """What is forecast: one number where it can be trusted, else a range."""
    values = (entry.after,) if entry.is_sharp else (entry.low, entry.high)
    return " to ".join(wording.significant(value, 2) for value in values)


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
            wording.unit(entry.unit) or "1",
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
        "where it is clearly there. With the next, a number may grow: errors are means over all "
        "trials, and the next shows some effects less than those at hand do.",
    )
