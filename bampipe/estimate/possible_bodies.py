"""Physically possible inertial parameters, and those nearest to an estimate.

Mass, first moment and inertia belong to some distribution of mass if and only if the pseudo-inertia
of the body, a symmetric 4 by 4 matrix linear in the ten numbers, has no negative eigenvalue
(Wensing, Kim and Slotine 2018, IEEE Robotics and Automation Letters 3(1)). Such numbers form a
convex cone.
"""

import numpy as np

from bampipe.arrays import Array, Indices
from bampipe.estimate.bounded import invert_scaled

_SMALLEST = 1e-3
"""Smallest eigenvalue of the pseudo-inertia at the start of a search, relative to the largest."""
_ROUNDING = 1e-9
"""Negative eigenvalues below this fraction of the largest are rounding errors."""
_ANCHOR = 1e-4
"""Fraction of each number's weight that draws it to the estimate if the others do not."""
_FIRST, _SHARPER, _GAP = 1e-6, 10.0, 1e-6
"""First weight of the cost over the barrier, its growth, and the excess cost allowed at the end,
as a fraction of the cost if that is above one."""
_STEPS, _CENTRED, _SHORTEST = 50, 1e-6, 1e-9
"""Largest number of steps at one weight, decrease that ends them, and shortest relative step."""
_AT_BOUND = 1e-2
"""A number that is closer to a bound than this, in standard deviations, is put on it."""


def pseudo_inertia(numbers: Array) -> Array:
    """Return the pseudo-inertia (4, 4) of mass, first moment x y z, inertia xx xy xz yy yz zz."""
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


_UNIT_BODIES = np.array([pseudo_inertia(row) for row in np.eye(10)])


def is_possible(numbers: Array) -> bool:
    """Whether these ten numbers are those of some body."""
    values = np.linalg.eigvalsh(pseudo_inertia(numbers))
    return bool(values[0] >= -_ROUNDING * max(abs(values[-1]), 1e-300))


def nearest_possible(
    value: Array,
    weight: Array,
    prior_sd: Array,
    bodies: Indices,
    start: Array,
    bounds: tuple[Array, Array],
) -> Array:
    """Return the possible numbers that are nearest to an estimate, (n,).

    Minimises ``(x - value)^T weight (x - value)`` over possible bodies, with other parameters
    within their bounds. This convex problem is solved by Newton's method with a logarithmic barrier
    (Boyd and Vandenberghe 2004, Convex Optimization, 11.3).

    Args:
        value: (n,), the estimate; weight: (n, n), such as the inverse of its covariance.
        prior_sd: (n,), distances over which the numbers may leave the estimate if the weight does
            not determine them; infinite for those that it does.
        bodies: (bodies, 10) indices of the numbers of each body.
        start: (bodies, 10), starting values, possible or not, such as those of a drawing.
        bounds: lower and upper bounds, (n,) each, of the other parameters.
    """
    weight = weight + np.diag(_ANCHOR * np.diag(weight) + prior_sd**-2.0)
    sd = 1.0 / np.sqrt(np.diag(weight))
    others = np.setdiff1d(np.arange(value.size), bodies)
    low, high = (each[others] for each in bounds)
    inside = np.minimum(sd[others], 0.1 * (high - low))
    x = value.copy()
    x[others] = np.clip(value[others], low + inside, high - inside)
    x[bodies] = [_inside(body) for body in start]

    def barrier(x: Array) -> tuple[float, Array, Array]:
        """The barrier, infinite outside, with its gradient (n,) and Hessian (n, n)."""
        matrices = np.array([pseudo_inertia(body) for body in x[bodies]])
        gaps = np.concatenate([x[others] - low, high - x[others]])
        values, vectors = np.linalg.eigh(matrices)
        height, gradient, hessian = np.inf, np.zeros(x.size), np.zeros((x.size, x.size))
        if values.min() > 0.0 and gaps.min(initial=1.0) > 0.0:
            height = -float(np.log(values).sum() + np.log(gaps[np.isfinite(gaps)]).sum())
            below, above = np.split(1.0 / gaps, 2)
            gradient[others], hessian[others, others] = above - below, below**2 + above**2
            for body, w, v in zip(bodies, values, vectors, strict=True):
                change = (v / w) @ v.T @ _UNIT_BODIES
                gradient[body] = -np.trace(change, axis1=1, axis2=2)
                hessian[np.ix_(body, body)] = np.einsum("kij,lji->kl", change, change)
        return height, gradient, hessian

    limits, sharpness = 4 * len(bodies) + 2 * len(others), _FIRST
    while True:
        for _ in range(_STEPS):
            height, gradient, hessian = barrier(x)
            pull = sharpness * weight @ (x - value)
            downhill = gradient + pull
            step = -invert_scaled(hessian + sharpness * weight) @ downhill
            promised, share = -float(downhill @ step), 1.0
            if promised < _CENTRED:
                break
            while share > _SHORTEST:
                quadratic = share * pull @ step + 0.5 * share**2 * sharpness * step @ weight @ step
                change = barrier(x + share * step)[0] - height + quadratic
                if change < -0.1 * share * promised:
                    break
                share *= 0.5
            x = x + share * step
        away = x - value
        if limits < _GAP * sharpness * max(1.0, float(away @ weight @ away)):
            break
        sharpness *= _SHARPER
    near = _AT_BOUND * sd[others]
    x[others] = np.where(x[others] < low + near, low, x[others])
    x[others] = np.where(x[others] > high - near, high, x[others])
    return x


def _inside(numbers: Array) -> Array:
    """Return nearby numbers of a body that is not flat."""
    values, vectors = np.linalg.eigh(pseudo_inertia(numbers))
    least = _SMALLEST * max(values[-1], 1e-12)
    matrix = (vectors * np.maximum(values, least)) @ vectors.T
    s = matrix[:3, :3]
    inertia = np.trace(s) * np.eye(3) - s
    return np.concatenate([[matrix[3, 3]], matrix[:3, 3], inertia[np.triu_indices(3)]])
