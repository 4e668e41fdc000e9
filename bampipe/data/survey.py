"""What a folder of logs holds, before anyone has said what its columns mean."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bampipe.data.readers import EXTENSIONS, columns_of, read_trial
from bampipe.data.readers.trial import Dialect
from bampipe.data.units import RecordedUnit, unit
from bampipe.errors import InputError

MOST_FILES = 500
_WORDS = {
    "time": "t time timestamp stamp zeit clock seconds sec secs nanosec nsec nsecs nanoseconds"
    " millis micros milliseconds microseconds",
    "reference": "goal ref reference setpoint target desired des cmd command soll sollwert demand"
    " wanted con ctrl",
    "brake": "brake bremse",
    "acceleration": "acc accel acceleration qdd ddq beschleunigung",
    "velocity": "vel velocity speed qd dq qdot omega geschwindigkeit drehzahl rpm rate",
    "force": "force f fx fy fz torque tau trq kraft moment loadcell wrench effort"
    " eff efforts torques",
    "current": "current curr cur i iq amp amps ampere strom spulenstrom coil",
    "voltage": "volt volts voltage pwm duty supply vin vbat vbus battery bus spannung",
    "position": "pos position angle theta phi psi q enc encoder disp displacement x stroke winkel"
    " weg lage hub joint deflection yaw pitch extension carriage counts",
}
REFERENCE_WORDS = frozenset(_WORDS["reference"].split())
"""Words for what a controller asks for rather than what was measured."""
DRIVERS = ("force", "current", "voltage")
"""Roles of what may drive an axis."""
_BY_UNIT = {
    "s": "time", "datetime": "time", "rad": "position", "m": "position", "rad/s": "velocity",
    "m/s": "velocity", "N": "force", "N.m": "force", "A": "current", "V": "voltage",
}  # fmt: skip
_BY_SUFFIX = {
    "rad": "position", "deg": "position", "mm": "position", "rpm": "velocity", "Nm": "force",
    "kN": "force", "mA": "current", "mV": "voltage",
}  # fmt: skip
"""By a unit at the end of a name that says nothing else."""
_PLAIN_POSITIONS = frozenset(["pos", "position", "angle", "theta"])
_PRESENT = frozenset(["current", "curr", "cur"])
_UNIT_WORDS = {
    "time": ("us", "ms", "ns", "s"),
    "position": ("rad", "deg", "mm", "cm", "m"),
    "velocity": ("rad/s", "deg/s", "mm/s", "m/s", "rpm"),
    "force": ("Nm", "kN", "N", "V"),
    "current": ("mA", "A"),
    "voltage": ("mV", "V", "percent", "pct", "%"),
}


@dataclass(frozen=True)
class SurveyedColumn:
    """One column that all logs of a folder have.

    Attributes:
        name: as the reader calls it.
        stated: unit that the file gives, "" where it gives none.
        role: time, position, velocity, acceleration, force, current, voltage, brake, reference,
            or "".
        unit: unit by the file, else by the name, "" where neither says.
        values: (T,) of the first log.
    """

    name: str
    stated: str
    role: str
    unit: str
    values: np.ndarray

    @property
    def conversion(self) -> RecordedUnit | None:
        """How its unit becomes SI; None where it has none, or none that is known."""
        return unit(self.unit) if self.unit else None

    @property
    def is_integer(self) -> bool:
        """Whether all values are integers, as counts are."""
        known = self.values[np.isfinite(self.values)]
        return bool(len(known)) and bool(np.all(known == np.rint(known)))

    @property
    def is_constant(self) -> bool:
        """Whether the value never changes."""
        known = self.values[np.isfinite(self.values)]
        return len(known) == 0 or bool(np.ptp(known) == 0.0)


@dataclass(frozen=True)
class Survey:
    """The logs of a folder.

    Attributes:
        files: paths relative to the folder, of the logs that have the same columns.
        columns: what they hold, from the first of them.
        remarks: what was found out about the layout of the first.
        passed: other files, and why each is left out.
    """

    files: tuple[str, ...]
    columns: tuple[SurveyedColumn, ...]
    remarks: tuple[str, ...]
    passed: tuple[tuple[str, str], ...]

    def of(self, *roles: str) -> list[SurveyedColumn]:
        """The columns with one of these roles."""
        return [column for column in self.columns if column.role in roles]


def survey(folder: Path, names: Sequence[str] = ()) -> Survey:
    """Look through the logs in ``folder`` and the folders in it.

    Args:
        folder: of the logs.
        names: of the columns, where they are texts without a header.

    Raises:
        InputError: no such folder, no log in it, too many, or none that can be read.
    """
    if not folder.is_dir():
        raise InputError("no such folder", where=str(folder))
    paths = sorted(
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in EXTENSIONS
        and path.is_file()
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )
    if not paths:
        raise InputError(
            "no log in this folder",
            where=str(folder),
            remedy=f"supported file extensions are {', '.join(EXTENSIONS)}",
        )
    if len(paths) > MOST_FILES:
        raise InputError(f"{len(paths)} logs are more than {MOST_FILES}", where=str(folder))
    found: dict[str, dict[str, str]] = {}
    dialect = Dialect(names=tuple(names))
    passed = []
    for path in paths:
        name = path.relative_to(folder).as_posix()
        try:
            found[name] = columns_of(path, name=name, dialect=dialect)
        except InputError as error:
            passed.append((name, str(error)))
    if not found:
        raise InputError("no log that can be read", where=str(folder), remedy=passed[0][1])
    common = Counter(tuple(sorted(columns)) for columns in found.values()).most_common(1)[0][0]
    _refuse_parted(folder, found, common)
    files = [name for name, columns in found.items() if set(common) <= set(columns)]
    passed += [(name, "has other columns") for name in found if name not in files]
    columns, remarks = _columns(folder / files[0], files[0], found[files[0]], common, dialect)
    return Survey(tuple(files), columns, remarks, tuple(passed))


def _refuse_parted(
    folder: Path, found: Mapping[str, Mapping[str, str]], common: tuple[str, ...]
) -> None:
    """Refuse logs that have their positions in one file and what drives them in another.

    Raises:
        InputError: they are so.
    """
    roles = {
        name: {_role(*column) for column in columns.items()} for name, columns in found.items()
    }
    first = next(name for name, columns in found.items() if set(common) <= set(columns))
    for here, there in (({"position"}, set(DRIVERS)), (set(DRIVERS), {"position"})):
        if here & roles[first] and not (there | {"reference"}) & roles[first]:
            other = next((name for name, other in roles.items() if there & other), "")
            if other:
                raise InputError(
                    f"positions and drives are in different files, such as {first} and {other}",
                    where=str(folder),
                    remedy="put the columns of one recording side by side in one file, the time"
                    " once, and leave the parts out of this folder",
                )


def _columns(
    path: Path, name: str, stated: dict[str, str], common: tuple[str, ...], dialect: Dialect
) -> tuple[tuple[SurveyedColumn, ...], tuple[str, ...]]:
    wanted = [column for column in stated if column in common]
    datetimes = {column: "" for column in wanted if stated[column] == "datetime"}
    # A reader of several topics takes the first column for the time.
    wanted.sort(key=lambda column: _role(column, stated[column]) != "time")
    raw = read_trial(path, wanted, name=name, datetimes=datetimes, dialect=dialect)
    found = []
    for column in wanted:
        said = raw.units.get(column, stated[column])
        role = _role(column, said)
        found.append(
            SurveyedColumn(column, said, role, _unit(column, said, role), raw.columns[column])
        )
    return _with_commands(found), raw.remarks


def _with_commands(columns: list[SurveyedColumn]) -> tuple[SurveyedColumn, ...]:
    """The columns, with commanded forces, currents or voltages for inputs if none was measured.

    Many controllers log what they ask of the drive and nothing of what it gives. Beside a measured
    one, the command is a reference like that of a position.
    """
    if any(column.role in DRIVERS for column in columns):
        return tuple(columns)
    return tuple(
        replace(column, role=role)
        if column.role == "reference" and (role := _role_apart(column)) in DRIVERS
        else column
        for column in columns
    )


def _role_apart(column: SurveyedColumn) -> str:
    """The role that the unit or the rest of the name gives to a reference."""
    known = unit(column.stated)
    if known is not None and known.si in _BY_UNIT:
        return _BY_UNIT[known.si]
    said = set(words(column.name)) - REFERENCE_WORDS
    return next((role for role in DRIVERS if said & set(_WORDS[role].split())), "")


def words(name: str) -> list[str]:
    """The words in the name of a column, in lower case."""
    bare = re.sub(r"[\[(].*?[\])]", " ", name)
    parts = re.split(r"[^A-Za-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", bare))
    return [part.lower() for part in parts if part]


def _role(name: str, stated: str) -> str:
    if stated == "datetime" or name.strip().lower() in _UNIT_WORDS["time"]:
        return "time"
    said = set(words(name))
    first = [role for role in ("reference", "brake") if said & set(_WORDS[role].split())]
    if first:
        return first[0]
    known = unit(stated)
    if known is not None and known.si in _BY_UNIT:
        return _BY_UNIT[known.si]
    if said & _PLAIN_POSITIONS and said & _PRESENT:
        said -= _PRESENT  # the position that is current, and no current
    named = next((role for role, text in _WORDS.items() if said & set(text.split())), "")
    return named or _BY_SUFFIX.get(re.split(r"[_\W]+", name)[-1], "")


def _unit(name: str, stated: str, role: str) -> str:
    """Unit by the file, or by a last word of the name such as ``_us``, before an index if any."""
    if stated:
        return stated
    bare = re.sub(r"(\[\d+\]|_\d+)$", "", name)
    rate = re.search(r"_(rad|deg|rev|mm|cm|m)_(per_)?s$", bare)
    if role == "velocity" and rate is not None:
        return f"{rate[1]}/s"
    parts = re.split(r"[_\W]+", bare)
    suffix = parts[-1] if len(parts) > 1 else ""
    matches = [u for u in _UNIT_WORDS.get(role, ()) if u.lower() == suffix.lower()]
    return matches[0] if matches else ""
