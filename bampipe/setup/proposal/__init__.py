"""A session file proposed for a folder of logs: what can be seen is guessed, the rest left open.

Every guess is marked in the text. What no look at the data can tell, such as how many counts make
a radian, is left at a value that the session reader refuses with a line saying what to fill in.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from bampipe.data import guesses
from bampipe.data.names import DRIVERS, words
from bampipe.data.readers import lerobot
from bampipe.data.refusals import refusal
from bampipe.data.survey import Survey, SurveyedColumn, survey
from bampipe.files import write_text
from bampipe.lists import join_names
from bampipe.physics.device import Device
from bampipe.physics.robot import Robot
from bampipe.setup.drawn_bodies import STATED
from bampipe.setup.mounting import Mounting
from bampipe.setup.proposal import device as devices
from bampipe.setup.proposal.device import DEVICE, UNKNOWN_CONSTANT, ChosenDevice, with_motors
from bampipe.setup.proposal.matching import Matcher
from bampipe.setup.proposal.notes import UNKNOWN, Notes, quoted
from bampipe.setup.proposal.positions import fresh_readings, signed_readings
from bampipe.setup.proposal.robot import RobotColumns, find_robot_columns
from bampipe.setup.proposal.tables import clock_of, encoders_table, input_tables
from bampipe.setup.sentences import sentence

SESSION = "session.toml"
_TRIALS = frozenset({"trial", "run", "condition", "test", "block", "versuch"})
"""Words in the name of a column that numbers trials."""
_LEAP_S, _SHORTEST_S, _MOST_CUTS = 1.0, 2.0, 200
"""Shortest pause between two trials and shortest trial, s; most cuts."""
_GUESSED_GEAR = ", scale_sd = 0.1"
"""Of a reduction that weight shows beside bodies that are drawn to 15 %."""


@dataclass(frozen=True)
class ProposedSession:
    """What to write, and what a person has to look at.

    Attributes:
        session: text of ``session.toml``.
        device: text of a device file to write beside it, "" if there is one already.
        fill_in: what only a person can know, a sentence each; the session is refused without.
        check: guesses, a sentence each.
        passed: files left out, with the reason.
    """

    session: str
    device: str
    fill_in: list[str]
    check: list[str]
    passed: list[str]


def propose(
    folder: Path, device: str = "", names: Sequence[str] = (), episodes: str = ""
) -> ProposedSession:
    """Propose a session file for the logs in ``folder``; writes nothing.

    Args:
        folder: with logs, in it or in folders below.
        device: a built-in device or a device file in the folder; guessed where empty.
        names: of the columns, where the logs are texts without a header.
        episodes: those that are wanted of a data set of LeRobot, as 0:20.

    Raises:
        InputError: no logs, a session file is there already, or no such device.
    """
    if (folder / SESSION).exists():
        raise refusal("there_already", str(folder), name=SESSION, folder=folder)
    found = survey(folder, names, episodes)
    if not device and not found.of(*DRIVERS):
        _refuse_goals(folder, found)
    notes = Notes(check=list(found.remarks))
    found, registers = signed_readings(fresh_readings(found, notes), notes)
    chosen = devices.find_device(folder, found, device)
    clock = clock_of(found, notes)
    match = Matcher(found, clock.t, set(clock.columns), registers, notes)
    if chosen is None:
        chosen = devices.new_device(folder, match)
    elif (robot := chosen.device.robot) is not None:
        timed = UNKNOWN not in clock.rate
        columns = find_robot_columns(folder, chosen.device, robot, found, clock.t, timed, notes)
        match.robot, match.given = columns, columns.columns
        chosen = _with_guessed_motors(folder, chosen, match)
        if columns.mounting is not None and columns.mounting.hangs:
            chosen = _hang(folder, chosen, columns.mounting, notes)
        chosen = _check_robot(chosen, robot, columns, notes)
    match.axes = len(chosen.device.coordinates)
    encoders, axes = encoders_table(chosen.device, match)
    inputs = input_tables(chosen.device, axes, match)
    if len(match.rivals) > 1 and match.axes == 1:
        measured = join_names(column.name for column in axes.values())
        several = join_names(match.rivals, 6)
        notes.check.append(sentence("rivals", several=several, measured=measured))
    left = [column.name for column in found.columns if column.name not in match.used]
    beside = [c.name for c in found.of("force") if c.name in left and not c.is_constant]
    if beside and match.axes == 1 and len(match.rivals) < 2:
        notes.check.append(sentence("may_act", names=join_names(beside, 4)))
    passed: dict[str, list[str]] = {}
    for name, reason in found.passed:
        passed.setdefault(reason.removeprefix(name).lstrip(":, "), []).append(name)
    identifier = re.sub(r"[^A-Za-z0-9._-]", "_", folder.resolve().name).lstrip("._-")
    lines = [
        sentence("head", id=identifier or "session", device=quoted(chosen.name), rate=clock.rate),
        *(["[csv]", f"names = [{', '.join(map(quoted, names))}]", ""] if names else []),
        *("[time]", *clock.lines, ""),
        *encoders,
        *inputs,
        *([f"# not used: {', '.join(left)}", ""] if left else []),
        *_trials_tables(chosen.device, axes, match, UNKNOWN not in clock.rate),
    ]
    return ProposedSession(
        session="\n".join(lines) + "\n",
        device=chosen.text,
        fill_in=notes.questions,
        check=notes.check,
        passed=[f"{join_names(own, 4)}: {reason}" for reason, own in passed.items()],
    )


def _refuse_goals(folder: Path, found: Survey) -> None:
    """Refuse a data set of LeRobot in which goals are all that is known of the drives."""
    columns = {column.name: column.values for column in found.columns}
    if not any(name.startswith(lerobot.STATE) for name in columns):
        return
    times = found.of("time")
    loops = lerobot.describe_loops(times[0].values, columns) if times else ""
    known = sentence("loops", loops=loops) if loops else ""
    raise refusal("goals_alone", str(folder), known=known)


def _with_guessed_motors(folder: Path, chosen: ChosenDevice, match: Matcher) -> ChosenDevice:
    """A new device file with the torque constants or reductions that the drawing suggests."""
    columns, scale_sd, robot = match.robot, match.scale_sd, chosen.device.robot
    assert robot is not None
    sizes = [abs(drive.share) for drive in columns.drives.values()]
    if not robot.motors:
        scale_sd |= dict.fromkeys(columns.gears, _GUESSED_GEAR)
    sure = [drive.is_sure for drive in columns.drives.values()]
    # The motors behind gears are alike: those of upright axes, too, whose drives tell little.
    if not chosen.text or not any(sure) or not (all(sure) or columns.gears):
        return chosen
    joints = [c.name for c in chosen.device.coordinates]
    turns = [columns.gears.get(joint, 1.0) for joint in joints]
    of_motor = [size * ratio for size, ratio in zip(sizes, turns, strict=True)]
    if chosen.device.force_unit == "A":
        if not all(sure):
            return chosen
        found = zip(joints, turns, of_motor, strict=True)
        guessed = {j: (n, 1.0 / size) for j, n, size in found}
        # On the joint that carries most, errors of single bodies count least.
        size = {
            name: float(np.nanstd(columns.columns[name].values) / abs(drive.share))
            for name, drive in columns.drives.items()
        }
        reference = max(size, key=lambda name: size[name])
        scale_sd[reference] = f", scale_sd = {robot.uncertainty}"
        return with_motors(folder, chosen, guessed, reference.removeprefix("current_"))
    known = [size for size, is_sure in zip(of_motor, sure, strict=True) if is_sure]
    if columns.gears and all(STATED[0] < size < STATED[1] for size in known):
        scale_sd |= dict.fromkeys(columns.drives, _GUESSED_GEAR)
        return with_motors(folder, chosen, {j: (columns.gears.get(j, 1.0), None) for j in joints})
    if not columns.gears and all(size < STATED[0] for size in sizes):
        gears = {j: (1.0 / size, None) for j, size in zip(joints, sizes, strict=True)}
        scale_sd |= dict.fromkeys(columns.drives, f", scale_sd = {robot.uncertainty}")
        return with_motors(folder, chosen, gears)
    return chosen


def _hang(folder: Path, chosen: ChosenDevice, mounting: Mounting, notes: Notes) -> ChosenDevice:
    """The robot under the gravity that the drawn bodies ask for in place of the stated one."""
    gravity = np.where(np.abs(mounting.gravity) < 1e-9, 0.0, mounting.gravity)
    said = f"gravity = [{', '.join(f'{v:.4g}' for v in gravity)}]"
    put = "" if chosen.text else f" put that into [robot] of {chosen.name}"
    notes.check.append(sentence("gravity", said=said, put=put))
    return devices.with_gravity(folder, chosen, said) if chosen.text else chosen


def _check_robot(
    chosen: ChosenDevice, robot: Robot, columns: RobotColumns, notes: Notes
) -> ChosenDevice:
    """The robot without torque constants that nothing tells; what else to look at is noted."""
    if "tip =" in chosen.text:
        notes.check.append(f"{chosen.name}: the robot ends at {robot.tip}; is that its last link?")
    if not columns.drives:
        joints = ", ".join(j.name for j in robot.joints)
        notes.check.append(sentence("at_joints", joints=joints))
    notes.check += [sentence("no_body", line=line) for line in robot.impossible]
    if robot.undrawn:
        notes.check.append(sentence("no_mass", links=join_names(robot.undrawn)))
    if UNKNOWN_CONSTANT not in chosen.text:
        return chosen
    note = notes.ask("torque_constants", device=chosen.name)
    return replace(chosen, text=chosen.text.replace(UNKNOWN_CONSTANT, f'= "{UNKNOWN}"{note}'))


def _trials_tables(
    device: Device, axes: Mapping[str, SurveyedColumn], match: Matcher, timed: bool
) -> Iterator[str]:
    """Propose the trials and their kinds; a long single record is cut at rests of its axis.

    Not where its rate is not known: then nobody can say after how many seconds.
    """
    trials = match.found.trials
    alone = len(trials) == 1 and timed
    cuts, where = _cuts(match) if alone else ([], "")
    if alone and axes and not cuts:
        cuts, where = guesses.stretches(match.t, next(iter(axes.values())).values), "at rests"
    if cuts:
        note = match.notes.guess(f"one record, cut {where}, so that each part can be held out")
        yield note.strip()
    for trial in trials:
        for start_s, end_s in pairwise([None, *cuts, None]):
            yield from ("[[trials]]", f"file = {quoted(trial.file)}")
            yield from _trial_kind(trial.file, device, match.notes)
            stretch = {"recording": trial.recording, "start_s": start_s, "end_s": end_s}
            yield from (f"{key} = {value}" for key, value in stretch.items() if value is not None)
            yield from [f"part = {quoted(trial.part)}"] if trial.part else []
            for key, of in (("columns", trial.columns), ("units", trial.units)):
                pairs = ", ".join(f"{quoted(c)} = {quoted(of[c])}" for c in of if c in match.used)
                yield from [f"{key} = {{ {pairs} }}"] if pairs else []
            for part in trial.parts:
                if not any(name.startswith(f"{part.name}:") for name in match.used):
                    continue
                yield from ("", "[[trials.parts]]")
                given = ("file", "name", "join", "time", "time_unit")
                told = {key: getattr(part, key) for key in given}
                yield from (f"{key} = {quoted(value)}" for key, value in told.items() if value)
            yield ""


def _cuts(match: Matcher) -> tuple[list[float], str]:
    """Times, s, at which one record goes on with another trial, and how that shows."""
    t = match.t - match.t[0]
    steps = np.diff(t)
    ends = {"where time leaps": np.flatnonzero(steps > max(_LEAP_S, 20.0 * np.median(steps)))}
    for column in match.found.columns:
        if column.is_integer and not column.role and _TRIALS & set(words(column.name)):
            match.used.add(column.name)
            ends[f"where {column.name} changes"] = np.flatnonzero(np.diff(column.values))
    for where, found in reversed(ends.items()):
        pieces = np.diff([0.0, *t[found], t[-1]])
        if 0 < len(found) <= _MOST_CUTS and pieces.min() > _SHORTEST_S:
            return [round(float(0.5 * (t[k] + t[k + 1])), 5) for k in found], where
    return [], ""


def _trial_kind(file: str, device: Device, notes: Notes) -> list[str]:
    said = set(words(Path(file).stem))
    axis = next((c.name for c in device.coordinates if c.name in said), "")
    if "locked" in said and axis:
        note = notes.guess(f"{file} is a locked trial, by its name")
        return [f'kind = "locked"{note}', f'locked_axis = "{axis}"']
    if "viscous" in said:
        return [
            'kind = "viscous"' + notes.guess(f"{file} is a viscous trial, by its name"),
            "viscous_n_s_per_m = 0.0" + notes.ask("viscous"),
        ]
    return ['kind = "free"']


def write_proposal(folder: Path, proposal: ProposedSession) -> list[Path]:
    """Write what was proposed; returns the files written.

    Raises:
        InputError: one of them is there already, or the folder cannot be written.
    """
    texts = {folder / SESSION: proposal.session}
    if proposal.device:
        texts[folder / DEVICE] = proposal.device
    for path in texts:
        if path.exists():
            raise refusal("left_alone", str(path))
    for path, text in texts.items():
        write_text(path, text)
    return list(texts)
