"""Probabilities of sets of effects, of single effects, and of something unknown.

The log evidence of a set near the most probable one is a sum over samples. Blocks of time are drawn
anew, as in a bootstrap, and the probabilities averaged over the draws: an event that a single block
shows decides nothing (pseudo-Bayesian model averaging with a bootstrap, after Yao, Vehtari, Simpson
and Gelman 2018, Bayesian Analysis 13, 917).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logit, softmax

from bampipe.arrays import Array, Flags
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.dictionary import Key
from bampipe.diagnosis.search import Pool
from bampipe.diagnosis.session import Fit, acting_axes, change_effects
from bampipe.diagnosis.set_cost import SetCosts, added_effects, removed_effects
from bampipe.diagnosis.unknown import Splines, Unknown, build_splines, weigh_unknown

_DRAWS = 1000
_MARGIN = 14.0
"""Log evidence below the best, nats, beyond which a set is none of the alternatives: one in a
million."""
_MOST_SETS = 40
LEAST_P_VALUE = 1e-4
"""No chance is known to be smaller from a dozen replays."""


@dataclass(frozen=True)
class SetProbability:
    """A set of effects.

    Attributes:
        keys: as changes of the most probable one.
        effects: that the model then has, beyond those of the model diagnosed.
        unknown: axis on which something unknown stands beside them; None if nowhere.
        log_evidence: over that of the most probable set, nats; probability: of the set.
    """

    keys: tuple[Key, ...]
    effects: tuple[str, ...]
    unknown: int | None
    log_evidence: float
    probability: float


@dataclass(frozen=True)
class Probabilities:
    """How probable everything is.

    Attributes:
        sets: the most probable first.
        effects: probability of each effect of any of them; by_name: the same where nothing is
            unknown.
        unknown: probability that an axis lacks something unknown, (n_q,).
        functions: what that would be, by axis; None where an axis does not move.
        drops: log evidence lost without each effect, where nothing takes its place, nats.
    """

    sets: tuple[SetProbability, ...]
    effects: Mapping[str, float]
    if_all_known: Mapping[str, float]
    unknown: Array
    functions: tuple[Unknown | None, ...]
    drops: Mapping[str, float]


def weigh_sets(
    by_noise: SetCosts, fit: Fit, pool: Pool, given: Sequence[str], criteria: Criteria, seed: int
) -> Probabilities:
    """Weigh the sets of a pool, each member's absence, and unknown functions beside them.

    Whether something unknown remains is weighed by the noise; which effects there are, by the
    samples that are independent in what remains.

    Args:
        by_noise: costs of sets beside the most probable model; fit: that model.
        pool: sets near it, with costs by the noise.
        given: effects of the model diagnosed, which are not in question.
        seed: of the bootstrap.
    """
    costs = by_noise.with_independent(fit.count_independent(criteria))
    # What a set fell short by when it was fitted.
    shortfall = {k: c - by_noise.cost(k) for c, k in pool.values()}
    pool = {n: (costs.cost(k) + shortfall[k], k) for n, (_, k) in pool.items()}
    none = costs.cost(())
    own = [e for e in costs.problem.absence if e not in given]
    bare = change_effects(fit.recipe, own)
    near = sorted((c, k) for c, k in pool.values() if c < none + _MARGIN and k)[:_MOST_SETS]
    absent = [((f"-{e}", ()),) for e in own]
    named = [
        _SetEvidence(
            keys, None, none - costs.cost(keys) - shortfall.get(keys, 0.0),
            _split_evidence(costs, keys, None, shortfall.get(keys, 0.0)),
        )
        for keys in dict.fromkeys([(), *(k for _, k in near), *absent])
        if np.isfinite(costs.cost(keys))
    ]  # fmt: skip
    sets = _compute_probabilities(costs, named, given, seed)
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
        more_by_block = _split_evidence(by_noise, (), by_all) - _split_evidence(costs, (), here)
        beside = [
            _SetEvidence(
                keys, axis, none - found.cost + more,
                _split_evidence(costs, keys, found) + more_by_block,
            )
            for keys, found in _beside_unknown(costs, splines, here, acting)
        ]  # fmt: skip
        # What one axis lacks is independent of what another one does.
        with_unknown = _compute_probabilities(costs, [*named, *beside], given, seed)
        here_too = _sum_by_effect(with_unknown)
        unknown[axis] = sum(s.probability for s in with_unknown if s.unknown is not None)
        for effect in acting:
            effects[effect] = min(effects[effect], here_too.get(effect, 0.0))
            if unknown[axis] >= criteria.probability:
                drops[effect] = _find_evidence_losses(with_unknown).get(effect, 0.0)
        if unknown[axis] == unknown.max():
            sets = with_unknown
    far = np.sqrt(_sum_squares(costs, ()) / np.maximum(costs.problem.count, 1)) > criteria.doubt
    unknown[far] = 1.0
    doubtful = (unknown >= criteria.probability) & fit.is_above_floor
    for effect in own if doubtful.any() else ():
        # In doubt is not absent: the model keeps it, and the report mentions it.
        most = max(_share_explained(costs, effect, doubtful), 1.0 - criteria.probability)
        effects[effect] = min(effects[effect], most)
    return Probabilities(sets, effects, if_all_known, unknown, tuple(functions), drops)


def _sum_squares(costs: SetCosts, keys: tuple[Key, ...]) -> Array:
    """Sum of squares that a set leaves, in units of the noise, (n_q,)."""
    return np.array([max(float(rows @ rows), 1e-300) for rows in costs.residual_rows(keys)])


def _share_explained(costs: SetCosts, effect: str, far: Flags) -> float:
    """Of the error without an effect, what it takes on axes that are ``far``; the largest.

    What is missing there may resemble an effect that takes less than that leaves. 1 of an effect
    that the other axes show, or show more than these.
    """
    now, without = _sum_squares(costs, ()), _sum_squares(costs, ((f"-{effect}", ()),))
    gain = 0.5 * costs.problem.independent * np.log(without / now)
    if gain[~far].sum() >= min(gain[far].sum(), _MARGIN):
        return 1.0
    return float(np.max(1.0 - np.sqrt(now[far] / without[far])))


@dataclass(frozen=True)
class _SetEvidence:
    """A set with its log evidence over that of the most probable one, by block of time, too."""

    keys: tuple[Key, ...]
    unknown: int | None
    gain: float
    by_block: Array


def _compute_probabilities(
    costs: SetCosts, listed: Sequence[_SetEvidence], given: Sequence[str], seed: int
) -> tuple[SetProbability, ...]:
    """Probabilities of sets, the most probable first."""
    total, blocks = np.array([s.gain for s in listed]), np.array([s.by_block for s in listed])
    count = blocks.shape[1]
    rng = np.random.default_rng([seed, count])
    drawn = rng.multinomial(count, np.full(count, 1.0 / count), _DRAWS)
    shares = softmax((drawn - 1.0) @ blocks.T + total, axis=1).mean(axis=0)
    sets = [
        SetProbability(s.keys, _list_effects(costs, s.keys, given), s.unknown, s.gain, float(share))
        for s, share in zip(listed, shares, strict=True)
    ]
    return tuple(sorted(sets, key=lambda s: -s.probability))


def _find_evidence_losses(sets: Sequence[SetProbability]) -> dict[str, float]:
    """For each effect, what the best set with it loses if nothing takes its place, nats."""
    found = {}
    for effect in dict.fromkeys(e for one in sets for e in one.effects):
        held = [one for one in sets if effect in one.effects]
        best = max(held, key=lambda one: one.log_evidence)
        rest = {*best.effects} - {effect}
        less = [s.log_evidence for s in sets if s.unknown == best.unknown and {*s.effects} <= rest]
        found[effect] = best.log_evidence - max(less, default=best.log_evidence - _MARGIN)
    return found


def _sum_by_effect(sets: Sequence[SetProbability]) -> dict[str, float]:
    found: dict[str, float] = {}
    for one in sets:
        for effect in one.effects:
            found[effect] = found.get(effect, 0.0) + one.probability
    return found


def _beside_unknown(
    costs: SetCosts, splines: Splines, here: Unknown, acting: Sequence[str]
) -> list[tuple[tuple[Key, ...], Unknown]]:
    """Sets beside an unknown function: the whole one, and less each effect whose place it takes.

    An effect of the model may be a mere resemblance of what is missing.
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


def _list_effects(costs: SetCosts, keys: Sequence[Key], given: Sequence[str]) -> tuple[str, ...]:
    away = removed_effects(keys)
    kept = [e for e in costs.problem.absence if e not in away and e not in given]
    return (*kept, *(name for name, _ in added_effects(keys)))


def _split_evidence(
    costs: SetCosts, keys: tuple[Key, ...], unknown: Unknown | None, shortfall: float = 0.0
) -> Array:
    """Log likelihood of a set over that of none, less ``short``, nats, by block of time, (n,)."""
    p = costs.problem
    before = costs.residual_rows(())
    after = list(unknown.residual) if unknown else costs.residual_rows(keys)
    w_before = costs.solve(()).weight
    w_after = unknown.weight if unknown else costs.solve(keys).weight
    volume = costs.volume_rows(keys)
    count = 1 + max((int(s.block.max()) for s in p.likelihood.samples if len(s.block)), default=0)
    found = np.full(count, -shortfall / count)
    for axis, here in enumerate(p.likelihood.samples):
        if not len(here.rows):
            continue
        share = here.independent / len(here.rows)
        scale = 0.5 * np.log(w_after[axis] / w_before[axis])
        rows = share * scale + 0.5 * (
            w_before[axis] * before[axis] ** 2 - w_after[axis] * after[axis] ** 2
        )
        found += np.bincount(here.block, rows + share * volume[axis], minlength=count)
    return found


def find_required_gain(criteria: Criteria, replicate_gains: Sequence[float] = ()) -> float:
    """The log evidence from which on an effect alone is called missing, nats.

    Its probability is what the criteria ask for, and chance gives as much rarely enough, see
    `chance_of` (infinite where no replays can say so).
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
    """Probability that chance gives a largest gain of ``gain`` or more, from those of replays.

    By the law of largest values (Gumbel 1935), with their median and quartiles, and no less than
    the share of the replays that gave as much.
    """
    middle, scale = _law_of_largest(replicate_gains)
    beyond = (gain - middle) / scale - np.log(np.log(2.0))
    by_law = float(-np.expm1(-np.exp(-max(beyond, -50.0))))
    return max(by_law, float(np.mean(np.asarray(replicate_gains) >= gain)), LEAST_P_VALUE)


def _law_of_largest(values: Sequence[float]) -> tuple[float, float]:
    """Median and scale of the law of largest values."""
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    # The evidence of one candidate alone scatters by half a nat a strength.
    scale = max(float(high - low) / (np.log(np.log(4.0)) - np.log(np.log(4.0 / 3.0))), 1.0)
    return float(middle), scale
