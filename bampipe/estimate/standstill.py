"""Where an axis stands still, and which samples therefore tell nothing about friction.

At standstill Coulomb friction is whatever balances the load, and the sign of the velocity is noise.
"""

import numpy as np

from bampipe.arrays import Array, Flags
from bampipe.estimate.low_pass import Band

REST_S = 0.03
"""A rest is longer than this, s, beyond what a change of direction takes by itself."""
REST_SPEED = 5.0
"""Speed below which an axis may rest, in standard deviations of the velocity."""
_RINGING_SPEED = 10.0
"""The same where a smoothed velocity rings, as it does at a stop: to and fro, where a machine that
turns round does so once. So does one whose brake is commanded, however shortly: the brake may hold
the axis for a moment at each reversal, and what it holds then is a hundred times the friction."""
_REACH = 0.02
"""Share that a rest may have in a low-passed sample before the sample is left out."""


def find_standstill(qd: Array, qd_sd: Array, rate_hz: float, braked: Flags | None = None) -> Flags:
    """Tell where an axis stands still.

    An axis rests where its velocity stays within five of its standard deviations, where its sign
    is noise, for longer than 0.03 s beyond what it takes to turn round; from the first to the last
    of several changes of sign within ten, for as long; where its brake is on, within ten, however
    shortly. How friction builds up in a slow turn is seen nowhere else.

    Args:
        qd: (T, n_q) velocity; qd_sd: (T, n_q) or (n_q,) its standard deviation; rate_hz: of the
            samples.
        braked: (n_q,) axes whose brake is commanded in this trial; none by default.

    Returns:
        (T, n_q).
    """
    slow = REST_SPEED * np.broadcast_to(qd_sd, qd.shape)
    ringing = _RINGING_SPEED * np.broadcast_to(qd_sd, qd.shape)
    still = np.zeros(qd.shape, dtype=bool)
    longest = int(REST_S * rate_hz)
    for column, v, limit, loose in zip(still.T, qd.T, slow.T, ringing.T, strict=True):
        for start, end in [*find_runs(np.abs(v) < limit), *_ringing(v, loose)]:
            if end - start - _turning(v, limit, start, end) > longest:
                column[start:end] = True
    if braked is not None:
        still |= (np.abs(qd) < ringing) & braked
    return still


def find_turns(qd: Array, rate_hz: float) -> Flags:
    """Tell where an axis turns round: within `REST_S` of a change of the velocity's sign.

    Args:
        qd: (T, n_q) velocity; rate_hz: of the samples.

    Returns:
        (T, n_q).
    """
    near, turns = round(REST_S * rate_hz), np.zeros(qd.shape, dtype=bool)
    for column, v in zip(turns.T, qd.T, strict=True):
        for last in np.flatnonzero(np.diff(np.sign(v))):
            column[max(last - near, 0) : last + near + 2] = True
    return turns


def find_runs(chosen: Flags) -> list[tuple[int, int]]:
    """First sample and the one after the last of every run of chosen samples."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], chosen.astype(int), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _ringing(v: Array, limit: Array) -> list[tuple[int, int]]:
    """Where a velocity (T,) within a limit (T,) goes to and fro.

    From the sample before the first change of sign to the one after the last.
    """
    found = []
    for start, end in find_runs(np.abs(v) < limit):
        turns = start + np.flatnonzero(np.diff(np.sign(v[start:end])))
        if len(turns) > 1:
            found.append((int(turns[0]), int(turns[-1]) + 2))
    return found


def _turning(v: Array, limit: Array, start: int, end: int) -> float:
    """Samples that a change of direction takes from ``-limit`` to ``limit``, of ``start:end``.

    At the acceleration of the same time before and after; zero where the velocity (T,) does not
    change its sign, where it is not known well enough to say so, or where the trial begins or ends.
    """
    length = end - start
    before, after = start - 1 - length, end + length
    if before < 0 or after >= len(v) or v[start - 1] * v[end] >= 0.0:
        return 0.0
    slow = float(limit[start:end].mean())
    # A steady turn comes from three times the limit, and goes to it.
    if min(v[before] * np.sign(v[start - 1]), v[after] * np.sign(v[end])) < 2.0 * slow:
        return 0.0
    outside = abs(v[start - 1] - v[before]) + abs(v[after] - v[end])
    return 4.0 * slow * length / max(outside, 1e-30)


def find_moving_samples(rest: Flags, band: Band) -> Flags:
    """Tell which low-passed, thinned samples no rest reaches into.

    Args:
        rest: (T, n_q) from `find_standstill`; band: the low-pass.

    Returns:
        (K, n_q).
    """
    reached = np.abs(band.thin(rest.astype(float))) >= _REACH
    # The response to a rest rings: where it passes zero between two lobes the rest acts, too.
    reached[1:-1] |= reached[:-2] & reached[2:]
    return ~reached
