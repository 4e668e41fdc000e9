"""Where the time of a diagnosis goes: CPU time by function, in one process.

    bampipe simulate sessions/s01 --seed 1 && bampipe run sessions/s01 --until validate
    python benchmarks/diagnosis_profile.py runs/s01

Time is that of the process and everything it calls; a function's includes that of the functions
below it. The profiler itself makes Python code slower, and compiled code not at all.
"""

from __future__ import annotations

import argparse
import cProfile
import io
import pstats
import sys
import time
from contextlib import redirect_stdout, suppress
from pathlib import Path

SHARE = 0.02
"""Functions below this share of the whole are left out."""


def profile(run: str) -> pstats.Stats:
    """Diagnose ``run`` in this process under the profiler."""
    from bampipe.cli import main

    sys.argv = ["bampipe", "diagnose", run, "--force", "--quiet", "--set", "jobs=1"]
    profiler = cProfile.Profile(time.process_time)
    with redirect_stdout(io.StringIO()), suppress(SystemExit):
        profiler.runcall(main)
    return pstats.Stats(profiler)


def main() -> None:
    """Parse the arguments and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", help="run folder, validated")
    stats = profile(parser.parse_args().run)
    entries = stats.stats.items()  # type: ignore[attr-defined]
    total = float(stats.total_tt)  # type: ignore[attr-defined]
    print(f"{total:.1f} s of CPU in all\n")
    print("| function | calls | CPU, s | share |")
    print("|-|-|-|-|")
    rows = [
        (cumulative, f"{Path(file).stem}.{name}", calls)
        for (file, _, name), (_, calls, _, cumulative, _) in entries
        if any(f"/bampipe/{room}/" in file for room in ("diagnosis", "trials"))
        and cumulative > SHARE * total
        and "<" not in name
    ]
    for cumulative, name, calls in sorted(rows, reverse=True):
        print(f"| `{name}` | {calls} | {cumulative:.1f} | {100 * cumulative / total:.0f} % |")


if __name__ == "__main__":
    main()
