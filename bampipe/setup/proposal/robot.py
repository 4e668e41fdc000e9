"""The columns of a robot's log held against its drawing: order, units, signs, sizes, reductions."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from bampipe.arrays import Array
from bampipe.data.chain import frame_of_tip, read_tree
from bampipe.data.survey import Survey, SurveyedColumn
from bampipe.physics.device import Device
from bampipe.physics.robot import Robot
from bampipe.setup import drawn_bodies
from bampipe.setup.drawn_bodies import Comparison, Drive, find_heavy, mean_left
from bampipe.setup.mounting import Mounting, find_mounting
from bampipe.setup.proposal.joints import Group, pair_joints
from bampipe.setup.proposal.notes import Notes
from bampipe.setup.proposal.positions import in_counts, position_in_si, scale_to
from bampipe.setup.sentences import sentence

BEYOND = 1.5
"""Times its range that a joint must travel for the position to be another's."""
_DOUBTED = 0.01
"""Of the drives' variance: what other units and zeros are tried from."""
_MOST_ROWS, _FEW_ROWS = 4000, 1000
_SMOOTHED_S = 0.1
"""Stretch of a record over which a parabola gives velocity and acceleration."""
_MARGINS = (1.05, 1.4, 2.0)
"""Of its range over what a motor travels: how much of its range a joint is thought to use."""
_DRAWN = 0.05
"""Weight of the size of the drawn bodies beside the shape of the drives."""
_SURE_LEFT = 0.02
"""Of the drives' variance: what the right reductions leave at most where zeros are guessed, too."""
_ALTERNATIONS = 2
"""How often zeros are sought with the reductions found so far, and reductions with these zeros."""
_BETTER = 0.5
"""Of what one order of the joints leaves unexplained: another one must leave less."""
_OTHER_UNITS = {"rad": ("deg", np.pi / 180.0), "m": ("mm", 1e-3)}


@dataclass(frozen=True)
class Gears:
    """Turns of motors for one of each joint, (n,), and what these and a mounting make of drives.

    ``compared``: the drives beside the drawing.
    """

    ratio: Array
    mounting: Mounting
    drives: list[Drive]
    compared: Comparison


@dataclass(frozen=True)
class Logged:
    """A robot with its log: device, robot, and time stamps, (T,), s."""

    device: Device
    robot: Robot
    t: Array

    @property
    def ranges(self) -> Array:
        """Width of what each joint can move through, (n,), rad or m; infinite if not known."""
        limits = [self.device.limits.get(c.name, (0.0, 0.0)) for c in self.device.coordinates]
        return np.array([high - low if high > low else np.inf for low, high in limits])

    def positions(self, group: Group) -> Array:
        """Positions (T, n) in SI, wherever their encoders sit."""
        columns = zip(self.device.coordinates, group.columns, strict=True)
        return np.column_stack([position_in_si(column, self.t, c.unit) for c, column in columns])

    def compare(
        self, positions: Group, drives: Group, ratio: Array, turned: Array | float = 1.0
    ) -> tuple[Comparison, Comparison] | None:
        """Compare drives and drawing at few samples and at many; None if the samples do not do.

        ``turned``: turns of what each encoder sits on for one of its joint, (n,).
        """
        q, step = self.positions(positions) / turned, float(np.median(np.diff(self.t)))
        window = max(5, 2 * round(0.5 * _SMOOTHED_S / step) + 1) if step > 0.0 else len(q)
        if not np.isfinite(q).all() or window >= len(q):
            return None
        smooth = (savgol_filter(q, window, 2, deriv=k, delta=step, axis=0) for k in range(3))
        motion, unit = drawn_bodies.JointMotion(*smooth), self.device.force_unit
        forces = [scale_to(unit, c) * np.nan_to_num(c.values) for c in drives.columns]
        drive = np.column_stack(forces)
        turning = tuple(c.unit == "rad" for c in self.device.coordinates)

        def at(most_rows: int) -> Comparison:
            rows = slice(None, None, max(1, len(q) // most_rows))
            return Comparison(self.robot, turning, [motion.rows(rows)], drive[rows], ratio)

        return at(_FEW_ROWS), at(_MOST_ROWS)

    def explain(
        self, positions: Group, drives: Group, ratio: Array, turned: Array | float = 1.0
    ) -> Gears | None:
        """Explanation of the drives by the drawing, best mounted; None if they do not compare."""
        compared = self.compare(positions, drives, ratio, turned)
        if compared is None:
            return None
        few, many = compared
        mounting = many.best_mounting(few, _DOUBTED)
        return Gears(ratio, mounting, many.hold(mounting), many)

    def explain_geared(self, positions: Group, drives: Group, turns: Array) -> Gears | None:
        """Positions of motors whose ``turns`` for one of the joint, (n,), are known.

        None if they leave a joint beyond its range, or the log is incomplete.
        """
        if (np.ptp(self.positions(positions) / turns, axis=0) > BEYOND * self.ranges).any():
            return None
        found = self.explain(positions, drives, turns, turns)
        if found is None:
            return None
        turned = replace(found.mounting, direction=found.mounting.direction * np.sign(turns))
        return replace(found, ratio=np.abs(turns), mounting=turned)

    def find_gears(self, positions: Group, drives: Group) -> Gears | None:
        """Turns of each motor for one of its joint, by positions on the side of the motors.

        Weight goes with the sine of the joint's angle, so only the right reductions and zeros let
        the drawing explain the drives. None if none do well.
        """
        least = np.ptp(self.positions(positions), axis=0) / self.ranges
        moved, at_joint = least > BEYOND, np.ones(len(least))
        compared = self.compare(positions, drives, at_joint) if moved.any() else None
        if compared is None:
            return None
        (few, many), in_torque = compared, self.device.force_unit == "N.m"

        def fitted(ratio: Array, mounting: Mounting) -> tuple[float, Array]:
            """Cost and reductions of the fit that starts at ``ratio``."""

            def misfit(x: Array) -> Array:
                tried = at_joint.copy()
                tried[moved] = np.exp(x)
                judged = few.reread(np.diag(1.0 / tried)).hold(mounting)
                left = np.sqrt([max(drive.left, 1e-12) for drive in judged])
                if not in_torque:
                    return np.asarray(left)
                # A torque is that of the joint as drawn, or of the motor: over the reduction.
                size = np.log([max(abs(drive.share), 1e-9) for drive in judged])[moved]
                off = np.stack([size, size + np.log(tried[moved])])
                return np.concatenate([left, _DRAWN * off[np.abs(off).sum(axis=1).argmin()]])

            found = least_squares(misfit, np.log(ratio[moved]), diff_step=1e-3, max_nfev=40)
            best = at_joint.copy()
            best[moved] = np.exp(found.x)
            return float(found.cost), best

        def sound(ratio: Array, mounting: Mounting) -> Gears | None:
            geared = many.reread(np.diag(1.0 / ratio))
            found = Gears(ratio, mounting, geared.hold(mounting), geared)
            # A gear that speeds up would take the joint further beyond its range than the log goes.
            return found if drawn_bodies.fits(found.drives) and ratio.min() >= 1.0 else None

        starts = [np.where(moved, factor * least, 1.0) for factor in _MARGINS]
        ratio = min((fitted(start, few.nominal) for start in starts), key=lambda one: one[0])[1]
        found = sound(ratio, few.nominal)
        for start in starts if found is None else ():
            ratio = start
            for _ in range(_ALTERNATIONS):
                geared = few.reread(np.diag(1.0 / ratio))
                mounting = find_mounting(geared.turning, few.nominal, geared.misfit, stands=True)
                ratio = fitted(ratio, mounting)[1]
                found = sound(ratio, mounting)
                # Wrong zeros with reductions to match explain much; only the right ones all.
                if found is not None and mean_left(found.drives) < _SURE_LEFT:
                    return found
        return found if found is not None and not found.mounting.changes else None


@dataclass(frozen=True)
class RobotColumns:
    """What a robot's log was found to hold.

    Attributes:
        joints: names of the joints.
        columns: by name of joint or input; of what stands there no other column is thought.
        drives: by name of input, where drawing and log can be compared.
        gears: by joint whose position is that of a motor, its turns for one of the joint.
        mounting: of the joints and the base against the drawing; None if nothing tells.
    """

    joints: Sequence[str] = ()
    columns: Mapping[str, SurveyedColumn] = field(default_factory=dict)
    drives: Mapping[str, Drive] = field(default_factory=dict)
    gears: Mapping[str, float] = field(default_factory=dict)
    mounting: Mounting | None = None

    @property
    def counting(self) -> Mapping[str, tuple[float, float]]:
        """Direction and zero of each joint against the drawing, where that tells."""
        by_joint = self.mounting.by_joint if self.mounting is not None else []
        return dict(zip(self.joints, by_joint, strict=False))

    @property
    def turned(self) -> frozenset[str]:
        """Inputs that are surely logged with the other sign."""
        return frozenset(name for name, drive in self.drives.items() if drive.is_turned)


def find_robot_columns(
    folder: Path, device: Device, robot: Robot, found: Survey, t: Array, timed: bool, notes: Notes
) -> RobotColumns:
    """Pair columns with joints and drives at ``t``, (T,) s, and hold them against the drawing.

    That needs a rate that is known: unless ``timed``, it is assumed.
    What is guessed is noted, and how sure it is.
    """
    by_position, by_drive, some_drives = pair_joints(device, found)
    for what, groups in (("positions", by_position), ("drives", by_drive)):
        if len(groups) > 1:
            listed = "; ".join(map(str, groups[1:]))
            notes.check.append(f"of several {what}, {groups[0]} are taken, not {listed}")
        if groups and not groups[0].named and not re.search(r"\d", groups[0].columns[0].name):
            notes.check.append(f"{what} are taken in the order of their columns, {groups[0]}")
    positions, drives = next(iter(by_position), None), next(iter(by_drive), None)
    turns, logged, joints = _turns(device, robot), Logged(device, robot, t), _joints(device)

    def pair(positions: Group | None, drives: Group | None) -> dict[str, SurveyedColumn]:
        groups = (joints, positions), (device.forces, drives)
        pairs = (zip(names, group.columns, strict=True) for names, group in groups if group)
        return dict(chain.from_iterable(pairs))

    if positions is None or drives is None or any(map(in_counts, positions.columns)) or not timed:
        return RobotColumns(joints, pair(positions, drives) | some_drives)
    best = logged.explain(positions, drives, turns) if turns is not None else None
    if turns is None or best is None:
        notes.check += _beyond_range(logged, positions, of_joint=False)
        return RobotColumns(joints, pair(positions, drives))
    stated, known = positions, bool((turns != 1.0).any())
    other_unit = _in_unit_of_range(logged, positions)
    other = logged.explain(other_unit, drives, turns) if other_unit else None
    if other_unit and other and mean_left(other.drives) < _BETTER:
        positions, best = other_unit, other
        notes.check.append(sentence("degrees", put_in=sentence("put_in")))
    left, sound = mean_left(best.drives), drawn_bodies.fits(best.drives)
    # Friction and the inertia of drives explain much of any motion.
    shown = sound and any(drive.is_sure for drive in best.drives)
    beyond = _beyond_range(logged, positions, of_joint=shown)
    guessed = (positions is not stated and left > _DOUBTED) or bool(beyond and not shown)
    on_motors = bool(beyond) if known else guessed and not robot.motors
    geared: list[tuple[Group, Gears]] = []
    # Hundreds without a unit are degrees, or radians of a motor.
    pairs = zip(device.coordinates, stated.columns, strict=True)
    in_si = replace(stated, columns=tuple(replace(p, unit=p.unit or c.unit) for c, p in pairs))
    for group in (positions, in_si) if on_motors or not sound else ():
        gears = logged.explain_geared(group, drives, turns) if known else None
        if not robot.motors:
            gears = logged.find_gears(group, drives)
        geared += [(group, gears)] if gears is not None else []
    if geared:
        group, gears = min(geared, key=lambda item: mean_left(item[1].drives))
        better = mean_left(gears.drives) < left * (1.0 if known else _BETTER)
        if better or (bool(beyond) if known else not sound):
            return _geared(device, pair(group, drives), gears, notes, given=known)
    notes.check += beyond
    if beyond and not sound:
        return RobotColumns(joints, pair(positions, drives))
    if not (positions.named or drives.named or sound):
        # ROS publishes joints so: the first column is the first name of the alphabet.
        order = [sorted(joints).index(name) for name in joints]
        ordered = positions.reordered(order), drives.reordered(order)
        other = logged.explain(*ordered, turns)
        if other is not None and mean_left(other.drives) < _BETTER * left:
            so, otherwise = 1.0 - mean_left(other.drives), max(1.0 - left, 0.0)
            notes.check.append(sentence("alphabetical", so=so, otherwise=otherwise))
            best, (positions, drives) = other, ordered
    if device.force_unit != "A" and (heavy := find_heavy(best.compared, best.mounting)):
        in_tip = _placed_in_tip(folder, robot)
        notes.check.append(drawn_bodies.describe_heavy(best.compared, best.mounting, heavy, in_tip))
    columns = pair(positions, drives)
    by_input = dict(zip(device.forces, best.drives, strict=True))
    notes.check += _sentences(device, columns, by_input)
    return RobotColumns(joints, columns, by_input, mounting=best.mounting)


def _placed_in_tip(folder: Path, robot: Robot) -> Callable[[Array], Array]:
    """What makes of a place in the frame of the last joint one in that of the tip, (3,)."""
    if robot.urdf is None:
        return lambda center: center
    turn, offset = frame_of_tip(read_tree(folder / robot.urdf), robot.base, robot.tip)
    return lambda center: np.asarray(turn.T @ (center - offset))


def _geared(
    device: Device, columns: Mapping[str, SurveyedColumn], found: Gears, notes: Notes, given: bool
) -> RobotColumns:
    """The columns of a log on the side of the motors, whose turns may be ``given``."""
    joints = _joints(device)
    ratio = [float(r) if given else float(f"{r:.4g}") for r in found.ratio]
    gears = {joint: r for joint, r in zip(joints, ratio, strict=True) if r != 1.0}
    listed = ", ".join(f"{joint} {turns:g}" for joint, turns in gears.items())
    name = "motors_given" if given else "motors_found"
    notes.check.append(sentence(name, turns=listed, put_in=sentence("put_in")))
    notes.check.append(_explained(found.drives))
    drives = dict(zip(device.forces, found.drives, strict=True))
    return RobotColumns(joints, columns, drives, gears, found.mounting)


def _joints(device: Device) -> list[str]:
    return [c.name for c in device.coordinates]


def _in_unit_of_range(logged: Logged, group: Group) -> Group | None:
    """The positions in degrees or millimetres where they state no unit and only these fit."""
    coordinates, others = logged.device.coordinates, set()
    for c, column, width in zip(coordinates, group.columns, logged.ranges, strict=True):
        span, most = float(np.ptp(np.nan_to_num(column.values))), BEYOND * width
        if not column.unit and span > most >= span * _OTHER_UNITS[c.unit][1]:
            others.add(c.unit)
    if not others:
        return None
    # One controller gives all angles alike: what is so for one is so for all.
    columns = [
        replace(column, unit=column.unit or _OTHER_UNITS[c.unit][0]) if c.unit in others else column
        for c, column in zip(coordinates, group.columns, strict=True)
    ]
    return replace(group, columns=tuple(columns))


def _beyond_range(logged: Logged, positions: Group, of_joint: bool) -> list[str]:
    found = []
    joints = zip(logged.device.coordinates, positions.columns, logged.ranges, strict=True)
    for c, column, width in joints:
        span = float(np.ptp(np.nan_to_num(column.values))) * scale_to(c.unit, column)
        if span > BEYOND * width:
            why = "range_wrong" if of_joint else "motor_beyond"
            why = sentence(why, turns=span / width, put_in=sentence("put_in"))
            of = {"column": column.name, "unit": c.unit, "joint": c.name}
            found.append(sentence("beyond_range", **of, span=span, width=width, why=why))
    return found


def _turns(device: Device, robot: Robot) -> Array | None:
    """Turns of each joint's motor for one of the joint (n,); None if motors turn several."""
    turned = [list(motor.turns) for motor in robot.motors.values()]
    names = _joints(device)
    if not turned:
        return np.ones(len(names))
    if turned != [[name] for name in names]:
        return None
    return np.array([m.turns[n] for m, n in zip(robot.motors.values(), names, strict=True)])


def _sentences(
    device: Device, columns: Mapping[str, SurveyedColumn], drives: Mapping[str, Drive]
) -> list[str]:
    """What weight and inertia of the drawn bodies say of the drives, a sentence each."""
    lines, agreed = [], []
    together = len(drives) > 1 and all(drive.is_turned for drive in drives.values())
    if together:
        lines.append(sentence("all_turned"))
    for c, (name, drive) in zip(device.coordinates, drives.items(), strict=True):
        column, of = columns[name].name, {"joint": c.name}
        if not drive.is_sure:
            how = "unsure_turned" if drive.is_turned else "unsure_right"
            friction = sentence(how, **of) if drive.is_turned or drive.is_dissipative else ""
            said = sentence("unsure", column=column, by_friction=friction, **of)
            lines += [] if together else [said]
            continue
        size, share = abs(drive.share), -drive.share if together else drive.share
        why = [sentence("sign_turned", **of)] if share < 0.0 else []
        if device.force_unit == "A":
            agreed.append(f"{c.name} {1.0 / size:.3g} {c.torque_unit}/A")
        elif not drawn_bodies.STATED[0] < size < drawn_bodies.STATED[1]:
            why.append(sentence("small_drive" if size < 1.0 else "large_drive", reduction=1 / size))
        elif not why:
            agreed.append(f"{c.name} {size:.2f}")
        if why:
            known = {"column": column, "share": share, "error": drive.error}
            lines.append(sentence("drive_size", **known, why="; and ".join(why)))
    if agreed:
        name = "constants" if device.force_unit == "A" else "agreed"
        lines.append(sentence(name, agreed=", ".join(agreed)))
    return [*lines, _explained(list(drives.values()))]


def _explained(drives: Sequence[Drive]) -> str:
    return sentence("explained", share=max(0.0, 1.0 - mean_left(drives)))
