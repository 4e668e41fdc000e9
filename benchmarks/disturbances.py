"""What a hit, a dead sensor, a warm-up or wild readings make of estimates and verdicts.

    python benchmarks/disturbances.py --machines bam joint axis damper --seeds 1 2 --diagnose

Each session of an independent simulator is identified as it was recorded and with its first two
trials spoilt, one way after the other. Printed are the stretches that `filter` leaves out, how far
the spoilt sessions' estimates are from the unspoilt one's in its standard deviations, error over
noise floor, and, with ``--diagnose``, the verdict.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import independent
import numpy as np
import pandas as pd
from independent.sensors import Conditions

import bampipe
from bampipe.data.run_folder import RunFolder
from bampipe.phrases.diagnosis import verdict
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.filter import FilterResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.validate import ValidateResult

DRIVES = {"bam": "force_x_v", "joint": "i", "axis": "u", "damper": "f"}
"""By machine: the column of the force that is spoilt."""
EFFECTS = {
    "bam": ("", "stribeck:yaw"),
    "joint": ("", "load_dependent_friction:joint"),
    "axis": ("", "asymmetric_coulomb:carriage"),
    "damper": ("", "quadratic_drag:piston"),
}
STAGES = 'schema = "bampipe.pipeline/1"\nname = "short"\nstages = [{stages}]\n'


def hit(force: np.ndarray, rate: float, rng: np.random.Generator) -> None:
    """A half sine of 80 ms, five times the force, that no encoder shows."""
    count = max(3, round(0.08 * rate))
    start = int(rng.integers(force.size // 4, force.size // 2))
    size = 5.0 * np.std(force)
    force[start : start + count] += size * np.sin(np.pi * (np.arange(count) + 0.5) / count)


def dead(force: np.ndarray, rate: float, rng: np.random.Generator) -> None:
    """A second in which the reading does not change."""
    start = int(rng.integers(force.size // 4, force.size // 2))
    force[start : start + round(rate)] = force[start]


def warm_up(force: np.ndarray, rate: float, rng: np.random.Generator) -> None:
    """An offset of twice the force that decays within 0.5 s of the start."""
    del rng
    force += 2.0 * np.std(force) * np.exp(-np.arange(force.size) / (0.5 * rate))


def wild(force: np.ndarray, rate: float, rng: np.random.Generator) -> None:
    """Six single readings off by three to ten times the force."""
    del rate
    at = rng.integers(10, force.size - 10, 6)
    force[at] += rng.choice([-1.0, 1.0], 6) * rng.uniform(3.0, 10.0, 6) * np.std(force)


SPOILT: dict[str, Callable[[np.ndarray, float, np.random.Generator], None]] = {
    "hit": hit,
    "dead": dead,
    "warm_up": warm_up,
    "wild": wild,
}


@dataclass(frozen=True)
class Outcome:
    """What one session gave: values, standard deviations, error over floor, stretches, verdict."""

    value: np.ndarray
    sd: np.ndarray
    ratio: float
    left_out: tuple[str, ...]
    verdict: str


def spoil(folder: Path, machine: str, how: str, seed: int) -> None:
    """Spoil the first trial, a hit, a dead second and wild readings the second one too."""
    files = sorted(folder.rglob("*.csv"))[: 1 if how == "warm_up" else 2]
    for number, path in enumerate(files):
        table = pd.read_csv(path)
        clock = table.columns[0]
        seconds = table[clock].to_numpy(float) * (1e-6 if clock.endswith("us") else 1.0)
        force = table[DRIVES[machine]].to_numpy(float, copy=True)
        rate = 1.0 / float(np.median(np.diff(seconds)))
        SPOILT[how](force, rate, np.random.default_rng([seed, number]))
        table[DRIVES[machine]] = force
        table.to_csv(path, index=False)


def run(folder: Path, diagnose: bool) -> Outcome:
    """Identify and judge a session."""
    stages = ["ingest", "filter", "identify", "validate", *(["diagnose"] if diagnose else [])]
    pipeline = folder.parent / "short.toml"
    names = ", ".join(f'"{stage}"' for stage in stages)
    pipeline.write_text(STAGES.format(stages=names), encoding="utf-8")
    runs = folder.parent / "runs"
    bampipe.run_session(folder, runs=runs, pipeline=str(pipeline))
    opened = RunFolder(runs / folder.name)
    parameters = opened.read(IdentifyResult, "base").parameters.values()
    axes = opened.read(ValidateResult, "base").axes.values()
    return Outcome(
        np.array([one.estimate for one in parameters]),
        np.array([one.sd for one in parameters]),
        max(axis.held_out_rmse / axis.noise_floor for axis in axes if axis.noise_floor),
        tuple(
            f"{trial} {one.start_s:.1f}-{one.end_s:.1f}"
            for trial, stretches in opened.read(FilterResult).disturbances.items()
            for one in stretches
        ),
        _verdicts(opened.read(DiagnoseResult, "base")) if diagnose else "",
    )


def _verdicts(found: DiagnoseResult) -> str:
    return "; ".join(f"{axis}: {verdict(found, axis)}" for axis in found.axes)


def compare(machine: str, effect: str, seed: int, diagnose: bool) -> list[str]:
    """One line for the session as it was recorded, one for each way to spoil it."""
    lines = []
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch)
        conditions = Conditions(trials=4, seconds=10.0)
        independent.record(
            machine, root / machine, seed, {effect: 1.0} if effect else {}, conditions
        )
        sound = run(root / machine, diagnose)
        for how in ("sound", *SPOILT):
            found = sound
            if how != "sound":
                folder = root / f"{machine}_{how}"
                shutil.copytree(root / machine, folder)
                text = (folder / "session.toml").read_text(encoding="utf-8")
                text = text.replace(f'session_id = "{machine}"', f'session_id = "{folder.name}"')
                (folder / "session.toml").write_text(text, encoding="utf-8")
                spoil(folder, machine, how, seed)
                found = run(folder, diagnose)
            moved = float(np.abs((found.value - sound.value) / sound.sd).max())
            same = "" if found.verdict == sound.verdict else "  OTHER VERDICT"
            lines.append(
                f"{machine:7s} {effect or 'nothing':30s} {seed:4d} {how:8s} {moved:8.2f} sd"
                f" {found.ratio:7.2f} floors  {'; '.join(found.left_out) or '-'}"
                f"  {found.verdict}{same}"
            )
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machines", nargs="+", default=list(DRIVES), choices=list(DRIVES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--diagnose", action="store_true")
    parser.add_argument("--jobs", type=int, default=2)
    chosen = parser.parse_args(arguments)
    cases = [
        (machine, effect, seed, chosen.diagnose)
        for seed in chosen.seeds
        for machine in chosen.machines
        for effect in EFFECTS[machine]
    ]
    with ProcessPoolExecutor(chosen.jobs) as pool:
        for lines in pool.map(compare, *zip(*cases, strict=True)):
            print("\n".join(lines), flush=True)


if __name__ == "__main__":
    sys.exit(main())
