"""Estimators side by side on simulated sessions of known truth.

The unscented filter and least squares, with and without the likelihood's weights, estimate friction
and mass of the BAM from the same sessions, made by `bampipe simulate` with fresh seeds:
bias, standard deviation, how often the stated 95 % interval holds the truth, seconds.

``python benchmarks/estimators.py [--sessions N]``
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bampipe.data.run_folder import RunFolder
from bampipe.files import read_json, write_text
from bampipe.physics import Model, compile_model, registry
from bampipe.progress import silent
from bampipe.simulator import simulated_session as simulate
from bampipe.stages import filter as filter_stage
from bampipe.stages import identify, ingest

Array = NDArray[np.float64]

MODEL = 'schema = "bampipe.model/1"\nname = "base"\ndevice = "bam"\neffects = []\n'
BY_STAGE = {
    "published": {},
    "unscented filter": {"method": "ukf"},
    "least squares": {"method": "least-squares"},
    "least squares, all samples alike": {"method": "least-squares", "remove_bias": False},
}


@dataclass(frozen=True)
class Found:
    """Estimates and standard deviations of one estimator, and what it took, s."""

    value: Array
    sd: Array
    seconds: float


def prepare(root: Path, config: simulate.Config) -> tuple[RunFolder, dict[str, float]]:
    """Simulate a session up to the filter stage; return it, with a base model, and the truth."""
    simulate.simulate_session(root / "session", config, silent)
    run = RunFolder(root / "run")
    for folder in ("ingest", "filter", "models/base"):
        run.path(folder).mkdir(parents=True)
    ingest.execute(run, run.root, ingest.Config(session=str(root / "session")), silent)
    filter_stage.execute(run, run.root, filter_stage.Config(), silent)
    write_text(run.path("models/base/model.toml"), MODEL)
    truth: dict[str, float] = read_json(root / "session.truth.json")["parameters"]
    return run, truth


def by_stage(run: RunFolder, names: Sequence[str], settings: dict[str, object]) -> Found:
    """What `bampipe identify` finds."""
    begun = time.process_time()
    found = identify.execute(run, run.root, identify.Config(**settings), silent)["parameters"]
    seconds = time.process_time() - begun
    return Found(
        np.array([found[name]["estimate"] for name in names]),
        np.array([found[name]["sd"] for name in names]),
        seconds,
    )


def main() -> None:
    """Estimate every session by every method and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--sessions", type=int, default=8)
    parser.add_argument("--seed", type=int, default=7000, help="of the first session")
    parser.add_argument("--trials", type=int, default=3)
    parser.add_argument("--duration", type=float, default=10.0)
    chosen = parser.parse_args()
    system = compile_model(Model(registry.device("bam")))
    names = [item.name for item in system.parameters]
    errors: dict[str, list[Array]] = defaultdict(list)
    found: dict[str, list[Found]] = defaultdict(list)
    for seed in range(chosen.seed, chosen.seed + chosen.sessions):
        with tempfile.TemporaryDirectory() as folder:
            config = simulate.Config(seed=seed, trials=chosen.trials, duration=chosen.duration)
            run, report_progress = prepare(Path(folder), config)
            truth = np.array([report_progress[name] for name in names])
            results = {label: by_stage(run, names, dict(s)) for label, s in BY_STAGE.items()}
        for label, one in results.items():
            errors[label].append((one.value - truth) / truth)
            found[label].append(replace(one, sd=one.sd / truth))
            within = int(np.sum(np.abs(errors[label][-1]) < 1.96 * found[label][-1].sd))
            print(
                f"{seed} {label}: {within} of {len(names)} within, {one.seconds:.1f} s", flush=True
            )
    print(f"\nload {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores\n")
    print("| estimator | bias, % | standard deviation, % | stated, % | 95 % interval holds | s |")
    print("|-|-|-|-|-|-|")
    for label, rows in errors.items():
        error = 100.0 * np.array(rows)
        sd = 100.0 * np.array([one.sd for one in found[label]])
        held = np.mean(np.abs(error) < 1.96 * sd)
        bias = np.sqrt(np.mean(np.square(error.mean(axis=0))))
        spread = np.sqrt(np.mean(np.square(error.std(axis=0, ddof=1))))
        seconds = np.median([one.seconds for one in found[label]])
        print(
            f"| {label} | {bias:.3f} | {spread:.3f} | {np.sqrt(np.mean(np.square(sd))):.3f} "
            f"| {100 * held:.0f} % of {error.size} | {seconds:.1f} |"
        )
    print("\n| bias, % | " + " | ".join(names) + " |\n|-|" + "-|" * len(names))
    for label, rows in errors.items():
        means = 100.0 * np.mean(rows, axis=0)
        print(f"| {label} | " + " | ".join(f"{value:+.3f}" for value in means) + " |")


if __name__ == "__main__":
    main()
