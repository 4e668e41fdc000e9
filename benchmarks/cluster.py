"""Scaling over Dask workers: the same sessions on one worker process and on two, on loopback.

    python benchmarks/cluster.py --sessions 8 --workers 1 2

Wall time says something only where every worker has a core to itself; the CPU time of the workers
and their largest resident memory count on any machine. Compiled code is warm.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bampipe.run import pipeline
from bampipe.run.cluster import run_on_cluster
from bampipe.run.events import ignore_event
from bampipe.run.request import Request


def cost() -> tuple[float, float]:
    """CPU time, s, and largest resident memory, MB, of the process that calls it."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0


def bampipe(*arguments: str, folder: Path) -> None:
    """Run a command in ``folder``."""
    command = [sys.executable, "-m", "bampipe", *arguments]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)


def measure(folder: Path, sessions: int, workers: int) -> None:
    """Run the sessions on a fresh cluster of so many workers and print a row."""
    from distributed import Client, LocalCluster

    chosen = pipeline.load("default")
    requests = [
        Request(folder / f"runs{workers}" / f"s{n:02d}", chosen, session=folder / f"s{n:02d}")
        for n in range(sessions)
    ]
    with (
        LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        client.wait_for_workers(workers)
        before = sum(cpu for cpu, _ in client.run(cost).values())
        start = time.perf_counter()
        outcomes = run_on_cluster(requests, cluster.scheduler_address, ignore_event)
        wall = time.perf_counter() - start
        used = client.run(cost).values()
    bad = [outcome.error for outcome in outcomes if outcome.state != "done"]
    if bad:
        raise SystemExit(bad[0])
    cpu, memory = sum(cpu for cpu, _ in used) - before, max(memory for _, memory in used)
    print(f"| {workers} | {sessions} | {wall:.1f} | {cpu:.1f} | {cpu / wall:.2f} | {memory:.0f} |",
          flush=True)  # fmt: skip


def main() -> None:
    """Parse the arguments and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=8)
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2])
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for n in range(given.sessions):
            bampipe("simulate", f"s{n:02d}", "--seed", str(n), "--file-format", "parquet",
                    folder=folder)  # fmt: skip
        bampipe("run", "s00", "--runs", "warm", folder=folder)
        print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
        print("| workers | sessions | wall, s | CPU, s | cores used | peak memory a worker, MB |")
        print("|-|-|-|-|-|-|")
        for workers in given.workers:
            measure(folder, given.sessions, workers)


if __name__ == "__main__":
    main()
