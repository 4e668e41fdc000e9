"""Wild readings: one sample or two far off, between readings that go on as if nothing had been."""

from __future__ import annotations

import numpy as np

from bampipe.data.quality.channels import fill_missing, take_out
from bampipe.data.quality.table import TrialTable

POSITION, INPUT = (0.95, 20.0), (0.5, 40.0)
"""A reading is wild this many times farther from its neighbours than so large a share of the
readings is. What a position does between three samples is curvature, which has its extremes; an
input jumps with the friction of every reversal, and its median tells its noise."""
_CALM = 0.05
"""Share of that by which its neighbours may change their pace: a machine at a stop turns round, and
the kick of a controller leaves its drive unsteady."""
_LONGEST = 2
"""Samples of one spike, the most."""
_ROUNDING = 1e-6
"""Share of the range below which a change is no step of the sensor."""


def find_spikes(values: np.ndarray, rule: tuple[float, float]) -> np.ndarray:
    """Tell which readings are wild.

    Args:
        values: (T,) finite readings; rule: `POSITION` or `INPUT`.

    Returns:
        (T,) bool.
    """
    wild = np.zeros(values.size, dtype=bool)
    if values.size < _LONGEST + 4:
        return wild
    share, far = rule
    changes = np.abs(np.diff(values))
    changes = changes[changes > _ROUNDING * np.ptp(values)]
    step = float(changes.min()) if changes.size else 0.0
    for width in range(1, _LONGEST + 1):
        end = values.size
        before, after = values[1 : end - width - 2], values[width + 2 : end - 1]
        pace = (after - before) / (width + 1)
        off = np.stack(
            [values[2 + k : end - width - 1 + k] - before - (k + 1) * pace for k in range(width)]
        )
        least = np.abs(off).min(axis=0)
        turn = np.maximum(
            np.abs(pace - before + values[: end - width - 3]),
            np.abs(pace - values[width + 3 :] + after),
        )
        limit = far * max(float(np.quantile(least, share)), 0.5 * step)
        one_sided = np.abs(np.sign(off).sum(axis=0)) == width
        starts = 2 + np.flatnonzero(one_sided & (least > limit) & (turn < _CALM * least))
        for k in range(width):
            wild[starts + k] = True
    return wild


def interpolate_spikes(table: TrialTable) -> None:
    """Take wild readings of positions and inputs out and interpolate them, where they are few."""
    rules = {encoder.column: POSITION for encoder in table.session.encoders}
    rules |= dict.fromkeys(table.inputs, INPUT)
    some = False
    for column, rule in rules.items():
        values = table.columns[column]
        wild = find_spikes(values, rule)
        if 0 < wild.sum() <= table.limits.nan_share * len(values):
            some = True
            take_out(table, column, wild)
    if some:
        fill_missing(table)
