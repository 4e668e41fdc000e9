"""The search for set-up mistakes: one after the other, each by what setting it right changes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.heavier_body import HeavierBody
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.setup.finding import (
    ALIKE,
    LEAST_GAIN,
    LEAST_GAIN_PLACEHOLDER,
    MOST_MISTAKES,
    RANKED_ERROR,
    SUSPICIOUS_ERROR,
    Finding,
    conclude,
    gain_of,
    least_gain,
    score_of,
    spoils_sound_axes,
)
from bampipe.setup.hypotheses import (
    JOINT_SPANS,
    MOST_TRAVEL,
    Correction,
    clock_corrections,
    combine,
    exchange_corrections,
    groups_of_like,
    quarter_turns,
    scaled,
    shifted,
    sign_corrections,
    unit_corrections,
)
from bampipe.setup.plausibility import Plausibility, axes_without_pose, judge_setup
from bampipe.setup.robot_search import DrawnSearch, is_drawn
from bampipe.trials.folds import Folds
from bampipe.trials.motion import Motion
from bampipe.trials.signals import Signals

Array = NDArray[np.float64]

SUSPICIOUS_PRIORS = 5.0
"""Sum of objections from which other set-ups are tried: two parameters beyond
two deviations."""
LEAST_FACTOR, LEAST_TURN, LEAST_SHIFT = 1.5, 0.25, 0.3
"""A factor, an angle (rad) and a share of an axis' travel below which what is off is no mistake of
set-up but an effect to be diagnosed."""
MOST_AXES = 3
"""With more, only signs, the clock and units of all axes or inputs at once are tried: what may be
exchanged, shifted or scaled grows faster than what a fit of a robot's bodies leaves time for."""
HIGHEST_HZ = 10.0
"""Set-ups are compared below this: gross as they are, they show there, and an input that is taken
for a position has derivatives up to no more than some 25 Hz."""
_SAMPLES, _SCREENED_SAMPLES, _DRAWN_SAMPLES = 12_000, 3_000, 4_000
_SCREENING_STEPS = 3
_SHORTLIST = 6
_DECADES = np.arange(-10, 11) / 2.0
_STEPS = 16
_MOST_TRIALS = 6
_SAME_FACTOR = 0.05
"""Logarithm within which the factor that explains most is a usual one."""
_HALVINGS = 11


Family = Callable[[float], Correction]


@dataclass
class CorrectionSearch:
    """Tries set-ups on a part of the trials; all on a small part, the best of them on more.

    Attributes:
        system: the bare device; motions: the trials as they are stated, short enough.
        band: of the residual; folds: of the trials; signals: of the session.
        tested: number of set-ups tried.
        heavier: the drawn body that alone is far heavier; None where none is.
        over_position: what the stated set-up explains with a torque over position that the device
            lacks, where that rather than a mistake is what spoils it; None else.
    """

    system: System
    motions: Sequence[Motion]
    band: Band
    folds: Folds
    signals: Signals
    tested: int = field(default=0, init=False)
    over_position: Plausibility | None = field(default=None, init=False)
    heavier: HeavierBody | None = field(default=None, init=False)
    _judged: dict[tuple[int, ...], tuple[Plausibility | None, tuple[Correction, ...]]] = field(
        default_factory=dict, init=False
    )

    @property
    def has_few_axes(self) -> bool:
        """Whether every kind of mistake can be tried in a few seconds."""
        return len(self.signals.axes) <= MOST_AXES

    @cached_property
    def screened(self) -> tuple[Sequence[Motion], Folds]:
        """The part of the trials that every set-up is tried on: two that are fitted, one braked."""
        folds = self.folds
        fitted = [k for k, fits in enumerate(folds.fitted) if fits]
        others = [k for k, fits in enumerate(folds.fitted) if not fits]
        chosen = [*dict.fromkeys([*fitted[:1], *fitted[-1:]]), *others[:1]]
        part = folds.subset(chosen)
        most = _SCREENED_SAMPLES if self.has_few_axes else _SCREENED_SAMPLES // 2
        return shorten([self.motions[k] for k in chosen], most), part

    def judge(self, corrections: tuple[Correction, ...]) -> Plausibility | None:
        """What a set-up explains of the trials; None where it cannot be computed with."""
        key = tuple(id(one) for one in corrections)
        if key not in self._judged:
            found = self._judge(corrections, self.motions, self.folds, 12)
            self._judged[key] = found, corrections
        return self._judged[key][0]

    def _judge(
        self,
        corrections: tuple[Correction, ...],
        motions: Sequence[Motion],
        folds: Folds,
        steps: int,
        posed: Sequence[int] = (),
    ) -> Plausibility | None:
        change = combine(self.signals, corrections)
        with np.errstate(all="ignore"):
            changed = [change.of_motion(motion, self.signals) for motion in motions]
        return judge_setup(self.system, changed, change.of_band(self.band), folds, steps, posed)

    def screen(self, chosen: tuple[Correction, ...], correction: Correction) -> float:
        """Score and cost of one correction more; infinite where it makes no sense."""
        if not _is_gross(correction, self.motions, self.signals):
            return math.inf
        self.tested += 1
        found = self._judge((*chosen, correction), *self.screened, _SCREENING_STEPS)
        return math.inf if found is None else found.score(RANKED_ERROR) + correction.cost

    def find_mistakes(self, placeholders: Sequence[str]) -> tuple[Finding, ...]:
        """The mistakes of the set-up, the one that gains most first.

        Args:
            placeholders: signals whose scale stands at exactly 1.
        """
        if is_drawn(self.system):
            # Bodies that are free take on much of a mistake.
            drawn = DrawnSearch(
                self.system, shorten(self.motions, _DRAWN_SAMPLES), self.band, self.signals
            )
            mistakes = drawn.find_mistakes()
            self.tested += drawn.tested
            self.heavier = drawn.heavier
            return mistakes
        chosen: tuple[Correction, ...] = ()
        tried: list[Correction] = []
        while len(chosen) < MOST_MISTAKES and self._is_suspicious(self.judge(chosen), placeholders):
            options = self._shortlist(chosen, self._discrete())
            best = self._best(chosen, options, placeholders)
            after = self.judge((*chosen, best) if best else chosen)
            if self.has_few_axes and self._is_suspicious(after, ()):
                options += self._shortlist(chosen, self._continuous(chosen))
                best = self._best(chosen, options, placeholders)
            if (not chosen and self._lacks_pose(best)) or best is None:
                break
            tried += options
            chosen = (*chosen, self._refined_factor(chosen, best))
        return conclude(self.judge, chosen, tried, placeholders)

    def _best(
        self,
        chosen: tuple[Correction, ...],
        options: Sequence[Correction],
        placeholders: Sequence[str],
    ) -> Correction | None:
        """The correction that sets most right, of those that gain enough and spoil no axis."""
        before = self.judge(chosen)
        for one in sorted(options, key=lambda one: score_of(self.judge, (*chosen, one))):
            after = self.judge((*chosen, one))
            if after is None:
                continue
            stated = before or after.with_nothing_explained()
            gain = gain_of(stated, after, one.cost)
            if gain >= least_gain(one, placeholders) and not spoils_sound_axes(stated, after):
                return one
        return None

    def _refined_factor(self, chosen: tuple[Correction, ...], best: Correction) -> Correction:
        """``best`` with the factor that explains most, where that is none of a unit or a gain."""
        if best.kind != "scale" or not self.has_few_axes:
            return best
        family = partial(_scaled_by_power, self.signals, best.signals)
        start = math.log10(best.factor)
        found = self._refine(chosen, family, start, math.inf, float(_DECADES[1] - _DECADES[0]))
        far = abs(math.log(found.factor / best.factor)) > _SAME_FACTOR
        gain = score_of(self.judge, (*chosen, best)) - score_of(self.judge, (*chosen, found))
        return found if far and gain > ALIKE else best

    def _lacks_pose(self, best: Correction | None) -> bool:
        """Whether a torque over position explains as much of the stated set-up as ``best`` does.

        That of gravity on a link or of a spring, where the device has none: no column is mistaken.
        """
        axes = axes_without_pose(self.system, self.motions) if self.has_few_axes else []
        stated = self.judge(())
        found = self._judge((), self.motions, self.folds, 12, axes) if axes else None
        if found is None or stated is None:
            return False
        after = self.judge((best,)) if best is not None else None
        gain = gain_of(stated, after, best.cost) if best is not None and after is not None else 0.0
        if gain_of(stated, found, 0.0) < (gain - ALIKE if gain else LEAST_GAIN):
            return False
        self.over_position = found
        return True

    def _is_suspicious(self, now: Plausibility | None, placeholders: Sequence[str]) -> bool:
        if now is None or now.error.max() > SUSPICIOUS_ERROR:
            return True
        most = LEAST_GAIN_PLACEHOLDER if placeholders else SUSPICIOUS_PRIORS
        return bool(now.objections.sum() > most)

    def _discrete(self) -> Iterator[Correction]:
        yield from sign_corrections(self.signals)
        yield from clock_corrections(self.signals)
        for correction in unit_corrections(self.signals):
            if self.has_few_axes or len(correction.signals) > 1:
                yield correction
        if self.has_few_axes:
            yield from exchange_corrections(self.signals)
            yield from quarter_turns(self.signals)

    def _continuous(self, chosen: tuple[Correction, ...]) -> list[Correction]:
        """Scales and zeros of any size: the best families on a grid, then refined."""
        change = combine(self.signals, chosen)
        families: list[tuple[Family, Array]] = [
            (partial(_scaled_by_power, self.signals, names), _DECADES)
            for names in groups_of_like(self.signals)
        ]
        changed = [change.of_motion(motion, self.signals) for motion in self.screened[0]]
        for place, axis in enumerate(self.signals.axes):
            q = np.concatenate([motion.q[:, place] for motion in changed])
            if self.signals.units[place] == "rad" and np.ptp(q) > MOST_TRAVEL:
                gear = partial(_scaled_by_power, self.signals, (axis,))
                families.append((gear, np.log10(JOINT_SPANS / np.ptp(q))))
            reach = 2.0 * max(float(np.ptp(q)), float(np.abs(np.median(q))))
            size = math.pi if self.signals.units[place] == "rad" else reach
            grid = size * np.linspace(-1.0, 1.0, _STEPS)
            families.append((partial(_shifted_by, self.signals, axis), grid))
        coarse = []
        for family, grid in families:
            scores = [self.screen(chosen, family(x)) for x in grid]
            best = int(np.argmin(scores))
            coarse.append((scores[best], family, float(grid[best]), float(grid[1] - grid[0])))
        coarse.sort(key=lambda one: one[0])
        return [
            self._refine(chosen, family, best, least, step)
            for least, family, best, step in coarse[: _SHORTLIST // 2]
        ]

    def _refine(
        self,
        chosen: tuple[Correction, ...],
        family: Family,
        best: float,
        least: float,
        step: float,
    ) -> Correction:
        """The best correction of a family near ``best``, where it scores ``least``."""
        for _ in range(_HALVINGS):
            step *= 0.5
            for x in (best - step, best + step):
                score = self.screen(chosen, family(x))
                if score < least:
                    best, least = x, score
        return family(best)

    def _shortlist(
        self, chosen: tuple[Correction, ...], corrections: Iterable[Correction]
    ) -> list[Correction]:
        """The corrections that do best on the small part of the trials."""
        screened = [(self.screen(chosen, correction), correction) for correction in corrections]
        screened.sort(key=lambda one: one[0])
        return [one for score, one in screened[:_SHORTLIST] if math.isfinite(score)]


def shorten(motions: Sequence[Motion], most: int = _SAMPLES) -> list[Motion]:
    """The middle of each trial, so that all have ``most`` samples together at most."""
    return [_middle(motion, most // max(len(motions), 1)) for motion in motions]


def spread(count: int) -> list[int]:
    """Numbers of some trials of ``count``, spread over the session."""
    chosen = np.linspace(0, max(count - 1, 0), min(count, _MOST_TRIALS))
    return [int(number) for number in np.unique(chosen.round())]


def _middle(motion: Motion, most: int) -> Motion:
    first = max((motion.t.size - most) // 2, 0)
    return motion.rows(slice(first, first + most))


def _scaled_by_power(signals: Signals, names: tuple[str, ...], power: float) -> Correction:
    return scaled(signals, names, 10.0**power, 3.0)


def _shifted_by(signals: Signals, axis: str, offset: float) -> Correction:
    return shifted(signals, axis, offset, 3.0)


def _is_gross(correction: Correction, motions: Sequence[Motion], signals: Signals) -> bool:
    """Whether a scale or zero is off by more than what an effect would explain."""
    if correction.kind == "scale":
        return abs(math.log(correction.factor)) > math.log(LEAST_FACTOR)
    if correction.kind != "zero":
        return True
    place = signals.places(correction.signals)[0]
    if signals.units[place] == "rad":
        return abs(correction.offset) > LEAST_TURN
    travel = max(float(np.ptp(motion.q[:, place])) for motion in motions)
    return abs(correction.offset) > LEAST_SHIFT * travel
