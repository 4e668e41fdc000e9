"""Comparison of two sessions of one device, and prediction of each by the model of the other."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
import pandas as pd

from bampipe.api import actions
from bampipe.api.opened import open_run
from bampipe.arrays import Array, Flags
from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model_file import load_model, read_estimate
from bampipe.diagnosis.shape import variables
from bampipe.errors import InputError
from bampipe.lists import join_names
from bampipe.phrases import diagnosis as diagnosis_phrases
from bampipe.phrases import pair as phrases
from bampipe.physics import System, compile_model
from bampipe.progress import Progress, silent
from bampipe.results.diagnose import DiagnoseResult, ResidualMap
from bampipe.results.floor import AT_FLOOR, FLOOR_SDS
from bampipe.results.identify import BaseEstimate, IdentifyResult, ParameterEstimate
from bampipe.results.pair import (
    FAMILY_ERROR,
    Journey,
    PairResult,
    ParameterChange,
    Refit,
    SessionOfPair,
    StateChange,
    Travel,
)
from bampipe.results.rounding import NORMAL_95
from bampipe.results.validate import ValidateResult
from bampipe.run import models
from bampipe.trials.linearisation import Linearisation, linearise_fit
from bampipe.trials.measured import read_measured_trials

_MAPPED_VARIABLES = ("position", "velocity", "direction")
_MAP_BINS, _FEWEST_SAMPLES, _MOST_REFITS = 8, 12, 5
_LEAST_GAIN = 0.03
"""Smallest fall of the log error above the limits for which another parameter is refitted."""
_REFIT_STEPS = 4
"""Gauss-Newton steps of a refit if the residual is not linear in its parameters."""


@dataclass(frozen=True)
class _Side:
    """A session and one of its models."""

    name: str
    run: RunFolder
    model: str
    system: System
    p: Array
    found: IdentifyResult
    validated: ValidateResult

    @classmethod
    def read(cls, root: Path, name: str, model: str) -> Self:
        run, model = RunFolder(root), models.choose_model(root, model)
        found, validated = run.read(IdentifyResult, model), run.read(ValidateResult, model)
        system = compile_model(load_model(run, model))
        p = read_estimate(run, model, system)
        return cls(name, run, model, system, p, found, validated)

    @property
    def effects(self) -> tuple[str, ...]:
        return tuple(effect.name for effect in self.system.model.effects)

    def predict(self, other: Self) -> Linearisation:
        """Evaluate this model on the trials of ``other`` without a refit."""
        trials = read_measured_trials(other.run, self.system, timing=other.found.input_timing)
        return linearise_fit(
            self.system, trials.motions, trials.band, self.p, trials.folds, most_iterations=0
        )

    def covariance(self, linearisation: Linearisation) -> Array:
        """Return the covariance of the free parameters, (n, n); 0 if they were not estimated."""
        known = self.found.covariance
        free = [self.system.parameters[i].name for i in linearisation.free]
        frame = pd.DataFrame(known.matrix, list(known.names), list(known.names))
        return np.asarray(frame.reindex(index=free, columns=free, fill_value=0.0))

    def describe(self) -> SessionOfPair:
        found = self.run.find(DiagnoseResult, self.model)
        verdicts = {}
        if found is not None:
            verdicts = {axis: diagnosis_phrases.verdict(found, axis) for axis in found.axes}
        return SessionOfPair(session=self.name, model=self.model, verdicts=verdicts)


def compare_runs(
    first: str | Path, second: str | Path, model: str = "", progress: Progress = silent
) -> PairResult:
    """Compare two identified sessions of one device.

    Args:
        first, second: run folders.
        model: model of both sessions; by default the best confirmed one of each.

    Raises:
        InputError: devices, axes or parameters differ, both runs are the same, or a stage has not
            run.
    """
    roots = [open_run(run).root for run in (first, second)]
    differ = roots[0].name != roots[1].name
    a, b = (_Side.read(root, root.name if differ else str(root), model) for root in roots)
    notes = _require_one_device(a, b)
    progress(0.1, f"predicting {b.name} with the model of {a.name}, and the reverse")
    there, back = a.predict(b), b.predict(a)
    journeys = []
    for one, other, linearisation in ((a, b, there), (b, a, back)):
        progress(0.3, f"looking for effects that the model of {one.name} lacks on {other.name}")
        journeys.append(_describe_journey(one, other, linearisation))
    progress(0.9, "comparing the residuals by state")
    parameters, alone = _compare_parameters(a, b)
    notes += [f"Only {name} has {join_names(some)}." for name, some in alone.items() if some]
    pair = PairResult(
        device=a.system.model.device.name,
        first=a.describe(),
        second=b.describe(),
        parameters=parameters,
        states=_compare_states(a, a.predict(a), there),
        journeys=tuple(journeys),
        notes=tuple(notes),
    )
    return pair.model_copy(update={"sentences": tuple(phrases.describe_pair(pair))})


def _require_one_device(a: _Side, b: _Side) -> list[str]:
    """Refuse sessions that cannot be compared; return notes on the others."""
    if a.run.root.resolve() == b.run.root.resolve():
        raise InputError("both runs are the same", where=str(a.run.root))
    ours, theirs = (_list_facts(side.system) for side in (a, b))
    for what, here in ours.items():
        only = (here - theirs[what], theirs[what] - here)
        if any(only):
            only_here, only_there = (join_names(sorted(names)) or "none" for names in only)
            raise InputError(
                f"the sessions differ in {what}: {only_here} only in {a.name},"
                f" {only_there} only in {b.name}",
                where=str(b.run.root),
                remedy="compare sessions of one device",
            )
    one, other = (side.system.model.device.declaration for side in (a, b))
    keys = {*one, *other} - {"name", "summary", "source"}
    changed = sorted(key for key in keys if one.get(key) != other.get(key))
    notes = [f"The device files differ in {join_names(changed)}."] if changed else []
    if a.effects != b.effects:
        notes.append("The models have different effects beside their common parameters.")
    return notes


def _list_facts(system: System) -> dict[str, set[str]]:
    """Return the device, its axes and its parameters, which two sessions must share."""
    of_effects = {q.name for effect in system.model.effects for q in effect.parameters}
    own = (q for q in system.parameters if q.name not in of_effects)
    return {
        "device": {system.model.device.name},
        "axes": {*system.coordinates},
        "parameters": {f"{q.name} ({q.unit})" for q in own},
    }


def _compare_parameters(
    a: _Side, b: _Side
) -> tuple[dict[str, ParameterChange], dict[str, list[str]]]:
    """Return the changes of common parameters, and the other parameters of each session."""
    tables: list[dict[str, ParameterEstimate | BaseEstimate]] = []
    for found in (a.found, b.found):
        own = {n: entry for n, entry in found.parameters.items() if n not in found.inertial}
        shown = {base.combination: base for base in found.base_parameters or () if base.shown}
        tables.append({**own, **shown})
    common = [name for name in tables[0] if name in tables[1]]
    pairs = {name: (tables[0][name], tables[1][name]) for name in common}
    z = []
    for x, y in pairs.values():
        sd = math.hypot(x.sd, y.sd)
        z.append((y.estimate - x.estimate) / sd if sd else 0.0)
    p_values = correct_p_values(z)
    changes = {
        name: ParameterChange(
            first=x.estimate, first_sd=x.sd, second=y.estimate, second_sd=y.sd, unit=x.unit,
            standard_errors=ratio, p_value=p, changed=p < FAMILY_ERROR,
        )
        for (name, (x, y)), ratio, p in zip(pairs.items(), z, p_values, strict=True)
    }  # fmt: skip
    sides = zip((a, b), tables, strict=True)
    return changes, {side.name: [n for n in some if n not in common] for side, some in sides}


def correct_p_values(z: Sequence[float]) -> list[float]:
    """Return two-sided p-values of standard normal numbers, corrected by Holm (1979)."""
    p = np.array([math.erfc(abs(value) / math.sqrt(2.0)) for value in z])
    order, found = np.argsort(p), np.ones(len(p))
    found[order] = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    return [float(value) for value in np.minimum(found, 1.0)]


def _compare_states(a: _Side, here: Linearisation, there: Linearisation) -> tuple[StateChange, ...]:
    """Return the residual of the model of ``a`` on both sessions, in equal bins of the state."""
    spread, found, every = a.covariance(here), [], []
    for axis, name in enumerate(a.system.coordinates):
        known = [variables(e.fitted, e.band, axis) for e in (here, there)]
        pairs = zip(*known, strict=True)
        for one, other in ((x, y) for x, y in pairs if x.name in _MAPPED_VARIABLES):
            x, y = (np.concatenate(v.values) for v in (one, other))
            edges = np.unique(np.quantile(np.append(x, y), np.linspace(0.0, 1.0, _MAP_BINS + 1)))
            if one.name == "direction":
                edges = np.array([-1.5, 0.0, 1.5])
            bins = [_bin_residual(e, axis, v, edges) for e, v in ((here, x), (there, y))]
            both = bins[0].index.intersection(bins[1].index)
            first, second = (table.loc[both] for table in bins)
            change = (second - first).to_numpy()[:, 4:]
            of_model = np.einsum("bi,ij,bj->b", change, spread, change)
            sd = np.sqrt(first["sd"] ** 2 + second["sd"] ** 2 + of_model)
            z = ((second["mean"] - first["mean"]) / np.maximum(sd, 1e-300)).tolist()
            found.append((name, one, first, second, len(z)))
            every += z
    p_values = iter(correct_p_values(every))
    return tuple(
        StateChange(
            axis=axis, variable=variable.name, first=_make_map(first, variable.unit),
            second=_make_map(second, variable.unit),
            p_values=tuple(next(p_values) for _ in range(count)),
        )
        for axis, variable, first, second, count in found
    )  # fmt: skip


def _bin_residual(e: Linearisation, axis: int, values: Array, edges: Array) -> pd.DataFrame:
    """Return centre, mean residual, its standard error, count and mean slopes of each bin.

    The standard error is the larger of those within and between trials.
    """
    use = np.concatenate([used[:, axis] for used in e.used])
    trial = np.repeat(np.arange(len(e.used)), [len(used) for used in e.used])[use]
    residual = np.concatenate([r[:, axis] for r in e.residual])[use]
    slopes = np.concatenate([s[:, axis] for s in e.jacobian])[use]
    which = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)[use]
    frame = pd.DataFrame({"center": values[use], "mean": residual})
    count = frame.groupby(which).size()
    means = pd.concat([frame, pd.DataFrame(slopes)], axis=1).groupby(which).mean()
    independent = np.maximum(count * e.band.independent_share[axis], 2.0)
    within = frame["mean"].groupby(which).std(ddof=0) / np.sqrt(independent)
    off = frame["mean"] - means["mean"].reindex(which).to_numpy()
    by_trial = off.groupby([which, trial]).sum()
    between = np.sqrt((by_trial**2).groupby(level=0).sum()) / count
    means.insert(2, "sd", np.maximum(within, between))
    means.insert(3, "count", count)
    return means[count >= _FEWEST_SAMPLES]


def _make_map(bins: pd.DataFrame, unit: str) -> ResidualMap:
    mean, half = bins["mean"], NORMAL_95 * bins["sd"]
    columns = {"center": bins["center"], "mean": mean, "low": mean - half, "high": mean + half}
    return ResidualMap.of(unit=unit, count=bins["count"], variance_share=0.0, **columns)


def _describe_journey(model: _Side, trials: _Side, e: Linearisation) -> Journey:
    """Predict the trials of one session with the model of the other, and refit it if it fails."""
    judged = list(np.flatnonzero(e.folds.judged))
    count = np.maximum(e.sums.count[judged].sum(axis=0), 1.0)
    of_spread = np.einsum("kaij,ij->a", e.sums.xx[judged], model.covariance(e))
    spread = np.sqrt(np.maximum(of_spread, 0.0) / count)
    error = np.sqrt(e.sums.yy[judged].sum(axis=0) / count)
    axes = {}
    for i, axis in enumerate(e.system.coordinates):
        judge = trials.validated.axes[axis]
        least = judge.noise_floor
        if least is None or model.validated.axes[axis].standing != "at_floor":
            # A model that fails on its own trials may have the same error on the others.
            least = max(judge.held_out_rmse, least or 0.0)
        limit = AT_FLOOR * math.hypot(least, spread[i]) + FLOOR_SDS * judge.noise_floor_sd
        axes[axis] = Travel(
            error=error[i], uncertainty=spread[i], own_error=judge.held_out_rmse,
            noise_floor=judge.noise_floor, limit=limit, unit=judge.unit,
            travels=bool(error[i] <= limit),
        )  # fmt: skip
    journey = Journey(model_of=model.name, trials_of=trials.name, effects=model.effects, axes=axes)
    if not journey.failed:
        return journey
    limits = np.array([max(one.limit, 1e-12) for one in axes.values()])
    alone = [_refit(e, [k], limits) for k in range(len(e.free))]
    alone.sort(key=lambda one: float(np.sum((np.array([*one.errors.values()]) / limits) ** 2)))
    together = _refit_together(e, limits)
    update: dict[str, object] = {"alone": tuple(alone[:_MOST_REFITS]), "together": together}
    doubtful = {*journey.failed} - {*(together.travels if together is not None else ())}
    doubtful |= {a for a, v in trials.validated.axes.items() if v.standing == "above_floor"}
    if doubtful:
        update |= _find_lacking(model, trials, doubtful)
    return journey.model_copy(update=update)


def _refit_together(e: Linearisation, limits: Array) -> Refit | None:
    """Refit parameters, one more at a time while an axis comes closer to its limit."""
    chosen: list[int] = []
    error = e.rmse()
    while len(chosen) < len(e.free) and np.any(error > limits):
        left = [k for k in range(len(e.free)) if k not in chosen]
        tried = {k: _solve(e, [*chosen, k], limits)[1] for k in left}
        best = min(left, key=lambda k: _sum_excess(tried[k], limits))
        if _sum_excess(tried[best], limits) > _sum_excess(error, limits) - _LEAST_GAIN:
            break
        chosen.append(best)
        error = tried[best]
    return _refit(e, chosen, limits) if chosen else None


def _sum_excess(error: Array, limits: Array) -> float:
    """Return the sum of log(error / limit) over the axes above their limits."""
    return float(np.sum(np.log(np.maximum(error / limits, 1.0))))


def _refit(e: Linearisation, chosen: list[int], limits: Array) -> Refit:
    """Refit the free parameters with indices ``chosen`` and hold the others."""
    start, free = e.p, list(e.free)
    step, error = _solve(e, chosen, limits)
    if not all(e.system.constant[free[k]] for k in chosen):
        for _ in range(_REFIT_STEPS):
            p = e.p.copy()
            p[free] += step
            e = linearise_fit(e.system, e.motions, e.band, p, e.folds, most_iterations=0)
            step, error = _solve(e, chosen, limits)
    change = (e.p - start)[free] + step
    errors = dict(zip(e.system.coordinates, map(float, error), strict=True))
    return Refit(
        changes={e.system.parameters[free[k]].name: float(change[k]) for k in chosen},
        errors=errors,
        travels=tuple(axis for (axis, x), y in zip(errors.items(), limits, strict=True) if x <= y),
    )


def _solve(e: Linearisation, chosen: list[int], limits: Array) -> tuple[Array, Array]:
    """Return a linear step of the free parameters, and its held-out error, (n_q,).

    Those that are not ``chosen`` stay. Priors do not count: they held in the other session.
    """
    sums = replace(e.sums, precision=np.zeros(len(e.free)))
    groups, judged, fitted = map(np.array, (e.folds.groups, e.folds.judged, e.folds.fitted))
    moves = np.isin(range(len(e.free)), chosen)
    lower, upper = np.where(moves, [e.lower, e.upper], 0.0)

    def solve(rows: Flags) -> Array:
        return sums.subset(np.flatnonzero(rows).tolist()).solve(limits**-2, lower, upper)

    total, count = np.zeros((2, len(limits)))
    for group in np.unique(groups[judged]):
        others = fitted & (groups != group)
        part = sums.subset(np.flatnonzero(judged & (groups == group)).tolist())
        size = part.count.sum(axis=0)
        total += size * part.mean_square(solve(others if others.any() else fitted))
        count += size
    return solve(fitted), np.sqrt(total / np.maximum(count, 1.0))


def _find_lacking(model: _Side, trials: _Side, axes: Collection[str]) -> dict[str, object]:
    """Return the effects that a model with the same effects lacks in the other session."""
    root, found = trials.run.root, trials.run.models()
    alike = (m for m in found if {*models.read(root, m).effects} == {*model.effects})
    name = next(alike, trials.model)
    if not trials.run.exists(DiagnoseResult.file(name)):
        try:
            actions.diagnose(root, name)
        except InputError as error:
            return {"reason": error.what}
    lacking = trials.run.read(DiagnoseResult, name).axes
    return {"lacking": {a: lacking[a] for a in axes if lacking[a].verdict != "nothing_missing"}}
