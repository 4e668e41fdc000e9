"""The search of one shape parameter: as near to the least cost as scores are compared."""

from __future__ import annotations

import numpy as np
import pytest

from bampipe.discover.parameter_scan import scan_parameters
from bampipe.discover.ranges import SearchRange


def scan(cost_of, by_ratio, least=0.002, most=0.12, count=np.inf):
    """Value and cost found, and how many values were tried."""
    tried = []

    def cost(values):
        tried.append(values[0])
        return cost_of(values[0]), np.ones((3, 1))

    found = scan_parameters(cost, [SearchRange(least, most, by_ratio)], np.inf, True, count)
    return found[0][0], found[1], len(tried)


@pytest.mark.parametrize("by_ratio", [True, False])
@pytest.mark.parametrize("best", [0.0047, 0.0163, 0.031, 0.087])
def test_a_sharp_minimum_is_found_to_a_unit_of_log_likelihood(by_ratio, best):
    """As that of a delay: a tenth beside it costs a hundred."""

    def cost_of(value):
        off = 10.0 * np.log(value / best)
        return 100.0 * off**2 / (1.0 + 0.1 * off**2)

    value, cost, tried = scan(cost_of, by_ratio)
    assert cost < 1.0
    assert value == pytest.approx(best, rel=0.01)
    assert tried <= 16


@pytest.mark.parametrize("by_ratio", [True, False])
@pytest.mark.parametrize("left", [0.2, 0.05, 0.01])
@pytest.mark.parametrize("best", [0.0032, 0.0163, 0.087])
def test_the_notch_of_an_effect_that_explains_all_is_found(by_ratio, left, best):
    """A quiet sensor: a delay that is right leaves a hundredth of what its absence leaves."""

    def cost_of(value):
        return 365.0 * np.log((value / best - 1.0) ** 2 + left**2)

    _, cost, tried = scan(cost_of, by_ratio, count=365.0)
    assert cost - cost_of(best) < 1.0
    assert tried <= 18


@pytest.mark.parametrize("by_ratio", [True, False])
def test_a_minimum_at_the_end_of_the_range_is_found_there(by_ratio):
    value, _, tried = scan(lambda value: -value, by_ratio)
    assert value == pytest.approx(0.12)
    assert tried <= 12


def test_a_cost_that_does_not_change_is_not_searched_long():
    assert scan(lambda _: 0.0, by_ratio=True)[2] <= 10
