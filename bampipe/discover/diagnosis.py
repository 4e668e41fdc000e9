"""Which effect a model lacks, or that it lacks none, or that the library has no name for it.

1. Every candidate is refitted with the model and scored on trials left out.
2. The same is done with replays of the fitted model, which lack nothing: the chance level.
3. The best candidate that beats chance is added, and so on until none does; later ones must also
   beat replays of the model with those before them. Candidates that come close to the best are
   told apart by replaying each of them: the pattern of all their scores must look like the
   measured one. Those that pass alike are reported as one group.
4. What is left is compared with the noise floor of the final model, found by replaying it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from bampipe.discover.candidates import Score, Scorer, library
from bampipe.discover.chance import (
    Pool,
    PrepareTask,
    Recipe,
    Replicate,
    ReplicateTask,
    ScoreTask,
    Session,
    candidates_of,
    fit_session,
    prepare,
    run_replicate,
    run_scores,
    workers,
)
from bampipe.discover.evidence import Evidence
from bampipe.discover.shape import explainable_share
from bampipe.discover.start import with_effect
from bampipe.physics.parameter import Parameter
from bampipe.physics.registry import effect_from

Array = NDArray[np.float64]
REPLAY_ERROR = 0.01
"""How far the log error of a replay may be off because no replay is perfect."""

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Settings:
    """How carefully to look.

    Attributes:
        replicates: replays of the model for the chance level.
        final_replicates: replays of the final model for the noise floor.
        rival_replicates: replays of each rival when candidates come close.
        most_effects: the most effects added.
        significance: chance of a false alarm in a session that is accepted.
        worth: least drop of log error beyond chance, on one axis, that is worth an effect.
        worth_at_floor: the same on an axis whose error is already within ``at_floor`` times its
            noise floor: no replay is perfect, and changes of direction blurred by sampling invite
            spurious effects, up to a tenth of the error on a linear axis.
        at_floor: see ``worth_at_floor``.
        above_floor: error over floor beyond which an axis still lacks something, if some of it
            could be predicted from the motion.
        surely: error over floor beyond which it lacks something, predictable or not.
        explained: least share of the excess mean square that the effects found must remove, else
            the axis is reported as unknown.
        far: error over floor with the effects found beyond which they must remove more.
        explained_far: that share: an effect that only resembles the missing one, such as a spring
            in place of a stop, removes much and leaves many times the floor.
        jobs: worker processes.
        seed: of all noise.
    """

    replicates: int = 10
    final_replicates: int = 6
    rival_replicates: int = 4
    most_effects: int = 4
    significance: float = 0.01
    worth: float = 0.03
    worth_at_floor: float = 0.16
    at_floor: float = 1.12
    above_floor: float = 1.3
    surely: float = 2.0
    explained: float = 0.6
    far: float = 5.0
    explained_far: float = 0.9
    jobs: int = 2
    seed: int = 0


@dataclass(frozen=True)
class Ranked:
    """One candidate in the ranking; errors are of the axis where it helps most, N.m or N."""

    effect: str
    axis: int
    held_out_rmse_before: float
    held_out_rmse_after: float
    p_value: float
    score: float
    values: Mapping[str, float]
    indistinguishable_from: tuple[str, ...] = ()


@dataclass(frozen=True)
class AxisFinding:
    """Verdict on one axis.

    Attributes:
        verdict: ``nothing_missing``, ``missing`` or ``unknown_effect``.
        rmse_before, rmse_after: held-out error without and with the effects found, N.m or N.
        noise_floor: what the final model leaves when it is the whole truth, N.m or N.
        floor_sd: its scatter over replays.
        explainable_share: share of the residual of the model as given that a flexible regressor
            predicts on unseen trials, beyond what it predicts on replays; zero where that is nil.
        explainable_after: the same with the effects found.
        explainable_chance: share that it predicts on replays of the final model, the largest.
        effects: effects found that act on this axis.
        remains: whether the effects found leave something that no effect explains.
        nearest: on an axis called unknown, the effects that come nearest without explaining it.
        explained: share of the excess mean square that the effects found or nearest remove.
    """

    verdict: str
    rmse_before: float
    rmse_after: float
    noise_floor: float
    floor_sd: float
    explainable_share: float
    explainable_after: float
    explainable_chance: float
    effects: tuple[str, ...] = ()
    remains: bool = False
    nearest: tuple[str, ...] = ()
    explained: float = 0.0


@dataclass(frozen=True)
class Diagnosis:
    """What `diagnose` found.

    Attributes:
        axes: by coordinate, in order.
        ranking: candidates, best first.
        selected: effects to add, in order.
        groups: for each selected effect, the others that these trials cannot tell from it.
        evidence: of the model with all selected effects.
        initial: of the model as given.
    """

    axes: tuple[AxisFinding, ...]
    ranking: tuple[Ranked, ...]
    selected: tuple[str, ...]
    groups: Mapping[str, tuple[str, ...]]
    evidence: Evidence
    initial: Evidence


class _Chance:
    """Mean and scatter of candidates' scores on replays of one model, found as needed.

    A candidate that gains nothing on the measured trials needs no chance level; most gain nothing.
    """

    def __init__(
        self,
        replay: Callable[[Sequence[str]], list[Replicate]],
        asked: Sequence[str],
        tests: int,
        independent: float,
    ) -> None:
        self._replay, self._tests, self._independent = replay, tests, independent
        self._gains: dict[str, Array] = {}
        self.replicates = self._learn(asked)

    def _learn(self, names: Sequence[str]) -> list[Replicate]:
        replicates = self._replay(names)
        nothing = np.zeros(len(replicates[0].error))
        for name in names:
            self._gains[name] = np.array(
                [r.scores[name].gain if name in r.scores else nothing for r in replicates]
            )
        return replicates

    def ask(self, names: Sequence[str]) -> None:
        """Replay again for those of ``names`` whose chance level is not known yet."""
        unknown = [name for name in names if name not in self._gains]
        if unknown:
            self._learn(unknown)

    def p_value(self, score: Score) -> float:
        """Chance that any candidate scores this high with nothing missing (Bonferroni).

        One for a candidate that was not worth a chance level.
        """
        if score.name not in self._gains:
            return 1.0
        count = len(self.replicates)
        totals = self._gains[score.name].sum(axis=1)
        spread = np.hypot(
            totals.std(ddof=1) * np.sqrt(1.0 + 1.0 / count), REPLAY_ERROR * self._independent
        )
        z = (score.total - totals.mean()) / spread
        return float(min(1.0, self._tests * student.sf(z, count - 1)))

    def excess(self, score: Score) -> Array:
        """Gain beyond the mean on replays, by axis; the gain itself where that is not known."""
        gains = self._gains.get(score.name)
        return np.asarray(score.gain if gains is None else score.gain - gains.mean(axis=0))


def diagnose(
    session: Session,
    recipe: Recipe,
    start: Array,
    settings: Settings | None = None,
    progress: Progress = lambda fraction, message: None,
) -> Diagnosis:
    """Find what a model lacks.

    Args:
        session: the measured trials, at least two.
        recipe: the model.
        start: parameters to start its fit from, (n_p,).
        settings: how carefully to look.
        progress: called with a fraction and a message.

    Raises:
        ValueError: fewer than two trials.
    """
    settings = settings or Settings()
    if len(session.motions) < 2:
        raise ValueError("a diagnosis needs at least two trials: one is held out")
    with workers(session, settings.jobs) as pool:
        return _Search(session, recipe, start, settings, pool, progress).run()


class _Search:
    def __init__(
        self,
        session: Session,
        recipe: Recipe,
        start: Array,
        settings: Settings,
        pool: Pool,
        progress: Progress,
    ) -> None:
        self.session, self.recipe, self.settings = session, recipe, settings
        self.pool, self.progress = pool, progress
        self.initial = fit_session(self.session, recipe, start)
        model = recipe.model()
        extra = [effect_from(e) for e in recipe.extra]
        self.names = library(model.device, recipe.effects, extra)
        self.groups: dict[str, tuple[str, ...]] = {}

    def run(self) -> Diagnosis:
        s = self.settings
        self.progress(0.0, "preparing the candidates")
        parts = 4 * s.jobs
        list(
            self.pool(
                prepare,
                [PrepareTask(self.recipe, self.names[k::parts]) for k in range(parts)],
            )
        )
        self.progress(0.05, "scoring every candidate on the measured trials")
        first = self._scores(self.recipe, self.initial.p, self.names)
        self.progress(0.15, "replaying the model for chance levels")
        asked = self._gaining(first, Scorer(self.initial))
        chance = self._chance(self.recipe, self.initial, asked, (0,))
        recipe, evidence, scores = self.recipe, self.initial, first
        selected: list[str] = []
        replayed = chance.replicates
        while len(selected) < s.most_effects:
            known = chance
            able = self._able(scores, known, evidence, replayed)
            if able and selected:
                # What a model with the first effects leaves by chance may look like another one.
                close = {name: scores[name] for _, name in able}
                known = self._chance(recipe, evidence, list(close), (4, len(selected)))
                able = self._able(close, known, evidence, replayed)
            if not able:
                break
            best = self._choose(able, known, recipe, evidence, scores)
            selected.append(best)
            self.progress(0.45 + 0.1 * len(selected), f"added {best}, looking for more")
            recipe = replace(self.recipe, effects=(*self.recipe.effects, *selected))
            evidence = fit_session(
                self.session, recipe, with_effect(recipe, evidence, scores[best])
            )
            replayed = self._replicas(recipe, evidence.p, s.rival_replicates, (), (3,))
            rest = [n for n in self.names if n not in selected]
            scores = self._scores(recipe, evidence.p, rest)
        self.progress(0.85, "replaying the final model for its noise floor")
        final = self._replicas(recipe, evidence.p, s.final_replicates, (), (1,), share=True)
        return self._conclude(chance, first, selected, evidence, final)

    def _chance(
        self, recipe: Recipe, evidence: Evidence, asked: Sequence[str], seed: tuple[int, ...]
    ) -> _Chance:
        count = self.settings.replicates
        return _Chance(
            lambda names: self._replicas(recipe, evidence.p, count, names, seed),
            asked,
            len(self.names),
            float(Scorer(evidence).independent.mean()),
        )

    def _replicas(
        self,
        recipe: Recipe,
        p: Array,
        count: int,
        names: Sequence[str],
        seed: tuple[int, ...],
        share: bool = False,
        analysed: tuple[Recipe, Array] | None = None,
    ) -> list[Replicate]:
        into, start = analysed or (recipe, p)
        tasks = [
            ReplicateTask(
                recipe, p, into, start, (self.settings.seed, *seed, k), tuple(names), share
            )
            for k in range(count)
        ]
        return list(self.pool(run_replicate, tasks))

    def _scores(self, recipe: Recipe, p: Array, names: Sequence[str]) -> dict[str, Score]:
        parts = 2 * self.settings.jobs
        tasks = [ScoreTask(recipe, p, tuple(names[k::parts])) for k in range(parts)]
        merged: dict[str, Score] = {}
        for found in self.pool(run_scores, tasks):
            merged |= found
        return merged

    def _gaining(self, scores: Mapping[str, Score], scorer: Scorer) -> list[str]:
        """Candidates whose gain could be worth having; chance lowers it at most by half of that."""
        least = 0.5 * self.settings.worth
        return [n for n, s in scores.items() if np.any(s.gain / scorer.independent > least)]

    def _able(
        self,
        scores: Mapping[str, Score],
        chance: _Chance,
        evidence: Evidence,
        replayed: Sequence[Replicate],
    ) -> list[tuple[float, str]]:
        """Candidates that beat chance and are worth having, best first."""
        scorer, s = Scorer(evidence), self.settings
        chance.ask(self._gaining(scores, scorer))
        errors = np.array([r.error for r in replayed])
        ceiling = s.at_floor * errors.mean(axis=0) + 2.0 * errors.std(axis=0, ddof=1)
        worth = np.where(scorer.before.error > ceiling, s.worth, s.worth_at_floor)
        able = []
        for name, score in scores.items():
            excess = chance.excess(score)
            if (
                np.any(excess / scorer.independent > worth)
                and chance.p_value(score) < s.significance
            ):
                able.append((float(excess.sum()), name))
        return sorted(able, reverse=True)

    def _choose(
        self,
        able: Sequence[tuple[float, str]],
        chance: _Chance,
        recipe: Recipe,
        evidence: Evidence,
        scores: Mapping[str, Score],
    ) -> str:
        """The best of ``able``; close ones are told apart by replaying each of them."""
        top, best = able[0]
        axis = int(np.argmax(chance.excess(scores[best])))
        rivals = [
            name
            for excess, name in able[:6]
            if excess > 0.6 * top and int(np.argmax(chance.excess(scores[name]))) == axis
        ][:4]
        if len(rivals) == 1:
            self.groups[best] = ()
            return best
        misfit = {}
        for k, name in enumerate(rivals):
            self.progress(0.5, f"replaying {name} to tell it from {len(rivals) - 1} rival(s)")
            wider = replace(recipe, effects=(*recipe.effects, name))
            fitted = fit_session(self.session, wider, with_effect(wider, evidence, scores[name]))
            replicas = self._replicas(
                wider,
                fitted.p,
                self.settings.rival_replicates,
                rivals,
                (2, k),
                analysed=(recipe, evidence.p),
            )
            misfit[name] = _misfit(rivals, scores, replicas, axis)
        ordered = sorted(rivals, key=lambda n: misfit[n])
        winner = ordered[0]
        limit = max(2.0, misfit[winner] + 1.0)
        alike = tuple(n for n in ordered[1:] if misfit[n] < limit)
        if best in alike:
            alike = (winner, *[n for n in alike if n != best])
            winner = best
        self.groups[winner] = alike[:2]
        return winner

    def _conclude(
        self,
        chance: _Chance,
        first: Mapping[str, Score],
        selected: list[str],
        evidence: Evidence,
        final: list[Replicate],
    ) -> Diagnosis:
        s = self.settings
        before = Scorer(self.initial).before.error
        after = Scorer(evidence).before.error
        floors = np.array([r.error for r in final])
        bare_floor = np.array([r.error for r in chance.replicates]).mean(axis=0)
        shares = np.array([r.share for r in final])
        main = {n: int(np.argmax(chance.excess(first[n]))) if n in first else 0 for n in selected}
        reach = {n: self._reach(chance, first, n) for n in selected}
        findings = []
        unknown = set()
        for axis in range(len(before)):
            floor, scatter = floors[:, axis].mean(), floors[:, axis].std(ddof=1)
            luck = float(shares[:, axis].max())
            given = _beyond(explainable_share(self.initial, axis), luck)
            share = _beyond(explainable_share(evidence, axis), luck) if selected else given
            here = tuple(n for n in selected if main[n] == axis or axis in reach[n])
            excess = before[axis] ** 2 - min(floor, bare_floor[axis]) ** 2
            left = max(after[axis] ** 2 - floor**2, 0.0)
            above = after[axis] / (floor + 3.0 * scatter / s.above_floor)
            lacking = bool(above > s.surely or (above > s.above_floor and share > 0.05))
            verdict = "missing" if here else "nothing_missing"
            explained = max(0.0, 1.0 - left / max(excess, 1e-30)) if here else 0.0
            if lacking and explained < (s.explained_far if above > s.far else s.explained):
                verdict = "unknown_effect"
                unknown |= {n for n in here if main[n] == axis}
            findings.append(
                AxisFinding(
                    verdict,
                    float(before[axis]),
                    float(after[axis]),
                    float(floor),
                    float(scatter),
                    given,
                    share,
                    luck,
                    here if verdict == "missing" else (),
                    lacking and verdict == "missing",
                    here if verdict == "unknown_effect" else (),
                    explained,
                )
            )
        kept = [n for n in selected if n not in unknown]
        ranking = self._ranking(chance, first, kept, before)
        groups = {n: self.groups.get(n, ()) for n in kept}
        return Diagnosis(
            tuple(findings), tuple(ranking), tuple(kept), groups, evidence, self.initial
        )

    def _reach(self, chance: _Chance, first: Mapping[str, Score], name: str) -> set[int]:
        """Axes on which an effect acts and whose error it lowers."""
        item = candidates_of(self.recipe, (name,))[0].system
        acts = range(len(item.coordinates)) if item.moves_sensors else item.touched
        if name not in first:
            return set()
        drop = chance.excess(first[name]) / Scorer(self.initial).independent
        return {axis for axis in acts if drop[axis] > self.settings.worth}

    def _ranking(
        self,
        chance: _Chance,
        first: Mapping[str, Score],
        selected: Sequence[str],
        before: Array,
    ) -> list[Ranked]:
        """Selected effects with their groups, then the others by their score beyond chance."""
        order: list[str] = []
        for name in selected:
            order += [n for n in (name, *self.groups.get(name, ())) if n not in order]
        others = sorted(
            (n for n in first if n not in order),
            key=lambda n: -float(chance.excess(first[n]).sum()),
        )
        rows = []
        for name in [*order, *others]:
            if name not in first:
                continue
            score = first[name]
            excess = chance.excess(score)
            axis = int(np.argmax(excess))
            group = next(
                ({g, *r} - {name} for g, r in self.groups.items() if name in (g, *r)), set()
            )
            own = [q.name for q in _own_parameters(self.recipe, name)]
            rows.append(
                Ranked(
                    name,
                    axis,
                    float(before[axis]),
                    float(score.error[axis]),
                    chance.p_value(score),
                    float(excess.sum()),
                    dict(zip(own, [float(v) for v in score.values], strict=True)),
                    tuple(sorted(group)),
                )
            )
        return rows


def _beyond(share: float, luck: float) -> float:
    """Explained share beyond the one that replays give, of what they leave."""
    return float(max(0.0, (share - luck) / max(1.0 - luck, 1e-9)))


def _own_parameters(recipe: Recipe, name: str) -> tuple[Parameter, ...]:
    return replace(recipe, effects=(name,)).model().effects[0].parameters


def _misfit(
    rivals: Sequence[str],
    scores: Mapping[str, Score],
    replicas: Sequence[Replicate],
    axis: int,
) -> float:
    """How unlike the measured pattern of scores is to the replayed one: mean squared z.

    A tenth of the score is allowed for, because no replay is perfect.
    """
    total = 0.0
    for name in rivals:
        seen = scores[name].gain[axis]
        replayed = np.array(
            [r.scores[name].gain[axis] if name in r.scores else 0.0 for r in replicas]
        )
        spread = np.sqrt(replayed.var(ddof=1) + (0.1 * replayed.mean()) ** 2 + 4.0)
        total += ((seen - replayed.mean()) / spread) ** 2
    return float(total / len(rivals))
