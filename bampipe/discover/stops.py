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
from bampipe.discover.polish import FittedSet
from bampipe.discover.scorer import Score
from bampipe.estimate.simulation import Runaway
from bampipe.results.diagnose import RefusedEffect
from bampipe.trials.noise_floor import PROBE_WIDTH, STILL_WIDTH, NoiseFloor

Array = NDArray[np.float64]


WIDTHS = (STILL_WIDTH, PROBE_WIDTH)
"""Sign widths, times the device's. How abruptly a machine stops no log says, and neither width
leaves what the other does: to a Stribeck friction that is not there, of a carriage at 1 kHz, an
eighth gives twice what the measured trials do and a 32nd half of it; to such a backlash of a wrist
in MuJoCo a 32nd gives all of it, and an eighth nothing."""
_CLEAR = 0.95
"""Share of what an effect takes off, beyond what it takes off replays of the first width, above
which those of the second are not made: of these it was never seen to take off seven times that."""


class StoppingReplays:
    """Replays of one fitted model with narrow sign widths, made once they are asked for."""

    def __init__(self, bench: Bench, current: FittedSet) -> None:
        """Take a session and the model of it that is searched for more."""
        self._bench, self._current = bench, current
        self._made: dict[float, Level] = {}
        self._matters: bool | None = None

    def _matter(self, level: Level) -> bool:
        """Whether they say anything new beside the ``level`` of replays that creep."""
        if self._matters is None:
            now = self._current
            floor = NoiseFloor.of_errors([replay.held_out_rmse for replay in level.replicates])
            self._matters = self._bench.standing_still_matters(now.recipe, now.evidence, floor)
        return self._matters

    def _level(self, width: float, names: Sequence[str]) -> Level:
        """The chance level on these replays; ``names``: candidates that are learned at once."""
        if width in self._made:
            self._made[width].learn(names)
        else:
            now = self._current
            narrow = now.recipe.with_sign_widths(width)
            self._made[width] = self._bench.level(
                now.recipe, now.evidence, now.replayed, names, replayed=narrow
            )
        return self._made[width]

    def _imitation(
        self, scores: Mapping[str, Score], level: Level, names: Sequence[str]
    ) -> tuple[float, Array] | None:
        """p-value and excess of a candidate on replays that imitate it; None if there are none.

        Args:
            scores, level: as of `first_beyond`.
            names: the candidate, and those whose turn may come.
        """
        name = names[0]
        s, whole = self._bench.settings, self._removed(level.excess(scores[name]))
        for width in WIDTHS:
            still = self._level(width, names)
            still.ask(scores, [name])
            p_value, excess = still.p_value(scores[name]), still.excess(scores[name])
            beyond = self._removed(excess) / whole
            if p_value >= s.significance or beyond <= s.still_share:
                return p_value, excess
            if beyond > _CLEAR:
                break
        return None

    def _removed(self, excess: Array) -> float:
        """Share of the mean square that a gain beyond chance is, by sample and axis, summed."""
        count = self._current.scorer.independent_samples
        return float(np.sum(count * (1.0 - np.exp(-2.0 * excess / count))))

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
            of them where standing still does not matter, or the replays run away.
        """
        s, kept = self._bench.settings, list(significant)
        doubted: dict[str, tuple[float, Array]] = {}
        try:
            if not kept or not self._matter(level):
                return kept, doubted
            while kept:
                name = kept[0][1]
                # Alone, the first is a third of the work, and mostly passes. Where one does not,
                # many do not, and share their replays.
                others = [other for _, other in kept[1:]] if doubted else []
                imitated = self._imitation(scores, level, [name, *others])
                if imitated is None:
                    break
                p_value, excess = imitated
                gain = excess / self._current.scorer.independent_samples
                doubted[name] = (max(p_value, s.significance), np.asarray(gain))
                kept.pop(0)
        except Runaway:
            return list(significant), {}
        return kept, doubted

    def refusal(self, score: Score) -> RefusedEffect:
        """A candidate that helps on the measured trials as it does on these replays."""
        evidence, axis = self._current.evidence, int(np.argmax(score.gain))
        return RefusedEffect(
            effect=score.name,
            axis=evidence.system.coordinates[axis],
            held_out_rmse_before=evidence.held_out_rmse[axis],
            held_out_rmse_after=self._current.scorer.comparable_error(score)[axis],
            why="stops",
        )
