"""A fitted model in place of the machine, its motion through the filters of the filter stage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate import butterworth, kalman_smoother, savitzky_golay
from bampipe.estimate.differentiation import Derivatives
from bampipe.estimate.hysteresis import noise_of
from bampipe.physics import System
from bampipe.physics.device import LAST_ORDER, derivative
from bampipe.trials.motions import Motion, put_aside
from bampipe.trials.observation import Motion as Driven
from bampipe.trials.observation import Recording, Sensors
from bampipe.trials.replay import replay

Array = NDArray[np.float64]


def replayed(
    session: Mapping[str, Any],
    settings: Mapping[str, Any],
    system: System,
    motions: Sequence[Motion],
    p: Array,
    rate_hz: float,
    seed: Sequence[int],
    force_noise: bool = True,
) -> Sequence[Motion]:
    """Replay every trial by the model and filter it as the measured one was.

    The model is driven by the measured force and an arm that keeps the motion near the measured
    one; what it does is read by the same encoders and force sensor.

    Args:
        session: ``ingest/session.json``; settings: ``filter/filter.json``.
        system: the model; motions: the trials; p: (n_p,) parameters.
        rate_hz: sampling rate.
        seed: of the sensor noise; the trial's number is added.
        force_noise: whether the force sensor is noisy.

    Raises:
        InputError: the simulated motion grows without bounds.
    """
    noise = session["force"]["noise_sd"]
    resolution = [session["axes"][axis].get("resolution") or 0.0 for axis in system.coordinates]
    quiet = [settings["axes"][axis]["measurement_noise_sd"] for axis in system.coordinates]
    force_sd = _force_noise(system, motions, noise)
    sensors = Sensors(
        rate_hz=rate_hz,
        resolution=np.where(
            np.array(resolution) > 0.0, resolution, np.sqrt(12.0) * np.array(quiet)
        ),
        force_sd=force_sd if force_noise else np.zeros_like(force_sd),
    )
    replays = _replays(system, motions, p, sensors, seed)
    return put_aside(
        _filtered(recording, motion, system, settings, rate_hz)
        for recording, motion in zip(replays, motions, strict=True)
    )


def _replays(
    system: System, motions: Sequence[Motion], p: Array, sensors: Sensors, seed: Sequence[int]
) -> Iterator[Recording]:
    for number, motion in enumerate(motions):
        rng = np.random.default_rng([*seed, number])
        channels = dict(zip(system.inputs, motion.u.T, strict=True))
        for axis in system.coordinates:
            brake = system.model.device.brakes.get(axis)
            channels.setdefault(brake or axis, np.zeros(len(motion.t)))
        for name in system.model.device.channels:
            channels.setdefault(name, np.zeros(len(motion.t)))
        driven = Driven(motion.trial_id, motion.t, motion.q, motion.qd, motion.qdd, channels)
        yield replay(system, p, driven, sensors, rng)


def _force_noise(system: System, motions: Sequence[Motion], stated: float | None) -> Array:
    """Return the noise (n_f,) of the force channels: as stated, else from the samples."""
    forces = system.model.device.forces
    if stated is not None:
        return np.full(len(forces), float(stated))
    columns = [system.inputs.index(name) for name in forces]
    return np.median([[noise_of(m.u[:, c]) for c in columns] for m in motions], axis=0)


def _filtered(
    recording: Recording,
    motion: Motion,
    system: System,
    settings: Mapping[str, Any],
    rate: float,
) -> Motion:
    """Return a replayed trial after the filters that the measured one went through."""
    moved = [
        _differentiated(recording.q[:, i], settings["method"], settings["axes"][axis], rate)
        for i, axis in enumerate(system.coordinates)
    ]
    u, u_rate = motion.u.copy(), np.zeros_like(motion.u)
    cutoff = settings["force"]["derivative_cutoff_hz"]
    at = {name: place for place, name in enumerate(system.inputs)}
    for column, name in enumerate(system.model.device.forces):
        found = butterworth.rates(recording.force[:, column], rate, cutoff, LAST_ORDER)
        u[:, at[name]], u_rate[:, at[name]] = recording.force[:, column], found[0]
        for order, values in enumerate(found, start=1):
            if derivative(name, order) in at:
                u[:, at[derivative(name, order)]] = values
    return replace(
        motion,
        q=np.stack([m.position for m in moved], axis=1),
        qd=np.stack([m.velocity for m in moved], axis=1),
        qdd=np.stack([m.acceleration for m in moved], axis=1),
        u=u,
        u_rate=u_rate,
    )


def _differentiated(
    position: Array, method: str, axis: Mapping[str, Any], rate: float
) -> Derivatives:
    """Differentiate as ``filter/filter.json`` says that the measured positions were."""
    noise_sd, cutoff = float(axis["measurement_noise_sd"]), float(axis["bandwidth_hz"])
    if method == "kalman":
        order = int(axis["order"])
        ratio = kalman_smoother.ratio_for(cutoff, order, rate)
        model = kalman_smoother.MotionModel(order, noise_sd, ratio, rate)
        return kalman_smoother.smooth(position, model)
    smooth = butterworth.smooth if method == "butterworth" else savitzky_golay.smooth
    return smooth(position, rate, cutoff, noise_sd)
