"""Stretches of trials that no model of the machine explains: hits, dead sensors, warm-ups.

Model errors recur whenever the motion that causes them recurs. If a stretch has an error many times
larger than the rest, and the same motion elsewhere does not, an event caused it. Such a stretch
would bias estimates and noise floors, and could appear as a physical effect.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.spatial import cKDTree

from bampipe.arrays import Array, Flags, Indices, find_runs
from bampipe.estimate.least_squares import Stacked, as_measured
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.results.filter import Disturbance
from bampipe.trials.kept import MOST_OF_TRIALS, KeptItems
from bampipe.trials.motion import Motion, trial_sizes
from bampipe.trials.residuals import applied_rms, fit_device

_BLOCK_S = 0.2
"""Length of the blocks whose errors are compared, s."""
_TIMES = 20.0
"""Smallest ratio of a stretch's worst block error to the error of the rest. Study:
`benchmarks/disturbances.py`; its results: benchmarks/notebook/setup.md."""
_ALONE = 25.0
"""The same for a whole stretch whose motion does not recur; an end stop reached once has 15."""
_EDGE = 3.0
"""The same for the blocks at the ends of a stretch, where the tails of the event still weigh."""
_MOST = 0.1
"""Largest fraction of the samples that disturbances may cover: beyond it, there is no normal."""
_ORDINARY = 0.05
"""Largest fraction of a stretch's squared error that the same motion may cause at other times."""
_APART_S, _BEFORE_S = 1.0, 0.3
_NEIGHBOURS, _FEWEST, _RADIUS = 12, 4, 0.35
"""Neighbours in state space that each sample of a stretch is compared with: how many, how many are
needed, and within what distance, in standard deviations of each quantity. They lie at least
`_APART_S` away in time or in another trial."""
_SLOWLY = 50.0
"""How much finer velocity is resolved near standstill, where friction changes quickly, so that
reversals are compared with reversals."""
_UNKNOWN = 3
"""Largest number of adjacent blocks at rest that a stretch extends through."""
_SLOW, _FRICTION = 0.1, 2.0
"""Below this fraction of its root mean square velocity, an axis may reverse unnoticed; a wrong sign
of the velocity may cause an error of this multiple of the root mean square applied force."""
_ROUNDS = 8
"""Iterations of the robust reweighting."""
_SHORTEST_S = 1.0
"""Shortest part between two disturbances in which a filter can converge, s."""


@dataclass(frozen=True)
class _Blocks:
    """Thinned samples of all trials in blocks.

    Attributes:
        block: (N,) number of the block of each sample, in the order of time within each trial.
        trial: (B,) number of the trial of each block.
        starts, ends: (B,) s since the start of the trial.
    """

    block: Indices
    trial: Indices
    starts: Array
    ends: Array

    def mean_square(self, values: Array, used: Flags) -> Array:
        """Mean of squares (N, n_q) over the used samples of each block, (B, n_q); NaN at rest."""
        found = np.full((self.trial.size, values.shape[1]), np.nan)
        whole = np.bincount(self.block, minlength=self.trial.size)
        for i in range(values.shape[1]):
            count = np.bincount(self.block, used[:, i], self.trial.size)
            total = np.bincount(self.block, values[:, i] ** 2 * used[:, i], self.trial.size)
            np.divide(total, count, out=found[:, i], where=2 * count > whole)
        return found


@dataclass(frozen=True)
class _Samples:
    """Thinned samples of all trials, one after the other.

    Attributes:
        system: the device; blocks: of the samples.
        t: (N,) s since the start of the trial; motion: (N, n_q, 3) position, rate, acceleration.
        inputs: (N, k) inputs other than forces, such as a damper's current, and the change of each
            over `_BEFORE_S`.
        error: (N, n_q) of the device, N.m or N; excess: (N, n_q) the same, but near reversals only
            the part that friction of the wrong sign could not cause.
        used: (N, n_q) whether each sample counts.
    """

    system: System
    blocks: _Blocks
    t: Array
    motion: Array
    inputs: Array
    error: Array
    excess: Array
    used: Flags

    def judge_stretch(
        self, axis: int, first: int, last: int, undisturbed: Flags
    ) -> Disturbance | None:
        """Judge blocks ``first`` to ``last``; None if their error recurs with the motion.

        ``undisturbed`` (B,) marks the blocks outside all candidate stretches of the axis. The
        reason of the disturbance is the rest of a sentence that begins with "the error".
        """
        blocks, excess = self.blocks, self.excess[:, axis]
        start, end = float(blocks.starts[first]), float(blocks.ends[last])
        inside = (blocks.block >= first) & (blocks.block <= last) & self.used[:, axis]
        here = blocks.trial[blocks.block] == blocks.trial[first]
        near = here & (self.t > start - _APART_S) & (self.t < end + _APART_S)
        others = self.used[:, axis] & ~near
        outside = undisturbed[blocks.block] & self.used[:, axis]
        if not others.any() or not outside.any():
            return None
        state = np.hstack([self.motion[:, axis], self.inputs])
        again, share = _repeated_share(state, excess, inside, others)
        if share > _ORDINARY:
            return None
        if not again and _rms(excess[inside]) < _ALONE * _rms(excess[outside]):
            return None
        size, rest = (_rms(self.error[part, axis]) for part in (inside, outside))
        name, unit = self.system.coordinates[axis], self.system.torque_units[axis]
        when = "the same motion included" if again else "where it moves otherwise"
        words = f"of {name} is {size:.3g} {unit}, {rest:.3g} {unit} at all other times, {when}"
        return Disturbance(start_s=start, end_s=end, reason=words)


def find_disturbances(
    system: System, motions: Sequence[Motion], band: Band, fitted: Sequence[int]
) -> dict[str, tuple[Disturbance, ...]]:
    """Find stretches whose error does not recur with the motion, by trial, in order of time.

    The bare device is fitted to the trials numbered ``fitted``.
    """
    samples, stretches = _gather(system, motions, band, fitted), dict[str, list[Disturbance]]()
    if samples is None:
        return {}
    mean_square = samples.blocks.mean_square(samples.excess, samples.used)
    whole = samples.blocks.mean_square(samples.error, samples.used)
    for axis in range(len(system.coordinates)):
        candidates = _candidates(mean_square[:, axis], whole[:, axis], samples.blocks)
        undisturbed = np.ones(len(mean_square), dtype=bool)
        for first, last in candidates:
            undisturbed[first : last + 1] = False
        for first, last in candidates:
            found = samples.judge_stretch(axis, first, last, undisturbed)
            if found is not None:
                name = motions[int(samples.blocks.trial[first])].trial_id
                stretches.setdefault(name, []).append(found)
    return {name: _merge_touching(found) for name, found in stretches.items()}


def _gather(
    system: System, motions: Sequence[Motion], band: Band, fitted: Sequence[int]
) -> _Samples | None:
    """The errors of the bare device on all trials; None if it cannot be fitted."""
    found = fit_device(system, motions, band, fitted)
    if found is None:
        return None
    problem, p, by_trial = found
    measured = [*as_measured(problem, p, by_trial)]
    stacked = Stacked(
        np.concatenate([trial.residual for trial in measured]),
        np.concatenate([trial.slope for trial in measured]),
        np.concatenate([trial.used for trial in measured]),
    )
    # A single pass: only few of many trials are in memory.
    kept = [_thin(system, motion, band) for motion in motions]
    times, states, others, turns, ends = zip(*kept, strict=True)
    blocks = _lay_out_blocks(times, ends, band)
    t, state, inputs, turning = map(np.concatenate, (times, states, others, turns))
    error = _robust_residual(stacked, blocks)
    force = applied_rms(system, motions, band, p[:-1], [one.used for one in by_trial])
    beyond = np.sign(error) * np.maximum(np.abs(error) - _FRICTION * force, 0.0)
    excess = np.where(turning, beyond, error)
    return _Samples(system, blocks, t, state, inputs, error, excess, stacked.used)


def _turning(motion: Motion, band: Band) -> Flags:
    """Samples within half a period of the band's cut-off from a reversal or halt, (T, n_q)."""
    turns = np.abs(motion.qd) < _SLOW * np.sqrt(np.mean(motion.qd**2, axis=0))
    turns[1:] |= np.signbit(motion.qd[1:]) != np.signbit(motion.qd[:-1])
    near: Flags = np.empty_like(turns)
    for i, cutoff in enumerate(band.cutoff_hz):
        reach = int(np.ceil(0.5 * band.rate_hz / cutoff))
        near[:, i] = maximum_filter1d(turns[:, i], 2 * reach + 1)
    return near


def _thin(system: System, motion: Motion, band: Band) -> tuple[Array, Array, Array, Flags, float]:
    """Thin one trial as its residual is thinned.

    Returns:
        Time, motion and inputs as in `_Samples`; which samples are near a reversal or halt,
        (K, n_q); and the end of the trial, s.
    """
    rows = band.thinned_rows(len(motion.t))
    forces = system.model.device.forces
    u = motion.inputs([name for name in system.inputs if name != "t" and name not in forces])
    before = np.maximum(rows - round(_BEFORE_S * band.rate_hz), 0)
    state = np.stack([motion.q[rows], motion.qd[rows], motion.qdd[rows]], axis=2)
    inputs = np.hstack([u[rows], u[rows] - u[before]])
    return motion.t[rows], state, inputs, _turning(motion, band)[rows], float(motion.t[-1])


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _merge_touching(stretches: list[Disturbance]) -> tuple[Disturbance, ...]:
    """Sort the stretches of one trial by time and merge those that touch."""
    groups: list[list[Disturbance]] = []
    for one in sorted(stretches, key=lambda one: one.start_s):
        if groups and one.start_s <= max(other.end_s for other in groups[-1]):
            groups[-1].append(one)
        else:
            groups.append([one])
    return tuple(
        Disturbance(
            start_s=round(group[0].start_s, 3),
            end_s=round(max(one.end_s for one in group), 3),
            reason=f"the error {'; '.join(one.reason for one in group)}: a hit, a fault of a sensor"
            " or a start",
        )
        for group in groups
    )


def part_trials(motions: Sequence[Motion], rate_hz: float) -> Sequence[Motion]:
    """Split trials at their disturbances, for filters that follow a motion from sample to sample.

    Returns:
        The parts that are long enough, or the trials themselves if nothing disturbs them.
    """
    rows: list[tuple[int, slice]] = []
    for number, motion in enumerate(motions):
        sound = np.ones(motion.t.size, dtype=bool)
        if motion.left_out is not None:
            sound = np.logical_not(motion.left_out.any(axis=1))
        for start, end in zip(*find_runs(sound), strict=True):
            if end - start >= _SHORTEST_S * rate_hz or end - start == motion.t.size:
                rows.append((number, slice(start, end)))
    if [part.stop - part.start for _, part in rows] == trial_sizes(motions):
        return motions
    return KeptItems((motions[k].rows(part) for k, part in rows), MOST_OF_TRIALS)


def _lay_out_blocks(times: Sequence[Array], ends_s: Sequence[float], band: Band) -> _Blocks:
    """Divide the thinned samples, at ``times`` (K,) by trial, s, into blocks of `_BLOCK_S`.

    The first and last block of a trial include the margins of the low-pass.
    """
    rows = max(1, round(_BLOCK_S * band.rate_hz / band.step))
    block, trial, starts, ends = [], [], [], []
    count = 0
    for number, (t, end_s) in enumerate(zip(times, ends_s, strict=True)):
        start = t[::rows].copy()
        block.append(count + np.arange(t.size) // rows)
        trial.append(np.full(start.size, number))
        if start.size:
            ends.append(np.append(start[1:], end_s))
            start[0] = 0.0
        starts.append(start)
        count += start.size
    return _Blocks(*(np.concatenate(parts) for parts in (block, trial, starts, ends)))


def _robust_residual(stacked: Stacked, blocks: _Blocks) -> Array:
    """The residual (N, n_q) of a robust fit, which a few outlying blocks do not move.

    Blocks have Cauchy weights, in units of the median block.
    """
    error = stacked.residual
    count = stacked.slope.shape[2]
    for _ in range(_ROUNDS):
        mean_square = blocks.mean_square(error, stacked.used)
        unused = np.isnan(mean_square).all(axis=0)
        scale = np.nanmedian(np.where(unused, np.inf, mean_square), axis=0)
        scale = np.where(scale > 0.0, scale, np.inf)
        worst = np.nanmax(np.nan_to_num(mean_square / scale), axis=1)
        weight = np.sqrt(1.0 / (1.0 + worst[blocks.block]))[:, None] / np.sqrt(scale)
        slope = (stacked.slope * weight[:, :, None]).reshape(-1, count)
        normal = slope.T @ slope
        size = np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
        moment = slope.T @ (stacked.residual * weight).reshape(-1) / size
        step = np.linalg.lstsq(normal / np.outer(size, size), -moment, rcond=1e-10)[0] / size
        error = stacked.residual + stacked.slope @ step
    return error


def _candidates(mean_square: Array, whole: Array, blocks: _Blocks) -> list[tuple[int, int]]:
    """First and last block of every stretch whose error (B,) is far above that of the rest.

    The rest excludes the stretch itself and all larger ones. A stretch extends through reversals
    while ``whole``, the error that includes reversals, stays high.
    """
    size = np.nan_to_num(mean_square)
    known = np.isfinite(mean_square)
    if not known.any():
        return []
    loud = _loud(mean_square) | _loud(whole)
    # Blocks mostly at rest have no known error: beside a stretch, they count as part of it.
    for _ in range(_UNKNOWN):
        beside = np.zeros_like(loud)
        beside[1:] |= loud[:-1] & (blocks.trial[1:] == blocks.trial[:-1])
        beside[:-1] |= loud[1:] & (blocks.trial[1:] == blocks.trial[:-1])
        loud |= beside & ~known
    apart = np.flatnonzero(np.diff(blocks.trial)) + 1
    stretches = [
        (offset + start, offset + end)
        for offset, part in zip([0, *apart.tolist()], np.split(loud, apart), strict=True)
        for start, end in zip(*find_runs(part), strict=True)
    ]
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


def _loud(mean_square: Array) -> Flags:
    """Blocks (B,) well above the mean of the lowest 1 - `_MOST` of them."""
    known = np.sort(mean_square[np.isfinite(mean_square)])
    lowest = known[: int(np.ceil((1.0 - _MOST) * known.size))].mean()
    return np.asarray(np.nan_to_num(mean_square) > _EDGE**2 * lowest)


def _repeated_share(state: Array, error: Array, inside: Flags, others: Flags) -> tuple[bool, float]:
    """Whether the motion of a stretch recurs, and the fraction of its squared error that recurs.

    Args:
        state: (N, k) position, rate and other quantities on which the error may depend.
        error: (N,); inside: the samples of the stretch; others: those to compare them with.
    """
    places = state / np.maximum(state[others].std(axis=0), np.finfo(float).tiny)
    places[:, 1] = np.arcsinh(_SLOWLY * places[:, 1]) / np.arcsinh(_SLOWLY)
    tree = cKDTree(places[others])
    distance, neighbour = tree.query(places[inside], k=_NEIGHBOURS, distance_upper_bound=_RADIUS)
    found = np.isfinite(distance)
    enough = found.sum(axis=1) >= _FEWEST
    if enough.mean() < 0.5:
        return False, 0.0
    size = np.append(np.abs(error[others]), np.nan)[np.where(found, neighbour, -1)]
    usual, here = np.nanmedian(size[enough], axis=1), np.abs(error[inside][enough])
    return True, float(np.sum(np.minimum(usual, here) ** 2) / max(np.sum(here**2), 1e-300))
