"""The device's paper and this session, side by side."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from bampipe.report import wording
from bampipe.report.document import Block, Bullets, Callout, Section, Subheading, Table
from bampipe.report.results import Results

_SIMULATED = (
    Callout(
        "note",
        "This session is simulated",
        "Agreement with the paper shows that the pipeline finds what the simulator was given. It "
        "replicates nothing that was measured.",
    ),
)


def section(results: Results) -> Section | None:
    """Return the section; None for a device without a paper."""
    paper = results.paper
    if paper is None:
        return None
    rows = tuple(_row(results, row) for row in paper["rows"])
    blocks: list[Block] = [
        *(_SIMULATED if results.session.simulated else ()),
        Table(
            f"{paper['title']}: published values and those of this session",
            ("Quantity", "Place", "Paper", "This session", "Unit"),
            rows,
            "llrrl",
            note="Paper: digits as printed there." + _lacking(rows),
        ),
    ]
    if "comparison" in paper:
        blocks.append(_comparison(results, paper["comparison"]))
    notes = tuple(paper.get("notes", {}).get("text", ()))
    if notes:
        blocks += [Subheading("Where this differs from the paper, and why"), Bullets(notes)]
    return Section("Paper and this session", tuple(blocks))


def _row(results: Results, row: dict[str, Any]) -> tuple[str, ...]:
    value = _stored(results, row, "value")
    sd = _stored(results, row, "sd")
    if value is None:
        shown = "–"
    elif sd is None:
        shown = wording.significant(value)
    else:
        shown = wording.with_sd(value, sd)
    return (
        row["quantity"],
        row["place"],
        row["published"],
        shown,
        wording.unit(row["unit"]),
    )


def _comparison(results: Results, comparison: dict[str, Any]) -> Table:
    """Return the device of this session beside others, as published."""
    rows = []
    for row in comparison["rows"]:
        parts = [_range(results, place) for place in row["session"]]
        own = "; ".join(part for part in parts if part) or "–"
        rows.append((row["quantity"], own, *row["published"]))
    return Table(
        f"The device of this session beside others, as published ({comparison['place']})",
        ("", "This session", *comparison["devices"]),
        tuple(rows),
        "llllll",
        (0.9, 1.2, 1.2, 0.95, 0.95, 0.9),
        comparison["note"] + _lacking(rows),
    )


def _lacking(rows: Iterable[tuple[str, ...]]) -> str:
    return (
        " –: no such result in this session: no trials for it, or a method that does not give it."
        if any("–" in row for row in rows)
        else ""
    )


def _range(results: Results, place: dict[str, Any]) -> str:
    """Return a stored number or range with its unit; "" where it is not stored."""
    unit, digits = wording.unit(place["unit"]), int(place.get("digits", 3))
    if "value" in place:
        value = _stored(results, place, "value")
        return "" if value is None else f"{wording.significant(value, digits)} {unit}"
    low, high = _stored(results, place, "lower"), _stored(results, place, "upper")
    if low is None or high is None:
        return ""
    return f"{wording.significant(low, digits)} to {wording.significant(high, digits)} {unit}"


def _stored(results: Results, place: dict[str, Any], key: str) -> float | None:
    """Return the number that ``place`` names under ``key``, times its factor."""
    if key not in place:
        return None
    content = results.json(place["file"].format(model=results.model)) or {}
    value = _find(content, place[key])
    return None if value is None else float(place.get("factor", 1.0)) * value


def _find(content: Any, dotted: str) -> float | None:
    """Return the number at a dotted place; keys may hold dots themselves."""
    if not dotted:
        return float(content) if isinstance(content, int | float) else None
    if not isinstance(content, dict):
        return None
    parts = dotted.split(".")
    for length in range(len(parts), 0, -1):
        key = ".".join(parts[:length])
        if key in content:
            return _find(content[key], ".".join(parts[length:]))
    return None
