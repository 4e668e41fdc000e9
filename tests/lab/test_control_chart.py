"""Control limits: how often they cry wolf, and what they see."""

from typing import Any

import numpy as np
import pytest

from bampipe.lab.control_chart import (
    FALSE_ALARM,
    FEWEST_SESSIONS,
    MEDIAN_RANGE,
    find_factor,
    make_chart,
)
from bampipe.results.lab import ControlChart


def chart(estimates: Any, sds: Any) -> ControlChart:
    """The chart of sessions called by their numbers."""
    names = map(str, range(len(estimates)))
    return make_chart("bam", "mass", "kg", list(zip(names, estimates, sds, strict=True)))


def outside(estimates: Any, sds: Any) -> list[str]:
    return [one.session for one in chart(estimates, sds).points if one.outside_limits]


@pytest.mark.parametrize("sessions", [6, 9, 14, 30])
def test_the_factors_are_the_quantiles_they_claim_to_be(sessions: int) -> None:
    x = np.random.default_rng(3).normal(size=(2_000_000 // sessions, sessions))
    sigma = np.median(np.abs(np.diff(x, axis=1)), axis=1) / MEDIAN_RANGE
    distance = np.abs(x - np.median(x, axis=1, keepdims=True)) / sigma[:, None]
    share = float((distance > find_factor(sessions)).mean())
    # 5400 alarms are expected, and those of one lab come together: 6 % is well over their scatter
    assert share == pytest.approx(FALSE_ALARM, rel=0.06)
    assert find_factor(10_000) == pytest.approx(3.0, abs=0.002)


@pytest.mark.parametrize("within", [0.0, 1.0, 3.0])
def test_false_alarms_with_scatter_between_and_within(within: float) -> None:
    """Uncertainty within a session must not raise alarms, whatever its share of the scatter."""
    rng = np.random.default_rng(5)
    alarms = 0
    for _ in range(500):
        sds = within * rng.uniform(0.5, 1.5, size=12)
        alarms += len(outside(rng.normal(size=12) + sds * rng.normal(size=12), sds))
    assert alarms / (500 * 12) < 2.5 * FALSE_ALARM


def test_a_trend_a_step_and_one_session_off_are_seen() -> None:
    rng = np.random.default_rng(6)
    x = 4.0 + 0.02 * rng.normal(size=12)
    x[5] += 0.5
    assert outside(x, np.full(12, 0.002)) == ["5"]
    x[6] += 0.5
    assert outside(x, np.full(12, 0.002)) == ["5", "6"]
    x = np.array([4.0, 4.02, 3.98, 4.01, 3.99, 4.6, 4.0, 4.01])
    sds = np.full(8, 0.005)
    assert outside(x, sds) == ["5"]
    sds[5] = 0.3
    assert outside(x, sds) == []
    rng = np.random.default_rng(7)
    found = chart(np.linspace(4.0, 4.6, 15) + 0.01 * rng.normal(size=15), np.full(15, 0.005))
    assert found.drifts
    assert found.slope_per_session == pytest.approx(0.6 / 14, rel=0.05)
    assert found.points[0].outside_limits and found.points[-1].outside_limits
    x = np.where(np.arange(20) < 10, 0.99, 1.01) + 0.004 * np.sin(np.arange(20) * 2.1)
    assert outside(x, np.full(20, 0.01)) == []
    assert chart(x, np.full(20, 0.01)).run == ("0", "9")
    found = chart([1.0] * (FEWEST_SESSIONS - 2) + [9.0], [0.1] * (FEWEST_SESSIONS - 1))
    assert not found.has_limits and not any(one.outside_limits for one in found.points)
    found = chart([2.0] * 8, [0.0] * 8)
    assert outside([2.0] * 8, [0.0] * 8) == [] and not found.drifts and found.run is None
