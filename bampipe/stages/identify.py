"""Stage identify: the parameters of a model, with uncertainties, from the free trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bampipe.data.store import write_json, write_parquet
from bampipe.discover.chance import Session
from bampipe.discover.start import search_start
from bampipe.errors import InputError
from bampipe.estimate.filter_uncertainty import sandwich_covariance
from bampipe.estimate.least_squares import LeastSquares, Problem, fit
from bampipe.estimate.low_pass import Band
from bampipe.estimate.unscented import constrain
from bampipe.physics import System, compile_model
from bampipe.stages.base import Progress, RunFolder
from bampipe.stages.filter_choice import FilterChoice, check_among, check_choice
from bampipe.stages.filter_run import (
    Attempt,
    filter_model,
    run_filter,
    stride_of,
    trial_of,
)
from bampipe.stages.filter_tables import (
    convergence,
    mean_nis,
    state_3sigma,
    states,
    trace,
    with_torques,
)
from bampipe.stages.modelfile import load_model, model_inputs
from bampipe.stages.motions import Motion, free_trials, problem_of, read_motion
from bampipe.stages.recordings import read_session, recipe_of
from bampipe.stages.sensor_noise import Noise, noise_report, sensor_noise, tuned, untuned

NAME = "identify"
SUMMARY = "Parameters of the model with uncertainties, from the free trials"

METHODS = ("ukf", "least-squares")
_RESTARTS = 5
"""Further searches, each with four times the process noise of the one before."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Config(FilterChoice):
    """What the stage can be told.

    Attributes:
        model: which model version.
        method: ``ukf``, the augmented unscented Kalman filter, or ``least-squares`` on the
            inverse dynamics.
        engine: ``compiled``, or ``filterpy``, slow, which gives the same numbers.
        form: ``square_root`` or ``covariance`` form of the filter.
        measure: ``position``, or ``position_velocity`` as in the paper; filtered velocities are
            not white, so intervals from them are too narrow.
        start_factor: multiplies every starting value: estimates must not depend on it.
        random_walk: of the parameters, in prior standard deviations per square root of a
            second; 0 takes them as constant, and only then are the intervals calibrated.
        reading_noise: standard deviation of a position reading in encoder steps; 0 takes it
            from the data.
        force_noise: of a force sample, N, model error included; 0 takes it from the data.
        longest_step_s: longest Runge-Kutta step, s.
        cutoff_hz: low-pass of the least-squares residual, Hz.
        block_s: length of the blocks that are taken as independent of each other, s.
        trace_rows: most rows a trial in trace.parquet and states.parquet.
    """

    model: str = "base"
    method: str = "ukf"
    start_factor: float = 1.0
    cutoff_hz: float = 8.0


def inputs(config: Config) -> tuple[str, ...]:
    """Return the paths the stage reads."""
    return (
        "ingest/trials.parquet",
        "ingest/samples.parquet",
        "ingest/session.json",
        "filter/kinematics.parquet",
        *model_inputs(config.model),
    )


def outputs(config: Config) -> tuple[str, ...]:
    """Return the paths the stage writes."""
    folder = f"models/{config.model}"
    return (f"{folder}/identify.json", f"{folder}/states.parquet", f"{folder}/trace.parquet")


@dataclass(frozen=True)
class _Estimate:
    """Parameters with what belongs to them, in physical units, those estimated in order."""

    value: Array
    covariance: Array
    filter_sd: Array | None
    systematic_sd: Array | None
    at_bound: NDArray[np.bool_]
    report: dict[str, object]
    states: pd.DataFrame
    trace: pd.DataFrame


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Estimate the parameters of one model from all free trials."""
    _check(config)
    session = run.read_json("ingest/session.json")
    system = compile_model(load_model(run, config.model))
    progress(0.0, "reading the trials")
    motions = [read_motion(run, trial, system) for trial in free_trials(run, fitted=True)]
    rate = float(session["sample_rate_hz"])
    # Filtered accelerations fall short at high frequency, which least squares takes for a delay
    # of the force: the filter alone can tell the two apart.
    problem = _without_timing(problem_of(system, motions, Band(rate, config.cutoff_hz)))
    progress(0.1, "least squares")
    start = _start(run, system, rate, config)
    start[problem.free] *= config.start_factor
    try:
        squares = fit(problem, np.append(start, 0.0), block_s=config.block_s)
    except ValueError as error:
        raise InputError(
            f"the free trials are too short to identify from ({error})", where=str(run.root)
        ) from error
    if config.method == "ukf":
        noise = sensor_noise(session, system, motions, config)
        estimate, squares = _unscented(
            run, system, motions, start, problem, squares, noise, config, progress
        )
    else:
        estimate = _from_squares(system, motions, problem, squares)
    content = _content(system, problem.free, estimate, squares, motions, config)
    write_json(out / f"models/{config.model}/identify.json", content)
    write_parquet(out / f"models/{config.model}/states.parquet", estimate.states)
    write_parquet(out / f"models/{config.model}/trace.parquet", estimate.trace)
    return content


def _start(run: RunFolder, system: System, rate: float, config: Config) -> Array:
    """Priors of the device; of effects, what a search over their range finds."""
    start = system.prior
    if system.model.effects:
        sensors, motions = read_session(run, system)
        recipe = recipe_of(run, config.model, system.model)
        session = Session(tuple(motions), sensors, Band(rate, config.cutoff_hz))
        found = search_start(session, recipe)
        count = len(system.model.device.parameters)
        start[count:] = found[count:]
    return start


def _check(config: Config) -> None:
    """Raise :class:`InputError` where a setting makes no sense."""
    check_among(config.method, METHODS, "identify.method")
    check_choice(config, "identify")
    for name in ("start_factor", "cutoff_hz"):
        if not getattr(config, name) > 0:
            raise InputError("must be positive", where=f"identify.{name}")


def _unscented(
    run: RunFolder,
    system: System,
    motions: Sequence[Motion],
    start: Array,
    problem: Problem,
    squares: LeastSquares,
    noise: Noise,
    config: Config,
    progress: Progress,
) -> tuple[_Estimate, LeastSquares]:
    """Tune the noise, converge on the first trial, then filter all trials.

    Returns the estimate, and least squares again with the timing that the filter found.
    """
    stride = stride_of(motions)
    trials = [trial_of(run, motion, system, noise, stride, config) for motion in motions]
    free = [item for item in system.parameters if not item.fixed]
    kept = len(free)
    # A delay in the model and the timing of the inputs are one and the same to the data.
    timing = not any(item.name in system.delays for item in free)
    model = filter_model(system, trials, start, timing)
    progress(0.15, "noise levels")
    if timing:
        late_sd = model.upper[-1:] / np.sqrt(3.0)
        late, no_walk = np.zeros(1), np.zeros(1)
    else:
        late_sd = late = no_walk = np.zeros(0)
    settled = np.append(squares.p[problem.free], late)
    known = np.append(np.sqrt(np.diag(squares.covariance)), late_sd)
    settings = untuned(system, noise, config)
    settings = replace(settings, walk_sd=np.append(settings.walk_sd, no_walk))
    settings = tuned(settings, model, trials, settled, known, noise, config)
    settings = replace(settings, stride=stride)
    prior_sd = np.append([item.sd for item in free], late_sd)
    first = np.append(start[problem.free], late)
    spread = np.hypot(prior_sd, first - np.append(system.prior[problem.free], late))
    # If the prior does not lead to the answer, the search starts from least squares, then with
    # more and more process noise, as a model that lacks much needs.
    attempts: list[Attempt] = [(first, spread, 1.0)]
    attempts += [(settled, prior_sd, 4.0**k) for k in range(_RESTARTS)]

    def told(done: int, place: int) -> None:
        progress(0.35 + 0.6 * done / (len(trials) + 1), motions[place].trial_id)

    def lost(what: str, place: int) -> InputError:
        remedy = "try --method least-squares, or set the trial aside if its sensors jumped there"
        told_what = what.format(motions[place].trial_id)
        return InputError(told_what, where=f"model {config.model}", remedy=remedy)

    found = run_filter(model, trials, attempts, settings, config, told, lost, system.coordinates)
    covariance, blocks = sandwich_covariance(
        found.main.trials,
        model.n_states,
        found.search.theta,
        found.search.covariance,
        config.block_s,
    )
    value, slope = model.to_physical(constrain(model, found.main.theta, covariance))
    scaled = covariance * np.outer(slope, slope)
    when = float(value[-1]) if timing else 0.0
    squares = fit(problem, np.append(squares.p[:-1], when), block_s=config.block_s)
    systematic = _systematic(value[:kept], scaled, squares, problem.free)
    scaled[:kept, :kept] += np.diag(systematic**2)
    tight = slope * np.sqrt(np.diag(found.main.covariance))
    near = (value - model.lower < tight) | (model.upper - value < tight)
    p = start.copy()
    p[problem.free] = value[:kept]
    names = [item.name for item in free]
    report: dict[str, object] = {
        "nis": mean_nis(found, motions),
        "noise": noise_report(system, found.settings, noise),
        "input_timing": {
            "estimate": when,
            "sd": float(np.sqrt(scaled[-1, -1])) if timing else 0.0,
            "unit": "s",
        },
        "blocks": blocks,
        "restarts": found.restarts,
        "state_3sigma": state_3sigma(system, found.main.trials),
        "convergence": convergence(names, model, found, covariance),
    }
    estimate = _Estimate(
        value=value[:kept],
        covariance=scaled[:kept, :kept],
        filter_sd=tight[:kept],
        systematic_sd=systematic,
        at_bound=near[:kept],
        report=report,
        states=states(system, motions, found, p, config.trace_rows),
        trace=trace(names, model, motions, found, config.trace_rows),
    )
    return estimate, squares


def _without_timing(problem: Problem) -> Problem:
    """Return the problem with the timing of the inputs held where the starting values put it."""
    return replace(
        problem,
        free=problem.free[:-1],
        lower=problem.lower[:-1],
        upper=problem.upper[:-1],
        step=problem.step[:-1],
    )


def _systematic(
    value: Array, covariance: Array, squares: LeastSquares, free: NDArray[np.int64]
) -> Array:
    """Return how far filter and least squares disagree beyond their standard deviations.

    Both see the same data and err alike by noise, but not by what the model lacks: where the
    model is right, their difference stays below the sum of their variances and adds nothing.
    """
    difference = value - squares.p[free]
    variance = np.diag(covariance)[: value.size] + np.diag(squares.covariance)
    return np.asarray(np.sqrt(np.maximum(difference**2 - variance, 0.0)))


def _from_squares(
    system: System, motions: Sequence[Motion], problem: Problem, squares: LeastSquares
) -> _Estimate:
    """Return the least-squares estimate; its trace is the fit to the trials so far."""
    names = [system.parameters[i].name for i in problem.free]
    rows, clock = [], 0.0
    for number, motion in enumerate(motions):
        clock += float(motion.t[-1])
        so_far = fit(problem, squares.p, trials=range(number + 1))
        row: dict[str, object] = {"t_total": clock, "trial_id": motion.trial_id}
        for place, name in enumerate(names):
            row[name] = so_far.p[problem.free[place]]
            row[f"{name}_sd"] = float(np.sqrt(so_far.covariance[place, place]))
        rows.append(row)
    frames = []
    for motion in motions:
        columns = {}
        for i, axis in enumerate(system.coordinates):
            columns[f"q_{axis}"], columns[f"qd_{axis}"] = motion.q[:, i], motion.qd[:, i]
            columns[f"qd_sd_{axis}"] = motion.qd_sd[:, i]
        frames.append(with_torques(system, motion, motion.t, columns, squares.p[:-1]))
    sd = 3.0 * np.median(np.concatenate([motion.qd_sd for motion in motions]), axis=0)
    report: dict[str, object] = {
        "input_timing": {
            "estimate": 0.0,
            "sd": 0.0,
            "unit": "s",
        },
        "residual_sd": dict(zip(system.coordinates, map(float, squares.residual_sd), strict=True)),
        "convergence": {"iterations": squares.iterations, "converged": squares.converged},
        "state_3sigma": {
            axis: {"velocity": float(sd[i])} for i, axis in enumerate(system.coordinates)
        },
    }
    return _Estimate(
        value=squares.p[problem.free],
        covariance=squares.covariance,
        filter_sd=None,
        systematic_sd=None,
        at_bound=squares.at_bound,
        report=report,
        states=pd.concat(frames, ignore_index=True),
        trace=pd.DataFrame(rows),
    )


def _content(
    system: System,
    free: NDArray[np.int64],
    estimate: _Estimate,
    squares: LeastSquares,
    motions: Sequence[Motion],
    config: Config,
) -> dict[str, object]:
    """Return what identify.json says."""
    names = [system.parameters[i].name for i in free]
    sd = np.sqrt(np.diag(estimate.covariance))
    parameters: dict[str, dict[str, object]] = {}
    for i, name in enumerate(names):
        entry: dict[str, object] = {
            "estimate": float(estimate.value[i]),
            "sd": float(sd[i]),
            "unit": system.parameters[free[i]].unit,
            "at_bound": bool(estimate.at_bound[i]),
        }
        if estimate.filter_sd is not None and estimate.systematic_sd is not None:
            entry["filter_sd"] = float(estimate.filter_sd[i])
            entry["systematic_sd"] = float(estimate.systematic_sd[i])
            entry["least_squares"] = float(squares.p[free[i]])
        parameters[name] = entry
    told = ", ".join(
        f"{name} {entry['estimate']:.4g} ± {entry['sd']:.2g} {entry['unit']}"
        for name, entry in parameters.items()
    )
    return {
        "model": config.model,
        "headline": told,
        "method": config.method,
        "engine": config.engine if config.method == "ukf" else "compiled",
        "parameters": parameters,
        "covariance": {"names": list(names), "matrix": estimate.covariance.tolist()},
        "trials": [motion.trial_id for motion in motions],
        **estimate.report,
    }
