"""Over which width the sign of a velocity is smoothed, as the trials themselves say.

A device file says over which speeds friction yields; a machine of its kind may truly stop. Where a
test bench gives the motion nothing is integrated along the sign, and any width will do: the one
with which trials that were left out are likeliest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.session import Fit, Session
from bampipe.diagnosis.start import search_start
from bampipe.physics.recipe import Recipe
from bampipe.trials.measured import MeasuredTrials

_STOPS = 0.125
"""Width, times the device's, of a machine that is nearer to a true stop than to its device file.
Friction that rises as the speed falls, where the model lacks it, can make a third of the width
likelier on a machine that does yield over all of it, but not an eighth."""
_NARROWER = (1.0 / 3.0, _STOPS, 1.0 / 32.0)
WORTH = 0.03
"""Least drop of the log error for a narrower width: `benchmarks/chosen_sign_width.py`."""


@dataclass(frozen=True)
class SignWidth:
    """A width and what it does.

    Attributes:
        factor: times the device's; 1 where nothing speaks for a narrower one.
        declared, chosen: error on trials left out with either, by axis, (n_q,), N.m or N.
    """

    factor: float
    declared: Array
    chosen: Array


def choose_sign_width(trials: MeasuredTrials, recipe: Recipe) -> SignWidth:
    """Choose the width for a model by least squares on trials left out.

    Raises:
        ValueError: the trials are too short to be fitted.
    """
    fits = {1.0: fit_width(trials, recipe, 1.0), _STOPS: fit_width(trials, recipe, _STOPS)}
    declared = fits[1.0].held_out_rmse
    count = fits[1.0].problem.independent

    def drop(factor: float) -> float:
        ratio = np.log(declared / np.maximum(fits[factor].held_out_rmse, 1e-300))
        return float(count @ ratio / max(count.sum(), 1.0))

    if not drop(_STOPS) > WORTH:
        return SignWidth(1.0, declared, declared)
    for factor in _NARROWER:
        if factor not in fits:
            fits[factor] = fit_width(trials, recipe, factor)
    best = max(_NARROWER, key=drop)
    return SignWidth(best, declared, fits[best].held_out_rmse)


def fit_width(trials: MeasuredTrials, recipe: Recipe, factor: float) -> Fit:
    """Fit a model with its widths times ``factor``."""
    narrowed = recipe.with_sign_widths(factor)
    session = Session(trials, Criteria())
    return session.fit_plainly(narrowed, search_start(trials, narrowed))
