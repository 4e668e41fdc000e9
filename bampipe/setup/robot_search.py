"""Search for set-up mistakes of a robot by its drawn bodies, starting from the stated session."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from bampipe.arrays import Array
from bampipe.estimate.standstill import find_moving_samples
from bampipe.physics import System
from bampipe.physics.robot import Robot
from bampipe.setup import drawn_bodies, hypotheses, search
from bampipe.setup.drawn_bodies import Comparison, Drive, JointMotion
from bampipe.setup.hypotheses import Correction
from bampipe.setup.mounting import Mounting
from bampipe.setup.plausibility import FARTHEST, WEIGHT, Plausibility
from bampipe.setup.search import Corrections
from bampipe.trials.residuals import standstill_of
from bampipe.trials.signals import Change

DRAWN_SAMPLES = 4_000
"""Samples of all trials together that are compared with the drawn bodies."""
_SUSPICIOUS = 0.15
"""Error with drawn bodies above which other set-ups are tried: two exchanged joints leave at least
0.26."""
_ALIKE_SHARES, _FAR_SHARE = np.log(1.5), np.log(1.5)
"""Logarithms: largest spread of drives that are wrong by a common unit, and smallest such error."""
_UNSURE = 0.3
"""Smallest relative uncertainty of the drive that a drawing requires."""


def is_drawn(system: System) -> bool:
    """Whether a device is a robot whose bodies are known from a drawing."""
    robot = system.model.device.robot
    return robot is not None and any(
        p.weighed and not p.fixed and p.sd > 0.0 for p in system.parameters
    )


def drawn_robot(system: System) -> Robot:
    """The robot of a device that is one."""
    robot = system.model.device.robot
    assert robot is not None
    return robot


@dataclass
class DrawnSearch(search.Search):
    """Tests set-ups against drawn bodies.

    Fitted bodies would absorb much of a mistake. Besides, each drive has an inertia and friction of
    its own, and one factor for its bodies.
    """

    _reread: dict[bytes, Comparison] = field(default_factory=dict, init=False)

    @cached_property
    def stated(self) -> Comparison:
        """Drives and the drawn bodies' forces, as stated except for a body that is too heavy."""
        bodies = self._nominal_bodies
        if self.system.model.device.force_unit != "A":
            self.heavier = drawn_bodies.find_heavy(bodies, bodies.nominal)
        if self.heavier is None:
            return bodies
        return replace(bodies, robot=drawn_bodies.with_heavier_body(bodies.robot, self.heavier))

    @cached_property
    def roughly(self) -> Comparison:
        """`stated` at thinned samples only: joints move more slowly than the band's cut-off."""
        kept = [self.band.thinned_rows(len(motion.t)) for motion in self.motions]
        motions = [m.rows(rows) for m, rows in zip(self.stated.motions, kept, strict=True)]
        return replace(self.stated, motions=motions, thin=drawn_bodies.keep, _required={})

    @cached_property
    def _nominal_bodies(self) -> Comparison:
        robot, n = drawn_robot(self.system), len(self.system.coordinates)
        p = self.system.prior
        for i, item in enumerate(self.system.parameters):
            if not (item.weighed or item.fixed):
                p[i] = 0.0
        drives, used = [], []
        with np.errstate(all="ignore"):
            for motion in self.motions:
                at, u = motion.kinematics, motion.inputs(self.system.inputs)
                z = self.system.memory(*at, u, p, motion.t)
                # Other forces than the bodies', such as a spring's, are as stated in any case.
                beside = self.system.required(*at, z, u, p)
                beside = beside - robot.drawn_forces(*at, np.array(robot.gravity))
                drives.append(self.band.thin(self.system.applied(*at, z, u, p) - beside))
                still = standstill_of(motion, self.system, self.band.rate_hz)
                used.append(find_moving_samples(still, self.band))
        shared = [
            np.array([motor.turns.get(axis, 0.0) for axis in self.system.coordinates])
            for motor in robot.motors.values()
            if len(motor.turns) > 1
        ]
        return Comparison(
            robot,
            tuple(c.unit == "rad" for c in self.system.model.device.coordinates),
            [JointMotion(*motion.kinematics) for motion in self.motions],
            np.concatenate(drives),
            np.ones(n),
            self.band.thin,
            np.concatenate(used),
            shared,
            has_offset=False,
        )

    def drives_against_bodies(self) -> list[str]:
        """Drives of a single joint whose stated sign is opposite to that of their bodies."""
        drives = self._nominal_bodies.hold(self._nominal_bodies.nominal)
        return [name for name, k in self._alone.items() if drives[k].is_turned]

    @cached_property
    def _alone(self) -> dict[str, int]:
        """Joints by the force that alone acts on them and on no other joint."""
        return {
            self.signals.forces[f]: k
            for k, row in enumerate(self._by_force)
            for f in np.flatnonzero(row)
            if np.count_nonzero(row) == np.count_nonzero(self._by_force[:, f]) == 1
        }

    @cached_property
    def _by_force(self) -> Array:
        """Joint forces per unit of each force of the device, (n, forces)."""
        poses = np.zeros((1, len(self.system.coordinates)))
        return np.asarray(self.system.input_map(poses)[0])

    def screen(self, chosen: Corrections, correction: Correction) -> float:
        # Signs and sizes of drives of a single joint are free here: `together` reads their shares.
        held = self._hold((*chosen, correction), self.roughly)
        return np.inf if held is None else held[0].misfit(held[1]) + 2.0 * correction.cost / WEIGHT

    def is_suspicious(self, now: Plausibility | None) -> bool:
        if now is None:
            return False
        return now.worst_error > _SUSPICIOUS or float(now.objections.sum()) > search.LEAST_GAIN

    def rivals(self, tried: list[Correction]) -> list[Correction]:
        down = [-g for g in self.stated.robot.gravity]
        return [
            *hypotheses.sign_corrections(self.signals),
            *hypotheses.quarter_turns(self.signals),
            hypotheses.gravity_correction(self.signals, down, 1.0),
        ]

    def discrete(self) -> Iterator[Correction]:
        coupled = {force for force in self.signals.forces if force not in self._alone}
        yield from (x for x in hypotheses.sign_corrections(self.signals) if coupled & {*x.signals})
        axes = set(self.signals.axes)
        for correction in (
            *hypotheses.exchange_corrections(self.signals),
            *hypotheses.unit_corrections(self.signals),
            *hypotheses.clock_corrections(self.signals),
        ):
            # The share shows the unit of a drive, unless the drive turns several joints.
            of_drive = correction.kind == "scale" and not (axes | coupled) & set(correction.signals)
            cycle = correction.kind == "exchange" and len(correction.signals) > 2
            if not (of_drive or (cycle and len(axes) > search.MOST_AXES)):
                yield correction

    def families(self, chosen: Corrections) -> Iterator[tuple[search.Family, Array]]:
        position = np.concatenate([motion.position for motion in self.stated.motions])
        for axis, turns, q in zip(self.signals.axes, self.stated.turning, position.T, strict=True):
            if turns:
                yield from search.gear_families(self.signals, axis, float(np.ptp(q)))
        for force in self.signals.forces:
            if force not in self._alone:
                yield partial(search.scale_by_power_of_ten, self.signals, (force,)), search.DECADES

    def together(self, chosen: Corrections) -> Corrections:
        # Add the mistakes that the best mounting and the drives' shares show.
        found: list[Correction] = []
        change = hypotheses.combine(self.signals, chosen)
        compared, rough = (self._compare(change, one) for one in (self.stated, self.roughly))
        if compared is None or rough is None:
            return ()
        mounting = compared.best_mounting(rough, _SUSPICIOUS**2)
        for k, (axis, (direction, zero)) in enumerate(
            zip(self.signals.axes, mounting.by_joint, strict=True)
        ):
            found += [hypotheses.sign_correction(self.signals, [axis])] if direction < 0.0 else []
            if zero:
                off = float(np.remainder(zero + np.pi, 2.0 * np.pi) - np.pi) or np.pi
                off = off if compared.turning[k] else zero
                found.append(hypotheses.zero_correction(self.signals, axis, off, 1.0))
        if mounting.hangs:
            found.append(hypotheses.gravity_correction(self.signals, mounting.gravity, 1.0))
        drives = compared.hold(mounting)
        return (*found, *self._by_share(drives))

    def lacks_pose(self, best: Corrections) -> bool:
        return False

    def _by_share(self, drives: Sequence[Drive]) -> Iterator[Correction]:
        """Yield drives whose sign or size differs from the bodies', one by one or all together."""
        signs = [name for name, k in self._alone.items() if drives[k].is_turned]
        if len(signs) == len(self.signals.forces) > 1:
            yield hypotheses.sign_correction(self.signals, signs, 1.0)
        else:
            yield from (hypotheses.sign_correction(self.signals, [name]) for name in signs)
        sizes = {
            name: float(np.log(abs(drives[k].share)))
            for name, k in self._alone.items()
            if drives[k].is_sure
        }
        logs = np.array(list(sizes.values()))
        middle = float(np.median(logs)) if len(logs) else 0.0
        alike = len(logs) > 2 and np.abs(logs - middle).max() < _ALIKE_SHARES
        if alike and abs(middle) > _FAR_SHARE:
            forces, factor = self.signals.forces, np.exp(-middle)
            yield hypotheses.nearest_scale_correction(self.signals, forces, factor)
            return
        for name, size in sizes.items():
            if abs(size) > np.log(drawn_bodies.STATED[1]):
                yield hypotheses.nearest_scale_correction(self.signals, [name], np.exp(-size))

    def _compare(self, change: Change, stated: Comparison) -> Comparison | None:
        """The comparison ``stated`` with other readings and drives, but the same zeros.

        None if the change makes a position of a force.
        """
        n, forces = len(self.signals.axes), len(self.signals.forces)
        readings, drives = change.gain[:n, :n], change.gain[n : n + forces, n : n + forces]
        if change.gain[:n, n:].any() or change.gain[n:, :n].any():
            return None
        key = readings.tobytes() + np.array([change.time, id(stated)]).tobytes()
        if key not in self._reread:
            self._reread[key] = stated.reread(readings, change.time)
        found = self._reread[key]
        if np.array_equal(drives, np.eye(forces)):
            return found
        # Joint drives are linear in the forces, so the forces give their changes.
        into = self._by_force @ drives @ np.linalg.pinv(self._by_force)
        return replace(found, drives=found.drives @ into.T)

    def _hold(
        self, corrections: Sequence[Correction], stated: Comparison
    ) -> tuple[Comparison, Mounting, list[Drive]] | None:
        self.tested += 1
        change = hypotheses.combine(self.signals, corrections)
        compared = self._compare(change, stated)
        if compared is None:
            return None
        n = len(self.signals.axes)
        gravity = np.array(change.gravity or compared.robot.gravity)
        mounting = Mounting(np.ones(n), change.offset[:n], gravity, change.gravity is not None)
        with np.errstate(all="ignore"):
            drives = compared.hold(mounting, drawn_bodies.STATED)
        if not np.isfinite([drive.left for drive in drives]).all():
            return None
        return compared, mounting, drives

    def judge(self, corrections: Corrections) -> Plausibility | None:
        held = self._hold(corrections, self.stated)
        if held is None:
            return None
        compared, _, drives = held
        assert compared.used is not None
        unsure = max(compared.robot.uncertainty, _UNSURE)
        shares = np.array([drive.share if drive.is_sure else 1.0 for drive in drives])
        off = np.log(np.maximum(np.abs(shares), 1e-300)) / unsure
        off[[drive.is_contradicted for drive in drives]] = FARTHEST
        error = np.sqrt([drive.left for drive in drives])
        objections = 0.5 * np.minimum(off**2, FARTHEST**2)
        return Plausibility(error, compared.used.mean(axis=0), self.system.prior, objections)
