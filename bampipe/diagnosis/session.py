"""The trials of a session, fits of models under the likelihood, and their replicates."""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from bampipe.arrays import Array, Flags
from bampipe.diagnosis.candidates import (
    Candidate,
    build_candidate_model,
    compile_candidate,
    list_candidates,
)
from bampipe.diagnosis.criteria import Criteria
from bampipe.estimate.least_squares import NotFinite
from bampipe.estimate.simulation import Runaway
from bampipe.physics import System, compile_model
from bampipe.physics.model_spec import ModelSpec
from bampipe.physics.registry import effect_from
from bampipe.results.floor import FLOOR_SDS
from bampipe.trials.folds import HELD_OUT
from bampipe.trials.kept import KeptItems
from bampipe.trials.likelihood import Likelihood, dry_friction
from bampipe.trials.linear_problem import (
    LinearProblem,
    LinearSolution,
    pose_problem,
    solve_bounded,
)
from bampipe.trials.linearisation import Linearisation, linearise_fit
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.noise_floor import NoiseFloor
from bampipe.trials.replicates import SimulatedTrials, keep_motion, make_replicate
from bampipe.trials.residuals import ModelOnTrial
from bampipe.trials.samples import (
    BIASES,
    Noise,
    Samples,
    describe_noise,
    lay_out_samples,
    take_samples,
)
from bampipe.trials.sensors import Sensors
from bampipe.workers import process_pool

Seed = tuple[int, ...]

_MOST_STEPS = 24
_MOST_TRIED, _LEAST_DAMPING = 5, 0.01
"""Number of dampings that are tried for a step, each ten times the last, and the first of them."""
_COARSE_SHIFT = 0.03
"""Change of the input delay, in radians at the highest frequency of the band, for which trials are
shifted: the column of the delay is its first derivative."""
_CONVERGED = 0.2
"""A fit ends when a step promises a smaller fall of the negative log likelihood, nats."""
_LEAST_FALL = 0.1
"""Smallest fall of it that a step must bring for another to be taken, nats."""
_STOPPING_WIDTH = 0.125
"""Factor on the sign width of the replicate that stops; a 32nd gives the same residual."""
_WIDER = 2.0
"""Factor on the sign width of friction that comes up more gradually than the model's."""
_SEED = 7
"""Second number, after the user's seed, in the seeds of replicates."""

_systems: dict[str, System] = {}
_candidates: dict[str, Candidate] = {}
"""Compiled models and candidates of this process, by `Model.key`."""


def system_of(spec: ModelSpec) -> System:
    """Return the compiled model of a specification."""
    model = spec.model()
    if model.key not in _systems:
        _systems[model.key] = compile_model(model)
    return _systems[model.key]


def candidates_of(spec: ModelSpec, names: Sequence[str]) -> list[Candidate]:
    """Return the named candidates for a model with the effects of ``spec``."""
    device, extra = spec.model().device, [effect_from(e) for e in spec.extra]
    out = []
    for name in names:
        model = build_candidate_model(device, name, extra, spec.effects)
        if model.key not in _candidates:
            _candidates[model.key] = compile_candidate(model)
        out.append(_candidates[model.key])
    return out


def acting_axes(spec: ModelSpec, effect: str) -> tuple[int, ...]:
    """Return the axes whose equation an effect changes, whether or not the model has it."""
    system = candidates_of(change_effects(spec, (effect,)), (effect,))[0].system
    touched = range(len(system.coordinates)) if system.moves_sensors else system.touched
    item = next(item for item in system.model.effects if item.name == effect)
    named = [system.coordinates.index(axis) for axis in item.axes]
    return tuple(axis for axis in named if axis in touched) or tuple(touched)


_worker_state: Any = None
"""Data of the tasks of a worker process, inherited from its parent process."""


def _set_worker_state(state: object) -> None:
    global _worker_state
    _worker_state = state


def worker_state() -> Any:
    """Return the data of the tasks of this worker process."""
    return _worker_state


@contextmanager
def workers(state: object, jobs: int) -> Iterator[Callable[..., Iterator[Any]]]:
    """Open a `map` over processes that inherit ``state``, see `worker_state`."""
    _set_worker_state(state)
    try:
        if jobs <= 1:
            yield map
            return
        with process_pool(jobs, _set_worker_state, state) as pool:
            yield pool.map
    finally:
        _set_worker_state(None)


@dataclass(frozen=True)
class Session:
    """The data and settings of a diagnosis.

    Attributes:
        jobs: number of worker processes; seed: seed of the noise of replicates.
        requested_effects: candidates among the effects that are weighed only on request.
        keeps_timing: whether fits leave the input delay of the trials to their linear problem.
    """

    trials: MeasuredTrials
    criteria: Criteria
    jobs: int = 1
    seed: int = 0
    requested_effects: tuple[str, ...] = ()
    keeps_timing: bool = False

    def candidate_names(self, spec: ModelSpec, without: Collection[str] = ()) -> tuple[str, ...]:
        """Return the effects that the model of ``spec`` could have, except its own."""
        extra = [effect_from(e) for e in spec.extra]
        present = (*spec.effects, *without)
        names = list_candidates(spec.model().device, present, extra)
        return (
            *names,
            *(name for name in self.requested_effects if name not in (*present, *names)),
        )

    def linearise(
        self,
        spec: ModelSpec,
        p: Array,
        like: Linearisation | None = None,
        judged: bool = False,
        late_s: float = 0.0,
    ) -> Linearisation:
        """Linearise the model of ``spec`` at parameters ``p``, (n_p,).

        The trials are those that choose a model or, if asked, those by which it is ``judged``;
        they have the input delay of ``like`` and ``late_s`` more.
        """
        t = self._trial_subsets[judged]
        motions, timing = (like.motions, like.timing) if like else (t.motions, t.timing)
        if late_s:
            low, high = timing[0] - late_s, timing[1] - late_s
            motions = [m.with_input_timing(t.timing[0] - low) for m in t.motions]
            timing = low, high
        return linearise_fit(
            system_of(spec), motions, t.band, p, t.folds,
            most_iterations=0, timing=timing, like=like,
        )  # fmt: skip

    @cached_property
    def _trial_subsets(self) -> list[MeasuredTrials]:
        """The trials that choose a model, and those that judge it."""
        choosing = np.array(self.trials.folds.groups) != HELD_OUT
        both = choosing, self.trials.folds.judged
        return [self.trials.subset(np.flatnonzero(counts).tolist()) for counts in both]

    def replicate(self, linearisation: Linearisation, count: int) -> Sequence[Array]:
        """Return the residuals of replicates of a fitted model, by trial, each (K, n_q, count).

        Raises:
            Runaway: the simulated motion grows without bounds.
        """
        seeds = [(self.seed, _SEED, k) for k in range(count)]
        return self._replicate([linearisation], linearisation.system, self.trials.sensors, seeds)

    def _replicate(
        self,
        models: Sequence[Linearisation],
        system: System,
        sensors: Sensors,
        seeds: Sequence[Seed],
    ) -> Sequence[Array]:
        """Return the residuals of ``models``, by seed, on replicates with parameters of the first.

        They are by trial, each (K, n_q, seeds * models).
        """
        e = models[0]
        simulated = SimulatedTrials(system, e.p, e.motions, sensors.rate_hz)
        parts = [[seed] for seed in seeds] if self.jobs > 1 else [seeds]
        # Workers inherit the course of the machine, which all replicates share.
        trials = range(min(len(simulated.courses), len(simulated.rests)))
        tasks = [(trial, part) for trial in trials for part in parts]
        state = models, simulated, sensors, self.trials.kinematics
        with workers(state, min(self.jobs, len(tasks))) as spread:
            found = spread(_replicate_trial, tasks)
            return KeptItems(np.concatenate([next(found) for _ in parts], axis=2) for _ in trials)

    def replicate_reversals(self, spec: ModelSpec, linearisation: Linearisation) -> list[Array]:
        """Return residuals of friction that reverses otherwise, by trial, each (K, n_q, 2).

        The first is that of a replicate without noise whose friction truly stops, or zero where the
        motion is kept or the simulation diverges. Controllers keep a robot on its path: there, only
        the width of the sign changes the friction. The second is that of a wider sign.
        """
        stops = self._replicate_stopping(spec, linearisation)
        wider = _change_width(linearisation, _WIDER)
        return [np.stack(both, axis=2) for both in zip(stops, wider, strict=True)]

    def _replicate_stopping(self, spec: ModelSpec, linearisation: Linearisation) -> list[Array]:
        """Return the first residual of `replicate_reversals`."""
        t, nothing = self.trials, [np.zeros_like(r) for r in linearisation.residual]
        if keep_motion(linearisation.fitted):
            return nothing
        if linearisation.system.model.device.robot is not None:
            return _change_width(linearisation, _STOPPING_WIDTH)
        narrow = system_of(spec.with_sign_widths(_STOPPING_WIDTH))
        kept = ([ModelOnTrial(narrow, linearisation.p, [m])] for m in linearisation.motions)
        if any(map(keep_motion, kept)):
            return nothing
        none = np.zeros(len(linearisation.system.coordinates))
        exact = replace(
            t.sensors, resolution=none, reading_sd=none, force_sd=np.zeros_like(t.sensors.force_sd)
        )
        try:
            found = self._replicate([linearisation], narrow, exact, [(self.seed,)])
        except Runaway:
            return nothing
        return [values[:, :, 0] for values in found]

    def compare_noise(self, before: "Fit", after: "Fit") -> Array:
        """Return the variance of sensor noise in the residual of a model over another's, (n_q,).

        Both see the difference of two replicates of ``before``. An elastic coupling, for example,
        averages the noise of an acceleration.
        """
        e, seeds = before.linearisation, [(self.seed, _SEED, k) for k in range(2)]
        models = e, after.linearisation
        rows = self._replicate(models, e.system, self.trials.sensors, seeds)
        squares = []
        for axis, here in enumerate(before.likelihood.samples):
            seen = take_samples(rows, here, axis) * before.likelihood.root[axis][:, None]
            squares.append(np.sum((seen[:, :2] - seen[:, 2:]) ** 2, axis=0))
        old, new = np.transpose(squares)
        return np.asarray(np.where(old > 0.0, new / np.maximum(old, 1e-300), 1.0))

    def weight_samples(
        self,
        spec: ModelSpec,
        linearisation: Linearisation,
        noise: Noise | None = None,
        count: int = 0,
    ) -> Likelihood:
        """Return the likelihood of the trials of ``linearisation``, with noise from replicates.

        Args:
            noise: noise from replicates of another model, to use instead.
            count: number of replicates, at least two; by default that of the criteria.

        Raises:
            Runaway: the simulated motion grows without bounds.
        """
        c = self.criteria
        samples = lay_out_samples(linearisation, c.block_s)
        if noise is None:
            residuals = self.replicate(linearisation, count or c.replicates)
            reversals = self.replicate_reversals(spec, linearisation)
            noise = describe_noise(residuals, reversals, linearisation, samples)
        force_sd = self.trials.sensors.force_sd
        return Likelihood.of(linearisation, samples, noise, c.bias_error, c.discrepancy, force_sd)

    def fit(
        self, spec: ModelSpec, start: Array, noise: Noise | None = None, lacking: float = np.inf
    ) -> "Fit":
        """Fit a model under the likelihood.

        Args:
            spec: the model; start: its initial parameters, (n_p,).
            noise: noise from replicates; by default those of this model at ``start``.
            lacking: scale above which all samples of an axis have equal weight.

        Raises:
            Runaway: the simulated motion grows without bounds.
        """
        linearisation, c = self.linearise(spec, start), self.criteria
        likelihood = self.weight_samples(spec, linearisation, noise)
        linearisation, problem = self._descend(spec, linearisation, likelihood)
        log_likelihood = problem.log_likelihood()
        # The error of the biases depends on the fitted residual.
        likelihood = self.weight_samples(spec, linearisation, likelihood.noise)
        rows = pose_problem(likelihood, linearisation).residual_rows()
        likelihood = likelihood.with_heavy_tails(rows, c.tails)
        likelihood = likelihood.with_equal_weights(problem.residual_rows(), lacking)
        linearisation, problem = self._descend(spec, linearisation, likelihood)
        return Fit(spec, linearisation, likelihood, problem, log_likelihood)

    def _descend(
        self, spec: ModelSpec, linearisation: Linearisation, likelihood: Likelihood
    ) -> tuple[Linearisation, LinearProblem]:
        """Take Gauss-Newton steps to the most likely parameters within their bounds.

        A step is accepted if it lowers the cost with refitted nuisance parameters, since the
        linear problem can promise far more than a step in a shape achieves; else it is damped
        (Marquardt 1963).

        Raises:
            ValueError: fewer samples are clear of standstill than there are parameters.
        """
        problem, count = pose_problem(likelihood, linearisation), len(linearisation.free)
        if sum(map(len, problem.y)) <= count:
            raise ValueError("fewer samples clear of standstill than parameters")
        here, damping = problem.solve_nuisance(count).cost, 0.0
        highest_hz = max(self.trials.band.cutoff_hz)
        for _ in range(_MOST_STEPS):
            promised = problem.solve()
            if here - promised.cost < _CONVERGED:
                break
            lightest = damping
            for _ in range(_MOST_TRIED):
                solved = problem.solve_damped(damping) if damping else promised
                step = problem.to_parameters @ solved.base
                p = linearisation.p.copy()
                p[list(linearisation.free)] += step[:count]
                p = np.clip(p, *bounds_of(linearisation.system))
                late_s = 0.0
                if linearisation.by_timing and not self.keeps_timing:
                    is_coarse = 2.0 * np.pi * highest_hz * abs(step[count]) > _COARSE_SHIFT
                    late_s = is_coarse * float(step[count])
                try:
                    # The residual without its slopes shows most steps that are too long. Factors of
                    # the measured force would change its unit.
                    there = -np.inf
                    if not linearisation.factors:
                        rows = linearisation.residual_of(linearisation.system, p)
                        there = problem.cost_of_step(rows, step[:count])
                    if there < here:
                        moved = self.linearise(spec, p, linearisation, late_s=late_s)
                        tried = pose_problem(likelihood, moved)
                        there = tried.solve_nuisance(count).cost
                except NotFinite:
                    there = np.inf
                if there < here:
                    break
                damping = max(10.0 * damping, _LEAST_DAMPING)
            else:
                break
            fall, linearisation, problem, here = here - there, moved, tried, there
            if fall < _LEAST_FALL:
                break
            if damping == lightest:
                damping = 0.1 * damping if damping > _LEAST_DAMPING else 0.0
        return linearisation, problem

    def judge(self, spec: ModelSpec, p: Array, count: int = 0) -> "Fit":
        """Compare a given model with ``count`` replicates on the trials that judge it.

        Raises:
            Runaway: the simulated motion grows without bounds.
        """
        linearisation = self.linearise(spec, p, judged=True)
        likelihood = self.weight_samples(spec, linearisation, count=count)
        return Fit(
            spec, linearisation, likelihood, pose_problem(likelihood, linearisation), is_given=True
        )

    def fit_plainly(self, spec: ModelSpec, start: Array) -> "Fit":
        """Fit a model with equal noise for all samples of an axis, without replicates."""
        linearisation = self.linearise(spec, start)
        samples = lay_out_samples(linearisation, self.criteria.block_s)
        silent = [np.zeros((*r.shape, 2)) for r in linearisation.residual]
        noise = describe_noise(silent, silent, linearisation, samples)
        flat = Likelihood.of(linearisation, samples, noise, 0.0, 0.0, self.trials.sensors.force_sd)
        linearisation, problem = self._descend(spec, linearisation, flat)
        return Fit(spec, linearisation, flat, problem)

    def try_fit(self, spec: ModelSpec, start: Array) -> "Fit | None":
        """Apply `fit`; None if the model cannot be simulated or its residual is not finite."""
        try:
            return self.fit(spec, start)
        except (Runaway, NotFinite):
            return None


def bounds_of(system: System) -> tuple[Array, Array]:
    """Return the lower and upper bounds of the parameters, (n_p,) each."""
    parameters = system.parameters
    return np.array([q.lower for q in parameters]), np.array([q.upper for q in parameters])


@dataclass(frozen=True)
class Fit:
    """A model fitted under the likelihood.

    Attributes:
        spec: the model; linearisation: of its residual at the estimate.
        likelihood: noise and weights; problem: the weighted linear problem.
        log_likelihood: log likelihood under the normal noise of its own replicates, nats, which
            ranks fits with different replicates; nan for other noise.
        is_given: whether the parameters are given and only nuisance parameters are fitted.
    """

    spec: ModelSpec
    linearisation: Linearisation
    likelihood: Likelihood
    problem: LinearProblem
    log_likelihood: float = float("nan")
    is_given: bool = False

    @property
    def effect_parameters(self) -> dict[str, float]:
        """Values of the parameters of the effects, by name."""
        system = self.linearisation.system
        count = len(system.model.device.parameters)
        pairs = zip(system.parameters[count:], self.linearisation.p[count:], strict=True)
        return {item.name: float(value) for item, value in pairs}

    @cached_property
    def solution(self) -> LinearSolution:
        """The solution of the linear problem; at the estimate, only nuisance parameters move."""
        if self.is_given:
            return self.problem.solve_nuisance(len(self.linearisation.free))
        return self.problem.solve()

    @property
    def has_settled(self) -> bool:
        """Whether another step promises no fall of the negative log likelihood that matters."""
        here = self.problem.solve_nuisance(len(self.linearisation.free))
        return here.cost - self.problem.solve().cost < _CONVERGED

    @cached_property
    def bias(self) -> tuple[Array, ...]:
        """The fitted bias by axis, each (n,)."""
        noise, n_q = self.likelihood.noise, len(self.likelihood.samples)
        factors = (self.problem.to_parameters @ self.solution.base)[-len(BIASES) * n_q :]
        return tuple(noise.biases(axis) @ factors[axis::n_q] for axis in range(n_q))

    @cached_property
    def noise_floor(self) -> NoiseFloor:
        """The noise floor: the error of the replicates, with the bias scaled as in the measurement.

        A machine may reverse exactly as the replicates do, or differ from them by the uncertainty
        of the biases. Of the floors in that range, the one closest to the error is taken.
        """
        like, levels = self.likelihood, []
        parts = zip(
            like.noise.residuals, like.noise.bias, self.bias, like.bias_variance,
            self.rows_beyond_bias, strict=True,
        )  # fmt: skip
        for residuals, b, bias, variance, left in parts:
            rows = residuals - b + bias
            square = np.mean(rows**2, axis=1) if b.size else np.zeros(len(rows))
            off = rms(left + bias) ** 2 - float(np.median(square))
            more = float(variance.mean()) if b.size else 0.0
            levels.append(np.sqrt(square + np.clip(off, 0.0, more)))
        return NoiseFloor.of_errors([*np.array(levels).T])

    @property
    def is_above_floor(self) -> Flags:
        """Whether the error of each axis exceeds the noise floor by more than its scatter, (n_q,).

        Below, an unknown function follows errors of the bias or hum, not the machine.
        """
        level, sd = self.noise_floor.level, self.noise_floor.sd
        return np.asarray(self.held_out_rmse > level + FLOOR_SDS * sd)

    @property
    def creeping_floor(self) -> Array:
        """Error of replicates that creep through reversals, by axis, (n_q,), N.m or N."""
        return np.array([rms(rows) for rows in self.likelihood.noise.residuals])

    @cached_property
    def rows_beyond_bias(self) -> tuple[Array, ...]:
        """Residual after the bias has been subtracted, by axis, each (n,), N.m or N."""
        rows = self.problem.residual_rows(self.solution.base)
        return tuple(left / root for left, root in zip(rows, self.likelihood.root, strict=True))

    def count_independent(
        self, criteria: Criteria, left: Iterable[Array] = ()
    ) -> tuple[Samples, ...]:
        """Return the samples of each axis with the number that are independent in a residual.

        ``left`` is that residual, in units of the noise, by axis, each (n,); by default the fit's.
        """
        band = self.linearisation.band
        lags = int(criteria.block_s * band.rate_hz / band.step)
        return self.likelihood.count_independent(left or self.problem.residual_rows(), lags)

    @cached_property
    def held_out_rmse(self) -> Array:
        """Error on trials that parameters and input delay have not seen, (n_q,), N.m or N.

        It follows from the linear problem. For one group of trials, it is the error of the fit.
        """
        return self.held_out_without()

    def held_out_without(self, effects: Iterable[str] = ()) -> Array:
        """Return `held_out_rmse` without some of the model's effects."""
        e, samples = self.linearisation, self.likelihood.samples
        plain = [take_samples(e.residual, here, axis) for axis, here in enumerate(samples)]
        slopes = [take_samples(e.slopes, here, axis) for axis, here in enumerate(samples)]
        squares = np.zeros(len(samples))
        for parts, unknowns in self._solve_held_out(effects):
            change = (self.problem.to_parameters @ unknowns)[: slopes[0].shape[1]]
            for axis, part in enumerate(parts):
                left = plain[axis][part] + slopes[axis][part] @ change
                squares[axis] += float(np.sum(left**2))
        return np.asarray(np.sqrt(squares / self.problem.count))

    def held_out_rows(self, effects: Iterable[str] = ()) -> list[Array]:
        """Return `rows_beyond_bias` on trials that no unknown has seen, without some effects."""
        rows = [np.zeros_like(y) for y in self.problem.y]
        for parts, unknowns in self._solve_held_out(effects):
            for row, part, left in zip(
                rows, parts, self.problem.residual_rows(unknowns), strict=True
            ):
                row[part] = left[part]
        return [row / root for row, root in zip(rows, self.likelihood.root, strict=True)]

    def _solve_held_out(self, effects: Iterable[str]) -> Iterator[tuple[list[Flags], Array]]:
        """Yield the samples of each group of trials, by axis, and the unknowns without them."""
        p, absent, weight = self.problem, self.problem.removal(effects), self.solution.weight
        groups, group_of = np.unique(self.linearisation.folds.groups, return_inverse=True)
        parts = [group_of[here.trial] for here in self.likelihood.samples]
        sums, is_unseen = p.sums(), len(groups) > 1
        for k, own in enumerate(zip(*p.sums_of(parts, len(groups)), strict=True)):
            xx, xy, yy = (whole - is_unseen * part for whole, part in zip(sums, own, strict=True))
            others = solve_bounded(p, xx, xy, np.maximum(yy, 1e-300), absent=absent, weight=weight)
            yield [part == k for part in parts], others.base


def rms(values: Array) -> float:
    """Return the root mean square; 0 for an empty array."""
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


def _replicate_trial(task: tuple[int, Sequence[Seed]]) -> Array:
    """Return the residuals of models on replicates of one trial, (K, n_q, seeds * models)."""
    (models, simulated, sensors, kinematics), (trial, seeds) = worker_state(), task
    e, rows = models[0], []
    for seed in seeds:
        rng = np.random.default_rng([*seed, trial])
        motion = make_replicate(simulated, trial, sensors, kinematics, rng)
        rows += [ModelOnTrial(m.system, m.p, [motion]).residual for m in models]
    thin = e.band.thin_trials(rows, range(len(e.system.coordinates)))
    return np.stack([values * e.used[trial] for values in thin], axis=2)


def _change_width(linearisation: Linearisation, factor: float) -> list[Array]:
    """Return the residual of friction whose sign is wider by a factor, by trial, (K, n_q)."""
    e = linearisation
    width = e.system.sign_widths
    rows = (
        dry * (np.tanh(m.qd / (factor * width)) - np.tanh(m.qd / width))
        for dry, m in zip(dry_friction(e), e.motions, strict=True)
    )
    thin = e.band.thin_trials(rows, range(len(width)))
    return [values * used for values, used in zip(thin, e.used, strict=True)]


def change_effects(
    spec: ModelSpec, removed: Collection[str], more: Sequence[str] = ()
) -> ModelSpec:
    """Return the model without some of its effects, and with ``more``."""
    return replace(spec, effects=(*(e for e in spec.effects if e not in removed), *more))
