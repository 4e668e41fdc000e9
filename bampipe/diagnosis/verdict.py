"""The rule: what is said of each axis, from the probabilities, the sizes and the noise floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bampipe.diagnosis.probability import chance_of, touched_axes
from bampipe.diagnosis.select import Selection
from bampipe.diagnosis.session import Fit, Session, candidates_of
from bampipe.results.diagnose import (
    AxisVerdict,
    NullDistribution,
    RankedEffect,
    Verdict,
    WeighedSet,
)
from bampipe.results.standing import standing
from bampipe.trials.noise_floor import NoiseFloor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Conclusion:
    """What a diagnosis says.

    Attributes:
        axes: by coordinate, in order, without their sentences.
        selected: effects to add; ranking: candidates, best first.
        sets: by their probability; chance: the null distribution.
    """

    axes: tuple[AxisVerdict, ...]
    selected: tuple[str, ...]
    ranking: tuple[RankedEffect, ...]
    sets: tuple[WeighedSet, ...]
    chance: NullDistribution


def conclude(session: Session, selection: Selection) -> Conclusion:
    """Say of each axis what is missing there, how probable that is, and what remains."""
    c, weighed = session.criteria, selection.weighed
    initial, final = selection.initial, selection.final
    p_values = {e: chance_of(drop, selection.chance) for e, drop in weighed.drops.items()}
    # Of what chance gives as well, nothing is sure.
    probability = {
        e: share if p_values.get(e, 0.0) <= c.significance else min(share, 1.0 - p_values[e])
        for e, share in weighed.effects.items()
    }
    where = {e: effect_axes(initial, final, e) for e in probability}
    selected = tuple(
        e for e in selection.effects if probability.get(e, 0.0) >= 1.0 - c.probability
    )
    axes = []
    for axis, name in enumerate(final.evidence.system.coordinates):
        here = {e: p for e, p in probability.items() if axis in where[e]}
        listed = {e: p for e, p in here.items() if p >= 1.0 - c.probability}
        listed = dict(sorted(listed.items(), key=lambda pair: -pair[1]))
        unknown = float(weighed.unknown[axis])
        axes.append(_judge(session, selection, axis, name, listed, unknown))
    ranking = rank_effects(selection, probability, p_values)
    return Conclusion(
        tuple(axes), selected, tuple(ranking), _sets(selection),
        NullDistribution(
            replicates=len(selection.chance),
            largest=tuple(map(float, selection.chance)),
            measured=selection.beside[0],
            effect=selection.beside[1],
            p_value=chance_of(selection.beside[0], selection.chance),
        ),
    )  # fmt: skip


def _judge(
    session: Session,
    selection: Selection,
    axis: int,
    name: str,
    listed: Mapping[str, float],
    unknown: float,
) -> AxisVerdict:
    c, final, initial = session.criteria, selection.final, selection.initial
    floor = noise_floor(final)
    before, after = (fit.evidence.held_out_rmse[axis] for fit in (initial, final))
    level, scatter = float(floor.level[axis]), float(floor.sd[axis])
    against_floor = standing(float(after), level, scatter)
    named = tuple(e for e in listed if e in selection.effects)
    sure = [e for e, p in listed.items() if p >= c.probability]
    open_question = [e for e, p in listed.items() if p < c.probability]
    remains = unknown >= c.probability or _exceeds_any_model(final, axis)
    verdict: Verdict
    if against_floor == "floor_missing":
        verdict = "no_verdict"
    elif open_question or 1.0 - c.probability <= unknown < c.probability:
        verdict = "undecided"
    elif sure:
        verdict = "missing"
    else:
        verdict = "unknown_effect" if remains else "nothing_missing"
    force = float(np.sqrt(np.mean(final.likelihood.applied[axis] ** 2)))
    excess = before**2 - min(level, before) ** 2
    left = max(after**2 - level**2, 0.0)
    rows = final.problem.y[axis] / final.likelihood.root[axis]
    solved = final.problem.solve()
    beyond = rows + final.problem.base[axis] @ solved.base / final.likelihood.root[axis]
    functions = selection.weighed.functions[axis]
    return AxisVerdict(
        verdict=verdict,
        effects=named,
        probabilities=dict(listed),
        unknown=unknown,
        rmse_before=before,
        rmse_after=after,
        rmse_beyond_bias=float(np.sqrt(np.mean(beyond**2))) if beyond.size else 0.0,
        noise_floor=level,
        noise_floor_sd=scatter,
        standing=against_floor,
        unit=final.evidence.system.torque_units[axis],
        force_rms=force,
        explained=max(0.0, 1.0 - (after / max(force, 1e-300)) ** 2),
        explainable_share=functions.share_before if functions else 0.0,
        explainable_after=functions.share if functions else 0.0,
        explained_by_effects=max(0.0, 1.0 - left / max(excess, 1e-300)) if named else 0.0,
        remains=bool(remains),
        sentence="",
    )


def noise_floor(fit: Fit) -> NoiseFloor:
    """The error of replays of a fitted model, which lacks nothing, by axis, N.m or N."""
    squares = [np.mean(r**2, axis=1) for r in fit.likelihood.noise.residuals]
    return NoiseFloor.of_errors(list(np.sqrt(np.array(squares)).T))


_BEYOND_MODELS = 3.0
"""Scale of the noise, in units of sensors, filters and the discrepancy of any model together."""


def _exceeds_any_model(fit: Fit, axis: int) -> bool:
    """Whether an axis leaves more than sensors, filters and the discrepancy of any model explain."""
    solved = fit.problem.solve()
    return bool(np.sqrt(solved.left[axis] / fit.problem.count[axis]) > _BEYOND_MODELS)


def effect_axes(initial: Fit, final: Fit, effect: str) -> tuple[int, ...]:
    """Axes on which an effect changes the equation."""
    model = final if effect in final.recipe.effects else None
    if model is not None:
        system = model.evidence.system
        item = next(i for i in system.model.effects if i.name == effect)
    else:
        candidate = candidates_of(initial.recipe, (effect,))[0]
        system, item = candidate.system, candidate.system.model.effects[-1]
    axes = tuple(system.coordinates.index(a) for a in item.axes)
    if axes:
        return axes
    alone = candidates_of(initial.recipe, (effect,))[0].system
    return tuple(range(len(system.coordinates))) if alone.moves_sensors else tuple(alone.touched)
