"""Candidates in the order of how well they explain what a model lacks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bampipe.discover.scorer import Scorer
from bampipe.discover.search import Search
from bampipe.physics.parameter import Parameter
from bampipe.physics.recipe import Recipe
from bampipe.results.diagnose import RankedEffect


def rank(search: Search, selected: Sequence[str]) -> list[RankedEffect]:
    """Selected effects with their groups, then the others by their score beyond chance.

    Selected effects are held against the model that they were added to, others against the model
    as given: what a second effect does may not show before the first is there. What was added and
    refused stands with what it did then, whatever its score had promised, unless it ran away. The
    parameters of selected ones are those of the final model, free of the bias that filters give.
    """
    names = (q.name for q in search.evidence.system.parameters)
    final = dict(zip(names, search.found.replayed, strict=True))
    order: list[str] = []
    for name in selected:
        order += [n for n in (name, *search.groups.get(name, ())) if n not in order]
    others = sorted(
        (n for n in search.first if n not in order),
        key=lambda n: -float(search.level.excess(search.first[n]).sum()),
    )
    initial, system = Scorer(search.initial), search.initial.system
    refused = {r.effect: r for r in search.refused}
    rows = []
    for name in [*order, *others]:
        if name not in search.first:
            continue
        score, scorer = search.first[name], initial
        excess, p_value = search.level.excess(score), search.level.p_value(score)
        if name in selected and name in search.additions:
            found = search.additions[name]
            score, scorer, excess, p_value = (
                found.score, found.scorer, found.excess, found.p_value,
            )  # fmt: skip
        axis = int(np.argmax(excess))
        before = scorer.evidence.held_out_rmse[axis]
        after = scorer.held_out_scale[axis] * score.error[axis]
        if name in refused:
            known = refused[name]
            axis = system.coordinates.index(known.axis)
            before = known.held_out_rmse_before
            after = after if known.held_out_rmse_after is None else known.held_out_rmse_after
        group = next(({g, *r} - {name} for g, r in search.groups.items() if name in (g, *r)), set())
        own = [q.name for q in _own_parameters(search.recipe, name)]
        scored = dict(zip(own, score.values, strict=True))
        rows.append(
            RankedEffect(
                effect=name,
                axis=system.coordinates[axis],
                held_out_rmse_before=before,
                held_out_rmse_after=after,
                unit=system.torque_units[axis],
                p_value=p_value,
                score=excess.sum(),
                parameters={n: final.get(n, value) for n, value in scored.items()},
                indistinguishable_from=tuple(sorted(group)),
            )
        )
    return rows


def _own_parameters(recipe: Recipe, name: str) -> tuple[Parameter, ...]:
    return replace(recipe, effects=(name,)).model().effects[0].parameters
