"""The search for a formula on one axis.

A form is a candidate of a `Search` like an effect of the library, with the same log evidence. Of
all forms on grids, the best are refined, and the best of these fitted with the whole model.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import cast

import numpy as np
from scipy.optimize import minimize

from bampipe.arrays import Array
from bampipe.diagnosis.dictionary import Dictionary, Key
from bampipe.diagnosis.drafts import symbolic
from bampipe.diagnosis.drafts.columns import FormDictionary
from bampipe.diagnosis.drafts.forms import Form
from bampipe.diagnosis.drafts.terms import Term
from bampipe.diagnosis.probability import compute_p_value
from bampipe.diagnosis.search import Search
from bampipe.diagnosis.select import TASKS_PER_PROCESS, Progress, make_columns, start_at
from bampipe.diagnosis.session import Fit, Session, worker_state, workers
from bampipe.physics.model_spec import ModelSpec
from bampipe.results.draft import ChanceOfDraft

MOST_TERMS = 2
"""Largest number of formulas; any further residual is left to a diagnosis of the new model."""
_REFINED, _FITTED = 12, 4
"""Number of forms whose shapes are refined, and of those that are fitted with the model."""
_TRIES = 90
"""Largest number of evaluations of a refinement."""
_STEPS = {"place": 0.02, "length": 0.03, "time": 0.03, "wavenumber": 2e-4, "number": 0.003}
"""First step of the refinement of a shape, as a share of its range, by kind."""


@dataclass(frozen=True)
class Option:
    """The fit of a model with some terms.

    Attributes:
        held_out_rmse: held-out error of the axis, N.m or N.
        log_evidence: log evidence over the given model, nats.
        spec: the model; p: its parameters, (n_p,).
    """

    terms: tuple[Form, ...]
    held_out_rmse: float
    log_evidence: float
    spec: ModelSpec
    p: Array

    @property
    def constants(self) -> int:
        """Number of constants of the terms."""
        return sum(len(form.parameters) for form in self.terms)


@dataclass(frozen=True)
class FoundDraft:
    """The result of a search for a formula on one axis.

    Attributes:
        chance: null distribution of each search for a term, in order.
        noise_floor: noise floor of the final model, N.m or N.
        options: all fits, that of the given model first; chosen: that of the final model.
        wants_formulas: whether symbolic regression should follow, but pyoperon is not installed.
    """

    axis: int
    terms: tuple[Term, ...]
    chance: tuple[ChanceOfDraft, ...]
    noise_floor: float
    options: tuple[Option, ...]
    chosen: Option
    wants_formulas: bool


class FormSearch(Search):
    """A search over forms beside one fitted model."""

    def __init__(self, session: Session, fit: Fit, forms: FormDictionary) -> None:
        self.forms, self.fit = forms, fit
        known = cast(Dictionary, forms)  # has the same interface
        keys = [key for name in forms.candidates for key in forms.grid(name)]
        parts = TASKS_PER_PROCESS * session.jobs
        with workers(forms, session.jobs) as spread:
            made = spread(make_columns, [keys[k::parts] for k in range(parts)])
            atoms = {key: atom for part in made for key, atom in part}
        make = partial(make_columns, dictionary=known)
        super().__init__(fit.problem, known, make, session.criteria, atoms)

    def best_forms(self, count: int, jobs: int) -> list[Key]:
        """Return the forms that gain most, with refined shapes, best first."""
        with workers(self, jobs) as spread:
            found = list(spread(_refine, [key for _, key in self.rank_additions((), count)]))
        self.ensure(found)
        found = [key for key in found if self.cost((key,)) < self.cost(())]
        return sorted(found, key=lambda key: self.cost((key,)))

    def refine_form(self, key: Key) -> Key:
        """Minimise the cost of a form over its shape by the method of Nelder and Mead."""
        name, shape = key
        if not shape:
            return key

        def cost(u: Array) -> float:
            here = (name, tuple(map(float, np.clip(u, 0.0, 1.0))))
            self.ensure([here])
            return min(self.cost((here,)), 1e30)

        kinds = self.forms.candidates[name].shape.searched.values()
        start, steps = np.array(shape), np.array([_STEPS[kind] for kind in kinds])
        steps = np.where(start + steps > 1.0, -steps, steps)
        simplex = np.vstack([start, start + np.diag(steps)])
        options = {"maxfev": _TRIES, "initial_simplex": simplex, "xatol": 1e-7, "fatol": 1e-3}
        found = minimize(cost, start, method="Nelder-Mead", options=options).x
        return name, tuple(map(float, np.clip(found, 0.0, 1.0)))


def _refine(key: Key) -> Key:
    search: FormSearch = worker_state()
    return search.refine_form(key)


def draft_formulas(
    session: Session,
    spec: ModelSpec,
    start: Array,
    axes: Sequence[int],
    source: str,
    curves: bool = False,
    progress: Progress = lambda fraction, message: None,
) -> list[FoundDraft]:
    """Search for formulas that explain the residual of a model, one axis after the other.

    Args:
        start: initial parameters of the model, (n_p,); axes: indices of the coordinates.
        source: source stated in the effect files.
        curves: whether to draft curves through points instead, for prediction only.

    Raises:
        Runaway: the model cannot be simulated.
    """
    found: list[FoundDraft] = []
    for k, axis in enumerate(axes):
        name = spec.model().device.coordinates[axis].name

        def tell(fraction: float, message: str, k: int = k, name: str = name) -> None:
            progress((k + fraction) / len(axes), f"{name}: {message}")

        found.append(_AxisSearch(session, axis, source, curves).run(spec, start, tell))
        spec, start = found[-1].chosen.spec, found[-1].chosen.p
    return found


@dataclass(frozen=True)
class _AxisSearch:
    """The search for a formula on one axis."""

    session: Session
    axis: int
    source: str
    curves: bool

    def run(self, spec: ModelSpec, start: Array, progress: Progress) -> FoundDraft:
        """Add terms to a model while one gains more than chance and lowers the held-out error."""
        bare, least = self.session.fit(spec, start), self.session.criteria.largest_p_value
        given = Option((), self._error_of(bare), 0.0, spec, bare.linearisation.p)
        options, chances, stand = [given], [], (bare, given)
        for number in range(MOST_TERMS):
            progress(0.05 + 0.4 * number, "comparing every form with the residual")
            search, before = self._open(stand[0]), stand[1]
            progress(0.15 + 0.4 * number, "searching replicates for as good a formula")
            chances.append(weigh_chance(search))
            if chances[-1].p_value > least:
                break
            progress(0.3 + 0.4 * number, "fitting the best forms with the model")
            tried = self._fit_forms(search, before)
            options += tried
            stand = self._take(stand, tried)
            if stand[1] is before or not stand[0].is_above_floor[self.axis]:
                break
        wanted = not self.curves and chances[0].p_value <= least
        wanted = wanted and bool(stand[0].is_above_floor[self.axis])
        if wanted and symbolic.is_available():
            progress(0.85, "symbolic regression")
            tried = self._fit_forms(self._open(bare, bred=True), given)
            options += tried
            stand = self._take(stand, tried)
        fit, chosen = stand
        chosen = replace(chosen, held_out_rmse=self._error_of(fit), p=fit.linearisation.p)
        options = [chosen if o.terms == chosen.terms else o for o in options]
        return FoundDraft(
            self.axis, _terms(fit, chosen), tuple(chances),
            float(fit.noise_floor.level[self.axis]), tuple(options), chosen,
            wanted and not symbolic.is_available(),
        )  # fmt: skip

    def _error_of(self, fit: Fit) -> float:
        """Return the held-out error of the axis, N.m or N."""
        return float(fit.held_out_rmse[self.axis])

    def _open(self, fit: Fit, bred: bool = False) -> FormSearch:
        """Open a search over the forms of the grammar, or over ``bred`` formulas."""
        forms = FormDictionary(fit.linearisation, fit.likelihood.samples, self.axis)
        if bred:
            symbolic.breed(forms, fit.problem)
        else:
            left = fit.problem.y[self.axis] / fit.likelihood.root[self.axis]
            forms.add_grammar(self.curves, left if self.curves else None)
        return FormSearch(self.session, fit, forms)

    def _take(self, stand: tuple[Fit, Option], tried: Sequence[Option]) -> tuple[Fit, Option]:
        """Fit the most probable model that lowers the held-out error, or return ``stand``."""
        chosen = stand[1]
        lower = [o for o in tried if o.held_out_rmse < chosen.held_out_rmse]
        best = max((chosen, *lower), key=lambda option: option.log_evidence)
        if best is chosen:
            return stand
        return self.session.fit(best.spec, best.p), best

    def _fit_forms(self, search: FormSearch, current: Option) -> list[Option]:
        """Fit the model with each of the best forms, all parameters together."""
        keys = search.best_forms(_REFINED, self.session.jobs)[:_FITTED]
        terms, tasks = [], []
        taken = {declared["name"] for declared in current.spec.extra}
        for key in keys:
            form, solution = search.forms.candidates[key[0]], search.solve((key,))
            while form.name in taken:
                form = replace(form, prefix=f"other_{form.prefix}")
            wider = replace(
                current.spec,
                effects=(*current.spec.effects, form.canonical_name),
                extra=(*current.spec.extra, form.declaration(self.source)),
            )
            strengths = dict(zip(form.shape.strengths, solution.strengths[0], strict=True))
            values = search.forms.values(key) | strengths
            known = {form.parameters[name]: value for name, value in values.items()}
            start = start_at(search, solution.base, known, wider)
            terms.append((*current.terms, form))
            tasks.append((wider, start))
        jobs = min(self.session.jobs, len(tasks))
        with workers((self, search.fit.likelihood.noise), jobs) as spread:
            fits = list(spread(_fit_form, tasks))
        found = []
        for key, term, (wider, _), (cost, held_out, p) in zip(
            keys, terms, tasks, fits, strict=True
        ):
            gain = search.fit.solution.cost - cost - search.solve((key,)).penalty
            found.append(Option(term, held_out, current.log_evidence + gain, wider, p))
        return found


def _fit_form(task: tuple[ModelSpec, Array]) -> tuple[float, float, Array]:
    """Return cost, held-out error and parameters of the fit of a model with a form."""
    search, noise = worker_state()
    fit = search.session.fit(*task, noise)
    return fit.solution.cost, float(fit.held_out_rmse[search.axis]), fit.linearisation.p


def weigh_chance(search: FormSearch) -> ChanceOfDraft:
    """Compare the gain of the best form with the gains on replicates of the model."""
    gains, gain = search.replicate_gains(), search.largest_gain()[0]
    return ChanceOfDraft(gain=gain, gains=gains, p_value=compute_p_value(gain, gains))


def _terms(fit: Fit, option: Option) -> tuple[Term, ...]:
    """Return the terms of a fitted model with values and covariance, all parameters free."""
    e, p = fit.linearisation, fit.problem
    solved = p.solve()
    normal = np.tensordot(solved.weight, p.sums()[0], 1) + p.precision
    covariance = p.to_parameters @ np.linalg.pinv(normal, hermitian=True) @ p.to_parameters.T
    place = {e.system.parameters[i].name: k for k, i in enumerate(e.free)}
    found = []
    for form in option.terms:
        rows = [place[name] for name in form.parameters.values()]
        values = {c: float(e.p[e.system.index(n)]) for c, n in form.parameters.items()}
        found.append(Term(form, values, covariance[np.ix_(rows, rows)]))
    return tuple(found)
