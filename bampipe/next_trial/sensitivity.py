"""What trials would have revealed: the smallest strength of each effect that a diagnosis finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.stats import norm

from bampipe.arrays import Array
from bampipe.diagnosis.candidates import Candidate
from bampipe.diagnosis.columns import added_residual
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.probability import least_gain
from bampipe.diagnosis.ranges import MachineScale
from bampipe.diagnosis.search import log_prior, penalise
from bampipe.diagnosis.session import Fit, Session, candidates_of
from bampipe.next_trial.discrimination import Alternative, Comparison, Sums
from bampipe.physics.parameter import Parameter
from bampipe.results.next import Detectable
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import ModelOnTrial

_FACTORS = np.geomspace(1e-4, 100.0, 241)
"""Of the typical strength: a factor of 1.06 from one to the next, with straight lines between. What
shows from the last one on only shows at no size that a machine has."""
_MOST_GROWTH = 0.15
"""Growth of the jump of friction at a reversal from which on no strength is promised. The joint of
the independent simulator, at the strength that was: friction by load (0.07, 0.08) showed in three
sessions of four, Stribeck friction (0.24 to 0.53) in none of four."""
_POSES, _SLIDING = 50, 5.0
"""At which that jump is looked at, and the speed on either side, in widths of the sign."""


@dataclass(frozen=True)
class DetectionLimit:
    """How large an effect must be to be found.

    Attributes:
        alternative: the effect with its typical strengths and shape.
        factor: of the typical strength, from which on it is found; infinite where the trials do
            not excite it.
        axis: where it shows first.
        growth: of the jump of friction as that axis turns round, at the typical strength.
    """

    alternative: Alternative
    factor: float
    axis: int
    growth: float = 0.0

    @property
    def item(self) -> Candidate:
        """The effect."""
        return self.alternative.items[0]

    @property
    def parameter(self) -> Parameter:
        """The strength that is meant."""
        return self.item.parameters[_strengths(self.item)[0]]

    @property
    def typical(self) -> float:
        """Its typical size, in its unit."""
        return float(abs(self.alternative.values[0][_strengths(self.item)[0]]))

    @property
    def is_promised(self) -> bool:
        """Whether the machine would have moved much as it did.

        When friction jumps between two samples no log says, and what that leaves grows with the
        jump; while a joint sticks and breaks free, it is not where it was without the effect.
        """
        return np.isinf(self.factor) or self.factor * self.growth <= _MOST_GROWTH

    @property
    def is_hidden(self) -> bool:
        """Whether the effect would go unnoticed at its typical size."""
        return self.factor > 1.0


def _strengths(item: Candidate) -> list[int]:
    return [i for i, q in enumerate(item.parameters) if q.strength and not q.fixed]


def _is_linear(item: Candidate) -> bool:
    return len(item.linear_indices) == len(_strengths(item))


def make_typical_alternative(item: Candidate, scale: MachineScale) -> Alternative | None:
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
    several = item.linear_indices if len(item.linear_indices) > 1 else ()
    return Alternative((item,), (np.array(values),), slopes=tuple((0, i) for i in several))


def find_limits(comparison: Comparison, sums: Sums, needed: float) -> list[DetectionLimit]:
    """From which strength on each alternative of ``comparison`` would be called missing.

    Its log evidence, with the penalties of `Search`, must be what is needed, or more, with the
    probability that an effect must have to be called missing; and its size must matter. What an
    effect takes off the measured quantity it takes off the noise of its residual, too. Here noise
    is that of what was measured, with the effect and without, and the two cancel.

    Args:
        comparison: effects at their typical strengths; sums: of the trials.
        needed: log evidence, nats, see `find_needed`.
    """
    criteria, found = comparison.session.criteria, []
    sure = norm.ppf(criteria.probability)
    remainders = comparison.find_remainders(sums)
    pairs = zip(comparison.alternatives, remainders, strict=True)
    for number, (alternative, left) in enumerate(pairs):
        expected = left.distance(sums.independent, _FACTORS)
        # Noise scatters a log likelihood ratio by the root of twice what is expected of it.
        surely = expected - sure * np.sqrt(2.0 * expected)
        excess = surely - needed - _find_penalty(comparison, sums, number)
        enough = np.flatnonzero(excess >= 0.0)
        factor = float("inf")
        if enough.size:
            k = max(int(enough[0]), 1)
            share = np.clip(-excess[k - 1] / max(excess[k] - excess[k - 1], 1e-300), 0.0, 1.0)
            factor = float(_FACTORS[k - 1] * (_FACTORS[k] / _FACTORS[k - 1]) ** share)
        # What it adds that the model cannot imitate, where it is most beside the applied force.
        added = sums.added[:, number] / np.maximum(sums.applied, 1e-300)
        size = np.sqrt(float(added.max()) * left.share)
        scatter = sure / np.sqrt(max(float(left.squares.sum()) + left.prior, 1e-300))
        factor = max(factor, float(criteria.size / max(size, 1e-300) + scatter))
        found.append(DetectionLimit(alternative, _limit(factor), int(np.argmax(left.squares))))
    return found


def _limit(factor: float) -> float:
    """A factor, infinite where no machine has such a size."""
    return factor if factor < _FACTORS[-1] else float("inf")


def _find_penalty(comparison: Comparison, sums: Sums, number: int) -> Array:
    """What the priors of an alternative take off its log evidence, at each factor, nats."""
    alternative = comparison.alternatives[number]
    item, values = alternative.items[0], alternative.values[0]
    linear, information = list(item.linear_indices), comparison.information(sums, number)
    typical, spread, factors = np.ones(1), np.ones(1), np.ones_like(_FACTORS)
    if linear:
        typical, factors = np.abs(values[linear]), _FACTORS
        spread = np.array([item.parameters[i].sd for i in linear]) / typical
    if alternative.slopes:
        information = information * np.outer(values[linear], values[linear])
    strengths = factors[:, None] * np.ones_like(typical)
    return penalise(information, spread, strengths, len(item.searched_indices))


def find_needed(criteria: Criteria, candidates: int, by_chance: Sequence[float] = ()) -> float:
    """The log evidence before its penalties that makes an effect probable enough, nats.

    Args:
        criteria: of the diagnosis; candidates: that are weighed.
        by_chance: the most that each replay of a model gives to any candidate, nats.
    """
    return least_gain(criteria, by_chance) - log_prior(criteria, candidates)


@dataclass(frozen=True)
class Detectability:
    """What the trials at hand would have shown of the library's effects.

    Attributes:
        comparison: every effect at its typical strength.
        limits: from which strength on each would have been found.
        needed: log evidence, nats.
    """

    comparison: Comparison
    limits: tuple[DetectionLimit, ...]
    needed: float

    @property
    def hidden_numbers(self) -> list[int]:
        """Numbers of the effects that would go unnoticed at their typical size, worst first."""
        order = sorted(range(len(self.limits)), key=lambda k: -self.limits[k].factor)
        return [k for k in order if self.limits[k].is_hidden]

    @property
    def unpromised_names(self) -> tuple[str, ...]:
        """Names of those of which nothing is said; see `DetectionLimit.is_promised`."""
        return tuple(one.alternative.name for one in self.limits if not one.is_promised)

    @property
    def brake_effects(self) -> tuple[str, ...]:
        """Names of the effects that show where brakes are on."""
        return tuple(one.alternative.name for one in self.limits if one.item.system.braked)

    def restrict(self, chosen: Sequence[int]) -> Detectability:
        """The same for some of the effects."""
        limits = tuple(self.limits[k] for k in chosen)
        comparison = replace(self.comparison, alternatives=tuple(one.alternative for one in limits))
        return Detectability(comparison, limits, self.needed)

    def gain(self, motion: Motion) -> float:
        """Sum of the logarithms by which a trial lowers what goes unnoticed of these effects."""
        now = np.minimum([one.factor for one in self.limits], _FACTORS[-1])
        then = np.clip(self.factors_with(motion), 1.0, now)
        return float(np.sum(np.log(now / then)))

    def tabulate(self, motions: Sequence[Motion]) -> dict[str, Detectable]:
        """The smallest strength of each effect that shows, without and with a trial.

        Args:
            motions: versions of the trial, of which the median counts.
        """
        after = np.median([self.factors_with(motion) for motion in motions], axis=0)
        axes = self.comparison.fit.evidence.system.coordinates
        return {
            one.alternative.name: Detectable(
                parameter=one.parameter.name,
                smallest=one.factor * one.typical if np.isfinite(one.factor) else None,
                typical=one.typical,
                unit=one.parameter.unit,
                axis=axes[one.axis] if np.isfinite(one.factor) else "",
                with_proposal=factor * one.typical if np.isfinite(factor) else None,
            )
            for one, factor in zip(self.limits, after, strict=True)
            if one.is_promised
        }

    def factors_with(self, motion: Motion) -> Array:
        """From which factor on each effect is found once ``motion`` has been recorded."""
        now, before = np.array([one.factor for one in self.limits]), self._factors_at_hand
        after = self._factors(self.comparison.at_hand + self.comparison.sums([motion]))
        # What is not linear in its strength is taken to change alike.
        ratio = np.ones(len(now))
        known = np.isfinite(before) & np.isfinite(now)
        ratio[known] = now[known] / before[known]
        return np.array([_limit(factor) for factor in after * ratio])

    @cached_property
    def _factors_at_hand(self) -> Array:
        return self._factors(self.comparison.at_hand)

    def _factors(self, sums: Sums) -> Array:
        found = find_limits(self.comparison, sums, self.needed)
        return np.array([one.factor for one in found])


def find_detectability(
    session: Session, fit: Fit, by_chance: Sequence[float] = ()
) -> Detectability:
    """What the trials would have shown of every effect of the library that the model lacks.

    Args:
        session: the trials; fit: the model.
        by_chance: what replays give to any candidate, nats.
    """
    scale, names = MachineScale.of_trials(fit.evidence), session.candidate_names(fit.recipe)
    typical = (make_typical_alternative(item, scale) for item in candidates_of(fit.recipe, names))
    alternatives = tuple(alternative for alternative in typical if alternative is not None)
    comparison = Comparison(session, fit, fit, alternatives)
    needed = find_needed(session.criteria, len(names), by_chance)
    limits = find_limits(comparison, comparison.at_hand, needed)
    limits = [
        replace(one, factor=_within(one, scale), growth=growth_of_jump(comparison, one))
        for one in _refine(comparison, limits, needed)
    ]
    return Detectability(comparison, tuple(limits), needed)


def _refine(
    comparison: Comparison, found: Sequence[DetectionLimit], needed: float
) -> list[DetectionLimit]:
    """The same with each effect at the strength found: it may not be linear in its strength."""
    refined = list(found)
    for _ in range(3):
        chosen = [
            k
            for k, one in enumerate(refined)
            if not _is_linear(one.item) and 1e-3 < one.factor < np.inf
        ]
        if not chosen:
            break
        probe = replace(
            comparison, alternatives=tuple(_at_strength_found(refined[k]) for k in chosen)
        )
        again = find_limits(probe, probe.at_hand, needed)
        for k, one in zip(chosen, again, strict=True):
            refined[k] = replace(refined[k], factor=refined[k].factor * one.factor, axis=one.axis)
    return refined


def _at_strength_found(found: DetectionLimit) -> Alternative:
    values, strengths = found.alternative.values[0].copy(), _strengths(found.item)
    own = [found.item.parameters[i] for i in strengths]
    values[strengths] = np.clip(
        values[strengths] * found.factor, [q.lower for q in own], [q.upper for q in own]
    )
    return replace(found.alternative, values=(values,))


def _within(found: DetectionLimit, scale: MachineScale) -> float:
    """The factor from which on an effect is found where its strength is looked for."""
    q, effect = found.parameter, found.item.system.model.effects[-1]
    least = 0.0 if _is_linear(found.item) else scale.range_of(effect, q).low / found.typical
    return max(found.factor, least) if found.factor * found.typical <= q.upper else float("inf")


def growth_of_jump(comparison: Comparison, found: DetectionLimit) -> float:
    """By which share an effect of typical strength makes friction jump more where motion turns.

    0 of an effect with a memory, whose force does not jump.

    Args:
        comparison: of the effect; found: the effect on the trials at hand.
    """
    item, values, e = found.item, found.alternative.values[0], comparison.fit.evidence
    if item.system.memory_names != e.system.memory_names or item.replaces_motion:
        return 0.0
    axis, motion = found.axis, e.motions[0]
    p = np.append(e.p[: len(item.system.parameters) - len(values)], values)
    motion = motion.rows(slice(None, None, max(1, len(motion.t) // _POSES)))
    speed = _SLIDING * e.system.model.device.coordinates[axis].sign_width
    own = more = 0.0
    for side in (1.0, -1.0):
        qd = np.zeros_like(motion.qd)
        qd[:, axis] = side * speed
        sliding = replace(motion, qd=qd, qdd=np.zeros_like(qd), _columns={})
        base = ModelOnTrial(e.system, e.p, [sliding])
        own += side * float(base.residual[:, axis].mean())
        more += side * float(added_residual(item, p, base)[:, axis].mean())
    return max(more / own, 0.0) if own else 0.0
