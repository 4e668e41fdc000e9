"""Replays that truly stand still where the machine turns round: what they explain is not missing.

A machine whose friction stops it goes through a reversal otherwise than a replay that creeps within
its sign width: play and compliance explain the difference, which is none of the machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.bench import Bench
from bampipe.discover.level import Level
from bampipe.discover.polish import FittedSet, extend_set
from bampipe.discover.scorer import Score
from bampipe.estimate.simulation import Runaway
from bampipe.results.diagnose import RefusedEffect
from bampipe.trials.noise_floor import NoiseFloor

Array = NDArray[np.float64]


class StoppingReplays:
    """Replays of one fitted model with a narrow sign width, made once they are asked for."""

    def __init__(self, bench: Bench, current: FittedSet) -> None:
        """Take a session and the model of it that is searched for more."""
        self._bench, self._current = bench, current
        self._made: Level | None = None
        self._matters: bool | None = None
        self._imitated: dict[str, Score] = {}
        self._beside: tuple[str, FittedSet] | None = None

    def _matter(self, level: Level) -> bool:
        """Whether they say anything new beside the ``level`` of replays that creep."""
        if self._matters is None:
            now = self._current
            floor = NoiseFloor.of_errors([replay.held_out_rmse for replay in level.replicates])
            self._matters = self._bench.standing_still_matters(now.recipe, now.evidence, floor)
        return self._matters

    def _level(self, name: str) -> Level:
        """The chance level on these replays; ``name``: a candidate that is learned at once."""
        if self._made is None:
            now, factor = self._current, self._bench.settings.still_width
            narrow = now.recipe.with_sign_widths(factor)
            self._made = self._bench.level(
                now.recipe, now.evidence, now.replayed, [name], replayed=narrow
            )
        return self._made

    def _says_more(self, score: Score) -> bool:
        """Whether a candidate keeps its gain beside the best one that these replays imitate.

        Friction that stops a machine rougher than any replay leaves something for other effects of
        a like shape.
        """
        if not self._imitated:
            return True
        best = max(self._imitated.values(), key=lambda one: one.total)
        if self._beside is None or self._beside[0] != best.name:
            self._beside = best.name, extend_set(self._current, best)
        beside = self._beside[1]
        found = self._bench.scores(beside.recipe, beside.evidence.p, [score.name])
        least = self._bench.settings.still_share * score.total
        return score.name in found and found[score.name].total > least

    def first_beyond(
        self,
        scores: Mapping[str, Score],
        level: Level,
        significant: Sequence[tuple[float, str]],
    ) -> tuple[list[tuple[float, str]], dict[str, tuple[float, Array]]]:
        """The significant candidates from the first on that beats these replays, too.

        Args:
            scores: against the model; level: chance on its own replays.
            significant: candidates that beat it, with their excess, best first.

        Returns:
            Those, as they came; and of the ones before, p-value and gain in log error by axis. All
            of them where standing still does not matter, or the replays run away. One that says
            little beside another that these replays imitate does not pass either.
        """
        s, kept = self._bench.settings, list(significant)
        doubted: dict[str, tuple[float, Array]] = {}
        # The rest are weighed against the first that passes: alone, it is a third of the work.
        try:
            if not kept or not self._matter(level):
                return kept, doubted
            while kept:
                name = kept[0][1]
                still = self._level(name)
                still.ask(scores, [name])
                p_value, excess = still.p_value(scores[name]), still.excess(scores[name])
                share = float(excess.sum() / level.excess(scores[name]).sum())
                beyond = p_value < s.significance and share > s.still_share
                if beyond and self._says_more(scores[name]):
                    break
                if not beyond:
                    self._imitated[name] = scores[name]
                gain = excess / self._current.scorer.independent_samples
                doubted[name] = (max(p_value, s.significance), np.asarray(gain))
                kept.pop(0)
        except Runaway:
            return list(significant), {}
        return kept, doubted

    def refusal(self, score: Score) -> RefusedEffect:
        """A candidate that helps on the measured trials as it does on these replays.

        Or that is like one which does.
        """
        evidence, axis = self._current.evidence, int(np.argmax(score.gain))
        return RefusedEffect(
            effect=score.name,
            axis=evidence.system.coordinates[axis],
            held_out_rmse_before=evidence.held_out_rmse[axis],
            held_out_rmse_after=self._current.scorer.comparable_error(score)[axis],
            why="stops" if score.name in self._imitated else "like_stops",
        )
