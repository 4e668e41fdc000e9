"""Candidate effects, each refitted together with the model's own parameters and scored by trial.

For fixed shape parameters an effect adds columns to a linear problem; the sums of products that
this needs are kept by trial and axis, so that leaving a trial out costs nothing. Shape parameters,
and strengths that act nonlinearly, are searched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.ranges import MachineScale, SearchRange, between
from bampipe.discover.settings import Settings
from bampipe.estimate.normal_equations import NormalEquations
from bampipe.physics import Model, System, compile_model
from bampipe.physics.device import Device
from bampipe.physics.effect import Effect
from bampipe.physics.parameter import Parameter
from bampipe.physics.registry import effect as built_in
from bampipe.physics.registry import effect_names
from bampipe.physics.signals import follows
from bampipe.trials.folds import Folds
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import Evidence

Array = NDArray[np.float64]

_GRID = 7
_LARGEST_RATIO = 3.0
"""Of neighbours on the grid of a searched parameter."""
_REFINE = 3
_STARTS = (0.5, 0.8)
"""Shares of their ranges at which several searched parameters start, one after the other: a sharp
resonance is missed between the points of a grid, one that is damped well shows from afar."""
_SIMILAR = 0.7
_DENSEST = 48
_SHARES = (1.0, 0.9, 0.8, 0.65, 0.5, 0.35, 0.2, 0.1, 0.05)
"""Shares of the least-squares strength tried where an effect weakens what the force does."""
_OWN_WEIGHT = 0.05
"""Weight that a trial keeps when it is left out to score candidates. Where it alone holds what
determines a parameter, as one wide motion among narrow ones does, leaving it out altogether would
compare extrapolations; of what several trials determine it keeps a few hundredths of a degree of
freedom."""
_DIVERGED = 1e30
"""An internal state that is too stiff to be integrated at the sampling rate ends above this."""


@dataclass(frozen=True)
class Candidate:
    """One effect at one target.

    Attributes:
        name: canonical, ``stribeck:yaw``.
        system: the device with this effect alone; with the other effects of the model before it
            where it acts on what they leave.
        joint: whether it is with them.
        own: its parameters.
        linear: positions in ``own`` of strengths in which the residual is linear.
        searched: positions in ``own`` of the parameters that are searched.
    """

    name: str
    system: System
    joint: bool
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
        gain: log likelihood ratio of the measured force on trials left out, by axis, (n_q,), in
            units of independent samples: positive where the effect helps. An effect that weakens
            what the force does, such as friction in proportion to it, makes both sides of the
            equation small, noise included; the slope of the residual by the force takes that off.
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


@dataclass(frozen=True)
class _Joint:
    """The linear problem of a model with a candidate of given shape.

    Attributes:
        sums: its sums of products.
        added, change: what the candidate adds to the columns and to the residual, by trial,
            (K, n_q, m) and (K, n_q).
        columns: what it adds, (n, m), for comparing shapes.
    """

    sums: NormalEquations
    added: Sequence[Array]
    change: Sequence[Array]
    columns: Array


def library(
    device: Device, present: Sequence[str], extra: Sequence[Effect] = ()
) -> tuple[str, ...]:
    """Names of the effects that could be added to ``device``, those in ``present`` left out."""
    known = {name: built_in(name) for name in effect_names()} | {e.name: e for e in extra}
    names = [
        f"{name}:{target}" if target else name
        for name, effect in sorted(known.items())
        for target in effect.targets(device)
    ]
    return tuple(name for name in names if name not in present)


def candidate_model(
    device: Device, name: str, extra: Sequence[Effect] = (), present: Sequence[str] = ()
) -> Model:
    """The model in which an effect is a candidate for one that has the effects ``present``.

    That is ``device`` with the effect alone, last with those present where they act on each other.

    Raises:
        InputError: there is no such effect or target.
    """
    full = Model(device, (*present, name), extra)
    *earlier, item = full.effects
    if any(follows(item, one, device) or follows(one, item, device) for one in earlier):
        return full
    return Model(device, (name,), extra)


def candidate(model: Model) -> Candidate:
    """The candidate that is the last effect of ``model``; see `candidate_model`."""
    system, item = compile_model(model), model.effects[-1]
    count = len(system.parameters) - len(item.parameters)
    own = system.parameters[count:]
    linear, searched = [], []
    for i, parameter in enumerate(own):
        if parameter.fixed:
            continue
        if parameter.strength and system.linear[count + i] and not system.moves_sensors:
            linear.append(i)
        else:
            searched.append(i)
    joint = len(model.effects) > 1
    return Candidate(item.name, system, joint, own, tuple(linear), tuple(searched))


class Scorer:
    """Scores candidates against one evidence."""

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = evidence
        # The trials that a session holds out choose no model.
        self.folds = evidence.folds.among_fitted()

    def _folds(self, item: Candidate) -> Folds:
        """What brakes do is part of the model with an effect of theirs, and fitted then."""
        return self.folds.with_all_fitted() if item.system.braked else self.folds

    @cached_property
    def independent(self) -> Array:
        """Number of independent samples that count in the error, by axis, (n_q,)."""
        judged = [k for k, counts in enumerate(self.folds.judged) if counts]
        count = self.evidence.sums.count[judged].sum(axis=0)
        return np.asarray(count * self.evidence.band.independent_share)

    @cached_property
    def scale(self) -> MachineScale:
        """What sizes the trials have."""
        return MachineScale.of_trials(self.evidence)

    @cached_property
    def before(self) -> Score:
        """The model as it is."""
        e = self.evidence
        steps = self.folds.solve(e.sums, e.weight, e.lower, e.upper, _OWN_WEIGHT)
        error = self.folds.error(e.sums, steps)
        return Score("", error, np.zeros(0), np.zeros(len(e.free)), np.zeros(len(error)))

    @cached_property
    def held_out_scale(self) -> Array:
        """What turns an error of a `Score` into one on the terms of the model's own, by axis.

        Candidates are scored with a little of the trial that is left out, models are judged without
        it: what the two have in common is the ratio.
        """
        return np.asarray(self.evidence.held_out_rmse / np.maximum(self.before.error, 1e-300))

    def _cost_before(self, item: Candidate) -> float:
        """Cost of the model as it is, fitted to the trials that ``item`` is fitted to."""
        e, folds = self.evidence, self._folds(item)
        steps = e.sums.subset(folds.fitted_trials).solve(e.weight, e.lower, e.upper)
        return self._cost(e.sums, steps, folds)

    def _cost(self, sums: NormalEquations, values: Array, folds: Folds) -> float:
        """Cost of a fit: sum over axes of n log(mean square)."""
        left = sums.subset(folds.fitted_trials).mean_square(values)
        return float(np.sum(self.independent * np.log(np.maximum(left, 1e-30))))

    def score(self, item: Candidate) -> Score | None:
        """Refit with ``item`` added; None where it does nothing in these trials.

        Searched parameters are scanned over their range, finely enough that neighbours on the
        grid resemble each other, and narrowed around the best; several are taken in turn, from
        `_STARTS`.
        """
        effect = item.system.model.effects[-1]
        ranges = [self.scale.range_of(effect, item.own[i]) for i in item.searched]
        hopeless = self._cost_before(item) - Settings().worth_searching
        found = [
            self._search(item, ranges, start, hopeless)
            for start in (_STARTS if len(ranges) > 1 else _STARTS[:1])
        ]
        costs = [each[1] if each is not None else np.inf for each in found]
        chosen = found[int(np.argmin(costs))]
        if chosen is None:
            return None
        at, cost = chosen
        if ranges and cost > hopeless:
            return self._absent(item)
        best = self._at(item, np.array(at))
        # An error of exactly zero, on an axis that nothing drives, is no explanation.
        return best if best is not None and np.isfinite(best.gain).all() else None

    def _search(
        self, item: Candidate, ranges: Sequence[SearchRange], start: float, hopeless: float
    ) -> tuple[list[float], float] | None:
        """Best searched parameters, and their cost; None if one never matters.

        Begins with every one at a share ``start`` of its range, and ends where the first round of
        all leaves more than ``hopeless``.
        """
        at = [r.within(start) for r in ranges]
        cost = -np.inf
        for _ in range(min(len(ranges), 2)):
            for k, interval in enumerate(ranges):
                found = self._scan(item, at, k, interval)
                if found is None:
                    return None
                at[k], cost = found
                if cost > hopeless:
                    return at, cost
        return at, cost

    def score_at(self, item: Candidate, values: Array) -> Score | None:
        """Refit with ``item`` added, its searched parameters held at those of ``values``."""
        found = self._at(item, values[list(item.searched)])
        return found if found is not None and np.isfinite(found.gain).all() else None

    def gain_by_sample(self, item: Candidate, score: Score) -> list[Array]:
        """Gain in log likelihood that each sample contributes, by trial, each (K,).

        That of the fit; zero in trials that the session holds out, for they choose no model.
        """
        problem = self._problem(item, score.values[list(item.searched)])
        if problem is None:
            return [np.zeros(len(r)) for r in self.evidence.residual]
        values, weight = self._fit(item, problem.sums)
        e, count = self.evidence, len(self.evidence.free)
        rows = zip(
            self.folds.judged, e.residual, e.jacobian, problem.change, problem.added, strict=True
        )
        return [
            0.5
            * (np.square(r) - np.square(r + moved + x @ values[:count] + new @ values[count:]))
            @ weight
            * judged
            for judged, r, x, moved, new in rows
        ]

    def _absent(self, item: Candidate) -> Score:
        """The score of an effect that these trials do not ask for: strength zero."""
        values = np.array([0.0 if p.strength else p.prior for p in item.own])
        nothing = np.zeros(len(self.before.error))
        return Score(item.name, self.before.error, values, nothing[:0], nothing)

    def _scan(
        self,
        item: Candidate,
        at: list[float],
        k: int,
        interval: SearchRange,
    ) -> tuple[float, float] | None:
        """Best value of one searched parameter, the others held, and its cost; None if it
        never matters."""

        def cost(value: float) -> tuple[float, Array] | None:
            return self._in_sample(item, np.array([*at[:k], value, *at[k + 1 :]]))

        low, high, count = (
            interval.low,
            interval.high,
            _GRID if len(item.searched) == 1 else _GRID - 2,
        )
        if interval.by_ratio:
            count = max(count, min(int(np.log(high / low) / np.log(_LARGEST_RATIO)) + 2, 2 * _GRID))
            grid = list(np.geomspace(low, high, count))
        else:
            grid = list(np.linspace(low, high, count))
        if at[k] not in grid:
            # Where the others were searched from must not be lost between two points.
            grid = sorted([*grid, at[k]])
        known = [cost(value) for value in grid]
        if all(found is None for found in known):
            return None
        i = 0
        while i + 1 < len(grid) and len(grid) < _DENSEST:
            first, second = known[i], known[i + 1]
            if (
                item.linear
                and first
                and second
                and _column_similarity(first[1], second[1]) < _SIMILAR
            ):
                middle = between(grid[i], grid[i + 1])
                grid.insert(i + 1, middle)
                known.insert(i + 1, cost(middle))
            else:
                i += 1
        values = [found[0] if found else np.inf for found in known]
        j = int(np.argmin(values))
        best, x = values[j], grid[j]
        ends = [grid[max(j - 1, 0)], grid[min(j + 1, len(grid) - 1)]]
        for _ in range(_REFINE):
            for side in (0, 1):
                middle = between(x, ends[side])
                found = cost(middle)
                if found is not None and found[0] < best:
                    ends[1 - side], x, best = x, middle, found[0]
                    break
            else:
                ends = [between(x, ends[0]), between(x, ends[1])]
        return float(x), float(best)

    def _problem(self, item: Candidate, searched: Array) -> _Joint | None:
        columns, change = self._columns(item, searched)
        if all(not c.any() for c in columns) and all(not c.any() for c in change):
            return None
        if not all((np.abs(c) < _DIVERGED).all() for c in (*columns, *change)):
            return None
        e = self.evidence
        shape = np.concatenate(columns if item.linear else change)
        flat = shape.reshape(-1, shape.shape[-1]) if item.linear else shape
        sums = e.sums.bordered(e.jacobian, columns, change, e.residual)
        return _Joint(sums, columns, change, flat)

    def _bounds(self, item: Candidate) -> tuple[Array, Array]:
        """Bounds of the changes of the base parameters and of the linear strengths."""
        own = [item.own[i] for i in item.linear]
        return (
            np.append(self.evidence.lower, [q.lower for q in own]),
            np.append(self.evidence.upper, [q.upper for q in own]),
        )

    def _in_sample(self, item: Candidate, searched: Array) -> tuple[float, Array] | None:
        """Cost of the joint fit, and the columns."""
        problem = self._problem(item, searched)
        if problem is None:
            return None
        values, _ = self._fit(item, problem.sums)
        return self._cost(problem.sums, values, self._folds(item)), problem.columns

    def _fit(self, item: Candidate, sums: NormalEquations) -> tuple[Array, Array]:
        """Coefficients of the joint fit, reweighted once by what each axis is left with."""
        weight, bounds = self.evidence.weight, self._bounds(item)
        fitted = sums.subset(self._folds(item).fitted_trials)
        for _ in range(2):
            values = fitted.solve(weight, *bounds)
            weight = 1.0 / np.maximum(fitted.mean_square(values), 1e-24)
        return values, weight

    def _at(self, item: Candidate, searched: Array) -> Score | None:
        problem = self._problem(item, searched)
        if problem is None:
            return None
        sums = problem.sums
        values, weight = self._fit(item, sums)
        folds, (lower, upper) = self._folds(item), self._bounds(item)
        own = np.array([p.prior for p in item.own])
        own[list(item.searched)] = searched
        start = len(self.evidence.free)
        own[list(item.linear)] = values[start:]

        def error_within(lower: Array, upper: Array) -> Array:
            steps = folds.solve(sums, weight, lower, upper, _OWN_WEIGHT)
            return folds.error(sums, steps)

        if not item.system.driven:
            error = error_within(lower, upper)
            gain = self.independent * np.log(self.before.error / error)
            return Score(item.name, error, own, values[:start], gain)
        best = None
        for share in _SHARES if item.linear else (1.0,):
            weaker = own.copy()
            weaker[list(item.linear)] *= share
            # Equal bounds hold the strengths at this share while the base parameters adapt.
            low, high = lower.copy(), upper.copy()
            if item.linear:
                low[start:] = high[start:] = weaker[list(item.linear)]
            error = error_within(low, high)
            gain = np.log(self.before.error / error) + self._sensitivity(item, weaker)
            if best is None or self.independent @ gain > self.independent @ best.gain:
                fitted = sums.subset(folds.fitted_trials)
                shift = fitted.solve(weight, low, high)[:start]
                best = Score(item.name, error, weaker, shift, gain)
        assert best is not None
        # Both sides of the equation made small explain nothing, however small the error becomes.
        if self.independent @ best.gain < Settings().worth_searching:
            return self._absent(item)
        return replace(best, gain=self.independent * best.gain)

    def _sensitivity(self, item: Candidate, own: Array) -> Array:
        """Mean of log |d residual / d force| with the effect over without it, by axis, (n_q,)."""
        e, system = self.evidence, item.system
        p = np.concatenate([e.p[: len(system.parameters) - len(own)], own])
        total = np.zeros(len(system.coordinates))
        for motion, used in zip(e.motions, e.used, strict=True):
            kept = e.band.kept(len(motion.t))
            u = motion.inputs(system.inputs)
            z = system.memory(motion.q, motion.qd, motion.qdd, u, p, motion.t)
            at = motion.q[kept], motion.qd[kept], motion.qdd[kept], z[kept]
            plain = system.input_map(at[0], u[kept], p)
            here, slope = system.contribution(*at, u[kept], p), plain.copy()
            for j, force in enumerate(system.model.device.forces):
                moved, column = u[kept].copy(), system.inputs.index(force)
                step = 1e-6 * max(float(np.abs(moved[:, column]).max()), 1e-6)
                moved[:, column] += step
                slope[:, :, j] += (system.contribution(*at, moved, p) - here) / step
            bare = np.linalg.norm(plain, axis=2)
            share = np.linalg.norm(slope, axis=2) / np.where(bare > 0.0, bare, 1.0)
            total += np.sum(np.where(bare > 0.0, np.log(np.maximum(share, 1e-3)), 0.0) * used, 0)
        return np.asarray(total / np.maximum(self.evidence.sums.count.sum(axis=0), 1.0))

    def _columns(self, item: Candidate, searched: Array) -> tuple[list[Array], list[Array]]:
        """Columns of the linear strengths (K, n_q, m) and change of the residual (K, n_q)."""
        e, system = self.evidence, item.system
        count = len(system.parameters) - len(item.own)
        p = np.concatenate([e.p[:count], [q.prior for q in item.own]])
        p[[count + i for i in item.searched]] = searched
        p[[count + i for i in item.linear]] = 0.0
        axes = list(range(len(system.coordinates)) if system.moves_sensors else system.touched)
        columns, changes = [], []
        for trial, (motion, used) in enumerate(zip(e.motions, e.used, strict=True)):
            z = None if system.moves_sensors and not item.joint else memory_of(item, motion, p)
            rows = [
                added_residual(item, motion, probe, e.system, e.p, e.unfiltered(trial), z)
                for probe in _probes(p, count, item.linear)
            ]
            thin = self._thin(rows, used, axes)
            if item.linear:
                columns.append(thin.transpose(0, 2, 1))
                changes.append(np.zeros(used.shape))
            else:
                columns.append(np.zeros((*used.shape, 0)))
                changes.append(thin[:, 0])
        return columns, changes

    def _thin(self, rows: list[Array], used: NDArray[np.bool_], axes: Sequence[int]) -> Array:
        """Low-pass each (T, n_q) of ``rows``; only ``axes`` can differ from zero."""
        out = np.zeros((len(used), len(rows), used.shape[1]))
        for r, values in enumerate(rows):
            out[:, r, axes] = self.evidence.band.thin(values[:, axes], axes) * used[:, axes]
        return out


def memory_of(item: Candidate, motion: Motion, p: Array) -> Array:
    """Internal states (T, n_z) of a candidate with the parameters ``p`` of its system."""
    system = item.system
    u = motion.inputs(system.inputs)
    return system.memory(motion.q, motion.qd, motion.qdd, u, p, motion.t)


def added_residual(
    item: Candidate,
    motion: Motion,
    p: Array,
    base: System,
    base_p: Array,
    unfiltered: tuple[Array, Array],
    z: Array | None = None,
) -> Array:
    """What a candidate adds to the residual of a model along a motion, (T, n_q), N.m or N.

    Args:
        item: the candidate; motion: the trial.
        p: parameters of its system, its own last.
        base, base_p: the model without it, and its parameters.
        unfiltered: residual (T, n_q) and internal states (T, n_z) of that model on the trial.
        z: internal states of the candidate, from `memory_of`, where they are known already.
    """
    system, (plain, memory) = item.system, unfiltered
    at = motion.q, motion.qd, motion.qdd
    u = motion.inputs(system.inputs)
    if system.moves_sensors and not item.joint:
        true = system.true_motion(*at, u, p)
        return base.residual(*true, memory, motion.inputs(base.inputs), base_p) - plain
    if z is None:
        z = memory_of(item, motion, p)
    if item.joint:
        return system.applied(*at, z, u, p) - system.required(*at, z, u, p) - plain
    return system.contribution(*at, z, u, p)


def _probes(p: Array, count: int, linear: Sequence[int]) -> list[Array]:
    """``p`` with each of the ``linear`` strengths, numbered from ``count``, at one; or as it is."""
    probes = [p.copy() for _ in linear or (None,)]
    for probe, i in zip(probes, linear, strict=False):
        probe[count + i] = 1.0
    return probes


def _column_similarity(a: Array, b: Array) -> float:
    """Cosine between two sets of columns: one where they span the same, zero where nothing."""
    first, second = np.linalg.qr(a)[0], np.linalg.qr(b)[0]
    return float(np.linalg.norm(first.T @ second) / np.sqrt(a.shape[1]))
