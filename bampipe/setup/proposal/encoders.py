"""The table ``[encoders]``: the column of every axis, its unit or counts, and its velocity."""

from __future__ import annotations

import numpy as np

from bampipe.data import guesses
from bampipe.data.survey import SurveyedColumn, words
from bampipe.data.units import bare, spelled, unit
from bampipe.physics.device import Coordinate, Device
from bampipe.setup.proposal.matching import Matcher
from bampipe.setup.proposal.notes import UNKNOWN, Notes, entry, quoted
from bampipe.setup.proposal.positions import in_counts, is_velocity

_POSITION_UNITS = ("rad", "deg", "mrad", "rev", "m", "mm", "cm", "um", "in")
_SURE, _NEAR = 2.0, 0.025
"""Standard errors, and share, within which a power of two, as most encoders count, is what a turn
counts."""
_SPEED_UNITS = ("rad/s", "deg/s", "rev/s", "rev/min", "m/s", "cm/s", "mm/s", "in/s")


def encoders_table(
    device: Device, match: Matcher, notes: Notes
) -> tuple[list[str], dict[str, SurveyedColumn]]:
    """Propose the column of every axis; its lines, and the columns found, by axis."""
    lines = ["[encoders]"]
    axes: dict[str, SurveyedColumn] = {}
    for axis in device.coordinates:
        column = match.position(axis.name, len(device.coordinates), notes)
        if column is None:
            note = notes.ask_column(axis.name, axis.unit, "position")
            lines.append(f"{axis.name} = {entry(UNKNOWN, axis.unit)}{note}")
            continue
        axes[axis.name] = column
        match.used.add(column.name)
        alone = len(device.coordinates) == 1
        table = _encoder(axis, alone, column, match, notes)
        register = match.registers.get(column.name)
        if register is not None:
            table = table.replace(" }", f"{register.fields} }}", 1)
            notes.check.append(f"{column.name} is {register.words}")
        lines.append(f"{axis.name} = {table}")
    return [*lines, ""], axes


def _encoder(
    axis: Coordinate, alone: bool, column: SurveyedColumn, match: Matcher, notes: Notes
) -> str:
    if is_velocity(column):
        return _integrated(axis, column, notes)
    if in_counts(column):
        return _counted(axis, column, match, notes)
    worth = match.turning.get(column.name)
    if worth is not None and column.si is not None:
        turns, sd = (column.scale * part for part in (worth.size, worth.sd))
        said = spelled(column.unit, _POSITION_UNITS)
        fields = f", gear_ratio = {turns:.4g}, zero_counts = {worth.zero:.4g}"
        return entry(column.name, said, fields) + notes.guess(
            f"{column.name} is the position of the motor of {axis.name}, which turns {turns:.4g} ±"
            f" {_rounded(sd)} times for one turn of it, by its weight, which goes with the sine of"
            " the angle; put in the ratio of the gear"
        )
    right, geared = column.si == axis.unit, axis.name in match.robot.gears
    if (column.by_looks or column.is_foreign) and not right:
        stated = f"stated as '{column.stated}'" if column.is_foreign else ""
        note = notes.ask(
            f"the unit of {column.name}, "
            + (stated or f"which looks like the position of {axis.name}"),
            "who wrote the logger, or by how far the machine moves; rad, deg, m and mm are usual",
        )
        return entry(column.name, UNKNOWN, _velocity_beside(axis, alone, match, notes)) + note
    by_size = "" if right else guesses.likely_unit(axis.unit, column.values)
    said = (spelled(column.unit, _POSITION_UNITS) if right else by_size) or axis.unit
    fields, how = _counting(axis, said, match, match.robot.gears.get(axis.name, 1.0))
    fields += "" if geared else _velocity_beside(axis, alone, match, notes)
    guess = f"is the position of {axis.name}, in {said}" + (", by its size" if by_size else "")
    if geared:
        guess = f"is the position of the motor of {axis.name}, in {said}"
    elif right:
        guess = "" if column.stated or how else f"in {column.unit}"
    guess += ("; it " if guess and how else "") + how
    return entry(column.name, said, fields) + (
        notes.guess(f"{column.name} {guess}") if guess else ""
    )


def _counting(axis: Coordinate, said: str, match: Matcher, turns: float = 1.0) -> tuple[str, str]:
    """Fields of an encoder that counts otherwise than a robot's drawing, and that in words.

    Args:
        axis: whose encoder it is; said: its unit; match: the columns.
        turns: of what the encoder sits on, for one of the axis.
    """
    direction, zero = match.robot.counting.get(axis.name, (1.0, 0.0))
    fields, ways = "", []
    if direction * turns != 1.0:
        fields = f", gear_ratio = {direction * turns:.10g}"
    if direction < 0.0:
        ways.append("counts the other way than the drawing")
    if zero:
        known = unit(said)
        reading = -direction * zero * turns / (known.scale if known is not None else 1.0)
        fields += f", zero_counts = {reading:.5g}"
        ways.append(f"reads {reading:.4g} {said} where the drawing has 0")
    why = ", by weight and inertia as drawn: look it up in the controller's manual"
    return fields, " and ".join(ways) + why if ways else ""


def _integrated(axis: Coordinate, column: SurveyedColumn, notes: Notes) -> str:
    si = f"{axis.unit}/s"
    if column.is_foreign:
        note = notes.ask(
            f"the unit of {column.name}, stated as '{column.stated}', which is integrated",
            "who wrote the logger; rad/s, rev/min and mm/s are usual",
        )
        return entry(column.name, UNKNOWN) + note
    said = spelled(column.unit, _SPEED_UNITS) if column.si == si else ""
    return entry(column.name, said or si) + notes.guess(
        f"no position was recorded: that of {axis.name} is the integral of {column.name}"
    )


def _counted(axis: Coordinate, column: SurveyedColumn, match: Matcher, notes: Notes) -> str:
    """The entry of an encoder that counts; the weight of a joint may show what a count is worth."""
    worth = match.turning.get(column.name)
    zero = worth.zero if worth is not None else float(np.median(column.values))
    turn, sd = (2.0 * np.pi * x for x in ((worth.size, worth.sd) if worth is not None else (0, 0)))
    power = 2.0 ** round(np.log2(turn)) if turn > 0.0 else 0.0
    is_power = abs(turn - power) < max(_SURE * sd, _NEAR * power)
    size = f"{(power if is_power else turn) / (2.0 * np.pi):.6g}" if turn > 0.0 else "0.0"
    counting = f"counts_per_unit = {size}, zero_counts = {zero:.0f}"
    table = f'{{ column = {quoted(column.name)}, {counting}, unit = "{axis.unit}" }}'
    if worth is not None:
        taken = f" ({power:.0f}, a power of two, is taken)" if is_power else ""
        return table + notes.guess(
            f"{column.name} counts {turn:.5g} ± {_rounded(sd)} a turn of {axis.name}{taken}, and"
            f" {zero:.0f} where it hangs, by its weight, which goes with the sine of the angle; put"
            " in the encoder's counts a turn, times the gear, by 2 pi"
        )
    return table + notes.ask(
        f"counts_per_unit of {axis.name}, the counts in one {axis.unit}; zero_counts is a guess",
        "counts a turn in the encoder's data sheet, times the gear, by 2 pi"
        if axis.unit == "rad"
        else "the scale's data sheet",
    )


def _rounded(sd: float) -> str:
    return f"{float(f'{sd:.1g}'):g}"


def _velocity_beside(axis: Coordinate, alone: bool, match: Matcher, notes: Notes) -> str:
    """The field of a recorded velocity, against which the position is checked; "" without one."""
    for column in match.found.of("velocity"):
        fits = column.si == f"{axis.unit}/s" and not column.is_constant
        if fits and (alone or axis.name in words(column.name)):
            match.used.add(column.name)
            notes.check.append(f"{column.name} is used to check the position only")
            return f", velocity = {entry(column.name, bare(column.unit))}"
    return ""
