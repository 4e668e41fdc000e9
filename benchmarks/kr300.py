"""Inverse dynamics, simulation and free run of a large arm: a minute each to fit, choose and test.

    python benchmarks/kr300.py [--data FOLDER]

FOLDER/kuka_kr300_60s has the recordings (Weigand et al. 2022, CC BY-SA 4.0), FOLDER/kuka_kr300 the
drawing of the same kind of arm (MIT). The load at the flange may differ, so that the drawn numbers
count within their own size. Parameters come from the training record. Of the models (bodies and
friction; with the counterbalance of axis 2, entered as a user would; with what `extend --auto` adds
to that), the error on the validation record chooses one. The test record is used once.

- Inverse dynamics: error of each joint's torque, per cent of it, within the band compared.
- Simulation over 75 and 150 steps (0.3 and 0.6 s) by the recorded torques, from the filtered state
  at 100 starts: RMSE over all steps by the standard deviation of the joint over the record. Beside
  it stands what keeping the first velocity gives.
- Free run over the whole record, the same measure, and when it first leaves the record's range.

Published: simulation with physics and a network for each joint (Retzler et al. 2024) is best; free
runs on the official 10 Hz set, another split, reach about 0.64.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from measured import (
    Array,
    Failed,
    bampipe,
    load,
    need,
    parse,
    processor_seconds,
    read,
    read_ladder,
    read_trial,
    run_free,
    store,
)
from robots import KR300_AXES, KR300_ZERO, kr300_device, write_session
from scipy.io import loadmat

from bampipe.errors import InputError
from bampipe.physics import System
from bampipe.trials.motion import Motion

RATE, BAND_HZ = 250.0, 10.0
STARTS, HORIZONS = 100, (75, 150)
RECORDS = ("training", "validation", "test")
COUNTERBALANCE = "counterbalance:axis_2"
SEARCH_S = 1800.0


def write_records(source: Path, drawing: Path, folder: Path) -> Path:
    """A session of the three records; validation and test are held out."""
    folder.mkdir(parents=True, exist_ok=True)
    found, trials = loadmat(source), {}
    for name in RECORDS:
        q = found[f"y_{name}"][:, :6].astype(float) + KR300_ZERO
        trials[name] = np.arange(len(q)) / RATE, q, found[f"u_{name}"].astype(float)
    device = kr300_device(drawing, uncertainty=1.0)
    write_session(folder, KR300_AXES, RATE, trials, device, held_out=RECORDS[1:])
    return folder


def error_of(run: Path, model: str, record: str) -> dict[str, float]:
    """Error of each joint on a record held out, per cent of its torque."""
    trial = read(run, model, "validate")["trials"][record]
    return {axis: trial[axis]["held_out_relative_error_percent"] for axis in KR300_AXES}


def simulate_from_starts(system: System, p: Array, motion: Motion, steps: int) -> dict[str, Any]:
    """RMSE over the steps from all starts, by the standard deviation of each joint."""
    starts = np.linspace(50, len(motion.t) - steps - 51, STARTS).astype(int)
    errors, straight, away, begin = [], [], 0, processor_seconds()
    for k in starts:
        q, later = motion.q[k], motion.q[k : k + steps + 1]
        straight.append(
            q + motion.qd[k] * (motion.t[k : k + steps + 1] - motion.t[k])[:, None] - later
        )
        try:
            found = run_free(system, p, motion, k, k + steps, q, motion.qd[k])
            errors.append(found[:, : q.size] - later)
        except InputError:
            away += 1
    spread = motion.q.std(axis=0)
    return {
        "normalised_rmse": list(np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0)) / spread),
        "velocity_kept": list(np.sqrt(np.mean(np.concatenate(straight) ** 2, axis=0)) / spread),
        "ran_away": away,
        "seconds": processor_seconds() - begin,
    }


def simulate_whole(system: System, p: Array, motion: Motion) -> dict[str, Any]:
    """The free run over the record, second by second, until it leaves twice its range."""
    n, begin, size = len(motion.t), processor_seconds(), round(RATE)
    q, qd, path = motion.q[0], motion.qd[0], [motion.q[:1]]
    spread, low, high = motion.q.std(axis=0), motion.q.min(axis=0), motion.q.max(axis=0)
    left = None
    for k in range(0, n - 1, size):
        end = min(k + size, n - 1)
        try:
            found = run_free(system, p, motion, k, end, q, qd)
        except InputError:
            left = float(motion.t[k])
            break
        q, qd = np.split(found[-1], 2)
        found = found[:, : q.size]
        path.append(found[1:])
        if np.any((found < 2.0 * low - high) | (found > 2.0 * high - low)):
            left = float(motion.t[end])
            break
    run = np.concatenate(path)
    error = np.sqrt(np.mean((run - motion.q[: len(run)]) ** 2, axis=0)) / spread
    return {
        "normalised_rmse": list(error), "mean": float(error.mean()), "left_after_s": left,
        "seconds": processor_seconds() - begin,
    }  # fmt: skip


def search(run: Path) -> str:
    """Add what the diagnosis finds beside the counterbalance; why not, where it cannot."""
    try:
        bampipe("extend", run, "--auto", most_s=SEARCH_S)
    except Failed as reason:
        return f"extend --auto: {reason}"
    return ""


def main() -> None:
    """Run all, print and store."""
    given, work = parse(
        __doc__, simple={"action": "store_true", "help": "neither counterbalance nor search"}
    )
    source = need(given.data / "kuka_kr300_60s") / "elabee_robot_ftsd.mat"
    drawing = need(given.data / "kuka_kr300" / "robot.toml")
    begin, session = processor_seconds(), write_records(source, drawing, work / "kr300")
    run, note = work / "runs" / session.name, "neither counterbalance nor search asked for"
    judged = ("--set", "validate.free_run=false", "--set", "validate.noise_floor=false")
    band = ("--set", f"filter.band_hz={BAND_HZ}", *judged, "--until", "validate")
    bampipe("run", session, "--runs", work / "runs", *band)
    if not given.simple:
        bampipe("extend", run, COUNTERBALANCE, "--model", "base")
        note = search(run)
    choice = [
        {"model": model, "added": added, "validation_percent": error_of(run, model, "validation")}
        for model, added in read_ladder(run)
    ]
    best = min(choice, key=lambda rung: sum(rung["validation_percent"].values()))
    model = best["model"]
    print(note, choice, flush=True)
    system, p = load(run, model)
    motion = read_trial(run, "test", system)
    result = {
        "note": note,
        "axes": KR300_AXES,
        "band_hz": BAND_HZ,
        "choice": choice,
        "model": model,
        "inverse_percent": error_of(run, model, "test"),
        "inverse_percent_bare": error_of(run, "base", "test"),
        "friction": {
            name: [entry["estimate"], entry["sd"]]
            for name, entry in read(run, model, "identify")["parameters"].items()
            if name.startswith(("viscous", "coulomb"))
        },
        "simulation": {str(k): simulate_from_starts(system, p, motion, k) for k in HORIZONS},
        "free_run": simulate_whole(system, p, motion),
        "seconds": processor_seconds() - begin,
    }
    print(store("kr300", result, given.out))


if __name__ == "__main__":
    main()
