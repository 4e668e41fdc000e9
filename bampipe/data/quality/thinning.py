"""Logs that are far faster than a mechanism: brought to a rate that holds all of its motion."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from bampipe.data.quality.table import CleanTrial

_HELD = 0.5
"""Share of readings that repeat the one before from which on a channel is a set-point that is held:
a low-pass would make a ramp of its steps."""
_HALF_LENGTH = 10
"""Samples that are kept on either side of the low-pass."""
_HALF_POWER, _KAISER = 1.04, 5.0
"""Cut-off over half the new rate at which half of the power passes there, of a Kaiser window: what
folds makes up for what is taken off, and white noise stays white, as sensors are taken to be."""


def thinning_factor(announced_hz: float, fastest_hz: float) -> int:
    """Every how many samples are kept of a log at ``announced_hz``; ``fastest_hz`` 0 keeps all.

    By the rate that the session announces, so that all of its trials are alike.
    """
    return max(1, int(announced_hz / fastest_hz + 1e-9)) if fastest_hz > 0.0 else 1


def thin(trial: CleanTrial, every: int, sampled: Collection[str]) -> CleanTrial:
    """Keep one sample of every few.

    Inputs go through a zero-phase low-pass at half the new rate first: noise from above it must not
    fold into what is kept. Positions, brake commands and set-points do not: counts stay counts, and
    steps steps.

    Args:
        trial: a sound trial; every: from `thinning_factor`.
        sampled: columns that are not low-passed in any case, beside positions and brakes.
    """
    if every == 1:
        return trial
    from scipy.signal import firwin, resample_poly  # slow to import, and for fast logs alone

    length = 2 * _HALF_LENGTH * every + 1
    low_pass = firwin(length, _HALF_POWER / every, window=("kaiser", _KAISER))
    columns = {
        name: values[::every].copy()
        if name.startswith(("q_", "brake_")) or name in sampled or _is_held(values)
        else resample_poly(values, 1, every, window=low_pass, padtype="edge")
        for name, values in trial.columns.items()
    }
    return replace(
        trial, t=trial.t[::every].copy(), columns=columns, sample_rate=trial.sample_rate / every
    )


def _is_held(values: np.ndarray) -> bool:
    """Whether readings (T,) are no signal that a low-pass may take: held, or with gaps."""
    return not np.isfinite(values).all() or float(np.mean(np.diff(values) == 0.0)) > _HELD
