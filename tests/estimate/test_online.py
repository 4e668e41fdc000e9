"""The online filter and its test of consistency."""

from dataclasses import replace

import numpy as np
import pytest
from slider import TRUTH, model, position_only, record, settings

from bampipe.estimate.consistency import WindowTest, find_threshold, window_means
from bampipe.estimate.online import OnlineFilter
from bampipe.estimate.unscented import filter_trials


def test_portions_do_not_matter() -> None:
    trial = position_only(record(6, 2.0))
    y = trial.y.copy()
    y[300:310] = np.nan
    trial = replace(trial, y=y)
    chosen = settings(walk_sd=0.01 * TRUTH)
    slider = model()
    mean, spread = slider.to_estimated(1.2 * TRUTH, TRUTH)
    batch = filter_trials(slider, [trial], mean, np.diag(spread**2), chosen)
    whole = batch.trials[0]
    rng = np.random.default_rng(1)
    online = OnlineFilter(slider, chosen, trial.x, trial.x_sd, mean, np.diag(spread**2))
    at, nis = 0, []
    while at < trial.t.size:
        part = slice(at, at + int(rng.integers(1, 40)))
        nis.append(online.advance(trial.t[part], trial.u[part], trial.y[part]).nis)
        at = part.stop
    np.testing.assert_allclose(online.mean, whole.mean[-1], rtol=1e-12, atol=1e-14)
    scale = np.sqrt(np.diag(whole.covariance[-1]))
    error = (online.covariance - whole.covariance[-1]) / np.outer(scale, scale)
    assert np.max(np.abs(error)) < 1e-12
    np.testing.assert_allclose(np.concatenate(nis), whole.nis, rtol=1e-9)


def test_thresholds_hold_and_windows_without_readings_are_wrong() -> None:
    rng = np.random.default_rng(2)
    samples, readings = 50, 3
    nis = np.sum(rng.normal(size=(200_000, readings)) ** 2, axis=1)
    means = window_means(nis, readings, samples)
    for good in (None, means[:200]):
        threshold = find_threshold(0.01, samples * readings, good)
        assert np.mean(means[200:] > threshold) == pytest.approx(0.01, abs=0.006)
    assert find_threshold(0.01, 60, np.full(3, 0.2)) == find_threshold(0.01, 60)
    nis = np.concatenate([np.full(10, 2.0), np.full(6, np.nan), np.full(4, 2.0), np.full(5, 9.0)])
    np.testing.assert_allclose(window_means(nis, 2, 10), [1.0])
    test = WindowTest(2, 10)
    squares = np.stack([nis / 2.0, nis / 2.0], axis=1)
    there = np.isfinite(squares)
    ones = [slice(k, k + 1) for k in range(25)]
    judged = [mean for k in ones for mean in test.take(nis[k], squares[k], there[k])]
    assert judged == pytest.approx([1.0])
    assert test.windows == 1
    np.testing.assert_allclose(test.by_reading, 1.0)
    test = WindowTest(2, 10)
    nis, squares = np.full(10, np.nan), np.full((10, 2), np.nan)
    there = np.zeros((10, 2), dtype=bool)
    there[:, 0] = True
    assert test.take(nis, squares, there) == [np.inf]
    assert test.useless.tolist() == [False, True]
