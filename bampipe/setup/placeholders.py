"""Scales that nobody has filled in: of sensors, and of constants that the input goes through."""

from __future__ import annotations

import ast
from dataclasses import dataclass

from bampipe.physics import System
from bampipe.results.ingest import IngestResult


@dataclass(frozen=True)
class Placeholder:
    """A scale that stands at exactly 1.

    Attributes:
        signals: whose readings it scales.
        sentence: what stands where, without a full stop.
    """

    signals: tuple[str, ...]
    sentence: str


def find_placeholders(system: System, session: IngestResult) -> tuple[Placeholder, ...]:
    """Return scales of exactly 1: counts of an encoder, calibrations, constants of the input."""
    found = [
        Placeholder((axis,), f"counts_per_unit of {axis} is 1")
        for axis, encoder in session.axes.items()
        if encoder.counts_per_unit is not None and abs(encoder.counts_per_unit) == 1.0
    ]
    force = session.force
    if force.raw_unit == "V":
        ones = tuple(
            name
            for name, row in zip(force.columns, force.calibration, strict=True)
            if sorted(map(abs, row)) == [0.0] * (len(row) - 1) + [1.0]
        )
        if ones:
            found.append(Placeholder(ones, f"calibration_n_per_v of {', '.join(ones)} is 1"))
    device = system.model.device
    used = {
        node.id
        for tree in device.applied.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.Name)
    }
    for name, constant in device.constants.items():
        if name in used and constant.value == 1.0 and constant.unit:
            source = f", source {constant.source!r}" if constant.source else ""
            sentence = f"{name} of the device file is 1 {constant.unit}{source}"
            found.append(Placeholder(tuple(device.forces), sentence))
    return tuple(found)
