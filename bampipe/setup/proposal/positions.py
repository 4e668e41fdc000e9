"""What the readings of a log stand for, and positions in SI."""

import re
from dataclasses import replace

import numpy as np
from scipy.integrate import cumulative_trapezoid

from bampipe.data import guesses
from bampipe.data.names import DRIVERS, words
from bampipe.data.quality.clock import find_fresh_rows
from bampipe.data.quality.encoders import unwrapped
from bampipe.data.quality.faulty_readings import INPUT, POSITION, find_spikes
from bampipe.data.session.channels import Register
from bampipe.data.survey import Survey, SurveyedColumn
from bampipe.data.units import unit
from bampipe.data.vocabulary import word_set
from bampipe.setup.proposal.notes import Notes

SLIDING, TURNING, _SHARES = map(word_set, ("sliding", "turning", "shares"))
_FORCES, TORQUES = map(word_set, ("forces", "torques"))
_FEWEST_COUNTS = 100
_MOST_WILD = 0.01
"""Largest share of the readings that may be wild or missing."""


def is_velocity(column: SurveyedColumn) -> bool:
    """Whether a column that stands for the position is a velocity, to be integrated."""
    return column.role == "velocity" or column.name in ("v", "V")


def is_of_motor(column: SurveyedColumn) -> bool:
    """Whether an angle is that of a motor or of its field, by its name."""
    return not {"motor", "rotor", "elec", "electrical"}.isdisjoint(words(column.name))


def in_counts(column: SurveyedColumn) -> bool:
    """Whether a position is in whole counts of no known unit, and nothing tells their size."""
    unsaid = column.si is None and not re.search(r"\d", column.stated)
    return unsaid and column.is_integer and bool(np.ptp(column.values) > _FEWEST_COUNTS)


def is_force(column: SurveyedColumn) -> bool:
    """Whether the column of a drive is a force rather than a torque, by its unit or its name."""
    said = set(words(column.name))
    if column.si is not None:
        return column.si in ("N", "kg")
    return bool(said & _FORCES) and not said & TORQUES


def needs_gain(column: SurveyedColumn) -> bool:
    """Whether the column of a force is a share or a count, by its name or by whole numbers."""
    counts = column.is_integer and float(np.ptp(column.values)) > _FEWEST_COUNTS
    shares = not _SHARES.isdisjoint(words(column.name))
    return column.si == "" or (not column.unit and (counts or shares))


def slides(column: SurveyedColumn, found: Survey) -> bool:
    """Whether an axis slides rather than turns: by its unit, its name, or a force in newtons."""
    if column.si:
        return column.si in ("m", "m/s")
    said, forces = set(words(column.name)), found.of("force")
    along = bool(said & {"x", "y", "z"}) and not said & TURNING and all(map(is_force, forces))
    return along or bool(said & SLIDING) or any(f.si == "N" for f in forces)


def travelled(column: SurveyedColumn, t: np.ndarray) -> np.ndarray:
    """Position (T,) as the column has it; the integral over ``t`` (T,), s, of a velocity."""
    values: np.ndarray = np.nan_to_num(column.values)
    return cumulative_trapezoid(values, t, initial=0.0) if is_velocity(column) else values


def position_in_si(column: SurveyedColumn, t: np.ndarray, si: str) -> np.ndarray:
    """Position (T,) in ``si``, rad or m; an angle that wraps at a full turn is unwrapped."""
    values = travelled(column, t)
    if is_velocity(column):
        return values * column.scale
    values = values * scale_to(si, column)
    return np.unwrap(values) if si == "rad" and not in_counts(column) else values


def scale_to(si: str, column: SurveyedColumn) -> float:
    """What brings the values of a column to ``si``, by its unit or by the likely one."""
    if column.si == si or (column.si, si) == ("N", "N.m"):  # the lever is to be asked for
        return column.scale
    known = unit(guesses.likely_unit(si, column.values) or si)
    return known.scale if known is not None else 1.0


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


def signed_readings(found: Survey, notes: Notes) -> tuple[Survey, dict[str, Register]]:
    """The log with its registers as signed numbers, and how each of them holds its sign.

    A position that counts on where a counter starts anew is no register: like ingest, it is
    unwrapped, and wild readings are taken out. No position in another unit passes for a drive.
    """
    registers = {
        column.name: register
        for column in found.of(*DRIVERS, "position", "velocity", "")
        if (register := guesses.find_register(column.values)) is not None
        and (register.sign_bit or column.role != "position")
    }
    columns, positions = [], found.of("position")
    for c in found.columns:
        alike = (p.name for p in positions if guesses.is_copy(c.values, p.values))
        copied = next(alike, "") if c.role in DRIVERS and not c.is_constant else ""
        if copied:
            notes.check.append(f"{c.name} repeats {copied} in another unit, and drives nothing")
        others = (p for p in positions if p is not c and _counts_turns(c.values, p.values))
        turning = next((p.name for p in others), "")
        if turning:
            notes.check.append(f"{c.name} counts the turns of {turning}, which is unwrapped")
        values = registers[c.name].signed(c.values) if c.name in registers else c.values
        if c.role == "position" and c.name not in registers and (c.si != "m" or c.is_integer):
            turn = 0.0 if in_counts(c) or c.si == "m" else 2.0 * np.pi / c.scale
            values = unwrapped(values, turn, in_counts(c) or c.is_integer)[0]
        if c.role in ("position", *DRIVERS):
            known = np.isfinite(values)
            known[known] = ~find_spikes(values[known], POSITION if c.role == "position" else INPUT)
            if 0 < np.sum(~known) <= _MOST_WILD * len(values):
                rows = np.arange(len(values))
                values = np.interp(rows, rows[known], values[known])
        role = "reference" if copied or turning else c.role
        columns.append(replace(c, values=values, role=role))
    return replace(found, columns=tuple(columns)), registers


def _counts_turns(values: np.ndarray, of: np.ndarray) -> bool:
    """Whether readings (T,) change just where those ``of`` an encoder (T,) begin a turn anew."""
    turns = np.abs(np.diff(of)) > 0.5 * np.ptp(of)
    return bool(turns.any()) and np.array_equal(np.diff(values) != 0.0, turns)
