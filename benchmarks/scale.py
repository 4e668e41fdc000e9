"""Growth: CPU time and peak memory of every stage against samples, and of a batch against sessions.

    python benchmarks/scale.py --samples 1e5 3e5 1e6 --sessions 1 10 50

Each stage runs in a process of its own, whose CPU time and largest resident memory are read when
it ends (``wait4``). CPU time is what counts on a machine that does other work too; wall time stands
beside it. A long session holds one simulated session's trials over and over: what grows is
the number of trials, as it does in a lab. Compiled code is warm.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

STAGES = ("ingest", "filter", "stiffness", "identify", "validate", "compare", "report")
RATE_HZ = 500.0


@dataclass(frozen=True)
class Cost:
    """Of one process: CPU and wall time, s, and largest resident memory, MB."""

    cpu: float
    wall: float
    memory: float


def measured(*arguments: str, folder: Path) -> Cost:
    """Run ``bampipe ARGUMENTS`` in ``folder``."""
    start = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "bampipe", *arguments],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    assert process.stderr is not None
    said = process.stderr.read().decode()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 1):
        raise SystemExit(f"bampipe {' '.join(arguments)}: exit {process.returncode}\n{said}")
    wall = time.perf_counter() - start
    return Cost(usage.ru_utime + usage.ru_stime, wall, usage.ru_maxrss / 1024.0)


def simulate(folder: Path, trials: int, seconds: float) -> Path:
    """One simulated session, Parquet logs."""
    measured(
        *("simulate", "session", "--seed", "1", "--trials", str(trials)),
        *("--duration", str(seconds), "--sample-rate", str(RATE_HZ), "--file-format", "parquet"),
        folder=folder,
    )
    return folder / "session"


def repeated(source: Path, target: Path, copies: int) -> Path:
    """A session with the trials of ``source`` so many times over.

    A file that is there twice counts once, so the force reading of each copy is shifted by a
    nanovolt: that changes the file and no result.
    """
    text = (source / "session.toml").read_text(encoding="utf-8")
    head, *trials = text.split("[[trials]]")
    target.mkdir(parents=True)
    (target / "trials").mkdir()
    blocks = [head.replace('session_id = "session"', f'session_id = "{target.name}"')]
    for copy in range(copies):
        for block in trials:
            name = block.split('file = "')[1].split('"')[0]
            new = f"trials/c{copy:04d}_{Path(name).name}"
            frame = pd.read_parquet(source / name)
            frame["force_x_v"] += 1e-9 * copy
            frame.to_parquet(target / new)
            blocks.append("[[trials]]" + block.replace(name, new))
    (target / "session.toml").write_text("".join(blocks), encoding="utf-8")
    return target


def by_samples(folder: Path, counts: list[int], stages: tuple[str, ...]) -> None:
    trial = 4000
    source = simulate(folder, 5, trial / RATE_HZ)
    measured("run", str(source), "--runs", "warm", folder=folder)
    print("| samples | stage | CPU, s | CPU a sample, µs | wall, s | peak memory, MB |")
    print("|-|-|-|-|-|-|")
    for count in counts:
        name = f"n{count}"
        session = repeated(source, folder / name, max(1, round(count / (5 * trial))))
        total, largest = 0.0, 0.0
        for stage in stages:
            argument = str(session) if stage == "ingest" else name
            cost = measured(stage, argument, "--quiet", folder=folder)
            total, largest = total + cost.cpu, max(largest, cost.memory)
            _row(count, stage, cost.cpu, cost.wall, cost.memory)
        print(f"| {count:.0e} | **all** | {total:.1f} | {1e6 * total / count:.0f} | "
              f"| {largest:.0f} |", flush=True)  # fmt: skip
        shutil.rmtree(session)
        shutil.rmtree(folder / "runs" / name)


def _row(count: int, stage: str, cpu: float, wall: float, memory: float) -> None:
    print(f"| {count:.0e} | {stage} | {cpu:.1f} | {1e6 * cpu / count:.0f} | {wall:.1f} "
          f"| {memory:.0f} |", flush=True)  # fmt: skip


def by_sessions(folder: Path, counts: list[int], jobs: int) -> None:
    """Batches of small sessions: two trials of four seconds."""
    source = simulate(folder, 2, 4.0)
    measured("run", str(source), "--runs", "warm", folder=folder)
    print("| sessions | jobs | CPU, s | CPU a session, s | wall, s | largest process, MB |")
    print("|-|-|-|-|-|-|")
    for count in counts:
        batch = folder / f"batch{count}"
        for number in range(count):
            repeated(source, batch / f"s{number:03d}", 1)
        cost = measured(
            *("run", f"{batch.name}/*", "--jobs", str(jobs), "--runs", f"{batch.name}-runs/runs"),
            *("--until", "compare", "--quiet"),
            folder=folder,
        )
        print(f"| {count} | {jobs} | {cost.cpu:.1f} | {cost.cpu / count:.2f} | {cost.wall:.1f} "
              f"| {cost.memory:.0f} |", flush=True)  # fmt: skip
        shutil.rmtree(batch)
        shutil.rmtree(folder / f"{batch.name}-runs")


def main() -> None:
    """Parse the arguments and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=float, nargs="*", default=[1e5, 3e5, 1e6])
    parser.add_argument("--stages", nargs="*", default=list(STAGES), choices=STAGES)
    parser.add_argument("--sessions", type=int, nargs="*", default=[1, 10, 50])
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--folder", type=Path, help="to work in; a temporary one if omitted")
    given = parser.parse_args()
    print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores", flush=True)
    with tempfile.TemporaryDirectory(dir=given.folder) as name:
        if given.samples:
            (Path(name) / "samples").mkdir()
            counts = [int(count) for count in given.samples]
            by_samples(Path(name) / "samples", counts, tuple(given.stages))
        if given.sessions:
            (Path(name) / "sessions").mkdir()
            by_sessions(Path(name) / "sessions", given.sessions, given.jobs)


if __name__ == "__main__":
    main()
