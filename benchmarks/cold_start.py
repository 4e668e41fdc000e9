"""Cold start: when each result of a first run appears, with nothing compiled, and once compiled.

    python benchmarks/cold_start.py

Both caches are put in an empty folder; the same run is then repeated, into another run folder, with
what the first one compiled. Processor time is that of all processes of the run.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SESSION = Path(__file__).parents[1] / "sample_runs/first"
RESULTS = {
    "ingest": "ingest/session.json",
    "filter": "filter/filter.json",
    "stiffness": "stiffness/stiffness.json",
    "identify": "models/base/identify.json",
}


def measured(session: Path, runs: Path, environment: dict[str, str]) -> tuple[list[float], float]:
    """Run up to identify; return when each result appeared and the processor time, s."""
    start = time.perf_counter()
    command = [sys.executable, "-m", "bampipe", "run", str(session), "--until", "identify"]
    process = subprocess.Popen(
        [*command, "--runs", str(runs), "--quiet"], env=environment, stdout=subprocess.DEVNULL
    )
    seen: dict[str, float] = {}
    while True:
        ended, status, usage = os.wait4(process.pid, os.WNOHANG)
        for stage, name in RESULTS.items():
            if stage not in seen and any(runs.glob(f"*/{name}")):
                seen[stage] = time.perf_counter() - start
        if ended:
            break
        time.sleep(0.02)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode or len(seen) < len(RESULTS):
        raise SystemExit(f"exit {process.returncode}, results of {', '.join(seen) or 'no stage'}")
    return [seen[stage] for stage in RESULTS], usage.ru_utime + usage.ru_stime


def main() -> None:
    """Parse the arguments and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--session", type=Path, default=SESSION)
    given = parser.parse_args()
    print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print(f"| | {', s | '.join(RESULTS)}, s | processor time, s |")
    print("|-|" + "-|" * (len(RESULTS) + 1), flush=True)
    with tempfile.TemporaryDirectory() as name:
        caches = {"BAMPIPE_CACHE_DIR": f"{name}/code", "NUMBA_CACHE_DIR": f"{name}/compiled"}
        for title in ("nothing compiled", "compiled"):
            runs = Path(name) / title.replace(" ", "_")
            times, processor = measured(given.session, runs, {**os.environ, **caches})
            row = " | ".join(f"{value:.1f}" for value in times)
            print(f"| {title} | {row} | {processor:.1f} |", flush=True)


if __name__ == "__main__":
    main()
