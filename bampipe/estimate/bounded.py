"""Linear least squares within bounds.

A fit hands its normal equations to `solve_bounded`. Sums over trials, over axes and over all
trials but one are sums of normal equations, so a held-out fit needs no second pass over the data:

    normal, moment = slope.T @ slope, slope.T @ measured
    solve_bounded(normal, moment, lower, upper)

Coefficients with equal bounds are held at that value.
"""

import numpy as np
from scipy.optimize import lsq_linear

from bampipe.arrays import Array, Flags

_RANK_TOLERANCE = 1e-12
"""Eigenvalues below this share of the largest, at unit diagonal, are rounding errors."""


def scaled_eigenbasis(matrix: Array) -> tuple[Array, Array, Array, Flags]:
    """Return the eigenvectors of normal equations, scaled to a unit diagonal.

    A coefficient without any information keeps its scale and is a null vector by itself. The
    ``matrix`` (n, n) is symmetric and not negative.

    Returns:
        scale (n,), eigenvalues (n,) rising, eigenvectors (n, n) and which of them are null (n,).
    """
    scale = np.sqrt(np.diag(matrix))
    scale = np.where(scale == 0.0, 1.0, scale)
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    return scale, values, vectors, values < _RANK_TOLERANCE * max(values[-1], 1e-300)


def invert_scaled(matrix: Array) -> Array:
    """Pseudo-inverse of normal equations, whatever the units of the coefficients.

    Without scaling, a stiffness in N/m beside a position in m would seem undetermined.

    Args:
        matrix: (n, n) symmetric, not negative.
    """
    scale, values, vectors, null = scaled_eigenbasis(matrix)
    kept = vectors[:, ~null] / scale[:, None]
    return np.asarray((kept / values[~null]) @ kept.T)


def solve_bounded(normal: Array, moment: Array, lower: Array, upper: Array) -> Array:
    """Minimise ``x^T normal x / 2 - moment^T x`` over ``lower <= x <= upper``; return x, (n,).

    Directions that the data do not determine are left at zero, the least-norm solution in
    coefficients scaled to unit diagonal. Bounds are met by the active-set method of Stark and
    Parker (1995), which also releases a coefficient from a bound.

    Args:
        normal: (n, n) slope^T slope; moment: (n,) slope^T measured, with any weights.
        lower, upper: (n,), infinite without a bound, equal for a fixed coefficient.
    """
    x = np.array(lower, dtype=float)
    open_ = np.flatnonzero(lower < upper)
    held = np.flatnonzero(~(lower < upper))
    if open_.size:
        rest = moment[open_] - normal[np.ix_(open_, held)] @ x[held]
        low, high = lower[open_], upper[open_]
        x[open_] = _solve_within(normal[np.ix_(open_, open_)], rest, low, high)
    return x


def _solve_within(normal: Array, moment: Array, lower: Array, upper: Array) -> Array:
    """Solve as `solve_bounded` does, allowing undetermined directions, (n,)."""
    basis = scaled_eigenbasis(normal)
    x = _least_norm(basis, moment)
    if np.all((x >= lower) & (x <= upper)):
        return x
    scale, values, vectors, null = basis
    singular, vectors = np.sqrt(values[~null]), vectors[:, ~null]
    root, target = singular[:, None] * vectors.T, vectors.T @ (moment / scale) / singular
    range_ = lower * scale, upper * scale
    at = lsq_linear(root, target, range_, method="bvls", max_iter=10 * lower.size).active_mask
    x = np.where(at < 0, lower, upper)
    # Take only the active set: along undetermined directions, free coefficients reach 1e12.
    inside = at == 0
    if inside.any():
        rest = (moment - normal[:, ~inside] @ x[~inside])[inside]
        x[inside] = _least_norm(scaled_eigenbasis(normal[np.ix_(inside, inside)]), rest)
    return np.asarray(np.clip(x, lower, upper))


def _least_norm(basis: tuple[Array, Array, Array, Flags], moment: Array) -> Array:
    """Return the solution without bounds, (n,), zero along undetermined directions.

    Args:
        basis: of the normal equations, see `scaled_eigenbasis`; moment: (n,) their right side.
    """
    scale, values, vectors, null = basis
    along = vectors.T @ (moment / scale) / np.where(null, 1.0, values)
    return np.asarray(vectors @ np.where(null, 0.0, along) / scale)
