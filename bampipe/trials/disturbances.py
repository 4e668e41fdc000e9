"""Stretches of trials that no model of the machine could explain: a hit, a dead sensor, a start.

Errors of a model come back wherever the machine does what they depend on. A stretch whose error is
many times that of the rest, while the same motion leaves an ordinary error at other times, tells of
an event; left in, it moves estimates and floors, and passes for a physical effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bampipe.estimate.least_squares import Stacked, minimise
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.results.filter import Disturbance
from bampipe.trials.cache import TrialCache
from bampipe.trials.motion import Motion, n_samples, trial_names, trial_sizes
from bampipe.trials.residuals import problem_of

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

BLOCK_S = 0.2
"""Length of the blocks of which the errors are compared, s."""
_TIMES = 20.0
"""Error of such a stretch over that of the rest. In 490 runs of machines with and without hidden
effects nothing that comes back and no start reached 18; a hit of 40 N for 80 ms, a force sensor
dead for a second and one that drifts as it warms up reached 30 to 800."""
_EDGE = 3.0
"""The same at its ends: what is left of an event there would still weigh."""
_MOST = 0.1
"""Share of the samples beyond which the rest is no longer the rule."""
_ORDINARY = 0.1
"""Share of a stretch's error that the same motion may have at other times."""
_APART_S = 1.0
_NEIGHBOURS, _FEWEST, _RADIUS = 12, 4, 0.25
"""Samples held against one of a stretch, and how near they are: in spreads of position and
velocity, and at least `_APART_S` away or in another trial."""
_SLOWLY = 50.0
_ROUNDS = 8
_SHORTEST_S = 1.0
"""Of a part between two disturbances, s, that a filter can start in."""


@dataclass(frozen=True)
class _Blocks:
    """Thinned samples of all trials in blocks.

    Attributes:
        block: (N,) number of the block of each sample, in the order of time within each trial.
        trial: (B,) number of the trial of each block.
        starts, ends: (B,) s since the start of the trial.
    """

    block: NDArray[np.int64]
    trial: NDArray[np.int64]
    starts: Array
    ends: Array

    def mean_square(self, values: Array, used: Flags) -> Array:
        """Of values (N, n_q) over the samples used, (B, n_q), NaN where there is none."""
        found = np.full((self.trial.size, values.shape[1]), np.nan)
        for i in range(values.shape[1]):
            count = np.bincount(self.block, used[:, i], self.trial.size)
            total = np.bincount(self.block, values[:, i] ** 2 * used[:, i], self.trial.size)
            np.divide(total, count, out=found[:, i], where=count > 0)
        return found


def find_disturbances(
    system: System, motions: Sequence[Motion], band: Band, fitted: Sequence[int]
) -> dict[str, tuple[Disturbance, ...]]:
    """Find stretches with an error that nothing repeats, by trial.

    Args:
        system: the bare device; motions: the free trials; band: of the residual.
        fitted: numbers of the trials that a fit may see.

    Returns:
        The stretches of each trial that has some, in the order of time.
    """
    problem = problem_of(system, motions, band)
    try:
        found = minimise(problem, np.append(system.prior, 0.0), fitted, 12, tolerance=1e-6)
    except ValueError:  # hardly anything moves
        return {}
    stacked = dict(zip(fitted, found.stacked, strict=True))
    chosen = sorted(stacked)
    blocks = _cut([motions[k] for k in chosen], band)
    residual = np.concatenate([stacked[k].residual for k in chosen])
    used = np.concatenate([stacked[k].used for k in chosen])
    slope = np.concatenate([stacked[k].slope for k in chosen])
    error = _robust_residual(Stacked(residual, slope, used), blocks)
    del slope
    at = [band.thinned_rows(len(motions[k].t)) for k in chosen]
    q = np.concatenate([motions[k].q[rows] for k, rows in zip(chosen, at, strict=True)])
    qd = np.concatenate([motions[k].qd[rows] for k, rows in zip(chosen, at, strict=True)])
    t = np.concatenate([motions[k].t[rows] for k, rows in zip(chosen, at, strict=True)])
    mean_square = blocks.mean_square(error, used)
    stretches: dict[str, list[Disturbance]] = {}
    for i, axis in enumerate(system.coordinates):
        for first, last in _candidates(mean_square[:, i], blocks):
            inside = (blocks.block >= first) & (blocks.block <= last) & used[:, i]
            trial = blocks.trial[blocks.block]
            here = trial == blocks.trial[first]
            near = here & (t > blocks.starts[first] - _APART_S) & (t < blocks.ends[last] + _APART_S)
            others = used[:, i] & ~near
            size = float(np.sqrt(np.mean(error[inside, i] ** 2)))
            usual = _error_elsewhere(q[:, i], qd[:, i], error[:, i], inside, others)
            if usual is None or usual > _ORDINARY * size:
                continue
            rest = float(np.sqrt(np.mean(error[others, i] ** 2)))
            stretches.setdefault(motions[chosen[blocks.trial[first]]].trial_id, []).append(
                Disturbance(
                    start_s=float(blocks.starts[first]),
                    end_s=float(blocks.ends[last]),
                    axis=axis,
                    error=size,
                    rest=rest,
                )
            )
    return {
        name: tuple(sorted(found, key=lambda one: (one.start_s, one.axis)))
        for name, found in stretches.items()
    }


def disturbed_samples(t: Array, stretches: Sequence[Disturbance]) -> Flags:
    """Tell which samples at times (T,), s since the start of the trial, lie in a stretch, (T,)."""
    inside = np.zeros(t.size, dtype=bool)
    for one in stretches:
        inside |= (t >= one.start_s) & (t <= one.end_s)
    return inside


def describe_disturbances(
    found: Mapping[str, Sequence[Disturbance]], units: Mapping[str, str]
) -> list[str]:
    """Say of each trial which stretches are left out and why; ``units`` of position by axis."""
    lines = []
    for name, stretches in found.items():
        for one in stretches:
            unit = "N.m" if units[one.axis] == "rad" else "N"
            lines.append(
                f"{name}: {one.start_s:.1f} to {one.end_s:.1f} s left out: the error of"
                f" {one.axis} is {one.error:.3g} {unit} there, {one.rest:.3g} {unit} at all other"
                " times, the same motion included: a hit, a fault of a sensor or a start"
            )
    return lines


def part_trials(motions: Sequence[Motion], rate_hz: float) -> tuple[Sequence[Motion], list[int]]:
    """Part trials at their disturbances, for what follows a motion from sample to sample.

    Args:
        motions: measured trials; rate_hz: of their samples.

    Returns:
        The parts that are long enough, or the trials where nothing disturbs them, and the number
        of the trial that each is of.
    """
    rows: list[slice] = []
    of_trial: list[int] = []
    for number, motion in enumerate(motions):
        sound = np.ones(motion.t.size + 2, dtype=np.int8)
        sound[[0, -1]] = 0
        if motion.left_out is not None:
            sound[1:-1] = ~motion.left_out.any(axis=1)
        edges = np.flatnonzero(np.diff(sound))
        for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            if end - start >= _SHORTEST_S * rate_hz or end - start == motion.t.size:
                rows.append(slice(start, end))
                of_trial.append(number)
    if len(rows) == len(motions) and all(
        part.stop - part.start == size
        for part, size in zip(rows, trial_sizes(motions), strict=True)
    ):
        return motions, of_trial
    names = trial_names(motions)
    return (
        TrialCache(
            lambda k: motions[of_trial[k]].rows(rows[k]),
            len(rows),
            n_samples,
            names=[names[number] for number in of_trial],
        ),
        of_trial,
    )


def _cut(motions: Sequence[Motion], band: Band) -> _Blocks:
    """The thinned samples of some trials in blocks of `BLOCK_S`."""
    rows = max(1, round(BLOCK_S * band.rate_hz / band.step))
    block, trial, starts, ends = [], [], [], []
    count = 0
    for number, motion in enumerate(motions):
        kept = band.thinned_rows(len(motion.t))
        own = np.arange(kept.size) // rows
        block.append(count + own)
        total = int(own[-1]) + 1 if own.size else 0
        first = kept[::rows]
        trial.append(np.full(total, number))
        start = motion.t[first]
        end = motion.t[np.minimum(first + rows * band.step, len(motion.t) - 1)]
        if total:  # the margins of the low-pass belong to the blocks beside them
            start[0], end[-1] = motion.t[0], motion.t[-1]
        starts.append(start)
        ends.append(end)
        count += total
    return _Blocks(
        np.concatenate(block), np.concatenate(trial), np.concatenate(starts), np.concatenate(ends)
    )


def _robust_residual(stacked: Stacked, blocks: _Blocks) -> Array:
    """The residual (N, n_q) with parameters that a few wild blocks do not move.

    Blocks are weighted down as Cauchy's distribution has it, in units of the median block.
    """
    error = stacked.residual
    count = stacked.slope.shape[2]
    for _ in range(_ROUNDS):
        mean_square = blocks.mean_square(error, stacked.used)
        scale = np.nanmedian(mean_square, axis=0)
        scale = np.where(np.isfinite(scale) & (scale > 0.0), scale, np.inf)
        worst = np.nanmax(np.nan_to_num(mean_square / scale), axis=1)
        weight = np.sqrt(1.0 / (1.0 + worst[blocks.block]))[:, None] / np.sqrt(scale)
        slope = (stacked.slope * weight[:, :, None]).reshape(-1, count)
        normal = slope.T @ slope
        size = np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
        moment = slope.T @ (stacked.residual * weight).reshape(-1) / size
        step = np.linalg.lstsq(normal / np.outer(size, size), -moment, rcond=1e-10)[0] / size
        error = stacked.residual + stacked.slope @ step
    return error


def _candidates(mean_square: Array, blocks: _Blocks) -> list[tuple[int, int]]:
    """First and last block of every stretch whose error (B,) stands far above the rest's.

    The rest is what is left without such stretches and all that are larger.
    """
    size = np.nan_to_num(mean_square)
    known = np.isfinite(mean_square)
    calm = np.sort(mean_square[known])[: int(np.ceil((1.0 - _MOST) * known.sum()))]
    if not calm.size:
        return []
    loud = size > _EDGE**2 * calm.mean()
    apart = np.flatnonzero(np.diff(blocks.trial)) + 1
    edges = np.diff(np.concatenate([[0], loud.astype(np.int8), [0]]))
    bounds = np.sort(
        np.concatenate([np.flatnonzero(edges), np.repeat(apart[loud[apart - 1] & loud[apart]], 2)])
    )
    stretches = list(zip(bounds[::2].tolist(), bounds[1::2].tolist(), strict=True))
    total, count, inside = size.sum(), int(known.sum()), 0
    found = []
    for start, end in sorted(stretches, key=lambda one: -size[one[0] : one[1]].max()):
        total -= size[start:end].sum()
        count -= int(known[start:end].sum())
        inside += end - start
        if inside > _MOST * known.sum():
            break
        found.append((size[start:end].max() * max(count, 1), total, (start, end - 1)))
    far = [k for k, (peak, rest, _) in enumerate(found) if peak > _TIMES**2 * rest]
    return sorted(stretch for _, _, stretch in found[: far[-1] + 1]) if far else []


def _error_elsewhere(
    q: Array, qd: Array, error: Array, inside: Flags, others: Flags
) -> float | None:
    """The error (N,) that the motion of a stretch has at other times.

    None where the machine does not move like that again.
    """
    scale = np.maximum([np.std(q[others]), np.std(qd[others])], np.finfo(float).tiny)
    places = np.column_stack([q, qd]) / scale
    # A tenth of the scale at standstill: friction changes within little, and turns meet turns.
    places[:, 1] = np.arcsinh(_SLOWLY * places[:, 1]) / np.arcsinh(_SLOWLY)
    tree = cKDTree(places[others])
    distance, neighbour = tree.query(places[inside], k=_NEIGHBOURS, distance_upper_bound=_RADIUS)
    found = np.isfinite(distance)
    enough = found.sum(axis=1) >= _FEWEST
    if enough.mean() < 0.5:
        return None
    size = np.append(np.abs(error[others]), np.nan)[np.where(found, neighbour, -1)]
    return float(np.sqrt(np.mean(np.nanmedian(size[enough], axis=1) ** 2)))
