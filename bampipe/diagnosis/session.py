"""The trials of a session, models fitted to them under the likelihood, and replays of those."""

from __future__ import annotations

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
from bampipe.physics.recipe import Recipe
from bampipe.physics.registry import effect_from
from bampipe.results.floor import compare_with_floor
from bampipe.trials.evidence import Evidence, gather_evidence
from bampipe.trials.folds import HELD_OUT
from bampipe.trials.kept import KeptItems
from bampipe.trials.likelihood import (
    Likelihood,
    LinearSolution,
    Noise,
    Problem,
    Samples,
    describe_noise,
    dry_friction,
    lay_out_samples,
    solve_bounded,
    take_samples,
)
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.noise_floor import NoiseFloor
from bampipe.trials.replicates import SimulatedTrials, keep_motion, make_replicate
from bampipe.trials.residuals import ModelOnTrial
from bampipe.trials.sensors import Sensors
from bampipe.workers import process_pool

Seed = tuple[int, ...]

_MOST_STEPS = 8
_STEP_LENGTHS = (1.0, 0.3, 0.1, 0.03)
_CONVERGED = 0.2
"""Fall of the negative log likelihood that a step promises, nats, below which a fit ends."""
_STOPPING_WIDTH = 0.125
"""Sign width, times the device's, of the replay whose friction stops it: a 32nd leaves the same."""
_SEED = 7
"""First number, after the user's, of the seeds of replicates."""

_systems: dict[str, System] = {}
_candidates: dict[str, Candidate] = {}
"""By `Model.key`: compiled once a process for each content."""


def system_of(recipe: Recipe) -> System:
    """The compiled model of a recipe."""
    model = recipe.model()
    if model.key not in _systems:
        _systems[model.key] = compile_model(model)
    return _systems[model.key]


def candidates_of(recipe: Recipe, names: Sequence[str]) -> list[Candidate]:
    """Candidates by name, for a model that has the effects of ``recipe``."""
    device, extra = recipe.model().device, [effect_from(e) for e in recipe.extra]
    out = []
    for name in names:
        model = build_candidate_model(device, name, extra, recipe.effects)
        if model.key not in _candidates:
            _candidates[model.key] = compile_candidate(model)
        out.append(_candidates[model.key])
    return out


def acting_axes(recipe: Recipe, effect: str) -> tuple[int, ...]:
    """Numbers of the axes whose equation an effect changes, beside a model that may have it."""
    system = candidates_of(change_effects(recipe, (effect,)), (effect,))[0].system
    touched = range(len(system.coordinates)) if system.moves_sensors else system.touched
    item = next(item for item in system.model.effects if item.name == effect)
    named = [system.coordinates.index(axis) for axis in item.axes]
    return tuple(axis for axis in named if axis in touched) or tuple(touched)


_worker_state: Any = None
"""In a worker process: what its tasks are about, inherited from the process that started it."""


def _set_worker_state(state: object) -> None:
    global _worker_state
    _worker_state = state


def worker_state() -> Any:
    """What the tasks of this worker process are about."""
    return _worker_state


@contextmanager
def workers(state: object, jobs: int) -> Iterator[Callable[..., Iterator[Any]]]:
    """A `map` over processes that inherit ``state``, for `shared` to return."""
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
    """What every step of a diagnosis works with.

    Attributes:
        trials: the measured trials.
        criteria: what it takes for an effect to be called missing.
        jobs: worker processes; seed: of the noise of replicates.
        also: effects that are weighed on request only.
    """

    trials: MeasuredTrials
    criteria: Criteria
    jobs: int = 1
    seed: int = 0
    requested_effects: tuple[str, ...] = ()

    def candidate_names(self, recipe: Recipe, without: Collection[str] = ()) -> tuple[str, ...]:
        """Effects that the model of ``recipe`` could have and has not."""
        extra = [effect_from(e) for e in recipe.extra]
        present = (*recipe.effects, *without)
        names = list_candidates(recipe.model().device, present, extra)
        return (
            *names,
            *(name for name in self.requested_effects if name not in (*present, *names)),
        )

    def linearise(
        self, recipe: Recipe, p: Array, like: Evidence | None = None, judged: bool = False
    ) -> Evidence:
        """The model of ``recipe`` at parameters ``p``, (n_p,), on the trials that choose a model.

        Or, where asked for, on those by which it is ``judged``.
        """
        t = self._trial_subsets[judged]
        return gather_evidence(
            system_of(recipe), t.motions, t.band, p, t.folds,
            most_iterations=0, timing=t.timing,
            like=like,
        )  # fmt: skip

    @cached_property
    def _trial_subsets(self) -> list[MeasuredTrials]:
        """The trials that choose a model, and those by which one is judged."""
        choosing = np.array(self.trials.folds.groups) != HELD_OUT
        both = choosing, self.trials.folds.judged
        return [self.trials.subset(np.flatnonzero(counts).tolist()) for counts in both]

    def replicate(
        self, evidence: Evidence, p: Array, count: int, first: int = 0
    ) -> Sequence[Array]:
        """Residuals of a model on replays of itself, by trial, each (K, n_q, count).

        Args:
            evidence: the model on the measured trials; p: parameters that are replayed, (n_p,).
            count: of replays, numbered from ``first`` on.

        Raises:
            Runaway: the simulated motion grows without bounds.
        """
        seeds = [(self.seed, _SEED, k) for k in range(first, first + count)]
        return self._replicate(evidence, evidence.system, p, self.trials.sensors, seeds)

    def _replicate(
        self, e: Evidence, system: System, p: Array, sensors: Sensors, seeds: Sequence[Seed]
    ) -> Sequence[Array]:
        simulated = SimulatedTrials(system, p, e.motions, sensors.rate_hz)
        parts = [[seed] for seed in seeds] if self.jobs > 1 else [seeds]
        # Workers inherit what the machine does, which is the same in all replays.
        trials = range(min(len(simulated.courses), len(simulated.rests)))
        tasks = [(trial, part) for trial in trials for part in parts]
        state = e, simulated, sensors, self.trials.kinematics
        with workers(state, min(self.jobs, len(tasks))) as spread:
            found = spread(_replicate_trial, tasks)
            return KeptItems(np.concatenate([next(found) for _ in parts], axis=2) for _ in trials)

    def replicate_stopping(self, recipe: Recipe, evidence: Evidence) -> list[Array]:
        """Residual of a model on a replay without noise whose friction truly stops it, by trial.

        How abruptly a machine stops no log says. Zero where the motion is given, and where such a
        replay runs away. A robot is held on its path by controllers: there friction that stops a
        joint differs from one that creeps by the width of its sign alone.
        """
        t, nothing = self.trials, [np.zeros_like(r) for r in evidence.residual]
        if keep_motion(evidence.fitted):
            return nothing
        if evidence.system.model.device.robot is not None:
            return _narrower_friction(evidence)
        none = np.zeros(len(evidence.system.coordinates))
        exact = replace(
            t.sensors, resolution=none, reading_sd=none, force_sd=np.zeros_like(t.sensors.force_sd)
        )
        narrow = system_of(recipe.with_sign_widths(_STOPPING_WIDTH))
        try:
            found = self._replicate(evidence, narrow, evidence.p, exact, [(self.seed,)])
        except Runaway:
            return nothing
        return [values[:, :, 0] for values in found]

    def weight_samples(
        self, recipe: Recipe, evidence: Evidence, noise: Noise | None = None, count: int = 0
    ) -> Likelihood:
        """The likelihood of the trials of ``evidence``, with noise by replays of its model.

        Args:
            recipe: the model; evidence: linearised; noise: by replays of another one instead.
            count: of replays, at least two; those of the criteria by default.

        Raises:
            Runaway: the simulated motion grows without bounds.
        """
        c = self.criteria
        samples = lay_out_samples(evidence, c.block_s)
        if noise is None:
            replays = self.replicate(evidence, evidence.p, count or c.replicates)
            stopping = self.replicate_stopping(recipe, evidence)
            noise = describe_noise(replays, stopping, evidence, samples)
        force_sd = self.trials.sensors.force_sd
        return Likelihood.of(evidence, samples, noise, c.bias_error, c.discrepancy, force_sd)

    def fit(
        self, recipe: Recipe, start: Array, noise: Noise | None = None, lacking: float = np.inf
    ) -> Fit:
        """Fit a model under the likelihood, with noise by replays of itself.

        Args:
            recipe: the model; start: parameters to start from, (n_p,).
            noise: by replays of another model; by default of this one, at ``start``.
            lacking: scale from which on all samples of an axis weigh alike.

        Raises:
            Runaway: the simulated motion grows without bounds.
        """
        evidence, c = self.linearise(recipe, start), self.criteria
        likelihood = self.weight_samples(recipe, evidence, noise)
        evidence, problem = self._descend(recipe, evidence, likelihood)
        log_likelihood = problem.log_likelihood()
        # How far the bias may be off is known once the model is fitted.
        likelihood = self.weight_samples(recipe, evidence, likelihood.noise)
        likelihood = likelihood.with_heavy_tails(likelihood.pose_problem(evidence), c.tails)
        likelihood = likelihood.with_equal_weights(problem, lacking)
        evidence, problem = self._descend(recipe, evidence, likelihood)
        return Fit(recipe, evidence, likelihood, problem, log_likelihood)

    def _descend(
        self, recipe: Recipe, evidence: Evidence, likelihood: Likelihood
    ) -> tuple[Evidence, Problem]:
        """Gauss-Newton steps to the most likely parameters, within their bounds.

        A step is judged by the cost where it leads, nuisance parameters at their best there: what a
        linear problem promises of a shape can be far from what it keeps.

        Raises:
            ValueError: fewer samples are clear of standstill than there are parameters.
        """
        problem, count = likelihood.pose_problem(evidence), len(evidence.free)
        if sum(map(len, problem.y)) <= count:
            raise ValueError("fewer samples clear of standstill than parameters")
        here = problem.solve_nuisance(count).cost
        for _ in range(_MOST_STEPS):
            promised = problem.solve()
            if here - promised.cost < _CONVERGED:
                break
            step = problem.to_parameters @ promised.base
            for share in _STEP_LENGTHS:
                p = evidence.p.copy()
                p[list(evidence.free)] += share * step[:count]
                try:
                    moved = self.linearise(
                        recipe, np.clip(p, *bounds_of(evidence.system)), evidence
                    )
                except NotFinite:
                    continue
                tried = likelihood.pose_problem(moved)
                there = tried.solve_nuisance(count).cost
                if there < here:
                    break
            else:
                break
            evidence, problem, here = moved, tried, there
        return evidence, problem

    def judge(self, recipe: Recipe, p: Array, count: int = 0) -> Fit:
        """A given model, held against ``count`` replays of it, on all trials that are judged.

        Raises:
            Runaway: the simulated motion grows without bounds.
        """
        evidence = self.linearise(recipe, p, judged=True)
        likelihood = self.weight_samples(recipe, evidence, count=count)
        return Fit(recipe, evidence, likelihood, likelihood.pose_problem(evidence), is_given=True)

    def fit_plainly(self, recipe: Recipe, start: Array) -> Fit:
        """Fit a model with noise that is the same for all samples of an axis, without replays."""
        evidence = self.linearise(recipe, start)
        samples = lay_out_samples(evidence, self.criteria.block_s)
        nothing = [np.zeros_like(r) for r in evidence.residual]
        silent = [np.zeros((*r.shape, 2)) for r in evidence.residual]
        noise = describe_noise(silent, nothing, evidence, samples)
        flat = Likelihood.of(evidence, samples, noise, 0.0, 0.0, self.trials.sensors.force_sd)
        evidence, problem = self._descend(recipe, evidence, flat)
        return Fit(recipe, evidence, flat, problem)

    def try_fit(self, recipe: Recipe, start: Array) -> Fit | None:
        """`fit`; None where the model cannot be replayed, or has no finite residual."""
        try:
            return self.fit(recipe, start)
        except (Runaway, NotFinite):
            return None


def bounds_of(system: System) -> tuple[Array, Array]:
    """Lower and upper bounds of the parameters, (n_p,) each."""
    parameters = system.parameters
    return np.array([q.lower for q in parameters]), np.array([q.upper for q in parameters])


@dataclass(frozen=True)
class Fit:
    """A model fitted under the likelihood.

    Attributes:
        recipe: the model; evidence: its residual and slopes there.
        likelihood: noise and weights; problem: the weighted linear problem.
        log_likelihood: under the normal noise of its replays, nats, to rank fits whose noise comes
            from different replays; nan where the model was not fitted with such noise.
        given: whether its parameters are given, so that nuisance parameters alone are fitted.
    """

    recipe: Recipe
    evidence: Evidence
    likelihood: Likelihood
    problem: Problem
    log_likelihood: float = float("nan")
    is_given: bool = False

    @property
    def effect_parameters(self) -> dict[str, float]:
        """Values of the parameters of its effects, by name."""
        system = self.evidence.system
        count = len(system.model.device.parameters)
        pairs = zip(system.parameters[count:], self.evidence.p[count:], strict=True)
        return {item.name: float(value) for item, value in pairs}

    @cached_property
    def solution(self) -> LinearSolution:
        """The solution of its linear problem, next to zero but for the nuisance parameters."""
        if self.is_given:
            return self.problem.solve_nuisance(len(self.evidence.free))
        return self.problem.solve()

    @cached_property
    def bias(self) -> tuple[Array, ...]:
        """The bias of filters and of friction that stops, as fitted, by axis, each (n,)."""
        noise, n_q = self.likelihood.noise, len(self.likelihood.samples)
        factors = (self.problem.to_parameters @ self.solution.base)[-2 * n_q :]
        pairs = zip(noise.bias, noise.stopping, factors[:n_q], factors[n_q:], strict=True)
        return tuple(beta * b + gamma * c for b, c, beta, gamma in pairs)

    @cached_property
    def noise_floor(self) -> NoiseFloor:
        """What a model leaves that is the whole truth, by axis: noise of the sensors, and the bias.

        That of replays, with the factors of the bias that the measurement has. A machine may turn
        just as they do, or be off by what is not known of that, or anything between: of these
        floors, the one nearest to the error.
        """
        like, levels = self.likelihood, []
        parts = zip(
            like.noise.residuals, like.noise.bias, self.bias, like.bias_variance,
            self.rows_beyond_bias, strict=True,
        )  # fmt: skip
        for of_replays, b, bias, variance, left in parts:
            rows = of_replays - b + bias
            square = np.mean(rows**2, axis=1) if b.size else np.zeros(len(rows))
            off = rms(left + bias) ** 2 - float(np.median(square))
            more = float(variance.mean()) if b.size else 0.0
            levels.append(np.sqrt(square + np.clip(off, 0.0, more)))
        return NoiseFloor.of_errors([*np.array(levels).T])

    @property
    def is_above_floor(self) -> Flags:
        """Of each axis, whether its error is clearly above the noise floor, (n_q,)."""
        errors = zip(self.held_out_rmse, self.noise_floor.level, self.noise_floor.sd, strict=True)
        return np.array([compare_with_floor(*map(float, e)) == "above_floor" for e in errors])

    @property
    def creeping_floor(self) -> Array:
        """The error of replays that creep where they turn, as the device says, (n_q,), N.m or N."""
        return np.array([rms(rows) for rows in self.likelihood.noise.residuals])

    @cached_property
    def rows_beyond_bias(self) -> tuple[Array, ...]:
        """What is left once the bias is taken off, by axis, each (n,), N.m or N."""
        rows = zip(self.problem.y, self.problem.base, self.likelihood.root, strict=True)
        return tuple((y + x @ self.solution.base) / root for y, x, root in rows)

    def count_independent(self, criteria: Criteria) -> tuple[Samples, ...]:
        """The samples of each axis, with the number that are independent in what is left."""
        band = self.evidence.band
        lags = int(criteria.block_s * band.rate_hz / band.step)
        return self.likelihood.count_independent(self.problem, lags)

    @cached_property
    def held_out_rmse(self) -> Array:
        """Error on trials that parameters have not seen, nor timing, (n_q,), N.m or N, linearised.

        With one group of trials only, that of the fit.
        """
        return self.held_out_without()

    def held_out_without(self, effects: Iterable[str] = ()) -> Array:
        """`held_out_rmse` where some of the model's effects are taken away."""
        absent = {k: v for name in effects for k, v in self.problem.absence[name].items()}
        e, p, samples = self.evidence, self.problem, self.likelihood.samples
        groups, group_of = np.unique(e.folds.groups, return_inverse=True)
        parts = [group_of[here.trial] for here in samples]
        plain = [take_samples(e.residual, here, axis) for axis, here in enumerate(samples)]
        slopes = [take_samples(e.slopes, here, axis) for axis, here in enumerate(samples)]
        sums, squares, is_unseen = p.sums(), np.zeros(len(samples)), len(groups) > 1
        for k, own in enumerate(zip(*p.sums_of(parts, len(groups)), strict=True)):
            xx, xy, yy = (whole - is_unseen * part for whole, part in zip(sums, own, strict=True))
            yy = np.maximum(yy, 1e-300)
            others = solve_bounded(p, xx, xy, yy, absent=absent, weight=self.solution.weight)
            change = (p.to_parameters @ others.base)[: slopes[0].shape[1]]
            for axis, part in enumerate(parts):
                left = plain[axis][part == k] + slopes[axis][part == k] @ change
                squares[axis] += float(np.sum(left**2))
        return np.asarray(np.sqrt(squares / p.count))


def rms(values: Array) -> float:
    """Root mean square; 0 of nothing."""
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


def _replicate_trial(task: tuple[int, Sequence[Seed]]) -> Array:
    """The residuals of one trial on replays of it, by seed, (K, n_q, seeds)."""
    (e, simulated, sensors, kinematics), (trial, seeds) = worker_state(), task
    rows = []
    for seed in seeds:
        rng = np.random.default_rng([*seed, trial])
        motion = make_replicate(simulated, trial, sensors, kinematics, rng)
        rows.append(ModelOnTrial(e.system, e.p, [motion]).residual)
    thin = e.band.thin_trials(rows, range(len(e.system.coordinates)))
    return np.stack([values * e.used[trial] for values in thin], axis=2)


def _narrower_friction(evidence: Evidence) -> list[Array]:
    """What Coulomb friction leaves whose sign is narrower than the model's, by trial, (K, n_q)."""
    e = evidence
    width = e.system.sign_widths
    rows = (
        dry * (np.tanh(m.qd / (_STOPPING_WIDTH * width)) - np.tanh(m.qd / width))
        for dry, m in zip(dry_friction(e), e.motions, strict=True)
    )
    thin = e.band.thin_trials(rows, range(len(width)))
    return [values * used for values, used in zip(thin, e.used, strict=True)]


def change_effects(recipe: Recipe, gone: Collection[str], more: Sequence[str] = ()) -> Recipe:
    """The model without some of its effects, and with others."""
    return replace(recipe, effects=(*(e for e in recipe.effects if e not in gone), *more))
