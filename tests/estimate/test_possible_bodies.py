"""Inertial numbers that no body has, and the nearest that some body can have."""

import numpy as np

from bampipe.estimate.possible_bodies import is_possible, nearest_possible

RNG = np.random.default_rng(3)
PLACES, EVERY = np.arange(20).reshape(2, 10), np.full(20, np.inf)


def body(points: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Ten numbers of point masses, summed one by one."""
    inertia = sum(
        w * (r @ r * np.eye(3) - np.outer(r, r)) for w, r in zip(weight, points, strict=True)
    )
    return np.concatenate([[weight.sum()], weight @ points, inertia[np.triu_indices(3)]])


def bodies(count: int) -> np.ndarray:
    return np.array([body(RNG.normal(size=(6, 3)), RNG.uniform(0.1, 1.0, 6)) for _ in range(count)])


def test_point_masses_are_possible_and_their_own_nearest() -> None:
    for numbers in bodies(20):
        assert is_possible(numbers)
        assert not is_possible(-numbers)
    one = body(np.array([[0.1, 0.2, 0.3]]), np.array([2.0]))
    assert is_possible(one)  # a single point: at the edge
    one[4] *= 0.9
    assert not is_possible(one)
    value, start = bodies(2), bodies(2)
    weight = np.diag(RNG.uniform(1.0, 10.0, 20))
    found = nearest_possible(value.ravel(), weight, EVERY, PLACES, start, (-EVERY, EVERY))
    np.testing.assert_allclose(found, value.ravel(), atol=1e-4)


def test_the_nearest_is_possible_and_no_other_is_nearer() -> None:
    """Beside the bodies there are a friction that cannot be negative, and what has no bounds."""
    truth = bodies(2)
    value = np.append(truth.ravel() + RNG.normal(0.0, 1.0, 20), [-0.5, 2.0])
    root = RNG.normal(size=(22, 22))
    weight = root @ root.T + np.eye(22)
    low, high = -np.append(EVERY, [0.0, np.inf]), np.append(EVERY, [3.0, np.inf])
    found = nearest_possible(value, weight, high + np.inf, PLACES, truth, (low, high))
    assert all(is_possible(numbers) for numbers in found[PLACES])
    assert found[20] >= 0.0
    # A number of which the weight says nothing stays, in whatever unit.
    places, prior_sd = np.ix_(range(21), range(21)), np.append(np.full(21, np.inf), 1e-6)
    known = np.zeros((22, 22))
    known[places] = weight[places]
    left = nearest_possible(value, known, prior_sd, PLACES, truth, (low, high))
    assert left[21] == value[21]

    def distance(numbers: np.ndarray) -> float:
        return float((numbers - value) @ weight @ (numbers - value))

    # What is possible is convex: towards any other of it it goes up.
    for _ in range(200):
        other = np.append(bodies(2).ravel(), [RNG.uniform(0.0, 3.0), RNG.normal()])
        for share in (1e-3, 1e-2, 0.1):
            assert distance((1.0 - share) * found + share * other) > distance(found) * (1 - 1e-6)


def test_a_point_mass_that_was_fitted_to_nearly_noise_free_trials_has_a_nearest_possible_body():
    """Its pseudo-inertia is singular, and a large weight drives the search to the very edge."""
    for _ in range(40):
        mass, far = 10.0 ** RNG.uniform(-3.0, 3.0), RNG.uniform(0.0, 0.3)
        start = body(np.array([[0.0, 0.0, far]]), np.array([mass]))
        value = start + RNG.normal(size=10) * mass * 10.0 ** RNG.uniform(-3.0, 1.0)
        weight = np.diag(10.0 ** RNG.uniform(-4.0, 8.0, 10))
        bounds = -EVERY[:10], EVERY[:10]
        found = nearest_possible(value, weight, EVERY[:10], PLACES[:1], start[None], bounds)
        assert is_possible(found)
