"""Starting values of an identification: shapes of effects, and the width of the smoothed sign.

A machine may yield over the speeds that its device file declares, or stop completely. On a test
bench, nothing is integrated along the sign, so that held-out trials can choose the width.
"""

from dataclasses import dataclass, replace

import numpy as np

from bampipe.arrays import Array
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.select import open_search, start_of
from bampipe.diagnosis.session import Fit, Session, system_of
from bampipe.diagnosis.set_cost import effect_names, removed_effects
from bampipe.physics.model_spec import ModelSpec
from bampipe.trials.measured import MeasuredTrials

_ANY_SIZE = 1e-9
_REPLICATES = 6
_STOPPING_FACTOR = 0.125
"""Factor on the width that reveals a machine that stops. If the model lacks friction that rises as
the speed falls, a third of the width may be likelier on a machine that yields, an eighth is not."""
_NARROW_FACTORS = (1.0 / 3.0, _STOPPING_FACTOR, 1.0 / 32.0)
LEAST_DROP = 0.03
"""Smallest drop of the log error for a narrower width: `benchmarks/chosen_sign_width.py`."""


def search_start(trials: MeasuredTrials, spec: ModelSpec) -> Array:
    """Return starting values of the parameters of a model within their bounds, (n_p,).

    The device's parameters are fitted from their priors. The shapes of effects are searched over
    their ranges as in a diagnosis, since a descent from the prior would end in the nearest minimum.
    """
    session = Session(trials, Criteria(size=_ANY_SIZE, replicates=_REPLICATES))
    current, left = replace(spec, effects=()), spec.effects
    fit = _fit(
        session, current, session.fit_plainly(current, system_of(current).prior).linearisation.p
    )
    while left:
        with open_search(session, fit, only=left) as search:
            every = (s for beam in search.grow_sets(len(left)) for s in beam)
            sets = [s for s in every if not removed_effects(s[1])]
            keys = min(sets, key=lambda s: (-len(s[1]), s[0]))[1] if sets else ()
            found = effect_names(keys) or left[:1]
            current = replace(current, effects=(*current.effects, *found))
            start = start_of(search, keys, current)
        fit, left = _fit(session, current, start), tuple(e for e in left if e not in found)
    known = fit.linearisation.system.by_name(fit.linearisation.p)
    return np.array([known[q.name] for q in system_of(spec).parameters])


def _fit(session: Session, spec: ModelSpec, start: Array) -> Fit:
    """Fit a model with noise from replicates, or with equal noise if it cannot be simulated."""
    return session.try_fit(spec, start) or session.fit_plainly(spec, start)


@dataclass(frozen=True)
class SignWidth:
    """The chosen width of the sign in Coulomb friction.

    Attributes:
        factor: its ratio to the declared width, at most 1.
        declared, chosen: held-out errors with either width, (n_q,), N.m or N.
    """

    factor: float
    declared: Array
    chosen: Array


def choose_sign_width(trials: MeasuredTrials, spec: ModelSpec) -> SignWidth:
    """Choose the width for a model by the held-out error of least squares.

    Raises:
        ValueError: the trials are too short to be fitted.
    """
    fits = {
        1.0: fit_width(trials, spec, 1.0),
        _STOPPING_FACTOR: fit_width(trials, spec, _STOPPING_FACTOR),
    }
    declared = fits[1.0].held_out_rmse
    count = fits[1.0].problem.independent

    def drop(factor: float) -> float:
        ratio = np.log(declared / np.maximum(fits[factor].held_out_rmse, 1e-300))
        return float(count @ ratio / max(count.sum(), 1.0))

    if not drop(_STOPPING_FACTOR) > LEAST_DROP:
        return SignWidth(1.0, declared, declared)
    fits |= {f: fit_width(trials, spec, f) for f in _NARROW_FACTORS if f not in fits}
    best = max(_NARROW_FACTORS, key=drop)
    return SignWidth(best, declared, fits[best].held_out_rmse)


def fit_width(trials: MeasuredTrials, spec: ModelSpec, factor: float) -> Fit:
    """Fit a model with its sign widths multiplied by ``factor``."""
    narrowed = spec.with_sign_widths(factor)
    session = Session(trials, Criteria())
    return session.fit_plainly(narrowed, search_start(trials, narrowed))
