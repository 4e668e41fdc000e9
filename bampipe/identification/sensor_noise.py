"""Settings of the filter, noise of the sensors, and tuning of noise levels by the likelihood."""

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.arrays import Array, Flags
from bampipe.estimate.filter_uncertainty import climb
from bampipe.estimate.square_root import FilterSettings
from bampipe.estimate.unscented import FilterFailure, FilterModel, Trial, filter_trials
from bampipe.physics import System
from bampipe.results.identify import NoiseLevels
from bampipe.schema import STRICT, NotNegative, Positive
from bampipe.trials.motion import Motion
from bampipe.trials.sensors import Sensors

TUNING_SAMPLES = 3000
"""Number of samples on which the noise levels are tuned."""
_TUNING_TRIALS = 6
"""Number of trials that they stem from: in a single one, a missing effect may be small."""
_TUNING_STEP_S = 2e-3
"""Longest Runge-Kutta step while tuning, s, which is sufficient for noise levels."""


@checked_dataclass(frozen=True, config=STRICT)
class FilterChoice:
    """Settings of the filter.

    Attributes:
        engine: ``compiled``, or ``filterpy``: slow, with the same results.
        measure: ``position``, or ``position_velocity`` as in the paper; filtered velocities are
            not white, so intervals from them are too narrow.
        random_walk: of the parameters, in prior standard deviations per square root of a
            second; with 0 they are constant, and only then are the intervals calibrated.
        reading_noise: standard deviation of a position reading in encoder steps; 0 measures it
            in the data.
        force_noise: of a force sample, N, including model error; 0 measures it in the data, or
            takes that of the identification if the model has been identified.
        longest_step_s: longest Runge-Kutta step, s.
        block_s: length of the blocks that are treated as independent of each other, s; shorter
            in short sessions, so that there are at least three per parameter.
        trace_rows: largest number of rows per trial in tables of states and of parameters along
            the data.
    """

    engine: Literal["compiled", "filterpy"] = "compiled"
    measure: Literal["position", "position_velocity"] = "position"
    random_walk: NotNegative = 0.0
    reading_noise: NotNegative = 0.0
    force_noise: NotNegative = 0.0
    longest_step_s: Positive = 1e-3
    block_s: Positive = 2.0
    trace_rows: Annotated[int, Field(gt=0)] = 2000


def force_noise_mask(system: System) -> Flags:
    """Find the components of the process noise that are a measured force, (nw,)."""
    return np.array([name in system.inputs for name in system.noise], dtype=bool)


def untuned_settings(
    sensors: Sensors, system: System, motions: Sequence[Motion], p: Array, choice: FilterChoice
) -> FilterSettings:
    """Return the settings of the filter with the noise of the session's sensors, before tuning.

    Process noise that is not of a force starts as the torque of the smallest force noise at an arm
    of 1 m. If the load moves the encoder relative to the handle, the noise of a force adds to the
    modelled reading.

    ``p`` (n_p,) are parameters near the answer; ``choice`` may fix levels.
    """
    n, reading = len(system.coordinates), sensors.reading_sd.copy()
    if choice.reading_noise > 0.0:
        reading = choice.reading_noise * sensors.resolution
    if choice.measure == "position_velocity":
        velocity = np.concatenate([motion.qd_sd for motion in motions])
        reading = np.append(reading, np.median(velocity, axis=0))
    force_sd = dict(zip(system.model.device.forces, sensors.force_sd, strict=True))
    is_force = force_noise_mask(system)
    process = np.array([float(force_sd.get(name, 0.0)) for name in system.noise])
    if choice.force_noise > 0.0:
        process[:] = choice.force_noise
    smallest = process[is_force].min() if is_force.any() else 0.05
    process[process == 0.0] = smallest or np.finfo(float).eps
    if system.moves_sensors:
        reading[:n] = np.hypot(reading[:n], _force_in_positions(system, motions, p, process))
    free = [item for item in system.parameters if not item.fixed]
    return FilterSettings(
        observed=np.arange(reading.size),
        reading_sd=reading,
        noise_sd=process,
        walk_sd=choice.random_walk * np.array([item.sd for item in free]),
        longest_step=choice.longest_step_s,
    )


def _force_in_positions(
    system: System, motions: Sequence[Motion], p: Array, noise_sd: Array
) -> Array:
    """Return the RMS motion of the encoders that force noise causes in the model, (n_q,)."""
    square, count = np.zeros(len(system.coordinates)), 0
    for motion in motions:
        given = motion.inputs(system.inputs)
        here = system.offset(motion.q, given, p)
        for place in np.flatnonzero(force_noise_mask(system)):
            u = given.copy()
            u[:, system.inputs.index(system.noise[place])] += noise_sd[place]
            square += np.sum((system.offset(motion.q, u, p) - here) ** 2, axis=0)
        count += len(motion.t)
    return np.asarray(np.sqrt(square / count))


def choose_tuning_trials(sizes: Sequence[int]) -> tuple[list[int], int]:
    """Choose trials on whose beginnings the noise levels are tuned, `TUNING_SAMPLES` in all.

    A filter can start at the beginning of a trial, where the machine is at rest; in the middle, the
    internal states of friction are unknown.

    Returns:
        Numbers of the trials, evenly spread, and the number of samples from each.
    """
    usual = int(np.median(sizes))
    count = min(len(sizes), max(_TUNING_TRIALS, -(-TUNING_SAMPLES // usual)))
    places = np.linspace(0, len(sizes) - 1, count).round().astype(int)
    return places.tolist(), -(-TUNING_SAMPLES // count)


def tune_noise(
    settings: FilterSettings,
    model: FilterModel,
    records: Sequence[Trial],
    clear: Sequence[Flags],
    near: tuple[Array, Array],
    is_force: Flags,
    choice: FilterChoice,
) -> FilterSettings:
    """Maximise the filter's likelihood over the noise levels, on parts of trials.

    The noise of a measured force is at least that of its sensor; the excess is model error.
    Reversals are left out: there the filter's Gaussian fits at no noise level, and tuning would
    double the noise everywhere else.

    Args:
        settings: with the initial levels; records: the beginnings of trials.
        clear: (T,) by record, the samples at which no axis reverses; if there are none, all count.
        near: (nt,) parameters near the answer, physical, and (nt,) their sd.
        is_force: see `force_noise_mask`.
        choice: may fix some levels.
    """
    longest = max(settings.longest_step, _TUNING_STEP_S)
    quick = settings._replace(longest_step=longest, stride=TUNING_SAMPLES)  # store no distributions
    counts = np.concatenate(clear)
    counts = counts if counts.any() else np.ones(counts.size, dtype=bool)
    value, sd = near
    spread = np.maximum(sd, 1e-6 * np.abs(value))
    mean, sd = model.to_estimated(value, np.maximum(spread, np.finfo(float).tiny))

    def with_levels(levels: Array) -> FilterSettings:
        reading, *process = np.exp(levels)
        return quick._replace(
            reading_sd=quick.reading_sd * reading, noise_sd=quick.noise_sd * process
        )

    def log_likelihood(levels: Array) -> float:
        try:
            found = filter_trials(model, records, mean, np.diag(sd**2), with_levels(levels))
        except FilterFailure:
            return -np.inf
        likely = np.concatenate([one.log_likelihood for one in found.trials])
        return float(np.nansum(likely[counts]))

    count = is_force.size
    step = np.log(np.array([2.0**0.125, *np.full(count, 2.0)]))
    lower = np.array([-np.inf, *np.where(is_force, 0.0, np.log(1e-3))])
    if choice.reading_noise > 0.0:
        step[0] = 0.0
    if choice.force_noise > 0.0:
        step[1:][is_force] = 0.0
    best, _ = climb(log_likelihood, np.zeros(count + 1), step, lower)
    return with_levels(best)._replace(longest_step=settings.longest_step, stride=settings.stride)


def noise_levels(system: System, settings: FilterSettings, untuned: FilterSettings) -> NoiseLevels:
    """Return the tuned levels and those of the sensors, by name."""
    names = [*system.coordinates, *(f"{axis}_rate" for axis in system.coordinates)]
    return NoiseLevels(
        reading_sd=dict(zip(names, settings.reading_sd, strict=False)),
        process_sd=dict(zip(system.noise, settings.noise_sd, strict=True)),
        sensor_sd=dict(zip(system.noise, untuned.noise_sd, strict=True)),
    )
