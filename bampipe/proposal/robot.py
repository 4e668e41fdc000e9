"""The columns of a robot's log held against its drawing: order, units, signs and sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from bampipe.data.survey import Survey, SurveyedColumn
from bampipe.physics.device import Device
from bampipe.physics.newton_euler import Algebra, joint_forces
from bampipe.physics.robot import Robot, gravity_vector
from bampipe.proposal.directions import Counting, find_counting
from bampipe.proposal.joints import Group, pair_joints
from bampipe.proposal.notes import Notes
from bampipe.proposal.positions import position_in_si, scale_to

Array = NDArray[np.float64]

_SMOOTHED_S = 0.1
"""Stretch of a record over which a parabola gives velocity and acceleration."""
_MOST_ROWS = 4000
_SURE = 5.0
"""Standard errors from which on the sign of a drive is known."""
LEAST_AT_JOINT = 1.0 / 3.0
"""Share of what the drawing requires below which a torque is that of a motor."""
_BEYOND = 1.5
"""Times its range that a joint must travel for the position to be another's."""
_BETTER = 0.5
"""Of what one order of the joints leaves unexplained: another one must leave less."""
_FEW_ROWS = 1000
_MARGINS = (1.05, 1.4, 2.0)
"""Of its range over what a motor travels: how much of its range a joint is thought to use."""
_DRAWN = 0.05
"""Weight of the size of the drawn bodies beside the shape of the drives."""
_MOST_LEFT = 0.05
"""Of the drives' variance: what a drawing with the right reductions leaves at most."""
_DOUBTED = 0.01
"""The same: what positions leave whose unit is guessed, before those of motors are tried."""
_OTHER_UNITS = {"rad": ("deg", np.pi / 180.0), "m": ("mm", 1e-3)}


@dataclass(frozen=True)
class Drive:
    """How the drive of a joint goes with what its motion requires by the drawing.

    Attributes:
        share: of the drive, for one of what is required; 1 where both are of the joint.
        error: its standard error by the scatter alone; the drawing has another.
        left: part of the drive's variance that drawing, drive's inertia and friction leave.
    """

    share: float
    error: float
    left: float

    @property
    def is_sure(self) -> bool:
        """Whether the sign is known."""
        return abs(self.share) > _SURE * self.error


@dataclass(frozen=True)
class RobotColumns:
    """What a robot's log was found to hold.

    Attributes:
        columns: by name of joint or input.
        drives: by name of input, where drawing and log can be compared.
        gears: by joint whose position is that of a motor, its turns for one of the joint.
        counting: by joint, its direction against the drawing, 1 or -1, and the angle that is added
            to its reading times that, rad.
    """

    columns: Mapping[str, SurveyedColumn]
    drives: Mapping[str, Drive]
    gears: Mapping[str, float] = field(default_factory=dict)
    counting: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def turned(self) -> frozenset[str]:
        """Inputs that are surely logged with the other sign."""
        return frozenset(n for n, drive in self.drives.items() if drive.is_sure and drive.share < 0)


def find_robot_columns(
    device: Device, robot: Robot, found: Survey, t: Array, notes: Notes
) -> RobotColumns:
    """Pair columns with joints and drives, and hold them against the drawing.

    Args:
        device, robot: the robot; found: the log; t: (T,) time, s.
        notes: what is guessed is noted, and how sure it is.
    """
    pairing = pair_joints(device, found)
    positions = next(iter(pairing.positions), None)
    drives = next(iter(pairing.drives), None)
    for what, chosen, others in (
        ("positions", positions, pairing.positions[1:]),
        ("drives", drives, pairing.drives[1:]),
    ):
        if chosen is not None and others:
            listed = "; ".join(str(other) for other in others)
            notes.check.append(f"of several {what}, {chosen} are taken, not {listed}")
    columns: dict[str, SurveyedColumn] = {}
    if positions is not None:
        other_unit = _in_unit_of_range(device, positions)
        if other_unit is not None and drives is not None:
            judged = _judge(device, robot, other_unit, drives, t)
            positions = other_unit if judged and _left(judged) < _BETTER else positions
        columns |= dict(zip(_joints(device), positions.columns, strict=True))
    if drives is not None:
        columns |= dict(zip(device.forces, drives.columns, strict=True))
    else:
        columns |= pairing.some_drives
    if positions is None or drives is None:
        return RobotColumns(columns, {})
    judged = _judge(device, robot, positions, drives, t)
    beyond = _beyond_range(device, positions, of_joint=bool(judged) and _fits(judged))
    guessed = positions is not pairing.positions[0] and bool(judged) and _left(judged) > _DOUBTED
    if judged and not robot.motors and (guessed or not _fits(judged)):
        # Hundreds without a unit are degrees, or radians of a motor.
        geared = [
            (group, fitted)
            for group in (positions, _in_si(device, pairing.positions[0]))
            if (fitted := _find_gears(device, robot, group, drives, t)) is not None
        ]
        if geared:
            group, (ratio, by_motor) = min(geared, key=lambda item: _left(item[1][1]))
            if not _fits(judged) or _left(by_motor) < _BETTER * _left(judged):
                return _geared(device, columns, group, ratio, by_motor, notes)
    notes.check += beyond
    if not judged or (beyond and not _fits(judged)):
        return RobotColumns(columns, {})
    if not (positions.named or drives.named):
        other = _in_alphabetical_order(device, positions), _in_alphabetical_order(device, drives)
        turned = _judge(device, robot, *other, t)
        if turned and _left(turned) < _BETTER * _left(judged):
            notes.check.append(
                "columns stand in the alphabetical order of the joints' names, since weight and"
                f" inertia as drawn explain {1.0 - _left(turned):.1%} of the drives that way,"
                f" {max(1.0 - _left(judged), 0.0):.1%} in the order of the chain"
            )
            judged = turned
            columns |= dict(zip(_joints(device), other[0].columns, strict=True))
            columns |= dict(zip(device.forces, other[1].columns, strict=True))
            positions, drives = other
    counting, judged = _counted(device, robot, positions, drives, t, judged)
    by_input = dict(zip(device.forces, judged, strict=True))
    notes.check += _sentences(device, columns, by_input)
    return RobotColumns(
        columns, by_input, counting=dict(zip(_joints(device), counting, strict=True))
    )


def _counted(
    device: Device, robot: Robot, positions: Group, drives: Group, t: Array, judged: list[Drive]
) -> tuple[list[tuple[float, float]], list[Drive]]:
    """Direction and zero of each joint, and what they make of the drives, as `find_counting`."""
    ratio = _turns(device, robot)
    few, many = (
        _motion(_positions(device, positions, t), t, rows) for rows in (_FEW_ROWS, _MOST_ROWS)
    )
    counting = Counting.as_drawn(len(device.coordinates))
    if few is None or many is None or ratio is None:
        return counting.by_joint, judged

    def left(direction: Array, zero: Array) -> Array:
        held = _hold(device, robot, few.counted(direction, zero), drives, ratio)
        return np.array([drive.left for drive in held])

    counting = find_counting([c.unit == "rad" for c in device.coordinates], left)
    if not counting.changed:
        return counting.by_joint, judged
    motion = many.counted(counting.direction, counting.zero)
    return counting.by_joint, _hold(device, robot, motion, drives, ratio)


def _geared(
    device: Device,
    columns: Mapping[str, SurveyedColumn],
    positions: Group,
    ratio: Array,
    judged: Sequence[Drive],
    notes: Notes,
) -> RobotColumns:
    """The columns of a log on the side of the motors."""
    joints = _joints(device)
    found = {**columns, **dict(zip(joints, positions.columns, strict=True))}
    gears = {j: float(r) for j, r in zip(joints, ratio, strict=True) if r != 1.0}
    listed = ", ".join(f"{joint} {turns:.3g}" for joint, turns in gears.items())
    notes.check.append(
        "positions are those of motors, by weight and inertia as drawn with these turns for one of"
        f" the joint: {listed}; put in those of the gears"
    )
    explained = max(0.0, 1.0 - _left(judged))
    notes.check.append(
        f"drawing, drives' inertia and friction explain {explained:.1%} of the drives"
    )
    return RobotColumns(found, dict(zip(device.forces, judged, strict=True)), gears)


def _in_si(device: Device, group: Group) -> Group:
    """The positions in rad or m where they state no unit."""
    pairs = zip(device.coordinates, group.columns, strict=True)
    return replace(group, columns=tuple(replace(p, unit=p.unit or c.unit) for c, p in pairs))


def _joints(device: Device) -> list[str]:
    return [c.name for c in device.coordinates]


def _in_alphabetical_order(device: Device, group: Group) -> Group:
    """Columns as ROS publishes joints: the first column is the first name of the alphabet."""
    names = _joints(device)
    order = [sorted(names).index(name) for name in names]
    return replace(group, columns=tuple(group.columns[k] for k in order))


def _in_unit_of_range(device: Device, group: Group) -> Group | None:
    """The positions in degrees or millimetres where they state no unit and only these fit."""
    found = []
    for c, column in zip(device.coordinates, group.columns, strict=True):
        name, scale = _OTHER_UNITS[c.unit]
        most = _BEYOND * _range(device, c.name)
        span = float(np.ptp(np.nan_to_num(column.values)))
        if column.unit or span <= most or span * scale > most:
            found.append(column)
        else:
            found.append(replace(column, unit=name))
    # One controller gives all angles alike: what is so for one is so for all.
    angles = {c.unit for c in device.coordinates}
    for si in angles:
        name, _ = _OTHER_UNITS[si]
        own = [k for k, c in enumerate(device.coordinates) if c.unit == si]
        if any(found[k].unit == name and not group.columns[k].unit for k in own):
            for k in own:
                found[k] = replace(found[k], unit=found[k].unit or name)
    changed = any(new is not old for new, old in zip(found, group.columns, strict=True))
    return replace(group, columns=tuple(found)) if changed else None


def _range(device: Device, joint: str) -> float:
    low, high = device.limits.get(joint, (-np.inf, np.inf))
    return high - low


def _beyond_range(device: Device, positions: Group, of_joint: bool) -> list[str]:
    found = []
    for c, column in zip(device.coordinates, positions.columns, strict=True):
        span = float(np.ptp(np.nan_to_num(column.values))) * scale_to(c.unit, column)
        width = _range(device, c.name)
        if span > _BEYOND * width:
            why = "weight and inertia as drawn agree with that: is the range of the drawing right?"
            if not of_joint:
                why = (
                    f"a position of the motor, which turns {span / width:.3g} times for one of the"
                    " joint or more? give gear_ratio, and [robot.motors]"
                )
            found.append(
                f"{column.name} travels {span:.3g} {c.unit}, and the range of {c.name} is"
                f" {width:.3g}: {why}"
            )
    return found


def _judge(device: Device, robot: Robot, positions: Group, drives: Group, t: Array) -> list[Drive]:
    """How each drive goes with the drawing; none where drives are not one a joint."""
    ratio = _turns(device, robot)
    if ratio is None:
        return []
    return _judge_along(device, robot, _positions(device, positions, t), drives, ratio, t)


def _turns(device: Device, robot: Robot) -> Array | None:
    """Turns of each joint's motor for one of the joint (n,); None where motors turn several."""
    turned = [list(motor.turns) for motor in robot.motors.values()]
    names = _joints(device)
    if not turned:
        return np.ones(len(names))
    if turned != [[name] for name in names]:
        return None
    return np.array([abs(m.turns[n]) for m, n in zip(robot.motors.values(), names, strict=True)])


def _positions(device: Device, group: Group, t: Array) -> Array:
    """Positions (T, n) in SI, wherever their encoders sit."""
    columns = zip(device.coordinates, group.columns, strict=True)
    return np.column_stack([position_in_si(column, t, c.unit) for c, column in columns])


def _judge_along(
    device: Device,
    robot: Robot,
    q: Array,
    drives: Group,
    ratio: Array,
    t: Array,
    most_rows: int = _MOST_ROWS,
) -> list[Drive]:
    """How drives go with positions (T, n) of the joints; ``ratio``: turns of the motors (n,)."""
    motion = _motion(q, t, most_rows)
    return [] if motion is None else _hold(device, robot, motion, drives, ratio)


@dataclass(frozen=True)
class _Motion:
    """Positions, velocities and accelerations of a robot's joints, each (K, n).

    Attributes:
        rows: of the log, of which they are.
    """

    position: Array
    rate: Array
    change: Array
    rows: slice

    def counted(self, direction: Array, zero: Array) -> _Motion:
        """The same with joints that count the other way, or from another zero; each (n,)."""
        parts = (direction * part for part in (self.position, self.rate, self.change))
        position, rate, change = parts
        return _Motion(position + zero, rate, change, self.rows)


def _motion(q: Array, t: Array, most_rows: int) -> _Motion | None:
    """The motion along positions (T, n); None where they are too few or incomplete."""
    step = float(np.median(np.diff(t)))
    window = max(5, 2 * round(0.5 * _SMOOTHED_S / step) + 1) if step > 0.0 else len(q)
    if not np.isfinite(q).all() or window >= len(q):
        return None
    rows = slice(None, None, max(1, len(q) // most_rows))
    position, rate, change = (
        savgol_filter(q, window, 2, deriv=k, delta=step, axis=0)[rows] for k in range(3)
    )
    return _Motion(position, rate, change, rows)


def _hold(
    device: Device, robot: Robot, motion: _Motion, drives: Group, ratio: Array
) -> list[Drive]:
    """How drives go with a motion of the joints; ``ratio``: turns of the motors (n,)."""
    position, rate, change = (
        list(part.T) for part in (motion.position, motion.rate, motion.change)
    )
    bodies = [list(joint.inertial) for joint in robot.joints]
    forces = joint_forces(
        Algebra.numbers(), robot.links, bodies, position, rate, change, gravity_vector(robot)
    )
    found = []
    for k, column in enumerate(drives.columns):
        required = np.broadcast_to(forces[k], rate[k].shape) / ratio[k]
        values = np.nan_to_num(column.values)[motion.rows] * scale_to(device.force_unit, column)
        found.append(_compare(required, rate[k], change[k], values))
    return found


def _find_gears(
    device: Device, robot: Robot, positions: Group, drives: Group, t: Array
) -> tuple[Array, list[Drive]] | None:
    """Turns of each motor for one of its joint (n,), by positions on the side of the motors.

    Weight goes with the sine of the joint's angle, so only the right reductions let the drawing
    explain the drives. Returns them with what they make of the drives; None where none do well.
    """
    q = _positions(device, positions, t)
    span = np.ptp(q, axis=0)
    least = span / np.array([_range(device, c.name) for c in device.coordinates])
    moved, at_joint = least > _BEYOND, np.ones(len(least))
    if not moved.any() or not _judge_along(device, robot, q, drives, at_joint, t, _FEW_ROWS):
        return None
    in_torque = device.force_unit == "N.m"

    def ratios(x: Array) -> Array:
        ratio = np.ones(len(least))
        ratio[moved] = np.exp(x)
        return ratio

    def misfit(x: Array) -> Array:
        ratio = ratios(x)
        judged = _judge_along(device, robot, q / ratio, drives, at_joint, t, _FEW_ROWS)
        left = np.sqrt([max(drive.left, 1e-12) for drive in judged])
        if not in_torque:
            return np.asarray(left)
        # A torque of the motor is that of the joint over the reduction, as well as it is drawn.
        size = np.array([max(abs(drive.share), 1e-9) for drive in judged])
        return np.concatenate([left, _DRAWN * np.log(size[moved] * ratio[moved])])

    found = [
        least_squares(misfit, np.log(factor * least[moved]), diff_step=1e-3, max_nfev=40)
        for factor in _MARGINS
    ]
    best = min(found, key=lambda solution: float(solution.cost))
    ratio = ratios(best.x)
    judged = _judge_along(device, robot, q / ratio, drives, at_joint, t)
    # A gear that speeds up would take the joint further beyond its range than the log goes.
    return (ratio, judged) if _fits(judged) and ratio.min() >= 1.0 else None


def _compare(required: Array, rate: Array, change: Array, drive: Array) -> Drive:
    """Regress a drive on what the drawing requires, its own inertia, friction and an offset."""
    sign = np.tanh(rate / max(0.02 * float(np.abs(rate).max()), 1e-9))
    columns = np.column_stack([required, change, rate, sign, np.ones_like(rate)])
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    values, _, rank, _ = np.linalg.lstsq(columns / size, drive, rcond=1e-9)
    rest = drive - columns / size @ values
    left = float(np.var(rest) / max(np.var(drive), 1e-300))
    if rank < columns.shape[1]:
        return Drive(0.0, np.inf, left)
    inverse = np.linalg.inv((columns / size).T @ (columns / size))
    # Neighbouring samples err alike: about one in ten counts.
    error = np.sqrt(10.0 * np.mean(rest**2) * inverse[0, 0])
    return Drive(float(values[0] / size[0]), float(error / size[0]), left)


def _fits(drives: Sequence[Drive]) -> bool:
    """Whether drawing and log are of the same joints."""
    return _left(drives) < _MOST_LEFT


def _left(drives: Sequence[Drive]) -> float:
    return float(np.mean([drive.left for drive in drives]))


def _sentences(
    device: Device, columns: Mapping[str, SurveyedColumn], drives: Mapping[str, Drive]
) -> list[str]:
    """What weight and inertia of the drawn bodies say of the drives, a sentence each."""
    lines, agreed = [], []
    for c, (name, drive) in zip(device.coordinates, drives.items(), strict=True):
        column = columns[name].name
        if not drive.is_sure:
            lines.append(
                f"{column}: too little weight and inertia act on {c.name} to tell its sign"
            )
            continue
        size = abs(drive.share)
        said = []
        if drive.share < 0.0:
            said.append(f"its sign is turned; or that of {c.name} is the wrong one")
        if device.force_unit == "A":
            agreed.append(f"{c.name} {1.0 / size:.3g} N.m/A")
        elif size >= 1.0 / LEAST_AT_JOINT:
            said.append("another unit, or bodies that are not drawn")
        elif size <= LEAST_AT_JOINT:
            said.append(
                f"another unit, or the torque of a motor with a reduction of about {1.0 / size:.3g}"
            )
        elif not said:
            agreed.append(f"{c.name} {size:.2f}")
        if said:
            lines.append(
                f"{column} is {drive.share:.2g} ± {drive.error:.1g} times what the drawing"
                f" requires: {'; and '.join(said)}"
            )
    if agreed and device.force_unit == "A":
        lines.append(
            f"torque constants by weight and inertia as drawn, and no better than these:"
            f" {', '.join(agreed)}; put in those of the data sheet, gears included, or have them"
            " estimated by that of one"
        )
    elif agreed:
        lines.append(
            f"signs and sizes of the drives agree with weight and inertia as drawn (1 is perfect):"
            f" {', '.join(agreed)}"
        )
    explained = max(0.0, 1.0 - _left(list(drives.values())))
    lines.append(f"drawing, drives' inertia and friction explain {explained:.1%} of the drives")
    return lines
