"""How well trials tell rival effects apart: what is left when the wrong one is refitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from bampipe.discover.candidates import Candidate
from bampipe.discover.columns import added_residual
from bampipe.discover.settings import Settings
from bampipe.estimate.least_squares import stacked_residual
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import ModelOnTrial, problem_of

Array = NDArray[np.float64]

_STEP = 1e-3
"""Of a parameter, for the slope of what its effect adds to the residual."""


@dataclass(frozen=True)
class Rival:
    """An effect that may be what a model lacks.

    Attributes:
        item: the candidate; None for none at all.
        values: its parameters, in the order of its file.
        odds: that it is this one.
    """

    item: Candidate | None
    values: Array
    odds: float

    @property
    def name(self) -> str:
        """Canonical name of the effect."""
        return self.item.name if self.item else ""

    @property
    def free(self) -> list[int]:
        """Places of its parameters that are fitted."""
        return [i for i, q in enumerate(self.item.parameters) if not q.fixed] if self.item else []


@dataclass(frozen=True)
class Sums:
    """Sums of products over the samples of some trials.

    Attributes:
        squares: (n_q, m, m) of all columns: slopes by the free parameters of the model, then what
            each rival adds, and its slopes by its own parameters.
        count: (n_q,) samples.
    """

    squares: Array
    count: Array

    def __add__(self, other: Sums) -> Sums:
        return Sums(self.squares + other.squares, self.count + other.count)

    def scaled(self, factor: float) -> Sums:
        """The sums of trials that are ``factor`` times as long."""
        return Sums(factor * self.squares, factor * self.count)


@dataclass(frozen=True)
class Contrast:
    """How two effects differ on some trials.

    Attributes:
        distance: expected log likelihood ratio of the right one over the wrong one refitted, nats,
            the smaller of both ways.
        confusion: chance that the wrong one comes out no worse, the mean of both ways.
        left: (n_q,) root mean square that the wrong one leaves of the right one, N.m or N, the
            smaller of both ways.
    """

    distance: float
    confusion: float
    left: Array


@dataclass(frozen=True)
class Contest:
    """Rival effects on one model.

    Attributes:
        system, p: the model without any of them, and its fitted parameters.
        rivals: the effects; band: of residuals.
        floor: (n_q,) noise floor of each axis, N.m or N.
        refits: whether rivals are fitted, and not only the model without them.
        timing_s: by how much the inputs may be sampled late or early, which is fitted beside the
            model's parameters, last; 0 where it is not.
    """

    system: System
    p: Array
    rivals: tuple[Rival, ...]
    band: Band
    floor: Array
    refits: bool = True
    timing_s: float = 0.0

    def sums(self, motions: Sequence[Motion]) -> Sums:
        """The sums over ``motions``."""
        parts = [self._sums_of(motion) for motion in motions]
        return Sums(
            np.sum([part.squares for part in parts], axis=0),
            np.sum([part.count for part in parts], axis=0),
        )

    def _sums_of(self, motion: Motion) -> Sums:
        problem = problem_of(self.system, [motion], self.band, timing=self.timing_s > 0.0)
        stacked = stacked_residual(problem, 0, np.append(self.p, 0.0))
        base = ModelOnTrial(self.system, self.p, [motion])
        columns = [stacked.slope]
        n = len(self.system.coordinates)
        for rival in self.rivals:
            rows = self._added_by(rival, base)
            thin = self.band.thin(np.concatenate(rows, axis=1)).reshape(-1, len(rows), n)
            columns.append(thin.transpose(0, 2, 1) * stacked.used[:, :, None])
        joined = np.concatenate(columns, axis=2)
        by_axis = np.ascontiguousarray(joined.transpose(1, 2, 0))
        squares = by_axis @ by_axis.transpose(0, 2, 1)
        return Sums(squares, stacked.used.sum(axis=0).astype(float))

    def _added_by(self, rival: Rival, base: ModelOnTrial) -> list[Array]:
        """What a rival adds to the residual, and the slopes of that by its parameters, (T, n_q)."""
        if rival.item is None:
            return [np.zeros(base.motion.q.shape)]
        system, count = rival.item.system, len(rival.values)
        p = np.append(self.p[: len(system.parameters) - count], rival.values)
        here = added_residual(rival.item, p, base)
        rows = [here]
        for i in rival.free if self.refits else ():
            q, moved = rival.item.parameters[i], p.copy()
            step = _STEP * max(abs(rival.values[i]), _STEP * q.sd)
            step = -step if rival.values[i] + step > q.upper else step
            moved[len(p) - count + i] += step
            rows.append((added_residual(rival.item, moved, base) - here) / step)
        return rows

    def _places(self, squares: Array) -> list[tuple[int, list[int]]]:
        """For each rival, the column of what it adds and those of its slopes."""
        widths = [1 + len(rival.free) * self.refits for rival in self.rivals]
        start = squares.shape[1] - sum(widths)
        places = []
        for width in widths:
            end = start + width
            places.append((start, list(range(start + 1, end))))
            start = end
        return places

    def contrasts(self, total: Sums, on: Sums | None = None) -> dict[tuple[int, int], Contrast]:
        """How each pair of rivals differs once the trials of ``total`` are fitted.

        Args:
            total: of all trials that the fit sees.
            on: of those on which `Contrast.left` is taken; the same by default.
        """
        places = self._places(total.squares)
        base = list(range(places[0][0]))
        on = on or total
        found = {}
        for i, j in combinations(range(len(self.rivals)), 2):
            ways = []
            for right, wrong in ((i, j), (j, i)):
                if self.rivals[right].item is None:
                    continue
                target, fitted = places[right][0], [*base, *places[wrong][1]]
                nothing = self._left(total, total, [target], base)[0]
                left = self._left(total, total, [target], fitted)[0]
                shown = self._left(total, on, [target], fitted)[0]
                distance, confusion = self._compare(total, nothing, left)
                ways.append((distance, confusion, np.sqrt(shown / np.maximum(on.count, 1.0))))
            found[i, j] = Contrast(
                min(way[0] for way in ways),
                float(np.mean([way[1] for way in ways])),
                min((way[2] for way in ways), key=lambda left: float(np.sum(left / self.floor))),
            )
        return found

    def left_by_model(self, total: Sums) -> list[Array]:
        """For each rival, the sum of squares that the model alone leaves of it, (n_q,)."""
        places = self._places(total.squares)
        base = list(range(places[0][0]))
        return list(self._left(total, total, [target for target, _ in places], base))

    def timing_of(self, total: Sums) -> list[float]:
        """For each rival, the timing that the model alone takes it for, s."""
        places = self._places(total.squares)
        base = list(range(places[0][0]))
        return [abs(float(late)) for late in self._fit(total, [t for t, _ in places], base)[-1]]

    def without_timing(self, total: Sums) -> tuple[Contest, Sums]:
        """The same where no timing is fitted."""
        last = self._places(total.squares)[0][0] - 1
        squares = np.delete(np.delete(total.squares, last, axis=1), last, axis=2)
        return replace(self, timing_s=0.0), replace(total, squares=squares)

    def _left(self, total: Sums, on: Sums, targets: Sequence[int], fitted: Sequence[int]) -> Array:
        """Sum of squares of each target that ``fitted`` columns leave on some trials, (m, n_q)."""
        taken, wanted, columns = self._fit(total, targets, fitted), list(targets), list(fitted)
        by_fitted = on.squares[:, columns]
        left = np.diagonal(on.squares, axis1=1, axis2=2)[:, wanted].T.copy()
        left -= 2.0 * np.einsum("apr,pr->ra", by_fitted[:, :, wanted], taken)
        left += np.einsum("apr,pr->ra", by_fitted[:, :, columns] @ taken, taken)
        return np.asarray(np.maximum(left, 0.0))

    def _fit(self, total: Sums, targets: Sequence[int], fitted: Sequence[int]) -> Array:
        """Coefficients with which ``fitted`` columns come closest to each target, (k, m)."""
        columns = list(fitted)
        weight, by_fitted = 1.0 / self.floor**2, total.squares[:, columns]
        normal = np.einsum("apq,a->pq", by_fitted[:, :, columns], weight)
        moments = np.einsum("apq,a->pq", by_fitted[:, :, list(targets)], weight)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))[:, None]
        solved = np.linalg.lstsq(normal * scale * scale.T, scale * moments, rcond=1e-9)[0]
        return np.asarray(scale * solved)

    def _compare(self, total: Sums, nothing: Array, left: Array) -> tuple[float, float]:
        """Distance in log likelihood, and the chance that noise and imperfect models hide it.

        Args:
            total: of the trials; nothing: (n_q,) sum of squares that the right effect adds and the
                model alone leaves; left: the same with the wrong effect.
        """
        s = Settings()
        count = np.maximum(total.count, 1.0)
        independent = count * self.band.independent_share
        floor = self.floor**2
        right = 0.5 * float(independent @ np.log1p(nothing / count / floor))
        wrong = 0.5 * float(independent @ np.log1p(left / count / floor))
        spread = np.sqrt(2.0 * wrong + (s.score_error * right) ** 2 + s.score_sd**2)
        return wrong, float(ndtr(-wrong / spread))

    def weights(self) -> dict[tuple[int, int], float]:
        """Weight of each pair, after Box and Hill (1967): the product of their odds, sum one."""
        pairs = list(combinations(range(len(self.rivals)), 2))
        products = [self.rivals[i].odds * self.rivals[j].odds for i, j in pairs]
        total = sum(products) or 1.0
        return {pair: product / total for pair, product in zip(pairs, products, strict=True)}

    def tells_apart(self, total: Sums) -> bool:
        """Whether trials distinguish every pair of rivals, were one of them all that is missing."""
        limit = Settings().confused
        return all(found.confusion < limit for found in self.contrasts(total).values())

    def confusion(self, contrasts: Mapping[tuple[int, int], Contrast]) -> float:
        """Chance of confusing two rivals, over all pairs."""
        weights = self.weights()
        return sum(weights[pair] * contrasts[pair].confusion for pair in contrasts)
