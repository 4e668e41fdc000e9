"""What trials say of the width of the smoothed sign, where friction stops a machine or yields.

    python benchmarks/chosen_sign_width.py damper --seed 12011 --stop
    python benchmarks/chosen_sign_width.py damper --seed 12301 --conditions "mains hum" jitter
    python benchmarks/chosen_sign_width.py axis --seed 12401 --creep

Each session of an independent simulator hides nothing or one effect of its own. The bare device is
fitted by least squares with several widths, times that of the device file; printed is by how much
the log of the error on trials left out falls. `identify` takes a narrower width on a test bench
where an eighth lowers it by `LEAST_DROP` of `bampipe.diagnosis.start`.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from independent import MACHINES, record
from independent.sensors import GOOD, HARD, Conditions

import bampipe
from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model_file import load_model, read_spec
from bampipe.diagnosis.session import system_of
from bampipe.diagnosis.start import fit_width
from bampipe.trials.measured import read_measured_trials

WIDTHS = (1.0 / 3.0, 1.0 / 8.0, 1.0 / 32.0)
PIPELINE = """schema = "bampipe.pipeline/1"
name = "widths"
stages = ["ingest", "filter", "identify"]

[settings.identify]
method = "least-squares"
"""


def find_drops(machine: str, seed: int, effect: str, conditions: Conditions) -> list[float]:
    """Drop of the log error on trials left out, over all axes, by width."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        record(machine, root / "session", seed, {effect: 1.0} if effect else {}, conditions)
        (root / "widths.toml").write_text(PIPELINE)
        pipeline = str(root / "widths.toml")
        session = bampipe.run_session(root / "session", runs=root / "runs", pipeline=pipeline)
        run = RunFolder(Path(session.root))
        spec = read_spec(run, "base", load_model(run, "base", as_declared=True))
        trials = read_measured_trials(run, system_of(spec), every_input=True)
        declared = fit_width(trials, spec, 1.0)
        count, error = declared.problem.independent, declared.held_out_rmse
        return [
            float(count @ np.log(error / one.held_out_rmse) / count.sum())
            for one in (fit_width(trials, spec, width) for width in WIDTHS)
        ]


def main() -> None:
    """Parse the arguments and print a line a session."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("machine", choices=[name for name in MACHINES if name != "bam"])
    parser.add_argument("--seed", type=int, default=12301, help="of the first session")
    parser.add_argument("--conditions", nargs="*", default=["good"], choices=["good", *HARD])
    parser.add_argument("--pace", type=float, default=1.0)
    parser.add_argument("--stop", action="store_true", help="the damper's friction truly stops it")
    parser.add_argument("--creep", action="store_true", help="dry friction smoothed, as in bampipe")
    options = parser.parse_args()
    machine = MACHINES[options.machine]
    effects = (*machine.EFFECTS, *machine.UNKNOWN, *getattr(machine, "BY_NAME", ()), "")
    seed, largest = options.seed, -np.inf
    for day in options.conditions:
        conditions = replace(
            HARD.get(day, GOOD), stop=options.stop, creep=options.creep, pace=options.pace
        )
        for effect in effects:
            drops = find_drops(options.machine, seed, effect, conditions)
            shown = "  ".join(f"{drop:+.3f}" for drop in drops)
            print(f"{options.machine} {day} {seed} | {effect or 'nothing':32s} {shown}", flush=True)
            seed, largest = seed + 1, max(largest, drops[1])
    print(f"largest at an eighth: {largest:+.3f}")


if __name__ == "__main__":
    sys.exit(main())
