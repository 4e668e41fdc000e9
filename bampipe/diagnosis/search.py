"""The search over sets of effects, with shapes refined and strengths within their bounds."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import copy

import numpy as np
from scipy.linalg import block_diag

from bampipe.arrays import Array
from bampipe.diagnosis.dictionary import Key
from bampipe.diagnosis.set_cost import SetCosts, Solution, added_effects, effect_names
from bampipe.trials.linear_problem import solve_scaled

_STEP = 0.02
"""Step of the slope by a shape, as a share of the shape's range."""
STEP_LENGTHS = (1.0, 0.35, 0.1)
"""Shares of a step of the linear problem of which the best is taken."""
_LONGEST_STEP = 0.2
"""Longest step of a refinement, as a share of that range."""

_ADDITIONS, _REPLACEMENTS, _SWAPS_REFINED = 12, 8, 5
"""Candidates computed exactly as additions to a set and as replacements of a member, and number of
the replacements whose shapes are refined."""
_SWAP_ROUNDS, _SETS_REFINED = 3, 4
_ROUNDS = 12
"""Largest number of steps of a refinement. It may need many: an impact moves with the width of its
gap, and an impact that comes too late gains nothing."""

Pool = dict[tuple[str, ...], tuple[float, tuple[Key, ...]]]
"""Sets by the names of their effects, each with its cost and shapes."""


class Search(SetCosts):
    """The search for the sets of least cost beside one model."""

    def largest_gain(self) -> tuple[float, str]:
        """Return the largest log evidence of a candidate of any size, nats, and its name."""
        any_size = copy(self)
        any_size.least_size, any_size._solutions = 0.0, {}
        beside = any_size.rank_additions((), _REPLACEMENTS)
        return (any_size.cost(()) - beside[0][0], beside[0][1][0]) if beside else (0.0, "")

    def replicate_gains(self) -> tuple[float, ...]:
        """Return `largest_gain` on each replicate of the model: the null distribution, nats."""
        numbers = range(self.criteria.replicates)
        return tuple(self.on_replicate(k).largest_gain()[0] for k in numbers)

    def rank_additions(
        self, keys: Sequence[Key], most: int, shapes: int = 2
    ) -> list[tuple[float, Key]]:
        """Return the cost of a set with each of the ``most`` promising candidates, best first."""
        none = self.cost(keys)
        if not np.isfinite(none):
            return []
        # Most weights converge in two passes from those of this set.
        self._weight = self.solve(keys).weight
        gains, have = self.gains(keys), {name.removeprefix("-") for name, _ in keys}
        tried: dict[str, float] = {}
        best: dict[str, tuple[float, Key]] = {}
        for k in np.argsort(-gains):
            key = self.grid_keys[k]
            name = key[0]
            if not gains[k] > 0.0:
                break
            is_one_too_many = name not in tried and len(tried) >= most
            if name in have or tried.get(name, 0) >= shapes or is_one_too_many:
                continue
            cost = self.cost((*keys, key))
            # A promise that rests on parameters beyond their bounds says little of the next shape.
            tried[name] = tried.get(name, 0.0) + (1.0 if cost < none else 0.25)
            if np.isfinite(cost) and cost < best.get(name, (np.inf,))[0]:
                best[name] = cost, key
        return sorted(best.values())

    def refine(self, start: Sequence[tuple[Key, ...]], rounds: int) -> list[tuple[Key, ...]]:
        """Minimise the cost of each set over its shapes by Gauss-Newton steps."""
        current = [tuple(sorted(keys)) for keys in start]
        moving = [i for i, keys in enumerate(current) if any(shape for _, shape in keys)]
        for _ in range(rounds):
            wanted = [key for i in moving for key in added_effects(current[i])]
            self.ensure(k for key in wanted for k in _neighbours(key))
            proposed = {i: self._propose_sets(current[i]) for i in moving}
            first = [sets[0] for sets in proposed.values() if sets]
            self.ensure(key for keys in first for key in added_effects(keys))
            moving = []
            for i, sets in proposed.items():
                before = self.cost(current[i])
                for keys in sets:
                    self.ensure(added_effects(keys))
                    cost = self.cost(keys)
                    if cost < before - 0.02:
                        current[i] = tuple(sorted(keys))
                        moving += [i] if cost < before - 0.3 else []
                        break
        return current

    def _propose_sets(self, all_keys: tuple[Key, ...]) -> list[tuple[Key, ...]]:
        """Return a set after a linear step in all shapes, and after shorter steps."""
        found, keys = self.solve(all_keys), added_effects(all_keys)
        slopes = self.shape_slopes(keys, found.strengths) if np.isfinite(found.cost) else None
        if slopes is None:
            return []
        solved = self._solve_with_shapes(all_keys, slopes, found)
        steps = iter(np.clip(solved, -_LONGEST_STEP, _LONGEST_STEP))
        aims = [[float(np.clip(u + next(steps), 0.0, 1.0)) for u in s] for _, s in all_keys]
        pairs = list(zip(all_keys, aims, strict=True))
        return [
            tuple(
                (name, tuple(u + share * (v - u) for u, v in zip(shape, aim, strict=True)))
                for (name, shape), aim in pairs
            )
            for share in STEP_LENGTHS
        ]

    def _solve_with_shapes(
        self, all_keys: tuple[Key, ...], slopes: Mapping[int, Array], known: Solution
    ) -> Array:
        """Return the step of the shapes of a set, (d,), all other unknowns being free.

        ``slopes`` are those by the shapes, by axis, (n, d); ``known`` is the solution.
        """
        keys, p, nb = added_effects(all_keys), self.problem, self.bb.shape[1]
        xx, xy, places = self._sums(keys, [self._multiply(slopes)])
        m, n = places[-1].start, places[-1].stop
        b = np.concatenate([known.base, *known.strengths, np.zeros(n - m)])
        own, steps = self._expected(keys), np.eye(n - m) / _LONGEST_STEP**2
        precision = block_diag(p.precision, own, steps)
        normal = np.tensordot(known.weight, xx, 1) + precision
        right = -known.weight @ (xy + xx @ b) - precision @ b
        right[:nb] += p.moment
        free = p.hold(known.fixed, n)[1]
        step = free @ solve_scaled(free.T @ normal @ free, free.T @ right)
        return np.asarray(step[m:])

    def shape_slopes(
        self, keys: Sequence[Key], strengths: Sequence[Array]
    ) -> dict[int, Array] | None:
        """Return the unweighted slopes of the residual by the shapes of a set, by axis, (n, d)."""
        total = sum(len(shape) for _, shape in keys)
        found: dict[int, Array] = {}
        place = 0
        for key, b in zip(keys, strengths, strict=True):
            here = self.atoms[key]
            for j, other in enumerate(_neighbours(key)):
                there = self.atoms.get(other)
                if there is None or here is None:
                    return None
                step = other[1][j] - key[1][j]
                for axis in {*here.columns, *there.columns}:
                    block = found.setdefault(axis, np.zeros((len(self.problem.y[axis]), total)))
                    after, before = (
                        atom.columns[axis] @ b if axis in atom.columns else 0.0
                        for atom in (there, here)
                    )
                    block[:, place + j] = (after - before) / step
            place += len(key[1])
        return found

    def drop_each(self, keys: tuple[Key, ...]) -> list[tuple[Key, ...]]:
        """Return a set without each of its members, and without each effect of the model."""
        less = [keys[:i] + keys[i + 1 :] for i, key in enumerate(keys) if key[0][0] != "-"]
        gone = {name for name, _ in keys}
        return less + [
            tuple(sorted((*keys, (f"-{name}", ()))))
            for name in self.problem.absence
            if f"-{name}" not in gone
        ]

    def add_to_pool(self, pool: Pool, sets: Iterable[tuple[Key, ...]]) -> None:
        """Add sets to a pool unless it has the same effects with better shapes."""
        for keys in sets:
            cost, known = self.cost(keys), pool.get(effect_names(keys))
            if np.isfinite(cost) and (known is None or cost < known[0]):
                pool[effect_names(keys)] = cost, tuple(sorted(keys))

    def list_swaps(self, keys: tuple[Key, ...], pool: Pool) -> list[tuple[Key, ...]]:
        """Return the best sets outside ``pool`` that have another effect in place of one."""
        found = [
            (cost, tuple(sorted((*rest, key))))
            for rest in self.drop_each(keys)
            for cost, key in self.rank_additions(rest, _REPLACEMENTS)[:_SWAPS_REFINED]
        ]
        fresh = [swap for _, swap in sorted(found) if effect_names(swap) not in pool]
        return fresh[: self.criteria.beam]

    def grow_sets(self, most: int) -> Iterator[list[tuple[float, tuple[Key, ...]]]]:
        """Yield the best sets of 1, 2, ... ``most`` effects with their costs, best first."""
        wide, start = self.criteria.beam, tuple[Key, ...]()
        beam = [(self.cost(start), start)]
        for _ in range(most):
            grown: Pool = {}
            for _, keys in beam:
                additions = self.rank_additions(keys, _ADDITIONS)
                self.add_to_pool(grown, ((*keys, key) for _, key in additions))
            if not grown:
                return
            pool: Pool = {}
            best = [keys for _, keys in sorted(grown.values())[:wide]]
            self.add_to_pool(pool, self.refine(best, 2))
            for _ in range(_SWAP_ROUNDS):
                lead = min(pool.values())[1]
                self.add_to_pool(pool, self.drop_each(lead))
                self.add_to_pool(pool, self.refine(self.list_swaps(lead, pool), 2))
                if min(pool.values())[1] == lead:
                    break
            best = [keys for _, keys in sorted(pool.values())[:_SETS_REFINED]]
            self.add_to_pool(pool, self.refine(best, _ROUNDS))
            beam = sorted(pool.values())[:wide]
            yield beam


def _neighbours(key: Key) -> list[Key]:
    """Return a candidate with each of its shapes moved a little towards mid-range."""
    name, shape = key
    found = []
    for j, u in enumerate(shape):
        moved = u + (_STEP if u <= 0.5 else -_STEP)
        found.append((name, (*shape[:j], moved, *shape[j + 1 :])))
    return found
