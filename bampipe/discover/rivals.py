"""Candidates that come close to each other, distinguished by replaying each of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.believed import count_new_constants, log_prior
from bampipe.discover.bench import Bench
from bampipe.discover.candidates import Candidate
from bampipe.discover.chance import Progress, candidates_of, retimed_trials
from bampipe.discover.columns import added_columns
from bampipe.discover.influence import SampleRange, largest_second, score_without
from bampipe.discover.level import Level
from bampipe.discover.scorer import Score, Scorer
from bampipe.discover.settings import Settings
from bampipe.discover.start import with_effect
from bampipe.estimate.simulation import Runaway
from bampipe.physics.recipe import Recipe
from bampipe.trials.evidence import Evidence

Array = NDArray[np.float64]

_CLEARLY = 2.0
"""Times the limit of a misfit from which on replays alone decide against the best score. Two delays
at 1.2 and 1.5 times it, where scores were right, had the name of a lag."""


@dataclass(frozen=True)
class Choice:
    """Which of the candidates that beat chance is to be added.

    Attributes:
        winner: the best one; "" if every one of them rests on one second.
        alike: others that these trials cannot tell from it.
        transient: candidates that only one second speaks for, and that second.
        unlike: where replays of neither the best nor any other look like the measurement, those
            whose replays are not much farther off: scores are all that distinguishes them.
        misfit: mean squared z of the likest of those replays.
        log_prior: of all that came close, see `believed.log_prior`.
    """

    winner: str
    alike: tuple[str, ...]
    transient: Mapping[str, SampleRange]
    unlike: tuple[str, ...] = ()
    misfit: float = 1.0
    log_prior: Mapping[str, float] = field(default_factory=dict)


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
    believed = {item.name: log_prior(item, scores[item.name]) for item in items}
    rivals = believable(firm, {n: rest[n].total for n in firm}, believed, s)[: s.most_rivals]
    if len(rivals) == 1:
        return Choice(rivals[0], (), transient, log_prior=believed)
    here = [item for item in items if item.name in rivals]
    constants = {item.name: count_new_constants(evidence, item, scores[item.name]) for item in here}

    def simplest(names: Sequence[str]) -> str:
        """Of those that explain as much as the first, the one with the fewest constants.

        Of as many, the one whose strength is easiest to believe.
        """
        least = rest[names[0]].total - max(s.score_sd, s.swap * abs(rest[names[0]].total))
        equal = (n for n in names if rest[n].total >= least)
        return min(equal, key=lambda n: (constants[n], -believed[n]))

    best = simplest(rivals)
    replayed = {name: scores[name] for name in rivals}
    misfits = replay_rivals(bench, recipe, evidence, replayed, axis, progress)
    likely = plausible(misfits, s, best)
    if not likely:
        # As where more is missing than one effect.
        unlike = unsettled_rivals(misfits, best, s)
        return Choice(best, (), transient, unlike, min(misfits.values()), believed)
    winner, *others = likely
    alike = tuple(others)
    if best in alike:
        alike = (winner, *[n for n in alike if n != best])
        winner = best
    plain = simplest([winner, *alike])
    if plain != winner:
        alike = (winner, *[n for n in alike if n != plain])
        winner = plain
    alike = without_mere_offsets(recipe, evidence, scores, alike, s)
    return Choice(winner, alike[: s.most_alike], transient, log_prior=believed)


def believable(
    names: Sequence[str],
    totals: Mapping[str, float],
    log_prior: Mapping[str, float],
    s: Settings,
) -> list[str]:
    """Those of ``names`` beside which none that fits about as well is far easier to believe.

    Args:
        totals, log_prior: of each, its score and what is known of it beforehand.
        s: how near scores are, and up to which odds an effect is worth a trial.
    """
    worth = float(np.log(s.least_odds))
    return [
        name
        for name in names
        if not any(
            totals[other] >= s.rival_score * totals[name]
            and log_prior[name] < log_prior[other] + worth
            for other in names
        )
    ]


def without_mere_offsets(
    recipe: Recipe,
    evidence: Evidence,
    scores: Mapping[str, Score],
    alike: Sequence[str],
    s: Settings,
) -> tuple[str, ...]:
    """Those of ``alike`` that add more than a constant: a spring of no stiffness is no spring.

    Args:
        recipe, evidence: the model without any of them, fitted.
        scores: of them against it; alike: those that fit as well as another.
        s: what share of an effect must be more than its offset.
    """
    return tuple(
        item.name
        for item in candidates_of(recipe, alike)
        if not _is_mere_offset(evidence, item, scores[item.name], s)
    )


def _is_mere_offset(evidence: Evidence, item: Candidate, score: Score, s: Settings) -> bool:
    """Whether nearly all that an effect adds to the residual is its offset."""
    moving = [not item.parameters[i].offset for i in item.linear_indices]
    if all(moving):
        return False
    columns, _ = added_columns(evidence, item, score.values[list(item.searched_indices)])
    parts = np.concatenate(columns) * score.values[list(item.linear_indices)]
    whole, rest = (float(np.sum(parts[:, :, which].sum(axis=2) ** 2)) for which in (..., moving))
    return rest < s.idle**2 * whole


def replay_rivals(
    bench: Bench,
    recipe: Recipe,
    evidence: Evidence,
    scores: Mapping[str, Score],
    axis: int,
    progress: Progress,
) -> dict[str, float]:
    """How unlike the measurement replays of each rival are, as a mean squared z; the likest first.

    Which rival fits best is no proof: filtering and sampling blur what each should leave. Each is
    added and replayed, and every one of them is scored on the replays as on the measurement.

    Args:
        bench: the session.
        recipe, evidence: the model that they would be added to, fitted.
        scores: of the rivals against it.
        axis: on which they are compared.
        progress: called with a fraction and a message.
    """
    s, rivals = bench.settings, list(scores)
    blur = s.replay_error * float(Scorer(evidence).independent_samples[axis])
    misfits = {}
    for k, name in enumerate(rivals):
        progress(0.5, f"replaying {name} and what may be mistaken for it")
        wider = replace(recipe, effects=(*recipe.effects, name))
        timed = replace(bench, trials=retimed_trials(bench.trials, scores[name].late_s))
        fitted = timed.fit(wider, with_effect(wider, evidence, scores[name]), evidence)
        try:
            replicas = timed.replicas(
                wider, fitted.p, s.rival_replicates, rivals, (2, k),
                analysed=(recipe, evidence.p),
            )  # fmt: skip
        except Runaway:
            misfits[name] = np.inf
            continue
        gains = [[r.scores[n].gain[axis] if n in r.scores else 0.0 for n in rivals]
                 for r in replicas]  # fmt: skip
        measured = np.array([scores[n].gain[axis] for n in rivals])
        misfits[name] = _misfit(measured, np.array(gains), blur, s)
    return dict(sorted(misfits.items(), key=lambda pair: pair[1]))


def plausible(misfits: Mapping[str, float], s: Settings, best: str = "") -> list[str]:
    """Rivals whose replays look like the measurement, the likest first; none if those do not.

    Args:
        misfits: from `replay_rivals`; best: the one with the best score, or the simplest of
            several, which replays that are not clearly against it leave beside those that they
            speak for.
    """
    least = min(misfits.values())
    if least > s.rival_misfit + s.rival_margin:
        return []
    limit = max(s.rival_misfit, least + s.rival_margin)
    return [
        name
        for name, misfit in misfits.items()
        if misfit == least or misfit < limit * (_CLEARLY if name == best else 1.0)
    ]


def unsettled_rivals(misfits: Mapping[str, float], best: str, s: Settings) -> tuple[str, ...]:
    """Rivals that replays leave open where those of none look like the measurement.

    What replays lack, they lack for every rival: they err by as much as the likest of them (Birge
    ratio), and one that is farther off than that allows is out, unless ``best`` is so itself.

    Args:
        misfits: from `replay_rivals`; best: as of `plausible`.
    """
    limit = min(misfits.values()) * (1.0 + s.rival_margin / s.rival_misfit)
    contradicted = misfits[best] > limit
    return tuple(
        n for n, misfit in misfits.items() if n != best and (contradicted or misfit <= limit)
    )


def _misfit(measured: Array, replayed: Array, blur: float, s: Settings) -> float:
    """Mean squared z of measured scores (n,) beside replayed ones, (R, n).

    What replays do to all rivals alike says nothing of which is right: their mean counts as one
    number, and how each stands to it as another.

    Args:
        measured, replayed: gains in log likelihood.
        blur: error of a gain because no replay is perfect.
    """

    def squared_z(here: Array, there: Array) -> Array:
        mean = there.mean(axis=0)
        spread = there.var(axis=0, ddof=1) + (s.score_error * mean) ** 2
        return np.asarray((here - mean) ** 2 / (spread + s.score_sd**2 + blur**2))

    level, levels = measured.mean(), replayed.mean(axis=1)
    each = squared_z(measured - level, replayed - levels[:, None])
    return float(0.5 * (squared_z(level, levels) + each.mean()))
