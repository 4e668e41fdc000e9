"""Wild readings: one sample or two far off, between readings that go on as if nothing had been."""

from __future__ import annotations

import numpy as np

from bampipe.data.quality.channels import fill_missing
from bampipe.data.quality.table import TrialTable, counted

_FAR = 20.0
"""A reading is wild this many times farther off than all but one in twenty are: some fifty standard
deviations of white noise."""
_CALM = 0.25
"""Share of that by which its neighbours may change their pace: a hit at a stop turns them round."""
_LONGEST = 2
"""Samples of one spike, the most."""


def find_spikes(values: np.ndarray, step: float = 0.0) -> np.ndarray:
    """Tell which readings are wild.

    Args:
        values: (T,) finite readings; step: the least step of the sensor, 0 where it is unknown.

    Returns:
        (T,) bool.
    """
    wild = np.zeros(values.size, dtype=bool)
    for width in range(1, _LONGEST + 1):
        if values.size < width + 4:
            break
        inner, end = slice(2, values.size - width - 1), values.size
        # The reading before the spike, the one after it, and the pace on either side.
        before, after = values[1 : end - width - 2], values[width + 2 : end - 1]
        pace = (after - before) / (width + 1)
        parts = np.stack(
            [values[2 + k : end - width - 1 + k] - before - (k + 1) * pace for k in range(width)]
        )
        off = np.abs(parts).min(axis=0)
        limit = _FAR * max(float(np.quantile(off, 0.95)), step)
        turn = np.maximum(
            np.abs(pace - before + values[: end - width - 3]),
            np.abs(pace - values[width + 3 :] + after),
        )
        same_side = np.abs(np.sign(parts).sum(axis=0)) == width
        found = np.zeros(values.size, dtype=bool)
        found[inner] = same_side & (off > limit) & (turn < _CALM * off) & (limit > 0.0)
        for k in range(width):
            wild[k:] |= found[: end - k]
    return wild


def interpolate_spikes(table: TrialTable) -> None:
    """Take wild readings of positions and forces out and interpolate them, where they are few."""
    session = table.session
    steps = {encoder.column: float(encoder.counts) for encoder in session.encoders}
    steps |= dict.fromkeys(session.force.columns if session.force is not None else (), 0.0)
    some = False
    for column, step in steps.items():
        values = table.columns[column]
        wild = find_spikes(values, step)
        if 0 < wild.sum() <= table.limits.nan_share * len(values):
            some = True
            values[wild] = np.nan
            words = counted(int(wild.sum()), "wild reading")
            table.repairs.append(f"column '{column}': {words} taken out")
    if some:
        fill_missing(table)
