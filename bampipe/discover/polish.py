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
from bampipe.discover.chance import (
    Progress,
    candidates_of,
    fit_trials,
    linearise,
    open_trials,
    retimed_trials,
)
from bampipe.discover.influence import largest_second, largest_trial, score_without
from bampipe.discover.rivals import plausible, replay_rivals, without_mere_offsets
from bampipe.discover.scorer import Score, Scorer
from bampipe.discover.settings import Settings
from bampipe.discover.start import with_effect, without_effect
from bampipe.physics.recipe import Recipe
from bampipe.results.diagnose import Contender
from bampipe.trials.evidence import Evidence
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.noise_floor import parameters_to_replay
from bampipe.trials.residuals import residual_and_memory

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


def extend_set(known: FittedSet, score: Score) -> FittedSet:
    """Fit the set with one effect more, from where it was scored."""
    wider = replace(known.recipe, effects=(*known.recipe.effects, score.name))
    start = with_effect(wider, known.evidence, score)
    trials = retimed_trials(known.trials, score.late_s)
    fitted = fit_trials(trials, wider, start, known.evidence)
    return FittedSet(wider, (*known.added, score.name), fitted, trials)


def reduce_set(known: FittedSet, name: str) -> FittedSet:
    """Fit the set without one of its effects."""
    fewer = replace(known.recipe, effects=tuple(e for e in known.recipe.effects if e != name))
    start = without_effect(fewer, known.evidence)
    fitted = fit_trials(known.trials, fewer, start, known.evidence)
    return FittedSet(fewer, tuple(n for n in known.added if n != name), fitted, known.trials)


def is_superfluous(error: Array, without: Array, s: Settings) -> bool:
    """Whether the error (n_q,) on every axis stays, but for what is not worth an effect."""
    return bool(np.all(np.log(without / error) < s.worth))


@dataclass(frozen=True)
class LeaveOutTask:
    """An effect of a set that is left out, and weighed beside its rivals.

    Attributes:
        recipe, p: the set, and its parameters as fitted.
        name: the effect; rivals: others for its place.
        late_s: time by which inputs were sampled after positions.
    """

    recipe: Recipe
    p: Array
    name: str
    rivals: tuple[str, ...]
    late_s: float | None


@dataclass(frozen=True)
class LeftOut:
    """What a set is without one effect.

    Attributes:
        error: that of the `FittedSet` without it, (n_q,).
        scores: of the effect and its rivals against that.
        contest: the same, best first; see `weigh`.
    """

    error: Array
    scores: dict[str, Score]
    contest: list[Contender]


def run_leave_out(task: LeaveOutTask) -> LeftOut:
    """Fit a set without one of its effects, and weigh what may take its place."""
    evidence = linearise(task.recipe, task.p, task.late_s)
    fewer = reduce_set(FittedSet(task.recipe, (), evidence, open_trials(task.late_s)), task.name)
    found = {
        item.name: fewer.scorer.score(item)
        for item in candidates_of(fewer.recipe, (task.name, *task.rivals))
    }
    scores = {name: score for name, score in found.items() if score is not None}
    return LeftOut(fewer.error, scores, weigh(fewer, task.name, scores))


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
        found, left_out = _swap_by_score(bench, found, rivals, swapped)
        alike: dict[str, tuple[str, ...]] = {}
        unlike = set()
        for name in found.added:
            likely, other, resembles = _swap_by_replay(bench, found, name, left_out[name], progress)
            if other is not None and name not in swapped:
                swapped |= {name, likely[0]}
                found = other
                break
            if likely:
                alike[name] = tuple(n for n in likely if n != name)
            if not resembles:
                unlike.add(name)
        else:
            contests = {name: _itself_first(out, name) for name, out in left_out.items()}
            return Polished(found, contests, alike, frozenset(unlike))


def _swap_by_score(
    bench: Bench, found: FittedSet, rivals: Mapping[str, Sequence[str]], swapped: set[str]
) -> tuple[FittedSet, dict[str, LeftOut]]:
    """Drop and swap effects by their scores; ``swapped`` holds those that were, for good."""
    s = bench.settings
    while True:
        left_out: dict[str, LeftOut] = {}
        tasks = [_leave_out(found, name, rivals.get(name, ())) for name in found.added]
        for name, out in zip(found.added, bench.pool(run_leave_out, tasks), strict=True):
            if len(found.added) > 1 and is_superfluous(found.error, out.error, s):
                found = reduce_set(found, name)
                break
            best = out.contest[0] if out.contest else None
            # An effect that is alone has been compared with its rivals by replays already.
            if len(found.added) > 1 and best and best.effect != name and name not in swapped:
                mine = next(c for c in out.contest if c.effect == name)
                if _beats(best, mine, s):
                    other = extend_set(reduce_set(found, name), out.scores[best.effect])
                    if np.sum(np.log(other.error / found.error)) < 0.0:
                        swapped |= {name, best.effect}
                        found = other
                        break
            left_out[name] = out
        else:
            return found, left_out


def _leave_out(found: FittedSet, name: str, rivals: Sequence[str]) -> LeaveOutTask:
    others = tuple(r for r in rivals if r not in found.added)
    return LeaveOutTask(found.recipe, found.evidence.p, name, others, found.trials.late_s)


def _swap_by_replay(
    bench: Bench, found: FittedSet, name: str, out: LeftOut, progress: Progress
) -> tuple[list[str], FittedSet | None, bool]:
    """Compare an effect of a set with its close rivals by replays, beside the others of the set.

    Returns:
        Those that these trials do not tell apart, none where none comes close; the set with the
        first of them where the effect itself is not among them; and whether replays of any look
        like the measurement.
    """
    if len(found.added) < 2 or not out.contest:
        return [], None, True
    s, (mine, *others) = bench.settings, _itself_first(out, name)
    close = [c.effect for c in others if comes_close(c, mine, s)]
    if not close:
        return [], None, True
    fewer = reduce_set(found, name)
    bench = replace(bench, trials=fewer.trials)
    scores = {n: out.scores[n] for n in (name, *close)}
    axis = fewer.evidence.system.coordinates.index(mine.axis)
    misfits = replay_rivals(bench, fewer.recipe, fewer.evidence, scores, axis, progress)
    likely = plausible(misfits, s, max(scores, key=lambda n: scores[n].total))
    resembles = bool(likely)
    if not resembles:
        # None looks like the measurement: those that do no worse are no less likely.
        likely = [n for n in close if misfits[n] <= misfits[name]] + [name]
    if name in likely:
        alike = [n for n in likely if n != name]
        rivals = without_mere_offsets(fewer.recipe, fewer.evidence, scores, alike, s)
        return [name, *rivals], None, resembles
    return likely, extend_set(fewer, scores[likely[0]]), resembles


def contest_of(found: FittedSet, name: str, rivals: Sequence[str]) -> tuple[Contender, ...]:
    """Those who contend for the place of an effect of a set, itself first."""
    return _itself_first(run_leave_out(_leave_out(found, name, rivals)), name)


def _itself_first(out: LeftOut, name: str) -> tuple[Contender, ...]:
    return tuple(sorted(out.contest, key=lambda c: c.effect != name))


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
