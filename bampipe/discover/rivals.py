"""Candidates that come close to each other, distinguished by replaying each of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bampipe.discover.bench import Bench
from bampipe.discover.chance import Progress, Replicate, candidates_of
from bampipe.discover.influence import SampleRange, largest_second, score_without
from bampipe.discover.level import Level
from bampipe.discover.scorer import Score, Scorer
from bampipe.discover.settings import Settings
from bampipe.discover.start import with_effect
from bampipe.estimate.simulation import Runaway
from bampipe.physics.recipe import Recipe
from bampipe.trials.residuals import Evidence


@dataclass(frozen=True)
class Choice:
    """Which of the candidates that beat chance is to be added.

    Attributes:
        winner: the best one; "" if every one of them rests on one second.
        alike: others that these trials cannot tell from it.
        transient: candidates that only one second speaks for, and that second.
    """

    winner: str
    alike: tuple[str, ...]
    transient: Mapping[str, SampleRange]


def choose(
    bench: Bench,
    significant: Sequence[tuple[float, str]],
    level: Level,
    recipe: Recipe,
    evidence: Evidence,
    scores: Mapping[str, Score],
    progress: Progress,
) -> Choice:
    """Choose among ``significant`` the best, and name others that these trials cannot tell from it.

    Candidates that come close are compared without the second that speaks most for the first of
    them, too: a start or a hit at a stop that happened once must not decide.

    Args:
        bench: the session.
        significant: candidates that beat chance with their excess, best first.
        level: their chance level.
        recipe, evidence: the model that they would be added to, fitted.
        scores: theirs.
        progress: called with a fraction and a message.
    """
    s = bench.settings
    top, best = significant[0]
    axis = int(np.argmax(level.excess(scores[best])))
    close = [
        name
        for excess, name in significant
        if excess > s.rival_share * top and int(np.argmax(level.excess(scores[name]))) == axis
    ]
    items = candidates_of(recipe, close)
    scorer, known = Scorer(evidence), [scores[name] for name in close]
    second = largest_second(evidence, scorer.gain_by_sample(items[0], known[0]))
    rest = score_without(evidence, items, known, second)

    least = s.worth_without_second * s.worth

    def stands(name: str) -> bool:
        score = rest.get(name)
        return (
            score is not None
            and level.p_value(score) < s.significance
            and bool(np.any(score.gain / scorer.independent_samples > least))
        )

    firm = sorted((n for n in close if stands(n)), key=lambda n: -rest[n].total)
    transient = {name: second for name in close if name not in firm}
    if not firm:
        return Choice("", (), transient)
    rivals = firm[: s.most_rivals]
    constants = {item.name: sum(not q.fixed for q in item.parameters) for item in items}

    def simplest(names: Sequence[str]) -> str:
        """Of those that explain as much as the first, the one with the fewest constants."""
        least = rest[names[0]].total - max(s.score_sd, s.swap * abs(rest[names[0]].total))
        return min((n for n in names if rest[n].total >= least), key=lambda n: constants[n])

    best = simplest(rivals)
    if len(rivals) == 1:
        return Choice(best, (), transient)
    misfit = {}
    for k, name in enumerate(rivals):
        progress(0.5, f"replaying {name} to tell it from {len(rivals) - 1} rival(s)")
        wider = replace(recipe, effects=(*recipe.effects, name))
        fitted = bench.fit(wider, with_effect(wider, evidence, scores[name]))
        try:
            replicas = bench.replicas(
                wider,
                fitted.p,
                bench.settings.rival_replicates,
                rivals,
                (2, k),
                analysed=(recipe, evidence.p),
            )
        except Runaway:
            misfit[name] = np.inf
            continue
        misfit[name] = _misfit(rivals, scores, replicas, axis, s)
    ordered = sorted(rivals, key=lambda n: misfit[n])
    winner = ordered[0]
    if misfit[winner] > s.rival_misfit + s.rival_margin:
        # No rival's replays look like the measurement, as where more is missing than one effect:
        # their patterns are no evidence for any of them.
        return Choice(best, (), transient)
    limit = max(s.rival_misfit, misfit[winner] + s.rival_margin)
    alike = tuple(n for n in ordered[1:] if misfit[n] < limit)
    if best in alike:
        alike = (winner, *[n for n in alike if n != best])
        winner = best
    plain = simplest([winner, *alike])
    if plain != winner:
        alike = (winner, *[n for n in alike if n != plain])
        winner = plain
    return Choice(winner, alike[: s.most_alike], transient)


def _misfit(
    rivals: Sequence[str],
    scores: Mapping[str, Score],
    replicas: Sequence[Replicate],
    axis: int,
    s: Settings,
) -> float:
    """How unlike the measured pattern of scores is to the replayed one: mean squared z.

    Errors of the scores themselves are allowed for, because no replay is perfect.
    """
    total = 0.0
    for name in rivals:
        measured = scores[name].gain[axis]
        replayed = np.array(
            [r.scores[name].gain[axis] if name in r.scores else 0.0 for r in replicas]
        )
        spread = np.sqrt(
            replayed.var(ddof=1) + (s.score_error * replayed.mean()) ** 2 + s.score_sd**2
        )
        total += ((measured - replayed.mean()) / spread) ** 2
    return float(total / len(rivals))
