"""The fully augmented filter: the same where theory says so, close elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from plain_filters import filter_augmented
from slider import TRUTH, model, position_only, record, settings

from bampipe.estimate.unscented import Trial, filter_trials


def short(truth=TRUTH, samples: int = 200) -> Trial:
    trial = position_only(record(3, 1.0, truth=truth, resolution=1e-4))
    return Trial(trial.t[:samples], trial.u[:samples], trial.y[:samples], trial.x, trial.x_sd)


def test_equal_where_motion_and_measurement_are_linear() -> None:
    """Viscous friction alone, its coefficient and the mass known: all noise is linear."""
    known = np.array([4.0, 0.0, 2.0])
    linear = replace(
        model(known), free=np.zeros(0, dtype=np.int64), lower=np.zeros(0), upper=np.zeros(0)
    )
    y = short(known).y.copy()
    y[50:60] = np.nan
    trial = replace(short(known), y=y)
    chosen = settings(walk_sd=np.zeros(0), reading_sd=np.array([3e-5]))
    nothing = np.zeros(0), np.zeros((0, 0))
    whole = filter_augmented(linear, [trial], *nothing, chosen).trials[0]
    simple = filter_trials(linear, [trial], *nothing, chosen).trials[0]
    np.testing.assert_allclose(simple.mean, whole.mean, rtol=1e-9, atol=1e-12)
    scale = np.sqrt(np.einsum("ti,tj->tij", *2 * [np.diagonal(whole.covariance, 0, 1, 2)]))
    assert np.max(np.abs(simple.covariance - whole.covariance) / scale) < 1e-9
    np.testing.assert_allclose(simple.nis, whole.nis, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(simple.log_likelihood, whole.log_likelihood, rtol=1e-9)


def test_close_where_they_are_not() -> None:
    """With unknown parameters and Coulomb friction: within a tenth of the standard deviation."""
    slider = model()
    mean, spread = slider.to_estimated(1.05 * TRUTH, 0.1 * TRUTH)
    chosen = settings(reading_sd=np.array([3e-5]), walk_sd=1e-3 * TRUTH)
    both = [
        engine(slider, [short()], mean, np.diag(spread**2), chosen)
        for engine in (filter_trials, filter_augmented)
    ]
    sd = np.sqrt(np.diag(both[1].covariance))
    difference = np.abs(both[0].theta - both[1].theta) / sd
    assert np.all(difference < 0.1)
    assert np.max(difference) > 1e-9
    np.testing.assert_allclose(np.sqrt(np.diag(both[0].covariance)), sd, rtol=0.05)
