"""Inertial numbers that some body can have, and the nearest ones to an estimate.

A body's mass, first moment and inertia are those of some distribution of mass exactly where its
pseudo-inertia, a symmetric 4 by 4 matrix linear in the ten numbers, has no negative eigenvalue
(Wensing, Kim and Slotine 2018, IEEE Robotics and Automation Letters 3(1)). Written by its
logarithmic Cholesky factor, every value is possible (Rucker and Wensing 2022, ibid. 7(2)).
"""

import numpy as np

from bampipe.arrays import Array

_NUMBERS = 10
_SMALLEST = 1e-6
"""Least eigenvalue of a pseudo-inertia that a search starts from, of the largest."""
_ROUNDING = 1e-9
"""Of the largest eigenvalue: a negative one beyond it is no rounding."""
_MOST_STEPS, _CONVERGED = 200, 1e-10
_LOWEST = -14.0
"""Of a logarithm: a body as thin as e^-14 of its length is flat."""


def pseudo_inertia(numbers: Array) -> Array:
    """Pseudo-inertia (4, 4) of mass, first moment x y z, inertia xx xy xz yy yz zz, ten numbers."""
    mass, x, y, z, xx, xy, xz, yy, yz, zz = numbers
    half = 0.5 * (xx + yy + zz)
    return np.array(
        [
            [half - xx, -xy, -xz, x],
            [-xy, half - yy, -yz, y],
            [-xz, -yz, half - zz, z],
            [x, y, z, mass],
        ]
    )


def _numbers_of(matrix: Array) -> Array:
    """The ten numbers of a pseudo-inertia, or of its derivative."""
    s = matrix[:3, :3]
    inertia = np.trace(s) * np.eye(3) - s
    return np.concatenate([[matrix[3, 3]], matrix[:3, 3], inertia[np.triu_indices(3)]])


def is_possible(numbers: Array) -> bool:
    """Whether some body has these ten numbers."""
    values = np.linalg.eigvalsh(pseudo_inertia(numbers))
    return bool(values[0] >= -_ROUNDING * max(abs(values[-1]), 1e-300))


def nearest_possible(value: Array, weight: Array, start: Array) -> Array:
    """Return possible numbers of several bodies nearest to an estimate.

    Minimises ``(x - value)^T weight (x - value)`` over what bodies can have, by Levenberg and
    Marquardt's method in the logarithmic Cholesky factors.

    Args:
        value: (bodies, 10), the estimate.
        weight: (10 bodies, 10 bodies), such as the inverse of its covariance.
        start: (bodies, 10), where to start, possible or not, such as a drawing's.

    Returns:
        (bodies, 10).
    """
    factors = np.concatenate([_factor(body) for body in start])
    target, damping = value.ravel(), 1e-3
    found, slope = _bodies(factors)
    cost = _cost(found - target, weight)
    for _ in range(_MOST_STEPS):
        gradient = slope.T @ (weight @ (found - target))
        normal = slope.T @ weight @ slope
        size = np.diag(normal) + 1e-12 * np.max(np.diag(normal))
        step = np.linalg.solve(normal + damping * np.diag(size), -gradient)
        tried = _bounded(factors + np.clip(step, -1.0, 1.0))
        there, slope_there = _bodies(tried)
        cost_there = _cost(there - target, weight)
        if cost_there <= cost:
            gained, damping = cost - cost_there, max(0.3 * damping, 1e-12)
            factors, found, slope, cost = tried, there, slope_there, cost_there
            if gained <= _CONVERGED * max(cost, 1e-300):
                break
        elif damping > 1e12:
            break
        else:
            damping *= 5.0
    return found.reshape(-1, _NUMBERS)


def _cost(off: Array, weight: Array) -> float:
    return float(off @ weight @ off)


def _factor(numbers: Array) -> Array:
    """Logarithms of the diagonal and entries above it of U with U U^T the pseudo-inertia."""
    values, vectors = np.linalg.eigh(pseudo_inertia(numbers))
    least = _SMALLEST * max(values[-1], 1e-12)
    matrix = (vectors * np.maximum(values, least)) @ vectors.T
    turned = np.linalg.cholesky(matrix[::-1, ::-1])[::-1, ::-1]
    return np.concatenate([np.log(np.diag(turned)), turned[np.triu_indices(4, 1)]])


def _bounded(factors: Array) -> Array:
    table = factors.reshape(-1, _NUMBERS).copy()
    table[:, :4] = np.maximum(table[:, :4], _LOWEST)
    return table.ravel()


def _bodies(factors: Array) -> tuple[Array, Array]:
    """Numbers of all bodies (10 bodies,) and their slopes by the factors, (10 b, 10 b)."""
    table = factors.reshape(-1, _NUMBERS)
    numbers, slopes = np.empty_like(table), np.zeros((factors.size, factors.size))
    above = np.triu_indices(4, 1)
    for b, row in enumerate(table):
        upper = np.diag(np.exp(row[:4]))
        upper[above] = row[4:]
        numbers[b] = _numbers_of(upper @ upper.T)
        for k in range(_NUMBERS):
            moved = np.zeros((4, 4))
            if k < 4:
                moved[k, k] = upper[k, k]
            else:
                moved[above[0][k - 4], above[1][k - 4]] = 1.0
            change = moved @ upper.T
            own = slice(b * _NUMBERS, (b + 1) * _NUMBERS)
            slopes[own, b * _NUMBERS + k] = _numbers_of(change + change.T)
    return numbers.ravel(), slopes
