"""The unscented filter on a slider with friction; filterpy is the oracle."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from slider import RESOLUTION, TRUTH, model, position_only, record, settings

from bampipe.estimate.differentiation import spline_curvature
from bampipe.estimate.filter_uncertainty import (
    at_block_ends,
    choose_block,
    climb,
    sandwich_covariance,
)
from bampipe.estimate.filterpy_engine import filter_trials_by_filterpy
from bampipe.estimate.unscented import FilterFailure, Trial, constrain, filter_trials


def run(trials, chosen, slider=None, start=TRUTH, sd=TRUTH, engine=filter_trials):
    slider = slider or model(start)
    mean, spread = slider.to_estimated(np.asarray(start), np.asarray(sd))
    return engine(slider, trials, mean, np.diag(spread**2), chosen)


def short(seed: int, samples: int = 150, observed: Sequence[int] = (0,)) -> Trial:
    trial = record(seed, 1.0).first(samples)
    trial = position_only(trial) if len(observed) == 1 else trial
    return replace(trial, curvature=spline_curvature(trial.t, trial.u))


@pytest.mark.parametrize(("observed", "factor"), [([0], 1.3), ([0], 2.0), ([0, 1], 2.0)])
def test_filterpy_gives_the_same_numbers(observed: list[int], factor: float) -> None:
    """From nearby, with velocities read too, and from far off, known hardly at all."""
    sd = np.array([RESOLUTION / np.sqrt(12.0), 3e-3])[observed]
    walk = np.array([0.1, 0.1, 0.05])
    chosen = settings(observed=np.array(observed), reading_sd=sd, walk_sd=walk)
    trials = [short(seed, observed=observed) for seed in (1, 2)]
    start, spread = factor * TRUTH, (factor - 1.0) * TRUTH
    late = replace(model(start), parameters=np.append(start, 4e-4))
    ours, theirs = (
        run(trials, chosen, late, start, spread, engine)
        for engine in (filter_trials, filter_trials_by_filterpy)
    )
    for a, b in zip(ours.trials, theirs.trials, strict=True):
        np.testing.assert_allclose(a.mean, b.mean, rtol=1e-8, atol=1e-10)
        scale = np.sqrt(np.einsum("ti,tj->tij", *2 * [np.diagonal(b.covariance, 0, 1, 2)]))
        assert np.max(np.abs(a.covariance - b.covariance) / scale) < 1e-8
        np.testing.assert_allclose(a.nis[1:], b.nis[1:], rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(a.log_likelihood[1:], b.log_likelihood[1:], rtol=1e-8)
    np.testing.assert_allclose(ours.theta, theirs.theta, rtol=1e-8)


def test_square_root_runs_where_the_covariance_is_lost() -> None:
    """Readings 1e-13 of the prior's spread: rounding makes the covariance indefinite.

    At which sample, and whether in one record or the next, is the processor's chance.
    """
    lost = 0
    chosen = settings(reading_sd=np.array([1e-11]), noise_sd=np.array([1e-2]))
    for seed in (3, 4, 6):
        fine = position_only(record(seed, 2.0, resolution=1e-11))
        trial = replace(fine, x_sd=np.array([100.0, 100.0]))
        try:
            run([trial], chosen, sd=0.1 * TRUTH, engine=filter_trials_by_filterpy)
        except FilterFailure as failure:
            assert "positive definiteness" in str(failure)
            lost += 1
        found = run([trial], chosen, sd=0.1 * TRUTH)
        value, _ = model().to_physical(found.theta)
        np.testing.assert_allclose(value, TRUTH, rtol=0.2)
    assert lost > 0


def with_idle(values):
    """The slider with further parameters, which do nothing."""
    slider, count = model(), TRUTH.size + values.size
    return replace(
        slider,
        parameters=np.concatenate([TRUTH, values, [0.0]]),
        free=np.arange(count),
        lower=np.concatenate([slider.lower, np.full(values.size, -np.inf)]),
        upper=np.full(count, np.inf),
    )


def test_more_sigma_points_than_one_call_takes() -> None:
    """Parameters beyond the three that matter: 87 points, in two calls of the model."""
    slider = with_idle(np.linspace(0.5, 1.5, 40 - TRUTH.size))
    value = 1.2 * slider.parameters[:-1]
    mean, spread = slider.to_estimated(value, 0.1 * value)
    chosen = settings(walk_sd=np.full(40, 0.01))
    ours, theirs = (
        engine(slider, [short(1, 40)], mean, np.diag(spread**2), chosen)
        for engine in (filter_trials, filter_trials_by_filterpy)
    )
    np.testing.assert_allclose(ours.theta, theirs.theta, rtol=1e-9)
    np.testing.assert_allclose(ours.covariance, theirs.covariance, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("factor", [0.2, 5.0])
def test_recovers_from_a_wrong_start(factor: float) -> None:
    trials = [position_only(record(seed)) for seed in range(4)]
    start = factor * TRUTH
    found = run(trials, settings(), start=start, sd=np.maximum(start, TRUTH))
    value, _ = model().to_physical(found.theta)
    np.testing.assert_allclose(value, TRUTH, rtol=5e-3)


def test_intervals_cover_and_innovations_are_consistent() -> None:
    covered, nis = [], []
    for session in range(10):
        trials = [position_only(record(100 + 3 * session + k)) for k in range(3)]
        slider = model()
        mean, spread = slider.to_estimated(1.2 * TRUTH, 0.5 * TRUTH)
        found = filter_trials(slider, trials, mean, np.diag(spread**2), settings())
        nis.append(np.nanmean(np.concatenate([t.nis for t in found.trials])))
        ends = [at_block_ends(trial, 2.0) for trial in found.trials]
        covariance, blocks = sandwich_covariance(ends, 2, mean, np.diag(spread**2))
        value, slope = slider.to_physical(found.theta)
        sd = slope * np.sqrt(np.diag(covariance))
        covered.append(np.abs(value - TRUTH) < 1.96 * sd)
        assert blocks == 9
    assert np.mean(covered) >= 0.8  # 30 intervals: 0.8 is three standard errors below 0.95
    assert 0.8 < np.mean(nis) < 1.2


def test_a_parameter_of_which_no_block_says_anything_keeps_its_spread() -> None:
    trials = [position_only(record(seed)) for seed in range(2)]
    slider = with_idle(np.array([0.7]))
    value, sd = np.append(TRUTH, 0.7), np.append(0.3 * TRUTH, 0.05)
    mean, spread = slider.to_estimated(value, sd)
    still = settings(walk_sd=np.zeros(value.size))
    found = filter_trials(slider, trials, mean, np.diag(spread**2), still)
    ends = [at_block_ends(trial, 1.0) for trial in found.trials]
    covariance, blocks = sandwich_covariance(ends, 2, mean, np.diag(spread**2))
    assert blocks > value.size
    assert np.isfinite(covariance).all()
    assert np.sqrt(covariance[-1, -1]) == pytest.approx(0.05, rel=1e-6)


def test_timing_of_the_inputs_is_found_and_forces_between_samples_are_cubic() -> None:
    trials = []
    for seed in range(3):
        trial = position_only(record(seed))
        late = np.interp(trial.t + 3e-4, trial.t, trial.u[:, 0])  # sampled 0.3 ms after positions
        trials.append(replace(trial, u=late[:, None]))
    slider = model(timing=True)
    mean, spread = slider.to_estimated(np.append(TRUTH, 0.0), np.append(TRUTH, 6e-4))
    found = filter_trials(slider, trials, mean, np.diag(spread**2), settings(walk_sd=np.zeros(4)))
    value, _ = slider.to_physical(found.theta)
    assert value[3] == pytest.approx(3e-4, abs=5e-5)
    np.testing.assert_allclose(value[:3], TRUTH, rtol=5e-3)
    # At 20 samples a second, straight forces would fall short of those of 2 Hz by 3 %.
    straight = []
    for seed in range(3):
        trial = position_only(record(seed))
        straight.append(replace(trial, t=trial.t[::25], u=trial.u[::25], y=trial.y[::25]))
    cubic = [replace(one, curvature=spline_curvature(one.t, one.u)) for one in straight]
    for trials, low, high in [(straight, 0.01, 0.05), (cubic, 0.0, 0.003)]:
        value, _ = model().to_physical(run(trials, settings()).theta)
        assert low <= abs(value[2] / TRUTH[2] - 1.0) < high


def test_blocks_are_short_enough_to_scatter() -> None:
    trials = [position_only(record(seed, 5.3)) for seed in range(2)]
    found = run(trials, settings())
    block_s = choose_block([5.3, 5.3], 11, 2.0)
    ends = [at_block_ends(trial, block_s) for trial in found.trials]
    assert 33 <= sum(end.t.size for end in ends) <= 35
    assert choose_block([60.0, 60.0], 11, 2.0) == 2.0


def test_ends_within_the_physical_range_over_missing_readings() -> None:
    """Without Coulomb friction the estimate is zero or above, and unbiased."""
    truth = np.array([4.0, 0.0, 2.0])
    values = []
    for session in range(4):
        trials = [position_only(record(2 * session + k, truth=truth)) for k in range(2)]
        found = run(trials, settings())
        inside = constrain(model(), found.theta, found.covariance)
        values.append(model().to_physical(inside)[0])
        assert abs(found.theta[1]) < 4.0 * np.sqrt(found.covariance[1, 1])
    assert np.min(values) >= 0.0
    np.testing.assert_allclose(np.array(values)[:, 0], 4.0, rtol=2e-3)
    trial = position_only(record(5))
    y = trial.y.copy()
    y[1000:1050] = np.nan
    found = run([replace(trial, y=y)], settings())
    value, _ = model().to_physical(found.theta)
    assert np.isnan(found.trials[0].nis[1000:1050]).all()
    np.testing.assert_allclose(value, TRUTH, rtol=2e-2)


def test_climb_finds_the_maximum_on_its_grid() -> None:
    best, value = climb(
        lambda x: -float((x[0] - 2.1) ** 2 + (x[1] + 0.9) ** 2),
        np.zeros(2), np.array([1.0, 0.5]), np.array([-np.inf, -0.5]),
    )  # fmt: skip
    np.testing.assert_allclose(best, [2.0, -0.5])
    assert value == pytest.approx(-0.17)
