"""Watched thresholds: they compare as numbers do, and note where each comparison would turn."""

from __future__ import annotations

import margins
import numpy as np
import pytest

from bampipe.discover.settings import Settings
from bampipe.results.standing import standing


@pytest.fixture
def worth():
    """The threshold ``worth``, 0.03, watched, and what is noted of it."""
    values, log = margins.watch_all()
    return values["worth"], log["worth"]


def test_what_is_compared_is_noted_whatever_its_type_and_side(worth):
    threshold, noted = worth
    assert 0.05 > threshold
    assert not threshold <= np.float64(0.02)
    assert (np.array([0.025, 0.04]) > threshold).tolist() == [False, True]
    assert noted.count == 4
    assert (noted.below, noted.above) == pytest.approx((0.025, 0.04))


@pytest.mark.parametrize(
    ("made", "value", "turn"),
    [
        (lambda w: 2.0 * w, 0.1, 0.05),
        (lambda w: np.float64(2.0) * w, 0.1, 0.05),
        (lambda w: w / 3.0, 0.02, 0.06),
        (lambda w: w + 1.0, 1.04, 0.04),
        (lambda w: np.float64(1.0) - w, 0.96, 0.04),
        (lambda w: -w, -0.05, 0.05),
    ],
)
def test_a_number_made_of_a_threshold_is_noted_in_units_of_the_threshold(worth, made, value, turn):
    threshold, noted = worth
    number = made(threshold)
    assert (number > value) == (float(made(margins.DEFAULTS["worth"])) > value)
    assert noted.count == 1
    assert noted.above == pytest.approx(turn)


def test_of_two_thresholds_each_is_noted_with_the_other_held():
    values, log = margins.watch_all()
    limit = max(values["worth"], values["carried"] * 0.2)  # 0.03 and 0.05
    assert 0.06 > limit
    assert log["worth"].above == pytest.approx(0.05)
    assert log["carried"].below == pytest.approx(0.15)
    assert log["carried"].above == pytest.approx(0.3)


def test_every_settings_and_standing_has_the_values_given_and_afterwards_its_own():
    assert standing(1.3, 1.0) == "above_floor"
    with margins.thresholds({"worth": 0.5, "AT_FLOOR": 1.4}):
        assert Settings(seed=3).worth == 0.5
        assert standing(1.3, 1.0) == "at_floor"
    assert Settings().worth == margins.DEFAULTS["worth"]
    assert standing(1.3, 1.0) == "above_floor"
