"""The cost of a set of effects: its negative log evidence beside a model.

The terms are those of docs/method_selection.md: misfit, change of variables, Occam factors, priors
of the strengths and of the set. Strengths stay within their bounds.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Self

import numpy as np
from scipy.linalg import block_diag

from bampipe.arrays import Array, Indices
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.dictionary import Atom, Dictionary, Key
from bampipe.trials.linear_problem import (
    NOTHING,
    LinearProblem,
    expect_strengths,
    solve_bounded,
    solve_scaled,
)
from bampipe.trials.linearisation import Linearisation
from bampipe.trials.samples import Samples
from bampipe.trials.scale import log_of_share

_LEAST_SLOPE = 0.2
"""Smallest geometric mean of dτ/df: below it, the equation of motion has no scale."""
_SHAPE_COST = 2.5
"""Occam factor of a shape, nats: a typical half logarithm of the information over its range."""

Products = Mapping[int, tuple[Array, Array, Array]]
"""By axis, some weighted columns, (n, m), and their products with base, (P, m), and y, (m,)."""
Make = Callable[[Sequence[Key]], Iterable[tuple[Key, Atom | None]]]


@dataclass(frozen=True)
class Solution:
    """A set with its most likely strengths.

    Attributes:
        cost: negative log evidence, nats.
        strengths: strengths of each effect, in the order of the set.
        base: change of the model's own reduced parameters.
        scale: s^2 of each axis, (n_q,).
        penalty: Occam factors and priors, nats.
        sizes: irreplaceable size of each effect, see `SetCosts._sizes`.
        weight: weight of the squares of each axis, (n_q,).
        fixed: see `LinearSolution`.
    """

    cost: float
    strengths: tuple[Array, ...] = ()
    base: Array = field(default_factory=lambda: np.zeros(0))
    scale: Array = field(default_factory=lambda: np.zeros(0))
    penalty: float = 0.0
    sizes: Sequence[float] = ()
    weight: Array = field(default_factory=lambda: np.zeros(0))
    fixed: Mapping[int, float] = field(default_factory=dict)


class SetCosts:
    """Costs of sets of candidates beside one model."""

    def __init__(
        self,
        problem: LinearProblem,
        dictionary: Dictionary,
        make: Make,
        criteria: Criteria,
        known: Mapping[Key, Atom | None],
    ) -> None:
        self.dictionary, self.make, self.criteria = dictionary, make, criteria
        self.log_prior = log_prior(criteria, len(dictionary.candidates))
        own = dictionary.linearisation.system.model.effects
        self._combined = {item.name: item.effect.combines for item in own}
        self._combined |= {name: c.combines for name, c in dictionary.candidates.items()}
        self.n_q = len(problem.y)
        self.bb = problem.sums()[0]
        self.atoms: dict[Key, Atom | None] = dict(known)
        self.least_size = criteria.size
        self._squares: dict[Key, dict[int, Array]] = {}
        self._scale_without: dict[str, tuple[dict[int, Array], Array]] = {}
        self.applied = [max(float(f @ f), 1e-300) for f in problem.likelihood.applied]
        # Columns that take part of the measured force scale or filter its noise, too.
        self._moves_noise = True
        grid = [key for name in dictionary.candidates for key in dictionary.grid(name)]
        self.ensure(grid)
        places = {key: atom for key in grid if (atom := self.atoms[key]) is not None}
        self.grid_keys = list(places)
        self._lay_out(problem, places)
        self._set_problem(problem)

    def _set_problem(self, problem: LinearProblem) -> None:
        """Set the residual and the numbers of independent samples; the columns stay."""
        self.problem = p = problem
        self.by = np.array([b.T @ y for b, y in zip(p.base, p.y, strict=True)])
        self.yy = np.array([float(y @ y) for y in p.y])
        self.xy = [x.T @ y for x, y in zip(self.columns, p.y, strict=True)]
        self._weight = p.independent / np.maximum(self.yy, 1e-300)
        self._products_by_key: dict[Key, Products] = {}
        self._solutions: dict[tuple[Key, ...], Solution] = {}
        self._own_penalties: dict[str, float] = {}

    def ensure(self, keys: Iterable[Key]) -> None:
        """Compute the columns that are missing."""
        missing = [key for key in dict.fromkeys(keys) if key not in self.atoms]
        if missing:
            self.atoms |= dict(self.make(missing))

    def _lay_out(self, p: LinearProblem, places: Mapping[Key, Atom]) -> None:
        """Join the columns of the grid by axis, and compute their products with the base."""
        widths = [a.width for a in places.values()]
        self.first_columns = np.concatenate([[0], np.cumsum(widths)])[:-1].astype(int)
        self.widths = np.array(widths, dtype=int)
        self.columns, self.column_indices, self.xb = [], [], []
        widest = int(max(widths, default=1))
        self.own_products = np.zeros((self.n_q, len(places), widest, widest))
        for axis in range(self.n_q):
            blocks, at = [], []
            for k, atom in enumerate(places.values()):
                if axis in atom.columns:
                    block = atom.columns[axis] * p.likelihood.root[axis][:, None]
                    w = block.shape[1]
                    self.own_products[axis, k, :w, :w] = block.T @ block
                    blocks.append(block)
                    at.append(np.arange(self.first_columns[k], self.first_columns[k] + w))
            x = np.concatenate(blocks, axis=1) if blocks else np.zeros((len(p.y[axis]), 0))
            self.columns.append(x)
            self.column_indices.append(np.concatenate(at) if at else np.zeros(0, dtype=int))
            self.xb.append(p.base[axis].T @ x)
        self.n_columns = int(sum(widths))
        self.lower, self.upper, self.prior_sd = self._priors(places).T

    def on_replicate(self, number: int) -> Self:
        """Return the costs on the residual of a replicate instead of the measured one."""
        other, p = copy(self), self.problem
        rows = zip(p.likelihood.noise.residuals, p.likelihood.root, strict=True)
        y = tuple(residuals[number] * root for residuals, root in rows)
        unscaled = np.zeros_like(p.log_scale_by_parameter)
        other._set_problem(replace(p, y=y, log_scale_by_parameter=unscaled))
        other._moves_noise = False
        return other

    def with_independent(self, samples: tuple[Samples, ...]) -> Self:
        """Return the costs with other numbers of independent samples."""
        other, likelihood = copy(self), replace(self.problem.likelihood, samples=samples)
        other._set_problem(replace(self.problem, likelihood=likelihood))
        other._products_by_key = self._products_by_key  # of the same residual
        return other

    def _priors(self, keys: Iterable[Key]) -> Array:
        """Return lower and upper bound and prior standard deviation of each strength, (m, 3)."""
        rows = [row for name, _ in keys for row in self.dictionary.priors(name)]
        return np.array(rows).reshape(-1, 3)

    def _atom(self, key: Key) -> Atom:
        """Return the columns of a candidate that has an effect in these trials."""
        atom = self.atoms[key]
        assert atom is not None
        return atom

    def _products(self, key: Key) -> Products:
        """Return the products of a candidate's columns."""
        if key not in self._products_by_key:
            self._products_by_key[key] = self._multiply(self._atom(key).columns)
        return self._products_by_key[key]

    def _multiply(self, columns: Mapping[int, Array]) -> Products:
        """Return the products of columns, (n, m) by axis."""
        p, found = self.problem, {}
        for axis, column in columns.items():
            x = column * p.likelihood.root[axis][:, None]
            found[axis] = x, p.base[axis].T @ x, x.T @ p.y[axis]
        return found

    def solve(self, keys: Sequence[Key]) -> Solution:
        """Return the most likely strengths of a set within their bounds, and its cost."""
        keys = tuple(sorted(keys))
        if keys not in self._solutions:
            self._solutions[keys] = self._solve(keys)
        return self._solutions[keys]

    def cost(self, keys: Sequence[Key]) -> float:
        """Return the negative log evidence of a set, nats."""
        return self.solve(keys).cost

    def _solve(self, all_keys: tuple[Key, ...]) -> Solution:
        p, nb = self.problem, self.bb.shape[1]
        absent, keys = p.removal(removed_effects(all_keys)), added_effects(all_keys)
        # Two delays of the same forces, or one beside the nuisance parameter, make a low-pass.
        delays = sum(self.dictionary.candidates[name].takes_timing for name, _ in keys)
        if delays:
            absent |= p.no_delay
        present = self.dictionary.linearisation.system.timing_effects
        delays += bool(present.difference(removed_effects(all_keys)))
        if delays > 1 or any(self.atoms.get(key) is None for key in keys):
            return Solution(np.inf)
        xx, xy, places = self._sums(keys)
        priors = self._priors(keys)
        bounds, spread = priors[:, :2], priors[:, 2]
        # A strength that changes nothing over its whole prior is zero.
        bounds[np.einsum("a,akk->k", self._weight, xx[:, nb:, nb:]) * spread**2 < NOTHING**2] = 0.0
        expected = self._expected(keys)
        solved = solve_bounded(
            p, xx, xy, self.yy, bounds[:, 0], bounds[:, 1], absent, self._weight, expected
        )
        b, weight, n = solved.unknowns, solved.weight, xx.shape[1]
        held = [slice(i.start - nb, i.stop - nb) for i in places]
        if any(solved.held[h].all() for h in held):
            return Solution(np.inf)
        strengths = tuple(b[nb:][h] for h in held)
        scale = solved.left / p.count
        volume = self._volume(self._log_slopes(all_keys, strengths, scale))
        if volume is None:
            return Solution(np.inf)
        # The cost contains the scale to second order in the model's parameters, absent ones too.
        places_of, change = list(absent), np.array([*absent.values()])
        first = p.log_scale_by_parameter[:, places_of] @ change
        volume = volume - p.independent * (first - 0.5 * first**2)
        sizes = list[float]()
        # The cost of the model does not contain the priors of its own effects.
        penalty = self.penalty_of(all_keys) + 0.5 * float(b[nb:] @ expected @ b[nb:])
        if keys:
            normal = np.tensordot(weight, xx, 1)
            normal[:nb, :nb] += p.precision
            normal[nb:, nb:] += expected
            used = np.flatnonzero(~solved.held)
            # A removed effect stays removed, so that a twin can take its place.
            if absent:
                free = p.hold(absent, n)[1]
                normal = free.T @ normal @ free
            # The information on the strengths after the model's own parameters have adapted.
            start = nb - (n - len(normal))
            cross = normal[:start, start:]
            inside = normal[start:, start:] - cross.T @ solve_scaled(normal[:start, :start], cross)
            inside = inside[np.ix_(used, used)]
            own = np.tensordot(weight, xx[:, nb:, nb:], 1)[np.ix_(used, used)]
            member = np.repeat(np.arange(len(keys)), [h.stop - h.start for h in held])[used]
            sizes = self._sizes(keys, strengths, b[nb:][used], inside, own, member)
            if any(size < self.least_size for size in sizes):
                return Solution(np.inf)
            shapes = sum(len(key[1]) for key in keys)
            penalty += float(penalise(inside, spread[used], b[nb:][used], shapes))
        cost = solved.cost - float(volume.sum()) + penalty
        return Solution(cost, strengths, b[:nb], scale, penalty, sizes, weight, solved.fixed)

    def _sums(
        self, keys: Sequence[Key], more: Sequence[Products] = ()
    ) -> tuple[Array, Array, list[slice]]:
        """Return products of base and columns, ``more`` last, with each other and with y, by axis.

        They are (n_q, n, n) and (n_q, n); the slices of each member among the n come third.
        """
        nb, parts = self.bb.shape[1], [*map(self._products, keys), *more]
        widths = [next(iter(part.values()))[0].shape[1] for part in parts]
        ends = nb + np.cumsum([0, *widths], dtype=int)
        n, places = int(ends[-1]), [slice(*map(int, pair)) for pair in pairwise(ends)]
        xx, xy = np.zeros((self.n_q, n, n)), np.zeros((self.n_q, n))
        xx[:, :nb, :nb], xy[:, :nb] = self.bb, self.by
        for k, (i, part) in enumerate(zip(places, parts, strict=True)):
            for axis, (x, xb, with_y) in part.items():
                xx[axis, :nb, i], xx[axis, i, :nb], xy[axis, i] = xb, xb.T, with_y
                for j, other in zip(places[: k + 1], parts, strict=False):
                    if axis in other:
                        xx[axis, i, j] = x.T @ other[axis][0]
                        xx[axis, j, i] = xx[axis, i, j].T
        return xx, xy, places

    def _sizes(
        self,
        keys: Sequence[Key],
        strengths: Sequence[Array],
        b: Array,
        inside: Array,
        own: Array,
        place: Indices,
    ) -> list[float]:
        """Return the size of each effect beyond what other parameters could absorb.

        It is a root mean square over that of the applied force, on the axis where it is largest.
        """
        spread, sizes = np.linalg.pinv(inside, hermitian=True), []
        for k, (key, strength) in enumerate(zip(keys, strengths, strict=True)):
            at = np.flatnonzero(place == k)
            here = np.ix_(at, at)
            if len(at) == 1:
                alone = float(b[at[0]]) ** 2 / max(float(spread[here][0, 0]), 1e-300)
            else:
                alone = float(b[at] @ np.linalg.pinv(spread[here], hermitian=True) @ b[at])
            share = alone / max(float(b[at] @ own[here] @ b[at]), 1e-300)
            sizes.append(self._size(key, strength) * float(np.sqrt(max(share, 0.0))))
        return sizes

    def _size(self, key: Key, strength: Array) -> float:
        """Return the root mean square of an effect over that of the applied force of an axis."""
        return max(
            float(np.sqrt(max(float(strength @ square @ strength), 0.0) / self.applied[axis]))
            for axis, square in self._squares_of(key).items()
        )

    def _squares_of(self, key: Key) -> dict[int, Array]:
        """Return the unweighted products of a candidate's columns, by axis, (m, m)."""
        if key not in self._squares:
            self._squares[key] = {a: c.T @ c for a, c in self._atom(key).columns.items()}
        return self._squares[key]

    def _expected(self, keys: Sequence[Key]) -> Array:
        """Return the prior precision of the strengths of a set, `expect_strengths`, (m, m)."""
        applied = self.problem.likelihood.applied
        parts = [self._squares_of(key) for key in keys]
        blocks = [expect_strengths([*x.values()], [applied[a] for a in x]) for x in parts]
        return np.asarray(block_diag(*blocks)) if blocks else np.zeros((0, 0))

    def volume_where_fitted(
        self, keys: Sequence[Key], linearisation: Linearisation
    ) -> Array | None:
        """Return the change of variables of a set at the parameters of a model fitted with it."""
        base = self.dictionary.linearisation
        gain, scale = linearisation.filter_gain[0] / base.filter_gain[0], self.solve(keys).scale
        rows = self._log_of_slopes([({}, gain)], scale)
        scale = linearisation.log_scale[0] - base.log_scale[0]
        return self._volume([r + here for r, here in zip(rows, scale, strict=True)])

    def _volume(self, rows: Sequence[Array]) -> Array | None:
        """Return the change of variables of each axis, or None if the equation has no scale.

        ``rows`` are the logarithms of the factors on the measured force at each sample, by axis.
        """
        means = np.array([float(r.mean()) if len(r) else 0.0 for r in rows])
        left = self.dictionary.linearisation.log_scale[0] + means
        if (left < np.log(_LEAST_SLOPE)).any():
            return None
        return np.asarray(self.problem.independent * means * self._moves_noise)

    def _log_slopes(
        self, keys: Sequence[Key], strengths: Sequence[Array], scale: Array
    ) -> list[Array]:
        """Return the log of the factor of a set on the measured force, by axis, (n,)."""
        atoms = [self._atom(key) for key in added_effects(keys)]
        each = [
            ({axis: slope @ b for axis, slope in atom.slopes.items()}, atom.gain)
            for atom, b in zip(atoms, strengths, strict=True)
        ]
        return self._log_of_slopes([*each, *map(self._without, removed_effects(keys))], scale)

    def _without(self, name: str) -> tuple[dict[int, Array], Array]:
        """Return the slopes and the gain of the removal of one of the model's effects."""
        if name not in self._scale_without:
            absence = self.problem.absence[name]
            self._scale_without[name] = self.dictionary.scale_without(name, absence)
        return self._scale_without[name]

    def _log_of_slopes(
        self, each: Sequence[tuple[Mapping[int, Array], Array]], scale: Array
    ) -> list[Array]:
        """Return `_log_slopes` of effects with given slopes, by axis, (n, n_forces), and gains."""
        found = [np.zeros(len(y)) for y in self.problem.y]
        moved: dict[int, Array] = {}
        gains = np.ones(self.n_q)
        for slopes, gain in each:
            for axis, slope in slopes.items():
                moved[axis] = moved.get(axis, 0.0) + slope
            gains *= gain
        likelihood = self.problem.likelihood
        for axis in map(int, np.flatnonzero(gains != 1.0)):
            filtered = likelihood.log_of_filter(axis, gains[axis], float(scale[axis]))
            found[axis] = found[axis] + filtered
        for axis, slope in moved.items():
            found[axis] = found[axis] + log_of_share(likelihood.slopes[axis], slope)
        return found

    def penalty_of(self, keys: Sequence[Key]) -> float:
        """Return the cost of the prior of a set, less the priors of the effects it removes."""
        away = removed_effects(keys)
        saved = sum(self._penalty_of_own(name) for name in away)
        fewer = sum(self._combined[name] for name in away)
        more = sum(self._combined[name] for name, _ in added_effects(keys))
        return self.log_prior * (fewer - more) - saved

    def _penalty_of_own(self, name: str) -> float:
        """Return the cost of the priors of the parameters of one of the model's effects."""
        if name not in self._own_penalties:
            # As for a candidate, the information on the strengths is that at a given shape.
            p, e, shapes = self.problem, self.dictionary.linearisation, self.problem.shapes[name]
            away = {k: change for k, change in p.absence[name].items() if k not in shapes}
            free = p.hold(dict.fromkeys(shapes, 0.0))[1]
            to = p.to_parameters[list(away)] @ free
            normal = np.tensordot(self.solve(()).weight, self.bb, 1) + p.precision
            spread = to @ solve_scaled(free.T @ normal @ free, to.T)
            strengths = np.array(list(away.values()))
            known: Array = np.asarray(np.linalg.pinv(spread, hermitian=True), dtype=float)
            prior_sd = np.array([e.system.parameters[e.free[k]].sd for k in away])
            # What a search leaves at its prior costs a candidate nothing.
            searched = sum(e.system.parameters[e.free[k]].searched for k in shapes)
            own = penalise(known, prior_sd, strengths, searched)
            self._own_penalties[name] = float(own)
        return self._own_penalties[name]

    def residual_rows(self, keys: Sequence[Key]) -> list[Array]:
        """Return the residual of a set in units of the noise, by axis, (n,)."""
        solution = self.solve(keys)
        left = [*self.problem.residual_rows(solution.base)]
        for key, strength in zip(
            added_effects(tuple(sorted(keys))), solution.strengths, strict=True
        ):
            for axis, (x, _, _) in self._products(key).items():
                left[axis] = left[axis] + x @ strength
        return left

    def size_of_own(self, name: str) -> float:
        """Return the size of an effect of the model beyond what the rest could absorb.

        It is a root mean square over that of the applied force, on the axis where it is largest.
        """
        rows = zip(self.residual_rows(((f"-{name}", ()),)), self.residual_rows(()), strict=True)
        moved = [(a - b) / r for (a, b), r in zip(rows, self.problem.likelihood.root, strict=True)]
        return max(float(np.sqrt(x @ x / f)) for x, f in zip(moved, self.applied, strict=True))

    def volume_rows(self, keys: Sequence[Key]) -> list[Array]:
        """Return the log of the factor of a set on the measured force, by axis, (n,)."""
        solution = self.solve(keys)
        return self._log_slopes(tuple(sorted(keys)), solution.strengths, solution.scale)

    def gains(self, keys: Sequence[Key]) -> Array:
        """Return the fall of the cost of a set by each key of the grid, at the set's weights."""
        known, p, nb = self.solve(keys), self.problem, self.bb.shape[1]
        keys = added_effects(tuple(sorted(keys)))
        weight = known.weight
        xx, _, places = self._sums(keys)
        n = xx.shape[1]
        normal = np.tensordot(weight, xx, 1)
        normal[:nb, :nb] += p.precision
        cross, moment = np.zeros((n, self.n_columns)), np.zeros(self.n_columns)
        for axis in range(self.n_q):
            w, cols = weight[axis], self.column_indices[axis]
            cross[:nb, cols] += w * self.xb[axis]
            moment[cols] -= w * self.xy[axis]
            for i, key in zip(places, keys, strict=True):
                if axis in (part := self._products(key)):
                    cross[i, cols] += w * (part[axis][0].T @ self.columns[axis])
        # The gains start from the solution of the set; a parameter at its bound stays there.
        b = np.concatenate([known.base, *known.strengths])
        moment = moment - cross.T @ b
        free = p.hold(known.fixed, n)[1]
        taken = free @ solve_scaled(free.T @ normal @ free, free.T @ cross)
        widest = self.own_products.shape[2]
        numbers, widths = np.arange(widest), self.widths[:, None]
        place, valid = (
            self.first_columns[:, None] + np.minimum(numbers, widths - 1),
            numbers < widths,
        )
        block = np.tensordot(weight, self.own_products, 1)
        c, t = cross.T[place], taken.T[place]
        block = block - c @ t.transpose(0, 2, 1)
        mom = np.where(valid, moment[place], 0.0)
        low, high = self.lower[place], self.upper[place]
        own = np.einsum("kww->kw", np.tensordot(weight, self.own_products, 1))
        least = np.maximum(1e-6 * own, (NOTHING / np.where(valid, self.prior_sd[place], 1.0)) ** 2)
        active = valid & (np.einsum("kww->kw", block) > least)
        gain = np.zeros(len(self.grid_keys))
        for _ in range(widest + 1):
            masked = block * (active[:, :, None] & active[:, None, :])
            diagonal = np.einsum("kww->kw", masked)
            scale = np.where(active, 1.0 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)
            ridge = np.eye(widest) * np.where(active, 1e-9, 1.0)[:, :, None]
            system = masked * scale[:, :, None] * scale[:, None, :] + ridge
            right = (np.where(active, mom, 0.0) * scale)[:, :, None]
            x = np.linalg.solve(system, right)[:, :, 0] * scale
            out = active & (
                (x < np.minimum(low, 0.0) - 1e-12)
                | (x > np.maximum(high, 0.0) + 1e-12)
                | ((x < 0) & (low >= 0))
                | ((x > 0) & (high <= 0))
            )
            gain = 0.5 * np.einsum("kw,kw->k", np.where(active, mom, 0.0), x)
            if not out.any():
                break
            active &= ~out
        # A single strength may gain at its bound, as those of shorter delays than the true one do.
        only = np.flatnonzero(self.widths == 1)
        square, moment = block[only, 0, 0], mom[only, 0]
        x = np.clip(moment / np.maximum(square, 1e-300), low[only, 0], high[only, 0])
        held = np.where(square > least[only, 0], (moment - 0.5 * square * x) * x, 0.0)
        gain[only] = np.maximum(held, 0.0)
        return gain


def log_prior(criteria: Criteria, number: int) -> float:
    """Return the log prior odds of each of a ``number`` of candidates."""
    return min(float(np.log(criteria.expected_effects / max(number, 1))), 0.0)


def penalise(information: Array, spread: Array, strengths: Array, shapes: int) -> Array:
    """Return the Occam factors of effects (Laplace), nats, (...).

    Args:
        information: information on the strengths, (m, m).
        spread: their prior standard deviations, (m,); strengths: (..., m).
        shapes: number of searched shapes.
    """
    wide = np.maximum(spread, np.abs(strengths))
    scaled = information * wide[..., :, None] * wide[..., None, :]
    found = 0.5 * np.linalg.slogdet(np.eye(len(information)) + scaled)[1]
    return np.asarray(found + _SHAPE_COST * shapes)


def added_effects(keys: Sequence[Key]) -> tuple[Key, ...]:
    """Return the effects that a set adds to the model; a key ``-name`` removes one."""
    return tuple(key for key in keys if key[0][0] != "-")


def removed_effects(keys: Sequence[Key]) -> tuple[str, ...]:
    """Return the effects of the model that a set removes."""
    return tuple(name[1:] for name, _ in keys if name[0] == "-")


def effect_names(keys: Sequence[Key]) -> tuple[str, ...]:
    """Return the names of the keys of a set in order."""
    return tuple(sorted(name for name, _ in keys))
