"""The start of a monitor: from an identified run, or from the priors of a device."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bampipe.arrays import Array
from bampipe.data.refusals import refusal
from bampipe.data.run_folder import RunFolder
from bampipe.data.session import Session, read_session
from bampipe.data.session.conversion import Conversion
from bampipe.data.stream import SampleStream, conversion_of_stream
from bampipe.declarations.model_file import load_model, read_estimate
from bampipe.errors import InputError
from bampipe.estimate.consistency import find_threshold, window_means
from bampipe.estimate.square_root import FilterSettings
from bampipe.estimate.unscented import FilterFailure, FilterModel, Trial, filter_trials
from bampipe.files import cannot
from bampipe.identification.filter_run import build_filter_model, infer_initial_state
from bampipe.physics import System, compile_model
from bampipe.results.identify import IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.trials.reading import free_trials, input_columns, read_samples
from bampipe.trials.sensors import RecordNoise, settle_encoder, settle_force

_NO_STEP = 3e-6
"""Noise of an encoder that did not move in the first samples, rad or m."""

LONGEST_WINDOW_S = 3600.0

FIRST_LOOK = 500
"""Samples from which the noise is estimated without a run."""


@dataclass(frozen=True)
class MonitorOptions:
    """Settings of a monitor.

    Attributes:
        window_s: length of the windows that the alarm judges, s.
        false_alarms_per_hour: alarms of a consistent filter that are accepted.
        memory_s: time in which a parameter may drift by its initial uncertainty, s; infinite for
            constant parameters.
        gap_s: a longer gap between samples restarts the motion, but not the parameters.
    """

    window_s: float = 1.0
    false_alarms_per_hour: float = 1.0
    memory_s: float = 60.0
    gap_s: float = 0.5

    def check(self) -> None:
        """Raise :class:`InputError` if an option makes no sense."""
        given = (self.window_s, self.false_alarms_per_hour, self.memory_s)
        for option, value in zip(("--window", "--false-alarms", "--memory"), given, strict=True):
            if not value > 0.0:
                raise InputError("must be positive", where=option)
        if self.window_s > LONGEST_WINDOW_S:
            raise InputError(f"must be at most {LONGEST_WINDOW_S:g} s", where="--window")
        if self.probability >= 0.5:
            raise InputError(
                "more false alarms than windows", where="--false-alarms", remedy="ask for fewer"
            )

    @property
    def probability(self) -> float:
        """Probability of a false alarm in one window."""
        return self.false_alarms_per_hour * self.window_s / 3600.0


@dataclass(frozen=True)
class Start:
    """The start of the filter.

    Attributes:
        model, settings: of the filter.
        theta, covariance: (nt,) and (nt, nt) parameters, on the scale of estimation.
        speed_sd: (n_q,) standard deviation of the rates at the first sample.
        threshold: of the mean NIS over a window, for an alarm; window: its length in samples.
    """

    model: FilterModel
    settings: FilterSettings
    theta: Array
    covariance: Array
    speed_sd: Array
    threshold: float
    window: int

    def state(self, system: System, q: Array, u: Array) -> tuple[Array, Array]:
        """Return the state (nx,) at rest for readings q (n_q,) and inputs u, and its sd (nx,)."""
        p = self.model.parameters.copy()
        p[self.model.free] = self.model.to_physical(self.theta)[0]
        return infer_initial_state(
            system, p[:-1], q, np.zeros(q.size), u, self.settings.reading_sd, self.speed_sd
        )


def list_layouts(system: System, session: Session | None) -> tuple[Conversion, ...]:
    """Return the headers that a stream for this model may have.

    They are SI columns named as in ``ingest/samples.parquet``, with brake commands of zero if their
    columns are absent, and with a session file also the columns of its raw logs.

    Raises:
        InputError: the model needs an input that no sensor gives in real time, such as a rate.
    """
    device = system.model.device
    given = {*device.forces, *device.channels, *device.brakes.values(), "t"}
    derived = [name for name in system.inputs if name not in given]
    if derived:
        raise refusal("not_in_real_time", name=derived[0])
    brakes = {name: f"brake_{axis}" for axis, name in device.brakes.items()}
    positions = [f"q_{axis}" for axis in system.coordinates]
    others = [name for name in system.inputs if name not in brakes and name != "t"]
    commands = [brakes[name] for name in system.inputs if name in brakes]
    found = [Conversion.in_si([*positions, *others, *commands])]
    if commands:
        found.append(Conversion.in_si([*positions, *others]))
    if session is not None:
        found.append(conversion_of_stream(session))
    return tuple(found)


def open_stream(
    samples: str,
    system: System,
    session: Path | None,
    strict: bool,
    complain: Callable[[str], None],
) -> SampleStream:
    """Open a growing file, or standard input if ``samples`` is ``-``.

    Args:
        samples: path, or ``-``; system: the model; session: folder whose raw columns are accepted.
        strict: raise at a bad line; complain: called for the first lines that are skipped.
    """
    known = list_layouts(system, read_session(session) if session is not None else None)
    if samples == "-":
        return SampleStream(0, "standard input", known, strict, complain)
    try:
        descriptor = os.open(samples, os.O_RDONLY)
    except OSError as error:
        raise cannot("read", Path(samples), error) from error
    return SampleStream(descriptor, samples, known, strict, complain)


def start_from_run(run: RunFolder, name: str, options: MonitorOptions) -> tuple[System, Start]:
    """Return model, parameters and noise from an identified run.

    The threshold of the alarm comes from the free trials of the run, filtered as the monitor does,
    so that the alarm responds to a change of the innovations.

    Raises:
        InputError: the model has not been identified by the filter.
    """
    system = compile_model(load_model(run, name))
    found = run.read(IdentifyResult, name)
    path = IdentifyResult.file(name)
    if found.noise is None:
        raise refusal("no_noise", str(run.path(path)), root=run.root)
    values, names = read_estimate(run, name, system), found.covariance.names
    ingested = run.read(IngestResult)
    if ingested.kept_every > 1:
        raise refusal("thinned", str(run.path(IngestResult.FILE)), every=ingested.kept_every)
    rate = ingested.sample_rate_hz
    trials = [_read_trial(run, trial, system) for trial in free_trials(run, fitted=True)]
    model = build_filter_model(system, trials, values, False, found.input_timing.estimate)
    sd = np.array([found.parameters[parameter].sd for parameter in names])
    value = values[model.free]
    theta, spread = model.to_estimated(value, np.maximum(sd, 1e-6 * np.abs(value)))
    matrix = np.array(found.covariance.matrix)
    scale = np.sqrt(np.diag(matrix))
    scale[scale == 0.0] = 1.0
    correlation = matrix / np.outer(scale, scale)
    np.fill_diagonal(correlation, 1.0)
    covariance = correlation * np.outer(spread, spread)
    reading = [found.noise.reading_sd[axis] for axis in system.coordinates]
    settings = FilterSettings(
        observed=np.arange(len(reading)),
        reading_sd=np.array(reading),
        noise_sd=np.array([found.noise.process_sd[item] for item in system.noise]),
        walk_sd=spread / np.sqrt(options.memory_s),
        stride=max(trial.t.size for trial in trials),
    )
    n = len(system.coordinates)
    squares = [np.mean(np.square(_find_speeds(trial)), axis=0) for trial in trials]
    speed = np.sqrt(np.mean(squares, axis=0))
    window = max(2, round(options.window_s * rate))
    start = Start(
        model, settings, theta, covariance, np.maximum(speed, 1e-3),
        find_threshold(options.probability, window * n), window,
    )  # fmt: skip
    means = []
    for trial in trials:
        begun = Trial(trial.t, trial.u, trial.y, *start.state(system, trial.y[0], trial.u[0]))
        try:
            filtered = filter_trials(model, [begun], theta, covariance, settings).trials[0]
        except FilterFailure as failure:
            of = {"why": failure.reason, "run": f"{run.root}{run.model_option(name)}"}
            raise refusal("does_not_follow", str(run.path(path)), **of) from failure
        means.append(window_means(filtered.nis[window:], n, window))
    threshold = find_threshold(options.probability, window * n, np.concatenate(means))
    return system, replace(start, threshold=threshold)


def start_from_samples(
    system: System, t: Array, u: Array, q: Array, options: MonitorOptions
) -> Start:
    """Return parameters from the priors of the device and noise from the first samples.

    The noise of each channel is estimated as `ingest` does. The threshold of the alarm is that of
    white Gaussian noise.

    Args:
        system: the model; t: (T,); u: (T, nu); q: (T, n_q): the first `FIRST_LOOK` samples.
    """
    trial = Trial(t, u, q, np.zeros(0), np.zeros(0))
    model = build_filter_model(system, [trial], system.prior, timing=False)
    free = [item for item in system.parameters if not item.fixed]
    theta, spread = model.to_estimated(
        np.array([item.prior for item in free]), np.array([item.sd for item in free])
    )
    reading = [
        settle_encoder(axis, "", None, [RecordNoise.of(column, t)]).noise_sd or _NO_STEP
        for axis, column in zip(system.coordinates, q.T, strict=True)
    ]
    sensed = {
        name: settle_force(name, "", None, [RecordNoise.of(u[:, column], t)]).noise_sd
        for column, name in enumerate(system.inputs)
        if name in system.noise
    }
    least = min((sd for sd in sensed.values() if sd > 0.0), default=0.05)
    n = len(system.coordinates)
    rate = 1.0 / float(np.median(np.diff(t)))
    window = max(2, round(options.window_s * rate))
    settings = FilterSettings(
        observed=np.arange(n),
        reading_sd=np.array(reading),
        noise_sd=np.array([sensed.get(name, 0.0) or least for name in system.noise]),
        walk_sd=spread / np.sqrt(options.memory_s),
    )
    return Start(
        model, settings, theta, np.diag(spread**2), np.ones(n),
        find_threshold(options.probability, window * n), window,
    )  # fmt: skip


def _read_trial(run: RunFolder, trial_id: str, system: System) -> Trial:
    """Return the raw samples of a trial from the first complete reading on, without a state."""
    columns = read_samples(run, trial_id, system)
    t = columns["t"]
    u = input_columns(columns, system.inputs, system.model.device.brakes)
    y = np.column_stack([columns[f"q_{axis}"] for axis in system.coordinates])
    first = int(np.flatnonzero(np.isfinite(y).all(axis=1))[0])
    return Trial(t[first:], u[first:], y[first:], np.zeros(0), np.zeros(0))


def _find_speeds(trial: Trial) -> Array:
    """Return coarse velocities over 0.05 s, (rows, n_q), to find their size."""
    step = max(1, round(0.05 / float(np.median(np.diff(trial.t)))))
    speed = np.diff(trial.y[::step], axis=0) / np.diff(trial.t[::step])[:, None]
    return np.nan_to_num(speed)
