"""The search for what a model lacks: the best candidate that beats chance, again and again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.bench import Bench
from bampipe.discover.candidates import Score, Scorer
from bampipe.discover.chance import Progress, Replicate
from bampipe.discover.level import Level
from bampipe.discover.rivals import choose
from bampipe.discover.start import with_effect, without_effect
from bampipe.estimate.simulation import Runaway
from bampipe.physics.recipe import Recipe
from bampipe.results.standing import AT_FLOOR, standing
from bampipe.trials.noise_floor import FLOOR_SEED, NoiseFloor
from bampipe.trials.residuals import Evidence

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Search:
    """What a search came to.

    Attributes:
        recipe: the model as given.
        initial: its fit.
        level: chance level of candidates against it.
        first: scores against it.
        groups: for each effect added, in order, the others that these trials cannot tell from it.
        main: for each, the axis on which it helps most.
        evidence: fit of the model with all of them.
        final: replays of that model, with explainable shares.
    """

    recipe: Recipe
    initial: Evidence
    level: Level
    first: Mapping[str, Score]
    groups: Mapping[str, tuple[str, ...]]
    main: Mapping[str, int]
    evidence: Evidence
    final: tuple[Replicate, ...]

    @property
    def selected(self) -> tuple[str, ...]:
        """Effects added, in order."""
        return tuple(self.groups)


def search(bench: Bench, base: Recipe, start: Array, progress: Progress) -> Search:
    """Add effects to a model until no candidate beats chance.

    Args:
        bench: the session and the candidates.
        base: the model as given.
        start: parameters to start its fit from, (n_p,).
        progress: called with a fraction and a message.
    """
    s = bench.settings
    progress(0.0, "preparing the candidates")
    bench.prepare(base)
    initial = bench.fit(base, start)
    progress(0.05, "scoring every candidate on the measured trials")
    first = bench.scores(base, initial.p, bench.names)
    progress(0.15, "replaying the model for chance levels")
    level = bench.level(base, initial, bench.gaining(first, Scorer(initial)), (FLOOR_SEED,))
    recipe, evidence, scores = base, initial, first
    groups: dict[str, tuple[str, ...]] = {}
    main: dict[str, int] = {}
    dropped: set[str] = set()
    replayed = level.replicates
    while len(groups) + len(dropped) < s.most_effects:
        known = level
        significant = _significant(bench, scores, known, evidence, replayed)
        if significant and groups:
            # What a model with the first effects leaves by chance may look like another one.
            close = {name: scores[name] for _, name in significant}
            known = bench.level(recipe, evidence, list(close), (4, len(groups)))
            significant = _significant(bench, close, known, evidence, replayed)
        if not significant:
            break
        best, alike = choose(bench, significant, known, recipe, evidence, scores, progress)
        wider = replace(base, effects=(*base.effects, *groups, best))
        fitted = bench.fit(wider, with_effect(wider, evidence, scores[best]))
        wider, fitted = _needed(bench, base, wider, fitted)
        try:
            replays = bench.replicas(wider, fitted.p, s.rival_replicates, (), (3,))
            sound = _keeps_the_floor(fitted, replays, replayed)
        except Runaway:
            sound = False
        if not sound:
            # It resembles what is missing in these trials, but no mechanism could have it.
            dropped.add(best)
            scores = {name: score for name, score in scores.items() if name != best}
            continue
        recipe, evidence, replayed = wider, fitted, replays
        groups[best] = alike
        help_ = level.excess(first[best]) if best in first else known.excess(scores[best])
        main[best] = int(np.argmax(help_))
        progress(0.45 + 0.1 * len(groups), f"added {best}, looking for more")
        dropped |= set(groups) - set(recipe.effects)
        groups = {name: alike for name, alike in groups.items() if name not in dropped}
        main = {name: axis for name, axis in main.items() if name not in dropped}
        rest = [n for n in bench.names if n not in groups and n not in dropped]
        scores = bench.scores(recipe, evidence.p, rest)
    progress(0.85, "replaying the final model for its noise floor")
    final = bench.floor_replicas(recipe, evidence.p)
    return Search(
        base, initial, level, first, groups, main, evidence, tuple(final)
    )  # fmt: skip


def _keeps_the_floor(
    evidence: Evidence, replays: Sequence[Replicate], before: Sequence[Replicate]
) -> bool:
    """Whether an effect buys nothing by raising the noise floor.

    The replays of a model with a wrong effect can be so wild that any error is below their floor:
    such a floor is no better than none, unless it was like that without the effect.
    """
    error = Scorer(evidence).before.error
    after, earlier = (NoiseFloor.of_errors([r.error for r in some]) for some in (replays, before))
    return not any(
        standing(float(error[i]), float(after.mean[i])) == "floor_implausible"
        and after.mean[i] > 2.0 * earlier.mean[i]
        for i in range(len(error))
    )


def _needed(
    bench: Bench, base: Recipe, recipe: Recipe, evidence: Evidence
) -> tuple[Recipe, Evidence]:
    """The model without those earlier effects that the latest one makes superfluous, and its fit.

    What resembles the missing effect may come first, because it takes a little of several others.
    """
    now = Scorer(evidence).before.error
    for name in recipe.effects[len(base.effects) : -1]:
        fewer = replace(recipe, effects=tuple(e for e in recipe.effects if e != name))
        fitted = bench.fit(fewer, without_effect(fewer, evidence))
        then = Scorer(fitted).before.error
        if np.all(np.log(then / now) < bench.settings.worth):
            recipe, evidence, now = fewer, fitted, then
    return recipe, evidence


def _significant(
    bench: Bench,
    scores: Mapping[str, Score],
    level: Level,
    evidence: Evidence,
    replayed: Sequence[Replicate],
) -> list[tuple[float, str]]:
    """Candidates that beat chance and are worth having, best first."""
    scorer, s = Scorer(evidence), bench.settings
    level.ask(bench.gaining(scores, scorer))
    errors = np.array([r.error for r in replayed])
    ceiling = AT_FLOOR * errors.mean(axis=0) + 2.0 * errors.std(axis=0, ddof=1)
    worth = np.where(scorer.before.error > ceiling, s.worth, s.worth_at_floor)
    found = []
    for name, score in scores.items():
        excess = level.excess(score)
        if np.any(excess / scorer.independent > worth) and level.p_value(score) < s.significance:
            found.append((float(excess.sum()), name))
    return sorted(found, reverse=True)
