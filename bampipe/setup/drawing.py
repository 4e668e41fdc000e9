"""What a robot's set-up explains with bodies as they are drawn.

Bodies that are free take on much of a mistake: with a reversed drive they come out turned over,
within what is not known of them, and little is left. Drawn bodies cannot.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain, product

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.heavier_body import HeavierBody, find_heavier_body
from bampipe.estimate.low_pass import Band
from bampipe.estimate.standstill import find_moving_samples
from bampipe.physics import System
from bampipe.physics.robot import Robot
from bampipe.setup.corrections import (
    Correction,
    encoder_sign_corrections,
    exchange_corrections,
    gravity_corrections,
    quarter_turn_pairs,
    quarter_turns,
    sign_corrections,
    unit_corrections,
)
from bampipe.setup.finding import MOST_MISTAKES, Finding, Tried, choose, is_explained
from bampipe.setup.plausibility import Plausibility
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import standstill_of
from bampipe.trials.signals import Change, Signals

Array = NDArray[np.float64]

_FARTHEST_SCALE = 3.0
"""How many times heavier or lighter than drawn what hangs on a joint may be."""
_TURNING = 0.02
"""Of the largest velocity: width of its sign."""
_RIDGE = 1e-9


SUSPICIOUS_DRAWN = 0.15
"""Error with bodies as drawn from which other set-ups are tried with these: two joints exchanged
leave 0.26 at least. A gain then decides, as elsewhere."""


@dataclass
class DrawnSearch:
    """Tries set-ups with bodies as drawn.

    Attributes:
        system: the bare device; motions: the trials as they are stated, short enough.
        band: of the residual; signals: of the session.
        heavier: the body that is heavier than drawn.
        tested: number of set-ups tried.
    """

    system: System
    motions: Sequence[Motion]
    band: Band
    signals: Signals
    heavier: HeavierBody | None = None
    tested: int = field(default=0, init=False)

    @property
    def robot(self) -> Robot:
        """Whose bodies are drawn."""
        return drawn_robot(self.system)

    def find_mistakes(self, exchanged: bool) -> tuple[Finding, ...]:
        """The mistakes of the set-up, the one that spoils most first; none if one is left over.

        Args:
            exchanged: whether columns may be exchanged, or single ones be in another unit.
        """
        change, found = Change.none(len(self.signals.names)), list[Finding]()
        before = self._judge(change)
        while before is not None and (found or before.worst_error > SUSPICIOUS_DRAWN):
            step = self._best(change, before, exchanged)
            if not step or len(found) + len(step) > MOST_MISTAKES:
                break
            found += step
            for finding in step:
                change = finding.correction.change.after(change)
            before = step[0].after
        explained = before is not None and all(is_explained(f, before) for f in found)
        return tuple(found) if explained else ()

    def _best(self, change: Change, before: Plausibility, exchanged: bool) -> list[Finding]:
        """The mistake whose correction gains most, or two: one right and one not may be worse."""
        singles = self._try_all(change, [(one,) for one in self._singles(exchanged)])
        best = choose(before, singles, drawn=True)
        if not best or best[0].after.worst_error > SUSPICIOUS_DRAWN:
            mounted = product(
                gravity_corrections(self.signals, self.robot),
                encoder_sign_corrections(self.signals),
            )
            pairs = self._try_all(change, chain(quarter_turn_pairs(self.signals), mounted))
            best = choose(before, [*singles, *pairs], drawn=True)
        return best

    def _singles(self, exchanged: bool) -> Iterator[Correction]:
        yield from sign_corrections(self.signals)
        yield from quarter_turns(self.signals)
        yield from gravity_corrections(self.signals, self.robot)
        if exchanged:
            yield from exchange_corrections(self.signals)
            yield from unit_corrections(self.signals)

    def _try_all(self, change: Change, options: Iterable[tuple[Correction, ...]]) -> list[Tried]:
        found = []
        for option in options:
            changed = change
            for correction in option:
                changed = correction.change.after(changed)
            after = self._judge(changed)
            found += [Tried(option, after)] if after is not None else []
        return found

    def _judge(self, change: Change) -> Plausibility | None:
        self.tested += 1
        with np.errstate(all="ignore"):
            changed = [change.of_motion(motion, self.signals) for motion in self.motions]
        added = np.array(change.gravity or self.robot.gravity) - self.robot.gravity
        band = change.of_band(self.band)
        return judge_drawn(self.system, changed, band, added, self.heavier)


def drawn_robot(system: System) -> Robot:
    """The robot of a device that is one."""
    robot = system.model.device.robot
    assert robot is not None
    return robot


def find_body_unlike_drawn(
    system: System, motions: Sequence[Motion], band: Band
) -> HeavierBody | None:
    """The body that alone is far heavier than drawn, as all drives have it."""
    robot, n = drawn_robot(system), len(system.coordinates)
    if system.model.device.force_unit == "A":
        return None
    drives: list[list[Array]] = [[] for _ in range(n)]
    bodies: list[list[Array]] = [[] for _ in range(n)]
    with np.errstate(all="ignore"):
        for motion in motions:
            columns, applied, used = _columns(system, motion, band)
            each = [
                band.thin(robot.drawn_forces(*motion.kinematics, np.array(robot.gravity), only=k))
                for k in range(len(robot.joints))
            ]
            forces = np.stack(each, axis=2)
            beside = applied - columns[:, :, 0] + forces.sum(axis=2)
            if not (np.isfinite(columns).all() and np.isfinite(beside).all()):
                return None
            for k in range(n):
                rows, lost = used[:, k], columns[used[:, k], k, 1:]
                drives[k].append(_without(lost, beside[rows, k]))
                bodies[k].append(_without(lost, forces[rows, k]))
    return find_heavier_body(
        [np.concatenate(parts) for parts in drives], [np.concatenate(parts) for parts in bodies]
    )


def _without(columns: Array, target: Array) -> Array:
    """What columns (K, m) leave of a target, (K,) or (K, p)."""
    return np.asarray(target - columns @ _fitted(columns, target))


def is_drawn(system: System) -> bool:
    """Whether a device is a robot whose bodies are known from a drawing."""
    return system.model.device.robot is not None and bool(_bodies(system))


def judge_drawn(
    system: System,
    motions: Sequence[Motion],
    band: Band,
    added: Array,
    heavier: HeavierBody | None = None,
) -> Plausibility | None:
    """What bodies as drawn leave of the applied force; None where it cannot be computed.

    Each axis has besides an inertia and friction of its own, and one factor for its bodies, within
    `_FARTHEST_SCALE`. It has no offset, which is small, and would take on weight of the wrong sign.

    Args:
        system: the bare device; motions: as a set-up has them; band: of the residual.
        added: to gravity as the device file states it, m/s2, (3,).
        heavier: the body that is heavier than drawn.
    """
    n = len(system.coordinates)
    with np.errstate(all="ignore"):
        parts = [_columns(system, motion, band, added, heavier) for motion in motions]
    columns = np.concatenate([part[0] for part in parts])
    applied, used = (np.concatenate([part[i] for part in parts]) for i in (1, 2))
    if not (np.isfinite(columns).all() and np.isfinite(applied).all()):
        return None
    error = np.array(
        [_left(columns[used[:, k], k], applied[used[:, k], k]) for k in range(n)], dtype=float
    )
    none = np.zeros(len(system.parameters))
    return Plausibility(error, used.mean(axis=0), system.prior, none)


def _bodies(system: System) -> list[int]:
    return [i for i, p in enumerate(system.parameters) if p.weighed and not p.fixed and p.sd > 0.0]


def _columns(
    system: System,
    motion: Motion,
    band: Band,
    added: Array | None = None,
    heavier: HeavierBody | None = None,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Columns (K, n_q, m) of a trial, bodies first, the applied force (K, n_q), and what moves."""
    p, known = system.prior, set(_bodies(system))
    for i, item in enumerate(system.parameters):
        if i not in known and not item.fixed:
            p[i] = 0.0
    u = motion.inputs(system.inputs)
    at = motion.kinematics
    z = system.memory(*at, u, p, motion.t)
    required = system.required(*at, z, u, p)
    robot = drawn_robot(system)
    gravity = np.array(robot.gravity)
    if added is not None and added.any():
        still = np.zeros_like(motion.q)
        required = required + robot.drawn_forces(motion.q, still, still, added)
        gravity = gravity + added
    if heavier is not None:
        body = robot.drawn_forces(*at, gravity, only=heavier.place)
        required = required + (heavier.factor - 1.0) * body
    shapes = [required, *_drive(motion.qd, motion.qdd)]
    for turns in _shared_motors(system):
        turned = motion.qd @ turns, motion.qdd @ turns
        shapes += _drive(*(np.outer(part, turns != 0.0) for part in turned))
    columns = np.stack([band.thin(shape) for shape in shapes], axis=2)
    applied = band.thin(system.applied(*at, z, u, p))
    used = find_moving_samples(standstill_of(motion, system, band.rate_hz), band)
    return columns, applied, used


def _drive(rate: Array, change: Array) -> list[Array]:
    """Inertia, viscous and dry friction of drives with these rates and accelerations, (T, n_q)."""
    width = np.maximum(_TURNING * np.abs(rate).max(axis=0), np.finfo(float).tiny)
    return [change, rate, np.tanh(rate / width)]


def _shared_motors(system: System) -> list[Array]:
    """Turns by joint, (n_q,), of each motor that turns several: its friction acts on all."""
    robot = system.model.device.robot
    motors = robot.motors.values() if robot is not None else ()
    return [
        np.array([motor.turns.get(axis, 0.0) for axis in system.coordinates])
        for motor in motors
        if len(motor.turns) > 1
    ]


def _left(columns: Array, applied: Array) -> float:
    """Share of the applied force of an axis (K,) that its columns (K, m) leave; 0 without force."""
    size = float(np.sqrt(np.mean(applied**2))) if len(applied) else 0.0
    if size <= 0.0:
        return 0.0
    found = _fitted(columns, applied)
    scale = float(np.clip(found[0], 1.0 / _FARTHEST_SCALE, _FARTHEST_SCALE))
    rest = _without(columns[:, 1:], applied - scale * columns[:, 0])
    return float(np.sqrt(np.mean(rest**2))) / size


def _fitted(columns: Array, target: Array) -> Array:
    scale = np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
    found = np.linalg.lstsq(columns / scale, target, rcond=_RIDGE)[0]
    return np.asarray((found.T / scale).T)
