"""The search for a formula on one axis: screened, held against chance, fitted with the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from bampipe.discover.bench import Bench
from bampipe.discover.chance import (
    Progress,
    fit_trials,
    open_trials,
    retimed_trials,
    stand_in_for,
    system_of,
    workers,
)
from bampipe.discover.drafts import symbolic
from bampipe.discover.drafts.forms import Form
from bampipe.discover.drafts.screen import Screen, Screened
from bampipe.discover.polish import FittedSet
from bampipe.discover.scorer import Score, Scorer
from bampipe.discover.settings import Settings
from bampipe.discover.start import with_effect
from bampipe.estimate.least_squares import fit
from bampipe.physics.recipe import Recipe
from bampipe.results.draft import ChanceOfDraft, CurveBound
from bampipe.trials.evidence import Evidence, gather_evidence
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.replay import replay_motions
from bampipe.trials.residuals import problem_of

Array = NDArray[np.float64]

MOST_TERMS = 2
MOST_LISTED = 5
_FITTED = (6, 3)
"""Forms refitted with the model, best of the first pass first: of the first term, of the next."""
_SEED = 11
"""First number, after the user's, of the seeds of these replays."""
_STEPS_OF_A_REPLAY = 4
"""Most Gauss-Newton steps of the fit to a replay: it starts at the parameters that made it."""


@dataclass(frozen=True)
class Term:
    """A form with its numbers.

    Attributes:
        form: what it is; name: of its effect, which differs where two terms have one form.
        values, sd: of its constants, by name, as fitted with the model.
        covariance: of them, in that order.
    """

    form: Form
    name: str
    values: dict[str, float]
    covariance: Array

    @property
    def sd(self) -> dict[str, float]:
        """Standard deviations of the constants."""
        spread = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return dict(zip(self.values, map(float, spread), strict=True))

    @property
    def canonical(self) -> str:
        """Its name as a model has it."""
        return self.name + self.form.canonical.removeprefix(self.form.name)

    def curve(self, count: int = 121) -> tuple[Array, Array, Array]:
        """Coordinate, torque and its standard deviation along the range travelled, (count,) each.

        At full speed or acceleration where the term is in proportion to these, in the positive
        direction of motion where it is friction, and at the upper end of what else it follows.
        """
        x = np.linspace(self.form.span.low, self.form.span.high, count)[:, None]
        others = [np.full((count, 1), span.high) for _, span in self.form.beside]
        x = np.hstack([x, *others])
        values = np.array(list(self.values.values()))
        middle = self._at(x, values)
        slopes = []
        for k in range(len(values)):
            moved, step = values.copy(), 1e-4 * max(abs(values[k]), 1e-9)
            moved[k] += step
            slopes.append((self._at(x, moved) - middle) / step)
        slope = np.array(slopes)
        variance = np.einsum("kt,kl,lt->t", slope, self.covariance, slope)
        return x[:, 0], middle, np.sqrt(np.maximum(variance, 0.0))

    def _at(self, x: Array, values: Array) -> Array:
        shape = self.form.shape
        known = dict(zip(self.values, values, strict=True))
        constants: dict[str, Any] = {n: v for n, (v, _) in self.form.fixed().items()} | known
        columns = (shape.drawn or shape.columns)(x, constants)
        found = sum(known[n] * c for n, c in zip(shape.strengths, columns, strict=True))
        return np.asarray(found)[:, 0]


@dataclass(frozen=True)
class Option:
    """A model with some terms, on the list of error against length.

    Attributes:
        terms: forms and the names of their effects.
        constants: how many numbers they have.
        held_out_rmse: by axis, (n_q,), N.m or N.
        slope: of the residual by the force, by axis, (n_q,); see `FittedSet.slope_by_force`.
    """

    terms: tuple[tuple[Form, str], ...]
    constants: int
    held_out_rmse: Array
    slope: Array

    def error(self, axis: int) -> float:
        """Held-out error over slope: making both sides of the equation small explains nothing."""
        return float(self.held_out_rmse[axis] / self.slope[axis])


@dataclass(frozen=True)
class FoundDraft:
    """What a search for a formula on one axis came to.

    Attributes:
        axis: its number.
        terms: found, at most `MOST_TERMS`.
        chance: of the first term, and of the next where one was looked for.
        noise_floor: median error of the replays that gave the last of these, N.m or N.
        options: error against number of constants, shortest first; the model as given first.
        before, after: held-out error without and with the terms, N.m or N.
        bound: what no formula in the first term's coordinate could do better; None without terms,
            and where it follows several quantities.
        wants_formulas: whether the structured forms left much, and pyoperon is not installed.
        recipe: the model with them; evidence: its fit.
    """

    axis: int
    terms: tuple[Term, ...]
    chance: tuple[ChanceOfDraft, ...]
    noise_floor: float
    options: tuple[Option, ...]
    before: float
    after: float
    bound: CurveBound | None
    wants_formulas: bool
    recipe: Recipe
    evidence: Evidence


Search = Literal["structured", "curves", "symbolic"]


def look(evidence: Evidence, axis: int, search: Search) -> Sequence[Screened]:
    """Forms that may explain the residual of ``axis``, best first; symbolic ones as well."""
    found = Screen(evidence, axis, search == "curves").search()
    if search == "symbolic":
        found += symbolic.search(Screen(evidence, axis))
    return sorted(found, key=lambda one: -one.gain)


@dataclass(frozen=True)
class ReplayTask:
    """A replay on which to search as on the measurement."""

    recipe: Recipe
    p: Array
    axis: int
    search: Search
    seed: tuple[int, ...]


def run_replay(task: ReplayTask) -> tuple[float, float]:
    """Gain of the best form on one replay, and error of the model there."""
    trials, system = open_trials(), system_of(task.recipe)
    stand_in = stand_in_for(trials, task.recipe, task.p)
    replays = replay_motions(stand_in, trials.sensors, trials.kinematics, task.seed)
    evidence = gather_evidence(
        system, replays, trials.band, task.p, trials.folds, most_iterations=_STEPS_OF_A_REPLAY
    )
    found = look(evidence, task.axis, task.search)
    error = float(Scorer(evidence).base_error[task.axis])
    return (found[0].gain if found else 0.0), error


@dataclass(frozen=True)
class FitTask:
    """A model to fit to the measured trials from a starting point."""

    recipe: Recipe
    start: Array


@dataclass(frozen=True)
class Fitted:
    """A fit of all parameters together, to inputs in the timing that goes with the model.

    Attributes:
        p: (n_p,) parameters.
        held_out_rmse, slope: error on held-out trials, N.m or N, and slope by the force, (n_q,).
        late_s: time taken off the inputs, s.
    """

    p: Array
    held_out_rmse: Array
    slope: Array
    late_s: float


def run_fit(task: FitTask) -> Fitted:
    """Fit a model and the timing of its inputs, within what is open."""
    trials = open_trials()
    evidence = fit_trials(trials, task.recipe, task.start)
    retimed = retimed_trials(trials, Scorer(evidence).late_s)
    if retimed is not trials:
        trials, evidence = retimed, fit_trials(retimed, task.recipe, evidence.p)
    slope = _slope(task.recipe, evidence, trials)
    return Fitted(evidence.p, evidence.held_out_rmse, slope, trials.late_s)


def _slope(recipe: Recipe, evidence: Evidence, trials: MeasuredTrials) -> Array:
    return FittedSet(recipe, (), evidence, trials).slope_by_force


def draft(
    trials: MeasuredTrials,
    recipe: Recipe,
    start: Array,
    axes: Sequence[int],
    settings: Settings,
    source: str,
    curves: bool = False,
    progress: Progress = lambda fraction, message: None,
) -> list[FoundDraft]:
    """Search a formula for what a model leaves on each of some axes, one after the other.

    Args:
        trials: the measured trials; recipe: the model; start: of its parameters, (n_p,).
        axes: numbers of the coordinates.
        settings: how carefully to look.
        source: that the effect files state.
        curves: whether a curve through points will do, where prediction is all that is wanted.
        progress: called with a fraction and a message.
    """
    found: list[FoundDraft] = []
    with workers(trials, settings.jobs) as pool:
        bench = Bench(trials, settings, pool, ())
        known = recipe
        for k, axis in enumerate(axes):
            name = recipe.model().device.coordinates[axis].name
            part = AxisSearch(bench, axis, source, curves)

            def tell(share: float, message: str, k: int = k, name: str = name) -> None:
                progress((k + share) / len(axes), f"{name}: {message}")

            found.append(part.run(known, start, tell))
            known, start = found[-1].recipe, found[-1].evidence.p
    return found


@dataclass(frozen=True)
class _Stand:
    """How far a search has come.

    Attributes:
        recipe: the model; evidence: its fit; option: the same as listed.
        options: everything that was fitted, the model as given first.
        chances: of each term that was looked for; floor: of the last replays, N.m or N.
    """

    recipe: Recipe
    evidence: Evidence
    option: Option
    options: tuple[Option, ...]
    chances: tuple[ChanceOfDraft, ...]
    floor: float


class AxisSearch:
    """The search for a formula on one axis."""

    def __init__(self, bench: Bench, axis: int, source: str, curves: bool) -> None:
        self._bench, self._axis = bench, axis
        self._source = source
        self._search: Search = "curves" if curves else "structured"

    @cached_property
    def _settings(self) -> Settings:
        return self._bench.settings

    def run(self, recipe: Recipe, start: Array, progress: Progress) -> FoundDraft:
        """Add terms to a model as long as one beats chance and is worth its constants."""
        axis = self._axis
        bare = self._bench.fit(recipe, start)
        slope = _slope(recipe, bare, self._bench.trials)
        nothing = Option((), 0, bare.held_out_rmse, slope)
        found = self._add_terms(_Stand(recipe, bare, nothing, (nothing,), (), 0.0), progress)
        wanting = self._search == "structured" and self._leaves_much(found)
        if wanting and symbolic.is_available():
            progress(0.85, "symbolic regression")
            found = self._breed(recipe, bare, found)
        terms = self._terms(found.evidence, found.option)
        before = float(bare.held_out_rmse[axis])
        bound = None
        if terms and not terms[0].form.beside:
            form = terms[0].form
            points, share = Screen(bare, axis).curve_bound(form)
            bound = CurveBound(
                variable=form.coordinate.words,
                acts_as=form.factor,
                points=points,
                held_out_rmse=share * before,
            )
        return FoundDraft(
            axis, terms, found.chances, found.floor, self._listed(found.options, found.option),
            before, float(found.option.held_out_rmse[axis]), bound,
            wanting and not symbolic.is_available(), found.recipe, found.evidence,
        )  # fmt: skip

    def _add_terms(self, stand: _Stand, progress: Progress) -> _Stand:
        """Structured forms, or curves, one after the other."""
        for number in range(MOST_TERMS):
            progress(0.05 + 0.4 * number, "holding every form against the residual")
            screened = look(stand.evidence, self._axis, self._search)
            progress(0.15 + 0.4 * number, "searching replays for as good a formula")
            chance, floor = self._chance(stand.recipe, stand.evidence, screened, self._search)
            stand = replace(stand, chances=(*stand.chances, chance), floor=floor)
            if chance.p_value > self._settings.draft_significance:
                break
            progress(0.3 + 0.4 * number, "fitting the best forms with the model")
            wider = self._fitted(
                stand.recipe, stand.evidence, stand.option, screened, _FITTED[number]
            )
            longer = self._cheaper(stand, wider)
            if longer.option is stand.option:
                return longer
            stand = longer
            if not self._leaves_much(stand):
                break  # what is left is for a diagnosis of the model with the draft
        return stand

    def _breed(self, recipe: Recipe, bare: Evidence, structured: _Stand) -> _Stand:
        """A formula by symbolic regression in place of the structured ones, where it is better."""
        bred = symbolic.search(Screen(bare, self._axis))
        if not bred:
            return structured
        chance, _ = self._chance(recipe, bare, bred, "symbolic")
        if chance.p_value > self._settings.draft_significance:
            return structured
        wider = self._fitted(recipe, bare, structured.options[0], bred, _FITTED[1])
        found = self._cheaper(structured, wider)
        return found if found.option is structured.option else replace(found, chances=(chance,))

    def _cheaper(self, stand: _Stand, wider: Sequence[tuple[Option, Recipe, Fitted]]) -> _Stand:
        """The best of some fitted models where it costs less, and all of them as options."""
        options = (*stand.options, *(option for option, _, _ in wider))
        option, recipe, fitted = min(wider, key=lambda entry: self._cost(entry[0]))
        if self._cost(option) >= self._cost(stand.option):
            return replace(stand, options=options)
        trials = self._bench.trials
        trials = retimed_trials(trials, fitted.late_s - trials.late_s)
        evidence = replace(self._bench, trials=trials).fit(recipe, fitted.p)
        return replace(stand, recipe=recipe, evidence=evidence, option=option, options=options)

    def _leaves_much(self, stand: _Stand) -> bool:
        error = float(Scorer(stand.evidence).base_error[self._axis])
        return error >= self._settings.surely * stand.floor

    def _cost(self, option: Option) -> float:
        """Log of the held-out error plus what its constants must be worth."""
        return (
            float(np.log(option.error(self._axis))) + self._settings.draft_worth * option.constants
        )

    def _chance(
        self,
        recipe: Recipe,
        evidence: Evidence,
        screened: Sequence[Screened],
        search: Search,
    ) -> tuple[ChanceOfDraft, float]:
        """Hold the best form's gain against what the same search finds on replays.

        Returns:
            Its chance, and the median error of the replays on the axis, N.m or N.
        """
        s = self._settings
        gain = screened[0].gain if screened else 0.0
        found = self._replays(recipe, evidence, search, 0, s.draft_replicates)
        p_value = self._p_value(gain, evidence, [g for g, _ in found])
        low, high = s.draft_significance / s.draft_close, s.draft_significance * s.draft_close
        if low < p_value < high:  # on either side, or it would be another chance of a false alarm
            more = 2 * s.draft_replicates
            found += self._replays(recipe, evidence, search, s.draft_replicates, more)
            p_value = self._p_value(gain, evidence, [g for g, _ in found])
        floor = float(np.median([error for _, error in found]))
        gains = tuple(g for g, _ in found)
        return ChanceOfDraft(gain=gain, gains=gains, p_value=p_value), floor

    def _replays(
        self, recipe: Recipe, evidence: Evidence, search: Search, first: int, count: int
    ) -> list[tuple[float, float]]:
        seed = (self._settings.seed, _SEED, self._axis, len(recipe.effects))
        tasks = [
            ReplayTask(recipe, evidence.p, self._axis, search, (*seed, k))
            for k in range(first, first + count)
        ]
        return list(self._bench.pool(run_replay, tasks))

    def _p_value(self, gain: float, evidence: Evidence, gains: Sequence[float]) -> float:
        """Chance of a gain, by Student's t: the best of all forms on each replay is one draw."""
        count = len(gains)
        # No replay is perfect: its log error is off by this, as a log likelihood.
        off = self._settings.replay_error * float(Scorer(evidence).independent_samples[self._axis])
        spread = np.hypot(np.std(gains, ddof=1) * np.sqrt(1.0 + 1.0 / count), off)
        return float(student.sf((gain - np.mean(gains)) / spread, count - 1))

    def _fitted(
        self,
        recipe: Recipe,
        evidence: Evidence,
        current: Option,
        screened: Sequence[Screened],
        count: int,
    ) -> list[tuple[Option, Recipe, Fitted]]:
        """The model with each of the best forms, all parameters fitted together."""
        least = self._settings.draft_rival_share * screened[0].gain
        chosen = [found for found in screened if found.gain >= least][:count]
        tasks, terms = [], []
        for found in chosen:
            taken = [name for _, name in current.terms]
            name = found.form.name if found.form.name not in taken else f"other_{found.form.name}"
            declaration = found.form.declaration(self._source, name)
            canonical = name + found.form.canonical.removeprefix(found.form.name)
            wider = replace(
                recipe,
                effects=(*recipe.effects, canonical),
                extra=(*recipe.extra, declaration),
            )
            values = np.array([
                found.values.get(short, entry_prior)
                for short, entry_prior in _priors(wider, canonical).items()
            ])  # fmt: skip
            score = Score(canonical, np.zeros(0), values, np.zeros(0), np.zeros(0))
            tasks.append(FitTask(wider, with_effect(wider, evidence, score)))
            terms.append((*current.terms, (found.form, name)))
        fits = self._bench.pool(run_fit, tasks)
        return [
            (
                Option(
                    term,
                    sum(form.constants for form, _ in term),
                    fitted.held_out_rmse,
                    fitted.slope,
                ),
                task.recipe,
                fitted,
            )
            for term, task, fitted in zip(terms, tasks, fits, strict=True)
        ]

    def _terms(self, evidence: Evidence, option: Option) -> tuple[Term, ...]:
        """The terms of the final model with values and covariance, fitted with all parameters."""
        trials = self._bench.trials
        problem = problem_of(evidence.system, evidence.motions, evidence.band)
        found = fit(
            problem, np.append(evidence.p, 0.0), trials=trials.folds.fitted_trials,
            most_iterations=1,
        )  # fmt: skip
        place = {int(i): k for k, i in enumerate(problem.free)}
        terms = []
        for form, name in option.terms:
            prefix = f"{name}.{form.target}" if form.target else name
            shape = form.shape
            short = [*shape.strengths, *shape.searched]
            index = [evidence.system.index(f"{prefix}.{constant}") for constant in short]
            rows = [place[i] for i in index]
            values = {c: float(evidence.p[i]) for c, i in zip(short, index, strict=True)}
            terms.append(Term(form, name, values, found.covariance[np.ix_(rows, rows)]))
        return tuple(terms)

    def _listed(self, options: Sequence[Option], chosen: Option) -> tuple[Option, ...]:
        """Options that no shorter one beats, the model as given first, and the chosen one."""
        ordered = sorted(options, key=lambda o: (o.constants, self._cost(o)))
        front: list[Option] = []
        for option in ordered:
            error = option.error(self._axis)
            if option is chosen or all(error < o.error(self._axis) for o in front):
                front.append(option)
        while len(front) > MOST_LISTED:
            front.remove(max((o for o in front if o is not chosen and o.terms), key=self._cost))
        return tuple(front)


def _priors(recipe: Recipe, effect: str) -> dict[str, float]:
    """Priors of the parameters of one effect of a model, by their short names."""
    system = system_of(recipe)
    prefix = f"{effect.replace(':', '.')}."
    return {
        p.name.removeprefix(prefix): p.prior for p in system.parameters if p.name.startswith(prefix)
    }
