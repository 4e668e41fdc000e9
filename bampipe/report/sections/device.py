"""The device: numbers taken from drawings, with their sources, and what they do (Table II)."""

from __future__ import annotations

from typing import Any

from bampipe.report import wording
from bampipe.report.document import Block, Section, Table, Text
from bampipe.report.results import Results


def section(results: Results) -> Section | None:
    """Return the section; None where no constants are stored."""
    content = results.json(results.of_model("performance.json")) or {}
    constants = content.get("constants") or {}
    identified = results.json(results.of_model("identify.json")) or {}
    known = identified.get("identifiability") or {}
    numbers = {number["name"]: number for number in known.get("numbers", ())}
    blocks: list[Block] = []
    if constants:
        blocks.append(_constants(results, constants, known))
    if numbers:
        blocks.append(_numbers(numbers))
    for group in known.get("together", ()):
        members = wording.listing(f"`{name}`" for name in group["members"])
        sums = wording.listing(f"`{name}`" for name in group["combinations"])
        blocks.append(
            Text(
                f"{members} enter the equations only as {sums}. No motion, however rich, tells the "
                "parts apart: they stand as the device file has them."
            )
        )
    return Section("Device", tuple(blocks)) if blocks else None


def _constants(results: Results, constants: dict[str, Any], known: dict[str, Any]) -> Table:
    grouped = {name for group in known.get("together", ()) for name in group["members"]}
    rows = []
    for name in sorted(constants, key=lambda name: (name in grouped, name.lower())):
        entry = constants[name]
        rows.append(
            (
                f"`{name}`",
                str(entry.get("description") or "–"),
                wording.significant(entry["value"], 4),
                wording.unit(str(entry.get("unit", ""))) or "1",
                str(entry.get("source") or "–"),
            )
        )
    return Table(
        f"Numbers that the device file takes from drawings{results.as_in('Table II')}",
        ("Name", "What", "Value", "Unit", "Source"),
        tuple(rows),
        "llrll",
        (0.0, 1.6, 0.0, 0.0, 1.2),
    )


def _numbers(numbers: dict[str, dict[str, Any]]) -> Table:
    """Return what the trials say of these numbers, and which estimates rest on them."""
    rows = []
    for name, entry in numbers.items():
        moved = sorted(entry["moves_percent"].items(), key=lambda item: -abs(item[1]))
        most = [
            f"`{parameter}` {wording.plain(size, 2)} %"
            for parameter, size in moved[:2]
            if abs(size) >= 0.005
        ]
        unit = wording.unit(str(entry["unit"])) or "1"
        rows.append(
            (
                f"`{name}`",
                f"{wording.significant(entry['value'], 4)} {unit}",
                "–"
                if entry["bound_sd"] is None
                else f"{wording.significant(entry['bound_sd'], 2)}",
                ", ".join(most) or "none by 0.01 %",
            )
        )
    return Table(
        "What the estimates rest on",
        ("Number", "Value", "SD at best", "An error of 1 % would move"),
        tuple(rows),
        "lrrl",
        (1.5, 1.0, 0.6, 2.0),
        "SD at best: how well these trials could determine it, were it estimated with the "
        "parameters (Cramér-Rao bound).",
    )
