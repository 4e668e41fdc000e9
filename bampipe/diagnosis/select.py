"""The selection of effects: search, fit the best set, and search again from there."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np

from bampipe.arrays import Array
from bampipe.diagnosis.dictionary import Atom, Dictionary, Key
from bampipe.diagnosis.probability import (
    FittedSet,
    Probabilities,
    compute_excess,
    weigh_sets,
)
from bampipe.diagnosis.ranges import MachineScale
from bampipe.diagnosis.search import STEP_LENGTHS, Pool, Search
from bampipe.diagnosis.session import (
    Fit,
    Session,
    bounds_of,
    candidates_of,
    change_effects,
    system_of,
    worker_state,
    workers,
)
from bampipe.diagnosis.set_cost import added_effects, effect_names, removed_effects
from bampipe.physics.model_spec import ModelSpec
from bampipe.results.compare import NOTICEABLE
from bampipe.trials.likelihood import Likelihood
from bampipe.trials.samples import take_samples

Progress = Callable[[float, str], None]
"""Called with the fraction of the work done and a description of the current step."""

_MOST_ROUNDS = 6
TASKS_PER_PROCESS = 8
"""Tasks per process into which columns are divided, as one candidate may take as long as ten."""
_MINOR_SHARE = 0.05
"""Smallest share of the gain of a set that a further effect must bring before the set is fitted: a
model linearised far from the truth leaves a larger residual than that."""
_LEAST_GAIN = 0.5
"""Smallest fall of the cost, nats, for which another set is fitted."""
_MOST_FITS = 2
"""Failed fits of a round after which only smaller sets are fitted, which gain more reliably; and
removals that are fitted if the model may lie far from the truth."""
_MOST_ADDED = 3
"""Largest number of effects added at once to a set that has been fitted."""


@dataclass(frozen=True)
class Selection:
    """The result of a selection.

    Attributes:
        initial: the fit of the given model; final: the fit with the most probable set.
        probabilities: probabilities of sets, effects and unknown functions beside the final model.
        replicate_gains: largest gain of any candidate on each replicate of the final model, nats.
        largest_gain: the same on the measured trials, and the candidate.
        gains: log evidence of each single effect beside the given model, nats.
        cut_short: whether the search ended at a limit on effects or rounds.
    """

    initial: Fit
    final: Fit
    probabilities: Probabilities
    replicate_gains: tuple[float, ...]
    largest_gain: tuple[float, str]
    gains: dict[str, float]
    cut_short: bool

    @property
    def effects(self) -> tuple[str, ...]:
        """Effects that the most probable set adds to the given model."""
        return tuple(e for e in self.final.spec.effects if e not in self.initial.spec.effects)


@contextmanager
def open_search(
    session: Session,
    fit: Fit,
    without: Collection[str] = (),
    known: Search | None = None,
    only: Sequence[str] = (),
) -> Iterator[Search]:
    """Open a search over the candidates beside a fitted model, with columns from worker processes.

    Args:
        without: effects that are excluded; only: the only effects to consider, if any.
        known: a search beside another model, whose equal columns are reused.
    """
    wanted = only or session.candidate_names(fit.spec, without)
    axes, found = fit.linearisation.system.coordinates, candidates_of(fit.spec, wanted)
    at_rest = {a for a, own in zip(axes, fit.likelihood.samples, strict=True) if not len(own.rows)}
    candidates = {c.name: c for c in found if at_rest.isdisjoint(c.system.model.effects[-1].axes)}
    # The shapes of a candidate are shares of its range, which therefore must not change.
    scale = known.dictionary.scale if known else MachineScale.of_trials(fit.linearisation)
    dictionary = Dictionary(fit.linearisation, fit.likelihood.samples, candidates, scale)
    with workers(dictionary, session.jobs) as spread:

        def make(keys: Sequence[Key]) -> Iterable[tuple[Key, Atom | None]]:
            parts = min(len(keys), TASKS_PER_PROCESS * session.jobs)
            if session.jobs <= 1 or parts < 2:
                return make_columns(keys, dictionary)
            made = spread(make_columns, [keys[k::parts] for k in range(parts)])
            return [pair for part in made for pair in part]

        yield Search(fit.problem, dictionary, make, session.criteria, _reusable(known, dictionary))


def make_columns(
    keys: Sequence[Key], dictionary: Dictionary | None = None
) -> list[tuple[Key, Atom | None]]:
    """Compute columns with a dictionary, by default that of this worker process."""
    dictionary = dictionary or worker_state()
    return [(key, dictionary.make(key)) for key in keys]


def _reusable(known: Search | None, dictionary: Dictionary) -> dict[Key, Atom | None]:
    """Return the columns of a known search whose candidates do not interact with either model."""
    if known is None or any(
        d.linearisation.system.moves_sensors for d in (known.dictionary, dictionary)
    ):
        return {}
    same = {
        name
        for name, item in dictionary.candidates.items()
        if known.dictionary.candidates.get(name) is item
    }
    return {key: atom for key, atom in known.atoms.items() if key[0] in same}


def select_effects(
    session: Session,
    spec: ModelSpec,
    start: Array,
    without: Collection[str] = (),
    progress: Progress = lambda fraction, message: None,
) -> Selection:
    """Find the most probable set of effects that a model lacks.

    Args:
        spec: the model; start: its initial parameters, (n_p,).
        without: effects that are excluded.

    Raises:
        Runaway: the given model cannot be simulated.
    """
    progress(0.0, "simulating replicates of the model")
    initial = current = session.fit(spec, start)
    earlier = [current]
    fits: dict[frozenset[str], Fit | None] = {frozenset(spec.effects): current}
    gains: dict[str, float] = {}
    known: Search | None = None
    last, left_out = False, set[str]()
    for number in range(_MOST_ROUNDS + 1):
        progress(0.1 + 0.1 * number, "weighing sets of effects")
        with open_search(session, current, {*without, *left_out}, known) as search:
            known = search
            if not gains:
                beside = search.rank_additions((), len(search.dictionary.candidates))
                gains = {key[0]: search.cost(()) - cost for cost, key in beside}
            room = session.criteria.most_effects - len(current.spec.effects) + len(spec.effects)
            pool = _explore(search, room, deep=room if number == 0 else min(_MOST_ADDED, room))
            moved, kept = None, dict[tuple[str, ...], FittedSet]()
            last |= number >= _MOST_ROUNDS - 1
            # Where the best set leaves something unknown, its residual recurs: of its samples, only
            # those that are independent tell whether another fit is worthwhile.
            left = search.residual_rows(min(pool.values())[1])
            costs = search.with_independent(current.count_independent(session.criteria, left))
            pool = {name: (costs.cost(keys), keys) for name, (_, keys) in pool.items()}
            none = costs.cost(())
            if not last:
                # The bias of the present replicates may hide an effect that only its prior rejects.
                better = [
                    keys
                    for cost, keys in sorted(pool.values())
                    if keys and cost < none + max(costs.penalty_of(keys), -_LEAST_GAIN)
                ]
                better += _without_weakest(costs, spec.effects)
                tell = partial(progress, 0.15 + 0.1 * number)
                moved, kept = _fit_better(session, costs, current, better, fits, tell)
                # Under the noise of its own replicates, an earlier set may seem better again.
                last |= any(moved is one for one in earlier)
            if moved is None:
                # The gain of a fitted set is that of its fit, not that of its linear problem.
                pool = {
                    n: one for n, one in pool.items() if n in kept or one[0] >= none - _LEAST_GAIN
                }
                progress(0.9, "comparing the gains with those on replicates")
                replicate_gains = search.replicate_gains()
                probabilities = weigh_sets(
                    search, current, pool, kept, spec.effects, session.criteria, session.seed
                )
                if number < _MOST_ROUNDS:
                    moved = _leave_out(session, search, current, probabilities, spec.effects)
                if moved is None:
                    return Selection(
                        initial, current, probabilities, replicate_gains, search.largest_gain(),
                        gains, number >= _MOST_ROUNDS - 1 or room <= 0,
                    )  # fmt: skip
                # After a second removal, nothing more is added.
                last |= bool(left_out)
                left_out |= {*current.spec.effects} - {*moved.spec.effects}
        current = moved
        earlier.append(current)
    raise AssertionError("the last round returns")


def _fit_better(
    session: Session,
    search: Search,
    current: Fit,
    better: Sequence[tuple[Key, ...]],
    fits: dict[frozenset[str], Fit | None],
    tell: Callable[[str], None],
) -> tuple[Fit | None, dict[tuple[str, ...], FittedSet]]:
    """Fit the sets ``better`` in turn until the fit of one is better than the current model.

    A set that fits held-out trials worse is no more probable, even if its log evidence is higher.

    Returns:
        The better fit, if any, and the fits that are not better, by effects.
    """
    broken: list[set[Key]] = []
    kept: dict[tuple[str, ...], FittedSet] = {}
    for keys in better:
        if added_effects(keys) and len(broken) >= _MOST_FITS and len(keys) >= min(map(len, broken)):
            continue
        # A set that contains one whose fit failed is no better.
        if any(one <= {*keys} for one in broken):
            continue
        wider = change_set(current.spec, keys)
        members = frozenset(wider.effects)
        if fresh := members not in fits:
            tell(f"fitting {', '.join(effect_names(keys))}")
            fits[members] = session.try_fit(wider, start_of(search, keys, wider))
        moved = fits[members]
        if moved is not None:
            gain, held_out = gains_when_fitted(current, moved, search, keys)
            if gain > _LEAST_GAIN:  # a set that averages noise of the motion gains nothing by it
                noise = np.minimum(session.compare_noise(current, moved), 1.0)
                share = 1.0 / np.maximum(moved.solution.left / moved.problem.count, 1.0)
                averaged = np.log(1.0 - share * (1.0 - noise))
                gain += 0.5 * float(search.problem.independent @ averaged)
            if gain > _LEAST_GAIN and held_out > -NOTICEABLE:
                return moved, kept
            rows = zip(moved.rows_beyond_bias, current.likelihood.root, strict=True)
            short = search.cost(()) - search.cost(keys) - min(gain, _LEAST_GAIN)
            short /= max(float(search.problem.independent.sum()), 1.0)
            kept[effect_names(keys)] = FittedSet(short, [row * root for row, root in rows])
        broken.append({*keys})
        if fresh:
            fits[members] = None
    return None, kept


def _without_weakest(search: Search, given: Collection[str]) -> list[tuple[Key, ...]]:
    """Return the removals of the weakest effects if the shapes of others could replace them.

    The linear problem at the present shapes does not show how well they could. It may be wrong of
    several effects where a residual exceeds noise and discrepancy, else of the weakest alone.
    """
    p = search.problem
    own = sorted(
        (e for e in p.absence if e not in given), key=lambda e: search.cost(((f"-{e}", ()),))
    )
    shaped = {e for e in own if p.shapes[e]}
    weakest: list[tuple[Key, ...]] = [((f"-{e}", ()),) for e in own if shaped - {e}]
    return weakest[: _MOST_FITS if np.any(compute_excess(search) > 0.5) else 1]


def _leave_out(
    session: Session, search: Search, fit: Fit, probabilities: Probabilities, given: Collection[str]
) -> Fit | None:
    """Fit the model without its improbable effects; None if it has none.

    The most probable set takes their place. An effect that an unknown function could replace stays
    if it lowers the held-out error.
    """
    least = 1.0 - session.criteria.probability
    own = [e for e in fit.spec.effects if e not in given]
    out = {e for e in own if probabilities.if_all_known.get(e, 0.0) < least}
    out = out or _find_misleading(fit, probabilities, own)
    if not out:
        return None
    best = next(one.keys for one in probabilities.sets if one.unknown is None)
    best = best if out.intersection(removed_effects(best)) else ()
    keys = tuple(sorted({*best, *((f"-{e}", ()) for e in out)}))
    less = change_set(fit.spec, keys)
    if np.isfinite(search.cost(keys)):
        return session.try_fit(less, start_of(search, keys, less))
    return session.try_fit(less, start_at(search, np.zeros(search.bb.shape[1]), {}, less))


def _find_misleading(fit: Fit, probabilities: Probabilities, own: Sequence[str]) -> set[str]:
    """Return the effects that are less probable than not and raise the held-out error."""
    rows, like = fit.held_out_rows, fit.likelihood
    out, least = set[str](), _log_squares(like, rows()).sum()
    while doubtful := [e for e in own if e not in out and probabilities.effects.get(e, 0.0) < 0.5]:
        left, worst = min((_log_squares(like, rows({*out, e})).sum(), e) for e in doubtful)
        if left >= least:
            break
        out, least = {*out, worst}, left
    return out


def _log_squares(likelihood: Likelihood, rows: Iterable[Array]) -> Array:
    """Return half the log of the weighted sum of squares of a residual, by axis, (n_q,)."""
    weighted = (row * root for row, root in zip(rows, likelihood.root, strict=True))
    return 0.5 * np.log([max(float(row @ row), 1e-300) for row in weighted])


def gains_when_fitted(
    before: Fit, after: Fit, search: Search, keys: Sequence[Key]
) -> tuple[float, float]:
    """Return what a set gains by its fit, under the weights of ``before``.

    ``before`` and ``after`` are fits without and with the set ``keys``.

    Returns:
        The log evidence, nats, and the log of the factor by which the error on held-out trials
        falls beside that of the measured force, summed over the axes.
    """
    if any(len(a) != len(b) for a, b in zip(before.problem.y, after.problem.y, strict=True)):
        return np.inf, np.inf
    volume = search.volume_where_fitted(keys, after.linearisation)
    if volume is None:
        return -np.inf, -np.inf
    like = before.likelihood
    with_set, without = [
        [_log_squares(like, rows) for rows in (fit.rows_beyond_bias, fit.held_out_rows())]
        for fit in (after, before)
    ]
    seen, held_out = np.subtract(without, with_set)
    independent = search.problem.independent
    gain = float(independent @ seen + volume.sum()) - search.solve(keys).penalty
    return gain, float(np.sum(held_out + volume / np.maximum(independent, 1e-300)))


def _explore(search: Search, room: int, deep: int) -> Pool:
    """Return sets near the fitted one: with members removed, exchanged and added."""
    pool: Pool = {}
    search.add_to_pool(pool, [()])
    lead = search.cost(())
    rest: tuple[Key, ...] | None = ()
    while rest is not None:  # backward elimination, as long as the probability rises
        fewer, least = search.drop_each(rest), search.cost(rest)
        search.add_to_pool(pool, fewer)
        better = (keys for keys in fewer if search.cost(keys) < least)
        rest = min(better, key=search.cost, default=None)
    search.add_to_pool(pool, search.refine(search.list_swaps((), pool), 2))
    for beam in search.grow_sets(deep):
        search.add_to_pool(pool, (keys for _, keys in beam))
        best = min(cost for cost, _ in beam)
        gained, total = lead - best, search.cost(()) - best
        if gained < _LEAST_GAIN or gained < _MINOR_SHARE * total:
            # Minor effects wait until the others have been fitted.
            if gained > 0.0 and gained < total:
                largest = max(len(keys) for _, keys in beam)
                for name in [n for n, (_, keys) in pool.items() if len(keys) >= largest]:
                    del pool[name]
            break
        lead = best
    return pool


def change_set(spec: ModelSpec, keys: Sequence[Key]) -> ModelSpec:
    """Return the model of ``spec`` with the changes of a set."""
    return change_effects(spec, removed_effects(keys), [name for name, _ in added_effects(keys)])


def start_of(search: Search, keys: Sequence[Key], wider: ModelSpec) -> Array:
    """Return the parameters of a changed model from the solution of its set, (n_p,).

    Of steps of several lengths, that with the least residual: shapes of the model that the linear
    problem moves far may end where the model is much worse.
    """
    solution, known = search.solve(keys), dict[str, float]()
    for key, strength in zip(added_effects(tuple(sorted(keys))), solution.strengths, strict=True):
        item = search.dictionary.candidates[key[0]]
        values = search.dictionary.values(key)
        share = 1.0 if item.linear_indices else float(strength[0])
        known |= {
            q.name: share * v if q.strength else v
            for i, v in zip(item.searched_indices, values, strict=True)
            for q in [item.parameters[i]]
        }
        known |= {
            item.parameters[i].name: v for i, v in zip(item.linear_indices, strength, strict=False)
        }
    starts = [start_at(search, share * solution.base, known, wider) for share in STEP_LENGTHS]
    return min(starts, key=lambda p: _misfit(search, wider, p))


def _misfit(search: Search, spec: ModelSpec, p: Array) -> float:
    """Return the misfit of the trials at parameters ``p``, (n_p,), nats up to a constant."""
    like = search.problem.likelihood
    rows = search.dictionary.linearisation.residual_of(system_of(spec), p)
    left = (take_samples(rows, here, axis) for axis, here in enumerate(like.samples))
    cost = float(search.problem.independent @ _log_squares(like, left))
    return cost if np.isfinite(cost) else np.inf


def start_at(search: Search, base: Array, known: Mapping[str, float], wider: ModelSpec) -> Array:
    """Return the parameters of a changed model within their bounds, (n_p,).

    They are those of the model after the change ``base`` of its linear problem, and ``known`` ones.
    """
    linearisation = search.dictionary.linearisation
    found = linearisation.system.by_name(linearisation.p)
    change = search.problem.to_parameters @ base
    for place, number in enumerate(linearisation.free):
        found[linearisation.system.parameters[number].name] += change[place]
    found |= known
    system = system_of(wider)
    start = np.array([found.get(q.name, q.prior) for q in system.parameters])
    return np.asarray(np.clip(start, *bounds_of(system)))
