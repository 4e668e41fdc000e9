"""Inverse dynamics, simulation and free run of a large arm: a minute each to fit, choose and test.

    python benchmarks/kr300.py [--data FOLDER]

FOLDER/kuka_kr300_60s has the recordings (Weigand et al. 2022, CC BY-SA 4.0), FOLDER/kuka_kr300 the
drawing of the same kind of arm (MIT). The load at the flange may differ, so that the drawn numbers
count within 10 %. Parameters come from the training record. Of the models (bodies and friction by
the drawing; with the counterbalance of axis 2, entered as a user would; with what `extend --auto`
adds to that), the error on the validation record chooses one. The test record is used once.

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
COUNTERBALANCE = "counterbalance:axis_2"
SEARCH_S = 1800.0


def write_records(source: Path, drawing: Path, folder: Path, held_out: str) -> Path:
    """A session of the training record and of one that is held out."""
    folder.mkdir(parents=True, exist_ok=True)
    found, trials = loadmat(source), {}
    for name in ("training", held_out):
        q = found[f"y_{name}"][:, :6].astype(float) + KR300_ZERO
        trials[name] = np.arange(len(q)) / RATE, q, found[f"u_{name}"].astype(float)
    device = kr300_device(drawing, uncertainty=0.1)
    write_session(folder, KR300_AXES, RATE, trials, device, held_out=[held_out])
    return folder


def held_out(run: Path, model: str) -> dict[str, float]:
    """Error of each joint on the record held out, per cent of its torque."""
    axes = read(run, model, "validate")["axes"]
    return {axis: found["held_out_relative_error_percent"] for axis, found in axes.items()}


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


def main() -> None:
    """Run all, print and store."""
    given, work = parse(__doc__)
    source = need(given.data / "kuka_kr300_60s") / "elabee_robot_ftsd.mat"
    drawing = need(given.data / "kuka_kr300" / "robot.toml")
    common = ("--runs", work / "runs")
    band = ("--set", f"filter.band_hz={BAND_HZ}", "--until", "validate")
    session = write_records(source, drawing, work / "choose", "validation")
    run, note = work / "runs" / "choose", ""
    begin = processor_seconds()
    bampipe("run", session, *common, *band)
    bampipe("extend", run, COUNTERBALANCE, "--model", "base")
    try:
        bampipe("extend", run, "--auto", most_s=SEARCH_S)
    except Failed as reason:
        note = f"extend --auto: {reason}"
    seconds = processor_seconds() - begin
    ladder = read_ladder(run)
    choice = [
        {"model": model, "added": added, "validation_percent": held_out(run, model)}
        for model, added in ladder
    ]
    best = min(range(len(choice)), key=lambda k: sum(choice[k]["validation_percent"].values()))
    print(note, choice, flush=True)

    session = write_records(source, drawing, work / "once", "test")
    once, model = work / "runs" / "once", "base"
    bampipe("run", session, *common, *band)
    for name, added in ladder[1 : best + 1]:
        bampipe("extend", once, *added, "--model", model)
        model = name
    system, p = load(once, model)
    motion = read_trial(once, "test", system)
    simulations = {str(k): simulate_from_starts(system, p, motion, k) for k in HORIZONS}
    result = {
        "seconds": seconds,
        "note": note,
        "axes": KR300_AXES,
        "band_hz": BAND_HZ,
        "choice": choice,
        "model": model,
        "inverse_percent": held_out(once, model),
        "inverse_percent_bare": held_out(once, "base"),
        "simulation": simulations,
        "free_run": simulate_whole(system, p, motion),
        "diagnosis": {
            axis: [found["verdict"], found["probabilities"]]
            for axis, found in read(run, choice[1]["model"], "diagnose")["axes"].items()
        }
        if not note
        else {},
    }
    print(store("kr300", result, given.out))


if __name__ == "__main__":
    main()
