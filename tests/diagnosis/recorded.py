"""Sessions that several tests of the diagnosis share."""

from collections.abc import Callable

import pytest
from independent_runs import record_trials
from sessions import take_timing_off

from bampipe.physics.model_spec import ModelSpec
from bampipe.trials.measured import MeasuredTrials

Recorded = tuple[MeasuredTrials, ModelSpec]


@pytest.fixture(scope="session")
def record(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Recorded]:
    """Record a session of an independent simulator, the timing of its inputs taken off; once."""
    known: dict[tuple[object, ...], Recorded] = {}

    def recorded(machine: str, seed: int, *effects: str, **conditions: object) -> Recorded:
        key = (machine, seed, effects, *sorted(conditions.items()))
        if key not in known:
            root = tmp_path_factory.mktemp(machine)
            trials, spec, _ = record_trials(root, machine, seed, *effects, **conditions)
            known[key] = take_timing_off(trials, spec), spec
        return known[key]

    return recorded
