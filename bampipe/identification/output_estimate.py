"""Output error on the raw positions of the free trials: see `estimate.output_error`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bampipe.errors import InputError
from bampipe.estimate.bounded import solve_bounded
from bampipe.estimate.output_error import OutputError, Segment, fit_output
from bampipe.estimate.simulation import simulate
from bampipe.estimate.unscented import Trial
from bampipe.identification.estimates import Estimate, estimate_of_fit, trace_row
from bampipe.physics import System
from bampipe.progress import Progress
from bampipe.trials.bias import UnbiasedFit
from bampipe.trials.folds import Folds
from bampipe.trials.motion import Motion

Array = NDArray[np.float64]

SEGMENT_S = 0.5
"""Length of a segment, s: noise of a force moves the motion by less than friction does."""
_LONGEST_STEP = 1e-3
"""Of the integration, s; friction near standstill shortens it further."""
_POSITION_STEP, _RATE_STEP, _PARAMETER_STEP, _TIMING_STEP = 1e-5, 1e-4, 1e-4, 1e-5
"""Differences for slopes: rad or m, per s, in prior standard deviations, s."""


def cut_segments(system: System, motion: Motion, trial: Trial, p: Array) -> list[Segment]:
    """Cut a trial into segments; those disturbed or with a missing reading are left out.

    Args:
        system: the model; motion: the filtered trial, for initial velocities; trial: its raw
            samples, which are put on a uniform grid.
        p: (n_p,) parameters for the internal states that segments start from. The fit's own
            have the timing of the inputs behind them, by which these are moved.
    """
    n, nx = len(system.coordinates), len(system.states)
    dt = float(np.median(np.diff(trial.t)))
    t = trial.t[0] + dt * np.arange(int((trial.t[-1] - trial.t[0]) / dt + 1e-6) + 1)
    # On stamps that are even already, interpolation changes nothing.
    y, u = (np.stack([np.interp(t, trial.t, c) for c in x.T], axis=1) for x in (trial.y, trial.u))
    rate = np.gradient(u, dt, axis=0)
    width = np.array([c.sign_width for c in system.model.device.coordinates])
    disturbed = np.zeros(t.size, dtype=bool)
    if motion.left_out is not None:
        disturbed = np.interp(t, motion.t, motion.left_out.any(axis=1)) > 0.0
    given = motion.inputs(system.inputs)
    true = motion.of_mechanism(system, given, p)
    memory = system.memory(*true.kinematics, given, p, true.t)
    state = np.hstack([true.q - motion.q, true.qd, memory])
    count = max(4 * nx, round(SEGMENT_S / dt))
    found = []
    for first in range(0, t.size - count + 1, count):
        part = slice(first, first + count)
        if not np.isfinite(y[part]).all() or disturbed[part].any():
            continue
        x0 = np.array([np.interp(t[first], motion.t, column) for column in state.T])
        x0[:n] += y[first, :n]

        def run(x: Array, parameters: Array, part: slice = part) -> Array:
            moved = u[part] - parameters[-1] * rate[part]
            try:
                states = simulate(
                    system.derivative, x, moved, parameters[:-1], dt,
                    width=width, n_noise=len(system.noise), smooth=system.forced,
                    max_step=_LONGEST_STEP,
                )  # fmt: skip
            except InputError:  # a step too far: the fit halves it
                return np.full((count, n), np.inf)
            return system.encoder_readings(states, moved, parameters[:-1])[:, :n]

        step = np.full(nx, _RATE_STEP)
        step[:n] = _POSITION_STEP
        step[2 * n :] *= 1.0 + np.abs(x0[2 * n :])
        found.append(Segment(run, y[part, :n], x0, step))
    return found


def estimate_by_output_error(
    system: System,
    motions: Sequence[Motion],
    trials: Sequence[Trial],
    squares: UnbiasedFit,
    folds: Folds,
    progress: Progress,
    most_samples: int | None = None,
) -> Estimate:
    """Return the output-error estimate, from least squares on; its trace is the fit so far.

    Args:
        system: the model; motions, trials: filtered and raw; squares: where to start.
        folds: which trials are left out together.
        progress: called with the share done.
        most_samples: fit segments of so many samples, spread evenly; all by default.

    Raises:
        InputError: too few segments, or the simulated motion grows without bound.
    """
    problem = squares.problem

    def cut(model: System) -> list[list[Segment]]:
        by_trial = [
            cut_segments(model, motion, trial, squares.p[:-1])
            for motion, trial in zip(motions, trials, strict=True)
        ]
        return by_trial if most_samples is None else _spread(by_trial, most_samples)

    segments = cut(system)
    sd = np.array([*(item.sd for item in system.parameters), 0.0])
    step = np.where(problem.free < len(sd) - 1, _PARAMETER_STEP * sd[problem.free], _TIMING_STEP)

    def fit(number: int, start: Array, most: int) -> OutputError:
        chosen = _joined(segments[:number])
        return fit_output(chosen, start, problem.free, problem.lower, problem.upper, step, most)

    progress(0.4, "output error")
    found = fit(len(segments), squares.p, 15)

    def rows() -> list[dict[str, object]]:
        trace: list[dict[str, object]] = []
        clock = 0.0
        for number, motion in enumerate(motions, start=1):
            clock += float(motion.t[-1])
            if sum(len(trial) for trial in segments[:number]) <= problem.free.size:
                continue
            so_far = found if number == len(motions) else fit(number, found.p, 2)
            row = trace_row(system, problem, so_far)
            trace.append({"t_total": clock, "trial_id": motion.trial_id, **row})
        return trace

    group = np.repeat(folds.groups, [len(trial) for trial in segments])
    held_out = {}
    for left_out in sorted(set(folds.groups)):
        others = group != left_out
        p = found.p.copy()
        if not folds.nothing_held_out and others.any():
            value = found.p[problem.free]
            p[problem.free] += solve_bounded(
                found.normal[others].sum(axis=0),
                found.moment[others].sum(axis=0),
                problem.lower - value,
                problem.upper - value,
            ).x
        held_out[left_out] = p
    estimate = estimate_of_fit(
        "output-error", system, motions, problem, found, found.p,
        [held_out[k] for k in folds.groups], [{} for _ in problem.free], rows,
        position_error=dict(zip(system.coordinates, found.rms, strict=True)),
    )  # fmt: skip
    count = len(estimate.value)
    return replace(estimate, moved_by=lambda other: found.moved_by(_joined(cut(other)))[:count])


def _joined(segments: Sequence[Sequence[Segment]]) -> list[Segment]:
    return [segment for trial in segments for segment in trial]


def _spread(segments: Sequence[Sequence[Segment]], most_samples: int) -> list[list[Segment]]:
    """Return segments of at most so many samples in all, spread evenly, by trial."""
    numbered = [(k, segment) for k, trial in enumerate(segments) for segment in trial]
    samples = sum(len(segment.q) for _, segment in numbered)
    step = max(1, -(-samples // most_samples))
    chosen: list[list[Segment]] = [[] for _ in segments]
    for k, segment in numbered[::step]:
        chosen[k].append(segment)
    return chosen
