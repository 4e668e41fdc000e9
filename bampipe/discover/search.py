"""The search for what a model lacks: sets of effects that beat chance, grown, swapped, pruned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.bench import Bench
from bampipe.discover.chance import Progress, Replicate
from bampipe.discover.growth import (
    Addition,
    choose_companions,
    describe_refusal,
    find_changed_axes,
    grow_set,
    record_addition,
    record_step,
)
from bampipe.discover.influence import SampleRange
from bampipe.discover.insufficient import insufficient_rivals
from bampipe.discover.level import Level
from bampipe.discover.nested import idle_extensions
from bampipe.discover.polish import FittedSet, contest_of, polish
from bampipe.discover.rivals import Choice, choose
from bampipe.discover.scorer import Score, Scorer
from bampipe.discover.settings import Settings
from bampipe.discover.stops import StoppingReplays
from bampipe.estimate.simulation import Runaway
from bampipe.lists import join_names
from bampipe.physics.recipe import Recipe
from bampipe.results.diagnose import Contender, RefusedEffect, SearchStep
from bampipe.results.standing import AT_FLOOR
from bampipe.trials.evidence import Evidence
from bampipe.trials.folds import HELD_OUT
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.noise_floor import NoiseFloor, force_noise_through_offset

Array = NDArray[np.float64]


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
        wider: for each, those that it is a part of and whose other parts add nothing.
        unlike: where one effect is found and no replay looks like the measurement, neither its own
            nor those of its rivals: these rivals, but for those that leave an axis above the floor
            where the effect found does not.
        misfit: mean squared z of the likest of those replays, else 1.
        log_prior: for each, that of itself and of its rivals as it was chosen; see
            `believed.log_prior`.
        contests: for each, those who contend for its place, itself first.
        main: for each, the axis on which it helps most.
        additions: for each, how it stood against the model that it was added to.
        likely: p-value and gain in log error by axis of candidates that would lower the error of
            the final model, but do not beat chance.
        transient: candidates that only one second speaks for, and that second.
        refused: candidates that beat chance and were added, but not kept.
        steps: the sets tried, in order.
        cut_short: whether it ended at `Settings.most_effects`.
        final: replays of the final model, with explainable shares; still: the same of one that
            stands still where it turns round, where those leave less than was measured; floor:
            noise floor by either kind.
        explainable, explainable_after: explainable share of the residual by axis, of the model as
            given and of the final one.
    """

    trials: MeasuredTrials
    recipe: Recipe
    initial: Evidence
    level: Level
    first: Mapping[str, Score]
    found: FittedSet
    groups: Mapping[str, tuple[str, ...]]
    wider: Mapping[str, frozenset[str]]
    unlike: tuple[str, ...]
    misfit: float
    log_prior: Mapping[str, Mapping[str, float]]
    contests: Mapping[str, tuple[Contender, ...]]
    main: Mapping[str, int]
    additions: Mapping[str, Addition]
    likely: Mapping[str, tuple[float, Array]]
    transient: Mapping[str, SampleRange]
    refused: tuple[RefusedEffect, ...]
    steps: tuple[SearchStep, ...]
    cut_short: bool
    final: tuple[Replicate, ...]
    still: tuple[Replicate, ...]
    floor: NoiseFloor
    explainable: Array
    explainable_after: Array

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
    scoring = "scoring every candidate on the measured trials"
    progress(0.0, scoring)
    initial = bench.fit(base, start)
    first = bench.scores(
        base, initial.p, bench.names, lambda share: progress(0.12 * share, scoring)
    )
    explainable = bench.shares(base, initial.p)
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
    steps = [record_step(current)]
    known = level

    def report_step(_: float, message: str) -> None:
        progress(0.4 + 0.05 * len(steps), message)

    while len(current.added) + len(dropped) < s.most_effects:
        evidence = current.evidence
        doubted: dict[str, tuple[float, Array]] = {}
        while True:
            left = {name: score for name, score in scores.items() if name not in doubted}
            significant, likely = _weigh(bench, left, known, evidence)
            significant, more = stops.first_beyond(left, known, significant)
            doubted |= more
            if not more:
                break
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
        beside = choose_companions(bench, stops, current, chosen.winner, significant, known, scores)
        for other in beside:
            transient |= other.transient
            if other.winner:
                joined.append(other)
        del joined[s.most_effects - len(current.added) - len(dropped) :]
        scores = {n: score for n, score in scores.items() if n not in transient}
        out = {*dropped, *transient}
        grown = grow_set(bench, current, joined, known, scores, out)
        if grown.level is None and len(joined) > 1:
            # Whichever of them it is: each has a turn of its own.
            joined = [chosen]
            grown = grow_set(bench, current, joined, known, scores, out)
        made = {c.winner: record_addition(scores[c.winner], known, current) for c in joined}
        if grown.level is None:
            # It resembles what is missing in these trials, but no mechanism could have it.
            name = chosen.winner
            dropped.add(name)
            refused[name] = describe_refusal(name, made[name], current, grown.found, s)
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
    rivals = {name: _rivals(base, first, name, groups.get(name, ()), s) for name in current.added}
    polished = polish(bench, current, rivals, lambda _, what: progress(0.8, what))
    found, contests = polished.found, polished.contests
    bench = replace(bench, trials=found.trials)
    progress(0.85, "replaying the final model for its noise floor")
    same = known.replicates if found is current else ()
    try:
        final = bench.floor_replicas(found.recipe, found.evidence, found.replayed, same)
    except Runaway:
        if found is current:
            raise
        # A rival that scored better has no mechanism that could have it: as found, then.
        found, bench = current, replace(bench, trials=current.trials)
        contests = {name: contest_of(found, name, rivals[name]) for name in found.added}
        final = bench.floor_replicas(found.recipe, found.evidence, found.replayed, known.replicates)
    if found.added != current.added:
        steps.append(record_step(found))
    axes = initial.system.coordinates
    # Beside others, an effect has been replayed again, and what it was chosen by is out of date.
    alone = choices.get(found.added[0]) if len(found.added) == 1 else None
    unlike, misfit = (alone.unlike, alone.misfit) if alone else ((), 1.0)
    main = {name: axes.index(c[0].axis) for name, c in contests.items() if c}
    alike = {n: polished.alike.get(n, groups.get(n, ())) for n in found.added}
    still = bench.still_replicas(found.recipe, found.evidence, found.replayed, final)
    floor = _floor_of(found.evidence, final, still)
    log_prior = {name: choice.log_prior for name, choice in choices.items()}
    for name in main:
        # Where replays say nothing of which it is, what each leaves does.
        unsettled = (*unlike, *(alike[name] if name in polished.unlike else ()))
        behind = insufficient_rivals(bench, found, name, main[name], unsettled, floor)
        behind |= _unbelieved(log_prior.get(name, {}), name, s)
        alike[name] = tuple(n for n in alike[name] if n not in behind)
        unlike = tuple(n for n in unlike if n not in behind)
    wider = {n: idle_extensions(bench, found, n, main[n], {*alike[n], *unlike}) for n in main}
    return Search(
        bench.trials, base, initial, level, first, found,
        alike, wider, unlike, misfit, log_prior, contests, main, additions, likely, transient,
        tuple(r for name, r in refused.items() if name not in found.added), tuple(steps), cut_short,
        tuple(final), tuple(still), floor, explainable,
        bench.shares(found.recipe, found.evidence.p) if found.added else explainable,
    )  # fmt: skip


def _unbelieved(log_prior: Mapping[str, float], name: str, s: Settings) -> frozenset[str]:
    """Rivals of ``name`` that are so much harder to believe that no trial is worth it."""
    least = log_prior.get(name, 0.0) + np.log(s.least_odds)
    return frozenset(n for n, known in log_prior.items() if n != name and known < least)


def _floor_of(
    evidence: Evidence, creeping: Sequence[Replicate], still: Sequence[Replicate]
) -> NoiseFloor:
    """Noise floor by replays that creep where the motion turns round, and others, if there are."""
    floor = NoiseFloor.of_errors([replay.held_out_rmse for replay in creeping])
    if not still:
        return floor
    other = NoiseFloor.of_errors([replay.held_out_rmse for replay in still])
    return floor.raised(other, evidence.held_out_rmse)


def _rivals(
    base: Recipe, first: Mapping[str, Score], name: str, alike: Sequence[str], s: Settings
) -> list[str]:
    """Candidates that help the model as given on the axis where ``name`` does, best first.

    What acts on other axes alone helps there by what it does to parameters that they share.
    """
    if name not in first:
        return list(alike)
    axis = int(np.argmax(first[name].gain))
    others = [n for n in first if n != name and first[n].gain[axis] > 0.0]
    others = [n for n in others if axis in find_changed_axes(base, n)]
    others.sort(key=lambda n: -float(first[n].gain[axis]))
    return [*alike, *(n for n in others[: s.most_rivals] if n not in alike)]


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
    floor = np.mean(replays**2, axis=0)
    through_play = force_noise_through_offset(evidence, bench.trials.sensors)
    blurred = np.clip(1.0 - through_play / np.maximum(floor, 1e-30), 0.0, 1.0)
    worth = np.where(above, s.worth, np.maximum(s.worth, s.worth_at_floor * blurred))
    least = (s.least_force * evidence.applied_rms) ** 2
    found, likely = [], {}
    for name, score in scores.items():
        excess = level.excess(score)
        gain = excess / scorer.independent_samples
        removed = error**2 * (1.0 - np.exp(-2.0 * gain))
        share = removed / np.maximum(
            error**2 - replays.mean(axis=0) ** 2, np.maximum(removed, 1e-30)
        )
        if not np.any((gain > worth) & (removed > least) & ((share > s.share) | ~above)):
            continue
        p_value = level.p_value(score)
        if p_value < s.significance:
            found.append((float(excess.sum()), name))
        elif p_value < s.likely:
            likely[name] = (p_value, np.asarray(gain))
    return sorted(found, reverse=True), likely
