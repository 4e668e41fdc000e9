"""A model fitted to the trials of a session, and its residual linearised there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bampipe.arrays import Array, Flags
from bampipe.estimate.least_squares import (
    KnownSlopes,
    Problem,
    as_measured,
    minimise,
    stacked_residual,
)
from bampipe.estimate.low_pass import Band
from bampipe.estimate.normal_equations import NormalEquations
from bampipe.estimate.standstill import find_moving_samples
from bampipe.physics import System
from bampipe.trials.folds import Folds
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import ModelOnTrial, problem_of
from bampipe.trials.scale import log_scale, slopes_by_force

_CONVERGED = 1e-8
"""Change of the negative log likelihood a sample at which a fit ends: a hundredth of a
standard deviation of a parameter over ten thousand samples, and no digit of an error."""


@dataclass(frozen=True)
class Evidence:
    """Residuals of one model on the trials of one session, linearised at its least-squares fit.

    Attributes:
        p: parameters at which it is linearised, (n_p,).
        fitted: the model with these parameters on each of the trials.
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
        factors: by which parameters multiply the measured force of each axis, (n_q,), as a torque
            constant does a current; nothing where none does.
    """

    system: System
    p: Array
    motions: Sequence[Motion]
    fitted: tuple[ModelOnTrial, ...]
    band: Band
    folds: Folds
    residual: tuple[Array, ...]
    jacobian: tuple[Array, ...]
    used: tuple[Flags, ...]
    free: tuple[int, ...]
    lower: Array
    upper: Array
    precision: Array
    known: Array
    by_timing: tuple[Array, ...] = ()
    timing: tuple[float, float] = (0.0, 0.0)
    factors: tuple[float, ...] = ()

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
    def slopes(self) -> list[Array]:
        """By trial, `jacobian` and, where the timing is open, `by_timing` behind it, (K, n_q, n).

        Joined anew each time: kept, it would double the memory that an evidence takes.
        """
        if not self.by_timing:
            return list(self.jacobian)
        pairs = zip(self.jacobian, self.by_timing, strict=True)
        return [np.append(x, by[:, :, None], axis=2) for x, by in pairs]

    @cached_property
    def slopes_by_force(self) -> tuple[Array, ...]:
        """What `scale.slopes_by_force` returns of the model, by trial, each (K, n_q, n_forces)."""
        each = slopes_by_force(self.system, self.motions, self.band, [self.p])
        return tuple(slope[..., 0] for slope in each)

    @cached_property
    def log_scale(self) -> tuple[Array, Array]:
        """Mean log of what the effects leave of the measured quantity, and its slopes.

        See `scale.log_scale`, (n_q,) and (n_q, n), by the same parameters as `slopes`.
        """
        value, slopes = log_scale(
            self.system, self.motions, self.band, self.used, self.p, self.free, self.slopes_by_force
        )
        return value, np.pad(slopes, ((0, 0), (0, 1 if self.by_timing else 0)))

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

    def rmse(self) -> Array:
        """Root mean square of the residual by axis over all trials, (n_q,), N.m or N."""
        count = np.maximum(self.sums.count.sum(axis=0), 1.0)
        return np.asarray(np.sqrt(self.sums.yy.sum(axis=0) / count))


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
        start: parameters to start from, (n_p,).
        like: a model with some more effects or some less, where that has been fitted: slopes that
            are the same for both are taken from it.
        timing: least and largest change of the inputs' timing, s, that may be weighed beside it.

    Raises:
        ValueError: fewer samples than parameters, where steps are to be taken.
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
        _factors(problem, found.p, len(system.coordinates)),
    )


def _factors(problem: Problem, p: Array, axes: int) -> tuple[float, ...]:
    """`Evidence.factors`."""
    if problem.multiplied is None:
        return ()
    found = np.ones(axes)
    for place, axis in zip(problem.free, problem.multiplied, strict=True):
        if axis >= 0:
            found[axis] = max(abs(p[place]), 1e-300)
    return tuple(found.tolist())


def _slopes_by_timing(
    fitted: Sequence[ModelOnTrial],
    band: Band,
    used: Sequence[Flags],
    timing: tuple[float, float],
) -> tuple[Array, ...]:
    """`Evidence.by_timing`; nothing where the timing is not open, or a delay has its place."""
    step = 0.25 * (timing[1] - timing[0])
    system = fitted[0].system
    if step == 0.0 or system.takes_timing:
        return ()

    def slope(base: ModelOnTrial) -> Array:
        late, early = (
            ModelOnTrial(system, base.p, [base.motion.with_input_timing(by)]).residual
            for by in (step, -step)
        )
        return np.asarray((late - early) / (2.0 * step))

    thin = band.thin_trials(map(slope, fitted), range(len(system.coordinates)))
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
