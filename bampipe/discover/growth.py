"""One round of a search: effects added to a set, and whether the wider model holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.bench import Bench
from bampipe.discover.chance import Replicate, candidates_of
from bampipe.discover.influence import error_without_second
from bampipe.discover.level import Level
from bampipe.discover.polish import FittedSet, extend_set, is_superfluous, reduce_set
from bampipe.discover.rivals import Choice, choose
from bampipe.discover.scorer import Score, Scorer
from bampipe.discover.settings import Settings
from bampipe.discover.stops import StoppingReplays
from bampipe.estimate.simulation import Runaway
from bampipe.physics.recipe import Recipe
from bampipe.results.diagnose import RefusalReason, RefusedEffect, SearchStep
from bampipe.results.standing import standing
from bampipe.trials.noise_floor import NoiseFloor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Addition:
    """An effect as it stood when it was chosen.

    Attributes:
        score: against the model that it was added to.
        p_value: chance that a candidate scores so high where nothing is missing.
        excess: gain beyond chance, by axis.
        scorer: of that model, fitted.
    """

    score: Score
    p_value: float
    excess: Array
    scorer: Scorer


@dataclass(frozen=True)
class GrownSet:
    """A set with one effect more, or several, and how candidates stand against it.

    Attributes:
        bench: the session, timed as the wider model wants it.
        found: that model, fitted, without what has become superfluous.
        steps: the sets on the way there.
        scores: of the candidates that are left.
        level: their chance level; None if no mechanism could have what was added.
    """

    bench: Bench
    found: FittedSet
    steps: tuple[SearchStep, ...]
    scores: dict[str, Score]
    level: Level | None


def record_addition(score: Score, known: Level, current: FittedSet) -> Addition:
    """How an effect with this score stands against a model and its chance level."""
    return Addition(score, known.p_value(score), known.excess(score), current.scorer)


def find_changed_axes(recipe: Recipe, name: str) -> frozenset[int]:
    """Axes whose equation a candidate changes: all of them if it moves what the sensors read."""
    item = candidates_of(recipe, (name,))[0]
    system = item.system
    return frozenset(range(len(system.coordinates)) if system.moves_sensors else system.touched)


def choose_companions(
    bench: Bench,
    stops: StoppingReplays,
    current: FittedSet,
    winner: str,
    significant: Sequence[tuple[float, str]],
    level: Level,
    scores: Mapping[str, Score],
) -> list[Choice]:
    """Choose what else to add at once: the best on axes that what is added leaves alone.

    One after the other they would be found as well, each after a round of replays. Only what beats
    chance beyond doubt comes along; the others are weighed anew.
    """
    s = bench.settings
    taken = find_changed_axes(current.recipe, winner)
    made: list[Choice] = []
    waiting = [
        (excess, name)
        for excess, name in significant
        if name in scores and level.p_value(scores[name]) < s.significance / s.close
    ]
    while waiting:
        waiting = [
            (excess, name)
            for excess, name in waiting
            if not any(name in choice.transient for choice in made)
            and taken.isdisjoint(find_changed_axes(current.recipe, name))
        ]
        passing, _ = stops.first_beyond(scores, level, waiting)
        if not passing:
            break
        choice = choose(
            bench, passing, level, current.recipe, current.evidence, scores, lambda *_: None
        )
        made.append(choice)
        if choice.winner:
            taken |= find_changed_axes(current.recipe, choice.winner)
    return made


def grow_set(
    bench: Bench,
    current: FittedSet,
    joined: Sequence[Choice],
    known: Level,
    known_scores: Mapping[str, Score],
    out: set[str],
) -> GrownSet:
    """Add the winners of ``joined``, drop what has become superfluous, and weigh all others anew.

    Args:
        bench: the session; current: the model that they are added to.
        known, known_scores: chance level and scores of the candidates against it.
        out: candidates that are not weighed again.
    """
    s, names = bench.settings, [choice.winner for choice in joined]
    wider, steps = current, []
    for k, name in enumerate(names):
        score = known_scores[name]
        # What the first does to the model's own parameters is in the fit when the next one comes.
        wider = extend_set(wider, replace(score, shift=score.shift[:0]) if k else score)
        if k < len(names) - 1:
            steps.append(record_step(wider))
    if collapses(current, wider, s):
        return GrownSet(bench, wider, (), {}, None)
    for earlier in (n for n in wider.added if n != names[0]):
        # What resembles the missing effect may come first: it takes a little of several others.
        less = reduce_set(wider, earlier)
        if is_superfluous(wider.error, less.error, s):
            wider = less
    bench = replace(bench, trials=wider.trials)
    timed = bench.retimed(wider.evidence)
    if timed is not bench:
        fitted = timed.fit(wider.recipe, wider.evidence.p)
        wider = replace(wider, evidence=fitted, trials=timed.trials)
    out = {*out, *wider.added, *current.added, *names}
    rest = [n for n in bench.names if n not in out]
    count = current.scorer.independent_samples
    every = range(len(current.error))
    promised = [
        (
            sorted(find_changed_axes(current.recipe, n)) if len(names) > 1 else every,
            known_scores[n].gain / count,
        )
        for n in names
        if n in wider.added
    ]
    sound = _sound_level(timed, current, wider, promised, known, known_scores, rest)
    scores, level = sound or ({}, None)
    return GrownSet(timed, wider, (*steps, record_step(wider)), scores, level)


def record_step(known: FittedSet) -> SearchStep:
    """A set that the search went through, with its held-out error."""
    axes = known.evidence.system.coordinates
    errors = dict(zip(axes, known.evidence.held_out_rmse, strict=True))
    return SearchStep(effects=known.added, held_out_rmse=errors)


def _sound_level(
    bench: Bench,
    before: FittedSet,
    after: FittedSet,
    promised: Sequence[tuple[Sequence[int], Array]],
    known: Level,
    known_scores: Mapping[str, Score],
    names: Sequence[str],
) -> tuple[dict[str, Score], Level] | None:
    """Scores of ``names`` against a model with more effects, and their chance level.

    What a model with the first effects leaves by chance may look like another one: every model has
    a chance level of its own. None if no mechanism could have what was added; the trials that the
    fit has not seen are asked first, for replays cost more. What was known of a candidate that acts
    on axes which it left as they were still holds.

    Args:
        bench: the session; before, after: the model without and with what was added.
        promised: for each effect that was added, the axes that it was for, and the drop in log
            error by its score, by axis.
        known, known_scores: chance level and scores of candidates against the model without.
        names: candidates.
    """
    s = bench.settings
    carried = all(_carries_over(before, after, drop, axes, s) for axes, drop in promised)
    if not carried:
        return None
    evidence = after.evidence
    error, error_before = after.scorer.base_error, before.scorer.base_error
    moved = np.abs(np.log(error / error_before)) > s.unmoved
    holds = _unmoved_candidates(before, after, moved, [n for n in names if n in known_scores])
    anew = bench.scores(after.recipe, evidence.p, [n for n in names if n not in holds])
    found = anew | {n: after.scorer.carry_over(known_scores[n], moved) for n in holds}
    scores = {n: found[n] for n in names if n in found}
    try:
        level = bench.level(
            after.recipe, evidence, after.replayed, bench.gaining(anew, after.scorer)
        )
    except Runaway:
        return None
    level.carry_over(known, holds, moved)
    if not _keeps_the_floor(error, level.replicates, error_before, known.replicates, s):
        return None
    return scores, level


def _unmoved_candidates(
    before: FittedSet, after: FittedSet, moved: NDArray[np.bool_], names: Sequence[str]
) -> list[str]:
    """Those of ``names`` that are the same beside one effect more, and act where it moved nothing.

    Args:
        before, after: the model without and with it.
        moved: axes whose error it changed, (n_q,).
        names: candidates.
    """
    if after.trials is not before.trials:
        return []
    pairs = zip(
        candidates_of(before.recipe, names), candidates_of(after.recipe, names), strict=True
    )
    return [
        item.name
        for earlier, item in pairs
        if item is earlier and not item.replaces_motion and not moved[[*item.system.touched]].any()
    ]


def _keeps_the_floor(
    error: Array,
    replays: Sequence[Replicate],
    error_before: Array,
    before: Sequence[Replicate],
    s: Settings,
) -> bool:
    """Whether an effect buys nothing by raising the noise floor or by falling far below it.

    What leaves a small part of the sensors' noise makes both sides of the equation small. And the
    replays of a model with a wrong effect can be so wild that any error is below their floor: such
    a floor is no better than none, unless it was like that without the effect.
    """
    after, earlier = (NoiseFloor.of_errors([r.error for r in some]) for some in (replays, before))
    ratio = error / np.maximum(after.level, 1e-300)
    shrunk = (ratio < s.shrunken) & (error_before / np.maximum(earlier.level, 1e-300) > s.shrunken)
    raised = [
        standing(float(error[i]), float(after.level[i])) == "floor_implausible"
        and after.level[i] > s.raised * earlier.level[i]
        for i in range(len(error))
    ]
    return not (shrunk.any() or any(raised))


def collapses(before: FittedSet, after: FittedSet, s: Settings) -> bool:
    """Whether an effect leaves so little of what the force does that the equation has no scale.

    Forces, masses and friction can then all go to zero together, and every error with them.
    """
    return bool((after.slope_by_force < s.least_slope * before.slope_by_force).any())


def _carries_over(
    before: FittedSet, after: FittedSet, promised: Array, axes: Sequence[int], s: Settings
) -> bool:
    """Whether one of ``axes`` errs less, by what is worth it, on trials that the fit has not seen.

    They choose no effect, but one that does nothing for them is none, nor is one that keeps next to
    nothing of the drop in log error that its score has ``promised``, by axis. It must stand with
    the worst second of each and without.
    """

    return any(
        float(np.min(np.log(_held_out(before, axis) / _held_out(after, axis))))
        > max(s.worth, s.carried * promised[axis])
        for axis in axes
    )


def _held_out(known: FittedSet, axis: int) -> Array:
    """Error on held-out trials over the slope by the force: whole, and but for the worst second."""
    least = error_without_second(known.evidence, axis)[1]
    both = np.array([known.evidence.held_out_rmse[axis], least])
    return np.asarray(both / known.slope_by_force[axis])


def describe_refusal(
    name: str, addition: Addition, before: FittedSet, after: FittedSet, s: Settings
) -> RefusedEffect:
    """Why an effect that was added is not kept, and what it did on the axis that it was for."""
    axis = int(np.argmax(addition.excess))
    promised = addition.score.gain / before.scorer.independent_samples
    carries = _carries_over(before, after, promised, range(len(before.error)), s)
    first, then = (
        _held_out(known, axis) * before.slope_by_force[axis] for known in (before, after)
    )
    collapsed, runs_away = collapses(before, after, s), bool(then[0] > s.runs_away * first[0])
    why: RefusalReason = (
        "scale" if collapsed else "replays" if carries else "runs_away" if runs_away else "held_out"
    )
    return RefusedEffect(
        effect=name,
        axis=before.evidence.system.coordinates[axis],
        held_out_rmse_before=first[0],
        held_out_rmse_after=None if runs_away else then[0],
        without_worst_second_before=first[1],
        without_worst_second_after=None if runs_away else then[1],
        why=why,
    )
