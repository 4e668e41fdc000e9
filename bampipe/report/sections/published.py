"""The device's paper and this session, side by side."""

from __future__ import annotations

from typing import Any

from bampipe.report import wording
from bampipe.report.document import Block, Bullets, Section, Table
from bampipe.report.results import Results


def section(results: Results) -> Section | None:
    """Return the section; None for a device without a paper."""
    paper = results.paper
    if paper is None:
        return None
    rows = tuple(_row(results, row) for row in paper["rows"])
    blocks: list[Block] = [
        Table(
            f"{paper['title']}: published values and those of this session",
            ("Quantity", "Place", "Paper", "This session", "Unit"),
            rows,
            "llrrl",
        )
    ]
    comparison = paper.get("comparison")
    if comparison:
        blocks.append(
            Table(
                f"The device beside others, as published ({comparison['place']})",
                ("", *comparison["devices"]),
                tuple(tuple(row) for row in comparison["rows"]),
                "lllll",
                (0.9, 1.2, 1.0, 1.0, 1.0),
            )
        )
    notes = tuple(paper.get("notes", {}).get("text", ()))
    if notes:
        blocks.append(Bullets(notes))
    return Section("Paper and this session", tuple(blocks), new_page=True)


def _row(results: Results, row: dict[str, Any]) -> tuple[str, ...]:
    content = results.json(row["file"].format(model=results.model)) or {}
    value = _find(content, row["value"])
    sd = _find(content, row["sd"]) if "sd" in row else None
    factor = float(row.get("factor", 1.0))
    if value is None:
        shown = "–"
    elif sd is None:
        shown = wording.significant(factor * value)
    else:
        shown = wording.with_sd(factor * value, factor * sd)
    return (
        row["quantity"],
        row["place"],
        row["published"],
        shown,
        wording.unit(row["unit"]),
    )


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
