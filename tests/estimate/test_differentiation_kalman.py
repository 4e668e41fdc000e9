"""The Kalman smoother against its textbook form, and its choice by likelihood."""

import numpy as np
import pytest

from bampipe.arrays import Array, Flags
from bampipe.estimate import kalman_smoother as ks

RATE = 500.0


def walk(order: int, density: float, count: int, seed: int) -> Array:
    """Return the states (count, order) of an integrated white noise."""
    rng = np.random.default_rng(seed)
    step, noise = ks.transition(order)
    scale = RATE ** np.arange(order)
    step = step * scale[:, None] / scale[None, :]
    noise = noise * density * np.outer(scale, scale) / RATE ** (2 * order - 1)
    kicks = rng.multivariate_normal(np.zeros(order), noise, count, method="cholesky")
    x = np.zeros((count, order))
    for k in range(1, count):
        x[k] = step @ x[k - 1] + kicks[k]
    return x


def textbook(y: Array, seen: Flags, model: ks.MotionModel) -> tuple[Array, Array]:
    """Return smoothed states and covariances by Rauch, Tung and Striebel's recursion."""
    step, noise = ks.transition(model.order)
    noise = noise * model.ratio
    mean, cov = ks._informed_prior(y, seen, step, noise)
    means, covs, ahead = [], [], []
    for k, value in enumerate(y):
        if k:
            mean, cov = step @ mean, step @ cov @ step.T + noise
        ahead.append((mean, cov))
        if seen[k]:
            gain = cov[:, 0] / (cov[0, 0] + 1.0)
            mean = mean + gain * (value - mean[0])
            cov = cov - np.outer(gain, cov[0])
        means.append(mean)
        covs.append(cov)
    for k in range(len(y) - 2, -1, -1):
        gain = covs[k] @ step.T @ np.linalg.inv(ahead[k + 1][1])
        means[k] = means[k] + gain @ (means[k + 1] - ahead[k + 1][0])
        covs[k] = covs[k] + gain @ (covs[k + 1] - ahead[k + 1][1]) @ gain.T
    return np.array(means), np.array(covs)


@pytest.mark.parametrize("order", ks.ORDERS)
def test_smoother_is_that_of_rauch_tung_and_striebel(order: int) -> None:
    rng = np.random.default_rng(0)
    y = np.cumsum(np.cumsum(rng.standard_normal(150))) * 0.3 + rng.standard_normal(150)
    seen = np.ones(150, dtype=bool)
    seen[60:75] = False
    model = ks.MotionModel(order, 1.0, 0.02, 1.0)
    found = ks.smooth(y, model, seen)
    means, covs = textbook(y - y[0], seen, model)
    np.testing.assert_allclose(found.position - y[0], means[:, 0], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.velocity, means[:, 1], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.acceleration_sd, np.sqrt(covs[:, 2, 2]), rtol=1e-4)


@pytest.mark.parametrize("order", ks.ORDERS)
def test_likelihood_recovers_the_noises(order: int) -> None:
    density, noise_sd = (1.0, 2e-5) if order == 3 else (1e4, 2e-5)
    rng = np.random.default_rng(1)
    records = []
    for seed in range(3):
        x = walk(order, density, 6000, seed)
        records.append((x[:, 0] + noise_sd * rng.standard_normal(6000), np.ones(6000, dtype=bool)))
    fits = {
        k: ks.maximum_likelihood(records, RATE, 0.0, order=k, bandwidth_limits_hz=(2.0, 120.0))
        for k in ks.ORDERS
    }
    model, _ = fits[order]
    assert model.noise_sd == pytest.approx(noise_sd, rel=0.05)
    ratio = density / noise_sd**2 / RATE ** (2 * order - 1)
    assert model.ratio == pytest.approx(ratio, rel=0.4)
    assert max(fits, key=lambda k: fits[k][1]) == order


def test_quantisation_bounds_the_noise_from_below() -> None:
    x = walk(3, 1.0, 4000, 0)[:, 0]
    resolution = 5e-5
    y = np.round(x / resolution) * resolution
    model, _ = ks.maximum_likelihood(
        [(y, np.ones(4000, dtype=bool))], RATE, resolution, order=3,
        bandwidth_limits_hz=(2.0, 120.0),
    )  # fmt: skip
    quantum = resolution / np.sqrt(12.0)
    assert quantum * (1 - 1e-12) <= model.noise_sd < 1.2 * quantum


@pytest.mark.parametrize("order", ks.ORDERS)
def test_bands_hold_for_the_motion_they_assume(order: int) -> None:
    density, noise_sd = (1.0, 2e-5) if order == 3 else (1e4, 2e-5)
    ratio = density / noise_sd**2 / RATE ** (2 * order - 1)
    rng = np.random.default_rng(2)
    inside = []
    for seed in range(20):
        x = walk(order, density, 600, 100 + seed)
        seen = rng.random(600) < 0.9
        seen[0] = True
        seen[200:230] = False
        found = ks.smooth(
            x[:, 0] + noise_sd * rng.standard_normal(600),
            ks.MotionModel(order, noise_sd, ratio, RATE), seen,
        )  # fmt: skip
        inside.append(np.mean(np.abs(found.acceleration - x[:, 2]) < found.acceleration_sd))
        assert found.velocity_sd[215] > 1.3 * np.median(found.velocity_sd)
    assert np.mean(inside) == pytest.approx(0.683, abs=0.06)


@pytest.mark.parametrize("order", ks.ORDERS)
def test_bandwidth_and_ratio_are_inverse(order: int) -> None:
    model = ks.MotionModel(order, 1e-5, ks.ratio_for(22.0, order, RATE), RATE)
    assert model.bandwidth_hz == pytest.approx(22.0)


def test_a_trial_at_rest() -> None:
    found = ks.smooth(np.full(500, 0.25), ks.MotionModel(4, 1e-5, 1e-4, RATE))
    np.testing.assert_allclose(found.position, 0.25, atol=1e-12)
    assert np.all(np.isfinite(found.acceleration_sd))


@pytest.mark.parametrize("order", ks.ORDERS)
def test_the_likelihood_is_that_of_every_innovation(order: int) -> None:
    """Of a slow motion, the variance of the innovations rests long before the gains settle."""
    y = np.random.default_rng(0).standard_normal(6000)
    y, (step, noise), seen = y - y[0], ks.transition(order), np.ones(len(y), dtype=bool)
    *_, innovations, spreads = ks._filter(y, seen, step, 1e-12 * noise, *ks._prior(y, order))
    mean, cov = ks._prior(y, order)
    wanted = []
    for value in y:
        off, spread = value - mean[0], cov[0, 0] + 1.0
        mean, cov = mean + cov[:, 0] * off / spread, cov - np.outer(cov[:, 0], cov[0]) / spread
        mean, cov = step @ mean, step @ cov @ step.T + 1e-12 * noise
        wanted.append((np.log(spread), off**2 / spread))
    found = np.log(spreads).sum(), (innovations**2 / spreads).sum()
    assert found == pytest.approx(np.sum(wanted, axis=0), rel=1e-6)
