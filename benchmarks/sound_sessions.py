"""Whether sound sessions are called sound: the error of the right model over the noise floor.

    python benchmarks/sound_sessions.py --sessions 30 --diagnose

Sessions of four simulators that share no code with bampipe, one in three with one effect hidden,
which the right model has. A floor is wrong where the held-out error of the right model is not 0.7
to 1.5 times the floor; a name is wrong where the diagnosis of the bare model names something else
than what is hidden.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from independent import MACHINES, prescribed
from independent.draws import USUAL
from independent.sensors import Conditions
from recovery import PIPELINE

import bampipe

SIMULATORS = {**MACHINES, "prescribed": prescribed}
DRAWN = ("prescribed", "joint", "prescribed", "bam", "prescribed", "axis", "damper")
BOUNDS = 0.7, 1.5


def try_session(seed: int, diagnose: bool) -> dict[str, object]:
    """Record, run and judge the session of a seed."""
    begun, name = time.perf_counter(), DRAWN[seed % len(DRAWN)]
    simulator = SIMULATORS[name]
    known = simulator.EFFECTS
    hidden = {known[seed // 3 % len(known)]: 1.0} if seed % 3 == 0 else {}
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        usual = USUAL.get(name, Conditions())
        truth = simulator.record(root / "session", seed, hidden, usual)
        (root / "sound.toml").write_text(PIPELINE)
        run = bampipe.run_session(
            root / "session", runs=root / "runs", pipeline=str(root / "sound.toml")
        )
        found: dict[str, object] = {"seed": seed, "machine": name, "hidden": list(hidden)}
        if diagnose:
            ranking = bampipe.diagnose(run, "base", jobs=1)
            found["named"] = list(ranking["selected"])
            found["verdicts"] = {a: e["verdict"] for a, e in ranking["axes"].items()}
        if hidden:
            run = bampipe.extend(run, truth["effects"], model="base")
            (right,) = set(run.models) - {"base"}
        rows = run.validation(right if hidden else "base")
        found["over_floor"] = {
            str(axis): round(float(row["held_out_rmse"] / row["noise_floor"]), 3)
            for axis, row in rows.iterrows()
        }
    found["seconds"] = round(time.perf_counter() - begun, 1)
    return found


def main() -> None:
    """Try sessions, print a line of JSON for each and what they have in common."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--sessions", type=int, default=30)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--diagnose", action="store_true", help="and hold names against the truth")
    given = parser.parse_args()
    ratios, names = [], []
    for seed in range(given.first_seed, given.first_seed + given.sessions):
        found = try_session(seed, given.diagnose)
        print(json.dumps(found), flush=True)
        ratios += found["over_floor"].values()  # type: ignore[attr-defined]
        names.append(set(found.get("named", found["hidden"])) != set(found["hidden"]))  # type: ignore[call-overload]
    values = np.array(ratios)
    wrong = int(np.sum(~((values > BOUNDS[0]) & (values < BOUNDS[1]))))
    print(
        f"{values.size} floors of {len(names)} sessions, {wrong} wrong; error over floor from"
        f" {values.min():.2f} to {values.max():.2f}; {sum(names)} sessions with a wrong name",
        file=sys.stderr,
    )


if __name__ == "__main__":
    main()
