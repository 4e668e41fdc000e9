"""The verdict of each axis, from the probabilities of effects and the noise floor."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bampipe.diagnosis.criteria import cap_probability
from bampipe.diagnosis.probability import compute_p_value
from bampipe.diagnosis.select import Selection
from bampipe.diagnosis.session import Session, acting_axes, rms
from bampipe.results.diagnose import (
    AxisVerdict,
    NullDistribution,
    RankedEffect,
    Verdict,
    WeighedSet,
)
from bampipe.results.floor import compare_with_floor


@dataclass(frozen=True)
class Conclusion:
    """The conclusion of a diagnosis.

    Attributes:
        axes: verdict of each coordinate, in order, without its sentence.
        selected: effects to add; ranking: candidates, best first.
        sets: sets, most probable first; chance: null distribution of the largest gain.
    """

    axes: tuple[AxisVerdict, ...]
    selected: tuple[str, ...]
    ranking: tuple[RankedEffect, ...]
    sets: tuple[WeighedSet, ...]
    chance: NullDistribution


def conclude(session: Session, selection: Selection) -> Conclusion:
    """Conclude which effects each axis lacks, with their probabilities, and what remains."""
    c, probabilities = session.criteria, selection.probabilities
    initial, final = selection.initial, selection.final
    p_values = {
        e: compute_p_value(drop, selection.replicate_gains)
        for e, drop in probabilities.drops.items()
    }
    # An effect whose gain chance can give is not certain.
    probability = {
        e: min(share, cap_probability(p_values.get(e, 0.0)))
        for e, share in probabilities.effects.items()
    }
    where = {e: acting_axes(initial.spec, e) for e in probability}
    axes = list[AxisVerdict]()
    for number in range(len(final.linearisation.system.coordinates)):
        likely = [(e, p) for e, p in probability.items() if p >= 1.0 - c.probability]
        here = [pair for pair in likely if number in where[pair[0]]]
        listed = dict(sorted(here, key=lambda pair: -pair[1]))
        axes.append(_judge(session, selection, number, listed))
    # Beside something unknown, effects in doubt are added only where they lower the error.
    helpful = {
        effect
        for axis in axes
        for effect in axis.probabilities
        if axis.verdict != "unknown_effect" or axis.rmse_after < axis.rmse_before
    }
    selected = tuple(effect for effect in selection.effects if effect in helpful)
    ranking = rank_effects(selection, probability, p_values, 1.0 - c.probability)
    return Conclusion(
        tuple(axes), selected, tuple(ranking), _list_sets(selection),
        NullDistribution(
            replicates=len(selection.replicate_gains),
            largest=tuple(map(float, selection.replicate_gains)),
            measured=selection.largest_gain[0],
            effect=selection.largest_gain[1],
            p_value=compute_p_value(selection.largest_gain[0], selection.replicate_gains),
        ),
    )  # fmt: skip


def _judge(
    session: Session, selection: Selection, axis: int, listed: Mapping[str, float]
) -> AxisVerdict:
    """Judge one axis, with the probabilities of the effects ``listed`` there."""
    c, final, initial = session.criteria, selection.final, selection.initial
    floor = final.noise_floor
    before, after = float(initial.held_out_rmse[axis]), float(final.held_out_rmse[axis])
    level, scatter = float(floor.level[axis]), float(floor.sd[axis])
    against_floor = compare_with_floor(after, level, scatter)
    named = tuple(e for e in listed if e in selection.effects)
    sure = [e for e, p in listed.items() if p >= c.probability]
    open_question = [e for e, p in listed.items() if p < c.probability]
    unknown = float(final.is_above_floor[axis] * min(selection.probabilities.unknown[axis], 1.0))
    remains = unknown >= c.probability
    verdict: Verdict
    if against_floor == "floor_missing":
        verdict = "no_verdict"
    elif remains and max(listed.values(), default=0.0) < 0.5:
        verdict = "unknown_effect"
    elif open_question or 1.0 - c.probability <= unknown < c.probability:
        verdict = "undecided"
    else:
        verdict = "missing" if sure else "nothing_missing"
    force = rms(final.likelihood.applied[axis])
    excess = max(before**2 - level**2, 0.0)
    left = max(after**2 - level**2, 0.0)
    function = selection.probabilities.functions[axis]
    share = min(max(function.share, 0.0), 1.0) if function else 0.0
    rest = after**2 * (1.0 - share) / max(before**2, 1e-300)
    return AxisVerdict(
        verdict=verdict,
        effects=named,
        probabilities=dict(listed),
        unknown=unknown,
        rmse_before=before,
        rmse_after=after,
        rmse_beyond_bias=rms(final.rows_beyond_bias[axis]),
        noise_floor=level,
        noise_floor_sd=scatter,
        standing=against_floor,
        unit=final.linearisation.system.torque_units[axis],
        force_rms=force,
        explained=max(0.0, 1.0 - (after / max(force, 1e-300)) ** 2),
        explainable_share=max(0.0, 1.0 - rest),
        explainable_after=share,
        explained_by_effects=max(0.0, 1.0 - left / max(excess, 1e-300)) if named else 0.0,
        remains=bool(remains),
        sentence="",
    )


def rank_effects(
    selection: Selection,
    probability: Mapping[str, float],
    p_values: Mapping[str, float],
    mentioned: float,
) -> list[RankedEffect]:
    """Rank the effects of the most probable set, then the others by what each gains alone.

    The error with one of the others follows from its log evidence and the independent samples of
    the axis. Sets of at least the probability ``mentioned`` give the indistinguishable effects.
    """
    initial, final = selection.initial, selection.final
    values = final.effect_parameters
    own = {item.name: item.parameters for item in final.linearisation.system.model.effects}
    unchosen = (e for e in selection.gains if e not in selection.effects)
    others = sorted(unchosen, key=lambda e: -selection.gains[e])
    chosen = sorted(selection.effects, key=lambda e: -selection.probabilities.drops.get(e, 0.0))
    left, rows = initial.problem.independent * initial.solution.left, []
    for effect in (*chosen, *others):
        is_chosen = effect in selection.effects
        fit = final if is_chosen else initial
        gain = (
            selection.probabilities.drops.get(effect, 0.0) if is_chosen else selection.gains[effect]
        )
        axis = max(acting_axes(initial.spec, effect), key=lambda a: float(left[a]))
        before = after = float(fit.held_out_rmse[axis])
        if is_chosen:
            before = float(final.held_out_without([effect])[axis])
        else:
            after *= float(np.exp(-gain / max(initial.problem.independent[axis], 1.0)))
        system = fit.linearisation.system
        rows.append(
            RankedEffect(
                effect=effect,
                axis=system.coordinates[axis],
                held_out_rmse_before=before,
                held_out_rmse_after=after,
                unit=system.torque_units[axis],
                probability=min(probability.get(effect, 0.0), 1.0),
                p_value=p_values.get(effect, compute_p_value(gain, selection.replicate_gains)),
                score=gain,
                parameters={q.name: values[q.name] for q in own.get(effect, ())},
                indistinguishable_from=_find_twins(selection, effect, mentioned),
            )
        )
    return rows


def _find_twins(selection: Selection, effect: str, mentioned: float) -> tuple[str, ...]:
    """Return the effects that replace one in another set of at least a given probability."""
    best = {*selection.effects}
    found = []
    for one in selection.probabilities.sets:
        swapped = {*one.effects} ^ best
        if len(swapped) == 2 and effect in swapped and one.probability >= mentioned:
            found += [e for e in swapped if e != effect]
    return tuple(sorted({*found}))


def _list_sets(selection: Selection) -> tuple[WeighedSet, ...]:
    sets, axes = selection.probabilities.sets, selection.final.linearisation.system.coordinates
    listed = [s for s in sets if s.probability >= 0.001] or sets[:1]
    return tuple(
        WeighedSet(
            effects=one.effects,
            unknown=None if one.unknown is None else axes[one.unknown],
            probability=min(one.probability, 1.0),
            log_evidence=one.log_evidence,
        )
        for one in listed
    )
