"""Vectorised elementary functions against the C library's."""

import math

import numpy as np
import pytest
from numba import njit

from bampipe.physics import elementary


@njit
def over(function, values):
    out = np.empty_like(values)
    for i in range(len(values)):
        out[i] = function(values[i])
    return out


def spread_out(largest):
    rng = np.random.default_rng(1)
    sizes = [10.0**k for k in range(-9, 7) if 10.0**k <= largest]
    return np.concatenate([[0.0], *(size * rng.uniform(-1.0, 1.0, 500) for size in sizes)])


@pytest.mark.parametrize(
    ("name", "largest"), [("exp", 100.0), ("tanh", 1e6), ("sin", 1e5), ("cos", 1e5)]
)
def test_as_exact_as_doubles_allow(name, largest):
    values = spread_out(largest)
    ours = over(getattr(elementary, name), values)
    expected = np.array([getattr(math, name)(v) for v in values])
    # What rounding moves the argument by moves sine and cosine by as much near their zeros.
    allowed = 1e-15 * np.abs(expected)
    if name in ("sin", "cos"):
        allowed = np.maximum(allowed, 2e-16)
    assert np.all(np.abs(ours - expected) <= allowed)


def test_tangent():
    values = spread_out(100.0)
    expected = np.tan(values)
    ours = over(elementary.tan, values)
    np.testing.assert_allclose(ours, expected, rtol=2e-15 * (1.0 + np.abs(expected).max()))


@pytest.mark.parametrize("name", ["exp", "tanh", "sin", "cos", "tan", "sign"])
def test_what_is_not_a_number_stays_so(name):
    assert np.isnan(over(getattr(elementary, name), np.array([np.nan]))).all()


def test_infinite_arguments():
    ends = np.array([-np.inf, np.inf])
    np.testing.assert_array_equal(over(elementary.exp, ends), [0.0, np.inf])
    np.testing.assert_array_equal(over(elementary.tanh, ends), [-1.0, 1.0])
    for function in (elementary.sin, elementary.cos, elementary.tan):
        assert np.isnan(over(function, ends)).all()
    np.testing.assert_array_equal(over(elementary.sign, np.array([-2.0, 0.0, 3.0])), [-1, 0, 1])
