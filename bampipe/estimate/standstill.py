"""Detection of standstill, where samples contain no information about friction.

At standstill, Coulomb friction balances any load, and the sign of the velocity is noise.
"""

import numpy as np

from bampipe.arrays import Array, Flags, find_runs
from bampipe.estimate.low_pass import Band

REST_S = 0.03
"""Time by which a rest lasts longer than a reversal, s."""
REST_SPEED = 5.0
"""Speed below which an axis may rest, in standard deviations of the velocity."""
_RINGING_SPEED = 10.0
"""The same for a smoothed velocity that rings, as it does at a stop: it changes sign several times,
whereas at a reversal it does so once. This limit also applies, for any duration, under a commanded
brake, which may hold the axis for a moment at each reversal with a hundred times the friction."""
_REACH = 0.02
"""A low-passed sample is left out if rests have a larger weight in it."""


def find_standstill(qd: Array, qd_sd: Array, rate_hz: float, braked: Flags | None = None) -> Flags:
    """Find the samples (T, n_q) at which an axis stands still.

    An axis rests while its velocity ``qd`` stays within five of its standard deviations ``qd_sd``,
    (T, n_q) or (n_q,), where its sign is noise, for at least 0.03 s longer than a reversal takes.
    It also rests between the first and the last of several changes of sign within ten standard
    deviations, if they last as long; and, if its brake is commanded in this trial (``braked``,
    (n_q,)), within ten for any duration. Slow reversals are kept, because only they show how
    friction builds up.
    """
    slow = REST_SPEED * np.broadcast_to(qd_sd, qd.shape)
    ringing = _RINGING_SPEED * np.broadcast_to(qd_sd, qd.shape)
    still = np.zeros(qd.shape, dtype=bool)
    longest = int(REST_S * rate_hz)
    for column, v, limit, loose in zip(still.T, qd.T, slow.T, ringing.T, strict=True):
        runs = zip(*find_runs(np.abs(v) < limit), strict=True)
        for start, end in (*runs, *_ringing(v, loose)):
            if end - start - _turning(v, limit, start, end) > longest:
                column[start:end] = True
    if braked is not None:
        still |= (np.abs(qd) < ringing) & braked
    return still


def find_turns(qd: Array, rate_hz: float) -> Flags:
    """Find samples within `REST_S` of a reversal of a velocity (T, n_q); return (T, n_q)."""
    near, turns = round(REST_S * rate_hz), np.zeros(qd.shape, dtype=bool)
    for column, v in zip(turns.T, qd.T, strict=True):
        for last in np.flatnonzero(np.diff(np.sign(v))):
            column[max(last - near, 0) : last + near + 2] = True
    return turns


def _ringing(v: Array, limit: Array) -> list[tuple[int, int]]:
    """Find runs in which a velocity (T,) within a limit (T,) oscillates, sign changes included."""
    found = []
    for start, end in zip(*find_runs(np.abs(v) < limit), strict=True):
        turns = start + np.flatnonzero(np.diff(np.sign(v[start:end])))
        if len(turns) > 1:
            found.append((int(turns[0]), int(turns[-1]) + 2))
    return found


def _turning(v: Array, limit: Array, start: int, end: int) -> float:
    """Return the number of samples within ``start:end`` that a reversal takes within the limit.

    It is computed from the acceleration over equal times before and after. It is zero if the
    velocity (T,) does not change sign, or at the ends of a trial.
    """
    length = end - start
    before, after = start - 1 - length, end + length
    if before < 0 or after >= len(v) or v[start - 1] * v[end] >= 0.0:
        return 0.0
    slow = float(limit[start:end].mean())
    # In a steady reversal, the velocity exceeds twice the limit before and after.
    if min(v[before] * np.sign(v[start - 1]), v[after] * np.sign(v[end])) < 2.0 * slow:
        return 0.0
    outside = abs(v[start - 1] - v[before]) + abs(v[after] - v[end])
    return 4.0 * slow * length / max(outside, 1e-30)


def find_moving_samples(rest: Flags, band: Band) -> Flags:
    """Find the thinned samples (K, n_q) that no ``rest`` (T, n_q) affects through the low-pass."""
    reached = np.abs(band.thin(rest.astype(float))) >= _REACH
    # The response to a rest rings: samples near a zero between two lobes are affected, too.
    reached[1:-1] |= reached[:-2] & reached[2:]
    return ~reached
