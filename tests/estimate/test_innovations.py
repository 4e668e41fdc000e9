"""The tests of innovations: level and power on series whose nature is known."""

import numpy as np

from bampipe.estimate.innovations import average_stretches, check_independence, check_whiteness


def noise(seed: int, count: int = 600) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=count)


def hand(seed: int, count: int = 600) -> np.ndarray:
    """Three slow inputs, as a hand's."""
    steps = np.random.default_rng([seed, 1]).normal(size=(count, 3))
    slow = np.empty_like(steps)
    slow[0] = steps[0]
    for k in range(1, count):
        slow[k] = 0.95 * slow[k - 1] + steps[k]
    return slow


def test_white_noise_and_unrelated_inputs_pass() -> None:
    white, unrelated = [], []
    for seed in range(200):
        record = noise(seed)
        record[100:140] = np.nan
        white.append(check_whiteness([record[:300], record[300:]]).p_value)
        unrelated.append(check_independence([noise(seed)], [hand(seed)], (0, 5, 10)).p_value)
    assert all(3 <= np.sum(np.array(p) < 0.05) <= 20 for p in (white, unrelated))


def test_colour_and_inputs_that_leak_in_are_found() -> None:
    white = noise(1, 4000)
    coloured = white[1:] + 0.5 * white[:-1]
    test = check_whiteness([coloured])
    assert test.p_value < 1e-6
    assert abs(test.share - (0.5 / 1.25) ** 2) < 0.03
    given = hand(3, 2000)
    record = noise(3, 2000) + 0.3 * given[:, 1] / given[:, 1].std()
    test = check_independence([record], [given], (0, 5))
    assert test.p_value < 1e-6
    assert abs(test.share - 0.09 / 1.09) < 0.03


def test_too_little_gives_no_verdict_and_averages_are_missing_where_a_value_is() -> None:
    assert check_whiteness([noise(1, 50)]) is None
    assert check_independence([noise(1)], [np.ones((600, 2))], (0, 5)) is None
    assert check_independence([noise(1, 5)], [np.ones((5, 2))], (0, 10)) is None
    values = np.stack([np.arange(11.0), np.arange(11.0) ** 2], axis=1)
    values[4, 0] = np.nan
    np.testing.assert_array_equal(average_stretches(values, 3)[:, 0], [1.0, np.nan, 7.0])
    np.testing.assert_allclose(average_stretches(values, 3)[:, 1], [5 / 3, 50 / 3, 149 / 3])
