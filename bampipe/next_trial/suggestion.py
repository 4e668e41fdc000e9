"""The alternatives that a diagnosis left undecided, and the trial that would decide."""

from collections.abc import Mapping

import numpy as np

from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.dictionary import Key
from bampipe.diagnosis.search import Search
from bampipe.diagnosis.select import open_search, start_of
from bampipe.diagnosis.session import Fit, Session, change_effects, system_of
from bampipe.next_trial.design_sentence import describe_design
from bampipe.next_trial.discrimination import Alternative, Comparison
from bampipe.next_trial.primitives import Envelope
from bampipe.next_trial.ranking import DesignSpace, rank_designs
from bampipe.next_trial.rehearsal import Rehearsal
from bampipe.phrases.proposal import say_chance
from bampipe.physics.model_spec import ModelSpec
from bampipe.results.diagnose import DiagnoseResult, SuggestedTrial
from bampipe.results.next import AS_FORECAST
from bampipe.trials.linear_problem import pose_problem

_MOST_ALTERNATIVES = 4
_REFINEMENTS = 4
"""Steps that refine the shapes of an alternative."""
_SUGGESTED_S = 20.0


Odds = Mapping[tuple[str, ...], float]
"""Odds of sets between which a diagnosis could not decide, by the effects in which they differ."""


def find_ambiguity(found: DiagnoseResult, criteria: Criteria) -> Odds | None:
    """Return the fewest sets that together reach the probability of a verdict; None if one does."""
    if all(axis.verdict != "undecided" for axis in found.axes.values()):
        return None
    sets, total = [], 0.0
    for one in found.sets[:_MOST_ALTERNATIVES]:
        if total < criteria.probability:
            sets.append(one)
            total += one.probability
    common = set.intersection(*({*one.effects} for one in sets)) if sets else set()
    odds: dict[tuple[str, ...], float] = {}
    for one in sets:
        members = tuple(sorted({*one.effects} - common))
        odds[members] = odds.get(members, 0.0) + one.probability / total
    return odds if len(odds) > 1 else None


def compare_alternatives(session: Session, final: Fit, odds: Odds) -> Comparison | None:
    """Fit the alternatives to the trials; None if fewer than two explain anything.

    ``final`` is the model with its most probable set, fitted.
    """
    members = {name for one in odds for name in one}
    spec, e = change_effects(final.spec, members), final.linearisation
    known = e.system.by_name(e.p)
    start = np.array([known[q.name] for q in system_of(spec).parameters])
    linearisation = session.linearise(spec, start)
    bare = Fit(spec, linearisation, final.likelihood, pose_problem(final.likelihood, linearisation))
    others = {*session.candidate_names(spec)} - members
    with open_search(session, bare, others) as search:
        found = [_fit_alternative(search, spec, *pair) for pair in odds.items()]
    alternatives = tuple(alternative for alternative in found if alternative is not None)
    return Comparison(session, bare, final, alternatives) if len(alternatives) > 1 else None


def _fit_alternative(
    search: Search, spec: ModelSpec, members: tuple[str, ...], odds: float
) -> Alternative | None:
    """Return a set of effects with its most probable parameters; None if it explains nothing."""
    keys: tuple[Key, ...] = ()
    for name in members:
        places = [key for key in search.grid_keys if key[0] == name]
        if not places:
            return None
        keys = (*keys, min(places, key=lambda key: search.cost((*keys, key))))
    (keys,) = search.refine([keys], _REFINEMENTS)
    if not np.isfinite(search.cost(keys)):
        return None
    wider = change_effects(spec, (), members)
    start = system_of(wider).by_name(start_of(search, keys, wider))
    items = tuple(search.dictionary.candidates[name] for name in members)
    values = tuple(np.array([start[q.name] for q in item.parameters]) for item in items)
    slopes = tuple(
        (number, place)
        for number, item in enumerate(items)
        for place, q in enumerate(item.parameters)
        if not q.fixed
    )
    return Alternative(items, values, odds, slopes)


def suggest_trial(session: Session, final: Fit, result: DiagnoseResult) -> SuggestedTrial | None:
    """Return the trial that would decide between the alternatives; None if there is none.

    With it, a wrong choice must be as improbable as a verdict demands. ``final`` is the model with
    its most probable set, fitted.
    """
    odds = find_ambiguity(result, session.criteria)
    comparison = compare_alternatives(session, final, odds) if odds is not None else None
    if comparison is None:
        return None
    trials, e = session.trials, comparison.fit.linearisation
    seen = Envelope.of_trials(trials.motions, e.system, e.p)
    rehearsal = Rehearsal(e.system, e.p, trials.sensors, trials.kinematics, seen, session.seed)

    # Only the axes on which alternatives act: on others they all leave the same residual.
    acts = {axis for one in comparison.alternatives for i in one.items for axis in i.system.touched}
    axes = [axis for axis in seen.moved_axes if axis in acts] or seen.moved_axes
    space = DesignSpace(rehearsal, _SUGGESTED_S, axes, with_rests=True, with_brakes=True)
    best = rank_designs(space, lambda motion: -comparison.confusion_with(motion))[0]
    confusions = comparison.expect(best.expected_motions)
    expected = max(confusions, key=lambda one: one.weight * one.before)
    if expected.after > min(1.0 - session.criteria.probability, expected.before / AS_FORECAST):
        return None
    axis = max(expected.left, key=lambda name: expected.left[name])
    first, second = expected.between
    design = describe_design(best.design, seen, e.system.model.device)
    before, after = expected.before, expected.after
    return SuggestedTrial(
        between=expected.between, axis=axis, design=design, confusion=after, confusion_now=before,
        sentence=f"To distinguish {first} from {second}, record this trial: {design} The chance of"
        f" confusing them would fall from {say_chance(before)} to {say_chance(after)}.",
    )  # fmt: skip
