"""Where an axis stands still, and which samples therefore tell nothing about friction.

At standstill Coulomb friction is whatever balances the load, and the sign of the velocity is noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.low_pass import Band

Array = NDArray[np.float64]

REST_S = 0.03
"""A change of direction is shorter than this, a rest is longer, s."""
REST_SPEED = 5.0
"""Speed below which an axis may rest, in standard deviations of the velocity."""
_BRAKED_SPEED = 10.0
"""The same where a brake is commanded: it may hold the axis for a moment at each reversal, and what
it holds then is a hundred times the friction. A smoothed velocity rings at such a stop."""
_REACH = 0.02
"""Share that a rest may have in a low-passed sample before the sample is left out."""


def find_standstill(
    qd: Array, qd_sd: Array, rate_hz: float, braked: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Tell where an axis stands still.

    An axis rests where its velocity stays within five of its standard deviations, where its sign
    is noise, for longer than 0.03 s; where its brake is on, within ten, however shortly.

    Args:
        qd: (T, n_q) velocity; qd_sd: (T, n_q) or (n_q,) its standard deviation; rate_hz: of the
            samples.
        braked: (n_q,) axes whose brake is commanded in this trial; none by default.

    Returns:
        (T, n_q).
    """
    still = np.abs(qd) < REST_SPEED * qd_sd
    longest = int(REST_S * rate_hz)
    for column in still.T:
        edges = np.flatnonzero(np.diff(np.concatenate([[0], column.astype(int), [0]])))
        for start, end in zip(edges[::2], edges[1::2], strict=True):
            column[start:end] = end - start > longest
    if braked is not None:
        still |= (np.abs(qd) < _BRAKED_SPEED * qd_sd) & braked
    return still


def find_moving_samples(rest: NDArray[np.bool_], band: Band) -> NDArray[np.bool_]:
    """Tell which low-passed, thinned samples no rest reaches into.

    Args:
        rest: (T, n_q) from `find_standstill`; band: the low-pass.

    Returns:
        (K, n_q).
    """
    return np.asarray(np.abs(band.thin(rest.astype(float))) < _REACH)
