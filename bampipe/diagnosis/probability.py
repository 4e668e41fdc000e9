"""Probabilities of sets of effects, of single effects, and of something unknown.

The log evidence of a set is a sum over samples. Blocks of time are resampled, and probabilities are
averaged over the draws, so that no single event decides (pseudo-Bayesian model averaging with a
bootstrap: Yao, Vehtari, Simpson and Gelman 2018, Bayesian Analysis 13, 917).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logit, ndtr, softmax

from bampipe.arrays import Array, Flags
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.dictionary import Key
from bampipe.diagnosis.search import Pool
from bampipe.diagnosis.session import Fit, acting_axes, change_effects
from bampipe.diagnosis.set_cost import SetCosts, added_effects, effect_names, removed_effects
from bampipe.diagnosis.unknown import Splines, Unknown, build_splines, weigh_unknown

_DRAWS = 1000
_MARGIN = 14.0
"""Difference in log evidence, nats, above which a set is no alternative: odds of a million."""
_MOST_SETS = 40
LEAST_P_VALUE = 1e-4
"""Smallest p-value: a dozen replicates do not support a smaller one."""


@dataclass(frozen=True)
class SetEvidence:
    """A set of effects with its log evidence and probability.

    Attributes:
        keys: its changes of the most probable model.
        effects: effects that it adds to the model diagnosed.
        unknown: index of the axis of an unknown function beside the effects, or None.
        log_evidence: log evidence over that of the most probable model, nats.
        by_block: its share of each block, (n,).
    """

    keys: tuple[Key, ...]
    effects: tuple[str, ...]
    unknown: int | None
    log_evidence: float
    by_block: Array
    probability: float = 0.0


@dataclass(frozen=True)
class FittedSet:
    """A set that has been fitted.

    Attributes:
        shortfall: log evidence that it gained less than its linear problem promised, nats an
            independent sample.
        rows: its residual beyond the bias in units of the present noise, by axis, each (n,).
    """

    shortfall: float
    rows: Sequence[Array]


@dataclass(frozen=True)
class Probabilities:
    """Probabilities of sets, of effects, and of something unknown.

    Attributes:
        sets: the sets, most probable first.
        effects: probability of each effect of any set.
        if_all_known: the same if nothing unknown is missing.
        unknown: probability that an axis lacks something unknown, (n_q,).
        functions: unknown function of each axis; None for an axis that does not move.
        drops: log evidence lost without each effect if nothing replaces it, nats.
    """

    sets: tuple[SetEvidence, ...]
    effects: Mapping[str, float]
    if_all_known: Mapping[str, float]
    unknown: Array
    functions: tuple[Unknown | None, ...]
    drops: Mapping[str, float]


def weigh_sets(
    by_noise: SetCosts,
    fit: Fit,
    pool: Pool,
    fitted: Mapping[tuple[str, ...], FittedSet],
    given: Sequence[str],
    criteria: Criteria,
    seed: int,
) -> Probabilities:
    """Compute the probabilities of the sets of a pool and of unknown functions beside them.

    The number of independent samples is that of the noise for something unknown, and that of the
    residual for effects.

    Args:
        by_noise: costs of sets beside the most probable model; fit: that model.
        pool: sets near it.
        fitted: those that have been fitted, by effects; their evidence is that of the fit.
        given: effects of the model diagnosed, which are not in question.
    """
    costs = by_noise.with_independent(fit.count_independent(criteria))
    by_fit = {pool[n][1]: one for n, one in fitted.items() if n in pool}
    none, count = costs.cost(()), float(costs.problem.independent.sum())

    def shortfall(keys: tuple[Key, ...]) -> float:
        """What a fit of the set, or of parts of it, falls short of its linear problem, nats."""
        if keys in by_fit:
            return by_fit[keys].shortfall * count
        parts = [one.shortfall for n, one in fitted.items() if {*n} < {*effect_names(keys)}]
        return count * max(parts, default=0.0)

    own = [e for e in costs.problem.absence if e not in given]
    bare = change_effects(fit.spec, own)
    weighed = sorted((costs.cost(k) + shortfall(k), k) for _, k in pool.values() if k)
    near = [k for cost, k in weighed[:_MOST_SETS] if cost < none + _MARGIN]
    absent = [((f"-{e}", ()),) for e in own]

    def list_effects(keys: Sequence[Key]) -> tuple[str, ...]:
        kept = [e for e in own if e not in removed_effects(keys)]
        return (*kept, *(name for name, _ in added_effects(keys)))

    named = [
        SetEvidence(
            keys, list_effects(keys), None, none - costs.cost(keys) - shortfall(keys),
            split_evidence(costs, keys, by_fit[keys].rows if keys in by_fit else ()),
        )
        for keys in dict.fromkeys([(), *near, *absent])
        if np.isfinite(costs.cost(keys))
    ]  # fmt: skip
    sets = _compute_probabilities(named, seed)
    effects, drops = _sum_by_effect(sets), _find_evidence_losses(sets)
    effects |= {e: 0.0 for e in own if by_noise.size_of_own(e) < criteria.size}
    if_all_known = dict(effects)
    unknown = np.zeros(len(costs.problem.y))
    functions: list[Unknown | None] = []
    for axis in range(len(unknown)):
        splines = build_splines(by_noise, axis)
        if splines is None:
            functions.append(None)
            continue
        by_all, here = (weigh_unknown(s, splines) for s in (by_noise, costs))
        functions.append(by_all)
        if by_all.size < criteria.size:
            continue
        more = by_noise.cost(()) - by_all.cost - (none - here.cost) + costs.log_prior
        if none - here.cost + more < costs.log_prior - _MARGIN:
            continue
        acting = [e for e in own if axis in acting_axes(bare, e)]
        more_by_block = split_evidence(by_noise, (), by_all.residual)
        more_by_block -= split_evidence(costs, (), here.residual)
        beside = [
            SetEvidence(
                keys, list_effects(keys), axis, none - found.cost + more,
                split_evidence(costs, keys, found.residual) + more_by_block,
            )
            for keys, found in _beside_unknown(costs, splines, here, acting)
        ]  # fmt: skip
        # The axes are independent in what they lack.
        with_unknown = _compute_probabilities([*named, *beside], seed)
        here_too = _sum_by_effect(with_unknown)
        unknown[axis] = sum(s.probability for s in with_unknown if s.unknown is not None)
        for effect in effects:
            if axis in acting_axes(bare, effect):
                effects[effect] = min(effects[effect], here_too.get(effect, 0.0))
        if unknown[axis] >= criteria.probability:
            losses = _find_evidence_losses(with_unknown)
            drops |= {effect: losses.get(effect, 0.0) for effect in acting}
        if unknown[axis] == unknown.max():
            sets = with_unknown
    excess = compute_excess(costs)
    sets, unknown = _add_unknown(sets, excess), np.maximum(unknown, excess)
    doubtful = (unknown >= criteria.probability) & fit.is_above_floor
    shares = _find_shares(costs, own, functions, doubtful) if doubtful.any() else {}
    for effect, share in shares.items():
        # A doubtful effect is not absent: the model keeps it, and the report mentions it.
        effects[effect] = min(effects[effect], max(share, 1.0 - criteria.probability))
    return Probabilities(sets, effects, if_all_known, unknown, tuple(functions), drops)


def _sum_squares(residual: Sequence[Array]) -> Array:
    """Return the sum of squares of the residual of each axis, (n_q,)."""
    return np.array([max(float(rows @ rows), 1e-300) for rows in residual])


def compute_excess(costs: SetCosts) -> Array:
    """Return the probability that the residual of each axis exceeds noise and discrepancy, (n_q,).

    With flat prior and N independent samples, log s is normal with variance 1/(2 N).
    """
    p = costs.problem
    log_scale = 0.5 * np.log(_sum_squares(costs.residual_rows(())) / np.maximum(p.count, 1))
    return np.asarray(ndtr(log_scale * np.sqrt(2.0 * p.independent)))


def _add_unknown(sets: Sequence[SetEvidence], excess: Array) -> tuple[SetEvidence, ...]:
    """Return the sets where something unknown has at least the largest probability of ``excess``.

    Of its form nothing is known, so that it is as probable beside any set without it.
    """
    axis = int(np.argmax(excess))
    none = sum(s.probability for s in sets if s.unknown is None)
    share = max(0.0, 1.0 - (1.0 - float(excess[axis])) / max(none, 1e-300))
    beside = {s.effects: s for s in sets if s.unknown == axis}
    rest = [s for s in sets if s.unknown not in (None, axis)]
    for one in (s for s in sets if s.unknown is None):
        same = beside.get(one.effects, replace(one, unknown=axis, probability=0.0))
        more = same.probability + share * one.probability
        beside[one.effects] = replace(same, probability=more)
        rest.append(replace(one, probability=(1.0 - share) * one.probability))
    return tuple(sorted([*rest, *beside.values()], key=lambda s: -s.probability))


def _find_shares(
    costs: SetCosts, effects: Sequence[str], functions: Sequence[Unknown | None], far: Flags
) -> dict[str, float]:
    """Return the largest share of the error without each effect that it explains on ``far`` axes.

    Something unknown there may resemble an effect that leaves a large error. The noise, which the
    unknown function leaves, is not part of it. The share is 1 if the other axes support the effect
    by `_MARGIN`, or more than these.
    """
    p, now = costs.problem, _sum_squares(costs.residual_rows(()))
    rest = [now if f is None else _sum_squares(f.residual) for f in functions]
    noise = np.minimum(np.diag(rest), np.minimum(p.count, now))
    shares = {}
    for effect in effects:
        without = _sum_squares(costs.residual_rows(((f"-{effect}", ()),)))
        gain = 0.5 * p.independent * np.log(without / now)
        ratio = (now - noise)[far] / np.maximum(without - noise, 1e-300)[far]
        by_others = gain[~far].sum() >= min(gain[far].sum(), _MARGIN)
        shares[effect] = 1.0 if by_others else float(1.0 - np.sqrt(np.maximum(ratio.min(), 0.0)))
    return shares


def _compute_probabilities(listed: Sequence[SetEvidence], seed: int) -> tuple[SetEvidence, ...]:
    """Return the sets with their probabilities, most probable first."""
    total = np.array([s.log_evidence for s in listed])
    blocks = np.array([s.by_block for s in listed])
    count = blocks.shape[1]
    rng = np.random.default_rng([seed, count])
    counts = rng.multinomial(count, np.full(count, 1.0 / count), _DRAWS)
    shares = softmax((counts - 1.0) @ blocks.T + total, axis=1).mean(axis=0)
    sets = [replace(s, probability=float(p)) for s, p in zip(listed, shares, strict=True)]
    return tuple(sorted(sets, key=lambda s: -s.probability))


def _find_evidence_losses(sets: Sequence[SetEvidence]) -> dict[str, float]:
    """Return the log evidence that the best set with each effect loses without it, nats."""
    found = {}
    for effect in dict.fromkeys(e for one in sets for e in one.effects):
        held = [one for one in sets if effect in one.effects]
        best = max(held, key=lambda one: one.log_evidence)
        rest = {*best.effects} - {effect}
        less = [s.log_evidence for s in sets if s.unknown == best.unknown and {*s.effects} <= rest]
        found[effect] = best.log_evidence - max(less, default=best.log_evidence - _MARGIN)
    return found


def _sum_by_effect(sets: Sequence[SetEvidence]) -> dict[str, float]:
    names = dict.fromkeys(e for one in sets for e in one.effects)
    return {e: sum(one.probability for one in sets if e in one.effects) for e in names}


def _beside_unknown(
    costs: SetCosts, splines: Splines, here: Unknown, acting: Sequence[str]
) -> list[tuple[tuple[Key, ...], Unknown]]:
    """Return sets beside an unknown function, by backward elimination of the ``acting`` effects.

    An effect of the model may merely resemble the missing one.
    """
    keys: tuple[Key, ...] = ()
    found = [(keys, here)]
    while True:
        away = removed_effects(keys)
        fewer = [tuple(sorted((*keys, (f"-{e}", ())))) for e in acting if e not in away]
        tried = [(less, weigh_unknown(costs, splines, less)) for less in fewer]
        best = min(tried, key=lambda one: one[1].cost, default=None)
        found += tried
        if best is None or best[1].cost > min(one.cost for _, one in found):
            return found
        keys = best[0]


def split_evidence(costs: SetCosts, keys: tuple[Key, ...], residual: Sequence[Array] = ()) -> Array:
    """Return the log evidence of a set over that of none by block, up to a constant, nats, (n,).

    ``residual`` is that of the set, by axis, each (n,); by default that of its linear problem.
    """
    p, before = costs.problem, costs.residual_rows(())
    after, volume = residual or costs.residual_rows(keys), costs.volume_rows(keys)
    count = 1 + max((int(s.block.max()) for s in p.likelihood.samples if len(s.block)), default=0)
    found = np.zeros(count)
    weights = [p.independent / _sum_squares(rows) for rows in (before, after)]
    for axis, here in enumerate(p.likelihood.samples):
        if not len(here.rows):
            continue
        w_before, w_after = (weight[axis] for weight in weights)
        share = here.independent / len(here.rows)
        rows = share * (volume[axis] + 0.5 * np.log(w_after / w_before))
        rows = rows + 0.5 * (w_before * before[axis] ** 2 - w_after * after[axis] ** 2)
        found += np.bincount(here.block, rows, minlength=count)
    return found


def find_required_gain(criteria: Criteria, replicate_gains: Sequence[float] = ()) -> float:
    """Return the log evidence from which a single effect is called missing, nats.

    Both its probability and its p-value then meet the criteria. The gain is infinite if they ask
    for less than `LEAST_P_VALUE`.
    """
    odds, p = float(logit(criteria.probability)), criteria.largest_p_value
    if not len(replicate_gains):
        return odds
    if p < LEAST_P_VALUE:
        return float("inf")
    middle, scale = _law_of_largest(replicate_gains)
    by_law = middle + scale * (np.log(np.log(2.0)) - np.log(-np.log1p(-p)))
    by_count = np.sort(replicate_gains)[-1 - int(p * len(replicate_gains))]
    return max(odds, float(by_law), float(by_count))


def compute_p_value(gain: float, replicate_gains: Sequence[float]) -> float:
    """Return the probability that chance gives a largest gain of at least ``gain``.

    It follows from the Gumbel distribution with the median and quartiles of the largest gains on
    replicates, and is at least the share of replicates with as large a gain.
    """
    middle, scale = _law_of_largest(replicate_gains)
    beyond = (gain - middle) / scale - np.log(np.log(2.0))
    by_law = float(-np.expm1(-np.exp(-max(beyond, -50.0))))
    return max(by_law, float(np.mean(np.asarray(replicate_gains) >= gain)), LEAST_P_VALUE)


def _law_of_largest(values: Sequence[float]) -> tuple[float, float]:
    """Return the median and the scale of the Gumbel distribution of largest gains."""
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    # The log evidence of a single candidate scatters by half a nat per strength.
    scale = max(float(high - low) / (np.log(np.log(4.0)) - np.log(np.log(4.0 / 3.0))), 1.0)
    return float(middle), scale
