"""Candidate effects, each refitted together with the model's own parameters and scored by trial.

For fixed shape parameters an effect adds columns to a linear problem; the sums of products that
this needs are kept by trial and axis, so that leaving a trial out costs nothing. Shape parameters,
and strengths that act nonlinearly, are searched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.evidence import Evidence
from bampipe.physics import Model, System, compile_model
from bampipe.physics.device import Device
from bampipe.physics.effect import Effect
from bampipe.physics.parameter import Parameter
from bampipe.physics.registry import effect as built_in
from bampipe.physics.registry import effect_names

Array = NDArray[np.float64]

_GRID = 7
_REFINE = 3


@dataclass(frozen=True)
class Candidate:
    """One effect at one target, on the bare device.

    Attributes:
        name: canonical, ``stribeck:yaw``.
        system: the device with this effect alone.
        own: its parameters.
        linear: positions in ``own`` of strengths in which the residual is linear.
        searched: positions in ``own`` of the parameters that are searched.
    """

    name: str
    system: System
    own: tuple[Parameter, ...]
    linear: tuple[int, ...]
    searched: tuple[int, ...]


@dataclass(frozen=True)
class Score:
    """How well the model explains the trials with one effect added.

    Attributes:
        name: the effect; ``""`` for the model as it is.
        error: root mean square of the residual on trials left out, by axis, (n_q,), N.m or N.
        values: fitted parameters of the effect, in the order of `Candidate.own`.
        shift: change of the model's own free parameters that goes with it.
        gain: log likelihood ratio on trials left out, by axis, (n_q,), in units of independent
            samples: positive where the effect helps.
    """

    name: str
    error: Array
    values: Array
    shift: Array
    gain: Array

    @property
    def total(self) -> float:
        """Gain over all axes."""
        return float(self.gain.sum())


def library(
    device: Device, present: Sequence[str], extra: Sequence[Effect] = ()
) -> tuple[Candidate, ...]:
    """Every effect that could be added to ``device``, those in ``present`` left out."""
    known = {name: built_in(name) for name in effect_names()} | {e.name: e for e in extra}
    found = []
    for name, effect in sorted(known.items()):
        for target in effect.targets(device):
            full = f"{name}:{target}" if target else name
            if full not in present:
                found.append(candidate(device, full, extra))
    return tuple(found)


def candidate(device: Device, name: str, extra: Sequence[Effect] = ()) -> Candidate:
    """The candidate called ``name``.

    Raises:
        InputError: there is no such effect or target.
    """
    system = compile_model(Model(device, (name,), extra))
    count = len(device.parameters)
    own = system.parameters[count:]
    linear, searched = [], []
    for i, parameter in enumerate(own):
        if parameter.fixed:
            continue
        if parameter.strength and system.linear[count + i] and not system.moves_sensors:
            linear.append(i)
        else:
            searched.append(i)
    return Candidate(name, system, own, tuple(linear), tuple(searched))


@dataclass(frozen=True)
class _Sums:
    """Sums of products by trial and axis: x'x (K, n_q, P, P), x'y (K, n_q, P), y'y (K, n_q)."""

    xx: Array
    xy: Array
    yy: Array


class Scorer:
    """Scores candidates against one evidence."""

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = evidence
        self.counts = np.array([u.sum(axis=0) for u in evidence.used])
        self._base = _sums(evidence.jacobian, [-r for r in evidence.residual])

    @cached_property
    def independent(self) -> Array:
        """Number of independent samples by axis: the low-pass leaves two a cut-off period."""
        band = self.evidence.band
        spacing = band.step * 2.0 * band.cutoff_hz / band.rate_hz
        return np.asarray(self.counts.sum(axis=0) * min(1.0, spacing))

    @cached_property
    def before(self) -> Score:
        """The model as it is."""
        weight = 1.0 / np.maximum(self.evidence.rmse(), 1e-12) ** 2
        shift = _solve(self._base.xx, self._base.xy, weight)
        error = self._held_out(self._base, weight)
        return Score("", error, np.zeros(0), shift, np.zeros(len(error)))

    def score(self, item: Candidate) -> Score | None:
        """Refit with ``item`` added; None where it does nothing in these trials."""
        ranges = [_search_range(item.own[i]) for i in item.searched]
        if not ranges:
            return self._at(item, np.zeros(0))
        best: Score | None = None
        best_cost = np.inf
        at = [float(_starts(r)[len(_starts(r)) // 2]) for r in ranges]
        for round_ in range(2 if len(ranges) > 1 else 1):
            for k, interval in enumerate(ranges):
                grid = _starts(interval)
                costs = []
                for value in grid:
                    found = self._in_sample(item, np.array([*at[:k], value, *at[k + 1 :]]))
                    if found is None:
                        return None
                    costs.append(found)
                j = int(np.argmin(costs))
                at[k] = float(grid[j])
                low, high = grid[max(j - 1, 0)], grid[min(j + 1, len(grid) - 1)]
                at[k] = self._refine(item, at, k, low, high, costs[j])
            found = self._in_sample(item, np.array(at))
            if found is None or found > best_cost - 1e-3:
                break
            best_cost = found
        best = self._at(item, np.array(at))
        return best

    def _refine(
        self, item: Candidate, at: list[float], k: int, low: float, high: float, cost: float
    ) -> float:
        """Narrow one searched parameter between its neighbours on the grid, by halving."""
        x, y = at[k], cost
        for _ in range(_REFINE):
            for end, left in ((low, True), (high, False)):
                middle = _middle(x, end)
                found = self._in_sample(item, np.array([*at[:k], middle, *at[k + 1 :]]))
                if found is not None and found < y:
                    low, high = (low, x) if left else (x, high)
                    x, y = middle, found
                    break
            else:
                low, high = _middle(x, low), _middle(x, high)
        return x

    def _problem(self, item: Candidate, searched: Array) -> tuple[_Sums, Array] | None:
        columns, change = self._columns(item, searched)
        if all(not c.any() for c in columns) and all(not c.any() for c in change):
            return None
        x = [
            np.concatenate([j, c], axis=2)
            for j, c in zip(self.evidence.jacobian, columns, strict=True)
        ]
        y = [-(r + c) for r, c in zip(self.evidence.residual, change, strict=True)]
        return _sums(x, y), np.concatenate(change)

    def _in_sample(self, item: Candidate, searched: Array) -> float | None:
        """Sum over axes of n log(mean square) with everything refitted."""
        problem = self._problem(item, searched)
        if problem is None:
            return None
        sums, _ = problem
        beta, weight = self._fit(item, sums)
        left = _squares(sums, beta).sum(axis=0) / np.maximum(self.counts.sum(axis=0), 1.0)
        return float(np.sum(self.independent * np.log(np.maximum(left, 1e-30))))

    def _fit(self, item: Candidate, sums: _Sums) -> tuple[Array, Array]:
        """Coefficients of the joint fit, reweighted once by what each axis is left with."""
        weight = 1.0 / np.maximum(self.evidence.rmse(), 1e-12) ** 2
        for _ in range(2):
            beta = _bounded(item, sums, weight)
            left = _squares(sums, beta).sum(axis=0) / np.maximum(self.counts.sum(axis=0), 1.0)
            weight = 1.0 / np.maximum(left, 1e-24)
        return beta, weight

    def _at(self, item: Candidate, searched: Array) -> Score | None:
        problem = self._problem(item, searched)
        if problem is None:
            return None
        sums, _ = problem
        beta, weight = self._fit(item, sums)
        own = np.array([p.prior for p in item.own])
        own[list(item.searched)] = searched
        start = len(self.evidence.free)
        own[list(item.linear)] = beta[start:]
        error = self._held_out(sums, weight, item)
        gain = self.independent * np.log(self.before.error / error)
        return Score(item.name, error, own, beta[:start], gain)

    def _held_out(self, sums: _Sums, weight: Array, item: Candidate | None = None) -> Array:
        squares = np.zeros(sums.yy.shape[1])
        for k in range(len(sums.yy)):
            rest = [i for i in range(len(sums.yy)) if i != k] or [k]
            part = _Sums(sums.xx[rest], sums.xy[rest], sums.yy[rest])
            beta = _solve(part.xx, part.xy, weight) if item is None else _bounded(item, part, weight)
            squares += _squares(_Sums(sums.xx[[k]], sums.xy[[k]], sums.yy[[k]]), beta)[0]
        return np.asarray(np.sqrt(squares / np.maximum(self.counts.sum(axis=0), 1.0)))

    def _columns(self, item: Candidate, searched: Array) -> tuple[list[Array], list[Array]]:
        """Columns of the linear strengths (K, n_q, m) and change of the residual (K, n_q)."""
        e, system = self.evidence, item.system
        count = len(system.model.device.parameters)
        p = np.concatenate([e.p[:count], [q.prior for q in item.own]])
        p[[count + i for i in item.searched]] = searched
        p[[count + i for i in item.linear]] = 0.0
        columns, changes = [], []
        for motion, used, memory, plain in zip(
            e.motions, e.used, e.memory, e.plain, strict=True
        ):
            u = motion.inputs(system.inputs)
            rows = []
            if system.moves_sensors:
                true = system.true_motion(motion.q, motion.qd, motion.qdd, u, p)
                inputs = motion.inputs(e.system.inputs)
                rows.append(e.system.residual(*true, memory, inputs, e.p) - plain)
            else:
                z = system.memory(motion.q, motion.qd, motion.qdd, u, p, motion.t)
                for i in item.linear or (None,):
                    probe = p.copy()
                    if i is not None:
                        probe[count + i] = 1.0
                    rows.append(
                        system.contribution(motion.q, motion.qd, motion.qdd, z, u, probe)
                    )
            thin = self._thin(rows, used)
            if item.linear:
                columns.append(thin.transpose(0, 2, 1))
                changes.append(np.zeros(used.shape))
            else:
                columns.append(np.zeros((*used.shape, 0)))
                changes.append(thin[:, 0])
        return columns, changes

    def _thin(self, rows: list[Array], used: Array) -> Array:
        """Low-pass each (T, n_q) of ``rows``; axes that are zero throughout cost nothing."""
        out = np.zeros((len(used), len(rows), used.shape[1]))
        for r, values in enumerate(rows):
            axes = np.flatnonzero(values.any(axis=0))
            if len(axes):
                out[:, r, axes] = self.evidence.band.thin(values[:, axes]) * used[:, axes]
        return out


def _sums(x: Sequence[Array], y: Sequence[Array]) -> _Sums:
    xx, xy, yy = [], [], []
    for a, b in zip(x, y, strict=True):
        axes = np.ascontiguousarray(a.transpose(1, 0, 2))
        right = np.ascontiguousarray(b.T)
        xx.append(axes.transpose(0, 2, 1) @ axes)
        xy.append(np.einsum("akp,ak->ap", axes, right))
        yy.append(np.sum(right**2, axis=1))
    return _Sums(np.array(xx), np.array(xy), np.array(yy))


def _solve(xx: Array, xy: Array, weight: Array) -> Array:
    a = np.einsum("kapq,a->pq", xx, weight)
    b = np.einsum("kap,a->p", xy, weight)
    scale = np.sqrt(np.maximum(np.diag(a), 1e-30))
    return np.asarray(
        np.linalg.lstsq(a / np.outer(scale, scale), b / scale, rcond=1e-10)[0] / scale
    )


def _bounded(item: Candidate, sums: _Sums, weight: Array) -> Array:
    """`_solve` with strengths held at a bound that they would cross."""
    beta = _solve(sums.xx, sums.xy, weight)
    start = sums.xx.shape[2] - len(item.linear)
    held = {}
    for k, i in enumerate(item.linear):
        bounded = float(np.clip(beta[start + k], item.own[i].lower, item.own[i].upper))
        if bounded != beta[start + k]:
            held[start + k] = bounded
    if not held:
        return beta
    keep = [i for i in range(len(beta)) if i not in held]
    fixed = list(held)
    values = np.array(list(held.values()))
    xy = sums.xy[..., keep] - np.einsum("kapq,q->kap", sums.xx[:, :, keep][..., fixed], values)
    out = np.empty(len(beta))
    out[fixed] = values
    out[keep] = _solve(sums.xx[:, :, keep][..., keep], xy, weight)
    return out


def _squares(sums: _Sums, beta: Array) -> Array:
    """Sum of squares left with coefficients ``beta``, by trial and axis."""
    fitted = np.einsum("kapq,p,q->ka", sums.xx, beta, beta)
    return np.asarray(np.maximum(sums.yy - 2.0 * sums.xy @ beta + fitted, 0.0))


def _search_range(parameter: Parameter) -> tuple[float, float, bool]:
    """Lower end, upper end, and whether to step by ratios, of a searched parameter."""
    reach = 4.0 * (abs(parameter.typical) if parameter.typical else parameter.sd)
    lower, upper = max(parameter.lower, -reach), min(parameter.upper, max(reach, 0.0))
    if parameter.shape:
        lower = parameter.lower if np.isfinite(parameter.lower) else parameter.prior - reach
        upper = parameter.upper if np.isfinite(parameter.upper) else parameter.prior + reach
        return lower, upper, lower > 0.0
    if parameter.lower >= 0.0:
        return 0.02 * reach, upper, True
    return lower, upper, False


def _starts(interval: tuple[float, float, bool]) -> Array:
    low, high, ratio = interval
    return np.geomspace(low, high, _GRID) if ratio else np.linspace(low, high, _GRID + 1)


def _middle(a: float, b: float) -> float:
    return float(np.sqrt(a * b)) if a > 0.0 and b > 0.0 else 0.5 * (a + b)
