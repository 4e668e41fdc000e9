"""Smallest strength of each effect that a diagnosis of the present trials would have found."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm

from bampipe.arrays import Array
from bampipe.diagnosis.candidates import Candidate
from bampipe.diagnosis.columns import compute_added_residual
from bampipe.diagnosis.probability import find_required_gain
from bampipe.diagnosis.ranges import MachineScale
from bampipe.diagnosis.session import Fit, Session, candidates_of
from bampipe.diagnosis.set_cost import log_prior, penalise
from bampipe.next_trial.discrimination import Alternative, Comparison, Sums
from bampipe.physics.parameter import Parameter
from bampipe.results.next import Detectable
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import ModelOnTrial

_STRENGTHS = np.geomspace(1e-4, 100.0, 241)
"""Strengths tried, relative to the typical one, with linear interpolation between them. No machine
has an effect of the largest size."""
_MOST_JUMP_GROWTH = 0.15
"""Largest growth of the jump of friction at a reversal for which a strength is promised. On a
simulated joint, load-dependent friction (growth 0.07 and 0.08) was found at the promised strength
in three sessions of four, Stribeck friction (0.24 to 0.53) in none of four."""
_JUMP_POSES, _JUMP_SPEED = 50, 5.0
"""Poses at which the jump is computed; speed on either side of it, in widths of the sign."""


@dataclass(frozen=True)
class DetectionLimit:
    """The smallest strength at which an effect is found.

    Attributes:
        alternative: the effect with its typical strengths and shape.
        factor: that strength over the typical one; infinite if the trials do not excite the effect.
        axis: the axis that shows it first.
        growth: relative growth of the jump of friction where that axis reverses, at the typical
            strength.
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
        """The strength parameter."""
        return self.item.parameters[_find_strengths(self.item)[0]]

    @property
    def typical(self) -> float:
        """Typical size of that parameter, in its unit."""
        return float(abs(self.alternative.values[0][_find_strengths(self.item)[0]]))

    @property
    def is_promised(self) -> bool:
        """Whether the machine would have moved much as it did without the effect.

        A log does not show at which instant between two samples friction jumps, and the error that
        this causes grows with the jump. A joint that sticks and breaks free moves differently.
        """
        return np.isinf(self.factor) or self.factor * self.growth <= _MOST_JUMP_GROWTH


def _find_strengths(item: Candidate) -> list[int]:
    return [i for i, q in enumerate(item.parameters) if q.strength and not q.fixed]


def _is_linear(item: Candidate) -> bool:
    return len(item.linear_indices) == len(_find_strengths(item))


def make_typical_alternative(item: Candidate, scale: MachineScale) -> Alternative | None:
    """Return an effect at its typical strength; None if it has no strength parameter.

    Its shape is limited to the range that the trials show.
    """
    strengths = _find_strengths(item)
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
    """Return the smallest strength at which each alternative of ``comparison`` is called missing.

    Its log evidence, nats, less the penalties of `SetCosts`, must reach ``needed`` with the
    probability that the criteria require, and its size must matter.

    The alternatives are effects at their typical strengths.
    """
    criteria, found = comparison.session.criteria, []
    sure = norm.ppf(criteria.probability)
    odds = log_prior(criteria, len(comparison.session.candidate_names(comparison.fit.spec)))
    remainders = comparison.find_remainders(sums)
    pairs = zip(comparison.alternatives, remainders, strict=True)
    for number, (alternative, left) in enumerate(pairs):
        expected = left.distance(sums.independent, _STRENGTHS)
        # The variance of a log likelihood ratio is twice its expectation.
        surely = expected - sure * np.sqrt(2.0 * expected)
        further = (1 - alternative.items[0].combines) * odds
        excess = surely - needed - further - _find_penalty(comparison, sums, number)
        enough = np.flatnonzero(excess >= 0.0)
        factor = float("inf")
        if enough.size:
            k = max(int(enough[0]), 1)
            share = np.clip(-excess[k - 1] / max(excess[k] - excess[k - 1], 1e-300), 0.0, 1.0)
            factor = float(_STRENGTHS[k - 1] * (_STRENGTHS[k] / _STRENGTHS[k - 1]) ** share)
        # The part that the model cannot imitate, on the axis where it is largest.
        added = sums.added[:, number] / np.maximum(sums.applied, 1e-300)
        size = np.sqrt(float(added.max()) * left.share)
        scatter = sure / np.sqrt(max(float(left.squares.sum()) + left.prior, 1e-300))
        factor = max(factor, float(criteria.size / max(size, 1e-300) + scatter))
        found.append(DetectionLimit(alternative, _cap_factor(factor), int(np.argmax(left.squares))))
    return found


def _find_penalty(comparison: Comparison, sums: Sums, number: int) -> Array:
    """Return the penalty of the priors on the log evidence of an alternative at each strength."""
    alternative = comparison.alternatives[number]
    item, values = alternative.items[0], alternative.values[0]
    linear, information = list(item.linear_indices), comparison.information(sums, number)
    typical, spread, factors = np.ones(1), np.ones(1), np.ones_like(_STRENGTHS)
    if linear:
        typical, factors = np.abs(values[linear]), _STRENGTHS
        spread = np.array([item.parameters[i].sd for i in linear]) / typical
    if alternative.slopes:
        information = information * np.outer(values[linear], values[linear])
    strengths = factors[:, None] * np.ones_like(typical)
    return penalise(information, spread, strengths, len(item.searched_indices))


def _cap_factor(factor: float) -> float:
    """Return ``factor``, or infinity if no machine has an effect of that size."""
    return factor if factor < _STRENGTHS[-1] else float("inf")


@dataclass(frozen=True)
class Detectability:
    """The effects of the library that the trials at hand would have shown.

    Attributes:
        comparison: every effect at its typical strength; limits: of each.
        needed: log evidence, before penalties, that makes an effect probable enough, nats.
    """

    comparison: Comparison
    limits: tuple[DetectionLimit, ...]
    needed: float

    def keep_hidden(self, most: int) -> "Detectability":
        """Return the same for the effects that go unnoticed at their typical size, worst first."""
        hidden = [one for one in self.limits if one.factor > 1.0]
        limits = tuple(sorted(hidden, key=lambda one: -one.factor)[:most])
        comparison = replace(self.comparison, alternatives=tuple(one.alternative for one in limits))
        return Detectability(comparison, limits, self.needed)

    def gain(self, motion: Motion) -> float:
        """Return the sum of the logarithms of the ratios by which a trial lowers the limits."""
        now = np.minimum([one.factor for one in self.limits], _STRENGTHS[-1])
        then = np.clip(self.factors_with(motion), 1.0, now)
        return float(np.sum(np.log(now / then)))

    def tabulate(self, motions: Sequence[Motion]) -> dict[str, Detectable]:
        """Return the smallest detectable strength of each effect, without and with a trial.

        The latter is the median over the versions of the trial.
        """
        after = np.median([self.factors_with(motion) for motion in motions], axis=0)
        axes = self.comparison.fit.linearisation.system.coordinates
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
        """Return the factor at which each effect is found once ``motion`` is recorded."""
        now = np.array([one.factor for one in self.limits])
        before = self._factors(self.comparison.sums_now)
        after = self._factors(self.comparison.sums_now + self.comparison.sums([motion]))
        # An effect that is not linear in its strength is assumed to change by the same ratio.
        ratio = np.ones(len(now))
        known = np.isfinite(before) & np.isfinite(now)
        ratio[known] = now[known] / before[known]
        return np.array([_cap_factor(factor) for factor in after * ratio])

    def _factors(self, sums: Sums) -> Array:
        found = find_limits(self.comparison, sums, self.needed)
        return np.array([one.factor for one in found])


def find_detectability(
    session: Session, fit: Fit, by_chance: Sequence[float] = ()
) -> Detectability:
    """Return the detection limits of every effect of the library that the model lacks.

    ``by_chance`` are the largest gains of any candidate on each replicate, nats.
    """
    scale, names = MachineScale.of_trials(fit.linearisation), session.candidate_names(fit.spec)
    typical = (make_typical_alternative(item, scale) for item in candidates_of(fit.spec, names))
    alternatives = tuple(alternative for alternative in typical if alternative is not None)
    comparison = Comparison(session, fit, fit, alternatives)
    needed = find_required_gain(session.criteria, by_chance) - log_prior(
        session.criteria, len(names)
    )
    limits = find_limits(comparison, comparison.sums_now, needed)
    limits = [
        replace(one, factor=_bound_factor(one, scale), growth=find_jump_growth(comparison, one))
        for one in _refine_limits(comparison, limits, needed)
    ]
    return Detectability(comparison, tuple(limits), needed)


def _refine_limits(
    comparison: Comparison, found: Sequence[DetectionLimit], needed: float
) -> list[DetectionLimit]:
    """Repeat the search around the strengths found for effects not linear in their strength."""
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
            comparison, alternatives=tuple(_set_found_strength(refined[k]) for k in chosen)
        )
        again = find_limits(probe, probe.sums_now, needed)
        for k, one in zip(chosen, again, strict=True):
            refined[k] = replace(refined[k], factor=refined[k].factor * one.factor, axis=one.axis)
    return refined


def _set_found_strength(found: DetectionLimit) -> Alternative:
    values, strengths = found.alternative.values[0].copy(), _find_strengths(found.item)
    own = [found.item.parameters[i] for i in strengths]
    values[strengths] = np.clip(
        values[strengths] * found.factor, [q.lower for q in own], [q.upper for q in own]
    )
    return replace(found.alternative, values=(values,))


def _bound_factor(found: DetectionLimit, scale: MachineScale) -> float:
    """Return the factor within the range in which the diagnosis searches the strength."""
    q, effect = found.parameter, found.item.system.model.effects[-1]
    least = 0.0 if _is_linear(found.item) else scale.range_of(effect, q).low / found.typical
    return max(found.factor, least) if found.factor * found.typical <= q.upper else float("inf")


def find_jump_growth(comparison: Comparison, found: DetectionLimit) -> float:
    """Return the relative growth of the jump of friction at a reversal, at typical strength.

    It is 0 for an effect with internal states, whose force does not jump.
    """
    item, values, e = found.item, found.alternative.values[0], comparison.fit.linearisation
    if item.system.memory_names != e.system.memory_names or item.replaces_motion:
        return 0.0
    axis, motion = found.axis, e.motions[0]
    p = np.append(e.p[: len(item.system.parameters) - len(values)], values)
    motion = motion.rows(slice(None, None, max(1, len(motion.t) // _JUMP_POSES)))
    speed = _JUMP_SPEED * e.system.model.device.coordinates[axis].sign_width
    own = more = 0.0
    for side in (1.0, -1.0):
        qd = np.zeros_like(motion.qd)
        qd[:, axis] = side * speed
        sliding = replace(motion, qd=qd, qdd=np.zeros_like(qd))
        base = ModelOnTrial(e.system, e.p, [sliding])
        own += side * float(base.residual[:, axis].mean())
        more += side * float(compute_added_residual(item, p, base)[:, axis].mean())
    return max(more / own, 0.0) if own else 0.0
