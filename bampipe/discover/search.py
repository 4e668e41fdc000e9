"""The search for what a model lacks: sets of effects that beat chance, grown, swapped, pruned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.bench import Bench
from bampipe.discover.chance import Progress, Replicate, candidates_of
from bampipe.discover.influence import SampleRange, error_without_second
from bampipe.discover.level import Level
from bampipe.discover.polish import (
    FittedSet,
    contest_of,
    extend_set,
    is_superfluous,
    polish,
    reduce_set,
)
from bampipe.discover.rivals import Choice, choose
from bampipe.discover.scorer import Score, Scorer
from bampipe.discover.settings import Settings
from bampipe.discover.stops import StoppingReplays
from bampipe.estimate.simulation import Runaway
from bampipe.lists import join_names
from bampipe.physics.recipe import Recipe
from bampipe.results.diagnose import Contender, RefusedEffect, SearchStep
from bampipe.results.standing import AT_FLOOR, standing
from bampipe.trials.folds import HELD_OUT
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.noise_floor import NoiseFloor
from bampipe.trials.residuals import Evidence

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
class Search:
    """What a search came to.

    Attributes:
        trials: the measured trials, timed as the model with every effect found wants them.
        recipe: the model as given.
        initial: its fit.
        level: chance level of candidates against it.
        first: scores against it.
        found: the model with every effect found, fitted.
        groups: for each effect found, in order, the others that these trials cannot tell from it.
        unlike: where one effect is found and no replay looks like the measurement, neither its own
            nor those of its rivals: these rivals.
        misfit: mean squared z of the likest of those replays, else 1.
        contests: for each, those who contend for its place, itself first.
        main: for each, the axis on which it helps most.
        additions: for each, how it stood against the model that it was added to.
        likely: p-value and gain in log error by axis of candidates that would lower the error of
            the final model, but do not beat chance.
        transient: candidates that only one second speaks for, and that second.
        refused: candidates that beat chance and were added, but not kept.
        steps: the sets tried, in order.
        cut_short: whether it ended at `Settings.most_effects`.
        final: replays of the final model, with explainable shares.
    """

    trials: MeasuredTrials
    recipe: Recipe
    initial: Evidence
    level: Level
    first: Mapping[str, Score]
    found: FittedSet
    groups: Mapping[str, tuple[str, ...]]
    unlike: tuple[str, ...]
    misfit: float
    contests: Mapping[str, tuple[Contender, ...]]
    main: Mapping[str, int]
    additions: Mapping[str, Addition]
    likely: Mapping[str, tuple[float, Array]]
    transient: Mapping[str, SampleRange]
    refused: tuple[RefusedEffect, ...]
    steps: tuple[SearchStep, ...]
    cut_short: bool
    final: tuple[Replicate, ...]

    @property
    def selected(self) -> tuple[str, ...]:
        """Effects found, in order."""
        return self.found.added

    @property
    def evidence(self) -> Evidence:
        """Fit of the model with all of them."""
        return self.found.evidence


def search(bench: Bench, base: Recipe, start: Array, progress: Progress) -> Search:
    """Add effects to a model until no candidate beats chance, then put the set to the test.

    Args:
        bench: the session and the candidates.
        base: the model as given.
        start: parameters to start its fit from, (n_p,).
        progress: called with a fraction and a message.
    """
    s = bench.settings
    progress(0.0, "preparing the candidates")
    bench.prepare(base, lambda share, what: progress(0.04 * share, what))
    initial = bench.fit(base, start)
    progress(0.05, "scoring every candidate on the measured trials")
    first = bench.scores(base, initial.p, bench.names)
    progress(0.15, "replaying the model for chance levels")
    current, scores = FittedSet(base, (), initial, bench.trials, start), dict(first)
    asked = bench.gaining(first, current.scorer)
    level = bench.level(base, initial, current.replayed, asked)
    stops = StoppingReplays(bench, current)
    choices: dict[str, Choice] = {}
    additions: dict[str, Addition] = {}
    dropped: set[str] = set()
    transient: dict[str, SampleRange] = {}
    refused: dict[str, RefusedEffect] = {}
    steps = [_step(current)]
    known = level

    def report_step(_: float, message: str) -> None:
        progress(0.4 + 0.05 * len(steps), message)

    while len(current.added) + len(dropped) < s.most_effects:
        evidence = current.evidence
        significant, likely = _weigh(bench, scores, known, evidence)
        significant, doubted = stops.first_beyond(scores, known, significant)
        refused |= {name: stops.refusal(scores[name]) for name in doubted}
        likely |= {n: found for n, found in doubted.items() if found[0] < s.likely}
        if not significant:
            break
        chosen = choose(bench, significant, known, current.recipe, evidence, scores, report_step)
        transient |= chosen.transient
        scores = {n: score for n, score in scores.items() if n not in chosen.transient}
        if not chosen.winner:
            continue
        joined = [chosen]
        beside = _choose_beside(bench, stops, current, chosen.winner, significant, known, scores)
        for other in beside:
            transient |= other.transient
            if other.winner:
                joined.append(other)
        del joined[s.most_effects - len(current.added) - len(dropped) :]
        scores = {n: score for n, score in scores.items() if n not in transient}
        out = {*dropped, *transient}
        grown = _grow(bench, current, joined, known, scores, out)
        if grown.level is None and len(joined) > 1:
            # Whichever of them it is: each has a turn of its own.
            joined = [chosen]
            grown = _grow(bench, current, joined, known, scores, out)
        made = {c.winner: _as_addition(scores[c.winner], known, current) for c in joined}
        if grown.level is None:
            # It resembles what is missing in these trials, but no mechanism could have it.
            name = chosen.winner
            dropped.add(name)
            refused[name] = _refusal(name, made[name], current, grown.found, s)
            scores = {n: score for n, score in scores.items() if n != name}
            continue
        dropped |= {*current.added, *made} - {*grown.found.added}
        bench, current, scores, known = grown.bench, grown.found, grown.scores, grown.level
        stops = StoppingReplays(bench, current)
        choices |= {choice.winner: choice for choice in joined}
        additions |= made
        steps += grown.steps
        report_step(0.0, f"added {join_names(made)}, looking for more")
    cut_short = len(current.added) + len(dropped) >= s.most_effects
    progress(0.8, "weighing each effect beside its rivals")
    groups = {name: choices[name].alike for name in choices}
    rivals = {name: _rivals(first, name, groups.get(name, ()), s) for name in current.added}
    polished = polish(bench, current, rivals, lambda _, what: progress(0.8, what))
    found, contests = polished.found, polished.contests
    progress(0.85, "replaying the final model for its noise floor")
    same = known.replicates if found is current else ()
    try:
        final = bench.floor_replicas(found.recipe, found.evidence, found.replayed, same)
    except Runaway:
        if found is current:
            raise
        # A rival that scored better has no mechanism that could have it: as found, then.
        found = current
        contests = {name: contest_of(bench, found, name, rivals[name]) for name in found.added}
        final = bench.floor_replicas(found.recipe, found.evidence, found.replayed, known.replicates)
    if found.added != current.added:
        steps.append(_step(found))
    axes = initial.system.coordinates
    # Beside others, an effect has been replayed again, and what it was chosen by is out of date.
    alone = choices.get(found.added[0]) if len(found.added) == 1 else None
    unlike, misfit = (alone.unlike, alone.misfit) if alone else ((), 1.0)
    main = {name: axes.index(c[0].axis) for name, c in contests.items() if c}
    return Search(
        bench.trials, base, initial, level, first, found,
        {n: polished.alike.get(n, groups.get(n, ())) for n in found.added},
        unlike, misfit, contests, main, additions, likely, transient,
        tuple(r for name, r in refused.items() if name not in found.added), tuple(steps), cut_short,
        tuple(final),
    )  # fmt: skip


@dataclass(frozen=True)
class _Grown:
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


def _as_addition(score: Score, known: Level, current: FittedSet) -> Addition:
    return Addition(score, known.p_value(score), known.excess(score), current.scorer)


def _axes_of(current: FittedSet, name: str) -> frozenset[int]:
    """Axes whose equation a candidate changes: all of them if it moves what the sensors read."""
    item = candidates_of(current.recipe, (name,))[0]
    system = item.system
    return frozenset(range(len(system.coordinates)) if system.moves_sensors else system.touched)


def _choose_beside(
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
    taken = _axes_of(current, winner)
    made: list[Choice] = []
    waiting = [
        (excess, name)
        for excess, name in significant
        if level.p_value(scores[name]) < s.significance / s.close
    ]
    while waiting:
        waiting = [
            (excess, name)
            for excess, name in waiting
            if not any(name in choice.transient for choice in made)
            and taken.isdisjoint(_axes_of(current, name))
        ]
        passing, _ = stops.first_beyond(scores, level, waiting)
        if not passing:
            break
        choice = choose(
            bench, passing, level, current.recipe, current.evidence, scores, lambda *_: None
        )
        made.append(choice)
        if choice.winner:
            taken |= _axes_of(current, choice.winner)
    return made


def _grow(
    bench: Bench,
    current: FittedSet,
    joined: Sequence[Choice],
    known: Level,
    known_scores: Mapping[str, Score],
    out: set[str],
) -> _Grown:
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
        wider = extend_set(bench, wider, replace(score, shift=score.shift[:0]) if k else score)
        if k < len(names) - 1:
            steps.append(_step(wider))
    for earlier in (n for n in wider.added if n != names[0]):
        # What resembles the missing effect may come first: it takes a little of several others.
        less = reduce_set(bench, wider, earlier)
        if is_superfluous(wider, less, s):
            wider = less
    timed = bench.retimed(wider.evidence)
    if timed is not bench:
        fitted = timed.fit(wider.recipe, wider.evidence.p)
        wider = replace(wider, evidence=fitted, trials=timed.trials)
    out = {*out, *wider.added, *current.added, *names}
    rest = [n for n in bench.names if n not in out]
    count = current.scorer.independent_samples
    every = range(len(current.error))
    promised = [
        (sorted(_axes_of(current, n)) if len(names) > 1 else every, known_scores[n].gain / count)
        for n in names
        if n in wider.added
    ]
    sound = _sound_level(timed, current, wider, promised, known, known_scores, rest)
    scores, level = sound or ({}, None)
    return _Grown(timed, wider, (*steps, _step(wider)), scores, level)


def _step(known: FittedSet) -> SearchStep:
    axes = known.evidence.system.coordinates
    errors = dict(zip(axes, known.evidence.held_out_rmse, strict=True))
    return SearchStep(effects=known.added, held_out_rmse=errors)


def _rivals(first: Mapping[str, Score], name: str, alike: Sequence[str], s: Settings) -> list[str]:
    """Candidates that help the model as given on the axis where ``name`` does, best first."""
    if name not in first:
        return list(alike)
    axis = int(np.argmax(first[name].gain))
    others = [n for n in first if n != name and first[n].gain[axis] > 0.0]
    others.sort(key=lambda n: -float(first[n].gain[axis]))
    return [*alike, *(n for n in others[: s.most_rivals] if n not in alike)]


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
    if collapses(before, after, s) or not carried:
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


def _refusal(
    name: str, addition: Addition, before: FittedSet, after: FittedSet, s: Settings
) -> RefusedEffect:
    """Why an effect that was added is not kept, and what it did on the axis that it was for."""
    axis = int(np.argmax(addition.excess))
    promised = addition.score.gain / before.scorer.independent_samples
    carries = _carries_over(before, after, promised, range(len(before.error)), s)
    first, then = (
        _held_out(known, axis) * before.slope_by_force[axis] for known in (before, after)
    )
    return RefusedEffect(
        effect=name,
        axis=before.evidence.system.coordinates[axis],
        held_out_rmse_before=first[0],
        held_out_rmse_after=then[0],
        without_worst_second_before=first[1],
        without_worst_second_after=then[1],
        why="scale" if collapses(before, after, s) else "replays" if carries else "held_out",
    )


def _weigh(
    bench: Bench,
    scores: Mapping[str, Score],
    level: Level,
    evidence: Evidence,
) -> tuple[list[tuple[float, str]], dict[str, tuple[float, Array]]]:
    """Candidates that beat chance and are worth having, and those that are worth it but do not.

    Returns:
        The former with their excess, best first; the latter with p-value and gain in log error by
        axis.
    """
    scorer, s = Scorer(evidence), bench.settings
    level.ask(scores, bench.gaining(scores, scorer))

    def ceiling(errors: Array) -> Array:
        scatter = errors.std(axis=0, ddof=1)
        return np.asarray(AT_FLOOR * errors.mean(axis=0) + s.above_floor_sd * scatter)

    # Trials that the session holds out may be above their floor where the fitted ones are not.
    replayed = level.replicates
    error, replays = scorer.base_error, np.array([r.error for r in replayed])
    above = error > ceiling(replays)
    if HELD_OUT in evidence.folds.groups:
        above |= evidence.held_out_rmse > ceiling(np.array([r.held_out_rmse for r in replayed]))
    worth = np.where(above, s.worth, s.worth_at_floor)
    found, likely = [], {}
    for name, score in scores.items():
        excess = level.excess(score)
        gain = excess / scorer.independent_samples
        removed = error**2 * (1.0 - np.exp(-2.0 * gain))
        share = removed / np.maximum(
            error**2 - replays.mean(axis=0) ** 2, np.maximum(removed, 1e-30)
        )
        if not np.any((gain > worth) & ((share > s.share) | ~above)):
            continue
        p_value = level.p_value(score)
        if p_value < s.significance:
            found.append((float(excess.sum()), name))
        elif p_value < s.likely:
            likely[name] = (p_value, np.asarray(gain))
    return sorted(found, reverse=True), likely
