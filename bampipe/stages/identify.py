"""Stage identify: the parameters of a model, with uncertainties, from the free trials."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bampipe.data.store import read_parquet, write_json, write_parquet
from bampipe.discover.chance import Session
from bampipe.discover.start import search_start
from bampipe.errors import InputError
from bampipe.estimate.filter_uncertainty import climb, sandwich_covariance
from bampipe.estimate.least_squares import LeastSquares, Problem, fit
from bampipe.estimate.low_pass import Band
from bampipe.estimate.unscented import (
    FilteredTrial,
    FilterFailure,
    FilterModel,
    FilterResult,
    FilterSettings,
    Trial,
    constrain,
    filter_trials,
)
from bampipe.physics import System, compile_model
from bampipe.stages.base import Progress, RunFolder
from bampipe.stages.modelfile import load_model, model_inputs
from bampipe.stages.motions import Motion, free_trials, input_columns, problem_of, read_motion
from bampipe.stages.recordings import read_session, recipe_of

NAME = "identify"
SUMMARY = "Parameters of the model with uncertainties, from the free trials"

METHODS = ("ukf", "least-squares")
ENGINES = ("compiled", "filterpy")
FORMS = ("square_root", "covariance")
MEASURES = ("position", "position_velocity")
_TUNING_SAMPLES = 3000
"""Samples of one trial on which the noise levels are tuned."""
_TUNING_STEP_S = 2e-3
"""Longest Runge-Kutta step while tuning, s: noise levels need no more."""
_STORED = 20_000
"""Most distributions stored of one trial: memory must not grow with the log."""
_COARSE = 300.0
"""Factor on the process noise of the search for the region of the answer."""
_RESTARTS = 5
"""Further searches, each with four times the process noise of the one before."""
_LARGEST_NIS = 10.0
"""Mean normalised innovation squared from which on the filter is taken to have lost the motion."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Config:
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
    engine: str = "compiled"
    form: str = "square_root"
    measure: str = "position"
    start_factor: float = 1.0
    random_walk: float = 0.0
    reading_noise: float = 0.0
    force_noise: float = 0.0
    longest_step_s: float = 1e-3
    cutoff_hz: float = 8.0
    block_s: float = 2.0
    trace_rows: int = 2000


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
    """Parameters with what belongs to them, in physical units, ``names`` in order."""

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
    motions = [read_motion(run, trial, system) for trial in free_trials(run)]
    rate = float(session["sample_rate_hz"])
    # Filtered accelerations fall short at high frequency, which least squares takes for a delay
    # of the force: the filter alone can tell the two apart.
    problem = _without_timing(problem_of(system, motions, Band(rate, config.cutoff_hz)))
    progress(0.1, "least squares")
    start = _start(run, system, rate, config)
    variable = [i for i, item in enumerate(system.parameters) if not item.fixed]
    start[variable] *= config.start_factor
    try:
        squares = fit(problem, np.append(start, 0.0), block_s=config.block_s)
    except ValueError as error:
        raise InputError(
            f"the free trials are too short to identify from ({error})", where=str(run.root)
        ) from error
    if config.method == "ukf":
        noise = _Noise.from_session(session, run, system, motions, config)
        stride = _stride(motions)
        trials = [_trial(run, motion, system, noise, stride, config) for motion in motions]
        estimate, squares = _unscented(
            system, motions, trials, start, problem, squares, noise, config, progress
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
    for name, known in (
        ("method", METHODS),
        ("engine", ENGINES),
        ("form", FORMS),
        ("measure", MEASURES),
    ):
        value = getattr(config, name)
        if value not in known:
            raise InputError(
                f"no {name} {value!r}",
                where=f"identify.{name}",
                remedy=f"choose from {', '.join(known)}",
            )
    for name in ("start_factor", "longest_step_s", "cutoff_hz", "block_s", "trace_rows"):
        if not getattr(config, name) > 0:
            raise InputError("must be positive", where=f"identify.{name}")
    for name in ("random_walk", "reading_noise", "force_noise"):
        if getattr(config, name) < 0:
            raise InputError("must not be negative", where=f"identify.{name}")


@dataclass(frozen=True)
class _Noise:
    """Noise of the sensors before any tuning.

    Attributes:
        reading_sd: (ny,) of position, and velocity where measured.
        process_sd: (nw,) of the model's process noise, one sample.
        is_force: (nw,) which of these are a measured force.
    """

    reading_sd: Array
    process_sd: Array
    is_force: NDArray[np.bool_]

    @staticmethod
    def from_session(
        session: Mapping[str, Any],
        run: RunFolder,
        system: System,
        motions: Sequence[Motion],
        config: Config,
    ) -> _Noise:
        """Encoder steps spread evenly, sd = step / sqrt(12); force noise as the session says.

        Where the session does not say, the second difference of the force gives it: the force
        of a hand is smooth over two milliseconds. Process noise that is no force starts as the
        torque of the same noise at an arm of 1 m.
        """
        reading = []
        for place, axis in enumerate(system.coordinates):
            step = session["axes"][axis].get("resolution") or 0.0
            if config.reading_noise > 0.0 and step > 0.0:
                reading.append(config.reading_noise * step)
            elif step > 0.0:
                reading.append(step / np.sqrt(12.0))
            else:
                reading.append(_white_part([motion.q[:, place] for motion in motions]))
        if config.measure == "position_velocity":
            velocity = np.concatenate([motion.qd_sd for motion in motions])
            reading.extend(np.median(velocity, axis=0))
        given = session.get("force", {}).get("noise_sd")
        is_force = np.array([name in system.inputs for name in system.noise])
        process = np.zeros(len(system.noise))
        forces = [name for name, force in zip(system.noise, is_force, strict=True) if force]
        for place, name in enumerate(system.noise):
            if config.force_noise > 0.0:
                process[place] = config.force_noise
            elif name in forces and isinstance(given, int | float) and given > 0.0:
                process[place] = float(given)
            elif name in forces:
                column = system.inputs.index(name)
                process[place] = _white_part([motion.u[:, column] for motion in motions])
        smallest = process[is_force].min() if is_force.any() else 0.05
        process[process == 0.0] = smallest or np.finfo(float).eps
        return _Noise(np.array(reading), process, is_force)


def _white_part(records: Sequence[Array]) -> float:
    """Standard deviation of the white part of a smooth signal, from its second differences."""
    second = np.concatenate([np.diff(record, 2) for record in records])
    return float(np.median(np.abs(second)) / (0.6745 * np.sqrt(6.0)))


def _trial(
    run: RunFolder, motion: Motion, system: System, noise: _Noise, stride: int, config: Config
) -> Trial:
    """Return the raw samples of one trial as the filter wants them."""
    path = run.require("ingest/samples.parquet", "ingest")
    frame = read_parquet(path, trial=motion.trial_id)
    n = len(system.coordinates)
    stamps = frame["t"].to_numpy(dtype=float)
    t = stamps - stamps[0]
    brakes = system.model.device.brakes.values()
    for place, name in enumerate(system.inputs):
        if name not in frame and name != "t" and name not in brakes:
            frame[name] = np.interp(t, motion.t, motion.u[:, place])
    u = input_columns(frame, system.inputs, system.model.device.brakes, t, str(path))
    for column in u.T:
        lost = np.isnan(column)
        if lost.any():
            column[lost] = np.interp(t[lost], t[~lost], column[~lost])
    # A copy: a table's only column would come out read-only, which compiled code refuses.
    y = frame[[f"q_{axis}" for axis in system.coordinates]].to_numpy(dtype=float, copy=True)
    if config.measure == "position_velocity":
        velocity = [np.interp(t, motion.t, column) for column in motion.qd.T]
        y = np.hstack([y, np.stack(velocity, axis=1)])
    first = int(np.flatnonzero(np.isfinite(y).all(axis=1))[0])
    memory = system.initial_memory(motion.q[0], motion.u[0], system.prior)
    x = np.concatenate([y[first, :n], motion.qd[0], memory])
    speed = np.maximum(motion.qd_sd[0], np.sqrt(np.mean(motion.qd**2, axis=0)) * 0.1)
    x_sd = np.concatenate([2.0 * noise.reading_sd[:n], speed, np.zeros(len(memory))])
    # The last stored distribution must be that of the last sample.
    last = first + (t.size - 1 - first) // stride * stride + 1
    return Trial(t[first:last], u[first:last], y[first:last], x, x_sd)


def _unscented(
    system: System,
    motions: Sequence[Motion],
    trials: Sequence[Trial],
    start: Array,
    problem: Problem,
    squares: LeastSquares,
    noise: _Noise,
    config: Config,
    progress: Progress,
) -> tuple[_Estimate, LeastSquares]:
    """Tune the noise, converge on the first trial, then filter all trials.

    Returns the estimate, and least squares again with the timing that the filter found.
    """
    model = _filter_model(system, trials, start)
    run_filter = _engine(config)
    progress(0.15, "noise levels")
    settings = _tuned(system, model, trials, squares, noise, config)
    settings = replace(settings, stride=_stride(motions))
    prior_sd = np.array([*(item.sd for item in _free(system)), model.upper[-1] / np.sqrt(3.0)])
    first = np.append(start[model.free[:-1]], 0.0)
    spread = np.hypot(prior_sd, first - np.append(system.prior[model.free[:-1]], 0.0))
    order = [*range(1, len(trials)), 0]

    def told(done: int) -> None:
        place = order[done - 1] if done else 0
        progress(0.35 + 0.6 * done / (len(trials) + 1), motions[place].trial_id)

    def attempt(value: Array, sd: Array, noise_factor: float) -> tuple[FilterResult, ...]:
        mean, sd = model.to_estimated(value, sd)
        level = replace(settings, noise_sd=noise_factor * settings.noise_sd)
        told(0)
        search = run_filter(
            model, trials[:1], mean, np.diag(sd**2),
            replace(level, noise_sd=_COARSE * level.noise_sd),
        )  # fmt: skip
        main = run_filter(
            model, [trials[i] for i in order], search.theta, search.covariance, level,
            lambda done: told(done),
        )  # fmt: skip
        return search, main

    # A filter that trusts its model far from the truth does not find back. The first trial is
    # filtered with much process noise, which adds next to no information, and filtered again at
    # the end in its own right. If that fails, the search starts from least squares instead, then
    # with more and more process noise, as a model that lacks much needs.
    failure: FilterFailure | None = None
    found: tuple[FilterResult, ...] | None = None
    level = settings
    tries = [(first, spread, 1.0)]
    settled = squares.p[model.free]
    tries += [(settled, prior_sd, 4.0**k) for k in range(_RESTARTS)]
    restarts = -1
    for value, sd, factor in tries:
        restarts += 1
        try:
            candidate = attempt(value, sd, factor)
        except FilterFailure as error:
            failure = error
            continue
        found, level = candidate, replace(settings, noise_sd=factor * settings.noise_sd)
        if _mean_nis(candidate[1], settings) < _LARGEST_NIS:
            break
    if found is None or _mean_nis(found[1], settings) >= _LARGEST_NIS:
        raise _lost(found, failure, system, motions, trials, order, config)
    search, main = found
    settings = level
    covariance, blocks = sandwich_covariance(
        main.trials, model.n_states, search.theta, search.covariance, config.block_s
    )
    value, slope = model.to_physical(constrain(model, main.theta, covariance))
    scaled = covariance * np.outer(slope, slope)
    squares = fit(problem, np.append(squares.p[:-1], value[-1]), block_s=config.block_s)
    systematic = _systematic(value, scaled, squares, problem.free)
    scaled += np.diag(systematic**2)
    tight = slope * np.sqrt(np.diag(main.covariance))
    near = (value - model.lower < tight) | (model.upper - value < tight)
    kept = value.size - 1
    report: dict[str, object] = {
        "nis": _nis(main, settings, motions, order),
        "noise": _noise_report(system, settings, noise),
        "input_timing": {
            "estimate": float(value[-1]),
            "sd": float(np.sqrt(scaled[-1, -1])),
            "unit": "s",
        },
        "blocks": blocks,
        "restarts": restarts,
        "state_3sigma": _state_3sigma(system, main.trials),
        "convergence": _convergence(system, model, search, main, covariance),
    }
    steps = [motions[0], *(motions[i] for i in order)]
    passes = [*search.trials, *main.trials]
    estimate = _Estimate(
        value=value[:kept],
        covariance=scaled[:kept, :kept],
        filter_sd=tight[:kept],
        systematic_sd=systematic[:kept],
        at_bound=near[:kept],
        report=report,
        states=_states(system, motions, order, main, value, config),
        trace=_trace(model, system, steps, passes, config),
    )
    return estimate, squares


def _stride(motions: Sequence[Motion]) -> int:
    """Return every how many samples the filter stores its distribution."""
    return -(-max(motion.t.size for motion in motions) // _STORED)


def _without_timing(problem: Problem) -> Problem:
    """Return the problem with the timing of the inputs held where the starting values put it."""
    return replace(
        problem,
        free=problem.free[:-1],
        lower=problem.lower[:-1],
        upper=problem.upper[:-1],
        step=problem.step[:-1],
    )


def _free(system: System) -> list[Any]:
    return [item for item in system.parameters if not item.fixed]


def _filter_model(system: System, trials: Sequence[Trial], start: Array) -> FilterModel:
    """Return the model with the timing of the inputs as its last parameter."""
    free = [i for i, item in enumerate(system.parameters) if not item.fixed]
    half = 0.5 * float(np.median(np.diff(trials[0].t)))
    return FilterModel(
        derivative=system.derivative,
        measure=system.measure,
        n_states=len(system.states),
        parameters=np.append(start, 0.0),
        free=np.array([*free, len(system.parameters)], dtype=np.int64),
        lower=np.array([*(system.parameters[i].lower for i in free), -half]),
        upper=np.array([*(system.parameters[i].upper for i in free), half]),
    )


def _engine(config: Config) -> Callable[..., FilterResult]:
    if config.engine == "filterpy":
        from bampipe.estimate.filterpy_oracle import filter_trials_by_filterpy

        return filter_trials_by_filterpy
    return filter_trials


def _tuned(
    system: System,
    model: FilterModel,
    trials: Sequence[Trial],
    squares: LeastSquares,
    noise: _Noise,
    config: Config,
) -> FilterSettings:
    """Set the noise levels at the maximum of the filter's likelihood on part of one trial.

    The noise of a measured force is at least that of its sensor: what is more is model error.
    """
    n = len(system.coordinates)
    velocity = config.measure == "position_velocity"
    prior_sd = np.array([*(item.sd for item in _free(system)), 0.0])
    settings = FilterSettings(
        observed=np.arange(2 * n if velocity else n),
        reading_sd=noise.reading_sd,
        noise_sd=noise.process_sd,
        walk_sd=config.random_walk * prior_sd,
        longest_step=_TUNING_STEP_S,
        square_root=config.form == "square_root",
    )
    longest = max(range(len(trials)), key=lambda i: trials[i].t.size)
    whole = trials[longest]
    part = replace(
        whole, t=whole.t[:_TUNING_SAMPLES], u=whole.u[:_TUNING_SAMPLES], y=whole.y[:_TUNING_SAMPLES]
    )
    value = squares.p[model.free]
    sd = np.append(np.sqrt(np.diag(squares.covariance)), model.upper[-1] / np.sqrt(3.0))
    spread = np.maximum(sd, 1e-6 * np.abs(value))
    mean, sd = model.to_estimated(value, np.maximum(spread, np.finfo(float).tiny))

    def with_levels(levels: Array) -> FilterSettings:
        factor = np.exp(levels)
        return replace(
            settings,
            reading_sd=settings.reading_sd * factor[0],
            noise_sd=settings.noise_sd * factor[1:],
        )

    def log_likelihood(levels: Array) -> float:
        try:
            found = filter_trials(model, [part], mean, np.diag(sd**2), with_levels(levels))
        except FilterFailure:
            return -np.inf
        return float(np.nansum(found.trials[0].log_likelihood))

    count = noise.process_sd.size
    step = np.log(np.array([2.0**0.125, *np.full(count, 2.0)]))
    lower = np.array([-np.inf, *np.where(noise.is_force, 0.0, np.log(1e-3))])
    if config.reading_noise > 0.0:
        step[0] = 0.0
    if config.force_noise > 0.0:
        step[1:][noise.is_force] = 0.0
    best, _ = climb(log_likelihood, np.zeros(count + 1), step, lower)
    return replace(with_levels(best), longest_step=config.longest_step_s)


def _systematic(
    value: Array, covariance: Array, squares: LeastSquares, free: NDArray[np.int64]
) -> Array:
    """Return how far filter and least squares disagree beyond their standard deviations.

    Both see the same data and err alike by noise, but not by what the model lacks: where the
    model is right, their difference stays below the sum of their variances and adds nothing.
    The timing of the inputs is the filter's in both and gets nothing.
    """
    kept = value.size - 1
    difference = value[:kept] - squares.p[free]
    variance = np.diag(covariance)[:kept] + np.diag(squares.covariance)
    return np.append(np.sqrt(np.maximum(difference**2 - variance, 0.0)), 0.0)


def _lost(
    found: tuple[FilterResult, ...] | None,
    failure: FilterFailure | None,
    system: System,
    motions: Sequence[Motion],
    trials: Sequence[Trial],
    order: Sequence[int],
    config: Config,
) -> InputError:
    """Say in physical words where the filter lost the motion."""
    remedy = "try --method least-squares, or set the trial aside if its sensors jumped there"
    where = f"model {config.model}"
    if found is not None:
        nis = [float(np.nanmean(trial.nis)) for trial in found[1].trials]
        worst = int(np.argmax(nis))
        trial = found[1].trials[worst]
        ratio = np.sqrt(np.nanmean((trial.innovation / trial.innovation_sd) ** 2, axis=0))
        axis = (*system.coordinates, *system.coordinates)[int(np.argmax(ratio))]
        return InputError(
            f"the filter does not follow trial {motions[order[worst]].trial_id}: its prediction "
            f"of {axis} one sample ahead errs {ratio.max():.0f} times more than noise explains",
            where=where,
            remedy=remedy,
        )
    if failure is None:
        raise RuntimeError("no attempt was made")
    number = order[failure.trial] if failure.trial < len(order) else 0
    t = trials[number].t[min(failure.sample, trials[number].t.size - 1)]
    return InputError(
        f"the filter lost the motion of trial {motions[number].trial_id} at {t:.2f} s: "
        f"{failure.reason}",
        where=where,
        remedy=remedy,
    )


def _mean_nis(found: FilterResult, settings: FilterSettings) -> float:
    """Return the mean normalised innovation squared of the worst trial; 1 is consistent."""
    worst = max(float(np.nanmean(trial.nis)) for trial in found.trials)
    return worst / settings.observed.size if np.isfinite(worst) else np.inf


def _nis(
    found: FilterResult,
    settings: FilterSettings,
    motions: Sequence[Motion],
    order: Sequence[int],
) -> dict[str, object]:
    """Return the normalised innovation squared: near 1 where the noise levels are right."""
    size = settings.observed.size
    by_trial = {
        motions[place].trial_id: float(np.nanmean(trial.nis)) / size
        for place, trial in zip(order, found.trials, strict=True)
    }
    total = np.concatenate([trial.nis for trial in found.trials])
    return {"mean": float(np.nanmean(total)) / size, "by_trial": by_trial}


def _noise_report(
    system: System, settings: FilterSettings, noise: _Noise
) -> dict[str, dict[str, float]]:
    names = [*system.coordinates, *(f"{axis}_rate" for axis in system.coordinates)]
    reading = zip(names, settings.reading_sd, strict=False)
    return {
        "reading_sd": {name: float(sd) for name, sd in reading},
        "process_sd": dict(zip(system.noise, (float(sd) for sd in settings.noise_sd), strict=True)),
        "sensor_sd": dict(zip(system.noise, (float(sd) for sd in noise.process_sd), strict=True)),
    }


def _state_3sigma(system: System, trials: Sequence[FilteredTrial]) -> dict[str, dict[str, float]]:
    """Return three standard deviations of position and velocity, median over time (Table VI)."""
    n = len(system.coordinates)
    variance = np.concatenate(
        [np.diagonal(trial.covariance, axis1=1, axis2=2)[:, : 2 * n] for trial in trials]
    )
    bound = 3.0 * np.sqrt(np.median(variance, axis=0))
    return {
        axis: {"position": float(bound[i]), "velocity": float(bound[n + i])}
        for i, axis in enumerate(system.coordinates)
    }


def _convergence(
    system: System,
    model: FilterModel,
    search: FilterResult,
    main: FilterResult,
    covariance: Array,
) -> dict[str, object]:
    """Say from when on every estimate stays within 2 % or 3 sd of its final value."""
    nx = model.n_states
    passes = [*search.trials, *main.trials]
    value, slope = model.to_physical(np.concatenate([p.mean[:, nx:] for p in passes]))
    elapsed = np.concatenate(_elapsed(passes))
    final = value[-1]
    band = np.maximum(0.02 * np.abs(final), 3.0 * slope[-1] * np.sqrt(np.diag(covariance)))
    outside = np.abs(value - final) > band
    names = [item.name for item in _free(system)]
    settled = {}
    for place, name in enumerate(names):
        late = np.flatnonzero(outside[:, place])
        settled[name] = float(elapsed[late[-1]]) if late.size else 0.0
    total = float(elapsed[-1])
    return {
        "settled_s": settled,
        "total_s": total,
        "converged": max(settled.values(), default=0.0) < 0.9 * total,
    }


def _elapsed(passes: Sequence[FilteredTrial]) -> list[Array]:
    """Return the time of each pass, counted from the start of the first."""
    clock, times = 0.0, []
    for trial in passes:
        times.append(clock + trial.t - trial.t[0])
        clock += float(trial.t[-1] - trial.t[0])
    return times


def _thinned(count: int, rows: int) -> NDArray[np.int64]:
    """Return indices of at most ``rows`` of ``count`` samples, the last one included."""
    step = -(-count // rows)
    return np.arange(count - 1, -1, -step)[::-1]


def _states(
    system: System,
    motions: Sequence[Motion],
    order: Sequence[int],
    main: FilterResult,
    value: Array,
    config: Config,
) -> pd.DataFrame:
    """Return the filtered motion of every trial, in the order of the session."""
    n = len(system.coordinates)
    frames: dict[int, pd.DataFrame] = {}
    for place, trial in zip(order, main.trials, strict=True):
        keep = _thinned(trial.t.size, config.trace_rows)
        t, mean = trial.t[keep], trial.mean[keep]
        sd = np.sqrt(np.diagonal(trial.covariance[keep], axis1=1, axis2=2))
        columns = {}
        for i, axis in enumerate(system.coordinates):
            columns[f"q_{axis}"], columns[f"q_sd_{axis}"] = mean[:, i], sd[:, i]
            columns[f"qd_{axis}"], columns[f"qd_sd_{axis}"] = mean[:, n + i], sd[:, n + i]
        frames[place] = _with_torque(system, motions[place], t, columns, value[:-1])
    return pd.concat([frames[i] for i in range(len(motions))], ignore_index=True)


def _with_torque(
    system: System, motion: Motion, t: Array, columns: dict[str, Array], value: Array
) -> pd.DataFrame:
    """Add the torque of the hand, N.m or N, and the trial."""
    p = system.prior
    p[[i for i, item in enumerate(system.parameters) if not item.fixed]] = value
    z = system.memory(motion.q, motion.qd, motion.qdd, motion.u, p, motion.t)
    torque = system.applied(motion.q, motion.qd, motion.qdd, z, motion.u, p)
    frame = pd.DataFrame({"trial_id": motion.trial_id, "t": t, **columns})
    for i, axis in enumerate(system.coordinates):
        frame[f"torque_user_{axis}"] = np.interp(t, motion.t, torque[:, i])
    return frame


def _trace(
    model: FilterModel,
    system: System,
    steps: Sequence[Motion],
    passes: Sequence[FilteredTrial],
    config: Config,
) -> pd.DataFrame:
    """Return how the parameters converged, trial by trial, the search first."""
    names = [item.name for item in _free(system)]
    frames = []
    for motion, trial, elapsed in zip(steps, passes, _elapsed(passes), strict=True):
        keep = _thinned(trial.t.size, config.trace_rows)
        value, slope = model.to_physical(trial.mean[keep, model.n_states :])
        value = np.clip(value, model.lower, model.upper)
        variance = np.diagonal(trial.covariance[keep], axis1=1, axis2=2)[:, model.n_states :]
        frame = pd.DataFrame({"t_total": elapsed[keep], "trial_id": motion.trial_id})
        for place, name in enumerate(names):
            frame[name] = value[:, place]
            frame[f"{name}_sd"] = slope[:, place] * np.sqrt(variance[:, place])
        frames.append(frame)
    return pd.concat(frames, ignore_index=True)


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
        frames.append(_with_torque(system, motion, motion.t, columns, squares.p[problem.free]))
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
