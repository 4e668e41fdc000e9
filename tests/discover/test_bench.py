"""The bench that a diagnosis works at."""

from __future__ import annotations

import numpy as np
import pytest
from sessions import bam, made

from bampipe.discover.bench import Bench
from bampipe.discover.settings import Settings


@pytest.mark.parametrize("jobs", [1, 2, 5])
def test_scores_come_in_one_order_for_any_number_of_jobs(jobs):
    names = tuple(f"effect{k}" for k in range(13))

    def pool(function, tasks):
        return ({name: f"score of {name}" for name in task.names} for task in tasks)

    bench = Bench(trials=made(bam(), {}), settings=Settings(jobs=jobs), pool=pool, names=names)
    assert list(bench.scores(bam(), np.zeros(7), names)) == list(names)
