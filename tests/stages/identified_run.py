"""Run folders up to the filter stage or the identification, simulated or recorded."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from made_results import write_model
from run_folders import write_ingested

from bampipe.data.run_folder import RunFolder
from bampipe.physics import Model, compile_model, registry
from bampipe.progress import silent
from bampipe.stages import filter as filter_stage
from bampipe.stages import identify, ingest
from bampipe.trials.motion import Motion
from bampipe.trials.replicates import follow_motion, read_by_sensors
from bampipe.trials.sensors import Sensors

RATE = 500.0
RESOLUTION = {"yaw": 4.6875e-5, "pitch": 9.8125e-5, "extension": 3.0e-5}
AXES = {
    axis: {"unit": "m" if axis == "extension" else "rad", "resolution": step}
    for axis, step in RESOLUTION.items()
}
SQUARES = identify.Config(method="least-squares")
TRUTH = {
    "viscous.yaw": 4.2, "coulomb.yaw": 1.05, "viscous.pitch": 3.6, "coulomb.pitch": 2.2,
    "viscous.extension": 13.0, "coulomb.extension": 3.5, "mass": 3.5,
}  # fmt: skip


def simulated_run(
    root: Path,
    *,
    trials: int = 2,
    seconds: float = 10.0,
    scramble: bool = False,
    late: int = 0,
    effect: str = "",
    hidden: Mapping[str, float] | None = None,
) -> RunFolder:
    """Simulate the BAM under a hand, read by its sensors, up to the filter stage.

    ``scramble`` turns the force channels round in time, so that no model explains the motion;
    ``late`` reads them that many samples after the motion. ``effect`` is in the mechanism, with
    the parameters ``hidden``.
    """
    system = compile_model(Model(registry.device("bam"), [effect] if effect else []))
    p = np.array([{**TRUTH, **(hidden or {})}[item.name] for item in system.parameters])
    resolution = np.array(list(RESOLUTION.values()))
    sensors = Sensors(RATE, resolution, resolution / np.sqrt(12.0), np.full(3, 0.05))
    frames = {}
    for number in range(trials):
        rng = np.random.default_rng([11, number])
        wanted = _wanted(rng, seconds, tuple(system.inputs), f"t{number:02d}")
        course = follow_motion(system, p, wanted, sensors.rate_hz)
        recording = read_by_sensors(system, wanted, *course, sensors, rng)
        forces = np.column_stack([recording.channels[f"force_{c}"] for c in "xyz"])
        force = forces[::-1] if scramble else np.roll(forces, late, axis=0)
        frame = pd.DataFrame({"t": wanted.t})
        for i, axis in enumerate(RESOLUTION):
            frame[f"q_{axis}"] = recording.q[:, i]
        for i, component in enumerate("xyz"):
            frame[f"force_{component}"] = force[:, i]
        for axis in RESOLUTION:
            frame[f"brake_{axis}"] = recording.channels[f"brake_{axis}"]
        frames[wanted.trial_id] = frame
    return _filtered(write_ingested(root, frames, dict.fromkeys(frames, ("free", None)), AXES))


def recorded_run(root: Path, session: Path) -> RunFolder:
    """Take the session in a folder up to the filter stage."""
    run = RunFolder(root)
    ingest.execute(run, root, ingest.Config(session=str(session)), silent)
    return _filtered(run)


def identified(run: RunFolder) -> RunFolder:
    """Identify by least squares, which is quick."""
    identify.execute(run, run.root, SQUARES, silent)
    return run


def _filtered(run: RunFolder) -> RunFolder:
    filter_stage.execute(run, run.root, filter_stage.Config(), silent)
    write_model(run.root, "base")
    return run


def _wanted(
    rng: np.random.Generator, seconds: float, inputs: tuple[str, ...], trial_id: str
) -> Motion:
    """The motion that the hand wants: a few sines of 0.1 to 1.5 Hz on every axis."""
    t = np.arange(0.0, seconds, 1.0 / RATE)
    middle, reach = np.array([0.0, 0.0, 1.1]), np.array([0.35, 0.25, 0.12])
    q, qd, qdd = (np.zeros((t.size, 3)) for _ in range(3))
    q += middle
    for i in range(3):
        for f, phase in zip(rng.uniform(0.1, 1.5, 4), rng.uniform(0, 2 * np.pi, 4), strict=True):
            w, size = 2 * np.pi * f, reach[i] / 2 / (1.0 + f)
            q[:, i] += size * np.sin(w * t + phase)
            qd[:, i] += size * w * np.cos(w * t + phase)
            qdd[:, i] -= size * w * w * np.sin(w * t + phase)
    return Motion(
        trial_id, t, q, qd, qdd, np.zeros_like(qd), {name: np.zeros(t.size) for name in inputs}
    )
