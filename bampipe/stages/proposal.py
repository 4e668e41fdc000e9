"""A session file proposed for a folder of logs: what can be seen is guessed, the rest left open.

Every guess is marked in the text. What no look at the data can tell, such as how many counts make
a radian, is left at a value that the session reader refuses with a line saying what to fill in.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from bampipe.data import guesses
from bampipe.data.session import SECONDS
from bampipe.data.store import read_toml, write_text
from bampipe.data.survey import Column, Survey, survey, words
from bampipe.data.units import spelled, unit
from bampipe.errors import InputError
from bampipe.physics import registry
from bampipe.physics.device import Device
from bampipe.stages.matching import Matcher, is_velocity
from bampipe.stages.starter import starter_device

SESSION, DEVICE = "session.toml", "device.toml"
UNKNOWN = "?"
_POSITION_UNITS = ("rad", "deg", "mrad", "rev", "m", "mm", "cm", "um", "in")
_SPEED_UNITS = ("rad/s", "deg/s", "rev/s", "rev/min", "m/s", "cm/s", "mm/s", "in/s")
_FORCE_UNITS = ("N", "N.m", "mN", "kN", "mN.m", "N.cm", "N.mm", "kN.m", "kgf", "lbf", "V")
_FULL = 1.05
_SLIDING = frozenset(["stroke", "displacement", "disp", "weg", "hub", "carriage", "piston"])


@dataclass
class Proposal:
    """What to write, and what a person has to look at.

    Attributes:
        session: text of ``session.toml``.
        device: text of a device file to write beside it, "" where there is one already.
        fill_in: what only a person can know, a sentence each; the session is refused without.
        check: guesses, a sentence each.
        passed: files left out, with the reason.
    """

    session: str = ""
    device: str = ""
    fill_in: list[str] = field(default_factory=list)
    check: list[str] = field(default_factory=list)
    passed: list[str] = field(default_factory=list)


def propose(folder: Path, device: str = "") -> Proposal:
    """Propose a session file for the logs in ``folder``; writes nothing.

    Args:
        folder: with logs, in it or in folders below.
        device: a built-in device or a device file in the folder; guessed where empty.

    Raises:
        InputError: no logs, a session file is there already, or no such device.
    """
    if (folder / SESSION).exists():
        raise InputError(
            f"there is a {SESSION} already",
            where=str(folder),
            remedy=f"it is left alone; to run it: bampipe run {folder}",
        )
    found = survey(folder)
    return _Writer(folder, found, device).write()


class _Writer:
    """The lines of the session file while they are put together."""

    def __init__(self, folder: Path, found: Survey, device: str) -> None:
        self.folder = folder
        self.found = found
        self.out = Proposal(passed=[f"{name}: {reason}" for name, reason in found.passed])
        self.lines: list[str] = []
        self.match = Matcher(found)
        self.seen: dict[str, Column | None] = {}  # inputs that a new device was made from
        self.name, self.device = self._device(device)

    def write(self) -> Proposal:
        self._head()
        self._time()
        if self.device is None:
            self._new_device()
        assert self.device is not None
        axes = self._encoders(self.device)
        self._inputs(self.device, axes)
        self._unused()
        self._trials(self.device, axes)
        self.out.session = "\n".join(self.lines) + "\n"
        return self.out

    def guess(self, text: str) -> str:
        """A comment that marks a guess; also told at the end."""
        self.out.check += [text] if text not in self.out.check else []
        return f"  # guess: {text}"

    def open(self, text: str) -> str:
        """A comment that marks what a person must fill in; also told at the end."""
        self.out.fill_in.append(text)
        return f"  # fill in: {text}"

    # The device

    def _device(self, wanted: str) -> tuple[str, Device | None]:
        if wanted:
            if not wanted.endswith(".toml"):
                return wanted, registry.device(wanted)
            for path in (self.folder / wanted, Path(wanted)):
                if path.is_file():
                    inside = path.resolve().is_relative_to(self.folder.resolve())
                    if not inside:
                        raise InputError(
                            "the device file is not in the folder of the logs",
                            where=wanted,
                            remedy=f"copy it to {self.folder}",
                        )
                    name = path.resolve().relative_to(self.folder.resolve()).as_posix()
                    return name, registry.device_from(read_toml(path), str(path))
            raise InputError("no such file", where=wanted)
        for path in sorted(self.folder.glob("*.toml")):
            content = read_toml(path)
            if content.get("schema") == "bampipe.device/1":
                return path.name, registry.device_from(content, str(path))
        said = {word for column in self.found.of("position") for word in words(column.name)}
        for name in registry.device_names():
            device = registry.device(name)
            if {c.name for c in device.coordinates} <= said and self._named_inputs(device):
                return name, device
        return "", None

    def _named_inputs(self, device: Device) -> bool:
        """Whether the columns have the names of what drives ``device``."""
        said = [set(words(column.name)) for column in self.found.columns]
        return all(
            any(set(words(name.removeprefix("force_"))) <= column for column in said)
            for name in (*device.forces, *device.channels)
        )

    def _new_device(self) -> None:
        """Propose a device file for one axis, where none is given and none built in fits."""
        position = self._position("", 1)
        if position is None:
            raise InputError(
                "no column looks like a position",
                where=f"{self.folder}: {self.found.files[0]}",
                remedy="name the device: bampipe init FOLDER --device NAME; columns are "
                + ", ".join(c.name for c in self.found.columns[:12]),
            )
        linear = _slides(position, self.found)
        driver, role = self.match.driver(position)
        found = guesses.Driven(0.0)
        if driver is not None:
            si = {"current": "A", "voltage": "V", "duty": ""}.get(role, "N" if linear else "N.m")
            drive = np.nan_to_num(_in_si(driver, si))
            place = _placed(self.match, position, "m" if linear else "rad")
            angle = not linear and not _counts(position)
            found = guesses.driven(self.match.t, place, drive, angle)
        supply = self.match.supply(driver) if role == "duty" else None
        channel = {"current": "motor_current", "voltage": "motor_voltage"}.get(role, role)
        self.seen = {"supply": supply, "force_drive" if role == "force" else channel: driver}
        text, name, own = starter_device(
            position.name, linear, role, driver.name if driver else "", self._coil(role), found,
            supply is not None,
        )  # fmt: skip
        self.out.device = text
        self.name = DEVICE
        self.device = registry.device_from(tomllib.loads(text), DEVICE)
        kind = "linear" if linear else "rotary"
        self.out.check.append(
            f"{DEVICE}: one {kind} axis '{name}' driven by a {role}; put in what you know of it"
        )
        for constant in own:
            self.out.check.append(
                f"{DEVICE}: {constant} is not yours yet: all forces and inertias scale with it"
            )
        if any(found.gravity):
            self.out.check.append(f"{DEVICE}: gravity on '{name}', since the motion shows it")

    def _coil(self, role: str) -> bool:
        """Whether a current is recorded beside a force: that of a coil or a brake."""
        return role == "force" and any(not c.constant for c in self.found.of("current"))

    def _position(self, axis: str, axes: int) -> Column | None:
        column, others = self.match.position(axis, axes)
        if column is not None and others:
            self.guess(f"of {', '.join(others)}, {column.name} is the measured position")
        return column

    # The tables

    def _head(self) -> None:
        sanitised = re.sub(r"[^A-Za-z0-9._-]", "_", self.folder.resolve().name).lstrip("._-")
        self.lines += [
            "# Proposed by `bampipe init`. Look at every line marked `guess` or `fill in`.",
            'schema = "bampipe.session/1"',
            f'session_id = "{sanitised or "session"}"',
            "",  # device, then rate: known once the tables below are
            "",
            "",
        ]

    def _time(self) -> None:
        times = self.found.of("time")
        self.lines.append("[time]")
        if self._stamps(times):
            return
        first = next((c for c in times if _increases(c.values)), None)
        given = [(c.name, float(c.values[0])) for c in self.found.columns if c.constant]
        steps = [(guesses.interval_of(name, value), name) for name, value in given]
        step, name = max(steps, default=(0.0, ""))
        if first is None and step > 0.0:
            self.match.t = step * np.arange(len(self.found.columns[0].values))
            self.match.used.add(name)
            self.lines.append('unit = "samples"' + self.guess(f"counted; {name} sets the rate"))
            self.lines[4] = f"sample_rate_hz = {1.0 / step:g}"
            self.lines.append("")
            return
        if first is None:
            self.match.t = np.arange(len(self.found.columns[0].values)) / 100.0
            self.lines.append('unit = "samples"' + self.guess("no column increases like a time"))
            self.lines[4] = "sample_rate_hz = 100.0" + self.open("sample_rate_hz, the true rate")
            self.lines.append("")
            return
        self.match.used.add(first.name)
        kind = guesses.time_unit(first.values, first.unit)
        seconds = SECONDS.get(kind, 1.0)
        self.match.t = (first.values - first.values[0]) * seconds
        rate = guesses.sample_rate(self.match.t) if kind else 100.0
        said = kind == "datetime" or spelled(first.unit, tuple(SECONDS)) == kind
        note = "" if said else self.guess(f"time in {kind or 's'}, by the rate that it gives")
        self.lines += [f"column = {_quoted(first.name)}", f'unit = "{kind or "s"}"{note}', ""]
        if not kind:
            self.open("the unit of time: no unit gives a likely rate")
        self.lines[4] = f"sample_rate_hz = {rate:g}" + self.guess(
            f"{rate:g} Hz, from the time stamps"
        )

    def _stamps(self, times: list[Column]) -> bool:
        """Propose whole seconds and nanoseconds in two columns, as ROS has them, if there are."""
        parts = {part: c for c in times for part in ("sec", "nanosec") if _part_of(c, part)}
        if set(parts) != {"sec", "nanosec"}:
            return False
        whole, more = parts["sec"], parts["nanosec"]
        self.match.used |= {whole.name, more.name}
        self.match.t = whole.values - whole.values[0] + 1e-9 * more.values
        rate = guesses.sample_rate(self.match.t)
        note = self.guess(f"seconds in {whole.name}, nanoseconds on top in {more.name}")
        self.lines += [
            f"column = {_quoted(whole.name)}", 'unit = "s"',
            f"nanoseconds = {_quoted(more.name)}{note}", "",
        ]  # fmt: skip
        self.lines[4] = f"sample_rate_hz = {rate:g}" + self.guess(
            f"{rate:g} Hz, from the time stamps"
        )
        return True

    def _encoders(self, device: Device) -> dict[str, Column]:
        self.lines[3] = f'device = "{self.name}"'
        self.lines.append("[encoders]")
        axes: dict[str, Column] = {}
        for c in device.coordinates:
            column = self._position(c.name, len(device.coordinates))
            if column is None:
                self.lines.append(
                    f'{c.name} = {{ column = "{UNKNOWN}", unit = "{c.unit}" }}'
                    + self.open(f"the column of the position of {c.name}")
                )
                continue
            axes[c.name] = column
            self.match.used.add(column.name)
            self.lines.append(self._encoder(c.name, column, c.unit))
        self.lines.append("")
        return axes

    def _encoder(self, axis: str, column: Column, si: str) -> str:
        name = _quoted(column.name)
        known = unit(column.unit)
        if is_velocity(column):
            fits = known is not None and known.si == f"{si}/s"
            said = spelled(column.unit, _SPEED_UNITS) if fits else ""
            text = f'{axis} = {{ column = {name}, unit = "{said or f"{si}/s"}" }}'
            return text + self.guess(
                f"no position was recorded: that of {axis} is the integral of {column.name}"
            )
        if _counts(column):
            middle = float(np.median(column.values))
            counts = f"counts_per_unit = 0.0, zero_counts = {middle:.0f}"
            return f'{axis} = {{ column = {name}, {counts}, unit = "{si}" }}' + self.open(
                f"counts_per_unit of {axis}, the counts in one {si}; zero_counts is a guess"
            )
        speed = self._velocity_of(column)
        more = f", velocity = {speed}" if speed else ""
        if known is not None and known.si == si:
            said = spelled(column.unit, _POSITION_UNITS) or si
            text = f'{axis} = {{ column = {name}, unit = "{said}"{more} }}'
            return text + ("" if column.stated else self.guess(f"{column.name} in {column.unit}"))
        likely = guesses.likely_unit(si, column.values) or si
        text = f'{axis} = {{ column = {name}, unit = "{likely}"{more} }}'
        size = ", by its size" if likely != si else ""
        return text + self.guess(f"{column.name} is the position of {axis}, in {likely}{size}")

    def _velocity_of(self, position: Column) -> str:
        for column in self.found.of("velocity"):
            if unit(column.unit) is None or column.constant or not column.unit:
                continue
            self.match.used.add(column.name)
            self.out.check.append(f"{column.name} is used to check the position only")
            return f'{{ column = {_quoted(column.name)}, unit = "{column.unit.strip("[]()")}" }}'
        return ""

    def _inputs(self, device: Device, axes: dict[str, Column]) -> None:
        wanted = {**dict.fromkeys(device.forces, device.force_unit), **device.channels}
        given = self.match.inputs(wanted, tuple(axes.values()))
        given |= {n: (c, "") for n, c in self.seen.items() if n in wanted and c is not None}
        columns = [given[name][0] for name in device.forces]
        sensed = all(name.startswith("force_") for name in device.forces)
        if sensed and columns and all(column is not None for column in columns):
            why = given[device.forces[0]][1]
            self._force_table(device, [c for c in columns if c is not None], why)
            wanted = dict(device.channels)
        brakes = {axis: self.match.named(name, "brake") for axis, name in device.brakes.items()}
        self._brake_table(device, {a: c for a, c in brakes.items() if c is not None})
        if not wanted:
            return
        self.lines.append("[channels]")
        for name, si in wanted.items():
            column, why = given[name]
            if column is None:
                self.lines.append(
                    f'{name} = {{ column = "{UNKNOWN}", unit = "{si}" }}'
                    + self.open(f"the column of {name}{f' in {si}' if si else ''}")
                )
                continue
            self.match.used.add(column.name)
            known = unit(column.unit)
            fits = known is not None and known.si == si and bool(column.unit)
            bits = guesses.signed_register(column.values)
            more = f", wrap_bits = {bits}, signed = true" if bits else ""
            text = f'{name} = {{ column = {_quoted(column.name)}, unit = "'
            likely = guesses.likely_unit(si, column.values) or si
            most = float(np.nanmax(np.abs(column.values)))
            if name == "duty" and not column.unit and most > _FULL:
                likely = "%" if most <= 100.0 else ""
                more += "" if likely or bits else ", scale = 0.0"
            text += f'{column.unit.strip("[]()") if fits else likely}"{more} }}'
            if not (fits and column.stated) or why or bits:
                where = f" in {likely}" if si and not fits else ""
                counts = column.whole and not column.unit and bool(si)
                scale = "; if in counts, give their scale too" if counts else ""
                if more.endswith("scale = 0.0"):
                    self.lines.append(text + self.open(f"the scale of {name}, 1 over full duty"))
                    continue
                scale = (
                    scale
                    if not bits
                    else f", a signed register of {bits} bits: give its scale"
                    if bits
                    else ""
                )
                text += self.guess(f"{column.name} is {name}{where}{why}{scale}")
            self.lines.append(text)
        self.lines.append("")

    def _force_table(self, device: Device, columns: list[Column], why: str) -> None:
        names = ", ".join(_quoted(c.name) for c in columns)
        self.match.used |= {c.name for c in columns}
        components = ", ".join(f'"{name}"' for name in device.components)
        self.lines += ["[force]", f"columns = [{names}]", f"components = [{components}]"]
        stated = {spelled(c.unit.strip("[]()"), _FORCE_UNITS) for c in columns}
        known = unit(next(iter(stated))) if len(stated) == 1 else None
        if known is not None and known.si == device.force_unit:
            note = "" if all(c.stated for c in columns) else self.guess(f"force in {known.si}")
            self.lines.append(f'unit = "{next(iter(stated))}"{note}')
        elif stated == {"V"}:
            row = "[" + ", ".join(["0.0"] * len(columns)) + "]"
            self.lines += [
                'unit = "V"' + self.guess("the force channels are volts, by their names"),
                f"calibration_n_per_v = [{', '.join([row] * len(columns))}]"
                + self.open("calibration_n_per_v, N for one volt"),
                f"zero_v = {row}" + self.open("zero_v, the volts without force"),
            ]
        else:
            self.lines.append(
                f'unit = "{device.force_unit}"'
                + self.guess(f"{names} is a force in {device.force_unit}{why}; volts need a gain")
            )
        self.lines.append("")

    def _brake_table(self, device: Device, brakes: dict[str, Column]) -> None:
        if not brakes:
            return
        self.match.used |= {column.name for column in brakes.values()}
        units = ", ".join(device.coordinate(axis).torque_unit for axis in brakes)
        self.lines += [
            "[brakes]",
            f"columns = [{', '.join(_quoted(c.name) for c in brakes.values())}]",
            f'unit = "{units}"' + self.guess("brake commands are in SI units"),
            "",
        ]

    def _unused(self) -> None:
        left = [column.name for column in self.found.columns if column.name not in self.match.used]
        if left:
            self.lines += [f"# not used: {', '.join(left)}", ""]

    def _trials(self, device: Device, axes: dict[str, Column]) -> None:
        files = self.found.files
        cuts: list[float] = []
        if len(files) == 1 and axes:
            cuts = guesses.stretches(self.match.t, next(iter(axes.values())).values)
        if cuts:
            note = "one record, cut at rests, so that each part can be held out"
            self.lines.append(f"# guess: {note}")
            self.out.check.append(note)
        bounds = [None, *cuts, None] if cuts else [None, None]
        for file in files:
            for start, end in pairwise(bounds):
                self.lines += ["[[trials]]", f"file = {_quoted(file)}"]
                self._kind(file, device)
                self.lines += [f"start_s = {start}"] if start is not None else []
                self.lines += [f"end_s = {end}"] if end is not None else []
                self.lines.append("")

    def _kind(self, file: str, device: Device) -> None:
        said = set(words(Path(file).stem))
        axis = next((c.name for c in device.coordinates if c.name in said), "")
        if "locked" in said and axis:
            note = self.guess(f"{file} is a locked trial, by its name")
            self.lines += [f'kind = "locked"{note}', f'locked_axis = "{axis}"']
        elif "viscous" in said:
            self.lines += [
                'kind = "viscous"' + self.guess(f"{file} is a viscous trial, by its name"),
                "viscous_n_s_per_m = 0.0" + self.open("viscous_n_s_per_m, the commanded damping"),
            ]
        else:
            self.lines.append('kind = "free"')


def _counts(column: Column) -> bool:
    """Whether a position is in whole counts of no known unit."""
    return column.whole and bool(np.ptp(column.values) > 100) and unit(column.unit or "?") is None


def _part_of(column: Column, part: str) -> bool:
    """Whether a column holds the whole seconds, or the nanoseconds on top, of time stamps."""
    said = set(words(column.name))
    if not column.whole:
        return False
    if part == "nanosec":
        named = bool(said & {"nanosec", "nsec", "nsecs", "nanosecs", "nanoseconds"})
        return named and bool(np.all((column.values >= 0) & (column.values < 1e9)))
    return bool(said & {"sec", "secs", "seconds"}) and bool(np.all(np.diff(column.values) >= 0))


def _placed(match: Matcher, column: Column, si: str) -> np.ndarray:
    """Position in SI, unwrapped where it is an angle that wraps at a full turn."""
    known = unit(column.unit) if column.unit else None
    if is_velocity(column):
        return match.moved(column) * (known.scale if known is not None else 1.0)
    values = match.moved(column) * _scale(column, si)
    return np.unwrap(values) if si == "rad" and not _counts(column) else values


def _in_si(column: Column, si: str) -> np.ndarray:
    """Values of a column in ``si``, by its unit or by the likely one."""
    return column.values * _scale(column, si)


def _scale(column: Column, si: str) -> float:
    known = unit(column.unit) if column.unit else None
    if known is None or known.si != si:
        known = unit(guesses.likely_unit(si, column.values) or si)
    return known.scale if known is not None else 1.0


def _slides(column: Column, found: Survey) -> bool:
    """Whether an axis slides rather than turns: by its unit, its name, or a force in newtons."""
    known = unit(column.unit) if column.unit else None
    if known is not None and known.si:
        return known.si in ("m", "m/s")
    if set(words(column.name)) & _SLIDING:
        return True
    forces = [unit(c.unit) for c in found.of("force") if c.unit]
    return any(force is not None and force.si == "N" for force in forces)


def _increases(values: np.ndarray) -> bool:
    known = values[np.isfinite(values)]
    return len(known) > 3 and float(np.mean(np.diff(known) > 0)) > 0.9


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\t", "\\t")
    return f'"{escaped}"'


def write_proposal(folder: Path, proposal: Proposal) -> list[Path]:
    """Write what was proposed; returns the files written.

    Raises:
        InputError: one of them is there already, or the folder cannot be written.
    """
    texts = {folder / SESSION: proposal.session}
    if proposal.device:
        texts[folder / DEVICE] = proposal.device
    for path in texts:
        if path.exists():
            raise InputError(
                "is there already and is left alone", where=str(path), remedy="move it away"
            )
    for path, text in texts.items():
        write_text(path, text)
    return list(texts)
