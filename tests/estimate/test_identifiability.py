"""Information, its bound and its weak directions, against regressions whose answer is known."""

import numpy as np
import pytest

from bampipe.estimate.identifiability import (
    cramer_rao_bound,
    growth_without,
    information,
    residual_spectrum,
    undetermined_covariance,
    weak_directions,
)


def slope(rng: np.random.Generator, count: int, columns: int) -> np.ndarray:
    return rng.normal(size=(count, 1, columns))


@pytest.mark.parametrize("count", [400, 401])
def test_in_white_noise_the_information_is_that_of_least_squares(count: int) -> None:
    x = slope(np.random.default_rng(1), count, 3)
    spectrum = residual_spectrum(
        count, 500.0, np.zeros(1), np.zeros(1), np.zeros(1), np.ones(1), np.full(1, 0.3)
    )
    expected = x[:, 0].T @ x[:, 0] / 0.3**2
    np.testing.assert_allclose(information(x, spectrum), expected, rtol=1e-10)


def test_the_bound_is_met_by_weighted_least_squares_in_the_noise_of_an_encoder() -> None:
    """Noise as an encoder's through an inertia: the best estimate scatters as the bound says."""
    rng = np.random.default_rng(2)
    count, rate = 512, 500.0
    t = np.arange(count) / rate
    x = np.stack([np.sin(2 * np.pi * t), np.sin(9 * np.pi * t) ** 3], axis=1)[:, None, :]
    reading, force, inertia = np.array([2e-5]), np.array([0.05]), np.array([2.5])
    spectrum = residual_spectrum(count, rate, inertia, np.zeros(1), np.zeros(1), reading, force)
    matrix = information(x, spectrum)
    root = np.sqrt(spectrum[:, 0])
    shaped = np.fft.rfft(x[:, 0], axis=0) / root[:, None]
    estimates = []
    for _ in range(400):
        noise = np.fft.rfft(rng.normal(size=count)) * root
        weight = np.r_[1.0, np.full(len(root) - 2, 2.0), 1.0][:, None]
        normal = (shaped.conj().T @ (weight * shaped)).real
        estimates.append(
            np.linalg.solve(normal, (shaped.conj().T @ (weight[:, 0] * noise / root)).real)
        )
    scatter = np.std(estimates, axis=0)
    np.testing.assert_allclose(scatter, np.sqrt(np.diag(cramer_rao_bound(matrix))), rtol=0.12)


def test_an_axis_that_nothing_drives_is_not_free_of_noise() -> None:
    pole = residual_spectrum(400, 200.0, *(np.array([v]) for v in (0.06, 0.0, 1.2, 1e-3, 0.0)))
    assert pole[0, 0] == pytest.approx((1.2e-3) ** 2) and (pole > 0.0).all()
    free = residual_spectrum(400, 200.0, *(np.array([v]) for v in (2.0, 0.0, 0.0, 1e-3, 0.0)))
    assert 0.0 < free[0, 0] <= free[-1, 0]


def test_what_looks_alike_says_nothing_or_adds_nothing_shows() -> None:
    rng = np.random.default_rng(3)
    x = slope(rng, 1000, 3)[:, 0]
    x[:, 2] = x[:, 0] + 0.05 * rng.normal(size=1000)
    found = weak_directions(x.T @ x)
    assert len(found) == 1
    assert set(found[0].members) == {0, 2}
    assert found[0].parts[0] * found[0].parts[1] == pytest.approx(-1.0, abs=0.05)
    assert found[0].strength < 0.01
    assert (
        weak_directions(slope(rng, 1000, 3)[:, 0].T @ slope(rng, 1000, 3)[:, 0] + 900 * np.eye(3))
        == []
    )
    x = np.zeros((50, 3))
    x[:, 0], x[:, 1] = 1.0, np.linspace(-1, 1, 50)
    matrix = x.T @ x
    sd = np.sqrt(np.diag(cramer_rao_bound(matrix)))
    assert np.isinf(sd[2])
    assert np.all(np.isfinite(sd[:2]))
    same = np.stack([x[:, 0], x[:, 0], x[:, 1]], axis=1)
    sd = np.sqrt(np.diag(cramer_rao_bound(same.T @ same)))
    assert np.isinf(sd[:2]).all()
    assert np.isfinite(sd[2])
    rng = np.random.default_rng(4)
    parts = [x.T @ x for x in (slope(rng, n, 2)[:, 0] for n in (500, 500))]
    growth = growth_without([*parts, 1e-6 * parts[0]])
    assert growth[2].max() < 1e-4
    assert growth[:2].min() > 0.3


def test_where_data_say_nothing_the_prior_stays_given_what_they_fix() -> None:
    prior = np.array([1.0, 2.0, 3.0, 4.0])
    matrix = np.zeros((4, 4))
    matrix[:2, :2] = 1e6  # the sum of the first two only
    matrix[2, 2] = 1e4
    left = undetermined_covariance(matrix, prior)
    shared = 1.0 * 4.0 / (1.0 + 4.0)  # of a normal pair whose sum is known
    expected = np.zeros((4, 4))
    expected[:2, :2] = [[shared, -shared], [-shared, shared]]
    expected[3, 3] = 16.0
    np.testing.assert_allclose(left, expected, atol=1e-9)
    np.testing.assert_array_equal(
        undetermined_covariance(np.diag([1.0, 2.0]), np.ones(2)), np.zeros((2, 2))
    )
