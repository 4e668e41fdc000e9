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
        independent: float,
        replay_error: float,
    ) -> None:
        self._replay, self._tests = replay, tests
        # No replay is perfect: its log error is off by this, as a log likelihood.
        self._error = replay_error * independent
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
        """Gain beyond the mean on replays, by axis; the gain itself where that is not known."""
        gains = self._gains.get(score.name)
        return np.asarray(score.gain if gains is None else score.gain - gains.mean(axis=0))
