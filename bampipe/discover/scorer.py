"""Scores of candidates: each refitted together with the model's parameters, on trials left out.

For fixed shape parameters an effect adds columns to a linear problem; the sums of products that
this needs are stored by trial and axis, so that leaving a trial out costs nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.candidates import Candidate
from bampipe.discover.columns import added_columns, added_residual
from bampipe.discover.parameter_scan import scan_parameters
from bampipe.discover.ranges import MachineScale
from bampipe.discover.settings import Settings
from bampipe.estimate.normal_equations import NormalEquations
from bampipe.trials.draw import draw_trials
from bampipe.trials.evidence import Evidence
from bampipe.trials.folds import Folds
from bampipe.trials.motion import trial_sizes
from bampipe.trials.residuals import ModelOnTrial

Array = NDArray[np.float64]

_SHARES = (1.0, 0.9, 0.8, 0.65, 0.5, 0.35, 0.2, 0.1, 0.05)
"""Shares of the least-squares strength tried where an effect weakens what the force does."""
_DIVERGED = 1e30
"""An internal state that is too stiff to be integrated at the sampling rate ends above this."""

_PROBE, _PROBE_SEED = 1e-3, 5
"""Noise that is put on a force to see what is left of it, over the force's own variation."""
_LEAST_PASSED = 1e-6
"""Of the mean square of that noise; less counts as this."""


@dataclass(frozen=True)
class Score:
    """How well the model explains the trials with one effect added.

    Attributes:
        name: the effect.
        error: root mean square of the residual on trials left out, by axis, (n_q,), N.m or N.
        values: fitted parameters of the effect, in the order of `Candidate.parameters`.
        shift: change of the model's own free parameters that goes with it.
        gain: log likelihood ratio of the measured force on trials left out, by axis, (n_q,), in
            units of independent samples: positive where the effect helps. An effect that weakens
            what the force does, such as friction in proportion to it, makes both sides of the
            equation small, noise included; the slope of the residual by the force takes that off.
        late_s: change of the inputs' timing that goes with it, s.
    """

    name: str
    error: Array
    values: Array
    shift: Array
    gain: Array
    late_s: float = 0.0

    @property
    def total(self) -> float:
        """Gain over all axes."""
        return float(self.gain.sum())


@dataclass(frozen=True)
class _JointProblem:
    """The linear problem of a model with a candidate of given shape.

    Attributes:
        sums: its sums of products.
        added, change: what the candidate adds to the columns and to the residual, by trial,
            (K, n_q, m) and (K, n_q).
        columns: what it adds, (n, m), for comparing shapes.
    """

    sums: NormalEquations
    added: Sequence[Array]
    change: Sequence[Array]
    columns: Array


class Scorer:
    """Scores candidates against one evidence."""

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = evidence
        # The trials that a session holds out choose no model.
        self.folds = evidence.folds.among_fitted()
        # What a small shift of the inputs explains is to the credit of no effect: the model and
        # each candidate have the timing that suits them.
        timing = evidence.timing if evidence.by_timing else ()
        self.jacobian: Sequence[Array] = evidence.jacobian
        if timing:
            pairs = zip(evidence.jacobian, evidence.by_timing, strict=True)
            self.jacobian = [np.append(x, by[:, :, None], axis=2) for x, by in pairs]
        self.lower = np.append(evidence.lower, timing[:1])
        self.upper = np.append(evidence.upper, timing[1:])

    @cached_property
    def sums(self) -> NormalEquations:
        """Sums of products of the model's own columns, the timing of the inputs last."""
        e = self.evidence
        return NormalEquations.from_samples(self.jacobian, e.residual, e.used, e.precision, e.known)

    @cached_property
    def late_s(self) -> float:
        """Change of the inputs' timing that goes with the model as it is, s; 0 if not open."""
        if not self.evidence.by_timing:
            return 0.0
        fitted = self.sums.subset(self.folds.fitted_trials)
        return float(fitted.solve(self.evidence.weight, self.lower, self.upper)[-1])

    def _folds_for(self, item: Candidate) -> Folds:
        """What brakes do is part of the model with an effect of theirs, and fitted then."""
        return self.folds.with_all_fitted() if item.system.braked else self.folds

    @cached_property
    def independent_samples(self) -> Array:
        """Number of independent samples that count in the error, by axis, (n_q,)."""
        judged = [k for k, counts in enumerate(self.folds.judged) if counts]
        count = self.sums.count[judged].sum(axis=0)
        return np.asarray(count * self.evidence.band.independent_share)

    @cached_property
    def machine_scale(self) -> MachineScale:
        """What sizes the trials have."""
        return MachineScale.of_trials(self.evidence)

    @cached_property
    def base_error(self) -> Array:
        """Error of the model as it is, as that of a `Score`, by axis, (n_q,), N.m or N."""
        held_out_weight = Settings().held_out_weight
        weight, bounds = self.evidence.weight, (self.lower, self.upper)
        steps = self.folds.solve(self.sums, weight, *bounds, held_out_weight)
        return self.folds.error(self.sums, steps)

    @cached_property
    def held_out_scale(self) -> Array:
        """What turns an error of a `Score` into one on the terms of the model's own, by axis.

        Candidates are scored with a little of the trial that is left out, models are judged without
        it: what the two have in common is the ratio.
        """
        return np.asarray(self.evidence.held_out_rmse / np.maximum(self.base_error, 1e-300))

    def comparable_error(self, score: Score) -> Array:
        """Held-out error that goes with the gain of a candidate, by axis, N.m or N.

        Of one that makes both sides of the equation small it is larger than what is left.
        """
        ratio = np.exp(-score.gain / np.maximum(self.independent_samples, 1e-300))
        return np.asarray(self.evidence.held_out_rmse * ratio)

    def _cost_before(self, item: Candidate) -> float:
        """Cost of the model as it is, fitted to the trials that ``item`` is fitted to."""
        fitted = self.sums.subset(self._folds_for(item).fitted_trials)
        step = fitted.solve(self.evidence.weight, self.lower, self.upper)
        return self._cost(fitted.mean_square(step))

    def _cost(self, left: Array) -> float:
        """Cost of a fit that leaves a mean square, (n_q,): sum over axes of n log of it."""
        return float(np.sum(self.independent_samples * np.log(np.maximum(left, 1e-30))))

    def score(self, item: Candidate) -> Score | None:
        """Refit with ``item`` added; None where it does nothing in these trials."""
        effect = item.system.model.effects[-1]
        ranges = [
            self.machine_scale.range_of(effect, item.parameters[i]) for i in item.searched_indices
        ]
        hopeless = self._cost_before(item) - Settings().worth_searching

        def values_at(searched: Sequence[float] | Array) -> Array:
            pairs = zip(ranges, searched, strict=True)
            return np.array([interval.value_at(float(x)) for interval, x in pairs])

        found = scan_parameters(
            lambda searched: self._fit_cost(item, values_at(searched)),
            ranges,
            hopeless,
            has_columns=bool(item.linear_indices),
            count=float(self.independent_samples[list(item.system.touched)].sum()) or np.inf,
        )
        if found is None:
            return None
        searched, cost = found
        if ranges and cost > hopeless:
            return self._score_at_zero(item)
        best = self._score_with(item, values_at(searched))
        # An error of exactly zero, on an axis that nothing drives, is no explanation.
        return best if best is not None and np.isfinite(best.gain).all() else None

    def score_at(self, item: Candidate, values: Array) -> Score | None:
        """Refit with ``item`` added, its searched parameters held at those of ``values``."""
        found = self._score_with(item, values[list(item.searched_indices)])
        return found if found is not None and np.isfinite(found.gain).all() else None

    def gain_by_sample(self, item: Candidate, score: Score) -> list[Array]:
        """Gain in log likelihood that each sample contributes, by trial, each (K,).

        That of the fit; zero in trials that the session holds out, for they choose no model.
        """
        problem = self._join(item, score.values[list(item.searched_indices)])
        if problem is None:
            return [np.zeros(len(r)) for r in self.evidence.residual]
        values, left = self._fit(item, problem.sums)
        weight = _weight(left)
        count, residual = self.lower.size, self.evidence.residual
        rows = zip(
            self.folds.judged, residual, self.jacobian, problem.change, problem.added, strict=True
        )
        return [
            0.5
            * (np.square(r) - np.square(r + moved + x @ values[:count] + new @ values[count:]))
            @ weight
            * judged
            for judged, r, x, moved, new in rows
        ]

    def carry_over(self, score: Score, moved: NDArray[np.bool_]) -> Score:
        """A score against a model that leaves the same but on the axes ``moved``, (n_q,)."""
        return replace(
            score,
            error=np.where(moved, self.base_error, score.error),
            gain=np.where(moved, 0.0, score.gain),
            shift=np.zeros(len(self.evidence.free)),
        )

    def _score_at_zero(self, item: Candidate) -> Score:
        """The score of an effect that these trials do not ask for: strength zero."""
        values = np.array([0.0 if p.strength else p.prior for p in item.parameters])
        nothing = np.zeros(len(self.base_error))
        return Score(item.name, self.base_error, values, nothing[:0], nothing)

    def _join(self, item: Candidate, searched: Array) -> _JointProblem | None:
        columns, change = added_columns(self.evidence, item, searched)
        if all(not c.any() for c in columns) and all(not c.any() for c in change):
            return None
        if not all((np.abs(c) < _DIVERGED).all() for c in (*columns, *change)):
            return None
        shape = np.concatenate(columns if item.linear_indices else change)
        flat = shape.reshape(-1, shape.shape[-1]) if item.linear_indices else shape
        sums = self.sums.bordered(self.jacobian, columns, change, self.evidence.residual)
        return _JointProblem(sums, columns, change, flat)

    def _bounds(self, item: Candidate) -> tuple[Array, Array]:
        """Bounds of the changes of the base parameters and of the linear strengths."""
        strengths = [item.parameters[i] for i in item.linear_indices]
        lower, upper = self.lower, self.upper
        if item.system.takes_timing:
            # Its delay has the place of the timing, as in identification.
            timing = np.arange(lower.size) >= len(self.evidence.free)
            lower, upper = np.where(timing, 0.0, lower), np.where(timing, 0.0, upper)
        return (
            np.append(lower, [q.lower for q in strengths]),
            np.append(upper, [q.upper for q in strengths]),
        )

    def _fit_cost(self, item: Candidate, searched: Array) -> tuple[float, Array] | None:
        """Cost of the joint fit, and the columns."""
        problem = self._join(item, searched)
        if problem is None:
            return None
        solution, left = self._fit(item, problem.sums)
        cost = self._cost(left)
        if item.system.remembers_force:
            values = self._values_of(item, searched, solution)
            cost -= 2.0 * float(self.independent_samples @ self._passed_noise(item, values))
        return cost, problem.columns

    def _fit(self, item: Candidate, sums: NormalEquations) -> tuple[Array, Array]:
        """Coefficients of the joint fit, reweighted once, and the mean square left, (n_q,)."""
        weight, bounds = self.evidence.weight, self._bounds(item)
        fitted = sums.subset(self._folds_for(item).fitted_trials)
        for _ in range(2):
            values = fitted.solve(weight, *bounds)
            left = fitted.mean_square(values)
            weight = _weight(left)
        return values, left

    def _score_with(self, item: Candidate, searched: Array) -> Score | None:
        """The score with given values of the searched parameters."""
        problem = self._join(item, searched)
        if problem is None:
            return None
        sums = problem.sums
        solution, left = self._fit(item, sums)
        weight = _weight(left)
        folds, (lower, upper) = self._folds_for(item), self._bounds(item)
        values = self._values_of(item, searched, solution)
        start = self.lower.size

        def error_within(lower: Array, upper: Array) -> Array:
            steps = folds.solve(sums, weight, lower, upper, Settings().held_out_weight)
            return folds.error(sums, steps)

        if not item.system.driven:
            error = error_within(lower, upper)
            gain = np.log(self.base_error / error)
            if item.system.remembers_force:
                gain += self._passed_noise(item, values)
                if self.independent_samples @ gain < Settings().worth_searching:
                    return self._score_at_zero(item)
            gain = self.independent_samples * gain
            shift, late_s = self._split(solution)
            return Score(item.name, error, values, shift, gain, late_s)
        best = None
        for share in _SHARES if item.linear_indices else (1.0,):
            weaker = values.copy()
            weaker[list(item.linear_indices)] *= share
            # Equal bounds hold the strengths at this share while the base parameters adapt.
            low, high = lower.copy(), upper.copy()
            if item.linear_indices:
                low[start:] = high[start:] = weaker[list(item.linear_indices)]
            error = error_within(low, high)
            gain = np.log(self.base_error / error) + self._sensitivity(item, weaker)
            if (
                best is None
                or self.independent_samples @ gain > self.independent_samples @ best.gain
            ):
                fitted = sums.subset(folds.fitted_trials)
                shift, late_s = self._split(fitted.solve(weight, low, high))
                best = Score(item.name, error, weaker, shift, gain, late_s)
        assert best is not None
        # Both sides of the equation made small explain nothing, however small the error becomes.
        if self.independent_samples @ best.gain < Settings().worth_searching:
            return self._score_at_zero(item)
        return replace(best, gain=self.independent_samples * best.gain)

    def _split(self, solution: Array) -> tuple[Array, float]:
        """Change of the model's free parameters, and of the inputs' timing, in a joint fit."""
        count = len(self.evidence.free)
        return solution[:count], float(solution[count]) if self.evidence.by_timing else 0.0

    def _values_of(self, item: Candidate, searched: Array, solution: Array) -> Array:
        """Values of its parameters, of the searched ones and the coefficients of the joint fit."""
        values = np.array([p.prior for p in item.parameters])
        values[list(item.searched_indices)] = searched
        values[list(item.linear_indices)] = solution[self.lower.size :]
        return values

    def _passed_noise(self, item: Candidate, values: Array) -> Array:
        """Log of the share of white noise of the forces that is left with the effect, (n_q,).

        At most zero. What remembers a force, as a lag does, averages its noise out, and the
        error falls although nothing is explained: how noisy the force is need not be known.
        """
        e, system, probed = self.evidence, item.system, self._probed
        p = np.concatenate([e.p[: len(system.parameters) - len(values)], values])
        noise, passed = [], []
        for base, shaken in probed.values():
            noise.append(shaken.residual - base.residual)
            change = added_residual(item, p, shaken) - added_residual(item, p, base)
            passed.append(noise[-1] + change)
        used = [e.used[trial] for trial in probed]

        def sum_of_squares(rows: Sequence[Array]) -> Array:
            thin = e.band.thin_trials(rows, range(len(system.coordinates)))
            squares = [np.sum(x**2 * u, axis=0) for x, u in zip(thin, used, strict=True)]
            return np.asarray(np.sum(squares, axis=0))

        whole = sum_of_squares(noise)
        share = sum_of_squares(passed) / np.where(whole > 0.0, whole, 1.0)
        share = np.where(whole > 0.0, np.clip(share, _LEAST_PASSED, 1.0), 1.0)
        return np.asarray(0.5 * np.log(share))

    @cached_property
    def _probed(self) -> dict[int, tuple[ModelOnTrial, ModelOnTrial]]:
        """The model on some trials, by number, as measured and with noise put on the forces."""
        e, found = self.evidence, {}
        for trial in draw_trials(trial_sizes(e.motions)):
            motion, rng = e.motions[trial], np.random.default_rng([_PROBE_SEED, trial])
            noisy = {}
            for name in e.system.model.device.forces:
                force = motion.channels[name]
                noisy[name] = force + _PROBE * np.std(force) * rng.normal(size=force.size)
            shaken = ModelOnTrial(e.system, e.p, [motion.with_channels(noisy)])
            found[int(trial)] = e.fitted[trial], shaken
        return found

    def _sensitivity(self, item: Candidate, values: Array) -> Array:
        """Mean of log |d residual / d force| with the effect over without it, by axis, (n_q,)."""
        e, system = self.evidence, item.system
        p = np.concatenate([e.p[: len(system.parameters) - len(values)], values])
        total = np.zeros(len(system.coordinates))
        for motion, used in zip(e.motions, e.used, strict=True):
            kept = e.band.thinned_rows(len(motion.t))
            u = motion.inputs(system.inputs)
            motion = motion.of_mechanism(system, u, p)
            z = system.memory(*motion.kinematics, u, p, motion.t)
            at = motion.q[kept], motion.qd[kept], motion.qdd[kept], z[kept]
            plain = system.input_map(at[0], u[kept], p)
            here, slope = system.contribution(*at, u[kept], p), plain.copy()
            for j, force in enumerate(system.model.device.forces):
                moved, column = u[kept].copy(), system.inputs.index(force)
                step = 1e-6 * max(float(np.abs(moved[:, column]).max()), 1e-6)
                moved[:, column] += step
                slope[:, :, j] += (system.contribution(*at, moved, p) - here) / step
            bare = np.linalg.norm(plain, axis=2)
            share = np.linalg.norm(slope, axis=2) / np.where(bare > 0.0, bare, 1.0)
            total += np.sum(np.where(bare > 0.0, np.log(np.maximum(share, 1e-3)), 0.0) * used, 0)
        return np.asarray(total / np.maximum(self.sums.count.sum(axis=0), 1.0))


def _weight(left: Array) -> Array:
    """Weight of the squares of each axis, where a fit leaves a mean square, (n_q,)."""
    return np.asarray(1.0 / np.maximum(left, 1e-24))
