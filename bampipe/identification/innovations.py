"""Whether the filter's innovations are white and independent of the inputs, channel by channel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bampipe.arrays import Flags
from bampipe.estimate.innovations import (
    InnovationTest,
    average_stretches,
    check_independence,
    check_whiteness,
)
from bampipe.identification.filter_run import STRETCH_S, FilterRun
from bampipe.physics import System
from bampipe.results.identify import Independence, InnovationTests, Whiteness

_LAGS_S = (0.0, 0.25, 0.5)
"""Lags at which inputs are taken."""
WHITE_SHARE = 0.2
"""Share predictable from the past below which a channel counts as white."""
INPUT_SHARE = 0.05
"""Share predictable from the inputs below which a channel counts as independent of them."""
_SIGNIFICANT = 0.01


def innovation_tests(
    system: System,
    found: FilterRun,
    moving: Callable[[int], Flags],
) -> dict[str, InnovationTests]:
    """Return both tests for each position channel, and a sentence on each.

    Args:
        moving: of a trial, by its place, where each axis is clear of standstill and reversal,
            (T, n_q).
    """
    n, lags = len(system.coordinates), [round(lag / STRETCH_S) for lag in _LAGS_S]
    channels = [i for i, name in enumerate(system.inputs) if name != "t"]
    by_trial, inputs = [], []
    for place, trial in zip(found.order, found.trials, strict=True):
        clear = average_stretches(moving(place).astype(float), trial.stretch_samples) == 1.0
        by_trial.append(np.where(clear, trial.stretches[:, :n], np.nan))
        inputs.append(trial.inputs[:, channels])
    tests = {}
    for axis, name in enumerate(system.coordinates):
        records = [stretches[:, axis] for stretches in by_trial]
        own, driven = check_whiteness(records), check_independence(records, inputs, lags)
        tests[name] = InnovationTests(
            sentence=_sentence(own, driven),
            whiteness=Whiteness(**vars(own), white=not _fails(own, WHITE_SHARE)) if own else None,
            inputs=Independence(**vars(driven), independent=not _fails(driven, INPUT_SHARE))
            if driven
            else None,
        )
    return tests


def _fails(test: InnovationTest, limit: float) -> bool:
    return test.p_value < _SIGNIFICANT and test.share > limit


def _sentence(own: InnovationTest | None, driven: InnovationTest | None) -> str:
    """Say both outcomes in words."""
    if own is None or driven is None:
        return "Too little motion to test the innovations."
    past = f"{100.0 * own.share:.0f} % of their variance follows from their past"
    force = f"{100.0 * driven.share:.0f} % from the inputs"
    if not _fails(own, WHITE_SHARE) and not _fails(driven, INPUT_SHARE):
        return f"White and independent of the inputs: {past}, {force}; nothing points to a lack."
    if _fails(driven, INPUT_SHARE):
        return (
            f"Not independent of the inputs: {force}, {past}. The model answers the force wrongly: "
            "a delay, a gain, an inertia or what carries the load."
        )
    return (
        f"Not white: {past}, {force}. Something acts that the model lacks and that does not follow "
        "the force, such as friction of another shape."
    )
