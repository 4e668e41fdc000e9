"""Candidates that come close to each other, told apart by replaying each of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bampipe.discover.bench import Bench
from bampipe.discover.candidates import Score
from bampipe.discover.chance import Progress, Replicate
from bampipe.discover.level import Level
from bampipe.discover.settings import Settings
from bampipe.discover.start import with_effect
from bampipe.estimate.simulation import Runaway
from bampipe.physics.recipe import Recipe
from bampipe.trials.residuals import Evidence


def choose(
    bench: Bench,
    significant: Sequence[tuple[float, str]],
    level: Level,
    recipe: Recipe,
    evidence: Evidence,
    scores: Mapping[str, Score],
    progress: Progress,
) -> tuple[str, tuple[str, ...]]:
    """The best of ``significant``, and others that these trials cannot tell from it, two at most.

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
    rivals = [
        name
        for excess, name in significant
        if excess > s.rival_share * top and int(np.argmax(level.excess(scores[name]))) == axis
    ][: s.most_rivals]
    if len(rivals) == 1:
        return best, ()
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
        return best, ()
    limit = max(s.rival_misfit, misfit[winner] + s.rival_margin)
    alike = tuple(n for n in ordered[1:] if misfit[n] < limit)
    if best in alike:
        alike = (winner, *[n for n in alike if n != best])
        winner = best
    return winner, alike[:2]


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
