"""Stretches over which a sensor reads one and the same value while the machine moves on."""

from __future__ import annotations

import numpy as np

from bampipe.data.quality.table import TrialTable, find_runs
from bampipe.results.ingest import DeadStretch

_SHORTEST_S = 0.1
_CHANCE = 1e-9
"""Of so long a run of equal readings, from the share of equal neighbours in the rest."""
_UNSTEADY = 0.1
"""Least share of changes that take back the one before: readings with noise, no set-points."""
_MOST = 0.2
"""Share of the trial beyond which such runs are steps of a command."""
_MOVES = 0.02
"""Share of its travel in the trial that some axis covers meanwhile."""


def note_dead_stretches(table: TrialTable) -> None:
    """Note where an input reads one value for longer than chance would have it."""
    positions = [table.columns[encoder.column] for encoder in table.session.encoders]
    for column in table.inputs:
        for start, stop in find_equal_runs(table.columns[column], table.t):
            travel = [np.ptp(q[start:stop]) / max(float(np.ptp(q)), 1e-300) for q in positions]
            if max(travel, default=0.0) > _MOVES:
                first, last = float(table.t[start]), float(table.t[stop - 1])
                table.dead.append(DeadStretch(column=column, start_s=first, end_s=last))


def find_equal_runs(values: np.ndarray, t: np.ndarray) -> list[tuple[int, int]]:
    """First and the one after the last sample of runs of equal readings that chance does not give.

    Args:
        values: (T,) readings; t: (T,) time stamps, s.
    """
    changes = np.diff(values)
    moved = changes[changes != 0.0]
    # A set-point goes on the way it went, and an input at its limit stays there.
    if moved.size < 2 or np.mean(np.diff(np.sign(moved)) != 0.0) < _UNSTEADY:
        return []
    starts, stops = find_runs(changes == 0.0)
    stops = stops + 1
    long = t[stops - 1] - t[starts] >= _SHORTEST_S
    equal = int(np.sum((stops - starts - 1)[~long]))
    share = equal / max(equal + moved.size, 1)
    least = np.log(_CHANCE) / np.log(max(share, 1e-3)) if share < 1.0 else np.inf
    found = [
        (int(start), int(stop))
        for start, stop in zip(starts[long], stops[long], strict=True)
        if stop - start > least and not _at_limit(values, start, stop)
    ]
    return found if sum(stop - start for start, stop in found) < _MOST * values.size else []


def _at_limit(values: np.ndarray, start: int, stop: int) -> bool:
    """Whether a run is at the highest or lowest reading, which others have, too."""
    here = values[start]
    if here not in (values.min(), values.max()):
        return False
    return int(np.sum(values == here)) > stop - start
