"""The search over sets of effects, each weighed whole, its shapes refined, its bounds held.

The cost of a set is its negative log evidence: half of n log s^2 on each axis, with s^2 what the
set leaves in units of the noise; the logarithm of what it takes off the measured quantity, so that
nothing is explained by making both sides of the equation small; and by the priors of its parameters
(Laplace) and of the set itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from bampipe.arrays import Array, Indices
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.dictionary import Atom, Dictionary, Key
from bampipe.trials.evidence import Evidence
from bampipe.trials.likelihood import (
    NOTHING,
    Problem,
    Samples,
    solve_bounded,
    solve_scaled,
)
from bampipe.trials.scale import log_of_share

_STEP = 0.02
"""Of a shape's range: the step of its slope."""
_FARTHEST = 0.2
_LEAST_SLOPE = 0.2
"""Geometric mean of what a set leaves of the slope by the force; below, nothing has a scale."""

_BESIDE, _PROMISING, _SWAPPED = 24, 8, 5
"""Candidates weighed exactly beside a set that grows, beside one that lost a member, and of those
the ones whose shapes are refined."""
_SWAPS, _POLISHED = 3, 4
_ROUNDS = 12
"""Of the refinement of shapes, as long as each gains: an impact moves with the width of its gap,
and one that comes too late looks like none."""

Pool = dict[tuple[str, ...], tuple[float, tuple[Key, ...]]]
"""Sets by the names of their members, each with its cost and shapes."""
Make = Callable[[Sequence[Key]], Iterable[tuple[Key, Atom | None]]]


@dataclass(frozen=True)
class Solution:
    """A set with its best strengths.

    Attributes:
        cost: negative log evidence, nats.
        strengths: of each effect, in the order of the set.
        base: change of the model's own reduced parameters.
        scale: s^2 by axis, (n_q,).
        volume: log of what is left of the measured quantity, summed over samples, by axis.
        penalty: what the priors take off.
    """

    cost: float
    strengths: tuple[Array, ...] = ()
    base: Array = field(default_factory=lambda: np.zeros(0))
    scale: Array = field(default_factory=lambda: np.zeros(0))
    volume: Array = field(default_factory=lambda: np.zeros(0))
    penalty: float = 0.0
    sizes: tuple[float, ...] = ()
    weight: Array = field(default_factory=lambda: np.zeros(0))


class Search:
    """Weighs sets of candidates against one model."""

    def __init__(
        self,
        problem: Problem,
        dictionary: Dictionary,
        make: Make,
        criteria: Criteria,
        known: Mapping[Key, Atom | None],
    ) -> None:
        self.p, self.dictionary, self.make, self.criteria = problem, dictionary, make, criteria
        self.log_prior = log_prior(criteria, len(dictionary.candidates))
        p = problem
        self.n_q = len(p.y)
        self.bb, self.by, self.yy = p.sums()
        self.atoms: dict[Key, Atom | None] = dict(known)
        self._with_base: dict[Key, dict[int, tuple[Array, Array, Array]]] = {}
        self._solved: dict[tuple[Key, ...], Solution] = {}
        self._own_penalties: dict[str, float] = {}
        self.least_size = criteria.size
        self._squares: dict[Key, dict[int, Array]] = {}
        self._scale_without: dict[str, tuple[dict[int, Array], Array]] = {}
        self.applied = [max(float(f @ f), 1e-300) for f in p.likelihood.applied]
        self._weight = p.independent / np.maximum(self.yy, 1e-300)
        grid = [key for name in dictionary.candidates for key in dictionary.grid(name)]
        self.ensure(grid)
        places = {key: atom for key in grid if (atom := self.atoms[key]) is not None}
        self.places = list(places)
        self._lay_out(places)

    def ensure(self, keys: Iterable[Key]) -> None:
        """Make the columns of what has none yet."""
        missing = [key for key in dict.fromkeys(keys) if key not in self.atoms]
        if missing:
            self.atoms |= dict(self.make(missing))

    def _lay_out(self, places: Mapping[Key, Atom]) -> None:
        """All columns of the grid side by side, axis by axis, and their products with the base."""
        widths = [a.width for a in places.values()]
        self.first = np.concatenate([[0], np.cumsum(widths)])[:-1].astype(int)
        self.widths = np.array(widths, dtype=int)
        m = int(sum(widths))
        p = self.p
        self.columns, self.at = [], []
        self.own = np.zeros(
            (self.n_q, len(places), int(max(widths, default=1)), int(max(widths, default=1)))
        )
        self.xb, self.xy = [], []
        for axis in range(self.n_q):
            blocks, at = [], []
            for k, atom in enumerate(places.values()):
                if axis in atom.columns:
                    block = atom.columns[axis] * p.likelihood.root[axis][:, None]
                    w = block.shape[1]
                    self.own[axis, k, :w, :w] = block.T @ block
                    blocks.append(block)
                    at.append(np.arange(self.first[k], self.first[k] + w))
            x = np.concatenate(blocks, axis=1) if blocks else np.zeros((len(p.y[axis]), 0))
            self.columns.append(x)
            self.at.append(np.concatenate(at) if at else np.zeros(0, dtype=int))
            self.xb.append(p.base[axis].T @ x)
            self.xy.append(x.T @ p.y[axis])
        self.m = m
        bounds = [b for key in places for b in self.dictionary.bounds(key[0])]
        self.low, self.high = np.array(bounds).reshape(-1, 2).T
        self.spread = np.array([v for key in places for v in self.dictionary.spreads(key[0])])

    def of_replay(self, replay: int) -> Search:
        """The same search with the residual of a replay in place of the measured trials."""
        other = copy(self)
        p, noise = self.p, self.p.likelihood.noise
        rows = zip(noise.residuals, p.likelihood.root, strict=True)
        other.p = replace(p, y=tuple(r[replay] * root for r, root in rows))
        other.by = np.array([b.T @ y for b, y in zip(p.base, other.p.y, strict=True)])
        other.yy = np.array([float(y @ y) for y in other.p.y])
        other.xy = [x.T @ y for x, y in zip(self.columns, other.p.y, strict=True)]
        other._with_base, other._solved = {}, {}
        other._weight = p.independent / np.maximum(other.yy, 1e-300)
        return other

    def with_independent(self, samples: tuple[Samples, ...]) -> Search:
        """The same search with other numbers of independent samples."""
        other = copy(self)
        other.p = replace(self.p, likelihood=replace(self.p.likelihood, samples=samples))
        other._solved, other._own_penalties = {}, {}
        other._weight = other.p.independent / np.maximum(self.yy, 1e-300)
        return other

    def largest_gain(self) -> tuple[float, str]:
        """Log evidence of the candidate that gains most beside the model, nats, and its name.

        Of whatever size: chance has no other.
        """
        any_size = copy(self)
        any_size.least_size, any_size._solved = 0.0, {}
        beside = any_size.best_beside((), _PROMISING)
        if not beside:
            return 0.0, ""
        cost, key = beside[0]
        return any_size.cost(()) - cost, key[0]

    # --- one set -------------------------------------------------------------------------------

    def _atom(self, key: Key) -> Atom:
        """The columns of a candidate that does something in these trials."""
        atom = self.atoms[key]
        assert atom is not None
        return atom

    def _products(self, key: Key) -> dict[int, tuple[Array, Array, Array]]:
        """By axis: weighted columns of an atom, their products with the base and with y."""
        if key not in self._with_base:
            atom, p = self._atom(key), self.p
            found = {}
            for axis, columns in atom.columns.items():
                x = columns * p.likelihood.root[axis][:, None]
                found[axis] = x, p.base[axis].T @ x, x.T @ p.y[axis]
            self._with_base[key] = found
        return self._with_base[key]

    def solve(self, keys: Sequence[Key]) -> Solution:
        """The best strengths of a set within their bounds, and its cost."""
        keys = tuple(sorted(keys))
        if keys not in self._solved:
            self._solved[keys] = self._solve(keys)
        return self._solved[keys]

    def _solve(self, all_keys: tuple[Key, ...]) -> Solution:
        p, nb = self.p, self.bb.shape[1]
        absent = {
            place: change
            for name, _ in all_keys
            if name[0] == "-"
            for place, change in p.absence[name[1:]].items()
        }
        keys = added(all_keys)
        if any(self.atoms.get(key) is None for key in keys):
            return Solution(np.inf)
        xx, xy, places = self._sums(keys)
        bounds = np.array([x for key in keys for x in self.dictionary.bounds(key[0])]).reshape(
            -1, 2
        )
        spread = np.array([s for key in keys for s in self.dictionary.spreads(key[0])])
        # What a strength of any size leaves as it is has none.
        bounds[np.einsum("a,akk->k", self._weight, xx[:, nb:, nb:]) * spread**2 < NOTHING**2] = 0.0
        solved = solve_bounded(p, xx, xy, self.yy, bounds[:, 0], bounds[:, 1], absent, self._weight)
        b, weight, n = solved.unknowns, solved.weight, xx.shape[1]
        held = [slice(i.start - nb, i.stop - nb) for i in places]
        if any(solved.held[h].all() for h in held):
            return Solution(np.inf)
        strengths = tuple(b[nb:][h] for h in held)
        scale = solved.left / p.count
        volume = self._volume(self._log_slopes(all_keys, strengths, scale))
        if volume is None:
            return Solution(np.inf)
        # The cost has what its own parameters leave of the scale in second order, absent ones, too.
        places_of, change = list(absent), np.array([*absent.values()])
        first = self.dictionary.evidence.log_scale[1][:, places_of] @ change
        volume = volume - p.independent * (first - 0.5 * first**2)
        sizes: tuple[float, ...] = ()
        # What an effect of the model costs is not in the cost of the model as it is.
        penalty = self.penalty_of(all_keys)
        if keys:
            products = np.tensordot(weight, xx, 1)
            normal = products.copy()
            normal[:nb, :nb] += p.precision
            used = np.flatnonzero(~solved.held)
            # What a set takes away does not move along: its place can be taken by a twin of it.
            if absent:
                free = p.hold(absent, n)[1]
                normal = free.T @ normal @ free
            inside = _schur(normal, nb - (n - len(normal)))[np.ix_(used, used)]
            own = np.tensordot(weight, xx[:, nb:, nb:], 1)[np.ix_(used, used)]
            member = np.repeat(np.arange(len(keys)), [h.stop - h.start for h in held])[used]
            sizes = self._sizes(keys, strengths, b[nb:][used], inside, own, member)
            for k, size in enumerate(sizes):
                # Nor can what others would take over beyond their bounds.
                if (
                    size < self.least_size
                    and self._size_within_bounds(all_keys, k, strengths, b, products)
                    < self.least_size
                ):
                    return Solution(np.inf)
            shapes = sum(len(key[1]) for key in keys)
            penalty += float(penalise(inside, spread[used], b[nb:][used], shapes))
        cost = solved.cost - float(volume.sum()) + penalty
        return Solution(cost, strengths, b[:nb], scale, volume, penalty, sizes, weight)

    def _sums(self, keys: Sequence[Key]) -> tuple[Array, Array, list[slice]]:
        """Products by axis of the base and the columns of a set, with each other and with y.

        Returns:
            (n_q, n, n), (n_q, n), and the places of each member among the n.
        """
        nb, parts = self.bb.shape[1], [self._products(key) for key in keys]
        ends = nb + np.cumsum([0, *(self._atom(key).width for key in keys)], dtype=int)
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
    ) -> tuple[float, ...]:
        """What each effect adds as far as nothing else in the model takes its place.

        As a share of the applied force of the axis where that is largest.
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
        return tuple(sizes)

    def _size_within_bounds(
        self,
        all_keys: tuple[Key, ...],
        number: int,
        strengths: Sequence[Array],
        b: Array,
        products: Array,
    ) -> float:
        """What an effect of a set adds as far as the best set without it, within bounds, does not.

        Args:
            all_keys: the set; number: of the effect; strengths: of each; b: all unknowns, (n,).
            products: weighted, of all columns, (n, n).
        """
        key = added(all_keys)[number]
        rest = self.solve(tuple(other for other in all_keys if other != key))
        if not np.isfinite(rest.cost):
            return 0.0
        others = [*rest.strengths[:number], np.zeros_like(strengths[number]),
                  *rest.strengths[number:]]  # fmt: skip
        moved = b - np.concatenate([rest.base, *others])
        start = len(rest.base) + sum(map(len, strengths[:number]))
        alone = slice(start, start + len(strengths[number]))
        whole = float(b[alone] @ products[alone, alone] @ b[alone])
        share = float(moved @ products @ moved) / max(whole, 1e-300)
        return self._size(key, strengths[number]) * float(np.sqrt(max(share, 0.0)))

    def _size(self, key: Key, strength: Array) -> float:
        """What an effect adds over the applied force of an axis, root mean square, the largest."""
        if key not in self._squares:
            self._squares[key] = {a: c.T @ c for a, c in self._atom(key).columns.items()}
        return max(
            float(np.sqrt(max(float(strength @ square @ strength), 0.0) / self.applied[axis]))
            for axis, square in self._squares[key].items()
        )

    def volume_where_fitted(self, keys: Sequence[Key], evidence: Evidence) -> Array | None:
        """`Solution.volume` of a set with the parameters of a model that was fitted with it."""
        known = {q.name: v for q, v in zip(evidence.system.parameters, evidence.p, strict=True)}
        gains = [self.dictionary.gain_with(name, known) for name, _ in added(keys)]
        gains += [self._without(name)[1] for name in gone(keys)]
        filters: list[tuple[dict[int, Array], Array]] = [({}, gain) for gain in gains]
        scale = evidence.log_scale[0] - self.dictionary.evidence.log_scale[0]
        rows = self._log_of_slopes(filters, self.solve(keys).scale)
        return self._volume([r + here for r, here in zip(rows, scale, strict=True)])

    def _volume(self, rows: Sequence[Array]) -> Array | None:
        """By axis, independent samples times the mean log of what is left of what was measured.

        None where so little is left of the force that the equation has no scale.
        """
        means = np.array([float(r.mean()) if len(r) else 0.0 for r in rows])
        left = self.dictionary.evidence.log_scale[0] + means
        return None if (left < np.log(_LEAST_SLOPE)).any() else self.p.independent * means

    def _log_slopes(
        self, keys: Sequence[Key], strengths: Sequence[Array], scale: Array
    ) -> list[Array]:
        """Of each sample, the log of what a set leaves of the measured quantity, by axis."""
        atoms = [self._atom(key) for key in added(keys)]
        each = [
            ({axis: slope @ b for axis, slope in atom.slopes.items()}, atom.gain)
            for atom, b in zip(atoms, strengths, strict=True)
        ]
        return self._log_of_slopes([*each, *map(self._without, gone(keys))], scale)

    def _without(self, name: str) -> tuple[dict[int, Array], Array]:
        """Slopes and gain that it adds to take one of the model's own effects away."""
        if name not in self._scale_without:
            absence = self.p.absence[name]
            self._scale_without[name] = self.dictionary.scale_without(name, absence)
        return self._scale_without[name]

    def _log_of_slopes(
        self, each: Sequence[tuple[Mapping[int, Array], Array]], scale: Array
    ) -> list[Array]:
        """The same of slopes, by axis, (n, n_forces), and gains of each effect."""
        found = [np.zeros(len(y)) for y in self.p.y]
        moved: dict[int, Array] = {}
        gains = np.ones(self.n_q)
        for slopes, gain in each:
            for axis, slope in slopes.items():
                moved[axis] = moved.get(axis, 0.0) + slope
            gains *= gain
        # A filter takes off the noise of the forces, and what is beyond that of replays; that of
        # the motion stays.
        for axis in map(int, np.flatnonzero(gains != 1.0)):
            kept = (1.0 - self.p.likelihood.force_share[axis]) / max(float(scale[axis]), 1.0)
            found[axis] = found[axis] + 0.5 * np.log(kept + (1.0 - kept) * gains[axis])
        for axis, slope in moved.items():
            found[axis] = found[axis] + log_of_share(self.p.likelihood.slopes[axis], slope)
        return found

    def penalty_of(self, keys: Sequence[Key]) -> float:
        """What the prior of a set costs, without that of the parameters it adds.

        Of effects of the model, what is gained where they are taken away.
        """
        away = gone(keys)
        saved = sum(self._penalty_of_own(name) for name in away)
        return self.log_prior * (len(away) - len(added(keys))) - saved

    def _penalty_of_own(self, name: str) -> float:
        """What the priors of the parameters of one of the model's effects cost."""
        if name not in self._own_penalties:
            # Of a candidate, too, the information on its strengths is that at its shape.
            p, shapes = self.p, self.p.shapes[name]
            away = {k: change for k, change in p.absence[name].items() if k not in shapes}
            free = p.hold(dict.fromkeys(shapes, 0.0))[1]
            to = p.to_parameters[list(away)] @ free
            normal = np.tensordot(self.solve(()).weight, self.bb, 1) + p.precision
            spread = to @ solve_scaled(free.T @ normal @ free, to.T)
            strengths = np.array(list(away.values()))
            known: Array = np.asarray(np.linalg.pinv(spread, hermitian=True), dtype=float)
            own = penalise(known, p.spread[name], strengths, len(shapes))
            self._own_penalties[name] = float(own)
        return self._own_penalties[name]

    def residual_rows(self, keys: Sequence[Key]) -> list[Array]:
        """What a set leaves, in units of the noise, by axis, each (n,)."""
        solution = self.solve(keys)
        left = [y + b @ solution.base for y, b in zip(self.p.y, self.p.base, strict=True)]
        for key, strength in zip(added(tuple(sorted(keys))), solution.strengths, strict=True):
            for axis, (x, _, _) in self._products(key).items():
                left[axis] = left[axis] + x @ strength
        return left

    def size_of_own(self, name: str) -> float:
        """What an effect of the model adds as far as the model without it does not.

        Root mean square over that of the applied force, of the axis where that is largest.
        """
        rows = zip(self.residual_rows(((f"-{name}", ()),)), self.residual_rows(()), strict=True)
        moved = [(a - b) / r for (a, b), r in zip(rows, self.p.likelihood.root, strict=True)]
        return max(float(np.sqrt(x @ x / f)) for x, f in zip(moved, self.applied, strict=True))

    def volume_rows(self, keys: Sequence[Key]) -> list[Array]:
        """Of each sample, the log of what a set leaves of the measured quantity, by axis."""
        solved = self.solve(keys)
        return self._log_slopes(tuple(sorted(keys)), solved.strengths, solved.scale)

    def cost(self, keys: Sequence[Key]) -> float:
        """Negative log evidence of a set, nats."""
        return self.solve(keys).cost

    # --- all candidates beside a set -------------------------------------------------------------

    def gains(self, keys: Sequence[Key]) -> Array:
        """What each place of the grid would take off the cost beside a set, at its weights."""
        known, p, nb = self.solve(keys), self.p, self.bb.shape[1]
        all_keys, keys = keys, added(tuple(sorted(keys)))
        weight = known.weight
        xx, _, places = self._sums(keys)
        n = xx.shape[1]
        normal = np.tensordot(weight, xx, 1)
        normal[:nb, :nb] += p.precision
        cross, moment = np.zeros((n, self.m)), np.zeros(self.m)
        for axis in range(self.n_q):
            w, cols = weight[axis], self.at[axis]
            cross[:nb, cols] += w * self.xb[axis]
            moment[cols] -= w * self.xy[axis]
            for i, key in zip(places, keys, strict=True):
                if axis in (part := self._products(key)):
                    cross[i, cols] += w * (part[axis][0].T @ self.columns[axis])
        # As the set has been solved within bounds, from there.
        b = np.concatenate([known.base, *known.strengths])
        moment = moment - cross.T @ b
        free = self._free_of(all_keys, n)
        taken = free @ solve_scaled(free.T @ normal @ free, free.T @ cross)
        widest = self.own.shape[2]
        place = self.first[:, None] + np.minimum(np.arange(widest), self.widths[:, None] - 1)
        valid = np.arange(widest) < self.widths[:, None]
        block = np.tensordot(weight, self.own, 1)
        c, t = cross.T[place], taken.T[place]
        block = block - c @ t.transpose(0, 2, 1)
        mom = np.where(valid, moment[place], 0.0)
        low, high = self.low[place], self.high[place]
        own = np.einsum("kww->kw", np.tensordot(weight, self.own, 1))
        least = np.maximum(1e-6 * own, (NOTHING / np.where(valid, self.spread[place], 1.0)) ** 2)
        active = valid & (np.einsum("kww->kw", block) > least)
        gain = np.zeros(len(self.places))
        for _ in range(widest + 1):
            masked = block * (active[:, :, None] & active[:, None, :])
            diagonal = np.einsum("kww->kw", masked)
            scale = np.where(active, 1.0 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)
            system = (
                masked * scale[:, :, None] * scale[:, None, :]
                + np.eye(widest) * np.where(active, 1e-9, 1.0)[:, :, None]
            )
            x = (
                np.linalg.solve(system, (np.where(active, mom, 0.0) * scale)[:, :, None])[:, :, 0]
                * scale
            )
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
        # Of one strength that its bounds hold, at the bound: a delay's columns of shorter ones.
        only = np.flatnonzero(self.widths == 1)
        square, moment = block[only, 0, 0], mom[only, 0]
        x = np.clip(moment / np.maximum(square, 1e-300), low[only, 0], high[only, 0])
        held = np.where(square > least[only, 0], (moment - 0.5 * square * x) * x, 0.0)
        gain[only] = np.maximum(held, 0.0)
        return gain

    def best_beside(
        self, keys: Sequence[Key], most: int, shapes: int = 2
    ) -> list[tuple[float, Key]]:
        """Cost of a set with each candidate added, best first, of those that promise most."""
        none = self.cost(keys)
        if not np.isfinite(none):
            return []
        # Close to those of this set: most weights are found in two passes from there.
        self._weight = self.solve(keys).weight
        gains, have = self.gains(keys), {name.removeprefix("-") for name, _ in keys}
        tried: dict[str, float] = {}
        best: dict[str, tuple[float, Key]] = {}
        for k in np.argsort(-gains):
            key = self.places[k]
            name = key[0]
            if not gains[k] > 0.0:
                break
            if (
                name in have
                or tried.get(name, 0) >= shapes
                or (name not in tried and len(tried) >= most)
            ):
                continue
            cost = self.cost((*keys, key))
            # One that promised much beyond the bounds of others says little of the next.
            tried[name] = tried.get(name, 0.0) + (1.0 if cost < none else 0.25)
            if np.isfinite(cost) and cost < best.get(name, (np.inf,))[0]:
                best[name] = cost, key
        return sorted(best.values())

    # --- shapes ----------------------------------------------------------------------------------

    def refine(self, sets: Sequence[tuple[Key, ...]], rounds: int) -> list[tuple[Key, ...]]:
        """Move the shapes of sets to where their cost is least: Gauss-Newton on all at once."""
        current = [tuple(sorted(s)) for s in sets]
        moving = [any(shape for _, shape in s) for s in current]
        for _ in range(rounds):
            wanted = [k for s, m in zip(current, moving, strict=True) if m for k in added(s)]
            self.ensure(k for key in wanted for k in _neighbours(key))
            proposed = [self._step(s) if m else None for s, m in zip(current, moving, strict=True)]
            trials = [
                list(_shares(s, to)) if to is not None else []
                for s, to in zip(current, proposed, strict=True)
            ]
            self.ensure(key for each in trials for one in each[:1] for key in added(one))
            for i, each in enumerate(trials):
                before = self.cost(current[i]) if moving[i] else 0.0
                moved = False
                for one in each:
                    self.ensure(added(one))
                    cost = self.cost(one)
                    if cost < before - 0.02:
                        current[i], moved = tuple(sorted(one)), True
                        moving[i] = cost < before - 0.3
                        break
                moving[i] &= moved
            if not any(moving):
                break
        return current

    def _step(self, keys: tuple[Key, ...]) -> tuple[Key, ...] | None:
        """Where a linear step in all shapes leads."""
        found, all_keys = self.solve(keys), keys
        keys = added(keys)
        if not np.isfinite(found.cost):
            return None
        slopes = self.shape_slopes(keys, found.strengths)
        if slopes is None:
            return None
        count = sum(len(shape) for _, shape in keys)
        more = {a: c * self.p.likelihood.root[a][:, None] for a, c in slopes.items()}
        solved = self._solve_with_shapes(all_keys, more, found)
        moved, place = [], 0
        for name, shape in keys:
            step = np.clip(solved[place : place + len(shape)], -_FARTHEST, _FARTHEST)
            place += len(shape)
            moved.append(
                (
                    name,
                    tuple(
                        float(np.clip(u + d, 0.0, 1.0)) for u, d in zip(shape, step, strict=True)
                    ),
                )
            )
        assert place == count
        return (*(key for key in all_keys if key[0][0] == "-"), *moved)

    def _solve_with_shapes(
        self,
        all_keys: tuple[Key, ...],
        more: Mapping[int, Array],
        known: Solution,
    ) -> Array:
        """Steps of the shapes, (d,), strengths and the model's own parameters moving along.

        Args:
            all_keys: the set; known: its solution.
            more: weighted slopes by the shapes, by axis, each (n, d).
        """
        keys, left = added(all_keys), self.residual_rows(all_keys)
        p, nb, weight = self.p, self.bb.shape[1], known.weight
        xx, xy, places = self._sums(keys)
        m, extra = xx.shape[1], next(iter(more.values())).shape[1]
        b = np.concatenate([known.base, *known.strengths])
        normal, right = np.zeros((m + extra, m + extra)), np.zeros(m + extra)
        normal[:m, :m] = np.tensordot(weight, xx, 1)
        right[:m] = -weight @ (xy + xx @ b)
        normal[:nb, :nb] += p.precision
        right[:nb] += p.moment - p.precision @ known.base
        normal[m:, m:] = np.eye(extra) / _FARTHEST**2
        for axis, slopes in more.items():
            w = weight[axis]
            normal[:nb, m:] += w * (p.base[axis].T @ slopes)
            for i, key in zip(places, keys, strict=True):
                if axis in (part := self._products(key)):
                    normal[i, m:] += w * (part[axis][0].T @ slopes)
            normal[m:, m:] += w * (slopes.T @ slopes)
            right[m:] -= w * (slopes.T @ left[axis])
        normal[m:, :m] = normal[:m, m:].T
        free = self._free_of(all_keys, m + extra)
        step = free @ solve_scaled(free.T @ normal @ free, free.T @ right)
        return np.asarray(step[m:])

    def _free_of(self, keys: Sequence[Key], n: int) -> Array:
        """Directions in which n unknowns may move while effects that a set takes away stay away."""
        away = [place for name in gone(keys) for place in self.p.absence[name]]
        return self.p.hold(dict.fromkeys(away, 0.0), n)[1]

    def shape_slopes(
        self, keys: Sequence[Key], strengths: Sequence[Array]
    ) -> dict[int, Array] | None:
        """Slopes of what a set adds by each of its shapes, by axis, (n, d), unweighted."""
        total = sum(len(shape) for _, shape in keys)
        found: dict[int, Array] = {}
        place = 0
        for key, b in zip(keys, strengths, strict=True):
            here = self.atoms[key]
            for other in _neighbours(key):
                there = self.atoms.get(other)
                j = _which(key, other)
                if there is None or here is None:
                    return None
                step = other[1][j] - key[1][j]
                for axis in {*here.columns, *there.columns}:
                    x = (there.columns[axis] @ b if axis in there.columns else 0.0) - (
                        here.columns[axis] @ b if axis in here.columns else 0.0
                    )
                    block = found.setdefault(axis, np.zeros((len(self.p.y[axis]), total)))
                    block[:, place + j] = x / step
            place += len(key[1])
        return found

    def without_one(self, keys: tuple[Key, ...]) -> list[tuple[Key, ...]]:
        """A set without each of its members, and without each effect of the model itself."""
        less = [keys[:i] + keys[i + 1 :] for i, key in enumerate(keys) if key[0][0] != "-"]
        gone = {name for name, _ in keys}
        return less + [
            tuple(sorted((*keys, (f"-{name}", ()))))
            for name in self.p.absence
            if f"-{name}" not in gone
        ]

    # --- sets ------------------------------------------------------------------------------------

    def keep(self, pool: Pool, keys: tuple[Key, ...]) -> None:
        """Enter a set into a pool unless the same effects are there with better shapes."""
        cost, known = self.cost(keys), pool.get(names(keys))
        if np.isfinite(cost) and (known is None or cost < known[0]):
            pool[names(keys)] = cost, tuple(sorted(keys))

    def swaps(self, keys: tuple[Key, ...], pool: Pool) -> list[tuple[Key, ...]]:
        """The best sets with another effect in the place of one, that are not in ``pool`` yet."""
        found = [
            (cost, tuple(sorted((*rest, key))))
            for rest in self.without_one(keys)
            for cost, key in self.best_beside(rest, _PROMISING)[:_SWAPPED]
        ]
        fresh = [swap for _, swap in sorted(found) if names(swap) not in pool]
        return fresh[: self.criteria.beam]

    def beam(self, most: int) -> Iterator[list[tuple[float, tuple[Key, ...]]]]:
        """Best sets of 1, 2, ... ``most`` effects: lists of cost and set, best first."""
        wide, start = self.criteria.beam, tuple[Key, ...]()
        beam = [(self.cost(start), start)]
        for _ in range(most):
            grown: Pool = {}
            for _, keys in beam:
                for _, key in self.best_beside(keys, _BESIDE):
                    self.keep(grown, (*keys, key))
            if not grown:
                return
            pool: Pool = {}
            for keys in self.refine([keys for _, keys in sorted(grown.values())[:wide]], 2):
                self.keep(pool, keys)
            for _ in range(_SWAPS):
                lead = min(pool.values())[1]
                for rest in self.without_one(lead):
                    self.keep(pool, rest)
                swaps = self.swaps(lead, pool)
                for keys in self.refine(swaps, 2):
                    self.keep(pool, keys)
                if min(pool.values())[1] == lead:
                    break
            best = [keys for _, keys in sorted(pool.values())[:_POLISHED]]
            for keys in self.refine(best, _ROUNDS):
                self.keep(pool, keys)
            beam = sorted(pool.values())[:wide]
            yield beam


_A_SHAPE = 2.5
"""Half the logarithm of the information on a shape over its range, as it comes out on the whole."""


def log_prior(criteria: Criteria, number: int) -> float:
    """Log of the prior odds of each of so many candidates."""
    return min(float(np.log(criteria.expected_effects / max(number, 1))), 0.0)


def penalise(information: Array, spread: Array, strengths: Array, shapes: int) -> Array:
    """What the priors of effects take off their log evidence (Laplace), nats, one or (...).

    Args:
        information: on their strengths, (m, m).
        spread: of these before any data, (m,); strengths: (..., m).
        shapes: how many parameters beside them are fitted.
    """
    wide = np.maximum(spread, np.abs(strengths))
    scaled = information * wide[..., :, None] * wide[..., None, :]
    found = 0.5 * np.linalg.slogdet(np.eye(len(information)) + scaled)[1]
    return np.asarray(found + _A_SHAPE * shapes)


def added(keys: Sequence[Key]) -> tuple[Key, ...]:
    """The effects of a set that the model does not have; ``-name`` takes one of its own away."""
    return tuple(key for key in keys if key[0][0] != "-")


def gone(keys: Sequence[Key]) -> set[str]:
    """The effects of the model that a set takes away."""
    return {name[1:] for name, _ in keys if name[0] == "-"}


def names(keys: Sequence[Key]) -> tuple[str, ...]:
    """The effects of a set, in order."""
    return tuple(sorted(name for name, _ in keys))


def _neighbours(key: Key) -> list[Key]:
    """A candidate with each of its shapes a little on, towards the middle of its range."""
    name, shape = key
    found = []
    for j, u in enumerate(shape):
        moved = u + (_STEP if u <= 0.5 else -_STEP)
        found.append((name, (*shape[:j], moved, *shape[j + 1 :])))
    return found


def _which(key: Key, other: Key) -> int:
    return next(j for j, (a, b) in enumerate(zip(key[1], other[1], strict=True)) if a != b)


def _shares(keys: tuple[Key, ...], to: tuple[Key, ...]) -> Iterator[tuple[Key, ...]]:
    """The whole way to a proposed set, a third, and a tenth of it."""
    aims = dict(to)
    for share in (1.0, 0.35, 0.1):
        yield tuple(
            (name, tuple(u + share * (v - u) for u, v in zip(shape, aims[name], strict=True)))
            for name, shape in keys
        )


def _schur(normal: Array, nb: int) -> Array:
    """Information on the strengths once the model's own parameters have moved along."""
    cross = normal[:nb, nb:]
    return np.asarray(normal[nb:, nb:] - cross.T @ solve_scaled(normal[:nb, :nb], cross))
