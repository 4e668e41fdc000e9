"""Stiffness of a locked axis from its hysteresis loops.

The model of the loop is an elastic transmission of stiffness K in parallel with friction that
follows the deflection x only after some slip (a Jenkins or Iwan element, or the smooth Bouc-Wen
model): torque = K x + F z, z in [-1, 1]. After every reversal z turns round, and the loop is
stiffer than K; once z has settled at its other limit (post-yield), the slope of the loop is K. So
K is read from that part of every branch. The shape of the transition is not assumed: an exponential
approach is fitted only to find where it has decayed.

The encoder is the coarse channel. It is used where it is exact, at the changes from one count to
the next, and deflection is regressed on torque. The noise of the torque is removed from the
regression (Fuller 1987, eq. 1.2.3), because it would make the axis appear too stiff.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.signal import butter, find_peaks, sosfiltfilt

from bampipe.arrays import Array
from bampipe.compiled import njit
from bampipe.estimate.white_noise import white_noise_sd

_TREMOR_HZ = 5.0
_PROMINENCE = 0.3
"""Smallest prominence of a reversal, relative to the range of the torque."""
_LEFTOVER = 0.01
"""Post-yield begins where the fitted transition changes the slope by less than this fraction."""
_LATEST_START = 0.6
"""Post-yield begins after this fraction of a branch at the latest: an exponential fits a long
transition with a sharp end poorly, and the slope needs a range."""
_LARGEST_SLOPE_CHANGE = 0.02
"""A loop is post-yield if the slopes of the two halves of the used part differ by less."""


_SYSTEMATIC = 0.25
"""Uncertainty of the stiffness as a fraction of the change of the slope: 95 to 100 % of the
intervals contain the truth for loops with seven kinds of transition
(benchmarks/notebook/estimates.md)."""


@dataclass(frozen=True)
class Branch:
    """One monotone part of the loading, from one reversal to the next.

    Attributes:
        start, stop: samples of the two reversals.
        direction: +1 torque rising, -1 torque falling.
        torque, deflection: at the changes of the encoder count, (n,).
        travel: smoothed torque since the reversal, positive, (n,).
    """

    start: int
    stop: int
    direction: int
    torque: Array
    deflection: Array
    travel: Array


@dataclass(frozen=True)
class Cycle:
    """One load cycle: a branch in each direction.

    Attributes:
        start, stop: its first and last sample.
        stiffness: N.m/rad or N/m.
        loop_width: height of the loop between its two straight sides, N.m or N.
        loop_width_deflection: its width in the other direction, rad or m.
        energy: lost in the cycle, J.
        amplitude: half the range of the torque, N.m or N.
        centre: deflection in the middle of the loop at zero torque, rad or m: a drift from cycle to
            cycle shows that the brake slips.
    """

    start: int
    stop: int
    stiffness: float
    loop_width: float
    loop_width_deflection: float
    energy: float
    amplitude: float
    centre: float


@dataclass(frozen=True)
class Hysteresis:
    """Stiffness and related results from the loops of one axis.

    Attributes:
        stiffness: of all post-yield parts together, N.m/rad or N/m.
        standard_error: of the stiffness, from the scatter over the cycles or the regression over
            all branches, whichever is larger.
        systematic: uncertainty of the stiffness due to the rest of the transition: a quarter of the
            change of the slope, or of the standard error of that change if larger.
        cycles: results by cycle.
        branches: all whole branches.
        transition: torque after a reversal from which the loop counts as post-yield, N.m or N.
        slope_change: change of the slope within the post-yield part: stiffness of its first half
            over that of its second, less one.
        yielded: whether ``slope_change`` is small (2 %, or three of its standard errors). If not,
            the load was too small to overcome the friction, and the stiffness is too high.
    """

    stiffness: float
    standard_error: float
    systematic: float
    cycles: tuple[Cycle, ...]
    branches: tuple[Branch, ...]
    transition: float
    slope_change: float
    yielded: bool


def smooth_torque(torque: Array, rate_hz: float) -> Array:
    """Return the torque (T,) without noise and tremor, by a zero-phase low-pass."""
    cutoff = min(_TREMOR_HZ, 0.2 * rate_hz)
    sections = butter(2, cutoff, fs=rate_hz, output="sos")
    padding = min(len(torque) - 1, int(2 * rate_hz / cutoff))
    return np.asarray(sosfiltfilt(sections, torque, padlen=padding))


def find_reversals(smooth: Array) -> NDArray[np.intp]:
    """Return the samples at which the loading reverses, in order.

    At a reversal, ``smooth`` (T,), from :func:`smooth_torque`, must stand out by 30 % of its range,
    so that pauses do not count.
    """
    least = _PROMINENCE * float(np.ptp(smooth))
    peaks = find_peaks(smooth, prominence=least)[0]
    valleys = find_peaks(-smooth, prominence=least)[0]
    turns = np.sort(np.concatenate((peaks, valleys)))
    # Two successive peaks can only be shoulders of one: the higher is the reversal.
    turning = []
    for top, run in groupby(turns, key=lambda turn: turn in peaks):
        same = np.array([*run])
        turning.append(same[np.argmax(smooth[same] if top else -smooth[same])])
    return np.array(turning, dtype=np.intp)


def split_branches(torque: Array, deflection: Array, rate_hz: float) -> tuple[Branch, ...]:
    """Return the whole branches of a loading record, each between two reversals.

    They contain the record at the changes of the encoder count. Half-way between two samples that
    differ, the deflection is half-way between their counts, exactly so for a step of one count. The
    distance of a point from the reversal comes from the smoothed torque, since a choice by the
    noisy torque would prefer noise of one sign.
    """
    smooth = smooth_torque(torque, rate_hz)
    turns = find_reversals(smooth)
    branches = []
    for start, stop in pairwise(turns):
        at = start + np.flatnonzero(np.diff(deflection[start : stop + 1]))
        direction = 1 if smooth[stop] > smooth[start] else -1
        branches.append(
            Branch(
                int(start),
                int(stop),
                direction,
                torque=0.5 * (torque[at] + torque[at + 1]),
                deflection=0.5 * (deflection[at] + deflection[at + 1]),
                travel=direction * (0.5 * (smooth[at] + smooth[at + 1]) - smooth[start]),
            )
        )
    return tuple(branches)


class _Line(NamedTuple):
    """A line through branches, with an intercept for each.

    Attributes:
        compliance, error: its slope and that slope's standard error.
        approach: amplitude of an exponential approach to the line, 0 without one.
        intercepts: (branches,); squares: sum of squares that line and approach leave.
    """

    compliance: float
    error: float
    approach: float
    intercepts: Array
    squares: float


def _fit_line(
    branches: Sequence[Branch],
    noise_sd: float,
    start: float = 0.0,
    stop: float = np.inf,
    decay: float | None = None,
) -> _Line:
    """Regress deflection on torque, with an intercept for each branch.

    Args:
        noise_sd: standard deviation of the torque at a count change.
        start, stop: first and last travel of the points used.
        decay: length, in torque, of an exponential approach to the straight line, which is fitted
            with one amplitude for all branches; None for no approach.
    """
    rows = [(branch.travel >= start) & (branch.travel <= stop) for branch in branches]
    torque, deflection, travel = (
        np.concatenate([getattr(b, name)[r] for b, r in zip(branches, rows, strict=True)])
        for name in ("torque", "deflection", "travel")
    )
    owner = np.repeat(np.arange(len(branches)), [np.count_nonzero(r) for r in rows])
    direction = np.array([branch.direction for branch in branches])[owner]
    approach = [] if decay is None else [-direction * np.exp(-travel / decay)]
    design = np.column_stack([torque, *approach, np.eye(len(branches))[owner]])
    moments = design.T @ design
    moments[0, 0] -= len(torque) * noise_sd**2
    inverse = np.linalg.pinv(moments, hermitian=True)
    coefficients = inverse @ (design.T @ deflection)
    residual = deflection - design @ coefficients
    squares = float(residual @ residual)
    spare = max(len(torque) - design.shape[1], 1)
    error = float(np.sqrt(max(inverse[0, 0], 0.0) * squares / spare))
    amplitude = float(coefficients[1]) if approach else 0.0
    return _Line(float(coefficients[0]), error, amplitude, coefficients[-len(branches) :], squares)


def find_transition(branches: Sequence[Branch], noise_sd: float) -> float:
    """Return the torque after a reversal from which the branches count as post-yield.

    There the slope of the fitted exponential approach has fallen to 1 % of the compliance, but it
    is at most 60 % of a branch.
    """
    span = float(np.median([branch.travel[-1] for branch in branches]))

    def fit(log_length: float) -> _Line:
        return _fit_line(branches, noise_sd, decay=float(np.exp(log_length)))

    grid = np.log(np.geomspace(0.005 * span, 0.5 * span, 15))
    best = int(np.argmin([fit(value).squares for value in grid]))
    found = minimize_scalar(
        lambda value: fit(value).squares, method="bounded", options={"xatol": 1e-3},
        bounds=(grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]),
    )  # fmt: skip
    length, line = float(np.exp(found.x)), fit(found.x)
    steepness = abs(line.approach) / length / abs(line.compliance)
    end = length * float(np.log(max(steepness / _LEFTOVER, 1.0)))
    return min(end, _LATEST_START * span)


def energy_lost(torque: Array, deflection: Array, stiffness: float) -> float:
    """Return the area, J, of one loop (T,), even if it does not quite close.

    The work of a spring of ``stiffness`` is subtracted first: it is zero around a closed loop, and
    stored energy rather than a loss otherwise.
    """
    x = deflection - 0.5 * (float(np.min(deflection)) + float(np.max(deflection)))
    level = 0.5 * (float(np.min(torque)) + float(np.max(torque)))
    return float(np.trapezoid(torque - level - stiffness * x, x))


def measure_hysteresis(torque: Array, deflection: Array, rate_hz: float) -> Hysteresis:
    """Return the stiffness of a locked axis from its load cycles.

    The generalised force on the axis, N.m or N, and the encoder reading, rad or m, are (T,).

    Raises:
        ValueError: fewer than two whole branches, or too few encoder counts to fit a line.
    """
    branches = split_branches(torque, deflection, rate_hz)
    if len(branches) < 2:
        raise ValueError("no whole load cycle: the load must turn round three times at least")
    if min(len(branch.torque) for branch in branches) < 8:
        raise ValueError("the deflection changes by fewer than 8 encoder counts on a branch")
    noise = white_noise_sd(torque) / np.sqrt(2.0)  # a count change averages two samples
    start = find_transition(branches, noise)
    line = _fit_line(branches, noise, start)
    if line.compliance <= 0.0:
        raise ValueError("the deflection does not follow the torque")
    middle = 0.5 * (start + float(np.median([branch.travel[-1] for branch in branches])))
    early = _fit_line(branches, noise, start, middle)
    late = _fit_line(branches, noise, middle)
    slope_change = late.compliance / early.compliance - 1.0
    slope_change_error = float(np.hypot(early.error, late.error)) / line.compliance
    cycles = tuple(
        _measure_cycle(torque, deflection, branches[k : k + 2], noise, start)
        for k in range(0, len(branches) - 1, 2)
    )
    stiffness = 1.0 / line.compliance
    standard_error = line.error * stiffness**2
    values = [cycle.stiffness for cycle in cycles]
    scatter = float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
    return Hysteresis(
        stiffness=stiffness,
        standard_error=max(standard_error, scatter / float(np.sqrt(len(values)))),
        systematic=_SYSTEMATIC * stiffness * max(abs(slope_change), slope_change_error),
        cycles=cycles, branches=branches, transition=start,
        slope_change=slope_change,
        yielded=abs(slope_change) < max(_LARGEST_SLOPE_CHANGE, 3.0 * slope_change_error),
    )  # fmt: skip


def _measure_cycle(
    torque: Array, deflection: Array, pair: Sequence[Branch], noise_sd: float, transition: float
) -> Cycle:
    """Return the results of one cycle."""
    line = _fit_line(pair, noise_sd, transition)
    rising, falling = line.intercepts[:: pair[0].direction]
    start, stop = pair[0].start, pair[1].stop
    load, moved = torque[start : stop + 1], deflection[start : stop + 1]
    return Cycle(
        start=start, stop=stop, stiffness=1.0 / line.compliance,
        loop_width=float(falling - rising) / line.compliance,
        loop_width_deflection=float(falling - rising),
        energy=energy_lost(load, moved, 1.0 / line.compliance),
        amplitude=0.5 * float(np.ptp(load)), centre=float(0.5 * (falling + rising)),
    )  # fmt: skip


@njit("float64[::1](float64[::1], float64)")
def drag_along(x: Array, play: float) -> Array:
    """Return positions (T,) of a point that stays within ``play`` of ``x`` (T,).

    This is the play operator of Krasnosel'skii and Pokrovskii 1989, Systems with Hysteresis.
    """
    out = np.empty(x.shape[0])
    at = x[0]
    for t in range(x.shape[0]):
        at = min(max(at, x[t] - play), x[t] + play)
        out[t] = at
    return out
