"""Triangular factors against dense algebra."""

import numpy as np
import pytest

from bampipe.estimate import triangular
from bampipe.estimate.unscented import join_roots

# Compiled code alone calls what is compiled of them.
append_rows, condition, covariance_of = (
    getattr(triangular, name).py_func for name in ("append_rows", "condition", "covariance_of")
)
RNG = np.random.default_rng(2)


@pytest.mark.parametrize("rows", [0, 1, 3, 9])
def test_appended_rows_add_their_squares(rows):
    upper = np.triu(RNG.normal(size=(6, 6)))
    upper[2] = 0.0
    added = RNG.normal(size=(rows, 6))
    expected = upper.T @ upper + added.T @ added
    append_rows(upper, 6, np.ascontiguousarray(added.T), rows)
    assert np.all(np.diag(upper) >= 0.0)
    assert not np.tril(upper, -1).any()
    product = np.empty((6, 6))
    covariance_of(upper, product)
    np.testing.assert_allclose(product, expected, atol=1e-13)


def test_conditioning_is_the_kalman_update():
    """With S = C P C^T + R: the root of S, the gain times it, the root of P - K S K^T."""
    n, ny = 7, 3
    upper = np.triu(RNG.normal(size=(n, n)))
    upper[np.diag_indices(n)] = np.abs(np.diag(upper))
    noise = np.tril(RNG.normal(size=(ny, ny)))
    noise[np.diag_indices(ny)] = np.abs(np.diag(noise))
    measured = RNG.normal(size=(ny, n))
    covariance, other = upper.T @ upper, noise @ noise.T
    s = measured @ covariance @ measured.T + other
    gain = np.linalg.solve(s, measured @ covariance).T
    root, turned, found = upper.copy(), noise.copy(), np.empty((ny, n))
    condition(root, turned, measured @ upper.T, found, np.empty(n + 1), np.empty(n + 1))
    np.testing.assert_allclose(turned @ turned.T, s, atol=1e-12)
    np.testing.assert_allclose(found.T, gain @ turned, atol=1e-12)
    np.testing.assert_allclose(root.T @ root, covariance - gain @ s @ gain.T, atol=1e-12)
    assert not np.tril(root, -1).any()


def test_a_root_where_nothing_was():
    spread = np.array([1e6, 1e-6, 3.0])
    whole = np.outer(spread, spread)  # all three are one and the same
    whole[0, 1] = whole[1, 0] = whole[0, 1] * (1 + 1e-14)
    root = join_roots(np.array([0.0, 2.0]), whole)
    np.testing.assert_allclose((root @ root.T)[2:, 2:], whole, rtol=1e-9)
    np.testing.assert_allclose((root @ root.T)[:2], [[0, 0, 0, 0, 0], [0, 4, 0, 0, 0]])
    with pytest.raises(ValueError, match="not positive definite"):
        join_roots(np.zeros(1), np.array([[1.0, 2.0], [2.0, 1.0]]))
