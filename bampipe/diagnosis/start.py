"""Where an identification starts: the shapes of effects searched over their range."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bampipe.arrays import Array
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.search import gone, names
from bampipe.diagnosis.select import open_search, start_of
from bampipe.diagnosis.session import Fit, Session, system_of
from bampipe.physics.recipe import Recipe
from bampipe.trials.measured import MeasuredTrials

_ANY_SIZE = 1e-9
_REPLICATES = 6


def search_start(trials: MeasuredTrials, recipe: Recipe) -> Array:
    """Starting values of every parameter of a model.

    The device's parameters start at their priors and are fitted; the shapes of the effects are
    searched over their range as a diagnosis does, all of them together as far as each has a
    strength beside the others: a descent from the prior would stay in the nearest valley.

    Args:
        trials: the measured trials; recipe: the model.

    Returns:
        (n_p,), within the bounds.
    """
    session = Session(trials, Criteria(size=_ANY_SIZE, replicates=_REPLICATES))
    current, left = replace(recipe, effects=()), recipe.effects
    fit = _fit(session, current, session.fit_plainly(current, system_of(current).prior).evidence.p)
    while left:
        with open_search(session, fit, only=left) as search:
            sets = [s for beam in search.beam(len(left)) for s in beam if not gone(s[1])]
            keys = min(sets, key=lambda s: (-len(s[1]), s[0]))[1] if sets else ()
            found = names(keys) or left[:1]
            current = replace(current, effects=(*current.effects, *found))
            start = start_of(search, keys, current)
        fit, left = _fit(session, current, start), tuple(e for e in left if e not in found)
    known = {q.name: v for q, v in zip(fit.evidence.system.parameters, fit.evidence.p, strict=True)}
    return np.array([known[q.name] for q in system_of(recipe).parameters])


def _fit(session: Session, recipe: Recipe, start: Array) -> Fit:
    """A fit with the noise and the bias of its replays, without them where it runs away."""
    return session.try_fit(recipe, start) or session.fit_plainly(recipe, start)
