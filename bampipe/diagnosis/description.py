"""The shape of a residual in one sentence."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import gamma

from bampipe.arrays import Array
from bampipe.diagnosis.session import bounds_of
from bampipe.diagnosis.shape import (
    BINS,
    Variable,
    number_bins,
    residual_map,
    take_used,
    variables,
)
from bampipe.results.diagnose import ResidualMap
from bampipe.results.rounding import significant
from bampipe.trials.linearisation import Linearisation
from bampipe.trials.measured import trial_of_block

_VARIABLE, _MENTIONED = 0.2, 0.005
"""Smallest share of a residual's variance that a variable must explain to name its shape, and to be
mentioned if the residual is scattered."""
_RIPPLE = 0.5
"""Smallest part of that share that a sine must explain to be called a ripple."""
_ALIKE = 0.6
"""Correlation of the residuals in both directions of motion above which they are called the same,
or opposite if it is negative."""
_BUMP_HEIGHT, _BUMP_WIDTH = 0.5, 1.0 / 3.0
"""Share of the largest mean residual above which a bin belongs to a bump, and largest share of the
range that a bump covers; a wider one is a broad change."""
_CHANGED = 0.5
"""Share that values by trial must explain for something to have changed between the trials."""
_UNRECORDED = (
    ". Some condition that is not recorded changed between the trials, such as a current, a payload"
    " or a temperature: record it as a channel, or make one session for each of its values"
)
_SEEN = 0.01
"""Least information on a parameter in a trial, as a share of that in the trial with most, for its
value there to be mentioned."""
_SIGNIFICANT = 0.01
"""Probability of reporting a vibration that is not there."""


@dataclass(frozen=True)
class _Sine:
    """A sine fitted to a residual: share of variance, amplitude, cycles per unit of abscissa."""

    share: float
    amplitude: float
    frequency: float


def describe(linearisation: Linearisation, axis: int) -> str:
    """Return the shape of an axis' residual, by the variable that explains most of it."""
    every = variables(linearisation.fitted, linearisation.band, axis)
    known = [v for v in every if v.name not in ("trial", "direction")]
    maps = [residual_map(linearisation, axis, v, 3 * BINS) for v in known]
    best = int(np.argmax([m.variance_share for m in maps]))
    most, variable, share = maps[best], known[best], maps[best].variance_share
    unit = linearisation.system.torque_units[axis]
    by_trial, differs = _by_trial(linearisation, axis)
    if by_trial > max(share, _VARIABLE):
        said = f"{differs}; this explains {100 * by_trial:.0f} % of the residual's variance"
        return said + (_UNRECORDED if by_trial > _CHANGED else "")
    if share < _VARIABLE or variable.name == "time":
        vibration = _vibration(linearisation, axis)
        if vibration is not None and vibration.share > max(share, _VARIABLE):
            return (
                f"a vibration of {significant(vibration.amplitude, 2)} {unit} at "
                f"{vibration.frequency:.3g} Hz in time, independent of the motion; it explains "
                f"{100 * vibration.share:.0f} % of the residual's variance"
            )
    if share < _VARIABLE:
        return (
            f"scattered over all motions; of all variables, {variable.name} explains most, "
            f"{100 * share:.0f} %"
            if share >= _MENTIONED
            else "scattered over all motions and independent of all variables of the motion"
        )
    explains = f"{variable.name} explains {100 * share:.0f} % of the residual's variance"
    turning = _by_direction(linearisation, axis, variable)
    ripple = _ripple(linearisation, axis, variable)
    if ripple is not None and ripple.share > _RIPPLE * share:
        period = 1.0 / ripple.frequency
        return (
            f"a ripple of {significant(ripple.amplitude, 2)} {unit} along {variable.name} that "
            f"repeats every {period:.3g} {most.unit}, {turning}; {explains}"
        )
    return f"{_bumps(most, unit + ' near ' + variable.name)}, {turning}; {explains}"


def _by_trial(linearisation: Linearisation, axis: int) -> tuple[float, str]:
    """Return the parameter of the device whose values by trial would explain most of a residual.

    Each is fitted alone.

    Returns:
        The share of the residual's variance that it explains, 0 to 1, and the range of its values.
    """
    e, trials = linearisation, [trial_of_block(m.trial_id) for m in linearisation.motions]
    sums, names = e.sums, [*dict.fromkeys(trials)]
    own = [k for k, i in enumerate(e.free) if i < len(e.system.model.device.parameters)]
    moment, square = np.zeros((2, len(names), len(own)))
    rows = [names.index(trial) for trial in trials]
    np.add.at(moment, rows, -sums.xy[:, axis, own])
    np.add.at(square, rows, np.diagonal(sums.xx[:, axis], axis1=1, axis2=2)[:, own])
    p, low, high = (x[[e.free[k] for k in own]] for x in (e.p, *bounds_of(e.system)))

    def change(moment: Array, square: Array) -> tuple[Array, Array]:
        """Return the best values within their bounds, and the fall of the sum of squares."""
        step = np.clip(p - moment / np.maximum(square, 1e-300), low, high) - p
        return p + step, -(2.0 * moment + step * square) * step

    values, falls = change(moment, square)
    taken, alike = falls.sum(axis=0), change(moment.sum(axis=0), square.sum(axis=0))[1]
    taken[taken < 2.0 * alike] = 0.0  # one other value for all trials does most of it
    best = int(np.argmax(taken))
    parameter = e.system.parameters[e.free[own[best]]]
    known = square[:, best] >= _SEEN * square[:, best].max()
    values = values[known, best]
    total = float(sums.yy[:, axis].sum())
    ends = (
        f"{significant(values[k], 2)} {parameter.unit}".strip() + f" in {np.array(names)[known][k]}"
        for k in (int(np.argmin(values)), int(np.argmax(values)))
    )
    share = float(taken[best]) / max(total, 1e-300) if len(names) > 1 else 0.0
    return share, f"{parameter.name} differs between trials, from {' to '.join(ends)}"


def _bumps(most: ResidualMap, unit: str) -> str:
    center, mean = np.array(most.center), np.array(most.mean)
    strong = np.abs(mean) > _BUMP_HEIGHT * np.max(np.abs(mean))
    places = []
    for side in (strong & (mean < 0.0), strong & (mean > 0.0)):
        if side.any():
            weight = np.abs(mean[side])
            middle = float(np.average(center[side], weights=weight))
            peak = mean[side][int(np.argmax(weight))]
            places.append((middle, f"{peak:+.2g} {unit} {middle:.3g} {most.unit}".strip()))
    places.sort()
    narrow = strong.sum() <= _BUMP_WIDTH * len(strong)
    form = "a bump of" if narrow else "a broad change,"
    if len(places) == 2:
        form = "opposite bumps of" if narrow else "a change of sign,"
    inside = center[strong]
    between = f"{inside.min():.3g} and {inside.max():.3g} {most.unit}".strip()
    return f"{form} {' and '.join(words for _, words in places)} (between {between})"


def _ripple(linearisation: Linearisation, axis: int, variable: Variable) -> _Sine | None:
    """Return the best sine along ``variable`` with at least two periods within its range."""
    v, r = take_used(linearisation, axis, variable)
    low, high = np.quantile(v, [0.01, 0.99])
    if high <= low:
        return None
    return _best_sine([(v, r)], np.arange(2.0, BINS, 0.1) / (high - low))


def _vibration(linearisation: Linearisation, axis: int) -> _Sine | None:
    """Return the best sine in time, or None if chance could give one as strong.

    The share of noise at one frequency is a sum of one exponential variate per trial (Lomb 1976).
    """
    band = linearisation.band
    trials = []
    for k, motion in enumerate(linearisation.motions):
        use = linearisation.used[k][:, axis] > 0
        if use.sum() > 2 * BINS:
            t = motion.t[band.thinned_rows(len(motion.t))][use]
            trials.append((t, linearisation.residual[k][use, axis]))
    if not trials:
        return None
    longest = max(float(np.ptp(t)) for t, _ in trials)
    tried = np.arange(2.0 / longest, band.cutoff_hz[axis], 0.25 / longest)
    best = _best_sine(trials, tried)
    by_chance = gamma.isf(_SIGNIFICANT / max(len(tried), 1), len(trials))
    independent = 0.5 * sum(len(r) for _, r in trials) * band.independent_share[axis]
    return best if best.share * independent > by_chance else None


def _best_sine(trials: Sequence[tuple[Array, Array]], frequencies: Array) -> _Sine:
    """Return the best least-squares sine, with a phase and size of its own in each trial.

    ``trials`` are pairs of abscissa and residual, (T,) each (Lomb 1976).
    """
    centred = [(x, r - r.mean()) for x, r in trials]
    count = sum(len(r) for _, r in trials)
    total = max(sum(float(r @ r) for _, r in centred), 1e-30)
    best = _Sine(0.0, 0.0, 0.0)
    for frequency in frequencies:
        taken = squares = 0.0
        for x, r in centred:
            phase = 2.0 * np.pi * frequency * x
            columns = np.column_stack([np.sin(phase), np.cos(phase)])
            product = columns.T @ r
            weights = np.linalg.solve(columns.T @ columns + 1e-9 * np.eye(2), product)
            taken += float(product @ weights)
            squares += len(r) * float(weights @ weights)
        if taken > best.share * total:
            best = _Sine(taken / total, float(np.sqrt(squares / count)), float(frequency))
    return best


def _by_direction(linearisation: Linearisation, axis: int, variable: Variable) -> str:
    """Compare the residual in both directions of motion, in words."""
    r = np.concatenate([x[:, axis] for x in linearisation.residual])
    v = np.concatenate(variable.values)
    kept = [linearisation.band.thinned_rows(len(m.t)) for m in linearisation.motions]
    rate = np.concatenate([m.qd[k, axis] for m, k in zip(linearisation.motions, kept, strict=True)])
    which = number_bins(v, 3 * BINS)
    means = []
    for b in np.unique(which):
        up, down = r[(which == b) & (rate > 0.0)], r[(which == b) & (rate < 0.0)]
        if len(up) >= 4 and len(down) >= 4:
            means.append((up.mean(), down.mean()))
    if len(means) < 4:
        return "seen in one direction of motion only"
    varied = np.ptp(np.array(means), axis=0).all()
    likeness = float(np.corrcoef(np.array(means).T)[0, 1]) if varied else 0.0
    if likeness > _ALIKE:
        return "the same in both directions of motion, like a spring"
    if likeness < -_ALIKE:
        return "opposite in the two directions of motion, like friction"
    return "different in the two directions of motion"
