"""A model fitted to the trials of a session, and its residual linearised there."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bampipe.arrays import Array, Flags
from bampipe.estimate.least_squares import Problem, as_measured, minimise, stacked_residual
from bampipe.estimate.low_pass import Band
from bampipe.estimate.normal_equations import NormalEquations
from bampipe.physics import System
from bampipe.trials.folds import Folds
from bampipe.trials.kept import KeptItems
from bampipe.trials.motion import Motion, join_short, trial_sizes
from bampipe.trials.residuals import ModelOnTrial, problem_of, rms
from bampipe.trials.scale import (
    Spectra,
    find_spectra,
    gain_of_filter,
    log_scale,
    slopes_by_force,
)

_CONVERGED = 1e-8
"""Change of the negative log likelihood per sample at which a fit ends: a hundredth of a
parameter's standard deviation over ten thousand samples."""
_STEP = 0.01
"""Finite-difference step of a filter's strength, relative to it."""


@dataclass(frozen=True)
class Linearisation:
    """Residuals of one model on the trials of one session, linearised at its least-squares fit.

    Attributes:
        p: parameters at which it is linearised, (n_p,).
        joined: the trials, joined into one if they are short; see `join_short`.
        folds: which trials were fitted, and which are left out together.
        residual: low-passed and thinned, by trial, each (K, n_q), N.m or N.
        jacobian: derivative of ``residual`` by the free parameters, by trial, (K, n_q, n_free); of
            the measured quantity if parameters multiply it, see `as_measured`.
        used: which samples count, by trial, (K, n_q), see `standstill`; ``residual`` and
            ``jacobian`` are zero elsewhere.
        free: indices of the estimated parameters.
        lower, upper: bounds of their change, (n_free,).
        precision, known: precision and mean of the prior of their change, (n_free,); see
            `NormalEquations`.
        timing: smallest and largest change of the input delay, s; both zero if it is not fitted.
        factors: absolute parameters that multiply the measured force of each axis, (n_q,), as a
            torque constant multiplies a current; empty if there are none.
    """

    system: System
    p: Array
    motions: Sequence[Motion]
    joined: Sequence[Motion]
    band: Band
    folds: Folds
    residual: Sequence[Array]
    jacobian: Sequence[Array]
    used: Sequence[Flags]
    free: tuple[int, ...]
    lower: Array
    upper: Array
    precision: Array
    known: Array
    timing: tuple[float, float] = (0.0, 0.0)
    factors: tuple[float, ...] = ()

    @property
    def slopes(self) -> Iterable[Array]:
        """By trial, `jacobian`, followed by the column `by_timing` if the delay is fitted.

        They are joined on each access: stored, they would double the memory of an `Linearisation`.
        """
        if not self.by_timing:
            return self.jacobian
        pairs = zip(self.jacobian, self.by_timing, strict=True)
        return (np.append(x, by[:, :, None], axis=2) for x, by in pairs)

    @cached_property
    def fitted(self) -> tuple[ModelOnTrial, ...]:
        """The model on each trial."""
        return _on_each(self.system, self.p, self.motions)

    @cached_property
    def along(self) -> tuple[ModelOnTrial, ...]:
        """The model on `joined`."""
        return _on_each(self.system, self.p, self.joined)

    def thin(self, of: Callable[[ModelOnTrial], Array]) -> list[Array]:
        """Apply a function (T, n_q) to the model on `joined`; low-pass and thin it, by trial."""
        rows = (x[part] for at in self.along for x in [of(at)] for part in at.motion.parts)
        return self.band.thin_trials(rows, range(len(self.system.coordinates)))

    def residual_of(self, system: System, p: Array) -> list[Array]:
        """Residual of a model with the same coordinates, by trial, each (K, n_q), N.m or N."""
        return self.thin(lambda at: ModelOnTrial(system, p, [at.motion]).residual)

    @cached_property
    def by_timing(self) -> tuple[Array, ...]:
        """Derivative of `residual` by the input delay, N.m/s or N/s, by trial, each (K, n_q).

        Empty if the delay is not fitted, or if the model has a delay of its own.
        """
        step = 0.25 * (self.timing[1] - self.timing[0])
        if step == 0.0 or self.system.takes_timing:
            return ()

        def slope(base: ModelOnTrial) -> Array:
            late, early = (
                ModelOnTrial(self.system, self.p, [base.motion.with_input_timing(by)]).residual
                for by in (step, -step)
            )
            return np.asarray((late - early) / (2.0 * step))

        rows = zip(self.thin(slope), self.used, strict=True)
        return tuple(values * moves for values, moves in rows)

    @cached_property
    def slopes_by_force(self) -> tuple[Array, ...]:
        """`scale.slopes_by_force` on `joined` at the fit, each (K, n_q, n_forces)."""
        each = slopes_by_force(self.system, self.joined, self.band, [self.p])
        return tuple(slope[..., 0] for slope in each)

    @cached_property
    def log_scale(self) -> tuple[Array, Array]:
        """Mean log of the fraction of the measured quantity that the effects leave, and its slopes.

        See `scale.log_scale`: (n_q,), and (n_q, n) by the same parameters as `slopes`.
        """
        value, slopes = log_scale(
            self.system, self.joined, self.band, self.used, self.p, self.free,
            self.slopes_by_force if self.system.parameters_by_force else (),
        )  # fmt: skip
        return value, np.pad(slopes, ((0, 0), (0, 1 if self.by_timing else 0)))

    @cached_property
    def filter_gain(self) -> tuple[Array, Array]:
        """Share of the variance of white force noise that passes the model's filters, and slopes.

        Within the band, by axis: (n_q,), and (n_q, n) by the same parameters as `slopes`.
        """
        n_q, strengths = len(self.system.coordinates), self.system.filter_strengths
        gain, slopes = np.ones(n_q), np.zeros((n_q, len(self.free) + (1 if self.by_timing else 0)))
        without = self.p.copy()
        without[strengths] = 0.0
        if (without == self.p).all():
            return gain, slopes
        before = self.spectra_of(self.system, without)
        gain = gain_of_filter(before, self.spectra_of(self.system, self.p), self.band)
        for number in {*strengths} & {*self.free}:
            longer, change = self.p.copy(), max(_STEP * self.p[number], 1e-300)
            longer[number] += change
            there = gain_of_filter(before, self.spectra_of(self.system, longer), self.band)
            slopes[:, self.free.index(number)] = (there - gain) / change
        return gain, slopes

    def spectra_of(self, system: System, p: Array) -> Spectra:
        """Spectra of the force that a model with the same coordinates applies, `find_spectra`."""
        return find_spectra(self.thin(lambda at: ModelOnTrial(system, p, [at.motion]).applied))

    @property
    def sizes(self) -> list[int]:
        """Samples before thinning that the residual of each trial represents."""
        return [len(residual) * self.band.step for residual in self.residual]

    @cached_property
    def sums(self) -> NormalEquations:
        """Sums of products of the linearised residual."""
        return NormalEquations.from_samples(
            self.jacobian, self.residual, self.used, self.precision, self.known
        )

    @cached_property
    def weight(self) -> Array:
        """Weight of the squares of each axis: one over the mean square on the fitted trials."""
        fitted = self.sums.subset(self.folds.fitted_trials)
        mean = fitted.yy.sum(axis=0) / np.maximum(fitted.count.sum(axis=0), 1.0)
        return np.asarray(1.0 / np.maximum(mean, 1e-24))

    def rmse(self) -> Array:
        """Root mean square of the residual by axis over all trials, (n_q,), N.m or N."""
        return rms(self.residual, self.used)


def linearise_fit(
    system: System,
    motions: Sequence[Motion],
    band: Band,
    start: Array,
    folds: Folds,
    *,
    most_iterations: int = 12,
    like: Linearisation | None = None,
    timing: tuple[float, float] = (0.0, 0.0),
) -> Linearisation:
    """Fit a model to the fitted trials, from parameters (n_p,), and linearise it on all trials.

    ``like`` is a linearisation on the same trials, which shares them as it has joined them;
    ``timing`` limits the change of the input delay, s.

    Raises:
        ValueError: fewer samples than parameters, if a fit is requested.
    """
    shared = like is not None and like.motions is motions
    joined = like.joined if like is not None and shared else join_short(motions)
    # Without a fit, all trials can be linearised at once.
    taken, fitted = (motions, folds.fitted_trials) if most_iterations else (joined, [0])
    problem = problem_of(system, taken, band)
    found = minimise(problem, np.append(start, 0.0), fitted, most_iterations, tolerance=_CONVERGED)
    place = {trial: number for number, trial in enumerate(fitted)}
    stacked = (
        found.stacked[place[k]] if k in place else stacked_residual(problem, k, found.p)
        for k in range(len(taken))
    )
    value, residual, used = found.p[problem.free], list[Array](), list[Flags]()
    ends = np.cumsum([len(band.thinned_rows(n)) for n in trial_sizes(motions)])[:-1]

    def slopes() -> Iterator[Array]:
        for s in as_measured(problem, found.p, stacked):
            parts = ends if len(taken) < len(motions) else ends[:0]
            residual.extend(np.split(s.residual, parts))
            used.extend(np.split(s.used, parts))
            yield from np.split(s.slope, parts)

    return Linearisation(
        system, found.p[:-1], motions, joined, band, folds, residual, KeptItems(slopes()), used,
        tuple(int(i) for i in problem.free),
        problem.lower - value, problem.upper - value, problem.precision, problem.known - value,
        timing, _factors(problem, found.p, len(system.coordinates)),
    )  # fmt: skip


def _factors(problem: Problem, p: Array, axes: int) -> tuple[float, ...]:
    """Absolute values of the parameters that multiply the forces, see `Linearisation.factors`."""
    if problem.multiplied is None:
        return ()
    found = np.ones(axes)
    for place, axis in zip(problem.free, problem.multiplied, strict=True):
        if axis >= 0:
            found[axis] = max(abs(p[place]), 1e-300)
    return tuple(found.tolist())


def _on_each(system: System, p: Array, motions: Sequence[Motion]) -> tuple[ModelOnTrial, ...]:
    return tuple(ModelOnTrial(system, p, motions, k) for k in range(len(motions)))
