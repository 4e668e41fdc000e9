"""The residual of a model on trials: both sides of the equation filtered alike, by trial.

Velocities from encoders are low-passed, forces are not. Comparing them raw misses effects near
standstill and invents delays; so the residual as a whole, the sign of the velocity in it included,
goes through one low-pass before anything is fitted, and is thinned to what that leaves independent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from bampipe.estimate.least_squares import (
    KnownSlopes,
    Problem,
    Stacked,
    as_measured,
    minimise,
    stacked_residual,
)
from bampipe.estimate.low_pass import Band
from bampipe.estimate.normal_equations import NormalEquations
from bampipe.estimate.standstill import find_moving_samples, find_standstill, find_turns
from bampipe.physics import System
from bampipe.trials.cache import TrialCache
from bampipe.trials.folds import Folds
from bampipe.trials.motion import Motion

Array = NDArray[np.float64]
Found = TypeVar("Found")

_REFITS = 6
"""Most Gauss-Newton steps of a refit that starts at the fit to all trials."""
_CONVERGED = 1e-8
"""Change of the negative log likelihood a sample at which a fit or refit ends: a hundredth of a
standard deviation of a parameter over ten thousand samples, and no digit of an error."""


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

    Its parameters are the model's, then the time by which the inputs were sampled after the
    positions, s, within half a sample.

    Args:
        system: the model; motions: the trials; band: the low-pass of the residual.
        held: parameters that are not estimated, beside those that the model fixes.
        timing: whether that time is estimated; else it stays as given.
        turning: whether samples count in which an axis turns round.
    """
    n = len(system.parameters)
    # Of differences by many parameters few change the internal states or the bodies' forces.
    states = _Remembered[Array](
        [i for i, linear in enumerate((*system.linear, False)) if not linear]
    )
    bodies = _Remembered[Array](range(n + 1) if system.moves_sensors else sorted(system.of_bodies))
    moved = _Remembered[tuple[Array, Array, Array]]([*system.moved_by, n])

    def mechanism(trial: int, motion: Motion, u: Array, p: Array) -> tuple[Array, Array, Array]:
        return moved.find(trial, p, lambda: motion.of_mechanism(system, u, p[:n]).kinematics)

    def inputs_at(motion: Motion, p: Array) -> Array:
        return motion.timed_inputs(system.inputs, float(p[n]))

    def left_out(trial: int) -> NDArray[np.bool_]:
        still = standstill_of(motions[trial], system, band.rate_hz)
        return still if turning else still | find_turns(motions[trial].qd, band.rate_hz)

    def residual(trial: int, p: Array) -> Array:
        motion = motions[trial]
        u = inputs_at(motion, p)
        true = mechanism(trial, motion, u, p)
        z = states.find(trial, p, lambda: system.memory(*true, u, p[:n], motion.t))
        forces = bodies.find(trial, p, lambda: system.body_forces(*true, p[:n]))
        return system.residual(*true, z, u, p[:n], forces)

    def slopes(trial: int, p: Array, wanted: Sequence[int]) -> tuple[list[int], Array]:
        numbers = [free[k] for k in wanted]
        given = [k for k, i in enumerate(numbers) if i in system.lasting]
        motion = motions[trial]
        if not given:
            return given, np.empty((len(motion.q), len(system.coordinates), 0))
        u = inputs_at(motion, p)
        true = mechanism(trial, motion, u, p)
        return given, system.slopes([numbers[k] for k in given], *true, u)

    parameters = system.parameters
    free = [i for i, item in enumerate(parameters) if not item.fixed and item.name not in held]
    lower = [parameters[i].lower for i in free]
    upper = [parameters[i].upper for i in free]
    step = [
        1.0
        if system.linear[i]
        else 1e-4 * max(abs(parameters[i].prior), parameters[i].sd, np.finfo(float).tiny)
        for i in free
    ]
    weighed = [parameters[i].weighed for i in free]
    known = [parameters[i].prior for i in free]
    precision = [
        1.0 / parameters[i].sd ** 2 if counts else 0.0
        for i, counts in zip(free, weighed, strict=True)
    ]
    # Moved in time, inputs change the slopes that they are part of.
    constant = system.unforced if timing else system.constant
    same = [constant[i] and not system.moves_sensors for i in free]
    multiplied = _multiplied(system, free)
    if multiplied is not None:  # as measured, their slopes change with the residual
        same = [constant and axis < 0 for constant, axis in zip(same, multiplied, strict=True)]
    linear = system.is_linear_in(free)
    if timing:
        half = 0.5 / band.rate_hz
        # The secant over all of its range serves a model that is linearised once; one that is
        # linearised again and again needs the tangent, or its descent ends short of the minimum.
        apart = half if linear else 0.05 * half
        same = [*same, False]
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
        constant=np.array(same),
        band=band,
        standstill=TrialCache(left_out, len(motions), len),
        precision=np.array(precision),
        known=np.array(known),
        slopes=slopes,
        multiplied=multiplied,
    )


def _multiplied(system: System, free: Sequence[int]) -> NDArray[np.int64] | None:
    """Axes whose inputs free parameters multiply, (n_free,), as torque constants of a robot do.

    A motor that turns several joints is that of one of them. None where there are none.
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


class _Remembered(Generic[Found]):
    """The last values of a function of a trial and of some parameters.

    Attributes:
        uses: numbers of those parameters.
    """

    def __init__(self, uses: Iterable[int]) -> None:
        self.uses = list(uses)
        self._known: dict[tuple[int, bytes], Found] = {}

    def find(self, trial: int, p: Array, compute: Callable[[], Found]) -> Found:
        """The value for parameters ``p``, (n_p,), computed where it is not known."""
        key = trial, p[self.uses].tobytes()
        if key not in self._known:
            if any(other != trial for other, _ in self._known) or len(self._known) > 1:
                self._known.clear()
            self._known[key] = compute()
        return self._known[key]


def standstill_of(motion: Motion, system: System, rate_hz: float) -> NDArray[np.bool_]:
    """Which samples stand still, (T, n_q).

    Or are left out. A replay leaves out what the trial does as well: where the machine rests for
    just long enough and the replay for just not, the load that friction balances would pass for an
    error.
    """
    u = motion.inputs(system.inputs)
    brakes = [system.model.device.brakes.get(axis) for axis in system.coordinates]
    braked = [
        name in system.inputs and bool(u[:, system.inputs.index(name)].any()) for name in brakes
    ]
    still = find_standstill(motion.qd, motion.qd_sd, rate_hz, np.array(braked))
    return still if motion.left_out is None else still | motion.left_out


def residual_and_memory(system: System, motion: Motion, u: Array, p: Array) -> tuple[Array, Array]:
    """Residual (T, n_q) of a trial under inputs ``u`` (T, n_u), unfiltered, and states (T, n_z)."""
    at = motion.of_mechanism(system, u, p).kinematics
    z = system.memory(*at, u, p, motion.t)
    return system.residual(*at, z, u, p), z


def applied_rms(
    system: System,
    motions: Sequence[Motion],
    band: Band,
    p: Array,
    used: Sequence[NDArray[np.bool_]],
) -> Array:
    """Root mean square of the applied force by axis, low-passed as the residual is, (n_q,).

    Args:
        system: the model; motions: the trials; band: the low-pass; p: parameters, (n_p,).
        used: which samples count, by trial, each (K, n_q).
    """
    square, count = np.zeros(len(system.coordinates)), np.zeros(len(system.coordinates))
    for motion, moves in zip(motions, used, strict=True):
        u = motion.inputs(system.inputs)
        at = motion.of_mechanism(system, u, p).kinematics
        z = system.memory(*at, u, p, motion.t)
        applied = band.thin(system.applied(*at, z, u, p))
        square += np.sum(applied**2 * moves, axis=0)
        count += moves.sum(axis=0)
    return np.asarray(np.sqrt(square / np.maximum(count, 1)))


@dataclass(frozen=True)
class ModelOnTrial:
    """A model with given parameters on one trial, computed when it is first asked for.

    Attributes:
        system: the model; p: its parameters, (n_p,).
        motions: the trials; trial: the number of the one.
    """

    system: System
    p: Array
    motions: Sequence[Motion]
    trial: int = 0

    @property
    def motion(self) -> Motion:
        """The trial, fetched anew: of many, not all are in memory."""
        return self.motions[self.trial]

    @property
    def inputs(self) -> Array:
        """The model's inputs, (T, n_u)."""
        return self.motion.inputs(self.system.inputs)

    @property
    def mechanism(self) -> Motion:
        """The trial as the mechanism moved, by the model."""
        if not self.system.moves_sensors:
            return self.motion
        q, qd, qdd = self._moved
        return replace(self.motion, q=q, qd=qd, qdd=qdd)

    @cached_property
    def _moved(self) -> tuple[Array, Array, Array]:
        return self.motion.of_mechanism(self.system, self.inputs, self.p).kinematics

    @cached_property
    def _residual_and_memory(self) -> tuple[Array, Array]:
        return residual_and_memory(self.system, self.motion, self.inputs, self.p)

    @property
    def residual(self) -> Array:
        """The residual before the low-pass, (T, n_q), N.m or N."""
        return self._residual_and_memory[0]

    @property
    def memory(self) -> Array:
        """Internal states, (T, n_z)."""
        return self._residual_and_memory[1]

    @property
    def applied(self) -> Array:
        """Generalised force of the measured input, before the low-pass, (T, n_q), N.m or N."""
        at = self.mechanism.kinematics
        return self.system.applied(*at, self.memory, self.inputs, self.p)

    @cached_property
    def contribution(self) -> Array:
        """What the model's effects add to the residual; see `System.contribution`, (T, n_q)."""
        at = self.mechanism.kinematics
        return self.system.contribution(*at, self.memory, self.inputs, self.p)


@dataclass(frozen=True)
class Evidence:
    """Residuals of one model on the trials of one session, linearised at its least-squares fit.

    Attributes:
        system: the model.
        p: parameters at which it is linearised, (n_p,).
        motions: the trials.
        fitted: the model with these parameters on each of them.
        band: the low-pass.
        folds: which trials were fitted, and which are left out together.
        residual: low-passed and thinned, by trial, each (K, n_q), N.m or N.
        jacobian: derivative of ``residual`` by the free parameters, by trial, (K, n_q, n_free);
            of what is measured where parameters multiply it, see `as_measured`.
        used: which samples count, by trial, (K, n_q), see `standstill`; the others are zero in
            ``residual`` and ``jacobian``.
        free: indices of the parameters that are estimated.
        lower, upper: bounds of their change, (n_free,).
        precision, known: what is known of their change beforehand, (n_free,); see
            `NormalEquations`.
        by_timing: derivative of ``residual`` by the time by which inputs were sampled after
            positions, by trial, (K, n_q), N.m/s or N/s; nothing where that is not open.
        timing: least and largest change of that time, s.
    """

    system: System
    p: Array
    motions: Sequence[Motion]
    fitted: tuple[ModelOnTrial, ...]
    band: Band
    folds: Folds
    residual: tuple[Array, ...]
    jacobian: tuple[Array, ...]
    used: tuple[NDArray[np.bool_], ...]
    free: tuple[int, ...]
    lower: Array
    upper: Array
    precision: Array
    known: Array
    by_timing: tuple[Array, ...] = ()
    timing: tuple[float, float] = (0.0, 0.0)

    def subset(self, trials: Sequence[int]) -> Evidence:
        """The same on some trials, given by number, linearised where it is."""
        return replace(
            self,
            motions=[self.motions[k] for k in trials],
            fitted=tuple(self.fitted[k] for k in trials),
            folds=self.folds.subset(trials),
            residual=tuple(self.residual[k] for k in trials),
            jacobian=tuple(self.jacobian[k] for k in trials),
            used=tuple(self.used[k] for k in trials),
            by_timing=tuple(self.by_timing[k] for k in trials if self.by_timing),
        )

    @property
    def sizes(self) -> list[int]:
        """Samples of each trial that its residual stands for."""
        return [len(residual) * self.band.step for residual in self.residual]

    @cached_property
    def sums(self) -> NormalEquations:
        """Sums of products of the linearised residual."""
        return NormalEquations.from_samples(
            self.jacobian, self.residual, self.used, self.precision, self.known
        )

    @cached_property
    def weight(self) -> Array:
        """Weight of the squares of each axis: one over the mean square where it was fitted."""
        fitted = self.sums.subset(self.folds.fitted_trials)
        mean = fitted.yy.sum(axis=0) / np.maximum(fitted.count.sum(axis=0), 1.0)
        return np.asarray(1.0 / np.maximum(mean, 1e-24))

    @cached_property
    def applied_rms(self) -> Array:
        """Root mean square of the applied force by axis; see `applied_rms`, (n_q,), N.m or N."""
        return applied_rms(self.system, self.motions, self.band, self.p, self.used)

    def rmse(self) -> Array:
        """Root mean square of the residual by axis over all trials, (n_q,), N.m or N."""
        count = np.maximum(self.sums.count.sum(axis=0), 1.0)
        return np.asarray(np.sqrt(self.sums.yy.sum(axis=0) / count))

    @cached_property
    def held_out_steps(self) -> tuple[Array, ...]:
        """Change of the free parameters when the trials of a group are left out, by trial.

        By the normal equations at the fit to all where the model is linear in its parameters; by
        refits from there where it is not: a Gauss-Newton step alone leads shapes astray.
        """
        if self.is_linear or self.folds.nothing_held_out:
            return self.folds.solve(self.sums, self.weight, self.lower, self.upper)
        problem = problem_of(self.system, self.motions, self.band)
        start, free = np.append(self.p, 0.0), list(self.free)
        steps: dict[int, Array] = {}
        for group in sorted(set(self.folds.groups)):
            others = [k for k in self.folds.fitted_trials if self.folds.groups[k] != group]
            steps[group] = np.zeros(len(free))
            if len(others) < len(self.folds.fitted_trials):
                here = [Stacked(self.residual[k], self.jacobian[k], self.used[k]) for k in others]
                refit = minimise(
                    problem, start, others, _REFITS, tolerance=_CONVERGED,
                    at_start=here if problem.multiplied is None else None,
                )  # fmt: skip
                steps[group] = refit.p[free] - self.p[free]
        return tuple(steps[group] for group in self.folds.groups)

    @cached_property
    def held_out_rmse(self) -> Array:
        """Error on trials that the parameters have not seen, (n_q,), N.m or N.

        See `held_out_steps` for the parameters without each group of trials.
        """
        if self.is_linear:
            return self.folds.error(self.sums, self.held_out_steps)
        judged = [k for k, counts in enumerate(self.folds.judged) if counts]
        squares = sum(np.sum(self.held_out_residual(k) ** 2, axis=0) for k in judged)
        count = self.sums.count[judged].sum(axis=0)
        return np.asarray(np.sqrt(squares / np.maximum(count, 1.0)))

    @property
    def is_linear(self) -> bool:
        """Whether the residual is linear in all free parameters together."""
        return self.system.is_linear_in(self.free)

    def held_out_residual(self, trial: int) -> Array:
        """The residual of a trial with parameters that have not seen it, (K, n_q)."""
        if trial not in self._held_out:
            step = self.held_out_steps[trial]
            if self.is_linear or not step.any():
                found = self.residual[trial] + self.jacobian[trial] @ step
            else:
                unfiltered = self.unfiltered_residual(trial, self.held_out_parameters(trial))
                found = self.band.thin(unfiltered) * self.used[trial]
            self._held_out[trial] = found
        return self._held_out[trial]

    @cached_property
    def _held_out(self) -> dict[int, Array]:
        return {}

    def held_out_parameters(self, trial: int) -> Array:
        """Those parameters, (n_p,)."""
        p = self.p.copy()
        p[list(self.free)] += self.held_out_steps[trial]
        return p

    def unfiltered_residual(self, trial: int, p: Array) -> Array:
        """The residual of a trial with parameters ``p``, (n_p,), before the low-pass, (T, n_q)."""
        return ModelOnTrial(self.system, p, self.motions, trial).residual


def gather_evidence(
    system: System,
    motions: Sequence[Motion],
    band: Band,
    start: Array,
    folds: Folds,
    *,
    most_iterations: int = 12,
    like: Evidence | None = None,
    timing: tuple[float, float] = (0.0, 0.0),
) -> Evidence:
    """Fit a model to the fitted trials by least squares and linearise it there on all.

    Args:
        system: the model; motions: the trials; band: the low-pass.
        start: parameters to start from, (n_p,); folds: which trials are fitted.
        most_iterations: the most Gauss-Newton steps.
        like: a model with some more effects or some less, where that has been fitted: slopes that
            are the same for both are taken from it.
        timing: least and largest change of the inputs' timing, s, that may be weighed beside it.

    Raises:
        ValueError: fewer samples than parameters.
    """
    problem = problem_of(system, motions, band)
    fitted = folds.fitted_trials
    known = None
    if like is not None and like.motions is motions and like.band == band:
        known = _common_slopes(like, system, problem)
    found = minimise(
        problem, np.append(start, 0.0), fitted, most_iterations, known=known, tolerance=_CONVERGED
    )
    stacked = dict(zip(fitted, found.stacked, strict=True))
    for trial in range(len(motions)):
        if trial not in stacked:
            stacked[trial] = stacked_residual(problem, trial, found.p, known)
    value = found.p[problem.free]
    order = range(len(motions))
    measured = as_measured(problem, found.p, [stacked[k] for k in order])
    fitted_trials = tuple(ModelOnTrial(system, found.p[:-1], motions, k) for k in order)
    used = tuple(stacked[k].used for k in order)
    return Evidence(
        system,
        found.p[:-1],
        motions,
        fitted_trials,
        band,
        folds,
        tuple(stacked[k].residual for k in order),
        tuple(s.slope for s in measured),
        used,
        tuple(int(i) for i in problem.free),
        problem.lower - value,
        problem.upper - value,
        problem.precision,
        problem.known - value,
        _slopes_by_timing(fitted_trials, band, used, timing),
        timing,
    )


def _slopes_by_timing(
    fitted: Sequence[ModelOnTrial],
    band: Band,
    used: Sequence[NDArray[np.bool_]],
    timing: tuple[float, float],
) -> tuple[Array, ...]:
    """`Evidence.by_timing`; nothing where the timing is not open, or a delay has its place."""
    step = 0.25 * (timing[1] - timing[0])
    system = fitted[0].system
    if step == 0.0 or system.takes_timing:
        return ()
    rows = []
    for base in fitted:
        late, early = (
            ModelOnTrial(system, base.p, [base.motion.with_input_timing(by)]).residual
            for by in (step, -step)
        )
        rows.append((late - early) / (2.0 * step))
    thin = band.thin_trials(rows, range(len(system.coordinates)))
    return tuple(values * moves for values, moves in zip(thin, used, strict=True))


def _common_slopes(like: Evidence, system: System, problem: Problem) -> KnownSlopes | None:
    """The slopes by parameters that two models share and that are the same for both.

    A slope that no parameter changes is that of the model without any effect. None are where other
    samples stand still for the one than for the other, as where a brake counts.
    """
    still = (find_moving_samples(s, problem.band) for s in problem.standstill)
    if not all(np.array_equal(a, b) for a, b in zip(still, like.used, strict=True)):
        return None
    held = {like.system.parameters[i].name: k for k, i in enumerate(like.free)}
    constant = like.system.constant
    moved = like.system.moves_sensors
    source = [held.get(system.parameters[i].name, -1) for i in problem.free]
    holds = [
        k >= 0 and not moved and constant[like.free[k]] and bool(here)
        for k, here in zip(source, problem.constant, strict=True)
    ]
    places = np.flatnonzero(holds)
    taken = [source[k] for k in places]
    slopes = []
    for jacobian in like.jacobian:
        columns = np.zeros((*jacobian.shape[:2], problem.free.size))
        columns[:, :, places] = jacobian[:, :, taken]
        slopes.append(columns)
    return KnownSlopes(slopes, np.array(holds))
