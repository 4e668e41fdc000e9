"""Moving trials of a run folder as the sensors gave them, for comparing and replaying models."""

from __future__ import annotations

import numpy as np

from bampipe.data.run_folder import MOVING, RunFolder
from bampipe.data.store import read_parquet
from bampipe.discover.chance import Recipe
from bampipe.errors import InputError
from bampipe.estimate.differentiation import uniform_grid
from bampipe.estimate.hysteresis import noise_of
from bampipe.files import read_toml
from bampipe.physics import Model, System
from bampipe.trials.motions import held_out_trials
from bampipe.trials.observation import Motion, Recording, Sensors, observe


def recipe_of(run: RunFolder, name: str, model: Model) -> Recipe:
    """``model``, called ``name`` in the run folder, as plain data for worker processes."""
    own = [read_toml(run.path(path)) for path in run.glob(f"models/{name}/effects/*.toml")]
    return Recipe(model.device.declaration, tuple(e.name for e in model.effects), tuple(own))


def read_session(
    run: RunFolder, system: System, cutoff_hz: float = 25.0
) -> tuple[Sensors, list[Motion]]:
    """Moving trials of a run folder on uniform grids, filtered for the diagnosis, and the sensors.

    Trials that the session holds out are left alone: no model is chosen by them.

    Raises:
        InputError: a file or channel that the model needs is missing.
    """
    about = run.read_json("ingest/session.json")
    rate = float(about["sample_rate_hz"])
    device = system.model.device
    trials = read_parquet(run.require("ingest/trials.parquet", "ingest"))
    sound = trials[(trials["kind"].isin(MOVING)) & (trials["status"] != "set_aside")]
    sound = sound[~sound["trial_id"].isin(held_out_trials(run))]
    samples = run.require("ingest/samples.parquet", "ingest")
    recordings = []
    for trial_id in sound["trial_id"].astype(str):
        frame = read_parquet(samples, trial=trial_id)
        frame = frame[frame.drop(columns="trial_id").notna().all(axis=1)]
        grid = uniform_grid(frame["t"].to_numpy(dtype=float), rate)
        q = [grid.resample(frame[f"q_{a}"].to_numpy(dtype=float)) for a in system.coordinates]
        missing = [c for c in (*device.forces, *device.channels) if c not in frame]
        if missing:
            raise InputError(
                f"no column {missing[0]!r}, which device {device.name!r} needs",
                where=str(samples),
                remedy="name the channel in session.toml",
            )
        force = [grid.resample(frame[f].to_numpy(dtype=float)) for f in device.forces]
        brake = [
            grid.hold(frame[f"brake_{a}"].to_numpy(dtype=float))
            if f"brake_{a}" in frame
            else np.zeros(len(grid.t))
            for a in system.coordinates
        ]
        other = {c: grid.resample(frame[c].to_numpy(dtype=float)) for c in device.channels}
        stacked = (np.column_stack(part) for part in (q, force, brake))
        recordings.append(Recording(trial_id, *stacked, other))
    stated = (about.get("force") or {}).get("noise_sd")
    if stated is None:
        rows = [[noise_of(column) for column in r.force.T] for r in recordings]
        noise = np.median(np.array(rows), axis=0) if rows else np.zeros(len(device.forces))
    else:
        noise = np.broadcast_to(np.asarray(stated, dtype=float), (len(device.forces),))
    # Where no resolution is stated, that whose rounding has the noise found by the filter stage.
    resolution = np.array(
        [float(about["axes"][a].get("resolution") or 0) for a in system.coordinates]
    )
    if not resolution.all():
        seen = run.read_json("filter/filter.json")["axes"]
        noise_sd = np.array([float(seen[a]["measurement_noise_sd"]) for a in system.coordinates])
        resolution = np.where(resolution > 0.0, resolution, np.sqrt(12.0) * noise_sd)
    sensors = Sensors(rate, resolution, np.array(noise), min(cutoff_hz, 0.2 * rate))
    return sensors, [observe(r, sensors, system) for r in recordings]
