"""Sums of products with what is known beforehand."""

import numpy as np

from bampipe.estimate.normal_equations import NormalEquations

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


def test_what_columns_explain_whole_leaves_what_rounding_may() -> None:
    x = RNG.normal(size=(400, 1))
    exact = NormalEquations.from_samples([x[:, :, None]], [-x], [np.ones((400, 1), dtype=bool)])
    assert 0.0 < exact.mean_square(np.array([1.0]))[0] < 1e-10 * float(np.mean(x**2))
