"""What the readings of a log stand for, before its columns are given a meaning."""

from __future__ import annotations

from dataclasses import replace

from bampipe.data.guesses import Register, find_register
from bampipe.data.quality.stamps import find_fresh_rows
from bampipe.data.survey import DRIVERS, Survey
from bampipe.setup.proposal.notes import Notes


def fresh_readings(found: Survey, notes: Notes) -> Survey:
    """The log without rows that repeat positions, as a logger that is too fast writes them."""
    positions = [c.values for c in found.of("position") if not c.is_constant]
    kept = find_fresh_rows(positions)
    if kept is None:
        return found
    held = 1.0 - len(kept) / len(positions[0])
    notes.check.append(f"{held:.0%} of the rows repeat the positions before them and are left out")
    columns = tuple(replace(c, values=c.values[kept]) for c in found.columns)
    return replace(found, columns=columns)


def signed_readings(found: Survey) -> tuple[Survey, dict[str, Register]]:
    """The log with its registers as signed numbers, and how each of them holds its sign.

    A position that counts on where a counter starts anew is no register: ingest unwraps it.
    """
    registers = {
        column.name: register
        for column in found.of(*DRIVERS, "position", "velocity", "")
        if (register := find_register(column.values)) is not None
        and (register.sign_bit or column.role != "position")
    }
    columns = tuple(
        replace(c, values=registers[c.name].signed(c.values)) if c.name in registers else c
        for c in found.columns
    )
    return replace(found, columns=columns), registers
