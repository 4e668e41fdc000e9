"""Maps of a residual by the variables of the motion, and its worst windows."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array, Indices
from bampipe.estimate.low_pass import Band
from bampipe.physics.effect import state_units
from bampipe.results.diagnose import ResidualMap, WorstWindow
from bampipe.trials.linearisation import Linearisation
from bampipe.trials.measured import trial_of_block
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import ModelOnTrial

BINS = 16
_LEAST = 12
"""Smallest number of samples in a bin of a map."""


@dataclass(frozen=True)
class Variable:
    """A quantity that a residual may depend on, at the thinned samples of each trial, (K,) each."""

    name: str
    unit: str
    values: tuple[Array, ...]


def variables(fitted: Sequence[ModelOnTrial], band: Band, axis: int) -> tuple[Variable, ...]:
    """Return the variables by which the residual of one axis is mapped."""
    system = fitted[0].system
    coordinate = system.model.device.coordinates[axis]
    unit = coordinate.unit
    columns: dict[str, tuple[str, list[Array]]] = {}

    def put(name: str, in_unit: str, values: Array) -> None:
        columns.setdefault(name, (in_unit, []))[1].append(values)

    for index, here in enumerate(fitted):
        motion, memory = here.motion, here.memory
        kept = band.thinned_rows(len(motion.t))
        # The modelled load: the residual itself is a part of the measured one.
        load = (here.applied - here.residual)[:, axis]
        since, distance = since_reversal(motion, axis)
        put("position", unit, motion.q[kept, axis])
        put("velocity", f"{unit}/s", motion.qd[kept, axis])
        put("acceleration", f"{unit}/s2", motion.qdd[kept, axis])
        put("load", coordinate.torque_unit, load[kept])
        put("direction", "", np.sign(motion.qd[kept, axis]))
        put("time since reversal", "s", since[kept])
        put("distance since reversal", unit, distance[kept])
        for k, other in enumerate(system.model.device.coordinates):
            if k != axis:
                put(f"{other.name} position", other.unit, motion.q[kept, k])
                put(f"{other.name} velocity", f"{other.unit}/s", motion.qd[kept, k])
        for item in system.model.effects:
            for state, in_unit in state_units(item, system.model.device).items():
                k = system.memory_names.index(f"{item.prefix}.{state}")
                put(f"{state} of {item.prefix}", in_unit, memory[kept, k])
        put("time", "s", motion.t[kept])
        put("trial", "", np.full(len(kept), float(index)))
    return tuple(Variable(name, u, tuple(v)) for name, (u, v) in columns.items())


def since_reversal(motion: Motion, axis: int) -> tuple[Array, Array]:
    """Return the time (s) and the distance since the velocity last changed sign, each (T,)."""
    sign = motion.qd[:, axis] > 0.0
    last = np.zeros(len(sign), dtype=int)
    changes = np.flatnonzero(sign[1:] != sign[:-1]) + 1
    last[changes] = changes
    last = np.maximum.accumulate(last)
    return motion.t - motion.t[last], np.abs(motion.q[:, axis] - motion.q[last, axis])


def number_bins(values: Array, bins: int) -> Indices:
    """Return the index of the bin of each value, (T,); bins hold equal counts."""
    edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, bins + 1)))
    found = np.searchsorted(edges, values, side="right") - 1
    return np.clip(found, 0, max(len(edges) - 2, 0)).astype(np.int64)


def share_between(values: Array, which: Indices) -> float:
    """Return the share of the variance of values (T,) that the means of their bins explain."""
    count = np.bincount(which)
    means = np.bincount(which, values) / np.maximum(count, 1)
    total = float(np.sum((values - values.mean()) ** 2))
    between = float(np.sum(count * (means - values.mean()) ** 2))
    return min(1.0, between / total) if total > 0.0 else 0.0


def take_used(linearisation: Linearisation, axis: int, variable: Variable) -> tuple[Array, Array]:
    """Return variable and residual of an axis at the samples that count, (n,) each."""
    use = np.concatenate([u[:, axis] for u in linearisation.used]) > 0
    left = np.concatenate([x[:, axis] for x in linearisation.residual])
    return np.concatenate(variable.values)[use], left[use]


def residual_map(
    linearisation: Linearisation, axis: int, variable: Variable, bins: int = BINS
) -> ResidualMap:
    """Average the residual of ``axis`` in ``bins`` parts of ``variable`` with equal counts.

    The confidence band is of 95 %, over independent samples.
    """
    v, r = take_used(linearisation, axis, variable)
    levels = np.unique(v)
    which = np.searchsorted(levels, v) if len(levels) <= bins else number_bins(v, bins)
    rows = [
        (v[which == b].mean(), r[which == b].mean(), r[which == b].std(), np.sum(which == b))
        for b in np.unique(which)
        if np.sum(which == b) >= _LEAST
    ]
    center, mean, sd, n = np.array(rows, dtype=float).reshape(-1, 4).T
    half = 1.96 * sd / np.sqrt(np.maximum(n * linearisation.band.independent_share[axis], 2.0))
    share = 0.0
    if rows:
        between, whole = np.sum(n * (mean - r.mean()) ** 2), np.sum((r - r.mean()) ** 2)
        share = min(float(between) / max(float(whole), 1e-30), 1.0)
    return ResidualMap.of(
        unit=variable.unit, center=center, mean=mean, low=mean - half, high=mean + half,
        count=n.astype(int), variance_share=share,
    )  # fmt: skip


def worst_windows(
    linearisation: Linearisation, count: int = 10, width_s: float = 0.5
) -> list[WorstWindow]:
    """Return the ``count`` windows with the largest error relative to that of their axis.

    The worst window of each axis is always among them.
    """
    band, system = linearisation.band, linearisation.system
    length = max(2, int(width_s * band.rate_hz / band.step))
    typical = linearisation.rmse()
    found: list[tuple[float, WorstWindow]] = []
    for k, motion in enumerate(linearisation.motions):
        kept = band.thinned_rows(len(motion.t))
        for start in range(0, len(kept) - length + 1, length):
            rows = slice(start, start + length)
            for axis, name in enumerate(system.coordinates):
                n = linearisation.used[k][rows, axis].sum()
                if n < 0.5 * length:
                    continue
                rmse = float(np.sqrt(np.sum(linearisation.residual[k][rows, axis] ** 2) / n))
                t = motion.t[kept[rows]]
                window = WorstWindow(
                    axis=name,
                    trial_id=trial_of_block(motion.trial_id),
                    t_start=t[0],
                    t_end=t[-1],
                    rmse=rmse,
                    unit=system.torque_units[axis],
                    doing=_doing(motion, kept[rows], axis, system.coordinate_units[axis]),
                )
                found.append((rmse / max(typical[axis], 1e-12), window))
    found.sort(key=lambda pair: -pair[0])
    windows = [window for _, window in found]
    listed = windows[:count]
    for other in windows[count:]:
        if all(other.axis != one.axis for one in listed):
            listed.append(other)
    return listed


def _doing(motion: Motion, rows: Indices, axis: int, unit: str) -> str:
    q, qd = motion.q[rows, axis], motion.qd[rows, axis]
    moved = "reversing" if np.any(qd > 0) and np.any(qd < 0) else (
        "moving forwards" if qd.mean() > 0 else "moving backwards"
    )  # fmt: skip
    return f"{moved} near {_size(q.mean(), unit)} at up to {_size(np.abs(qd).max(), unit)}/s"


def _size(value: float, unit: str) -> str:
    """Return a position or speed with two decimals, in mm if metres would show too few."""
    if unit == "m" and abs(value) < 0.1:
        return f"{round(1e3 * value, 2) + 0.0:.4g} mm"
    return f"{round(float(value), 2) + 0.0:.2f} {unit}"
