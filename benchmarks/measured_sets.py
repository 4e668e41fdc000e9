"""One table of measured machines, the same commands for all: how far, what is named, what is left.

    python benchmarks/measured_sets.py [--data FOLDER] [--cases FOLDER] [--only NAME ...]

Each set is a folder of logs as its authors store them (`bampipe init` writes its session), or a
session of a recipe in `robots.py` and here. Then, for every set alike:

    bampipe run SESSION --until validate
    bampipe extend RUN --auto

Per axis: held-out error without and with what was named, the noise floor, verdict and
probabilities; and a bound that knows no mechanics, `find_flexible_error`. A set that refuses, or
takes longer than `--most` seconds, is a row with that reason. Results are stored after each set.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from emps import write_session as write_emps
from measured import (
    RESULTS,
    ROOT,
    Array,
    Failed,
    bampipe,
    parse,
    processor_seconds,
    read,
    read_ladder,
    rms,
    store,
)
from robots import BAND_HZ, dfki_double_pendulum, kuka_kr300, staubli_tx40, tiago
from scipy.spatial.distance import cdist

WriteSession = Callable[[Path, Path], object]
CASES = ROOT.parent / "shared" / "cases" / "data"
HELD_OUT_GAIN, FULL_DUTY = 200, 885.0
FOLDS, CENTRES, RIDGE = 5, 300, 1e-2


def take_logs(source: Path, folder: Path) -> None:
    """Logs as they are; `bampipe init` writes what is missing beside them."""
    for path in sorted(source.rglob("*")):
        if path.is_file() and "known" not in path.parts and path.name != "SOURCE.md":
            shutil.copy(path, folder / path.name)
            (folder / path.name).chmod(0o644)


def servo_pendulum(source: Path, folder: Path) -> None:
    """Logs of a servo; one gain is held out, and logs in which it is let go are left out."""
    held = []
    for log in sorted((source / "raw").glob("*.json")):
        content = json.loads(log.read_text(encoding="utf-8"))
        if all(entry["torque_enable"] for entry in content["entries"]):
            shutil.copy(log, folder / log.name)
            held += [log.name] if content["kp"] == HELD_OUT_GAIN else []
    text = (
        f'schema = "bampipe.session/1"\nsession_id = "{folder.name}"\ndevice = "servo_pendulum"\n'
        'sample_rate_hz = 188.0\n[time]\ncolumn = "timestamp"\nunit = "s"\n[encoders]\n'
        'joint = { column = "position", unit = "rad", resolution = 1.5339807878853584e-3 }\n'
        f'[channels]\nduty = {{ column = "load", unit = "", scale = {1.0 / FULL_DUTY!r},'
        ' wrap_bits = 16 }\nsupply = { column = "input_volts", unit = "V" }\n'
    )
    for path in sorted(folder.glob("*.json")):
        text += f'[[trials]]\nfile = "{path.name}"\nkind = "free"\n'
        text += "hold_out = true\n" if path.name in held else ""
    (folder / "session.toml").write_text(text, encoding="utf-8")


SETS: dict[str, tuple[str, WriteSession]] = {
    "joint_2": ("robot_joints/joint_2", take_logs),
    "joint_5": ("robot_joints/joint_5", take_logs),
    "emps": ("emps", write_emps),
    "servo_pendulum": ("servo_pendulum", servo_pendulum),
    "mr_damper_shaking_table": ("", take_logs),
    "brfd_friction_damper": ("", take_logs),
    "pneumatic_cylinder_friction": ("", take_logs),
    "odrive_motor_voltage": ("", take_logs),
    "uart_servo_backlash": ("", take_logs),
    "dfki_double_pendulum": ("dfki_double_pendulum", dfki_double_pendulum),
    "staubli_tx40": ("staubli_tx40", staubli_tx40),
    "kuka_kr300": ("kuka_kr300", kuka_kr300),
    "rokae_ar5_arm": ("", take_logs),
    "kuka_med7_arm": ("", take_logs),
    "tiago": ("tiago", tiago),
}
"""Name: folder below --data, else of that name below --cases; and its recipe."""


def find_flexible_error(run: Path, axis: str) -> float:
    """Error that a kernel regression leaves of an axis' held-out residual, unit of the torque.

    Position, speed, acceleration and predicted torque of the axis; Gaussian kernels about
    `CENTRES` samples, ridge `RIDGE`; folds over trials, or over stretches of a few trials. It is
    no lower bound: an effect with memory, or of another axis, may leave less.
    """
    left = pd.read_parquet(run / "models/base/residuals.parquet")
    motion = pd.read_parquet(run / "filter/kinematics.parquet")
    both = left.merge(motion, on=["trial_id", "t"], suffixes=("", "_motion"))
    y = (both[f"torque_measured_{axis}"] - both[f"torque_predicted_{axis}"]).to_numpy()
    names = [f"{what}_{axis}" for what in ("q", "qd", "qdd", "torque_predicted")]
    x = both[names].to_numpy()
    x = (x - x.mean(axis=0)) / (x.std(axis=0) + 1e-12)
    known = np.isfinite(y) & np.isfinite(x).all(axis=1) & both["held_out"].to_numpy(dtype=bool)
    x, y, trial = x[known], y[known], both["trial_id"].to_numpy()[known]
    names_of = np.unique(trial)
    fold = np.searchsorted(names_of, trial) % FOLDS
    if len(names_of) < FOLDS:
        fold = np.arange(len(y)) * 4 * FOLDS // len(y) % FOLDS
    rng, predicted = np.random.default_rng(0), np.zeros_like(y)
    for k in range(FOLDS):
        seen = np.flatnonzero(fold != k)
        centres = x[rng.choice(seen, min(CENTRES, len(seen)), replace=False)]
        seen = rng.choice(seen, min(20_000, len(seen)), replace=False)
        width = float(np.median(cdist(centres[:100], centres[:100]))) / 2.0
        on, held = (_kernels(x[rows], centres, width) for rows in (seen, fold == k))
        normal = on.T @ on + RIDGE * len(seen) * np.eye(len(centres)) / len(centres)
        predicted[fold == k] = held @ np.linalg.solve(normal, on.T @ y[seen])
    return rms(y - predicted)


def _kernels(x: Array, centres: Array, width: float) -> Array:
    return np.asarray(np.exp(-0.5 * cdist(x, centres, "sqeuclidean") / width**2))


def measure(source: Path, write: WriteSession, folder: Path, most_s: float) -> dict[str, Any]:
    """The row of one set."""
    folder.mkdir(parents=True)
    write(source, folder)
    runs, run = folder.parent / "runs", folder.parent / "runs" / folder.name
    begin, row = processor_seconds(), {"note": ""}
    try:
        if not (folder / "session.toml").exists():
            bampipe("init", folder, most_s=most_s)
        band = BAND_HZ.get(folder.name)
        setting = ("--set", f"filter.band_hz={band}") if band else ()
        bampipe("run", folder, "--runs", runs, "--until", "validate", *setting, most_s=most_s)
        row["seconds_run"] = processor_seconds() - begin
        row["axes"] = describe(run, run_is_extended=False)
        bampipe("extend", run, "--auto", most_s=most_s)
        row["axes"] = describe(run, run_is_extended=True)
        row["ladder"] = [[model, added] for model, added in read_ladder(run)]
    except Failed as reason:
        row["note"] = str(reason).removeprefix("bampipe: error: ").replace(f"{folder}/", "")
    return row | {"seconds": processor_seconds() - begin}


def describe(run: Path, *, run_is_extended: bool) -> dict[str, dict[str, Any]]:
    """What is known of each axis; errors in per cent of the measured torque."""
    bare, found = read(run, "base", "validate")["axes"], {}
    last = read_ladder(run)[-1][0] if run_is_extended else "base"
    after = read(run, last, "validate")["axes"]
    verdicts = read(run, "base", "diagnose")["axes"] if run_is_extended else {}
    for axis, entry in bare.items():
        per_cent = entry["held_out_relative_error_percent"] / (entry["held_out_rmse"] or 1.0)
        floor = after[axis]["noise_floor"]
        found[axis] = {
            "bare_percent": entry["held_out_relative_error_percent"],
            "after_percent": after[axis]["held_out_relative_error_percent"],
            "floor_percent": None if floor is None else per_cent * floor,
            "flexible_percent": per_cent * find_flexible_error(run, axis),
            "verdict": verdicts.get(axis, {}).get("verdict"),
            "probabilities": verdicts.get(axis, {}).get("probabilities", {}),
            "unknown": verdicts.get(axis, {}).get("unknown"),
        }
    return found


def main() -> None:
    """Measure each set, and store after each."""
    given, work = parse(
        __doc__,
        cases={"type": Path, "default": CASES, "help": "folder of the logs of strangers"},
        only={"nargs": "*", "choices": SETS, "default": [], "help": "sets; all where empty"},
        most={"type": float, "default": 1800.0, "help": "seconds that one command may take"},
    )
    path = given.out or RESULTS / "measured_sets.json"
    rows = json.loads(path.read_text(encoding="utf-8"))["result"] if path.exists() else {}
    for name in given.only or SETS:
        below, write = SETS[name]
        source = given.data / below if below else given.cases / name
        if not source.is_dir():
            print(f"{name}: skipped, {source} is not here")
            continue
        shutil.rmtree(work / name, ignore_errors=True)
        rows[name] = measure(source, write, work / name / name, given.most)
        print(name, json.dumps(rows[name]), flush=True)
        store("measured_sets", {key: rows[key] for key in SETS if key in rows}, path)


if __name__ == "__main__":
    main()
