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
    JUDGED_ERROR,
    LEAST_GAIN,
    LEAST_GAIN_PLACEHOLDER,
    MOST_MISTAKES,
    RANKED_ERROR,
    SUSPICIOUS_ERROR,
    Finding,
    Tried,
    choose,
    is_explained,
)
from bampipe.setup.hypotheses import (
    Correction,
    clock_corrections,
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
from bampipe.trials.signals import Change, Signals

Array = NDArray[np.float64]

SUSPICIOUS_PRIORS = 5.0
"""Sum of objections, beyond the usual, from which other set-ups are tried: two parameters beyond
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
_HALVINGS = 11


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

    def judge(self, change: Change) -> Plausibility | None:
        """What a set-up explains of the trials; None where it cannot be computed with."""
        return self._judge(change, self.motions, self.folds, 12)

    def _judge(
        self, change: Change, motions: Sequence[Motion], folds: Folds, steps: int
    ) -> Plausibility | None:
        with np.errstate(all="ignore"):
            changed = [change.of_motion(motion, self.signals) for motion in motions]
        return judge_setup(self.system, changed, change.of_band(self.band), folds, steps)

    def screen(self, correction: Correction, change: Change) -> float:
        """Score and cost of a correction on top of ``change``; infinite where it makes no sense."""
        if not _is_gross(correction, self.motions, self.signals):
            return math.inf
        self.tested += 1
        found = self._judge(correction.change.after(change), *self.screened, _SCREENING_STEPS)
        return math.inf if found is None else found.score(RANKED_ERROR) + correction.cost

    def find_mistakes(
        self, stated: Plausibility | None, placeholders: Sequence[str]
    ) -> tuple[Finding, ...]:
        """The mistakes of the set-up, the one that spoils most first.

        Args:
            stated: what the set-up as it is stated explains of ``motions``.
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
        change, now = Change.none(len(self.signals.names)), stated
        found: list[Finding] = []
        while len(found) < MOST_MISTAKES and self._is_suspicious(now, placeholders):
            step = self._best(change, now, placeholders)
            if (now is not None and not found and self._lacks_pose(now, step)) or step is None:
                break
            found.append(step)
            change, now = step.correction.change.after(change), step.after
        return tuple(f for f in found if now is None or is_explained(f, now))

    def _lacks_pose(self, stated: Plausibility, step: Finding | None) -> bool:
        """Whether a torque over position explains as much of the stated set-up as ``step`` does.

        That of gravity on a link or of a spring, where the device has none: no column is mistaken.
        """
        axes = axes_without_pose(self.system, self.motions) if self.has_few_axes else []
        if not axes:
            return False
        found = judge_setup(self.system, self.motions, self.band, self.folds, 12, axes)
        least = LEAST_GAIN if step is None else step.gain - ALIKE
        if found is None or stated.score(JUDGED_ERROR) - found.score(JUDGED_ERROR) < least:
            return False
        self.over_position = found
        return True

    def _is_suspicious(self, now: Plausibility | None, placeholders: Sequence[str]) -> bool:
        if now is None or now.error.max() > SUSPICIOUS_ERROR:
            return True
        most = LEAST_GAIN_PLACEHOLDER if placeholders else SUSPICIOUS_PRIORS
        return bool(now.objections.sum() - now.usual > most)

    def _best(
        self, change: Change, now: Plausibility | None, placeholders: Sequence[str]
    ) -> Finding | None:
        """The mistake whose correction gains most beyond what is stated, None if none does."""
        before = now or _nothing_explained(self.system)
        tried = self._try_best(change, self._discrete())
        best = choose(before, tried, placeholders)
        if self.has_few_axes and self._is_suspicious(best[0].after if best else now, ()):
            tried += self._try_best(change, self._continuous(change))
            best = choose(before, tried, placeholders)
        return next(iter(best), None)

    def _discrete(self) -> Iterator[Correction]:
        yield from sign_corrections(self.signals)
        yield from clock_corrections(self.signals)
        for correction in unit_corrections(self.signals):
            if self.has_few_axes or len(correction.signals) > 1:
                yield correction
        if self.has_few_axes:
            yield from exchange_corrections(self.signals)
            yield from quarter_turns(self.signals)

    def _continuous(self, change: Change) -> list[Correction]:
        """Scales and zeros of any size: the best families on a grid, then refined."""
        families: list[tuple[Callable[[float], Correction], Array]] = []
        for names in groups_of_like(self.signals):
            families.append((partial(_scaled_by_power, self.signals, names), _DECADES))
        for place, axis in enumerate(self.signals.axes):
            changed = [change.of_motion(motion, self.signals) for motion in self.screened[0]]
            q = np.concatenate([motion.q[:, place] for motion in changed])
            reach = 2.0 * max(float(np.ptp(q)), float(np.abs(np.median(q))))
            size = math.pi if self.signals.units[place] == "rad" else reach
            grid = size * np.linspace(-1.0, 1.0, _STEPS)
            families.append((partial(_shifted_by, self.signals, axis), grid))
        coarse = []
        for family, grid in families:
            scores = [self.screen(family(x), change) for x in grid]
            coarse.append((min(scores), family, grid, float(grid[int(np.argmin(scores))])))
        coarse.sort(key=lambda one: one[0])
        return [self._refined(change, *one) for one in coarse[: _SHORTLIST // 2]]

    def _refined(
        self,
        change: Change,
        least: float,
        family: Callable[[float], Correction],
        grid: Array,
        best: float,
    ) -> Correction:
        """The best correction of a family near ``best``, where it scores ``least``."""
        step = float(grid[1] - grid[0])
        for _ in range(_HALVINGS):
            step *= 0.5
            for x in (best - step, best + step):
                score = self.screen(family(x), change)
                if score < least:
                    best, least = x, score
        return family(best)

    def _try_best(self, change: Change, corrections: Iterable[Correction]) -> list[Tried]:
        """Screen all corrections; return the best with what they explain of all trials."""
        screened = [(self.screen(correction, change), correction) for correction in corrections]
        screened.sort(key=lambda one: one[0])
        tried = []
        for score, correction in screened[:_SHORTLIST]:
            found = self.judge(correction.change.after(change)) if math.isfinite(score) else None
            tried += [Tried((correction,), found)] if found is not None else []
        return tried


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


def _nothing_explained(system: System) -> Plausibility:
    n = len(system.coordinates)
    objections = np.full(len(system.parameters), 0.5)
    return Plausibility(np.full(n, 1e3), np.ones(n), system.prior, objections)


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
