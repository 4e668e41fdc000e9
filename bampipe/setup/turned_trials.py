"""Trials in which a signal has the opposite sign to the other trials, so no set-up suits all."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.setup import search
from bampipe.setup.hypotheses import Correction, sign_correction
from bampipe.setup.plausibility import Plausibility, judge_setup
from bampipe.setup.robot_search import DRAWN_SAMPLES, DrawnSearch, is_drawn
from bampipe.setup.search import ALIKE, LEAST_GAIN, Finding, gain_of
from bampipe.trials.folds import Folds
from bampipe.trials.motion import Motion
from bampipe.trials.signals import Signals

_STEPS, _SAMPLES = 4, 4000


def find_turned_trials(
    system: System, motions: Sequence[Motion], band: Band, folds: Folds, signals: Signals
) -> dict[int, Finding]:
    """Find the minority of trials whose signs contradict the others, by inertia and friction.

    Each trial is fitted alone, so that parameters may differ between trials, as with different
    dampers. With many joints, the drawn bodies determine the signs.

    Returns:
        By number of the trial, the signs that are turned, and others that explain it as well.
    """
    fitted = folds.fitted_trials
    if len(fitted) < 2:
        return {}
    if len(system.coordinates) > search.MOST_AXES:
        if not is_drawn(system):
            return {}
        short = {k: search.shorten([motions[k]], DRAWN_SAMPLES) for k in fitted}
        return _find_by_drawn_bodies(
            {k: DrawnSearch(system, m, band, folds.subset([k]), signals) for k, m in short.items()}
        )

    def gain(own: Plausibility, other: Plausibility) -> float:
        found = gain_of(own, other, 0.0)
        worse = own if found > 0.0 else other
        return found if worse.error.max() >= search.SUSPICIOUS_ERROR else 0.0

    def fit(k: int, one: Correction | None = None) -> Plausibility | None:
        (motion,) = search.shorten([motions[k]], _SAMPLES)
        way = one.change.of_motion(motion, signals) if one else motion
        return judge_setup(system, [way], band, folds.subset([k]), _STEPS)

    stated = {k: own for k in fitted if (own := fit(k)) is not None}
    if all(own.error.max() < search.SUSPICIOUS_ERROR for own in stated.values()):
        return {}
    drives = [name for name in signals.inputs if name not in signals.brakes]
    options = [sign_correction(signals, [name]) for name in (*signals.axes, *drives)]
    fits = {
        k: [fit(k, one) or own.with_nothing_explained() for one in options]
        for k, own in stated.items()
    }
    gains = {k: np.array([gain(stated[k], one) for one in of]) for k, of in fits.items()}
    found: dict[int, list[tuple[float, int]]] = {}
    for place in range(len(options)):
        # The best sign for each trial, and those that are as good.
        against = [k for k, of in gains.items() if of[place] > max(LEAST_GAIN, of.max() - ALIKE)]
        along = [k for k, of in gains.items() if of[place] < -LEAST_GAIN]
        for k in min(against, along, key=len) if against and along else ():
            strength = float(np.mean([gains[j][place] for j in against]))
            found.setdefault(k, []).append((strength, place))
    result = {}
    for k, ways in sorted(found.items()):
        most, place = max(ways, key=lambda way: way[0])
        before, after = stated[k], fits[k][place]
        if gains[k][place] < 0.0:  # the other trials are reversed, not this one
            before, after = after, before
        alike = [options[at] for strength, at in ways if strength > most - ALIKE and at != place]
        result[k] = Finding(options[place], tuple(alike), before, after, most)
    return result


def _find_by_drawn_bodies(alone: Mapping[int, DrawnSearch]) -> dict[int, Finding]:
    """Find the few trials, each searched alone, in which a drive opposes bodies and friction."""
    against = {k: own.drives_against_bodies() for k, own in alone.items()}
    often = Counter(name for names in against.values() for name in names)
    found = {}
    for k, own in alone.items():
        if names := [name for name in against[k] if 2 * often[name] < len(alone)]:
            one = sign_correction(own.signals, names)
            before, after = own.judge(()), own.judge((one,))
            gain = gain_of(before, after, 0.0) if before and after else 0.0
            if before and after and gain > LEAST_GAIN:
                found[k] = Finding(one, (), before, after, gain)
    return found
