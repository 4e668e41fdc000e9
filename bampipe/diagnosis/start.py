"""Where an identification starts: the shapes of effects searched over their range."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.select import change_set, open_search, start_of
from bampipe.diagnosis.session import Fit, Session, system_of
from bampipe.physics.recipe import Recipe
from bampipe.trials.measured import MeasuredTrials

Array = NDArray[np.float64]

_ANY_SIZE = 1e-9
_REPLICATES = 6


def search_start(trials: MeasuredTrials, recipe: Recipe) -> Array:
    """Starting values of every parameter of a model, its effects taken one after the other.

    The device's parameters start at their priors and are fitted; the shape of each effect is
    searched over its range, where a descent from the prior would stay in the nearest valley.

    Args:
        trials: the measured trials; recipe: the model.

    Returns:
        (n_p,), within the bounds.
    """
    session = Session(trials, Criteria(size=_ANY_SIZE, replicates=_REPLICATES))
    current = replace(recipe, effects=())
    fit = _fit(session, current, session.fit_plainly(current, system_of(current).prior).evidence.p)
    for effect in recipe.effects:
        wider = change_set(current, [(effect, ())])
        with open_search(session, fit, only=(effect,)) as search:
            found = search.refine([(k,) for _, k in search.best_beside((), 1, shapes=3)], 4)
            keys = min(found, key=search.cost, default=None)
            start = start_of(search, keys or (), wider)
        current, fit = wider, _fit(session, wider, start)
    return fit.evidence.p


def _fit(session: Session, recipe: Recipe, start: Array) -> Fit:
    """A fit with the noise and the bias of its replays, without them where it runs away."""
    return session.try_fit(recipe, start) or session.fit_plainly(recipe, start)
