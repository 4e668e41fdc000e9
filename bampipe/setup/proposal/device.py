"""The device of a session: one named or in the folder, a built-in one that fits, or a new one."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bampipe.data import guesses
from bampipe.data.chain import Branches
from bampipe.data.device_file import complete_device, read_device_file
from bampipe.data.names import REFERENCE_WORDS, words
from bampipe.data.readers import is_text
from bampipe.data.refusals import refusal
from bampipe.data.survey import Survey, SurveyedColumn
from bampipe.data.units import unit
from bampipe.data.urdf import unexpanded
from bampipe.errors import InputError
from bampipe.estimate.white_noise import counting_step, white_noise_sd
from bampipe.files import read_toml
from bampipe.lists import join_names
from bampipe.physics import registry
from bampipe.physics.device import KINDS, Device
from bampipe.setup.hypotheses import MOST_TRAVEL
from bampipe.setup.proposal import positions
from bampipe.setup.proposal.joints import chain_logged
from bampipe.setup.proposal.matching import Matcher
from bampipe.setup.proposal.positions import SLIDING, in_counts, is_velocity, needs_gain
from bampipe.setup.proposal.starter import Drive, stage_device, starter_device, weight_of
from bampipe.setup.sentences import sentence

DEVICE = "device.toml"
_SCHEMA = "bampipe.device/1"
UNKNOWN_CONSTANT = "= 1  # guess: N.m/A, gears included"
"""Stands for the torque constant of a motor until a drawing or a person tells."""
_MAY_SLIDE = " (no unit says that it slides: if it does, bampipe init FOLDER --device slider)"
_MAY_TURN = " (by its name or a force in N: if it turns, call its column {0}_rad or {0}_deg)"
_HEAD_BYTES = 1 << 16
"""Of an XML file, in which its first element is looked for."""
_NEAR = 0.05
"""Share by which what a radian reads by the weight may differ from that of its unit."""
_SAME_DRIVE = 0.8
"""Correlation beyond which a current and a force are of one drive: that of a coil has its own."""

_Motors = Mapping[str, tuple[float, float | None]]


@dataclass(frozen=True)
class ChosenDevice:
    """The device, and how the session file calls it.

    Attributes:
        name: of a built-in device, or the path of a device file relative to the folder of logs.
        text: of a new device file, "" if there is one already.
    """

    name: str
    device: Device
    text: str = ""


def find_device(folder: Path, found: Survey, wanted: str) -> ChosenDevice | None:
    """The device ``wanted``; where that is empty, the one in the folder or that the logs are of.

    Raises:
        InputError: no such device, a device file outside the folder, or one that is wrong.
    """
    if wanted.endswith(".toml"):
        return _device_file(folder, wanted)
    if wanted:
        return ChosenDevice(wanted, registry.device(wanted))
    for path in sorted(folder.glob("*.toml")):
        content = read_toml(path)
        # That of a robot may be three lines without a schema.
        schema = content.get("schema", _SCHEMA if "robot" in content else "")
        if schema == _SCHEMA:
            return ChosenDevice(path.name, registry.device_from(read_device_file(path), str(path)))
    return _robot(folder, found) or _built_in(found)


def _is_mjcf(path: Path) -> bool:
    """Whether an XML file is one of MuJoCo, sound or not."""
    try:
        with path.open("rb") as file:
            return b"<mujoco" in file.read(_HEAD_BYTES)
    except OSError:
        return False


def _robot(folder: Path, found: Survey) -> ChosenDevice | None:
    """The robot of the URDF or MJCF in the folder, its drives logged as torque or as current.

    Where joints branch, as fingers do, it ends with the last one that has a column, else before
    them. InputError where the file cannot be used, is a xacro file, or there are several.
    """
    urdfs = sorted(folder.glob("*.urdf")) or [*filter(_is_mjcf, sorted(folder.glob("*.xml")))]
    if not urdfs:
        macros = next(iter(sorted(folder.glob("*.xacro"))), None)
        if macros is not None:
            raise unexpanded(macros)
        return None
    if len(urdfs) > 1:
        names = ", ".join(path.name for path in urdfs)
        raise refusal("several_robots", str(folder), count=len(urdfs), names=names)
    text = f'schema = "{_SCHEMA}"\nname = "{urdfs[0].stem}"\n\n[robot]\nurdf = "{urdfs[0].name}"\n'
    try:
        device = _complete(folder, text)
    except Branches as error:
        logged = chain_logged(error.chains, found)
        if not (logged or error.stem):
            remedy = sentence("choose_tip", device=DEVICE, urdf=urdfs[0].name)
            raise InputError(error.what, where=error.where, remedy=remedy) from error
        why = "the last joint with a column" if logged else "the joints branch behind it"
        text += f'tip = "{logged or error.stem}"  # guess: {why}\n'
        device = _complete(folder, text)
    chosen = ChosenDevice(DEVICE, device, text)
    if any(not c.is_constant for c in found.of("force")) or not found.of("current"):
        return chosen
    return with_motors(folder, chosen, {c.name: (1.0, 1.0) for c in chosen.device.coordinates})


def with_motors(
    folder: Path, chosen: ChosenDevice, motors: _Motors, reference: str = ""
) -> ChosenDevice:
    """A new device file of a robot with a table for each motor.

    Args:
        motors: by joint, turns for one of the joint and, where currents are logged, N.m/A.
        reference: of constants that the drawing suggests, the joint whose constant the others are
            estimated by.
    """
    robot = chosen.device.robot
    uncertainty = robot.uncertainty if robot is not None else 0.0
    text = chosen.text.partition("\n[robot.motors")[0]
    for joint, (turns, constant) in motors.items():
        text += f"\n[robot.motors.{joint}]\nturns = {{ {joint} = {turns:.4g} }}"
        text += "" if turns == 1.0 else "  # guess: by the drawn bodies; put in that of the gear"
        if constant is not None:
            gears = ", gears included" if turns == 1.0 else ""
            text += f"\ntorque_constant = {constant:.3g}  # guess: N.m/A{gears}"
            if reference and joint != reference:
                text += f"\ntorque_constant_sd = {uncertainty * constant:.2g}"
                text += "  # estimated; leave out with that of the data sheet"
        text += "\n"
    return replace(chosen, text=text, device=_complete(folder, text))


def with_gravity(folder: Path, chosen: ChosenDevice, said: str) -> ChosenDevice:
    """A new device file of a robot with a line on gravity."""
    head, motors, rest = chosen.text.partition("\n[robot.motors")
    text = f"{head}{said}  # guess: by the drawn bodies\n{motors}{rest}"
    return replace(chosen, text=text, device=_complete(folder, text))


def _complete(folder: Path, text: str) -> Device:
    return registry.device_from(complete_device(tomllib.loads(text), folder, DEVICE), DEVICE)


def _device_file(folder: Path, wanted: str) -> ChosenDevice:
    path = folder / wanted if (folder / wanted).is_file() else Path(wanted)
    device = registry.device_from(read_device_file(path), str(path))
    full, root = path.resolve(), folder.resolve()
    if not full.is_relative_to(root):
        raise refusal("device_elsewhere", wanted, folder=folder)
    return ChosenDevice(full.relative_to(root).as_posix(), device)


def _built_in(found: Survey) -> ChosenDevice | None:
    """The first built-in device of which the columns have all names."""
    positions = {word for column in found.of("position") for word in words(column.name)}
    columns = [set(words(column.name)) for column in found.columns]
    for name in registry.device_names():
        device = registry.device(name)
        names = (*device.forces, *device.channels)
        inputs = [set(words(name.removeprefix("force_"))) for name in names]
        named = all(any(said <= column for column in columns) for said in inputs)
        if named and {c.name for c in device.coordinates} <= positions:
            return ChosenDevice(name, device)
    return None


def new_device(folder: Path, match: Matcher) -> ChosenDevice:
    """Propose a device file for one axis, with priors by a rough fit to the first log.

    Raises:
        InputError: no column looks like a position.
    """
    found, notes = match.found, match.notes
    position = match.position("")
    if position is None:
        file, columns = found.trials[0].file, ", ".join(c.name for c in found.columns[:12])
        name = "no_position" if is_text(file) else "no_position_named"
        raise refusal(name, f"{folder}: {file}", columns=columns)
    linear = positions.slides(position, found)
    driver, role = match.driver(position)
    stage = match.stage(position, driver) if driver is not None and linear else {}
    if len(stage) > 1 and role != "duty":
        return _stage(stage, role, match)
    supply = match.supply(driver) if role == "duty" else None
    coil = role == "force" and _has_coil(driver, match)
    read, position = (position, position) if linear else _at_joint(position, driver, match)
    fit = _rough_fit(position, driver, role, linear, match.t)
    if driver is not None and fit.feeds:
        # A sensor at the foot of a motor shows what the axis does to that.
        match.reacting = driver.name
        turned = replace(driver, values=-driver.values)
        fit = _rough_fit(position, turned, role, linear, match.t)
        notes.check.append(sentence("reaction", column=driver.name))
    name = driver.name if driver is not None else ""
    drive = Drive(role, name, supply is not None, coil, register=name in match.registers)
    if driver is not None:
        levered = not linear and (positions.is_force(driver) or "motor" in words(driver.name))
        asked = driver.si == "V" or needs_gain(driver) or driver.is_foreign or driver.by_looks
        drive = replace(drive, scaled=role == "force" and not (asked or levered))
    width = 0.0 if in_counts(position) else _sign_width(position, match.t, linear)
    springs = fit.pose is not None and fit.pose.reading == "spring"
    match.geared = position.name if springs and _may_be_geared(position) else ""
    weight, on_gravity = weight_of(position, fit, linear, found, bool(match.geared))
    name = position.name.removesuffix(f" [{read.stated}]")
    text = starter_device(f"{name} {position.quantity}", linear, drive, fit, weight, width)
    device = registry.device_from(tomllib.loads(text), DEVICE)
    axis = device.coordinates[0].name
    known = {axis: read, "supply": supply, device.forces[0]: driver}
    match.given = {name: column for name, column in known.items() if column is not None}
    on_motor = positions.is_of_motor(position) and not match.turning and not match.geared
    if role == "force" and driver is not None and not linear and "motor" in words(driver.name):
        match.of_motor = "" if on_motor else driver.name
    kind = "linear" if linear else "rotary"
    doubt = "" if position.si is not None else _MAY_SLIDE
    if doubt and linear:
        doubt = "" if set(words(position.name)) & SLIDING else _MAY_TURN.format(position.name)
    what = "torque" if role == "force" and not linear else role
    notes.check.append(
        f"{DEVICE}: one {kind} axis '{axis}' driven by a {what}{doubt}; put in what you know of it"
    )
    if names := join_names(device.constants):
        notes.check.append(sentence("scales", device=DEVICE, names=names))
    if on_gravity:
        notes.check.append(f"{DEVICE}: on '{axis}', {on_gravity}")
    return ChosenDevice(DEVICE, device, text)


def _stage(
    axes: Mapping[str, tuple[SurveyedColumn, SurveyedColumn]], role: str, match: Matcher
) -> ChosenDevice:
    """Propose a device file for a stage of sliding axes, by their positions and drives."""
    texts = []
    for name, (position, driver) in axes.items():
        fit = _rough_fit(position, driver, role, True, match.t)
        drive = Drive(role, driver.name, scaled=role == "force" and not needs_gain(driver))
        width = 0.0 if in_counts(position) else _sign_width(position, match.t, True)
        texts.append(starter_device("", True, drive, fit, sign_width=width, axis=name))
    text = stage_device(texts)
    device = registry.device_from(tomllib.loads(text), DEVICE)
    for pair, source in zip(axes.items(), device.forces, strict=True):
        match.given = {**match.given, pair[0]: pair[1][0], source: pair[1][1]}
    match.rivals = []
    match.notes.check.append(sentence("stage", device=DEVICE, axes=join_names(axes), role=role))
    if names := join_names(device.constants):
        match.notes.check.append(sentence("scales", device=DEVICE, names=names))
    return ChosenDevice(DEVICE, device, text)


def _has_coil(driver: SurveyedColumn | None, match: Matcher) -> bool:
    """Whether a current beside a force is that of a coil or a brake, rather than of the drive."""
    found = (c for c in match.found.of("current") if not c.is_constant)
    currents = [c for c in found if "motor" not in words(c.name)]
    if driver is None:
        return bool(currents)
    pairs = (np.nan_to_num([c.values, driver.values]) for c in currents)
    together = [abs(float(np.corrcoef(pair)[0, 1])) > _SAME_DRIVE for pair in pairs]
    alike = [c for c, same in zip(currents, together, strict=True) if same]
    for current in alike:
        match.used.add(current.name)
        said = sentence("both_of_drive", current=current.name, driver=driver.name)
        match.notes.check.append(said)
    coils = [c.name for c in currents if c.name not in match.used]
    commanded = [name for name in coils if REFERENCE_WORDS & set(words(name))]
    match.notes.check += [sentence("coil", column=name) for name in commanded]
    return bool(coils)


def _at_joint(
    position: SurveyedColumn, driver: SurveyedColumn | None, match: Matcher
) -> tuple[SurveyedColumn, SurveyedColumn]:
    """What is read, and the angle of the joint, by the weight on it, which goes with its sine.

    That tells the unit of a position that has none, and the size of counts and of a motor's angle.
    """
    far = _may_be_geared(position)
    unsaid = not position.stated and position.si is None
    if driver is None or not (far or unsaid or in_counts(position)) or is_velocity(position):
        return position, position
    values = np.nan_to_num(driver.values)
    worth = guesses.find_turning(match.t, np.nan_to_num(position.values), values)
    if worth is None:
        return position, position
    if not in_counts(position):
        units = (position.unit,) if far else ("rad", "deg", "rev")
        named = [replace(position, unit=name) for name in units]
        fitting = [p for p in named if abs(p.scale * worth.size - 1.0) < _NEAR]
        if fitting:
            return (fitting[0],) * 2
    match.turning = {position.name: worth}
    angle = (position.values - worth.zero) / worth.size
    return position, replace(position, values=angle, stated="rad", unit="rad")


def _may_be_geared(position: SurveyedColumn) -> bool:
    """Whether an angle is rather a motor's before its gear: by its name, in turns, or by travel."""
    travel = float(np.ptp(position.values)) * position.scale
    of_motor = positions.is_of_motor(position) or unit(position.unit) == unit("rev")
    return position.si == "rad" and (of_motor or travel > MOST_TRAVEL)


def _sign_width(position: SurveyedColumn, t: np.ndarray, linear: bool) -> float:
    """Width for the sign of the velocity, rad/s or m/s, where less than the usual; else 0.

    Friction that truly stops an axis is a sign over no width. Replays that creep over the usual one
    leave less at reversals than such a machine, which then seems to lack a Stribeck friction or a
    compliance; filtered velocities know the sign down to a fortieth of a step a sample.
    """
    kind = "linear" if linear else "rotary"
    si, _, usual = KINDS[kind]
    q = positions.position_in_si(position, t, si)
    step = counting_step(q)
    step = max(step, float(np.sqrt(12.0)) * float(np.nan_to_num(white_noise_sd(q, t, step))))
    width = max(step / float(np.median(np.diff(t))) / 40.0, usual / 20.0)
    return float(f"{width:.0e}") if width < usual / 2.0 else 0.0


def _rough_fit(
    position: SurveyedColumn, driver: SurveyedColumn | None, role: str, linear: bool, t: np.ndarray
) -> guesses.Driven:
    """How the driver goes with the motion, both in SI; nothing found where nothing drives."""
    if driver is None:
        return guesses.Driven(0.0)
    si = {"current": "A", "voltage": "V", "duty": ""}.get(role, "N" if linear else "N.m")
    drive = np.nan_to_num(driver.values * positions.scale_to(si, driver))
    q = positions.position_in_si(position, t, "m" if linear else "rad")
    counted = in_counts(position)
    found = guesses.driven(t, q, drive, angle=not linear and not counted)
    # Sizes per count would pass for sizes per radian or metre.
    return replace(found, inertia=0.0, viscous=0.0) if counted else found
