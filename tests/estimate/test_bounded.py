"""The bounded least-squares solver against scipy's on the rows, and the descent against scipy's."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import least_squares, lsq_linear

from bampipe.estimate.bounded import invert_scaled, solve_bounded
from bampipe.estimate.least_squares import descend
from bampipe.estimate.normal_equations import NormalEquations


def problem(seed: int, rows: int = 60, n: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """Rows of strongly correlated columns whose sizes differ by nine decades, and their target."""
    rng = np.random.default_rng(seed)
    mixed = rng.normal(size=(rows, n)) @ (np.eye(n) + 0.9 * rng.normal(size=(n, n)))
    return mixed * 10.0 ** rng.uniform(-4.5, 4.5, n), rng.normal(size=rows)


@pytest.mark.parametrize("seed", range(20))
def test_scipy_finds_the_same_within_bounds(seed: int) -> None:
    a, b = problem(seed)
    size = np.abs(np.linalg.lstsq(a, b, rcond=None)[0])
    rng = np.random.default_rng(seed + 100)
    lower = np.where(rng.random(7) < 0.3, -np.inf, -rng.random(7) * size)
    upper = np.where(rng.random(7) < 0.3, np.inf, rng.random(7) * size)
    found = solve_bounded(a.T @ a, a.T @ b, lower, upper)
    scale = np.linalg.norm(a, axis=0)
    theirs = lsq_linear(a / scale, b, (lower * scale, upper * scale), method="bvls", max_iter=100)
    np.testing.assert_allclose(found * scale, theirs.x, rtol=1e-7, atol=1e-9)
    np.testing.assert_array_equal((found == lower) | (found == upper), theirs.active_mask != 0)
    assert np.all((found >= lower) & (found <= upper))


def test_a_coefficient_is_released_from_a_bound_and_held_between_equal_ones() -> None:
    """Clipped at first, the second is inside its range once the first one is at its own bound."""
    a, b = np.array([[1.0, 0.0], [2.0, 1.0]]), np.array([2.0, 3.0])
    assert np.linalg.solve(a, b).tolist() == [2.0, -1.0]
    found = solve_bounded(a.T @ a, a.T @ b, np.zeros(2), np.array([1.0, 9.0]))
    np.testing.assert_allclose(found, [1.0, 1.0])
    above = solve_bounded(a.T @ a, a.T @ b, np.array([3.0, 0.0]), np.full(2, 9.0))
    below = solve_bounded(a.T @ a, a.T @ b, np.full(2, -9.0), np.array([1.0, -2.0]))
    assert (above.tolist(), below.tolist()) == ([3.0, 0.0], [1.0, -2.0])
    a, b = problem(4)
    lower, upper = np.full(7, -np.inf), np.full(7, np.inf)
    lower[2] = upper[2] = 0.3
    found = solve_bounded(a.T @ a, a.T @ b, lower, upper)
    others = np.delete(np.arange(7), 2)
    rest = np.linalg.lstsq(a[:, others], b - 0.3 * a[:, 2], rcond=None)[0]
    assert found[2] == 0.3
    np.testing.assert_allclose(found[others], rest, rtol=1e-7)
    all_held = solve_bounded(a.T @ a, a.T @ b, np.ones(7), np.ones(7))
    assert all_held.tolist() == [1.0] * 7


def test_what_the_data_do_not_determine_stays_small() -> None:
    # Two columns of ones: with this draw, the method of bounds ends at 1e14 and minus that.
    rng = np.random.default_rng(1437)
    mixed = rng.normal(size=(50, 8)) @ (np.eye(8) + 0.9 * rng.normal(size=(8, 8)))
    slope = mixed * 10.0 ** rng.uniform(-2.0, 2.0, 8)
    slope[:, 0], slope[:, 1] = 1.0, -1.0
    measured = slope @ (rng.normal(size=8) * 10.0) + rng.normal(size=50)
    lower, upper = np.where(np.arange(8) < 3, -np.inf, 0.0), np.full(8, np.inf)
    found = solve_bounded(slope.T @ slope, slope.T @ measured, lower, upper)
    best = lsq_linear(slope[:, 1:], measured, (lower[1:], upper[1:]), tol=1e-14)
    assert (found == lower).any()
    assert found[0] == pytest.approx(-found[1])
    assert found[1] - found[0] == pytest.approx(best.x[0], rel=1e-6)
    assert found[2:] == pytest.approx(best.x[1:], rel=1e-4, abs=1e-6)
    a, b = problem(5)
    twice = np.column_stack([a, a[:, 0], np.zeros(len(a))])
    free = np.full(9, np.inf)
    found = solve_bounded(twice.T @ twice, twice.T @ b, -free, free)
    assert found[8] == 0.0
    assert found[7] == pytest.approx(found[0])
    best = a @ np.linalg.lstsq(a, b, rcond=None)[0]
    np.testing.assert_allclose(twice @ found, best, rtol=1e-6, atol=1e-7)


@dataclass(frozen=True)
class Decay:
    """``exp`` fitted to points: the residual is nonlinear in the second parameter."""

    value: np.ndarray
    t = np.linspace(0.0, 3.0, 50)
    measured = 2.0 * np.exp(-1.3 * t) + 0.01 * np.sin(40.0 * t)

    def residual(self, value: np.ndarray) -> np.ndarray:
        return value[0] * np.exp(-value[1] * self.t) - self.measured

    @property
    def cost(self) -> float:
        return float(np.sum(self.residual(self.value) ** 2))

    def normal_equations(self) -> tuple[np.ndarray, np.ndarray]:
        fall = np.exp(-self.value[1] * self.t)
        slope = np.column_stack([fall, -self.value[0] * self.t * fall])
        return slope.T @ slope, -slope.T @ self.residual(self.value)

    def moved(self, value: np.ndarray) -> "Decay":
        return Decay(value)


@pytest.mark.parametrize("highest", [9.0, 1.1])
def test_a_descent_ends_where_scipy_s_does(highest: float) -> None:
    lower, upper = np.zeros(2), np.array([9.0, highest])
    start = Decay(np.array([0.2, 0.1]))
    found = descend(start, lower, upper, 50, tolerance=1e-14)
    theirs = least_squares(start.residual, start.value, bounds=(lower, upper), xtol=1e-12)
    np.testing.assert_allclose(found.value, theirs.x, rtol=1e-5)
    again = descend(found, lower, upper, 1)
    np.testing.assert_allclose(again.value, found.value, rtol=1e-6)


def test_the_inverse_of_normal_equations_does_not_depend_on_units() -> None:
    """A stiffness of 6e4 N/m beside its position in m: eigenvalues sixteen decades apart."""
    rng = np.random.default_rng(5)
    slope = rng.normal(size=(200, 3)) * np.array([1e-5, 6e4, 1.0])
    slope = np.column_stack([slope, np.zeros(200)])
    found = invert_scaled(slope.T @ slope)
    unit = slope[:, :3] / np.array([1e-5, 6e4, 1.0])
    expected = np.linalg.inv(unit.T @ unit) / np.outer(*2 * [np.array([1e-5, 6e4, 1.0])])
    np.testing.assert_allclose(found[:3, :3], expected, rtol=1e-9)
    assert not found[3].any()
    assert not found[:, 3].any()


RNG = np.random.default_rng(2)
TRIALS, COUNT, AXES, P = 3, 40, 2, 5
FREE = np.full(P, np.inf)


def test_what_is_known_beforehand_counts_as_so_many_samples() -> None:
    """A coefficient known as 3 with variance 1/4 is as four samples of it that read 3."""
    slopes, left = RNG.normal(size=(TRIALS, COUNT, AXES, P)), RNG.normal(size=(TRIALS, COUNT, AXES))
    used = [np.ones((COUNT, AXES), dtype=bool)] * TRIALS
    precision, known = np.zeros(P), np.zeros(P)
    precision[1], known[1] = 4.0, 3.0
    weight = np.ones(AXES)
    found = NormalEquations.from_samples(slopes, left, used, precision, known)
    rows, target = slopes.reshape(-1, P), -left.ravel()
    unit = np.zeros((4, P))
    unit[:, 1] = 1.0
    expected = np.linalg.lstsq(np.vstack([rows, unit]), np.append(target, [3.0] * 4), rcond=None)[0]
    np.testing.assert_allclose(found.solve(weight, -FREE, FREE), expected, rtol=1e-9)
    x = RNG.normal(size=(400, 1))
    nothing, every = np.zeros(0), np.ones((400, 1), dtype=bool)
    exact = NormalEquations.from_samples([x[:, :, None]], [-x], [every], nothing, nothing)
    assert 0.0 < exact.mean_square(np.array([1.0]))[0] < 1e-10 * float(np.mean(x**2))
