"""The residual of a model on trials, low-passed as a whole and thinned.

Velocities from encoders are low-passed, forces are not: comparing them raw misses effects near
standstill and invents delays. So the residual as a whole, including the sign of the velocity, goes
through one low-pass before anything is fitted, and is thinned to nearly independent samples.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.optimize import linear_sum_assignment

from bampipe.arrays import Array, Flags, Indices
from bampipe.errors import InputError
from bampipe.estimate.bounded import invert_scaled
from bampipe.estimate.least_squares import (
    Problem,
    Stacked,
    as_measured,
    minimise,
    stacked_residual,
)
from bampipe.estimate.low_pass import Band
from bampipe.estimate.normal_equations import NormalEquations
from bampipe.estimate.standstill import find_standstill, find_turns
from bampipe.physics import System
from bampipe.trials.kept import KeptItems
from bampipe.trials.motion import Motion


def problem_of(
    system: System,
    motions: Sequence[Motion],
    band: Band,
    *,
    held: Sequence[str] = (),
    timing: bool = False,
    turning: bool = True,
) -> Problem:
    """Return the inverse dynamics of ``motions`` as a least-squares problem.

    Its parameters are those of the model, followed by the input delay, s, within half a sample,
    which is estimated with ``timing``. Parameters in ``held`` are not estimated. Without
    ``turning``, samples near reversals do not count.
    """
    n = len(system.parameters)
    by_offset, by_body = list(system.moved_by), list(system.of_bodies)

    # Few parameters change the motion of the mechanism or the forces of its bodies: cache both.
    @lru_cache(maxsize=2)
    def move(trial: int, late_s: float, offset: tuple[float, ...]) -> Motion:
        motion, p = motions[trial].with_input_timing(late_s), system.prior
        p[by_offset] = offset
        return motion.of_mechanism(system, motion.inputs(system.inputs), p)

    @lru_cache(maxsize=2)
    def bodies(trial: int, late_s: float, offset: tuple[float, ...], *own: float) -> Array:
        p = system.prior
        p[by_body] = own
        return system.body_forces(*move(trial, late_s, offset).kinematics, p)

    def left_out(trial: int) -> Flags:
        each, rate = motions[trial].split(), band.rate_hz
        still = np.concatenate([standstill_of(m, system, rate) for m in each])
        return still if turning else still | np.concatenate([find_turns(m.qd, rate) for m in each])

    def residual(trial: int, p: Array) -> Array:
        place = trial, float(p[n]), tuple(p[by_offset])
        motion, forces = move(*place), bodies(*place, *p[by_body])
        at, u, z = motion.kinematics, motion.inputs(system.inputs), motion.memory(system, p[:n])
        return system.residual(*at, z, u, p[:n], forces)

    def slopes(trial: int, p: Array) -> tuple[list[int], Array]:
        given = [k for k, i in enumerate(free) if i in system.lasting]
        if not given:
            return given, np.empty((len(motions[trial].q), len(system.coordinates), 0))
        motion = move(trial, float(p[n]), tuple(p[by_offset]))
        u = motion.inputs(system.inputs)
        return given, system.slopes([free[k] for k in given], *motion.kinematics, u)

    parameters = system.parameters
    free = [i for i, item in enumerate(parameters) if not item.fixed and item.name not in held]
    lower = [parameters[i].lower for i in free]
    upper = [parameters[i].upper for i in free]
    # The instant of an impact is strongly nonlinear in its parameters: use a wide secant.
    contact = {q.name for e in system.model.effects if e.effect.has_play for q in e.parameters}
    step = [
        1.0
        if system.linear[i]
        else (3e-2 if parameters[i].name in contact else 1e-4)
        * max(abs(parameters[i].prior), parameters[i].sd, np.finfo(float).tiny)
        for i in free
    ]
    known = [parameters[i].prior for i in free]
    precision = [1.0 / parameters[i].sd ** 2 if parameters[i].weighed else 0.0 for i in free]
    multiplied = _multiplied(system, free)
    linear = system.is_linear_in(free)
    if timing:
        half = 0.5 / band.rate_hz
        # A model that is linearised once needs the secant over the whole range; one that is
        # linearised repeatedly needs the tangent, or its descent stops short of the minimum.
        apart = half if linear else 0.05 * half
        precision, known = [*precision, 0.0], [*known, 0.0]
        free, lower, upper, step = [*free, n], [*lower, -half], [*upper, half], [*step, apart]
        multiplied = None if multiplied is None else np.append(multiplied, -1)
    return Problem(
        residual=residual,
        n_trials=len(motions),
        free=np.array(free, dtype=np.int64),
        lower=np.array(lower),
        upper=np.array(upper),
        step=np.array(step),
        linear=linear,
        band=band,
        standstill=KeptItems(map(left_out, range(len(motions)))),
        precision=np.array(precision),
        known=np.array(known),
        slopes=slopes,
        multiplied=multiplied,
        parts=lambda trial: motions[trial].parts,
        keep=KeptItems,
    )


def find_robot_timing(
    system: System, motions: Sequence[Motion], band: Band, p: Array
) -> tuple[float, float]:
    """Delay of the sampling of a robot's inputs behind its positions, and its sd, s.

    One clock reads all drives, so the delay is the median over the joints: in a common fit, one
    drive that acts late would move the delay, and with it all other joints. Samples near reversals
    do not count: friction that truly stops a joint appears milliseconds late there, and would
    outweigh the rest of the path. Nor do joints whose drive has a delay of its own in the model.

    The residual is linearised at the fitted parameters ``p`` (n_p,). If no joint determines the
    delay, the result is zero and infinity.
    """
    problem = problem_of(system, motions, band, timing=True, turning=False)
    at = np.append(p, 0.0)
    stacked = [stacked_residual(problem, trial, at) for trial in range(len(motions))]
    slopes = [each.slope for each in as_measured(problem, at, stacked)]
    own, axes = problem.free.size - 1, range(len(system.coordinates))
    # Replace the column of the common delay by one for each joint.
    split = [
        np.concatenate([slope[:, :, :own], slope[:, :, own:] * np.eye(len(axes))], axis=2)
        for slope in slopes
    ]
    sums = NormalEquations.from_samples(
        split, [each.residual for each in stacked], [each.used for each in stacked],
        problem.precision[:own], problem.known[:own] - at[problem.free[:own]],
    )  # fmt: skip
    anywhere = np.full(len(axes), np.inf)
    lower = np.append(problem.lower[:own] - at[problem.free[:own]], -anywhere)
    upper = np.append(problem.upper[:own] - at[problem.free[:own]], anywhere)
    weight = 1.0 / np.maximum(sums.mean_square(np.zeros(lower.size)), 1e-24)
    step = sums.solve(weight, lower, upper)
    weight = band.independent_share / np.maximum(sums.mean_square(step), 1e-24)
    normal = np.tensordot(weight, sums.xx.sum(axis=0), 1) + np.diag(sums.precision)
    late = sums.solve(weight, lower, upper)[own:]
    variance = np.diag(invert_scaled(normal))[own:]
    determined = np.flatnonzero((variance > 0.0) & (variance < problem.upper[-1] ** 2))
    if not determined.size:
        return 0.0, np.inf
    count = determined.size
    middle = determined[np.argsort(late[determined])][(count - 1) // 2 : count // 2 + 1]
    chosen = middle[np.argmin(np.abs(late[middle]))]
    return float(late[chosen]), float(np.sqrt(variance[chosen]))


def fit_device(
    system: System, motions: Sequence[Motion], band: Band, fitted: Sequence[int]
) -> tuple[Problem, Array, list[Stacked]] | None:
    """Fit a bare device to the trials numbered ``fitted``.

    Returns:
        The problem, the parameters (n_p + 1,), and residual and slopes of every trial there; None
        if it cannot be fitted.
    """
    problem = problem_of(system, motions, band)
    try:
        found = minimise(problem, np.append(system.prior, 0.0), fitted, 12, tolerance=1e-6)
    except (ValueError, InputError):
        return None
    known = dict(zip(fitted, found.stacked, strict=True))
    order = range(len(motions))
    return problem, found.p, [known.get(k) or stacked_residual(problem, k, found.p) for k in order]


def _multiplied(system: System, free: Sequence[int]) -> Indices | None:
    """Axis whose input each free parameter multiplies, (n_free,), like a robot's torque constants.

    A motor that moves several joints is assigned to one of them. None if there is no such
    parameter.
    """
    if system.model.device.robot is None:
        return None
    q = np.zeros((1, len(system.coordinates)))
    gains = system.input_map(q)[0]
    found = np.full(len(free), -1, dtype=np.int64)
    rows, columns = linear_sum_assignment(-(np.abs(gains) > 0.0).astype(float))
    axes = dict(zip(columns.tolist(), rows.tolist(), strict=True))
    for k, number in enumerate(free):
        if number in system.of_bodies:
            continue
        p = system.prior.copy()
        p[number] = 2.0 * p[number] or 1.0
        moved = np.flatnonzero(np.any(system.input_map(q, None, p)[0] != gains, axis=0))
        if len(moved) == 1:
            found[k] = axes[int(moved[0])]
    return found if np.any(found >= 0) else None


def standstill_of(motion: Motion, system: System, rate_hz: float) -> Flags:
    """Samples at standstill or left out, (T, n_q).

    A replicate leaves out the same samples as its trial. Otherwise, where the machine rests just
    long enough to be left out and the replicate does not, the load that friction balances would
    appear as an error.
    """
    u = motion.inputs(system.inputs)
    brakes = [system.model.device.brakes.get(axis) for axis in system.coordinates]
    braked = [
        name in system.inputs and bool(u[:, system.inputs.index(name)].any()) for name in brakes
    ]
    still = find_standstill(motion.qd, motion.qd_sd, rate_hz, np.array(braked))
    return still if motion.left_out is None else still | motion.left_out


def applied_rms(
    system: System, motions: Sequence[Motion], band: Band, p: Array, used: Sequence[Flags]
) -> Array:
    """Root mean square of the applied force by axis, low-passed like the residual, (n_q,).

    ``p`` are parameters (n_p,); the samples ``used`` (K, n_q) of each trial count.
    """
    return rms((band.thin(ModelOnTrial(system, p, [m]).applied) for m in motions), used)


def rms(values: Iterable[Array], used: Iterable[Flags]) -> Array:
    """Root mean square by axis, (n_q,), of values (K, n_q) by trial over the samples that count."""
    square, count = np.zeros(1), np.zeros(1)
    for each, keep in zip(values, used, strict=True):
        square, count = square + np.sum(each**2 * keep, axis=0), count + keep.sum(axis=0)
    return np.asarray(np.sqrt(square / np.maximum(count, 1.0)))


@dataclass(frozen=True)
class ModelOnTrial:
    """A model with given parameters on one trial; its properties are computed on first access.

    Attributes:
        system: the model; p: its parameters, (n_p,).
        motions: the trials; trial: the number of this one.
    """

    system: System
    p: Array
    motions: Sequence[Motion]
    trial: int = 0

    @property
    def motion(self) -> Motion:
        """The trial, read on each access: a long session is not all in memory."""
        return self.motions[self.trial]

    @property
    def inputs(self) -> Array:
        """The model's inputs, (T, n_u)."""
        return self.motion.inputs(self.system.inputs)

    @property
    def mechanism(self) -> Motion:
        """The motion of the mechanism, which the model may distinguish from the readings."""
        return self._moved if self.system.moves_sensors else self.motion

    @cached_property
    def _moved(self) -> Motion:
        return self.motion.of_mechanism(self.system, self.inputs, self.p)

    @cached_property
    def memory(self) -> Array:
        """Internal states, (T, n_z)."""
        return self.mechanism.memory(self.system, self.p)

    @property
    def _arguments(self) -> tuple[Array, ...]:
        return (*self.mechanism.kinematics, self.memory, self.inputs, self.p)

    @cached_property
    def residual(self) -> Array:
        """The residual before the low-pass, (T, n_q), N.m or N."""
        return self.system.residual(*self._arguments)

    @property
    def applied(self) -> Array:
        """Generalised force of the measured input, before the low-pass, (T, n_q), N.m or N."""
        return self.system.applied(*self._arguments)

    @property
    def residual_once(self) -> Array:
        """`residual` by functions that need no compilation, for a model that is seen only once."""
        return self.applied - self.system.required(*self._arguments)

    @cached_property
    def contribution(self) -> Array:
        """Contribution of the effects to the residual, see `System.contribution`, (T, n_q)."""
        return self.system.contribution(*self._arguments)
