"""The chance level: what candidates score on replays of a model that lacks nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from bampipe.discover.chance import Replicate
from bampipe.discover.scorer import Score
from bampipe.discover.settings import Settings

Array = NDArray[np.float64]

_HOPELESS_SD = 1.5
"""Standard deviations above chance, by the first four replays, below which a candidate is left at
that. Among a hundred, significance takes 4.2 with thirty replays and more with fewer; four replays
overstate a scatter by as much three times in a hundred thousand (chi-squared)."""


class Level:
    """Mean and scatter of candidates' scores on replays of one model, found as needed.

    A candidate that gains nothing on the measured trials needs no chance level; most gain nothing.
    A few replays tell chance from what stands far above it, or not above it at all; where the best
    candidates do neither, more are made, and more again of those whose decision is close.
    """

    def __init__(
        self,
        replay: Callable[[Sequence[str], int, int], list[Replicate]],
        asked: Sequence[str],
        first: int,
        tests: int,
        before: Array,
        independent: Array,
        settings: Settings,
    ) -> None:
        """Replay the model and learn the chance level of ``asked``.

        Args:
            replay: candidates to score, number of the first replay, count; returns the replays.
            asked: candidates to learn at once; first: replays for them.
            tests: number of candidates in the library.
            before: error of the model, by axis; independent: samples that count, by axis.
            settings: how many replays, and what is significant.
        """
        self._replay, self._tests, self._settings = replay, tests, settings
        self._before, self._independent, self._first = before, independent, first
        # No replay is perfect: its log error is off by this, as a log likelihood.
        self._error = settings.replay_error * float(independent.mean())
        self._gains: dict[str, Array] = {}
        self.replicates: list[Replicate] = []
        self._learn(asked, 0, first)

    def _learn(self, names: Sequence[str], first: int, count: int) -> None:
        replicates = self._replay(names, first, count)
        if first == len(self.replicates):
            self.replicates += replicates
        nothing = np.zeros(len(replicates[0].error))
        for name in names:
            gains = np.array(
                [r.scores[name].gain if name in r.scores else nothing for r in replicates]
            )
            known = self._gains.get(name)
            self._gains[name] = gains if known is None else np.concatenate([known, gains])

    def _complete(self, names: Sequence[str], count: int) -> None:
        """Replay until each of ``names`` has been scored on ``count`` replays."""
        for first in sorted({len(self._gains.get(name, ())) for name in names}):
            if first < count:
                short = [name for name in names if len(self._gains.get(name, ())) == first]
                self._learn(short, first, count - first)

    def learn(self, names: Sequence[str]) -> None:
        """Replay for those of ``names`` whose chance level is not known, all at once."""
        self._complete(names, self._first)

    def carry_over(self, known: Level, names: Sequence[str], moved: NDArray[np.bool_]) -> None:
        """Take over what another level knows of candidates.

        Args:
            known: of a model that leaves the same on the axes they act on.
            names: candidates; moved: axes on which it does not, (n_q,).
        """
        for name in names:
            if name in known._gains:
                self._gains[name] = np.where(moved, 0.0, known._gains[name])

    def ask(self, scores: Mapping[str, Score], names: Sequence[str]) -> None:
        """Replay for those of ``names`` whose chance level is not known, again where it is close.

        Close is a p-value within a factor of `Settings.close` of the significance on either side:
        on both, or the second look would be another chance of a false alarm.
        """
        s = self._settings
        self.learn(names)
        if not all(self._is_clear(scores[n]) for n in self._deciding(scores, names)):
            self._complete([n for n in names if self._stands_out(scores[n])], s.replicates)
        low, high = s.significance / s.close, s.significance * s.close
        close = [
            name
            for name in self._deciding(scores, names)
            if len(self._gains[name]) == s.replicates and low < self.p_value(scores[name]) < high
        ]
        self._complete(close, s.most_replicates)

    def _is_clear(self, score: Score) -> bool:
        """Whether a candidate beats chance beyond doubt."""
        return self.p_value(score) < self._settings.significance / self._settings.close

    def _deciding(self, scores: Mapping[str, Score], names: Sequence[str]) -> list[str]:
        """Those of ``names`` on which it hangs what is added: all, unless one is clear.

        Then those that come near the best of the clear ones. The others wait: once it is part of
        the model they are weighed anew.
        """
        excess = {name: float(self.excess(scores[name]).sum()) for name in names}
        clear = [excess[name] for name in names if self._is_clear(scores[name])]
        near = self._settings.rival_share * max(clear, default=-np.inf)
        return [name for name in names if excess[name] >= near]

    def _stands_out(self, score: Score) -> bool:
        """Whether more replays could make a candidate significant, and have not been made."""
        return not self._is_clear(score) and self._height(score) > _HOPELESS_SD

    def _height(self, score: Score) -> float:
        """How far a candidate, whose chance level is known, stands above it, in its scatter."""
        totals = self._gains[score.name].sum(axis=1)
        count, middle = len(totals), float(np.median(totals))
        totals = np.maximum(totals, 2.0 * middle - totals.max())
        spread = np.hypot(totals.std(ddof=1) * np.sqrt(1.0 + 1.0 / count), self._error)
        return float((score.total - totals.mean()) / spread)

    def p_value(self, score: Score) -> float:
        """Chance that any candidate scores this high with nothing missing (Bonferroni).

        One for a candidate that was not worth a chance level. What counts is how far chance reaches
        upwards: a replay on which the candidate fails, as its shape may without one of three
        trials, would only widen the scatter.
        """
        if score.name not in self._gains:
            return 1.0
        count = len(self._gains[score.name])
        return float(min(1.0, self._tests * student.sf(self._height(score), count - 1)))

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
        by_chance = replayed**2 * (1.0 - np.exp(-2.0 * np.median(gains, axis=0) / n))
        after = self._before**2 * np.exp(-2.0 * score.gain / n) + by_chance
        ratio = np.maximum(after, 1e-12 * self._before**2) / self._before**2
        return np.asarray(-0.5 * n * np.log(ratio))
