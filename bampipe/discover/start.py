"""Where an identification starts: effects searched over their range, not at their prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.candidates import build_candidate_model, compile_candidate
from bampipe.discover.chance import fit_trials, system_of
from bampipe.discover.scorer import Score, Scorer
from bampipe.physics.recipe import Recipe
from bampipe.physics.registry import device_from, effect_from
from bampipe.trials.evidence import Evidence
from bampipe.trials.measured import MeasuredTrials

Array = NDArray[np.float64]


def with_effect(recipe: Recipe, evidence: Evidence, score: Score) -> Array:
    """Parameters of ``recipe``, whose last effect is the one scored, from the narrower model.

    Args:
        recipe: the wider model.
        evidence: of the model without its last effect.
        score: of that effect on this evidence.

    Returns:
        (n_p,), within the bounds.
    """
    known = {q.name: v for q, v in zip(evidence.system.parameters, evidence.p, strict=True)}
    for i, shift in zip(evidence.free, score.shift, strict=False):
        known[evidence.system.parameters[i].name] += shift
    system = system_of(recipe)
    added = system.parameters[len(evidence.system.parameters) :]
    known |= {q.name: float(v) for q, v in zip(added, score.values, strict=True)}
    start = np.array([known[q.name] for q in system.parameters])
    lower = np.array([q.lower for q in system.parameters])
    upper = np.array([q.upper for q in system.parameters])
    return np.asarray(np.clip(start, lower, upper))


def without_effect(recipe: Recipe, evidence: Evidence) -> Array:
    """Parameters of ``recipe``, (n_p,), from the fit of a model that has more effects."""
    known = {q.name: v for q, v in zip(evidence.system.parameters, evidence.p, strict=True)}
    return np.array([known[q.name] for q in system_of(recipe).parameters])


def search_start(trials: MeasuredTrials, recipe: Recipe) -> Array:
    """Starting values of every parameter of a model, its effects taken one after the other.

    The device's parameters start at their priors and are fitted; each effect's shape is scanned
    over its range, where a descent from the prior would stay in the nearest valley.
    """
    bare = replace(recipe, effects=())
    evidence = fit_trials(trials, bare, system_of(bare).prior)
    device = device_from(recipe.device)
    extra = [effect_from(e) for e in recipe.extra]
    for count, name in enumerate(recipe.effects, start=1):
        wider = replace(recipe, effects=recipe.effects[:count])
        model = build_candidate_model(device, name, extra, recipe.effects[: count - 1])
        score = Scorer(evidence).score(compile_candidate(model))
        if score is None:
            prior = np.array([q.prior for q in system_of(wider).parameters])
            prior[: len(evidence.p)] = evidence.p
            start = prior
        else:
            start = with_effect(wider, evidence, score)
        evidence = fit_trials(trials, wider, start)
    return evidence.p
