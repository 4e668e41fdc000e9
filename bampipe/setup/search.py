"""Search for set-up mistakes, one after the other, by the improvement that a correction brings."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from bampipe.arrays import Array
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.setup import hypotheses
from bampipe.setup.drawn_bodies import HeavierBody
from bampipe.setup.hypotheses import Correction
from bampipe.setup.plausibility import Plausibility, axes_without_pose, judge_setup
from bampipe.trials.folds import Folds
from bampipe.trials.motion import Motion
from bampipe.trials.signals import Signals

SUSPICIOUS_ERROR = 0.4
"""Error relative to the applied force above which other set-ups are tried. Right set-ups stay below
0.15 with any one effect hidden; a gravity compensator that lags behind leaves 0.36."""
LEAST_GAIN = 7.0
"""Smallest gain of score by a correction: the error of one axis falls to 42 %, for example. In
sound sessions no other set-up gains more than 5.0, in mistaken ones the right one at least 7.9."""
LEAST_GAIN_PLACEHOLDER = 4.0
"""The same for a scale of exactly 1, which nobody has filled in."""
EXPLAINED = 0.6
"""Largest error of an axis that counts as corrected or sound, relative to the applied force and to
its standard deviation: a constant explains a constant force, whatever the signals mean."""
JUDGED_ERROR, RANKED_ERROR = 0.1, 0.01
"""Errors below these count as equal: when a mistake is confirmed, and when mistakes are ranked."""
SPOILS = 2.0
"""Largest factor by which a correction may raise the error, or `JUDGED_ERROR` if larger, of an axis
that was sound before. Doubling all drives of a robot helps an axis whose counterbalance the device
lacks, and raises another from 8 to 34 % of its force, although the set-up has no mistake."""
ALIKE = 1.5
"""Largest difference of scores at which two mistakes cannot be distinguished."""
MOST_MISTAKES = 4

SUSPICIOUS_PRIORS = 5.0
"""Sum of objections above which other set-ups are tried: two parameters beyond two deviations."""
LEAST_FACTOR, LEAST_TURN, LEAST_SHIFT = 1.5, 0.25, 0.3
"""Smallest mistakes: a factor, an angle (rad) and a fraction of an axis' travel. Anything smaller
is an effect to be diagnosed."""
MOST_AXES = 3
"""With more axes, only signs, the clock, and units of all axes or inputs together are tried: the
number of exchanges, shifts and scales grows too fast for fits of a robot's bodies."""
HIGHEST_HZ = 10.0
"""Frequency below which set-ups are compared: mistakes are so gross that they show there, and an
input that is taken for a position has derivatives only up to some 25 Hz."""
_SAMPLES, _SCREENED_SAMPLES = 12_000, 3_000
_SCREENING_STEPS = 3
_SHORTLIST = 6
DECADES = np.arange(-10, 11) / 2.0
_STEPS = 16
MOST_TRIALS = 6
_SAME_FACTOR = 0.05
"""Largest difference of logarithms at which the best factor is taken for a usual one."""
_HALVINGS = 11

Family = Callable[[float], Correction]
Corrections = tuple[Correction, ...]
Trials = tuple[Sequence[Motion], Folds]


@dataclass(frozen=True)
class Finding:
    """A mistake with the two set-ups that it distinguishes.

    Attributes:
        rivals: other corrections that work as well; gain: of the score.
        before, after: plausibility of the set-ups, with all other mistakes corrected.
    """

    correction: Correction
    rivals: tuple[Correction, ...]
    before: Plausibility
    after: Plausibility
    gain: float


def drop_correction(corrections: Corrections, one: Correction) -> Corrections:
    """Return all corrections but ``one``."""
    return tuple(other for other in corrections if other is not one)


def spoilt_axes(finding: Finding) -> list[int]:
    """Axes whose error falls by more than a third by the correction; all axes if there are none.

    Against drawn bodies, axes with fewer objections come before all.
    """
    before, after = finding.before, finding.after
    fallen = np.flatnonzero(after.error < before.error / 1.5)
    if not len(fallen) and before.unexplained is None:
        fallen = np.flatnonzero(after.objections < before.objections / 1.5)
    return fallen.tolist() or list(range(len(before.error)))


def gain_of(before: Plausibility, after: Plausibility, cost: float) -> float:
    """Gain of score by a correction of that cost."""
    return before.score(JUDGED_ERROR) - after.score(JUDGED_ERROR) - cost


def spoils_sound_axes(before: Plausibility, after: Plausibility) -> bool:
    """Whether a correction makes an axis much worse that was sound without it."""
    sound = before.error < SUSPICIOUS_ERROR
    return bool(np.any(after.error[sound] > SPOILS * np.maximum(before.error[sound], JUDGED_ERROR)))


@dataclass
class Search:
    """A search over hypotheses about signals, judged by how well the bare device explains trials.

    Parameters are free. All hypotheses are tried on a small part of the trials, the best on more.

    Attributes:
        motions: the trials as stated, shortened; tested: number of set-ups tried.
        placeholders: signals whose scale is exactly 1.
        heavier: the only body that is far heavier than drawn; None if there is none.
        over_position: plausibility of the stated set-up with a torque over position that the
            device lacks, if this rather than a mistake explains the error; otherwise None.
    """

    system: System
    motions: Sequence[Motion]
    band: Band
    folds: Folds
    signals: Signals
    placeholders: Sequence[str] = ()
    tested: int = field(default=0, init=False)
    over_position: Plausibility | None = field(default=None, init=False)
    heavier: HeavierBody | None = field(default=None, init=False)
    _judged: dict[Corrections, Plausibility | None] = field(default_factory=dict, init=False)

    def together(self, chosen: Corrections) -> Corrections:
        """Return corrections that explain more only together; none by default."""
        return ()

    def rivals(self, tried: list[Correction]) -> list[Correction]:
        """Return corrections, of those ``tried``, that may do as well as the chosen ones."""
        return tried

    def find_mistakes(self) -> tuple[Finding, ...]:
        """Return the mistakes of the set-up, the largest gain first."""
        chosen: Corrections = ()
        tried: list[Correction] = []
        while len(chosen) < MOST_MISTAKES and self.is_suspicious(self.judge(chosen)):
            singles = self._shortlist(chosen, self.discrete())
            options = [*((one,) for one in singles), self.together(chosen)]
            best = self._best(chosen, options)
            if self.is_suspicious(self.judge((*chosen, *best))):
                singles += self._continuous(chosen)
                with_first = self.together((*chosen, *singles[:1]))
                options += [*((one,) for one in singles), (*singles[:1], *with_first)]
                best = self._best(chosen, options)
            if (not chosen and self.lacks_pose(best)) or not best:
                break
            tried += singles
            chosen = (*chosen, *self._with_refined_factor(chosen, best))
        return self.confirm(chosen, self.rivals(tried))

    def confirm(self, chosen: Corrections, others: Sequence[Correction]) -> tuple[Finding, ...]:
        """Return the mistakes among corrections ``chosen`` together, the largest gain first.

        Corrections without which the error hardly rises are dropped. There are no mistakes if some
        axis remains unexplained, or is worse than as stated. ``others`` are corrections that may
        replace a chosen one.
        """
        found: list[Finding] = []
        while chosen:
            after = self.judge(chosen)
            if after is None:
                return ()
            found = []
            for one in chosen:
                before = self.judge(drop_correction(chosen, one)) or after.with_nothing_explained()
                found.append(Finding(one, (), before, after, gain_of(before, after, one.cost)))
            idle = min(found, key=lambda f: f.gain - self.least_gain(f.correction))
            if idle.gain >= self.least_gain(idle.correction):
                break
            chosen = drop_correction(chosen, idle.correction)
        stated = self.judge(())
        spoilt = stated is not None and chosen and spoils_sound_axes(stated, found[0].after)
        if spoilt or not 0 < len(chosen) <= MOST_MISTAKES:
            return ()
        most = self.score(chosen) + ALIKE
        for place, finding in enumerate(found):
            rest = drop_correction(chosen, finding.correction)
            known = {(one.kind, one.signals) for one in chosen}
            rivals: dict[tuple[str, tuple[str, ...]], Correction] = {}
            for other in others:
                key = (other.kind, other.signals)
                if key not in known and self.score((*rest, other)) < most:
                    rivals.setdefault(key, other)
            found[place] = replace(finding, rivals=tuple(rivals.values()))
        found.sort(key=lambda finding: -finding.gain)
        explained = all((f.after.left[spoilt_axes(f)] < EXPLAINED).all() for f in found)
        return tuple(found) if explained else ()

    def least_gain(self, correction: Correction) -> float:
        """Smallest gain of score at which a correction counts."""
        hinted = correction.kind == "scale" and set(correction.signals) <= set(self.placeholders)
        return LEAST_GAIN_PLACEHOLDER if hinted else LEAST_GAIN

    def score(self, corrections: Corrections) -> float:
        """Score of a set-up, lower being better; infinite if it cannot be computed."""
        found = self.judge(corrections)
        cost = sum(one.cost for one in corrections)
        return math.inf if found is None else found.score(RANKED_ERROR) + cost

    def _best(self, chosen: Corrections, options: Sequence[Corrections]) -> Corrections:
        """Return the best of the options that gain enough and spoil no axis."""
        before = self.judge(chosen)
        ranked = sorted(options, key=lambda option: self.score((*chosen, *option)))
        for option in filter(None, ranked):
            after = self.judge((*chosen, *option))
            if after is None:
                continue
            stated = before or after.with_nothing_explained()
            gain = gain_of(stated, after, sum(one.cost for one in option))
            least = max(map(self.least_gain, option))
            if gain >= least and not spoils_sound_axes(stated, after):
                return option
        return ()

    def _with_refined_factor(self, chosen: Corrections, best: Corrections) -> Corrections:
        """Return ``best`` with the optimal factor, if that differs from a unit's or a gain's."""
        first, *rest = best
        if first.kind != "scale":
            return best
        family = partial(scale_by_power_of_ten, self.signals, first.signals)
        start = math.log10(first.factor)
        refined = self._refine(chosen, family, start, math.inf, float(DECADES[1] - DECADES[0]))
        found = (refined, *rest)
        far = abs(math.log(refined.factor / first.factor)) > _SAME_FACTOR
        gain = self.score((*chosen, *best)) - self.score((*chosen, *found))
        return found if far and gain > ALIKE else best

    def _continuous(self, chosen: Corrections) -> list[Correction]:
        """Return scales and zeros of any size: the best families on a grid, refined."""
        coarse = []
        for family, grid in self.families(chosen):
            scores = [self.screen(chosen, family(x)) for x in grid]
            best = int(np.argmin(scores))
            coarse.append((scores[best], family, float(grid[best]), float(grid[1] - grid[0])))
        coarse.sort(key=lambda one: one[0])
        return [
            self._refine(chosen, family, best, least, step)
            for least, family, best, step in coarse[: _SHORTLIST // 2]
        ]

    def _refine(
        self, chosen: Corrections, family: Family, best: float, least: float, step: float
    ) -> Correction:
        """Return the best correction of a family near ``best``, whose score is ``least``."""
        for _ in range(_HALVINGS):
            step *= 0.5
            for x in (best - step, best + step):
                score = self.screen(chosen, family(x))
                if score < least:
                    best, least = x, score
        return family(best)

    def _shortlist(self, chosen: Corrections, tried: Iterable[Correction]) -> list[Correction]:
        """Return the best corrections on the small part of the trials."""
        screened = sorted(((self.screen(chosen, c), c) for c in tried), key=lambda pair: pair[0])
        return [one for score, one in screened[:_SHORTLIST] if math.isfinite(score)]

    @property
    def has_few_axes(self) -> bool:
        """Whether there are so few axes that every kind of mistake can be tried in seconds."""
        return len(self.signals.axes) <= MOST_AXES

    @cached_property
    def screened(self) -> Trials:
        """The part of the trials for all set-ups: two fitted trials and a braked one."""
        folds = self.folds
        fitted = [k for k, fits in enumerate(folds.fitted) if fits]
        others = [k for k, fits in enumerate(folds.fitted) if not fits]
        chosen = [*dict.fromkeys([*fitted[:1], *fitted[-1:]]), *others[:1]]
        part = folds.subset(chosen)
        most = _SCREENED_SAMPLES if self.has_few_axes else _SCREENED_SAMPLES // 2
        return shorten([self.motions[k] for k in chosen], most), part

    def judge(self, corrections: Corrections) -> Plausibility | None:
        """Return the plausibility of a set-up on the trials; None if it cannot be computed."""
        if corrections not in self._judged:
            self._judged[corrections] = self._judge(corrections, (self.motions, self.folds), 12)
        return self._judged[corrections]

    def _judge(
        self, corrections: Corrections, trials: Trials, steps: int, posed: Sequence[int] = ()
    ) -> Plausibility | None:
        (motions, folds), change = trials, hypotheses.combine(self.signals, corrections)
        with np.errstate(all="ignore"):
            changed = [change.of_motion(motion, self.signals) for motion in motions]
        return judge_setup(self.system, changed, change.of_band(self.band), folds, steps, posed)

    def screen(self, chosen: Corrections, correction: Correction) -> float:
        """Return score and cost with one more correction; infinite if it makes no sense."""
        if not _is_gross(correction, self.motions, self.signals):
            return math.inf
        self.tested += 1
        found = self._judge((*chosen, correction), self.screened, _SCREENING_STEPS)
        return math.inf if found is None else found.score(RANKED_ERROR) + correction.cost

    def lacks_pose(self, best: Corrections) -> bool:
        """Whether a torque over position explains the stated set-up as well as ``best`` does.

        If the device lacks gravity on a link or a spring, no column is mistaken.
        """
        axes = axes_without_pose(self.system, self.motions) if self.has_few_axes else []
        stated = self.judge(())
        found = self._judge((), (self.motions, self.folds), 12, axes) if axes else None
        if found is None or stated is None:
            return False
        after = self.judge(best) if best else None
        cost = sum(one.cost for one in best)
        gain = gain_of(stated, after, cost) if after is not None else 0.0
        if gain_of(stated, found, 0.0) < (gain - ALIKE if gain else LEAST_GAIN):
            return False
        self.over_position = found
        return True

    def is_suspicious(self, now: Plausibility | None) -> bool:
        """Whether the error or the parameters are implausible enough to try other set-ups."""
        if now is None or now.error.max() > SUSPICIOUS_ERROR:
            return True
        most = LEAST_GAIN_PLACEHOLDER if self.placeholders else SUSPICIOUS_PRIORS
        return bool(now.objections.sum() > most)

    def discrete(self) -> Iterator[Correction]:
        """Yield usual mistakes."""
        yield from hypotheses.sign_corrections(self.signals)
        yield from hypotheses.clock_corrections(self.signals)
        for correction in hypotheses.unit_corrections(self.signals):
            if self.has_few_axes or len(correction.signals) > 1:
                yield correction
        if self.has_few_axes:
            yield from hypotheses.exchange_corrections(self.signals)
            yield from hypotheses.quarter_turns(self.signals)

    def families(self, chosen: Corrections) -> Iterator[tuple[Family, Array]]:
        """Yield scales and zeros of any size, each with its initial grid."""
        if not self.has_few_axes:
            return
        for names in hypotheses.group_signals(self.signals):
            yield partial(scale_by_power_of_ten, self.signals, names), DECADES
        change = hypotheses.combine(self.signals, chosen)
        changed = [change.of_motion(motion, self.signals) for motion in self.screened[0]]
        for place, axis in enumerate(self.signals.axes):
            q = np.concatenate([motion.q[:, place] for motion in changed])
            turns = self.signals.units[place] == "rad"
            if turns:
                yield from gear_families(self.signals, axis, float(np.ptp(q)))
            reach = 2.0 * max(float(np.ptp(q)), float(np.abs(np.median(q))))
            grid = (math.pi if turns else reach) * np.linspace(-1.0, 1.0, _STEPS)
            yield partial(hypotheses.zero_correction, self.signals, axis, cost=3.0), grid


def shorten(motions: Sequence[Motion], most: int = _SAMPLES) -> list[Motion]:
    """Return the middle of each trial, so that all together have at most ``most`` samples."""
    each = most // max(len(motions), 1)
    starts = [max((motion.t.size - each) // 2, 0) for motion in motions]
    return [m.rows(slice(at, at + each)) for m, at in zip(motions, starts, strict=True)]


def scale_by_power_of_ten(signals: Signals, names: tuple[str, ...], power: float) -> Correction:
    return hypotheses.scale_correction(signals, names, 10.0**power, 3.0)


def gear_families(signals: Signals, axis: str, travel: float) -> Iterator[tuple[Family, Array]]:
    """Yield gear ratios of an axis whose position, with that travel, rad, must be a motor's."""
    if travel > hypotheses.MOST_TRAVEL:
        spans = hypotheses.JOINT_SPANS / travel
        yield partial(scale_by_power_of_ten, signals, (axis,)), np.log10(spans)


def _is_gross(correction: Correction, motions: Sequence[Motion], signals: Signals) -> bool:
    """Whether a scale or zero is wrong by more than an effect would explain."""
    if correction.kind == "scale":
        return abs(math.log(correction.factor)) > math.log(LEAST_FACTOR)
    if correction.kind != "zero":
        return True
    place = signals.places(correction.signals)[0]
    if signals.units[place] == "rad":
        return abs(correction.offset) > LEAST_TURN
    travel = max(float(np.ptp(motion.q[:, place])) for motion in motions)
    return abs(correction.offset) > LEAST_SHIFT * travel
