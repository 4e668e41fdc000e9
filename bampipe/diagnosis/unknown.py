"""Something that no effect of the library is: a smooth function of what an axis does.

Linear splines in position, speed, load and time since the last reversal, and in the position of the
other axes, even and odd in the direction of motion, with a normal prior: a Gaussian process of few
knots. Its evidence is integrated over the strengths and the best of a few sizes is taken.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array
from bampipe.diagnosis.dictionary import Key
from bampipe.diagnosis.search import Search, gone
from bampipe.diagnosis.shape import since_reversal
from bampipe.trials.evidence import Evidence
from bampipe.trials.likelihood import solve_scaled, take_samples

_KNOTS, _KNOTS_OF_OTHERS = 9, 5
_SIZES = (0.003, 0.01, 0.03, 0.1)
"""Standard deviations of the function at a knot, over the applied force of the axis."""
_REWEIGHTS = 4


@dataclass(frozen=True)
class Unknown:
    """The unknown function beside a set of effects.

    Attributes:
        cost: negative log evidence of the set with it, as `Search.cost`.
        residual: weighted rows that are left, by axis, each (n,).
        weight: of the squares of each axis.
        share: of the mean square of the axis' residual, what it takes.
        size: of what it adds, root mean square, over the applied force.
    """

    axis: int
    cost: float
    residual: tuple[Array, ...]
    weight: Array
    share: float
    size: float


def spline_columns(evidence: Evidence, axis: int) -> list[Array]:
    """Splines of what an axis does, low-passed as its residual is, by trial, each (K, m)."""
    e, width = evidence, evidence.system.model.device.coordinates[axis].sign_width
    parts: list[list[Array]] = []
    quantities = [_quantities(e, trial, axis) for trial in range(len(e.motions))]
    for place in range(len(quantities[0])):
        values = np.concatenate([q[place] for q in quantities])
        count = _KNOTS if place < 4 else _KNOTS_OF_OTHERS
        knots = np.unique(np.quantile(values, np.linspace(0.0, 1.0, count)))
        if len(knots) > 2:
            parts.append([_hats(q[place], knots) for q in quantities])
    columns = []
    for trial, motion in enumerate(e.motions):
        even = np.concatenate([part[trial] for part in parts], axis=1)
        side = np.tanh(motion.qd[:, axis] / width)[:, None]
        both = np.concatenate([even, even * side], axis=1)
        columns.append(e.band.thin(both, [axis] * both.shape[1]))
    return columns


def _quantities(evidence: Evidence, trial: int, axis: int) -> list[Array]:
    motion, n_q = evidence.motions[trial], len(evidence.system.coordinates)
    since, _ = since_reversal(motion, axis)
    fitted = evidence.fitted[trial]
    # The load by the model, not as measured: a function of that could take all of it away.
    load = (fitted.applied - fitted.residual)[:, axis]
    return [
        motion.q[:, axis],
        np.abs(motion.qd[:, axis]),
        load,
        np.log(since + 0.02),
        *(motion.q[:, other] for other in range(n_q) if other != axis),
    ]


def _hats(values: Array, knots: Array) -> Array:
    """Linear B-splines, (T, len(knots))."""
    inside = np.clip(values, knots[0], knots[-1])
    return np.column_stack([np.interp(inside, knots, row) for row in np.eye(len(knots))])


def weigh_unknown(
    search: Search, axis: int, columns: Sequence[Array], keys: tuple[Key, ...] = ()
) -> Unknown | None:
    """The evidence of an unknown function on an axis beside a set; None if the axis has no samples.

    ``columns`` are its `spline_columns`; ``keys`` the set, of effects of the model taken away.
    """
    p, nb = search.p, search.bb.shape[1]
    if len(p.y[axis]) <= nb:
        return None
    wide = [c[:, None, :] for c in columns]
    root = p.likelihood.root[axis]
    x = take_samples(wide, p.likelihood.samples[axis], 0) * root[:, None]
    absent = {k: v for name in gone(keys) for k, v in p.absence[name].items()}
    fixed, free = p.hold(absent)
    force = float(np.sqrt(np.mean(p.likelihood.applied[axis] ** 2)))
    base = [b @ free for b in p.base]
    y = [v + b @ fixed for v, b in zip(p.y, p.base, strict=True)]
    bb = np.array([b.T @ b for b in base])
    by = np.array([b.T @ v for b, v in zip(base, y, strict=True)])
    precision = free.T @ p.precision @ free
    moment = free.T @ (p.moment - p.precision @ fixed)
    bx, xx, xy = base[axis].T @ x, x.T @ x, x.T @ y[axis]
    best: Unknown | None = None
    for size in _SIZES:
        known = 1.0 / (size * force) ** 2
        weight = search.solve(keys).weight
        for _ in range(_REWEIGHTS):
            own, w = np.tensordot(weight, bb, 1) + precision, weight[axis]
            taken = solve_scaled(own, w * bx)
            inside = w * xx - w * bx.T @ taken
            right = moment - weight @ by
            c = solve_scaled(
                inside + known * np.eye(len(xx)), -w * xy - w * bx.T @ solve_scaled(own, right)
            )
            b = solve_scaled(own, right - w * bx @ c)
            left = [v + z @ b for v, z in zip(y, base, strict=True)]
            left[axis] = left[axis] + x @ c
            squares = np.maximum([float(v @ v) for v in left], 1e-300)
            weight = p.independent / squares
        cost = p.fixed_cost + float(p.independent @ (0.5 * np.log(squares / p.count)))
        moved = fixed + free @ b
        cost += 0.5 * float(moved @ p.precision @ moved) - float(p.moment @ moved)
        cost += 0.5 * known * float(c @ c)
        cost += 0.5 * float(np.linalg.slogdet(np.eye(len(xx)) + inside / known)[1])
        cost += np.log(len(_SIZES)) + search.penalty_of(keys)
        if best is None or cost < best.cost:
            before = search.residual_rows(keys)[axis] / root
            after = left[axis] / root
            share = 1.0 - float(after @ after) / max(float(before @ before), 1e-300)
            size_now = float(np.sqrt(np.mean((before - after) ** 2))) / max(force, 1e-300)
            best = Unknown(axis, cost, tuple(left), weight, share, size_now)
    return best
