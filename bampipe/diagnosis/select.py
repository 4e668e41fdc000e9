"""The selection of effects: search, fit what was found, and search again from there."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np

from bampipe.arrays import Array
from bampipe.diagnosis.dictionary import Atom, Dictionary, Key
from bampipe.diagnosis.probability import Probabilities, weigh_sets
from bampipe.diagnosis.ranges import MachineScale
from bampipe.diagnosis.search import Pool, Search
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
from bampipe.physics.recipe import Recipe
from bampipe.results.compare import NOTICEABLE

Progress = Callable[[float, str], None]
"""Called with a fraction of the work done and what is being done."""

_MOST_ROUNDS = 6
TASKS_PER_PROCESS = 8
"""Tasks a process into which columns are divided: one candidate may take as long as ten others."""
_MINOR_SHARE = 0.05
"""Share of the gain of a set that the next effect must bring to be added before the set is fitted:
linearised far from the truth, a model leaves more than that."""
_LEAST_GAIN = 0.5
"""Fall of the cost, nats, that makes another set worth fitting."""
_MOST_FITS = 2
"""Sets fitted in a round before only smaller ones are: these keep more of what they promise."""
_MOST_ADDED = 3
"""Effects added at once beside a set that has been fitted."""


@dataclass(frozen=True)
class Selection:
    """What a search came to.

    Attributes:
        initial: the model as given, fitted; final: with the set that is most probable.
        weighed: sets near it, effects and unknown functions with their probabilities.
        chance: the largest gain of any candidate beside the final model on each replay, nats.
        beside: the same on the measured trials, and of which candidate.
        gains: log evidence of the model as given with each single effect, nats, by effect.
        steps: the sets that were fitted, in order.
        cut_short: whether more effects were wanted than may be added.
    """

    initial: Fit
    final: Fit
    probabilities: Probabilities
    replicate_gains: tuple[float, ...]
    largest_gain: tuple[float, str]
    gains: dict[str, float]
    steps: tuple[Fit, ...]
    cut_short: bool

    @property
    def effects(self) -> tuple[str, ...]:
        """Of the most probable set, beyond those of the model as given."""
        return tuple(e for e in self.final.recipe.effects if e not in self.initial.recipe.effects)


@contextmanager
def open_search(
    session: Session,
    fit: Fit,
    without: Collection[str] = (),
    known: Search | None = None,
    only: Sequence[str] = (),
) -> Iterator[Search]:
    """A search over the candidates beside a fitted model, its columns made by several processes.

    Args:
        session: the trials; fit: the model; without: effects that are not weighed.
        known: a search beside another model, of which columns that are the same are taken.
        only: effects that are weighed in place of all.
    """
    wanted = only or session.candidate_names(fit.recipe, without)
    candidates = {c.name: c for c in candidates_of(fit.recipe, wanted)}
    # The shapes of a candidate are shares of its range, so that this must stay.
    scale = known.dictionary.scale if known else MachineScale.of_trials(fit.evidence)
    dictionary = Dictionary(fit.evidence, fit.likelihood.samples, candidates, scale)
    with workers(dictionary, session.jobs) as spread:

        def make(keys: Sequence[Key]) -> Iterable[tuple[Key, Atom | None]]:
            parts = min(len(keys), TASKS_PER_PROCESS * session.jobs)
            if session.jobs <= 1 or parts < 2:
                return dictionary.make_all(keys)
            made = spread(make_columns, [keys[k::parts] for k in range(parts)])
            return [pair for part in made for pair in part]

        yield Search(fit.problem, dictionary, make, session.criteria, _reusable(known, dictionary))


def make_columns(keys: Sequence[Key]) -> list[tuple[Key, Atom | None]]:
    """Make columns by the dictionary that a worker process shares."""
    dictionary: Dictionary = worker_state()
    return dictionary.make_all(keys)


def _reusable(known: Search | None, dictionary: Dictionary) -> dict[Key, Atom | None]:
    """Columns that are the same beside another model: of effects that do not act on its effects."""
    if known is None or known.dictionary.evidence.system.moves_sensors:
        return {}
    if dictionary.evidence.system.moves_sensors:
        return {}
    same = {
        name
        for name, item in dictionary.candidates.items()
        if known.dictionary.candidates.get(name) is item
    }
    return {key: atom for key, atom in known.atoms.items() if key[0] in same}


def select_effects(
    session: Session,
    recipe: Recipe,
    start: Array,
    without: Collection[str] = (),
    progress: Progress = lambda fraction, message: None,
) -> Selection:
    """Find the set of effects that is most probable beside a model.

    Args:
        session: the trials; recipe: the model; start: its parameters, (n_p,).
        without: effects that are not weighed.
        progress: called with a fraction and a message.

    Raises:
        Runaway: the model as given cannot be replayed.
    """
    progress(0.0, "replaying the model")
    initial = current = session.fit(recipe, start)
    steps = [current]
    fits: dict[frozenset[str], Fit | None] = {frozenset(recipe.effects): current}
    gains: dict[str, float] = {}
    known: Search | None = None
    last, left_out = False, set[str]()
    for number in range(_MOST_ROUNDS + 1):
        progress(0.1 + 0.1 * number, "weighing sets of effects")
        with open_search(session, current, {*without, *left_out}, known) as search:
            known = search
            none = search.cost(())
            if not gains:
                beside = search.rank_additions((), len(search.dictionary.candidates))
                gains = {key[0]: none - cost for cost, key in beside}
            room = session.criteria.most_effects - len(current.recipe.effects) + len(recipe.effects)
            pool = _explore(search, room, deep=room if number == 0 else min(_MOST_ADDED, room))
            moved, kept = None, dict[tuple[str, ...], float]()
            last |= number >= _MOST_ROUNDS - 1
            if not last:
                better = [k for c, k in sorted(pool.values()) if c < none - _LEAST_GAIN]
                better += _without_weakest(search, recipe.effects)
                tell = partial(progress, 0.15 + 0.1 * number)
                moved, kept = _fit_better(session, search, current, better, fits, tell)
                # By its own noise a set fitted before is not the better one: the last.
                last |= any(moved is one for one in steps)
            if moved is None:
                # What has been fitted counts by what it kept, not by its linear problem.
                pool = {
                    n: (none - kept[n] if n in kept else c, k)
                    for n, (c, k) in pool.items()
                    if n in kept or c >= none - _LEAST_GAIN
                }
                progress(0.9, "holding the model against chance")
                replays = range(session.criteria.replicates)
                chance = tuple(search.on_replicate(k).largest_gain()[0] for k in replays)
                probabilities = weigh_sets(
                    search, current, pool, recipe.effects, session.criteria, session.seed
                )
                moved = (
                    None
                    if number == _MOST_ROUNDS
                    else _leave_out(session, search, current, probabilities, recipe.effects)
                )
                if moved is None:
                    return Selection(
                        initial, current, probabilities, chance, search.largest_gain(), gains,
                        tuple(steps), number >= _MOST_ROUNDS - 1 or room <= 0,
                    )  # fmt: skip
                # A second time, nothing more is added.
                last |= bool(left_out)
                left_out |= {*current.recipe.effects} - {*moved.recipe.effects}
        current = moved
        steps.append(current)
    raise AssertionError("the last round returns")


def _fit_better(
    session: Session,
    search: Search,
    current: Fit,
    better: Sequence[tuple[Key, ...]],
    fits: dict[frozenset[str], Fit | None],
    tell: Callable[[str], None],
) -> tuple[Fit | None, dict[tuple[str, ...], float]]:
    """Fit sets in turn until one is better than the current model when fitted, too.

    Of the sets ``better``, the most promising first; with what each kept when fitted, nats. One
    whose error on unseen trials is larger is not better, whatever the bias of its replays explains.
    """
    broken: list[set[Key]] = []
    kept: dict[tuple[str, ...], float] = {}
    for keys in better:
        if added_effects(keys) and len(broken) >= _MOST_FITS and len(keys) >= min(map(len, broken)):
            continue
        # A larger set promises no more than the one in it whose fit fell short.
        if any(one <= {*keys} for one in broken):
            continue
        wider = change_set(current.recipe, keys)
        members = frozenset(wider.effects)
        if fresh := members not in fits:
            tell(f"fitting {', '.join(effect_names(keys))}")
            fits[members] = session.try_fit(wider, start_of(search, keys, wider))
        moved = fits[members]
        if moved is not None:
            gain = gain_when_fitted(current, moved, search, keys)
            if gain <= _LEAST_GAIN:
                kept[effect_names(keys)] = gain
            elif _held_out_error(moved) < _held_out_error(current) + NOTICEABLE:
                return moved, kept
        broken.append({*keys})
        if fresh:
            fits[members] = None
    return None, kept


def _without_weakest(search: Search, given: Collection[str]) -> list[tuple[Key, ...]]:
    """The set without the member that adds least, where shapes of others may take its place.

    How far they do a linear problem at the shapes they have beside it does not say.
    """
    own = [e for e in search.problem.absence if e not in given]
    weakest = min(own, key=lambda e: search.cost(((f"-{e}", ()),)), default=None)
    shaped = any(search.problem.shapes[e] for e in own if e != weakest)
    return [((f"-{weakest}", ()),)] if shaped else []


def _leave_out(
    session: Session, search: Search, fit: Fit, probabilities: Probabilities, given: Collection[str]
) -> Fit | None:
    """The model without the effects that came out improbable; None where there are none.

    With what the most probable set has in their place. What an unknown function could replace
    stays: it describes the machine until its effect has a name. It must predict, though.
    """
    least = 1.0 - session.criteria.probability
    own = [e for e in fit.recipe.effects if e not in given]
    out = {e for e in own if probabilities.if_all_known.get(e, 0.0) < least} or _find_misleading(
        fit, probabilities, own
    )
    if not out:
        return None
    best = next(one.keys for one in probabilities.sets if one.unknown is None)
    best = best if out & removed_effects(best) else ()
    keys = tuple(sorted({*best, *((f"-{e}", ()) for e in out)}))
    less = change_set(fit.recipe, keys)
    if np.isfinite(search.cost(keys)):
        return session.try_fit(less, start_of(search, keys, less))
    return session.try_fit(less, start_at(search, np.zeros(search.bb.shape[1]), {}, less))


def _find_misleading(fit: Fit, probabilities: Probabilities, own: Sequence[str]) -> set[str]:
    """Effects that are rather not there, and make the error on trials not seen larger."""

    out, least = set[str](), _held_out_error(fit)
    while doubtful := [e for e in own if e not in out and probabilities.effects.get(e, 0.0) < 0.5]:
        left, worst = min((_held_out_error(fit, {*out, e}), e) for e in doubtful)
        if left >= least:
            break
        out, least = {*out, worst}, left
    return out


def _held_out_error(fit: Fit, without: Collection[str] = ()) -> float:
    """Its logarithm, summed over the axes, with or without some of the model's effects."""
    errors = fit.held_out_without(without) if without else fit.held_out_rmse
    return float(np.sum(np.log(np.maximum(errors, 1e-300))))


def gain_when_fitted(before: Fit, after: Fit, search: Search, keys: Sequence[Key]) -> float:
    """Log evidence that a fitted set gains by the weights of the model without it, nats.

    Args:
        before, after: the model without and with it; search: beside the former; keys: the set.
    """
    if any(len(a) != len(b) for a, b in zip(before.problem.y, after.problem.y, strict=True)):
        return np.inf
    gained = 0.0
    for axis, root in enumerate(before.likelihood.root):
        if len(root):
            squares = [
                float(np.sum((fit.rows_beyond_bias[axis] * root) ** 2)) for fit in (before, after)
            ]
            ratio = max(squares[1], 1e-300) / max(squares[0], 1e-300)
            gained -= 0.5 * before.problem.independent[axis] * float(np.log(ratio))
    volume = search.volume_where_fitted(keys, after.evidence)
    taken = -np.inf if volume is None else float(volume.sum())
    return gained + taken - search.solve(keys).penalty


def _explore(search: Search, room: int, deep: int) -> Pool:
    """Sets near the fitted one: without a member, with another in its place, and with more."""
    pool: Pool = {}
    search.add_to_pool(pool, ())
    lead = search.cost(())
    rest: tuple[Key, ...] | None = ()
    while rest is not None:  # backward elimination, as far as each member less is more probable
        fewer, least = search.drop_each(rest), search.cost(rest)
        for keys in fewer:
            search.add_to_pool(pool, keys)
        rest = min(
            (keys for keys in fewer if search.cost(keys) < least), key=search.cost, default=None
        )
    for keys in search.refine(search.list_swaps((), pool), 2):
        search.add_to_pool(pool, keys)
    for beam in search.grow_sets(deep):
        for _, keys in beam:
            search.add_to_pool(pool, keys)
        best = min(cost for cost, _ in beam)
        gained, total = lead - best, search.cost(()) - best
        if gained < _LEAST_GAIN or gained < _MINOR_SHARE * total:
            # What is minor beside the rest is weighed once that has been fitted.
            if gained > 0.0 and gained < total:
                largest = max(len(keys) for _, keys in beam)
                for name in [n for n, (_, keys) in pool.items() if len(keys) >= largest]:
                    del pool[name]
            break
        lead = best
    return pool


def change_set(recipe: Recipe, keys: Sequence[Key]) -> Recipe:
    """The model of ``recipe`` with the changes of a set."""
    return change_effects(recipe, removed_effects(keys), [name for name, _ in added_effects(keys)])


def start_of(search: Search, keys: Sequence[Key], wider: Recipe) -> Array:
    """Parameters of a changed model from the solution of its linear problem, (n_p,)."""
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
    return start_at(search, solution.base, known, wider)


def start_at(search: Search, base: Array, known: Mapping[str, float], wider: Recipe) -> Array:
    """Parameters of a changed model, within bounds, (n_p,).

    Those of the model moved by ``base``, a solution of its linear problem, with ``known`` ones.
    """
    evidence = search.dictionary.evidence
    found = {q.name: v for q, v in zip(evidence.system.parameters, evidence.p, strict=True)}
    change = search.problem.to_parameters @ base
    for place, number in enumerate(evidence.free):
        found[evidence.system.parameters[number].name] += change[place]
    found |= known
    system = system_of(wider)
    start = np.array([found.get(q.name, q.prior) for q in system.parameters])
    return np.asarray(np.clip(start, *bounds_of(system)))
