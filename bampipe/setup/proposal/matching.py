"""Which column of a log is which: by name and unit first, then by what the data show."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from bampipe.data import guesses
from bampipe.data.guesses import is_time
from bampipe.data.names import DRIVERS, REFERENCE_WORDS, words
from bampipe.data.session.channels import Register
from bampipe.data.survey import Survey, SurveyedColumn
from bampipe.setup.proposal.notes import Notes
from bampipe.setup.proposal.positions import TORQUES, is_of_motor, travelled
from bampipe.setup.proposal.robot import RobotColumns

_NO_LESS = 0.03
_SUPPLIED = frozenset(["in", "input", "supply", "bus", "battery", "d", "id"])
"""Words in the name of what a converter takes up, or of flux, rather than what turns a motor."""
_NEVER_DRIVES = ("time", "velocity", "acceleration", "reference", "position")
_INPUT_ROLE = {"N": "force", "N.m": "force", "A": "current", "V": "voltage", "": "voltage"}
_AXES = ("x", "y", "z")
Match = tuple[SurveyedColumn | None, str]


@dataclass
class Matcher:
    """The columns of a survey, and which of them are taken.

    Attributes:
        found: the columns.
        t: (T,) time stamps of the first log, s.
        used: names of the columns that have a meaning already; grows as tables are proposed.
        registers: columns that hold signed numbers in a register, and how.
        notes: what a person has to look at; axes: number of those of the device.
        robot: columns of a robot of which the drawing tells, and how they are counted.
        turning: what the readings of a position are worth, by the weight on it, by name of column.
        given: columns that are known, by name of axis or input.
        reacting: the column of a drive that has the sign of the reaction, "" if none has.
        of_motor: the column of a motor's torque beside the position of its joint, by name.
        geared: the position that may be a motor's before a gear of which nothing tells, by name.
        rivals: names of columns that may be the position, where there are several.
        scale_sd: field of the uncertainty of a scale that is guessed, by name of axis or input.
    """

    found: Survey
    t: np.ndarray
    used: set[str]
    registers: Mapping[str, Register]
    notes: Notes
    axes: int = 1
    robot: RobotColumns = field(default_factory=RobotColumns)
    turning: Mapping[str, guesses.Turning] = field(default_factory=dict)
    given: Mapping[str, SurveyedColumn] = field(default_factory=dict)
    reacting: str = ""
    of_motor: str = ""
    geared: str = ""
    rivals: list[str] = field(default_factory=list)
    scale_sd: dict[str, str] = field(default_factory=dict)

    def named(self, name: str, *roles: str) -> SurveyedColumn | None:
        """The column that has the words of ``name``, of one of the roles."""
        if name in self.given:
            return self.given[name]
        wanted, numbers = set(words(name)), set(_numbers(name))
        for column in self.found.of(*roles):
            counted = set(_numbers(column.name))
            alike = wanted <= set(words(column.name)) and (numbers <= counted or not counted)
            if column.name == name or alike:
                return column
        return None

    def position(self, axis: str) -> SurveyedColumn | None:
        """The measured position of an axis, "" for any; of several axes, only the name tells."""
        named = self.named(axis, "position") if axis else None
        if named is not None or self.axes > 1:
            return named
        moving = [c for c in self.found.columns if not c.is_constant]
        found = [c for c in moving if c.role == "position"]
        found = found or [c for c in moving if not c.role and re.match(r"q\w?\Z", c.name.lower())]
        # A test stand may log the velocity only, which is integrated then.
        found = found or [c for c in moving if c.role == "velocity"]
        found = found or [c for c in moving if c.name in ("v", "V")]
        found = [c for c in found if not is_of_motor(c)] or found
        if len(found) < 2:
            return found[0] if found else None
        best = found[0]
        for other in found[1:]:
            alike = abs(float(np.corrcoef(best.values, other.values)[0, 1])) > 0.9
            alike &= not guesses.is_copy(best.values, other.values)
            best = other if alike and guesses.follows(best.values, other.values) else best
        self.rivals = [c.name for c in found]
        drives = [c for c in self.found.of(*DRIVERS) if not c.is_constant]
        if len(drives) != 1:
            return best
        # Of a cart and the pole on it, the cart is driven.
        share = {c.name: self._share(c, drives[0]) for c in found}
        most = max(found, key=lambda c: share[c.name])
        clear = 1.0 - share[most.name] < guesses.CLEARLY * (1.0 - share[best.name])
        return most if clear and share[most.name] >= guesses.MOVED else best

    def stage(
        self, position: SurveyedColumn, driver: SurveyedColumn
    ) -> dict[str, tuple[SurveyedColumn, SurveyedColumn]]:
        """Position and drive of the axes x, y and z whose names are alike but for that letter."""
        of: dict[tuple[str, ...], dict[str, SurveyedColumn]] = {}
        for column in self.found.columns:
            said = [word.removeprefix("f") or word for word in words(column.name)]
            bare = [word for word in said if word not in _AXES]
            if len(bare) + 1 == len(said) and not column.is_constant:
                of.setdefault((column.role, *bare), {})[next(filter(_AXES.count, said))] = column
        moved, driven = (
            next((own for own in of.values() if c in own.values()), {}) for c in (position, driver)
        )
        return {
            a: (moved[a], driven[a]) for a in _AXES if moved.keys() == driven.keys() and a in moved
        }

    def of_another(self, position: SurveyedColumn) -> dict[str, str]:
        """Columns of another joint or trial, each by the one of its kind beside ``position``.

        None unless as many columns drive as may be the position, or as may be for each drive.
        """
        known = {*self.used, *(c.name for c in self.given.values())}
        moving = [c for c in self.found.columns if not c.is_constant]
        pairs, driven = dict[str, str](), False
        for column in (c for c in moving if c.name in known and position.name in self.rivals):
            alike = [c.name for c in moving if (c.role, c.si) == (column.role, column.si)]
            if 1 < len(alike) and len(self.rivals) % len(alike) == 0:
                pairs[column.name] = alike[1 if column.name == alike[0] else 0]
                driven |= column.role in DRIVERS
        return pairs if driven and position.name in pairs else {}

    def _share(self, position: SurveyedColumn, column: SurveyedColumn) -> float:
        """The share of a column that the motion of a position explains, 0 if it is the position."""
        values = np.nan_to_num(column.values)
        if abs(float(np.corrcoef(position.values, values)[0, 1])) > 0.98:
            return 0.0
        return guesses.driven(self.t, travelled(position, self.t), values).share

    def inputs(
        self, wanted: Mapping[str, str], axes: tuple[SurveyedColumn, ...]
    ) -> dict[str, Match]:
        """The column of every input, given with its SI unit; why, where that is not by its name."""
        given: dict[str, Match] = {}
        # Those with a unit first: what has none could be anything.
        for name, si in sorted(wanted.items(), key=lambda item: not item[1]):
            given[name] = self._input(name, si, axes)
            column = given[name][0]
            self.used |= {column.name} if column is not None else set()
        return given

    def _input(self, name: str, si: str, axes: tuple[SurveyedColumn, ...]) -> Match:
        role = _INPUT_ROLE.get(si, "")
        if name in self.given:
            return self.given[name], ""
        free = [c for c in self.found.columns if c.name not in self.used]
        exact = next((c for c in free if c.name == name), None)
        named = exact or self.named(name, role) or self.named(name.removeprefix("force_"), role)
        if named is not None and named in free:
            return named, ""
        if len(self.robot.joints) > 1:
            return None, ""  # a column left over is another joint's as well as this one's
        fitting = [c for c in free if c.role == role and not c.is_constant and (si or not c.unit)]
        if len(fitting) == 1 and _compatible(fitting[0], si):
            return fitting[0], ""
        for position in axes:
            best = self.driving(position)
            if best is not None and best.role in ("", role) and _compatible(best, si):
                return best, ", since the motion follows it"
        return None, ""

    def driver(self, position: SurveyedColumn) -> tuple[SurveyedColumn | None, str]:
        """What drives an axis: by its motion, else by name; and what kind of input that is.

        The kind is that of the column, ``duty`` for a voltage given as a share of the supply.
        """
        named = [c for role in DRIVERS for c in self.found.of(role) if not c.is_constant]
        best = self.driving(position) or next(iter(named), None)
        if best is not None and not best.unit and best.name in self.registers:
            # The load of a servo is the share of the time that its bridge is on; a current or a
            # torque is called one.
            is_torque = not TORQUES.isdisjoint(words(best.name))
            return best, "force" if is_torque else "current" if best.role == "current" else "duty"
        if best is None or best.role not in DRIVERS:
            return best, "force"
        duty = best.role == "voltage" and {"pwm", "duty"} & set(words(best.name))
        return best, "duty" if duty else best.role

    def supply(self, driver: SurveyedColumn | None) -> SurveyedColumn | None:
        """The supply voltage beside a duty cycle: in volts or of no unit, and never negative."""
        for column in self.found.of("voltage"):
            if column is not driver and _compatible(column, "V") and np.nanmin(column.values) > 0.0:
                return column
        return None

    def driving(self, position: SurveyedColumn) -> SurveyedColumn | None:
        """The column that acceleration, velocity and friction of the motion explain best."""
        share = {}
        # The command of a coil brakes the motion, and follows it if a force is controlled.
        forced = any(not REFERENCE_WORDS & set(words(c.name)) for c in self.found.of("force"))
        asked = REFERENCE_WORDS if forced else frozenset[str]()
        for column in self.found.columns:
            known = column.name in self.used or column.role in _NEVER_DRIVES
            of_axis = column is position or column.si in ("rad", "m")
            # A flag, or the number of the row.
            known |= column.is_integer and (np.ptp(column.values) == 1.0 or is_time(column.values))
            if known or column.is_constant or of_axis or asked & set(words(column.name)):
                continue
            share[column.name] = self._share(position, column)
        roles = {column.name: column.role for column in self.found.columns}
        fitting = [name for name in share if share[name] >= guesses.DRIVEN]
        number, at_motor = _numbers(position.name), "motor" in words(position.name)
        # A velocity of an unknown name fits itself. Of several joints without a drawing, a drive
        # has the number of its position.
        for is_likelier in (
            lambda name: roles[name] in DRIVERS,
            lambda name: not _SUPPLIED & set(words(name)),
            lambda name: roles[name] != "voltage",  # which goes with the speed, too
            lambda name: number and _numbers(name) == number,
            lambda name: at_motor or "motor" not in words(name) or roles[name] != "force",
        ):
            fitting = [*filter(is_likelier, fitting)] or fitting
        if not fitting:
            return None
        # A torque needs no constant where a current tells the same.
        best = max(fitting, key=lambda name: share[name] + _NO_LESS * (roles[name] == "force"))
        return next(c for c in self.found.columns if c.name == best)


def _numbers(name: str) -> list[str]:
    return [str(int(digits)) for digits in re.findall(r"\d+", name)]


def _compatible(column: SurveyedColumn, si: str) -> bool:
    """Whether nothing that the column says of its unit contradicts ``si``."""
    return column.si in (None, si)
