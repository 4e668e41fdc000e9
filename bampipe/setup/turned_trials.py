"""Trials in which a sensor counts the other way than in the others: no set-up suits all of them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.setup.hypotheses import Correction, turned
from bampipe.setup.plausibility import Plausibility, judge_setup
from bampipe.setup.robot_search import DRAWN_SAMPLES, DrawnSearch, is_drawn
from bampipe.setup.search import (
    ALIKE,
    LEAST_GAIN,
    MOST_AXES,
    RANKED_ERROR,
    SUSPICIOUS_ERROR,
    gain_of,
    shorten,
)
from bampipe.trials.folds import Folds
from bampipe.trials.motion import Motion
from bampipe.trials.signals import Signals

_TOGETHER = 6
"""Trials that are held against each other at once, the most."""
_STEPS, _SAMPLES = 4, 4000
_ONE_AXIS = 3
"""Signals of a machine so small that signs wrong throughout are tried beside those of a trial."""


@dataclass(frozen=True)
class TurnedTrial:
    """A trial in which the readings of a signal have another sign than in those around it.

    Attributes:
        place: of the trial; corrections: any sets it right; of one signal, or a robot's drives.
        before, after: what its group shows as stated, and with all that was found in it.
    """

    place: int
    corrections: tuple[Correction, ...]
    before: Plausibility
    after: Plausibility


def find_turned_trials(
    system: System, motions: Sequence[Motion], band: Band, folds: Folds, signals: Signals
) -> list[TurnedTrial]:
    """Find them among the trials that are fitted; of many joints, drawn bodies must tell the signs.

    Where as many count one way as the other, those found are as right as the rest.
    """
    fitted = folds.fitted_trials
    if len(fitted) < 2:
        return []
    if len(system.coordinates) > MOST_AXES:
        drawn = is_drawn(system)
        return _by_drawn_bodies(system, motions, fitted, band, folds, signals) if drawn else []
    groups = -(-len(fitted) // _TOGETHER)
    parts = (fitted[start::groups] for start in range(groups))
    return [one for part in parts for one in _search(system, motions, part, band, folds, signals)]


def _by_drawn_bodies(
    system: System,
    motions: Sequence[Motion],
    fitted: Sequence[int],
    band: Band,
    folds: Folds,
    signals: Signals,
) -> list[TurnedTrial]:
    """Those in which a drive goes against its drawn bodies and friction, which it does in few."""
    alone = {
        k: DrawnSearch(
            system, shorten([motions[k]], DRAWN_SAMPLES), band, folds.subset([k]), signals
        )
        for k in fitted
    }
    against = {k: search.drives_against_bodies() for k, search in alone.items()}
    often = Counter(name for names in against.values() for name in names)
    found = []
    for k, search in alone.items():
        if names := [name for name in against[k] if 2 * often[name] < len(fitted)]:
            one = turned(signals, names)
            before, after = search.judge(()), search.judge((one,))
            if before and after and gain_of(before, after, 0.0) > LEAST_GAIN:
                found.append(TurnedTrial(k, (one,), before, after))
    return found


def _search(
    system: System,
    motions: Sequence[Motion],
    places: Sequence[int],
    band: Band,
    folds: Folds,
    signals: Signals,
) -> list[TurnedTrial]:
    """Of one group; where nothing is found as stated, under a sign that is wrong in all of it."""
    part, short = folds.subset(places), shorten([motions[k] for k in places], _SAMPLES)
    stated = judge_setup(system, short, band, part, _STEPS)
    if stated is None or stated.error.max() < SUSPICIOUS_ERROR:
        return []
    drives = [name for name in signals.inputs if name not in signals.brakes]
    options = [turned(signals, [name]) for name in (*signals.axes, *drives)]
    for start in (None, *options) if len(options) <= _ONE_AXIS else (None,):
        now = [start.change.of_motion(one, signals) for one in short] if start else list(short)
        best = judge_setup(system, now, band, part, _STEPS)
        found: dict[int, tuple[Correction, ...]] = {}
        while best is not None and len(found) < len(places) // 2:
            tried = []
            for at in (at for at in range(len(places)) if at not in found):
                for one in options:
                    changed = [*now[:at], one.change.of_motion(now[at], signals), *now[at + 1 :]]
                    after = judge_setup(system, changed, band, part, _STEPS)
                    if after is not None:
                        tried.append((after.score(RANKED_ERROR), at, one, after))
            if not tried:
                break
            least, at, one, after = min(tried, key=lambda each: each[0])
            if gain_of(best, after, 0.0) <= ALIKE:
                break
            alike = [c for score, k, c, _ in tried if k == at and score < least + ALIKE]
            found[at], best = (one, *(c for c in alike if c is not one)), after
            now[at] = one.change.of_motion(now[at], signals)
        if best is not None and found and gain_of(stated, best, 0.0) > LEAST_GAIN:
            return [TurnedTrial(places[at], any_of, stated, best) for at, any_of in found.items()]
    return []
