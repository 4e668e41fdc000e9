"""An unknown function as a candidate for what no effect of the library explains.

It is a sum of linear splines and of a vibration, see docs/method_selection.md. They are added while
the evidence, integrated over their coefficients, grows.
"""

from dataclasses import dataclass
from itertools import chain, pairwise, repeat

import numpy as np
from scipy.linalg import block_diag

from bampipe.arrays import Array, Indices
from bampipe.diagnosis.dictionary import Key
from bampipe.diagnosis.set_cost import SetCosts, removed_effects
from bampipe.diagnosis.shape import since_reversal
from bampipe.trials.linear_problem import solve_scaled
from bampipe.trials.linearisation import Linearisation
from bampipe.trials.samples import take_samples

_KNOTS = (9, 33), (9,), (9,), (9,)
"""Knots of splines of position, speed, load, and time since the last reversal."""
_KNOTS_OF_OTHERS = (5,)
"""Knots of splines of the position of another axis."""
_SIZES = (0.003, 0.01, 0.03, 0.1)
"""Prior standard deviations of the coefficients, over the applied force of the axis."""
_FEWEST_PERIODS = 2
"""Of a vibration, in the longest trial."""
_REWEIGHTS = 2
"""Reweighting steps of the best spline, from the weights of the function with one spline less."""


@dataclass(frozen=True)
class Unknown:
    """The unknown function of an axis beside a set of effects.

    Attributes:
        cost: negative log evidence of the set with the function, as `SetCosts.cost`.
        residual: residual in units of the noise, by axis, each (n,).
        share: share of the mean square of the axis' residual that the function explains.
        size: root mean square of the function over that of the applied force.
    """

    cost: float
    residual: tuple[Array, ...]
    share: float
    size: float


@dataclass(frozen=True)
class Splines:
    """The splines, and the vibration, of which the unknown function of an axis is a sum.

    Attributes:
        columns: all columns, low-passed and weighted as the residual, (n, m).
        functions: indices of the columns of each spline, and of the vibration.
        log_choices: log number of the functions among which each was chosen.
        products: products of the columns with the columns of the model, (nb, m), with each other,
            (m, m), and with the residual, (m,).
    """

    axis: int
    columns: Array
    functions: tuple[Indices, ...]
    log_choices: Array
    products: tuple[Array, Array, Array]


def build_splines(costs: SetCosts, axis: int) -> Splines | None:
    """Return the splines of an axis; None if the axis does not move."""
    p, e = costs.problem, costs.dictionary.linearisation
    if len(p.y[axis]) <= costs.bb.shape[1]:
        return None
    width = e.system.model.device.coordinates[axis].sign_width
    quantities = zip(*(_quantities(e, k, axis) for k in range(len(e.motions))), strict=True)
    sides = [np.tanh(m.qd[:, axis] / width)[:, None] for m in e.motions]
    blocks = []
    for values, counts in zip(quantities, chain(_KNOTS, repeat(_KNOTS_OF_OTHERS)), strict=False):
        for count in counts:
            knots = np.unique(np.quantile(np.concatenate(values), np.linspace(0.0, 1.0, count)))
            if len(knots) < 3:
                continue
            even = [_hats(v, knots) for v in values]
            for hats in (even, [h * side for h, side in zip(even, sides, strict=True)]):
                thin = [e.band.thin(h, [axis] * len(knots))[:, None, :] for h in hats]
                blocks.append(take_samples(thin, p.likelihood.samples[axis], 0))
    if not blocks:
        return None
    vibration, frequencies = _find_vibration(costs, axis)
    blocks.append(vibration)
    choices = len(_SIZES) * len(blocks) * np.array([1] * (len(blocks) - 1) + [frequencies])
    ends = np.cumsum([0, *(block.shape[1] for block in blocks)])
    x = np.concatenate(blocks, axis=1) * p.likelihood.root[axis][:, None]
    functions = tuple(np.arange(*pair) for pair in pairwise(ends))
    products = p.base[axis].T @ x, x.T @ x, x.T @ p.y[axis]
    return Splines(axis, x, functions, np.log(choices), products)


def _find_vibration(costs: SetCosts, axis: int) -> tuple[Array, int]:
    """Return the vibration that explains most of the residual of an axis, and the number tried.

    It has one frequency, and in each trial an amplitude and a phase: (n, 2 n_trials).
    """
    p, e = costs.problem, costs.dictionary.linearisation
    samples = p.likelihood.samples[axis]
    counts = [len(used) for used in e.used]
    left = np.zeros(sum(counts))
    left[samples.rows] = costs.residual_rows(())[axis]
    padded = 2 * max(counts)
    power = np.zeros(padded // 2 + 1)
    for part in np.split(left, np.cumsum(counts)[:-1]):
        power += np.abs(np.fft.rfft(part, padded)) ** 2
    # Fewer periods in the longest trial look like a drift.
    first = min(2 * _FEWEST_PERIODS, len(power) - 1)
    angle = 2.0 * np.pi * (first + int(np.argmax(power[first:]))) / padded
    turns = [angle * np.arange(count) for count in counts]
    columns = block_diag(*(np.column_stack([np.cos(turn), np.sin(turn)]) for turn in turns))
    return columns[samples.rows], len(power) - first


def _quantities(linearisation: Linearisation, trial: int, axis: int) -> list[Array]:
    motion, n_q = linearisation.motions[trial], len(linearisation.system.coordinates)
    since, _ = since_reversal(motion, axis)
    fitted = linearisation.fitted[trial]
    # The modelled load, since a function of the measured load could cancel it.
    load = (fitted.applied - fitted.residual)[:, axis]
    return [
        motion.q[:, axis],
        np.abs(motion.qd[:, axis]),
        load,
        np.log(since + 0.02),
        *(motion.q[:, other] for other in range(n_q) if other != axis),
    ]


def _hats(values: Array, knots: Array) -> Array:
    """Return linear B-splines, (T, len(knots))."""
    inside = np.clip(values, knots[0], knots[-1])
    return np.column_stack([np.interp(inside, knots, row) for row in np.eye(len(knots))])


def weigh_unknown(costs: SetCosts, splines: Splines, keys: tuple[Key, ...] = ()) -> Unknown:
    """Weigh an unknown function beside the model without the effects that ``keys`` remove."""
    model = _ModelWithout(costs, splines, keys)
    best = model.add_best({}, costs.solve(keys).weight)
    while len(best.sizes) < len(splines.functions):
        found = model.add_best(best.sizes, best.weight)
        if found.cost >= best.cost:
            break
        best = found
    return model.describe(best)


@dataclass(frozen=True)
class _Solution:
    """The most likely unknowns of the model and of splines, whose sizes are given by index."""

    sizes: dict[int, float]
    cost: float
    base: Array
    strengths: Array
    weight: Array


class _ModelWithout:
    """The linear problem of a model without some of its effects, to which splines are added."""

    def __init__(self, costs: SetCosts, splines: Splines, keys: tuple[Key, ...]) -> None:
        p = self.p = costs.problem
        self.splines, axis = splines, splines.axis
        self.fixed, self.free = p.hold(p.removal(removed_effects(keys)))
        self.base = [b @ self.free for b in p.base]
        self.y = [v + b @ self.fixed for v, b in zip(p.y, p.base, strict=True)]
        self.bb = np.array([b.T @ b for b in self.base])
        self.by = np.array([b.T @ v for b, v in zip(self.base, self.y, strict=True)])
        self.yy = np.array([float(v @ v) for v in self.y])
        self.precision = self.free.T @ p.precision @ self.free
        self.moment = self.free.T @ (p.moment - p.precision @ self.fixed)
        bx, self.xx, xy = splines.products
        self.bx, self.xy = self.free.T @ bx, xy + bx.T @ self.fixed
        self.penalty, self.before = costs.penalty_of(keys), costs.residual_rows(keys)[axis]
        self.force = float(np.sqrt(np.mean(p.likelihood.applied[axis] ** 2)))

    def add_best(self, sizes: dict[int, float], weight: Array) -> _Solution:
        """Return the solution of least cost with one more spline than ``sizes``."""
        wider = [
            {**sizes, function: size}
            for function in range(len(self.splines.functions))
            if function not in sizes
            for size in _SIZES
        ]
        taken = self._take_model(weight)
        ranked = (self._solve(one, weight, taken) for one in wider)
        best = min(ranked, key=lambda one: one.cost)
        for _ in range(_REWEIGHTS - 1):
            best = self._solve(best.sizes, best.weight, self._take_model(best.weight))
        return best

    def _take_model(self, weight: Array) -> Array:
        """Return what the model takes of each column and of the residual, (nb, m + 1)."""
        own = np.tensordot(weight, self.bb, 1) + self.precision
        right = [weight[self.splines.axis] * self.bx, self.moment - weight @ self.by]
        return solve_scaled(own, np.column_stack(right))

    def _solve(self, sizes: dict[int, float], weight: Array, all_taken: Array) -> _Solution:
        """Return the solution with splines of given sizes at weights of the axes."""
        p, axis, functions = self.p, self.splines.axis, self.splines.functions
        at = np.concatenate([functions[k] for k in sizes])
        known = np.concatenate(
            [np.full(len(functions[k]), (size * self.force) ** -2) for k, size in sizes.items()]
        )
        bx, xx, xy = self.bx[:, at], self.xx[np.ix_(at, at)], self.xy[at]
        taken, alone, w = all_taken[:, at], all_taken[:, -1], weight[axis]
        inside = w * xx - w * bx.T @ taken
        c = solve_scaled(inside + np.diag(known), -w * xy - w * bx.T @ alone)
        b = alone - taken @ c
        squares = self.yy + 2.0 * self.by @ b + (self.bb @ b) @ b
        squares[axis] += 2.0 * (xy + bx.T @ b) @ c + c @ xx @ c
        left = np.maximum(squares, 1e-9 * self.yy + 1e-300)
        moved = self.fixed + self.free @ b
        cost = p.fixed_cost + 0.5 * float(p.independent @ np.log(left / p.count))
        cost += 0.5 * float(moved @ p.precision @ moved) - float(p.moment @ moved)
        cost += 0.5 * float(c @ (known * c))
        cost += 0.5 * float(np.linalg.slogdet(np.eye(len(at)) + inside / known)[1])
        cost += float(self.splines.log_choices[list(sizes)].sum()) + self.penalty
        return _Solution(sizes, cost, b, c, p.independent / left)

    def describe(self, one: _Solution) -> Unknown:
        """Describe the sum of the splines of a solution."""
        axis, root = self.splines.axis, self.p.likelihood.root[self.splines.axis]
        at = np.concatenate([self.splines.functions[k] for k in one.sizes])
        left = [v + z @ one.base for v, z in zip(self.y, self.base, strict=True)]
        left[axis] = left[axis] + self.splines.columns[:, at] @ one.strengths
        before, after = self.before / root, left[axis] / root
        share = 1.0 - float(after @ after) / max(float(before @ before), 1e-300)
        size = float(np.sqrt(np.mean((before - after) ** 2))) / max(self.force, 1e-300)
        return Unknown(one.cost, tuple(left), share, size)
