"""The tables ``[force]``, ``[brakes]`` and ``[channels]``: the columns of what a device is fed."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bampipe.data import guesses
from bampipe.data.survey import SurveyedColumn, words
from bampipe.data.units import bare, spelled, unit
from bampipe.lists import join_names
from bampipe.physics.device import Device
from bampipe.setup.proposal.device import ChosenDevice
from bampipe.setup.proposal.matching import Match, Matcher
from bampipe.setup.proposal.notes import UNKNOWN, Notes, entry, quoted

_FORCE_UNITS = ("N", "N.m", "mN", "kN", "mN.m", "N.cm", "N.mm", "kN.m", "kgf", "lbf", "kip", "V")
_SHARES = frozenset(["percent", "pct", "raw", "counts", "adc", "permille"])
_FORCES = frozenset(["force", "forc", "kraft", "loadcell", "fx", "fy", "fz"])
_TORQUES = frozenset(["torque", "tau", "trq", "moment", "effort", "drehmoment"])
_LOGGER = "who wrote the logger, or its manual"
_QUANTITY = {"N": "force", "N.m": "torque", "A": "current", "V": "voltage"}
_FEWEST_COUNTS = 100
_MOST_VOLTS = 60.0
"""Of a supply: servos count theirs in tenths."""
_FULL_DUTY = 1.05
"""A duty cycle as a share goes to 1, and a little over by rounding."""


def input_tables(
    chosen: ChosenDevice, axes: Mapping[str, SurveyedColumn], match: Matcher, notes: Notes
) -> list[str]:
    """Propose the column of every input; the lines of those tables that have something to say."""
    device = chosen.device
    wanted = {**dict.fromkeys(device.forces, device.force_unit), **device.channels}
    given = match.inputs(wanted, tuple(axes.values()))
    given |= {name: (c, "") for name, c in chosen.columns.items() if name in wanted}
    lines = []
    sensed = all(name.startswith("force_") for name in device.forces)
    forces = [column for name in device.forces if (column := given[name][0]) is not None]
    if sensed and len(forces) in (0, len(device.forces)):
        match.used |= {column.name for column in forces}
        lines += _force_table(device, forces, given[device.forces[0]][1], notes)
        wanted = dict(device.channels)
    lines += _brakes_table(device, match, notes)
    return lines + _channels_table(wanted, given, match, notes)


def _force_table(
    device: Device, columns: list[SurveyedColumn], why: str, notes: Notes
) -> list[str]:
    names = [column.name for column in columns] or [UNKNOWN] * len(device.forces)
    components = ", ".join(f'"{name}"' for name in device.components)
    which = " and ".join(device.forces)
    ask = "" if columns else notes.ask_column(which, device.force_unit)
    stated = [f'unit = "{device.force_unit}"']
    return [
        "[force]",
        f"columns = [{', '.join(quoted(name) for name in names)}]{ask}",
        f"components = [{components}]",
        *(_force_unit(device, columns, why, notes) if columns else stated),
        "",
    ]


def _force_unit(device: Device, columns: list[SurveyedColumn], why: str, notes: Notes) -> list[str]:
    """The unit that all force columns share, and what makes forces of volts or of counts."""
    units = {spelled(bare(column.unit), _FORCE_UNITS) for column in columns}
    common = units.pop() if len(units) == 1 else ""
    known = unit(common)
    names = ", ".join(quoted(column.name) for column in columns)
    if known is not None and known.si == device.force_unit and common:
        stated = all(column.stated for column in columns)
        return [
            f'unit = "{common}"'
            + ("" if stated else notes.guess(f"{names} is a {_QUANTITY[known.si]} in {common}"))
        ]
    if len({unit(column.unit) for column in columns if column.unit}) > 1:
        note = notes.ask(
            f"one unit of {names}, which are logged in {join_names([c.unit for c in columns])}",
            "export them in one, as a force has one unit; it goes here",
        )
        return [f'unit = "{UNKNOWN}"{note}']
    needs_gain = any(_needs_gain(column) for column in columns)
    if common == "V" or needs_gain:
        row = f"[{', '.join(['0.0'] * len(columns))}]"
        rows = f"[{', '.join([row] * len(columns))}]"
        ask = notes.ask(
            f"calibration_n_per_v, {device.force_unit} for one "
            + (f"of {names}" if needs_gain else "volt"),
            "the sensor's certificate or the driver's manual, or hang a known weight on it",
        )
        if needs_gain:
            volts = notes.guess(f"{names} counts or is a share: like volts it gets a calibration")
            zero = notes.guess(f"{names} is 0 without force")
        else:
            volts = notes.guess("the force channels are volts, by their names")
            zero = notes.ask("zero_v, the volts without force", "a log of the unloaded sensor")
        return [f'unit = "V"{volts}', f"calibration_n_per_v = {rows}{ask}", f"zero_v = {row}{zero}"]
    odd = next((column for column in columns if column.is_foreign), None)
    if odd is not None or any(c.by_looks or not (c.role or c.unit or why) for c in columns):
        looks = "which looks like what drives the motion"
        note = notes.ask(
            f"the unit of {names}, " + (f"stated as '{odd.stated}'" if odd is not None else looks),
            "who wrote the logger; N.m or N of a sensor, V with calibration_n_per_v of counts",
        )
        return [f'unit = "{UNKNOWN}"{note}']
    if device.force_unit == "N.m" and any(_is_force(column) for column in columns):
        note = "" if common else notes.guess(f"{names} is a force in N")
        if any(column.si == "kg" for column in columns):
            common = next(unit for unit in ("kgf", "gf") if columns[0].unit.startswith(unit[:-1]))
            note = notes.guess(f"{names} is the weight of a mass: a force in {common}")
        ask = notes.ask(
            f"lever_m, how far from the axis {names} acts, m",
            "measure it on the machine, or take it from the drawing; if the column is a torque"
            ' already, put unit = "N.m" and take lever_m out',
        )
        return [f'unit = "{common or "N"}"{note}', f"lever_m = 0.0{ask}"]
    note = notes.guess(f"{names} is a {_QUANTITY[device.force_unit]} in {device.force_unit}{why}")
    return [f'unit = "{device.force_unit}"{note}']


def _is_force(column: SurveyedColumn) -> bool:
    """Whether the column of a drive is a force rather than a torque, by its unit or its name."""
    said = set(words(column.name))
    if column.si is not None:
        return column.si in ("N", "kg")
    return bool(said & _FORCES) and not said & _TORQUES


def _needs_gain(column: SurveyedColumn) -> bool:
    """Whether the column of a force is a share or a count, by its name or by whole numbers."""
    counts = column.is_integer and float(np.ptp(column.values)) > _FEWEST_COUNTS
    shares = not _SHARES.isdisjoint(words(column.name))
    return column.si == "" or (not column.unit and (counts or shares))


def _brakes_table(device: Device, match: Matcher, notes: Notes) -> list[str]:
    named = {axis: match.named(name, "brake") for axis, name in device.brakes.items()}
    brakes = {axis: column for axis, column in named.items() if column is not None}
    if not brakes:
        return []
    match.used |= {column.name for column in brakes.values()}
    units = ", ".join(device.coordinate(axis).torque_unit for axis in brakes)
    return [
        "[brakes]",
        f"columns = [{', '.join(quoted(column.name) for column in brakes.values())}]",
        f'unit = "{units}"' + notes.guess("brake commands are in SI units"),
        "",
    ]


def _channels_table(
    wanted: Mapping[str, str], given: Mapping[str, Match], match: Matcher, notes: Notes
) -> list[str]:
    """Lines for the inputs ``wanted``, by name, with their SI units; none if nothing is."""
    if not wanted:
        return []
    lines = ["[channels]"]
    for name, si in wanted.items():
        column, why = given[name]
        if column is None:
            lines.append(f"{name} = {entry(UNKNOWN, si)}{notes.ask_column(name, si)}")
            continue
        match.used.add(column.name)
        lines.append(f"{name} = {_channel(name, si, column, why, match, notes)}")
    return [*lines, ""]


def _channel(
    name: str, si: str, column: SurveyedColumn, why: str, match: Matcher, notes: Notes
) -> str:
    """Column and unit of one input; its register or its scale, where the unit does not do."""
    register = match.registers.get(column.name)
    fields = register.fields if register else ""
    fields += ", scale = -1.0" if name in match.robot.turned else ""
    slides = (column.si, si) == ("N", "N.m")  # the drive of a sliding joint
    if column.si == si or slides:
        table = entry(column.name, bare(column.unit), fields)
        if column.stated and not why and register is None:
            return table
        return table + notes.guess(f"{column.name} is {name}{why}{_unscaled(si, column, register)}")
    if column.is_foreign and si and not register:
        note = notes.ask(f"the unit of {column.name}, stated as '{column.stated}'", _LOGGER)
        return entry(column.name, UNKNOWN, fields) + note
    if register and si and not column.unit:
        note = notes.ask(
            f"the unit of {column.name}, what one count is, such as 2.69mA; {register.words}",
            "the drive's table of registers",
        )
        return entry(column.name, UNKNOWN, fields) + note
    likely = si if register else guesses.likely_unit(si, column.values) or si
    if name == "supply" and column.is_integer and float(np.nanmedian(column.values)) > _MOST_VOLTS:
        likely = "0.1V"
    if name == "duty" and not column.unit:
        most = float(np.nanmax(np.abs(column.values)))
        if most > 100.0:
            table = entry(column.name, "", f"{fields}, scale = 0.0")
            said = f", {register.words}" if register else ""
            return table + notes.ask(
                f"the scale of {name}, 1 over the reading of {column.name} at full duty{said}",
                "the servo's table of registers: in steps of 0.1 % it is 0.001",
            )
        if most > _FULL_DUTY:
            likely = "%"
    where = f" in {likely}" if si else ""
    doubt = "" if likely[:1].isdigit() else _unscaled(si, column, register)
    return entry(column.name, likely, fields) + notes.guess(
        f"{column.name} is {name}{where}{why}{doubt}"
    )


def _unscaled(si: str, column: SurveyedColumn, register: guesses.Register | None) -> str:
    """What to add of a column that may be in counts, or is a register."""
    if register:
        return f", {register.words}: give its scale"
    counts = column.is_integer and not column.unit and si
    return "; if in counts, give their scale too" if counts else ""
