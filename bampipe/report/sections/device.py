"""The device: numbers taken from drawings, with their sources, and what they do (Table II)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from bampipe.report import wording
from bampipe.report.document import Block, Section, Table
from bampipe.report.results import Results
from bampipe.results.identify import Combined, DeviceNumber, IdentifyResult
from bampipe.results.performance import DeviceConstant, PerformanceResult


def section(results: Results) -> Section | None:
    """Return the section; None where no constants are stored."""
    performance, identified = results.read(PerformanceResult), results.read(IdentifyResult)
    known = identified.identifiability if identified else None
    together = known.together if known else ()
    blocks: list[Block] = []
    if performance and performance.constants:
        blocks.append(_constants(results, performance.constants, together))
    if known and known.numbers:
        blocks.append(_numbers(known.numbers))
    return Section("Device", tuple(blocks)) if blocks else None


def _constants(
    results: Results, constants: Mapping[str, DeviceConstant], together: Iterable[Combined]
) -> Table:
    grouped = {name for group in together for name in group.members}
    rows = []
    for name in sorted(constants, key=lambda name: (name in grouped, name.lower())):
        entry = constants[name]
        rows.append(
            (
                f"`{name}`",
                entry.description,
                wording.as_written(entry.value),
                wording.unit(entry.unit) or "1",
                entry.source,
            )
        )
    return Table(
        f"Numbers that the device file gives, none of them estimated{results.in_paper('Table II')}",
        ("Name", "What", "Value", "Unit", "Source"),
        tuple(rows),
        "llrll",
        (0.0, 1.6, 0.0, 0.0, 1.2),
    ).without_empty_columns()


def _numbers(numbers: Iterable[DeviceNumber]) -> Table:
    """Return what the trials say of these numbers, and which estimates rest on them."""
    rows = []
    for entry in numbers:
        moved = sorted(entry.moves_percent.items(), key=lambda item: -abs(item[1]))
        most = [
            f"`{parameter}` {wording.plain(size, 2)} %"
            for parameter, size in moved[:2]
            if abs(size) >= 0.005
        ]
        unit = wording.unit(entry.unit) or "1"
        rows.append(
            (
                f"`{entry.name}`",
                f"{wording.as_written(entry.value)} {unit}",
                wording.significant(entry.bound_sd, 2),
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
