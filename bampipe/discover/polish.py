"""The set of effects that a search found, put to the test in the presence of all the others.

What came first may be superfluous once the rest is there, or another effect may do better in its
place: effects are left out in turn, and weighed again beside their rivals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.bench import Bench
from bampipe.discover.chance import Progress, candidates_of
from bampipe.discover.influence import largest_second, largest_trial, score_without
from bampipe.discover.rivals import plausible, replay_rivals, without_mere_offsets
from bampipe.discover.scorer import Score, Scorer
from bampipe.discover.settings import Settings
from bampipe.discover.start import with_effect, without_effect
from bampipe.physics.recipe import Recipe
from bampipe.results.diagnose import Contender
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.noise_floor import parameters_to_replay
from bampipe.trials.residuals import Evidence, residual_and_memory

Array = NDArray[np.float64]

_LEAST_SLOPE = 1e-6
"""Of a residual by its force, where a sample has none: its logarithm stays finite."""


@dataclass(frozen=True)
class FittedSet:
    """A model with some effects, fitted.

    Attributes:
        recipe: the model; added: the effects that the model as given lacks, in order.
        evidence: its fit.
        trials: that it was fitted to.
        published: parameters (n_p,) of the mechanism, where they have been identified.
    """

    recipe: Recipe
    added: tuple[str, ...]
    evidence: Evidence
    trials: MeasuredTrials
    published: Array | None = None

    @cached_property
    def error(self) -> Array:
        """Cross-validated error among the fitted trials over `slope_by_force`, by axis.

        What only makes both sides of the equation small, noise included, explains nothing.
        """
        return self.scorer.base_error / self.slope_by_force

    @cached_property
    def replayed(self) -> Array:
        """Parameters (n_p,) with which the model is replayed."""
        trials = self.trials
        return parameters_to_replay(
            self.evidence, trials.sensors, trials.kinematics, self.published
        )

    @cached_property
    def scorer(self) -> Scorer:
        """Scores candidates against it."""
        return Scorer(self.evidence)

    @cached_property
    def slope_by_force(self) -> Array:
        """Geometric mean slope of the first trial's residual by its force, by axis, (n_q,).

        As a gain in log likelihood takes it off: what friction in proportion to the load makes of
        a push and of a pull must not cancel.
        """
        evidence = self.evidence
        system, motion = evidence.system, evidence.motions[0]
        u = motion.inputs(system.inputs)
        plain, _ = residual_and_memory(system, motion, u, evidence.p)
        square = np.zeros(plain.shape)
        for name in system.model.device.forces:
            column = system.inputs.index(name)
            step = 1e-3 * max(float(np.abs(u[:, column]).max()), 1e-9)
            moved = u.copy()
            moved[:, column] += step
            changed, _ = residual_and_memory(system, motion, moved, evidence.p)
            square += np.square((changed - plain) / step)
        return np.asarray(
            np.exp(0.5 * np.mean(np.log(np.maximum(square, _LEAST_SLOPE**2)), axis=0))
        )


def extend_set(bench: Bench, known: FittedSet, score: Score) -> FittedSet:
    """Fit the set with one effect more, from where it was scored."""
    wider = replace(known.recipe, effects=(*known.recipe.effects, score.name))
    fitted = bench.fit(wider, with_effect(wider, known.evidence, score), known.evidence)
    return FittedSet(wider, (*known.added, score.name), fitted, bench.trials)


def reduce_set(bench: Bench, known: FittedSet, name: str) -> FittedSet:
    """Fit the set without one of its effects."""
    fewer = replace(known.recipe, effects=tuple(e for e in known.recipe.effects if e != name))
    fitted = bench.fit(fewer, without_effect(fewer, known.evidence), known.evidence)
    kept = tuple(n for n in known.added if n != name)
    return FittedSet(fewer, kept, fitted, bench.trials)


def is_superfluous(known: FittedSet, without: FittedSet, s: Settings) -> bool:
    """Whether the error on every axis stays, but for what is not worth an effect."""
    return bool(np.all(np.log(without.error / known.error) < s.worth))


@dataclass(frozen=True)
class Polished:
    """A set of effects that has been put to the test.

    Attributes:
        found: the set, fitted.
        contests: by effect, those who contend for its place: itself first, then its rivals.
        alike: by effect that was replayed beside the others, rivals that these trials cannot tell
            from it.
        unlike: effects of which neither replays nor those of their rivals look like the
            measurement: `alike` has those that do no worse.
    """

    found: FittedSet
    contests: Mapping[str, tuple[Contender, ...]]
    alike: Mapping[str, tuple[str, ...]]
    unlike: frozenset[str]


def polish(
    bench: Bench, found: FittedSet, rivals: Mapping[str, Sequence[str]], progress: Progress
) -> Polished:
    """Drop what is superfluous, swap what another effect does better, weigh each beside its rivals.

    Args:
        bench: the session.
        found: the set, fitted.
        rivals: by effect of the set, others that act where it does, most promising first.
        progress: called with a fraction and a message.
    """
    swapped: set[str] = set()
    while True:
        found, contests = _swap_by_score(bench, found, rivals, swapped)
        alike: dict[str, tuple[str, ...]] = {}
        unlike = set()
        for name in found.added:
            likely, other, resembles = _swap_by_replay(bench, found, contests[name], progress)
            if other is not None and name not in swapped:
                swapped |= {name, likely[0]}
                found = other
                break
            if likely:
                alike[name] = tuple(n for n in likely if n != name)
            if not resembles:
                unlike.add(name)
        else:
            return Polished(found, contests, alike, frozenset(unlike))


def _swap_by_score(
    bench: Bench, found: FittedSet, rivals: Mapping[str, Sequence[str]], swapped: set[str]
) -> tuple[FittedSet, dict[str, tuple[Contender, ...]]]:
    """Drop and swap effects by their scores; ``swapped`` holds those that were, for good."""
    s = bench.settings
    contests: dict[str, tuple[Contender, ...]] = {}
    waiting = list(found.added)
    while waiting:
        name = waiting.pop(0)
        fewer = reduce_set(bench, found, name)
        if len(found.added) > 1 and is_superfluous(found, fewer, s):
            found, contests = fewer, {}
            waiting = list(found.added)
            continue
        scores, contest = _contest(bench, found, fewer, name, rivals.get(name, ()))
        best = contest[0] if contest else None
        # An effect that is alone has been compared with its rivals by replays already.
        if len(found.added) > 1 and best and best.effect != name and name not in swapped:
            mine = next(c for c in contest if c.effect == name)
            if _beats(best, mine, s):
                other = extend_set(bench, fewer, scores[best.effect])
                if np.sum(np.log(other.error / found.error)) < 0.0:
                    swapped |= {name, best.effect}
                    found, contests = other, {}
                    waiting = list(found.added)
                    continue
        contests[name] = _itself_first(contest, name)
    return found, contests


def _swap_by_replay(
    bench: Bench, found: FittedSet, contest: Sequence[Contender], progress: Progress
) -> tuple[list[str], FittedSet | None, bool]:
    """Compare an effect of a set with its close rivals by replays, beside the others of the set.

    Returns:
        Those that these trials do not tell apart, none where none comes close; the set with the
        first of them where the effect itself is not among them; and whether replays of any look
        like the measurement.
    """
    if len(found.added) < 2 or not contest:
        return [], None, True
    mine, *others = contest
    close = [c.effect for c in others if comes_close(c, mine, bench.settings)]
    if not close:
        return [], None, True
    fewer = reduce_set(bench, found, mine.effect)
    scores = bench.scores(fewer.recipe, fewer.evidence.p, [mine.effect, *close])
    axis = fewer.evidence.system.coordinates.index(mine.axis)
    misfits = replay_rivals(bench, fewer.recipe, fewer.evidence, scores, axis, progress)
    likely = plausible(misfits, bench.settings)
    resembles = bool(likely)
    if not resembles:
        # None looks like the measurement: those that do no worse are no less likely.
        likely = [n for n in close if misfits[n] <= misfits[mine.effect]] + [mine.effect]
    if mine.effect in likely:
        alike = [n for n in likely if n != mine.effect]
        rivals = without_mere_offsets(fewer.recipe, fewer.evidence, scores, alike, bench.settings)
        return [mine.effect, *rivals], None, resembles
    return likely, extend_set(bench, fewer, scores[likely[0]]), resembles


def contest_of(
    bench: Bench, found: FittedSet, name: str, rivals: Sequence[str]
) -> tuple[Contender, ...]:
    """Those who contend for the place of an effect of a set, itself first."""
    contest = _contest(bench, found, reduce_set(bench, found, name), name, rivals)[1]
    return _itself_first(contest, name)


def _contest(
    bench: Bench, found: FittedSet, fewer: FittedSet, name: str, rivals: Sequence[str]
) -> tuple[dict[str, Score], list[Contender]]:
    """Scores of an effect of a set and its rivals against the set without it, and the contest."""
    others = [r for r in rivals if r not in found.added]
    scores = bench.scores(fewer.recipe, fewer.evidence.p, [name, *others])
    return scores, weigh(fewer, name, scores)


def _itself_first(contest: Sequence[Contender], name: str) -> tuple[Contender, ...]:
    return tuple(sorted(contest, key=lambda c: c.effect != name))


def comes_close(one: Contender, mine: Contender, s: Settings) -> bool:
    """Whether an effect comes close to the one found, by any score in which that gains at all."""
    pairs = [(one.score, mine.score), (one.score_without_second, mine.score_without_second)]
    if one.score_without_trial is not None and mine.score_without_trial is not None:
        pairs.append((one.score_without_trial, mine.score_without_trial))
    return any(theirs >= s.rival_score * ours for theirs, ours in pairs if ours > 0.0)


def weigh(fewer: FittedSet, name: str, scores: Mapping[str, Score]) -> list[Contender]:
    """Score an effect and its rivals as a whole, without the worst trial, and without a second.

    Args:
        fewer: the model without the effect, fitted.
        name: the effect; scores: of it and its rivals against that model.

    Returns:
        Best first by what they gain without the second that speaks most for ``name``.
    """
    if name not in scores:
        return []
    names = [name, *(n for n in scores if n != name)]
    items = candidates_of(fewer.recipe, names)
    known = [scores[n] for n in names]
    scorer = fewer.scorer
    gained = scorer.gain_by_sample(items[0], known[0])
    second = largest_second(fewer.evidence, gained)
    without_second = score_without(fewer.evidence, items, known, second)
    without_trial: dict[str, Score] = {}
    if len(fewer.evidence.folds.fitted_trials) > 2:
        trial = largest_trial(fewer.evidence, gained)
        without_trial = score_without(fewer.evidence, items, known, trial)
    axis = int(np.argmax(scores[name].gain))
    contenders = [
        Contender(
            effect=n,
            axis=fewer.evidence.system.coordinates[axis],
            held_out_rmse=scorer.comparable_error(scores[n])[axis],
            score=scores[n].total,
            score_without_trial=without_trial[n].total if n in without_trial else None,
            score_without_second=without_second[n].total if n in without_second else 0.0,
            odds=0.0,
        )
        for n in names
    ]
    return sorted(contenders, key=lambda c: -c.score_without_second)


def _beats(one: Contender, other: Contender, s: Settings) -> bool:
    """Whether an effect is better than another by more than scores are good for, either way."""
    pairs = [(one.score, other.score), (one.score_without_second, other.score_without_second)]
    return all(a - b > max(s.score_sd, s.swap * abs(b)) for a, b in pairs)
