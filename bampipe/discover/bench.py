"""A session, replays of models fitted to it, and candidates scored on both."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.chance import (
    Pool,
    Replicate,
    ReplicateTask,
    ScoreTask,
    ShareTask,
    fit_trials,
    open_trials,
    run_replicate,
    run_scores,
    run_share,
    system_of,
)
from bampipe.discover.level import Level
from bampipe.discover.scorer import Score, Scorer
from bampipe.discover.settings import Settings
from bampipe.estimate.least_squares import fit
from bampipe.estimate.simulation import Runaway
from bampipe.physics.recipe import Recipe
from bampipe.trials.bias import remove_bias
from bampipe.trials.evidence import Evidence
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.noise_floor import (
    FLOOR_SEED,
    PROBE_WIDTH,
    STILL_WIDTH,
    NoiseFloor,
    floor_replays,
    standing_still_matters,
)
from bampipe.trials.residuals import problem_of
from bampipe.trials.timing import find_robot_timing

Array = NDArray[np.float64]

_STEPS_OF_TIMING = 4
"""Most Gauss-Newton steps of a fit that starts at the right parameters."""
_PARTS = 6
"""Tasks a process into which candidates are divided: one may take as long as a hundred others."""


@dataclass(frozen=True)
class Bench:
    """What every step of a diagnosis works with.

    Attributes:
        trials: the measured trials.
        settings: how carefully to look.
        pool: a `map` over worker processes.
        names: every candidate.
    """

    trials: MeasuredTrials
    settings: Settings
    pool: Pool
    names: tuple[str, ...]

    def retimed(self, evidence: Evidence) -> Bench:
        """The same with inputs moved by the timing that a model with more effects gives them.

        A lean model takes a part of what it lacks for inputs sampled late; kept, that part would
        look like a delay as soon as the rest is found. A drive that holds its command acts half a
        sample late, which a fit finds on either side of that limit.
        """
        trials, system = self.trials, evidence.system
        if trials.limit_s == 0.0 or system.takes_timing:
            return self
        chosen = evidence.folds.fitted_trials
        if system.model.device.robot is not None:
            motions = [trials.motions[k] for k in chosen]
            step, sd = find_robot_timing(system, motions, trials.band, evidence.p)
        else:
            step, sd = self._timing_of_fit(evidence)
        late_s, s = trials.late_s + step, self.settings
        if abs(step) < s.timing_sd * sd or abs(late_s) - s.limit_sd * sd > trials.limit_s:
            return self
        late_s = float(np.clip(late_s, -trials.limit_s, trials.limit_s))
        return replace(self, trials=open_trials(late_s))

    def _timing_of_fit(self, evidence: Evidence) -> tuple[float, float]:
        """The change of the inputs' timing that a fit to all samples finds, and its sd, s."""
        trials, system = self.trials, evidence.system
        problem = problem_of(system, trials.motions, trials.band, timing=True)
        wide = replace(problem, lower=_wider(problem.lower), upper=_wider(problem.upper))
        found = fit(
            wide,
            np.append(evidence.p, 0.0),
            trials=evidence.folds.fitted_trials,
            most_iterations=_STEPS_OF_TIMING,
        )
        step, sd = float(found.p[-1]), float(np.sqrt(found.covariance[-1, -1]))
        if abs(trials.late_s + step) > trials.limit_s:
            # What filters make of a change of direction looks late, too.
            straight = remove_bias(
                trials.sensors, trials.kinematics, system, trials.motions, wide, found
            )
            step = float(straight.p[-1])
        return step, sd

    def fit(self, recipe: Recipe, start: Array, like: Evidence | None = None) -> Evidence:
        """Least squares of a model on the measured trials; see `fit_trials`."""
        return fit_trials(self.trials, recipe, start, like)

    def replicas(
        self,
        recipe: Recipe,
        p: Array,
        count: int,
        names: Sequence[str],
        seed: tuple[int, ...],
        share: bool = False,
        analysed: tuple[Recipe, Array] | None = None,
        first: int = 0,
    ) -> list[Replicate]:
        """Replays of a model at ``p``; ``seed`` tells this set from all others.

        They are numbered from ``first`` on. Each is fitted by ``analysed``, a model and where its
        fit starts, or else by itself, and ``names`` are scored against that fit.
        """
        into, start = analysed or (recipe, p)
        tasks = [
            ReplicateTask(
                recipe,
                p,
                into,
                start,
                (self.settings.seed, *seed, k),
                tuple(names),
                self.trials.late_s,
                share,
            )
            for k in range(first, first + count)
        ]
        return list(self.pool(run_replicate, tasks))

    def floor_replicas(
        self, recipe: Recipe, evidence: Evidence, p: Array, known: Sequence[Replicate]
    ) -> list[Replicate]:
        """Replays that give the noise floor of a fitted model, those that `validate` makes of it.

        Args:
            recipe: the model; evidence: its fit; p: parameters that are replayed, (n_p,).
            known: replays of the same by `level`, taken where they have what is wanted.
        """
        count, again = floor_replays(self.trials.motions), (recipe, evidence.p)
        if len(known) >= count and all(replay.share.size for replay in known[:count]):
            return list(known[:count])
        return self.replicas(recipe, p, count, (), (FLOOR_SEED,), share=True, analysed=again)

    def still_replicas(
        self, recipe: Recipe, evidence: Evidence, p: Array, creeping: Sequence[Replicate]
    ) -> list[Replicate]:
        """Replays of a model that stands still where it turns round, as many as of one that creeps.

        None where these leave as much as was measured, where standing still does not matter, or
        where the narrow ones run away.
        """
        floor = NoiseFloor.of_errors([replay.held_out_rmse for replay in creeping])
        if not floor.is_exceeded(evidence.held_out_rmse):
            return []
        narrow, again = recipe.with_sign_widths(STILL_WIDTH), (recipe, evidence.p)
        with suppress(Runaway):
            if self.standing_still_matters(recipe, evidence, floor):
                return self.replicas(
                    narrow, p, len(creeping), (), (FLOOR_SEED,), share=True, analysed=again
                )
        return []

    def standing_still_matters(self, recipe: Recipe, evidence: Evidence, floor: NoiseFloor) -> bool:
        """Whether replays of a fitted model that stand still would say anything new.

        Raises:
            Runaway: the simulated motion grows without bounds.
        """
        narrow = recipe.with_sign_widths(PROBE_WIDTH)
        return standing_still_matters(
            evidence, lambda: system_of(narrow), self.trials.sensors, self.trials.kinematics, floor
        )

    def scores(
        self,
        recipe: Recipe,
        p: Array,
        names: Sequence[str],
        progress: Callable[[float], None] = lambda share: None,
    ) -> dict[str, Score]:
        """Scores of candidates against a model on the measured trials.

        Each is derived and compiled by the worker that scores it, where it is not in the cache.

        Args:
            recipe: the model; p: its parameters as fitted, (n_p,); names: of the candidates.
            progress: called with the share done.
        """
        parts = min(_PARTS * self.settings.jobs, len(names))
        late_s = self.trials.late_s
        tasks = [ScoreTask(recipe, p, tuple(names[k::parts]), late_s) for k in range(parts)]
        merged: dict[str, Score] = {}
        for done, found in enumerate(self.pool(run_scores, tasks), start=1):
            merged |= found
            progress(done / parts)
        # In the order of the names, whatever the number of jobs: ties in the ranking keep it.
        return {name: merged[name] for name in names if name in merged}

    def shares(self, recipe: Recipe, p: Array) -> Array:
        """Explainable share of a fitted model on the measured trials, by axis, (n_q,)."""
        axes = range(len(recipe.model().device.coordinates))
        tasks = [ShareTask(recipe, p, axis, self.trials.late_s) for axis in axes]
        return np.array(list(self.pool(run_share, tasks)))

    def level(
        self,
        recipe: Recipe,
        evidence: Evidence,
        p: Array,
        asked: Sequence[str],
        replayed: Recipe | None = None,
    ) -> Level:
        """Chance level of candidates against a fitted model, on the replays of its noise floor.

        Args:
            recipe: the model; evidence: its fit; p: parameters that are replayed, (n_p,).
            asked: candidates that are learned at once.
            replayed: another model with the same parameters, which is replayed in its place.
        """
        again = (recipe, evidence.p)
        # Where nothing gains, the search is at its end: these are the replays of the final model.
        last = not asked

        def replay(names: Sequence[str], first: int, count: int) -> list[Replicate]:
            return self.replicas(
                replayed or recipe,
                p,
                count,
                names,
                (FLOOR_SEED,),
                share=last and not names,
                analysed=again,
                first=first,
            )

        scorer, s = Scorer(evidence), self.settings
        least = min(s.first_replicates, s.replicates)
        return Level(
            replay,
            asked,
            floor_replays(self.trials.motions) if last else least,
            len(self.names),
            scorer.base_error,
            np.maximum(scorer.independent_samples, 1.0),
            s,
        )

    def gaining(self, scores: Mapping[str, Score], scorer: Scorer) -> list[str]:
        """Candidates whose gain could be worth having: what chance gives only lowers it."""
        least = self.settings.worth
        return [n for n, s in scores.items() if np.any(s.gain / scorer.independent_samples > least)]


def _wider(bound: Array) -> Array:
    """Bounds of the parameters, the last one, of the timing, twice as far."""
    return np.append(bound[:-1], 2.0 * bound[-1])
