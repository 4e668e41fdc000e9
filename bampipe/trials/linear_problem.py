"""The weighted linear problem of a linearised model under the likelihood, and its solution."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.linalg.lapack import dposv

from bampipe.arrays import Array, Flags, Indices
from bampipe.physics.parameter import Parameter
from bampipe.trials.kept import KeptItems
from bampipe.trials.likelihood import Likelihood
from bampipe.trials.linearisation import Linearisation
from bampipe.trials.samples import BIASES, MOST_BIAS, take_samples

NOTHING = 1e-4
"""A parameter whose whole range moves the data by fewer standard deviations has no effect."""
_DETERMINED = 1e-9
"""A direction of the model's parameters is undetermined, and keeps its value, if its eigenvalue of
the scaled normal equations is below this fraction of the largest."""
_LOOSE = 1e-6
"""Smallest part of a parameter, in its standard deviations, in a direction without effect."""
_TOGETHER = 100_000
"""Rows of columns that are weighted in one pass."""
_RIDGE = 1e-10
_REWEIGHTS = 5
_STEADY = 0.02
"""Relative change of the weights at convergence; the cost changes by its square."""


def pose_problem(likelihood: Likelihood, linearisation: Linearisation) -> "LinearProblem":
    """Weight the residual and slopes of a linearised model, and add its priors."""
    samples, noise, weights = likelihood.samples, likelihood.noise, likelihood.root
    n_q = len(samples)
    if linearisation.factors:  # the unit is that of the measured force: small factors gain nothing
        ratio = np.array(likelihood.model.factors) / np.array(linearisation.factors)
        weights = [root * by for root, by in zip(weights, ratio, strict=True)]
    timing = linearisation.timing if linearisation.by_timing else ()
    n, n_biases = len(linearisation.free) + len(timing[:1]), len(BIASES) * n_q

    def weighted_columns(axis: int) -> Iterator[tuple[slice, Array]]:
        """Yield the columns of all unknowns, (k, n_all), in chunks, since they are large."""
        biases, weight = noise.biases(axis), weights[axis]
        for part, slopes in _stack_chunks(samples[axis].take(linearisation.slopes, axis)):
            columns = np.zeros((len(slopes), n + n_biases))
            columns[:, :n] = slopes
            columns[:, n + axis :: n_q] = -biases[part]
            columns *= weight[part, None]
            yield part, columns

    def combined_columns(axis: int) -> Array:
        out = np.empty((len(samples[axis].rows), to.shape[1]))
        for part, x in weighted_columns(axis):
            out[part] = x @ to
        return out

    # The standard deviation of a uniform distribution is 0.29 of its width.
    of_timing = [(3.5 / max(timing[1] - timing[0], 1e-12)) ** 2] if timing else []
    delay, none = [sum(timing) / 2] * len(of_timing), np.zeros(n_biases)
    precision = np.concatenate([linearisation.precision, of_timing, none + 1.0])
    known = np.concatenate([linearisation.known, delay, np.repeat(BIASES, n_q)])
    lower = np.concatenate([linearisation.lower, timing[:1], none])
    upper = np.concatenate([linearisation.upper, timing[1:], none + MOST_BIAS])
    y = [
        take_samples(linearisation.residual, here, axis) * weights[axis]
        for axis, here in enumerate(samples)
    ]
    weight = [s.independent / max(float(v @ v), 1e-300) for s, v in zip(samples, y, strict=True)]
    products = (w * (x.T @ x) for axis, w in enumerate(weight) for _, x in weighted_columns(axis))
    known_precision, moment = np.diag(precision), precision * known
    cost_of_known = 0.5 * float(precision @ known**2)
    effects, p = linearisation.system.model.effects, linearisation.p[list(linearisation.free)]
    strengths = [
        _find_places(linearisation, [q for q in e.parameters if q.strength]) for e in effects
    ]
    shapes = [_find_places(linearisation, [q for q in e.parameters if q.shape]) for e in effects]
    if at := [place for places in strengths for place in places]:
        member = np.repeat(np.arange(len(effects)), [*map(len, strengths)])
        own = (take_samples(linearisation.slopes, here, a)[:, at] for a, here in enumerate(samples))
        expected = expect_strengths([x.T @ x for x in own], likelihood.applied)
        expected = expected * (member[:, None] == member)
        known_precision[np.ix_(at, at)] += expected
        moment[at] -= expected @ p[at]
        cost_of_known += 0.5 * float(p[at] @ expected @ p[at])
    normal = sum(products) + known_precision
    # Unknowns without effect over their range stay, like the shape of an effect of no strength.
    size, parameters = np.sqrt(np.diag(normal)), linearisation.system.parameters
    reach = np.ones(size.size)
    reach[: len(linearisation.free)] = [parameters[i].sd or 1.0 for i in linearisation.free]
    per_unit = np.divide(1.0, size, out=np.zeros_like(size), where=size * reach > NOTHING)
    values, vectors = np.linalg.eigh(normal * per_unit * per_unit[:, None])
    kept = values > _DETERMINED * values[-1]
    to = vectors[:, kept] / np.sqrt(values[kept]) * per_unit[:, None]
    loose = vectors[:, ~kept] * per_unit[:, None]
    log_scale, by_parameter = _log_scale_with_filters(likelihood, linearisation, y)
    by_parameter = np.pad(by_parameter, ((0, 0), (0, n_biases)))
    return LinearProblem(
        likelihood, KeptItems(y), KeptItems(map(combined_columns, range(n_q))),
        to.T @ known_precision @ to, to.T @ moment, log_scale,
        by_parameter, to, lower, upper,
        {
            # Without a strength the data say nothing of the shape: it does not move to its prior.
            item.name: {k: -float(p[k]) for k in own} | dict.fromkeys(others, 0.0)
            for item, own, others in zip(effects, strengths, shapes, strict=True)
        },
        {item.name: tuple(own) for item, own in zip(effects, shapes, strict=True)},
        cost_of_known, loose, dict.fromkeys(range(len(linearisation.free), n), 0.0),
        np.diag(1.0 / values[kept]),
    )  # fmt: skip


def _log_scale_with_filters(
    likelihood: Likelihood, linearisation: Linearisation, y: Sequence[Array]
) -> tuple[Array, Array]:
    """Return `Linearisation.log_scale` with the factors of the model's filters on force noise."""
    value, slopes = (x.copy() for x in linearisation.log_scale)
    gains, by_parameter = linearisation.filter_gain
    for axis in map(int, np.flatnonzero(by_parameter.any(axis=1))):
        scale = float(np.mean(y[axis] ** 2))
        rows = likelihood.log_of_filter(axis, gains[axis], scale)
        value[axis] += rows.mean()
        more = likelihood.log_of_filter(axis, gains[axis] * (1.0 + 1e-6), scale)
        slopes[axis] += (more - rows).mean() / (1e-6 * gains[axis]) * by_parameter[axis]
    return value, slopes


def _find_places(linearisation: Linearisation, parameters: Sequence[Parameter]) -> list[int]:
    """Indices, among the free parameters, of some parameters."""
    names, every = {q.name for q in parameters}, linearisation.system.parameters
    return [k for k, number in enumerate(linearisation.free) if every[number].name in names]


def _stack_chunks(parts: Iterable[Array]) -> Iterator[tuple[slice, Array]]:
    """Yield the stacked arrays in chunks of `_TOGETHER` rows or a few more, with their rows."""
    few, end, size = list[Array](), 0, 0
    for part in parts:
        few, size = [*few, part], size + len(part)
        if size >= _TOGETHER:
            yield slice(end, end + size), np.concatenate(few)
            few, end, size = [], end + size, 0
    if few:
        yield slice(end, end + size), np.concatenate(few)


@dataclass(frozen=True)
class LinearProblem:
    """A weighted linear problem: the residual of all axes in units of noise, and its columns.

    Attributes:
        likelihood: weights and samples.
        y: residual by axis, (n,); base: by axis, (n, P), columns of the determined combinations of
            the model's parameters.
        known_precision, known_moment: (P, P) and (P,), the priors of these.
        log_scale: mean log of the fraction of the measured quantity that the effects leave, by
            axis, (n_q,); log_scale_by_parameter: its slopes by the parameters, (n_q, n_all).
        to_parameters: (n_all, P), from these to the free parameters, nuisance parameters last.
        lower, upper: bounds of the change of the parameters, (n_all,).
        absence: by effect, the change of each of its free parameters (by index) that removes it.
        shapes: by effect, the indices of its free shape parameters.
        cost_of_known: negative log density of the priors if nothing changes.
        loose: (n_all, m) directions of the parameters in which nothing measured changes.
        no_delay: the change of the input delay, by index, if that is fitted: none.
        step_precision: (P, P), the diagonal of the parameters' precision, which damps a step.
    """

    likelihood: Likelihood
    y: Sequence[Array]
    base: Sequence[Array]
    known_precision: Array
    known_moment: Array
    log_scale: Array
    log_scale_by_parameter: Array
    to_parameters: Array
    lower: Array
    upper: Array
    absence: Mapping[str, Mapping[int, float]] = field(default_factory=dict)
    shapes: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    cost_of_known: float = 0.0
    loose: Array | None = None
    no_delay: Mapping[int, float] = field(default_factory=dict)
    step_precision: Array | float = 0.0
    _held: dict[Any, tuple[Array, Array]] = field(default_factory=dict, init=False, repr=False)

    @property
    def independent(self) -> Array:
        """Independent samples of each axis, (n_q,)."""
        return np.array([s.independent for s in self.likelihood.samples])

    @property
    def count(self) -> Array:
        """Number of samples of each axis, at least one, (n_q,)."""
        return np.array([max(float(len(y)), 1.0) for y in self.y])

    @cached_property
    def log_scale_slopes(self) -> Array:
        """Slopes of ``log_scale`` by the combinations of ``base``, (n_q, P)."""
        return np.asarray(self.log_scale_by_parameter @ self.to_parameters)

    @property
    def moment(self) -> Array:
        """Gradient of the log density, without the residual, if nothing changes, (P,)."""
        return np.asarray(self.known_moment + self.independent @ self.log_scale_slopes)

    @cached_property
    def precision(self) -> Array:
        """Its curvature, (P, P): a fraction of the scale is linear in the strength of an effect."""
        slopes = self.log_scale_slopes
        return np.asarray(self.known_precision + (self.independent * slopes.T) @ slopes)

    @property
    def fixed_cost(self) -> float:
        """Negative log density, without the residual, if nothing changes, nats."""
        return self.cost_of_known - float(self.independent @ self.log_scale)

    def sums(self) -> tuple[Array, Array, Array]:
        """Products of the base with itself, of the base with y, and of y with itself, by axis."""
        return (
            np.array([b.T @ b for b in self.base]),
            np.array([b.T @ y for b, y in zip(self.base, self.y, strict=True)]),
            np.array([float(y @ y) for y in self.y]),
        )

    def sums_of(self, parts: Sequence[Indices], count: int) -> tuple[Array, Array, Array]:
        """`sums` of ``count`` parts separately; ``parts`` numbers each axis' samples, (n,)."""
        n_q, n = len(self.y), self.to_parameters.shape[1]
        xx, xy, yy = (np.zeros((count, n_q, *shape)) for shape in ((n, n), (n,), ()))
        for axis, (y, base, part) in enumerate(zip(self.y, self.base, parts, strict=True)):
            order = np.argsort(part, kind="stable")
            ends = np.searchsorted(part[order], np.arange(count + 1))
            for k, (first, last) in enumerate(pairwise(ends)):
                b, v = base[order[first:last]], y[order[first:last]]
                xx[k, axis], xy[k, axis], yy[k, axis] = b.T @ b, b.T @ v, v @ v
        return xx, xy, yy

    def hold(self, values: Mapping[int, float], n: int | None = None) -> tuple[Array, Array]:
        """Fix some parameters: unknowns (n,) with the given values, and (n, m) free directions.

        A value that can be reached along a direction without effect constrains nothing else.

        Args:
            values: values by index of the parameter.
            n: number of unknowns, the model's own first; by default these alone.
        """
        nb, key = self.to_parameters.shape[1], tuple(values.items())
        if key not in self._held:
            self._held[key] = self._hold(values)
        own_fixed, own_free = self._held[key]
        n, m = nb if n is None else n, own_free.shape[1]
        fixed, free = np.zeros(n), np.zeros((n, m + n - nb))
        fixed[:nb], free[:nb, :m] = own_fixed, own_free
        free[nb:, m:] = np.eye(n - nb)
        return fixed, free

    def _hold(self, values: Mapping[int, float]) -> tuple[Array, Array]:
        """Return `hold` for the model's own unknowns."""
        nb, places = self.to_parameters.shape[1], list(values)
        rows, wanted = self.to_parameters[places], np.array(list(values.values()))
        # Scale each row to its own unit; a row of zeros needs no constraint.
        norm = np.linalg.norm(rows, axis=1)
        moves = norm > 0.0
        rows, wanted = rows[moves] / norm[moves, None], wanted[moves] / norm[moves]
        if self.loose is not None and rows.size:
            u, size, _ = np.linalg.svd(self.loose[places][moves] / norm[moves, None])
            bound = u[:, int(np.sum(size > _LOOSE)) :].T
            rows, wanted = bound @ rows, bound @ wanted
        if not rows.size:
            return np.zeros(nb), np.eye(nb)
        u, size, vt = np.linalg.svd(rows)
        rank = int(np.sum(size > 1e-9 * max(float(size[0]), 1e-300)))
        return vt[:rank].T @ ((u.T @ wanted)[:rank] / size[:rank]), vt[rank:].T

    def removal(self, effects: Iterable[str]) -> dict[int, float]:
        """Changes of the parameters, by index, that remove some of the model's effects."""
        return {k: change for name in effects for k, change in self.absence[name].items()}

    def residual_rows(self, base: Array | None = None) -> Iterator[Array]:
        """The residual after a change ``base``, (P,), by default the most likely; by axis, (n,)."""
        change = self.solve().base if base is None else base
        return (y + x @ change for y, x in zip(self.y, self.base, strict=True))

    def solve(self) -> "LinearSolution":
        """The most likely change of the model's own parameters."""
        return solve_bounded(self, *self.sums())

    def solve_damped(self, damping: float) -> "LinearSolution":
        """The most likely change by a damped step (Marquardt 1963)."""
        held = self.known_precision + damping * self.step_precision
        return replace(self, known_precision=held).solve()

    def log_likelihood(self) -> float:
        """Log likelihood of the samples at the solution, nats, up to a constant free of weights."""
        roots = [float(np.mean(np.log(r))) if r.size else 0.0 for r in self.likelihood.root]
        return float(self.independent @ roots) - self.solve().cost

    def cost_of_step(self, residual: Sequence[Array], steps: Array) -> float:
        """Negative log density after a step, nats; infinite if the residual there is not finite.

        Nuisance parameters are fitted anew. Priors and the scale of the equation are those of the
        linear problem.

        Args:
            residual: after the step, by trial, each (K, n_q), N.m or N.
            steps: of the model's parameters, (n,).
        """
        values = dict(enumerate(steps.tolist()))
        beside = dict.fromkeys(range(len(values), len(self.to_parameters)), 0.0)
        change, like = self.hold(values | beside)[0], self.likelihood
        weighed = zip(like.samples, like.root, self.base, strict=True)
        y = [
            take_samples(residual, here, axis) * root - base @ change
            for axis, (here, root, base) in enumerate(weighed)
        ]
        if not all(np.isfinite(rows).all() for rows in y):
            return np.inf
        moved = replace(self, y=y)
        return solve_bounded(moved, *moved.sums(), absent=values).cost

    def solve_nuisance(self, count: int) -> "LinearSolution":
        """The most likely nuisance parameters while the model's ``count`` parameters stay."""
        return solve_bounded(self, *self.sums(), absent=dict.fromkeys(range(count), 0.0))


def expect_strengths(squares: Sequence[Array], applied: Sequence[Array]) -> Array:
    """Return the prior precision of the strengths of an effect about zero, (m, m).

    The contribution of the effect has the root mean square of the applied force as its standard
    deviation, so that similar effects cannot cancel each other with excessive forces.

    Args:
        squares: by axis, products of the columns of unit strength, (m, m); applied: by axis, (n,).
    """
    pairs = zip(squares, applied, strict=True)
    return np.asarray(sum(square / max(float(f @ f), 1e-300) for square, f in pairs))


@dataclass(frozen=True)
class LinearSolution:
    """The most likely unknowns of a linear problem.

    Attributes:
        unknowns: (n,), of which the first P are the model's own combinations of parameters.
        held: which of the other unknowns are held at zero by a bound, (n - P,).
        fixed: changes of the model's parameters that are prescribed or at a bound, by index.
        left: sum of squares by axis, (n_q,); weight: that of the squares at the solution.
        cost: negative log density, nats.
    """

    unknowns: Array
    held: Flags
    fixed: Mapping[int, float]
    left: Array
    weight: Array
    cost: float

    @property
    def base(self) -> Array:
        """The first P unknowns, those of the model."""
        return self.unknowns[: len(self.unknowns) - len(self.held)]


def solve_bounded(
    problem: LinearProblem,
    xx: Array,
    xy: Array,
    yy: Array,
    low: Array | None = None,
    high: Array | None = None,
    absent: Mapping[int, float] | None = None,
    weight: Array | None = None,
    expected: Array | None = None,
) -> LinearSolution:
    """Minimise the negative log likelihood, alternating between axis weights and bounds.

    An unknown that leaves its bounds is held at the bound it crossed, and let go once if the cost
    falls inwards from there.

    Args:
        problem: the model's own columns, which come first.
        xx, xy, yy: sums of products by axis, (n_q, n, n), (n_q, n), (n_q,).
        low, high: bounds of the other unknowns, (n - P,).
        absent: prescribed changes of the model's parameters, by index.
        weight: initial weight of the squares of each axis, (n_q,).
        expected: prior precision of the other unknowns about zero, (n - P, n - P).
    """
    p, n = problem, xx.shape[1]
    flat = xx.reshape(len(xx), -1)
    (n_all, nb), independent = p.to_parameters.shape, p.independent
    lower = p.lower if low is None else np.append(p.lower, low)
    upper = p.upper if high is None else np.append(p.upper, high)
    precision, moment = np.zeros((n, n)), np.zeros(n)
    precision[:nb, :nb], moment[:nb] = p.precision, p.moment
    precision[nb:, nb:] = 0.0 if expected is None else expected
    given = absent or {}
    # By index: parameters first, then the other unknowns.
    fixed_at, freed = dict(given), set[int]()
    weight = independent / np.maximum(yy, 1e-300) if weight is None else weight
    while True:
        own = {k: value for k, value in fixed_at.items() if k < n_all}
        others = {k - n_all: value for k, value in fixed_at.items() if k >= n_all}
        fixed, free = p.hold(own, n)
        fixed[nb:][[*others]] = [*others.values()]
        chosen = np.delete(free, [k + free.shape[1] - n + nb for k in others], axis=1)
        for _ in range(_REWEIGHTS):
            normal = (weight @ flat).reshape(n, n) + precision
            right = moment - weight @ xy
            rest = chosen.T @ (right - normal @ fixed)
            b = fixed + chosen @ solve_scaled(chosen.T @ normal @ chosen, rest)
            left = np.maximum(yy + 2.0 * xy @ b + (xx @ b) @ b, 1e-12 * yy)
            left = left + 1e-300
            before, weight = weight, independent / left
            if np.all(np.abs(weight - before) <= _STEADY * before):
                break
        change = np.append(p.to_parameters @ b[:nb], b[nb:])
        slack = 1e-6 * (1.0 + np.abs(change))
        slack[n_all:] = 1e-12
        beyond = (change < lower - slack) | (change > upper + slack)
        if fresh := {*np.flatnonzero(beyond).tolist()} - {*fixed_at}:
            nearest = np.clip(change, lower, upper)
            fixed_at |= {k: float(nearest[k]) for k in fresh}
            continue
        if not (bounds := {*fixed_at} - {*given} - freed):
            break
        # The minimum may lie at only some of the bounds that were crossed together.
        slope = normal @ b - right
        rise = np.append(np.zeros(n_all), slope[nb:])
        rise[[*own]] = np.linalg.lstsq(p.to_parameters[[*own]].T, slope[:nb])[0]
        rise = np.where(change >= upper - slack, rise, -rise)
        inwards = {k for k in bounds if rise[k] > 0.0}
        if not inwards:
            break
        freed |= inwards
        fixed_at = {k: value for k, value in fixed_at.items() if k not in inwards}
    held = np.array([others.get(k) == 0.0 for k in range(n - nb)], dtype=bool)
    cost = float(independent @ (0.5 * np.log(left / p.count)))
    off = b[:nb]
    cost += p.fixed_cost + 0.5 * float(off @ p.precision @ off) - float(p.moment @ off)
    return LinearSolution(b, held, own, left, weight, cost)


def solve_scaled(normal: Array, right: Array) -> Array:
    """Solve a symmetric system whose unknowns have different units; ``right``: (n,) or (n, k)."""
    size = 1.0 / np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    scaled = normal * size * size[:, None]
    scaled.flat[:: len(scaled) + 1] += _RIDGE
    by = size if right.ndim == 1 else size[:, None]
    failed = not scaled.size
    if not failed:
        _, found, failed = dposv(scaled, right * by)
    # LAPACK takes nothing empty, and rounding may take the least eigenvalue below zero.
    return np.asarray((np.linalg.solve(scaled, right * by) if failed else found) * by)
