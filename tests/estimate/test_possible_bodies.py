"""Inertial numbers that no body has, and the nearest that some body can have."""

import numpy as np

from bampipe.estimate.possible_bodies import is_possible, nearest_possible

RNG = np.random.default_rng(3)


def body(points: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Ten numbers of point masses, summed one by one."""
    inertia = sum(
        w * (r @ r * np.eye(3) - np.outer(r, r)) for w, r in zip(weight, points, strict=True)
    )
    return np.concatenate([[weight.sum()], weight @ points, inertia[np.triu_indices(3)]])


def bodies(count: int) -> np.ndarray:
    return np.array([body(RNG.normal(size=(6, 3)), RNG.uniform(0.1, 1.0, 6)) for _ in range(count)])


def test_point_masses_are_possible_and_their_negatives_are_not() -> None:
    for numbers in bodies(20):
        assert is_possible(numbers)
        assert not is_possible(-numbers)
    one = body(np.array([[0.1, 0.2, 0.3]]), np.array([2.0]))
    assert is_possible(one)  # a single point: at the edge
    one[4] *= 0.9
    assert not is_possible(one)


def test_a_possible_estimate_is_its_own_nearest() -> None:
    value, start = bodies(2), bodies(2)
    weight = np.diag(RNG.uniform(1.0, 10.0, 20))
    np.testing.assert_allclose(nearest_possible(value, weight, start), value, atol=1e-4)


def test_the_nearest_is_possible_and_no_other_is_nearer() -> None:
    truth = bodies(2)
    value = truth + RNG.normal(0.0, 1.0, truth.shape)
    root = RNG.normal(size=(20, 20))
    weight = root @ root.T + np.eye(20)
    found = nearest_possible(value, weight, truth)
    assert all(is_possible(numbers) for numbers in found)

    def distance(numbers: np.ndarray) -> float:
        off = (numbers - value).ravel()
        return float(off @ weight @ off)

    # Possible numbers are a convex cone: towards any other of them it goes up.
    for _ in range(200):
        other = bodies(2)
        for share in (1e-3, 1e-2, 0.1):
            assert distance((1.0 - share) * found + share * other) > distance(found) * (1 - 1e-6)
