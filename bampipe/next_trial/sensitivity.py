"""What trials would have revealed: the smallest strength of each effect that a diagnosis finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm
from scipy.stats import t as student

from bampipe.discover.candidates import Candidate
from bampipe.discover.columns import added_residual
from bampipe.discover.ranges import MachineScale
from bampipe.discover.settings import Settings
from bampipe.next_trial.discrimination import Contest, Rival, Sums
from bampipe.physics.parameter import Parameter
from bampipe.results.standing import AT_FLOOR
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import ModelOnTrial

Array = NDArray[np.float64]

PROBABILITY = 0.9
"""With which the strength would have been revealed."""
HOPELESS = 100.0
"""Of the typical strength: what shows from there on only shows at no size that a machine has."""
ROUGHER = 0.15
"""Growth of the jump of friction at a reversal from which on no strength is promised. The joint of
the independent simulator, at the strength that was: friction by load (0.07, 0.08) showed in three
sessions of four, Stribeck friction (0.24 to 0.53) in none of four."""
_POSES, _SLIDING = 50, 5.0
"""At which that jump is looked at, and the speed on either side, in widths of the sign."""
LARGE = 1.0
"""Of the size at which an effect is clearly there: what goes unnoticed at that size is hidden."""


@dataclass(frozen=True)
class Visibility:
    """How large an effect must be to be found.

    Attributes:
        rival: the effect with its typical strengths and shape.
        factor: of the typical strength, from which on it is found; infinite where the trials do
            not excite it.
        axis: where it shows first.
        growth: of the jump of friction as that axis turns round, at the typical strength.
        imitated: whether it gains more than at ``factor`` on trials of a machine without it that
            stands still where it turns round.
    """

    rival: Rival
    factor: float
    axis: int
    growth: float = 0.0
    imitated: bool = False

    @property
    def parameter(self) -> Parameter:
        """The strength that is meant."""
        assert self.rival.item is not None
        return self.rival.item.parameters[_strengths(self.rival.item)[0]]

    @property
    def typical(self) -> float:
        """Its typical size, in its unit."""
        assert self.rival.item is not None
        return float(abs(self.rival.values[_strengths(self.rival.item)[0]]))

    @property
    def is_promised(self) -> bool:
        """Whether the machine would have moved much as it did, and not look like it without it.

        When friction jumps between two samples no log says, and what that leaves grows with the
        jump; while a joint sticks and breaks free, it is not where it was without the effect.
        """
        known = self.factor * self.growth <= ROUGHER and not self.imitated
        return self.factor >= HOPELESS or known

    @property
    def is_hidden(self) -> bool:
        """Whether the effect would go unnoticed at its typical size."""
        return self.factor > LARGE


def _strengths(item: Candidate) -> list[int]:
    return [i for i, q in enumerate(item.parameters) if q.strength and not q.fixed]


def typical_rival(item: Candidate, scale: MachineScale) -> Rival | None:
    """An effect at its typical strength, its shape within the range that the trials show.

    None where it has no strength.
    """
    strengths = _strengths(item)
    if not strengths:
        return None
    effect, values = item.system.model.effects[-1], []
    for i, q in enumerate(item.parameters):
        value = q.prior if q.typical is None else q.typical
        if i in strengths:
            value = value or q.sd
        elif not q.fixed:
            value = scale.range_of(effect, q).value_like(value)
        values.append(value)
    return Rival(item, np.array(values), 0.0)


@dataclass(frozen=True)
class Bar:
    """What a diagnosis asks of an effect.

    Attributes:
        drop: (n_q,) of the log error of an axis that is worth an effect there.
        tests: number of candidates.
    """

    drop: Array
    tests: int

    @classmethod
    def of_errors(cls, error: Array, floor: Array, floor_sd: Array, tests: int) -> Bar:
        """What counts is 16 % of an error at its floor, or what lifts it above its floor.

        Args:
            error: (n_q,) at hand; floor, floor_sd: (n_q,) of the noise, N.m or N.
            tests: number of candidates.
        """
        s = Settings()
        lift = np.log((AT_FLOOR * floor + s.above_floor_sd * floor_sd) / error)
        return cls(np.minimum(s.worth_at_floor, np.maximum(s.worth, lift)), tests)


def weigh_visibility(contest: Contest, sums: Sums, bar: Bar) -> list[Visibility]:
    """From which strength on each rival of ``contest`` would be found with `PROBABILITY`.

    The gain in log likelihood must exceed the chance level after Bonferroni's correction, and the
    error must fall by what is worth an effect. What the timing of the inputs can imitate, it does,
    as far as it may.

    Args:
        contest: the library's effects at their typical strengths, its floor the error at hand.
        sums: of the trials; bar: what is asked of an effect.
    """
    found = _weigh(contest, sums, bar)
    if not contest.timing_s:
        return found
    sharp = _weigh(*contest.without_timing(sums), bar)
    late = contest.timing_of(sums)
    return [
        one
        if other.factor >= one.factor or one.factor * late_s <= contest.timing_s
        else replace(
            other, factor=beyond_timing(one.factor, other.factor, contest.timing_s / late_s)
        )
        for one, other, late_s in zip(found, sharp, np.maximum(late, 1e-300), strict=True)
    ]


def beyond_timing(free: float, sharp: float, most: float) -> float:
    """The factor at which an effect shows whose imitation by the timing ends at ``most``.

    What shows goes with the square of the strength: of the whole effect what no timing imitates,
    and of the strength beyond ``most`` the rest as well.

    Args:
        free, sharp: factors at which it shows with a timing without limits, and without any.
    """
    alone = 1.0 / free**2
    rest = 1.0 / sharp**2 - alone
    root = np.sqrt(alone + rest - alone * rest * most**2)
    return float((rest * most + root) / (alone + rest))


def _weigh(contest: Contest, sums: Sums, bar: Bar) -> list[Visibility]:
    s = Settings()
    count = np.maximum(sums.count, 1.0)
    independent = np.maximum(count * contest.band.independent_share, 1.0)
    level = student.isf(min(s.significance / max(bar.tests, 1), 0.5), s.most_replicates - 1)
    sure = norm.ppf(PROBABILITY)
    found = []
    for rival, left in zip(contest.rivals, contest.left_by_model(sums), strict=True):
        by_chance = 0.5 * len(rival.free)
        spread = np.hypot(np.sqrt(by_chance), s.replay_error * float(independent.mean()))
        total = by_chance + level * spread
        total += sure * np.sqrt(2.0 * total)
        needed = np.maximum(total / independent, bar.drop)
        needed += sure * np.sqrt(2.0 * needed / independent)
        ratio = np.expm1(2.0 * needed) * count * contest.floor**2 / np.maximum(left, 1e-300)
        axis = int(np.argmin(ratio))
        excited = left[axis] > 1e-12 * count[axis] * contest.floor[axis] ** 2
        factor = float(np.sqrt(ratio[axis])) if excited else np.inf
        found.append(Visibility(rival, factor, axis))
    return found


def refine(
    contest: Contest, motions: Sequence[Motion], found: Sequence[Visibility], bar: Bar
) -> list[Visibility]:
    """The same with each effect at the strength found: it may not be linear in its strength."""
    refined = list(found)
    for _ in range(3):
        chosen = [k for k, one in enumerate(refined) if _is_nonlinear(one)]
        if not chosen:
            break
        probe = replace(contest, rivals=tuple(_at_strength_found(refined[k]) for k in chosen))
        again = weigh_visibility(probe, probe.sums(motions), bar)
        for k, one in zip(chosen, again, strict=True):
            refined[k] = replace(refined[k], factor=refined[k].factor * one.factor, axis=one.axis)
    return refined


def _is_nonlinear(found: Visibility) -> bool:
    """Whether an effect is not linear in its strength, and shows at a strength at all."""
    item = found.rival.item
    assert item is not None
    is_linear = len(item.linear_indices) == len(_strengths(item))
    return not is_linear and 1e-3 < found.factor < 1e3


def _at_strength_found(found: Visibility) -> Rival:
    item = found.rival.item
    assert item is not None
    values, strengths = found.rival.values.copy(), _strengths(item)
    own = [item.parameters[i] for i in strengths]
    values[strengths] = np.clip(
        values[strengths] * found.factor, [q.lower for q in own], [q.upper for q in own]
    )
    return replace(found.rival, values=values)


def growth_of_jump(contest: Contest, motions: Sequence[Motion], found: Visibility) -> float:
    """By which share an effect of typical strength makes friction jump more where motion turns.

    0 of an effect with a memory, whose force does not jump.

    Args:
        contest: of the effect; motions: the trials; found: the effect on them.
    """
    item, values = found.rival.item, found.rival.values
    assert item is not None
    if item.system.memory_names != contest.system.memory_names or item.replaces_motion:
        return 0.0
    axis, motion = found.axis, motions[0]
    p = np.append(contest.p[: len(item.system.parameters) - len(values)], values)
    motion = motion.rows(slice(None, None, max(1, len(motion.t) // _POSES)))
    speed = _SLIDING * contest.system.model.device.coordinates[axis].sign_width
    own = more = 0.0
    for side in (1.0, -1.0):
        qd = np.zeros_like(motion.qd)
        qd[:, axis] = side * speed
        sliding = replace(motion, qd=qd, qdd=np.zeros_like(qd), _columns={})
        base = ModelOnTrial(contest.system, contest.p, [sliding])
        own += side * float(base.residual[:, axis].mean())
        more += side * float(added_residual(item, p, base)[:, axis].mean())
    return max(more / own, 0.0) if own else 0.0


def gain_at(contest: Contest, sums: Sums, found: Visibility, left: Array) -> float:
    """Log likelihood that an effect gains at the strength at which it is found.

    Args:
        contest, sums: as for `weigh_visibility`; found: the effect.
        left: (n_q,) sum of squares that the model leaves of it at its typical strength.
    """
    axis = found.axis
    independent = float(sums.count[axis] * contest.band.independent_share[axis])
    ratio = left[axis] / (sums.count[axis] * contest.floor[axis] ** 2)
    return 0.5 * independent * float(np.log1p(found.factor**2 * ratio))
