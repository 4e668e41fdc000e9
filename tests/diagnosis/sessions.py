"""A short session made from the device itself, with effects, for tests of the diagnosis."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from independent_runs import record_trials

from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.ranges import MachineScale
from bampipe.diagnosis.select import Selection, select_effects
from bampipe.diagnosis.session import Fit, Session, system_of
from bampipe.diagnosis.verdict import Conclusion, conclude
from bampipe.estimate.butterworth import zero_phase
from bampipe.estimate.low_pass import Band
from bampipe.physics import registry
from bampipe.physics.model_spec import ModelSpec
from bampipe.trials.folds import Folds
from bampipe.trials.kinematics import AxisFilter, Kinematics
from bampipe.trials.linearisation import Linearisation, linearise_fit
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.motion import Motion
from bampipe.trials.replicates import SimulatedTrials, read_by_sensors
from bampipe.trials.sensors import Sensors

RATE = 250.0
TRUTH = {
    "viscous.yaw": 4.2,
    "coulomb.yaw": 1.1,
    "viscous.pitch": 3.7,
    "coulomb.pitch": 2.2,
    "viscous.extension": 13.4,
    "coulomb.extension": 3.6,
    "mass": 3.56,
}
RESOLUTION = np.array([1 / 21333.3333, 1 / 10191.0828, 1 / 33333.3333])
SENSORS = Sensors(RATE, RESOLUTION, RESOLUTION / np.sqrt(12.0), np.full(3, 0.05))
KINEMATICS = Kinematics(
    "kalman",
    RATE,
    {
        axis: AxisFilter(25.0, step / np.sqrt(12.0), 3)
        for axis, step in zip(("yaw", "pitch", "extension"), RESOLUTION, strict=True)
    },
    25.0,
)
BAND = Band(RATE, (8.0, 8.0, 8.0))
AXIS = MachineScale(
    np.array([-0.05]), np.array([0.2]), np.array([0.3]), np.array([100.0]),
    np.array([50.0]), {"carriage": ("m", "N")}, 1e-3, 20.0, (8.0,),
)  # fmt: skip
"""A positioning axis: 0.25 m, 0.3 m/s, 100 N, 1 kHz, a band up to 8 Hz."""


def folds(count: int) -> Folds:
    """Each trial left out alone."""
    names = [f"t{k}" for k in range(count)]
    return Folds.of_trials(names, (), names)


def bam(effects: Sequence[str] = (), extra: Sequence[Mapping[str, Any]] = ()) -> ModelSpec:
    """The BAM with ``effects``."""
    return ModelSpec(registry.device("bam").declaration, tuple(effects), tuple(extra))


def fit_trials(trials: MeasuredTrials, spec: ModelSpec) -> Linearisation:
    """Least squares of the model of ``spec`` on the trials, from its priors."""
    system = system_of(spec)
    return linearise_fit(system, trials.motions, trials.band, system.prior, trials.folds)


def fit_from_priors(session: Session, spec: ModelSpec) -> Fit:
    """The plain fit of a model from its priors."""
    return session.fit_plainly(spec, system_of(spec).prior)


def take_timing_off(trials: MeasuredTrials, spec: ModelSpec) -> MeasuredTrials:
    """The trials with the timing of their inputs as found by least squares, and open beside it."""
    half = 0.5 / trials.band.rate_hz
    timed = replace(trials, limit_s=half, timed=True)
    fit = fit_from_priors(Session(timed, Criteria(), keeps_timing=True), spec)
    change = fit.problem.to_parameters @ fit.solution.base
    return timed.with_input_timing(float(change[len(fit.linearisation.free)]))


def fit_bare(
    root: Path, machine: str, seed: int, *effects: str, replicates: int = 6
) -> tuple[Session, ModelSpec, Fit]:
    """A recorded session with hidden ``effects``, the bare device, and its fit."""
    trials, spec, _ = record_trials(root, machine, seed, *effects)
    trials = replace(trials, motions=tuple(trials.motions))
    session = Session(trials, Criteria(replicates=replicates))
    return session, spec, session.fit(spec, system_of(spec).prior)


def diagnose_trials(
    trials: MeasuredTrials, spec: ModelSpec, only: Sequence[str] = (), **criteria: float
) -> tuple[Selection, Conclusion]:
    """Fit a model by least squares, as identification does, and diagnose it, in this process.

    Args:
        trials: of the session; recipe: the model.
        only: effects that are weighed in place of all; criteria: other ones than the defaults.
    """
    session = Session(trials, Criteria(**criteria))
    without = [n for n in session.candidate_names(spec) if only and n not in only]
    start = fit_from_priors(session, spec).linearisation.p
    selection = select_effects(session, spec, start, without)
    return selection, conclude(session, selection)


def made(
    spec: ModelSpec, values: Mapping[str, float], trials: int = 4, seconds: float = 8.0
) -> MeasuredTrials:
    """Simulate designed motions with the model of ``spec`` at TRUTH and ``values``."""
    system = system_of(spec)
    known = TRUTH | {q.name: q.prior for q in system.parameters[len(TRUTH) :]} | dict(values)
    p = np.array([known[q.name] for q in system.parameters])
    rng = np.random.default_rng(7)
    t = np.arange(int(seconds * RATE)) / RATE
    motions = []
    for trial in range(trials):
        q = np.zeros((len(t), 3))
        middle, size = np.array([0.0, 0.05, 1.1]), np.array([0.6, 0.35, 0.25])
        for axis in range(3):
            for frequency in (0.15, 0.35, 0.7, 1.3):
                phase = rng.uniform(0.0, 2.0 * np.pi)
                q[:, axis] += np.sin(2.0 * np.pi * frequency * t + phase) / (1.0 + 4.0 * frequency)
        q = middle + size * q / np.abs(q).max(axis=0)
        qd = np.gradient(q, t, axis=0)
        qdd = np.gradient(qd, t, axis=0)
        channels = {name: np.zeros(len(t)) for name in system.inputs} | {"t": t}
        for axis in system.coordinates:
            channels[f"brake_{axis}"] = np.zeros(len(t))
        u = np.column_stack([channels[name] for name in system.inputs])
        z = system.memory(q, qd, qdd, u, p, t)
        need = system.required(q, qd, qdd, z, u, p)
        # A hand has no step in its force where friction changes sign: the arm lags instead.
        need = np.column_stack([zero_phase(column, RATE, 8.0)[0] for column in need.T])
        lever = np.column_stack([q[:, 2] * np.cos(q[:, 1]), q[:, 2], np.ones(len(t))])
        for k, name in enumerate(("force_x", "force_y", "force_z")):
            channels[name] = need[:, k] / lever[:, k]
            head, _, component = name.rpartition("_")
            channels[f"{head}_rate_{component}"] = np.gradient(channels[name], t)
            for order in ("curvature", "third", "fourth", "fifth", "sixth"):
                channels[f"{head}_{order}_{component}"] = np.zeros(len(t))
        wanted = Motion(f"t{trial + 1:02d}", t, q, qd, qdd, np.zeros_like(qd), channels)
        rng = np.random.default_rng([11, trial])
        simulated = SimulatedTrials(system, p, [wanted], SENSORS.rate_hz)
        recording = read_by_sensors(system, wanted, *simulated.courses[0], SENSORS, rng)
        seen = KINEMATICS.observe(recording, system.model.device.forces)
        motions.append(replace(seen, left_out=simulated.rests[0]))
    return MeasuredTrials(tuple(motions), SENSORS, KINEMATICS, BAND, folds(trials))
