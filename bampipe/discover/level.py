"""The chance level: what candidates score on replays of a model that lacks nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from bampipe.discover.candidates import Score
from bampipe.discover.chance import Replicate

Array = NDArray[np.float64]


class Level:
    """Mean and scatter of candidates' scores on replays of one model, found as needed.

    A candidate that gains nothing on the measured trials needs no chance level; most gain nothing.
    """

    def __init__(
        self,
        replay: Callable[[Sequence[str]], list[Replicate]],
        asked: Sequence[str],
        tests: int,
        before: Array,
        independent: Array,
        replay_error: float,
    ) -> None:
        self._replay, self._tests = replay, tests
        self._before, self._independent = before, independent
        # No replay is perfect: its log error is off by this, as a log likelihood.
        self._error = replay_error * float(independent.mean())
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
        spread = np.hypot(totals.std(ddof=1) * np.sqrt(1.0 + 1.0 / count), self._error)
        z = (score.total - totals.mean()) / spread
        return float(min(1.0, self._tests * student.sf(z, count - 1)))

    def excess(self, score: Score) -> Array:
        """Gain beyond chance, by axis; the gain itself where chance is not known.

        What chance takes off the mean square of a replay, it takes off the measured one: little
        where much is missing, all of it where nothing is.
        """
        gains = self._gains.get(score.name)
        if gains is None:
            return score.gain
        n = self._independent
        replayed = np.mean([r.error for r in self.replicates], axis=0)
        by_chance = replayed**2 * (1.0 - np.exp(-2.0 * gains.mean(axis=0) / n))
        after = self._before**2 * np.exp(-2.0 * score.gain / n) + by_chance
        ratio = np.maximum(after, 1e-12 * self._before**2) / self._before**2
        return np.asarray(-0.5 * n * np.log(ratio))
