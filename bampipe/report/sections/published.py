"""The device's paper and this session, side by side."""

from collections.abc import Iterable, Iterator
from typing import Any

from bampipe.files import pick_values, read_json_table
from bampipe.report.document import Block, Callout, Subheading, Table
from bampipe.report.run_results import Results
from bampipe.report.wording import NONE, format_digits, format_unit, format_with_sd

TITLE = "Paper and this session"
_SIMULATED = Callout(
    "note",
    "This session is simulated",
    "Agreement with the paper shows that the pipeline recovers the numbers of the simulator. It "
    "replicates nothing that was measured.",
)


def list_blocks(results: Results) -> Iterator[Block]:
    """Yield the comparison with the device's paper, if it has one."""
    paper = results.paper
    if paper is None:
        return
    rows = []
    for row in paper["rows"]:
        value, sd = _read_number(results, row, "value"), _read_number(results, row, "sd")
        shown = format_digits(value) if sd is None else format_with_sd(value, sd)
        rows.append((row["quantity"], row["place"], row["published"], shown, row["unit"]))
    if results.session.simulated:
        yield _SIMULATED
    yield Table(
        f"{paper['title']}: published values and those of this session",
        "Quantity | Place | >Paper | >This session | Unit :unit",
        rows,
        f"Paper: digits as printed there.{_explain_dash(rows)}",
    )
    if "comparison" in paper:
        comparison = paper["comparison"]
        rows = []
        for row in comparison["rows"]:
            parts = [_format_range(results, place) for place in row["session"]]
            own = "; ".join(part for part in parts if part) or NONE
            rows.append((row["quantity"], own, *row["published"]))
        widths = (1.2, 0.95, 0.95, 0.9)
        heads = (f"{name} ~{w}" for name, w in zip(comparison["devices"], widths, strict=True))
        yield Table(
            f"The device of this session beside others, as published ({comparison['place']})",
            " | ".join((" ~0.9", "This session ~1.2", *heads)),
            rows,
            comparison["note"] + _explain_dash(rows),
        )
    if notes := tuple(paper.get("notes", {}).get("text", ())):
        yield Subheading("Where this differs from the paper, and why")
        yield notes


def _explain_dash(rows: Iterable[tuple[str, ...]]) -> str:
    if not any(NONE in row for row in rows):
        return ""
    return " –: this session has no trials for it, or a method that does not give it."


def _format_range(results: Results, place: dict[str, Any]) -> str:
    """Return a stored number or range with its unit; "" if it is not stored."""
    names = ("value",) if "value" in place else ("lower", "upper")
    values = [_read_number(results, place, name) for name in names]
    if None in values:
        return ""
    digits = int(place.get("digits", 3))
    shown = " to ".join(format_digits(value, digits) for value in values)
    return f"{shown} {format_unit(place['unit'])}"


def _read_number(results: Results, place: dict[str, Any], key: str) -> float | None:
    """Return the number that ``place`` names under ``key``, times its factor."""
    if key not in place:
        return None
    path = results.root / place["file"].format(model=results.model)
    value = pick_values(read_json_table(path) if path.is_file() else {}, place[key]).get("")
    return float(place.get("factor", 1.0)) * value if isinstance(value, int | float) else None
