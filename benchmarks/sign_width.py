"""What the width of the smoothed sign of the velocity does to an identified friction.

    python benchmarks/sign_width.py --seeds 2 --factors 4 1 0.25

Records sessions of the independent simulator of the BAM whose friction falls with speed on all
three axes and truly stops them, identifies each with the right effects and the built-in device at
several widths, and prints how far the parameters of the effect are from the truth: relative, and in
their own standard deviations.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from importlib.resources import files
from pathlib import Path

import numpy as np
from independent import record
from independent.sensors import GOOD

import bampipe
from bampipe.data.run_folder import RunFolder
from bampipe.files import write_text
from bampipe.results.identify import IdentifyResult
from bampipe.results.validate import ValidateResult

EFFECTS = ("stribeck:yaw", "stribeck:pitch", "stribeck:extension")
PIPELINE = """schema = "bampipe.pipeline/1"
name = "widths"
stages = ["ingest", "filter", "identify", "validate"]
"""


def widen(session: Path, factor: float) -> None:
    """Give a session the built-in device with its widths times ``factor``."""
    built_in = (files("bampipe.physics") / "devices" / "bam.toml").read_text(encoding="utf-8")
    device = re.sub(
        r"sign_width = (\S+)", lambda m: f"sign_width = {factor * float(m[1]):g}", built_in
    ).replace('name = "bam"', 'name = "bam_widened"')
    write_text(session / "device.toml", device)
    stated = (session / "session.toml").read_text(encoding="utf-8")
    write_text(session / "session.toml", stated.replace('"bam"', '"device.toml"', 1))


def study(folder: Path, seed: int, factor: float) -> None:
    """Print one line: errors of the effects' parameters at one width."""
    session = folder / f"s{seed}_{factor:g}"
    truth = record("bam", session, seed, dict.fromkeys(EFFECTS, 1.0), GOOD)["parameters"]
    widen(session, factor)
    write_text(folder / "widths.toml", PIPELINE)
    run = bampipe.run_session(session, runs=folder / "runs", pipeline=str(folder / "widths.toml"))
    bampipe.extend(run, EFFECTS, model="base")
    model = "+".join(["base", *(effect.replace(":", ".") for effect in EFFECTS)])
    folder_of_run = RunFolder(Path(run.root))
    found = folder_of_run.read(IdentifyResult, model).parameters
    validated = folder_of_run.read(ValidateResult, model).axes
    for kind in ("force", "speed"):
        names = [f"{effect.replace(':', '.')}.{kind}" for effect in EFFECTS]
        off = [100.0 * (found[n].estimate / truth[n] - 1.0) for n in names]
        sds = [(found[n].estimate - truth[n]) / found[n].sd for n in names]
        print(f"{seed} {factor:5g} {kind:6s} % {np.round(off, 1)}  sd {np.round(sds, 1)}")
    ratios = {a: round(v.held_out_rmse / v.noise_floor, 2) for a, v in validated.items()}
    print(f"{seed} {factor:5g} error over floor {ratios}", flush=True)


def main() -> None:
    """Parse the arguments and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first-seed", type=int, default=7801)
    parser.add_argument("--factors", nargs="*", type=float, default=[4.0, 1.0])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(options.first_seed, options.first_seed + options.seeds):
            for factor in options.factors:
                study(Path(folder) / f"{seed}_{factor:g}", seed, factor)


if __name__ == "__main__":
    sys.exit(main())
