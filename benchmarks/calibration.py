"""Whether the probabilities that a diagnosis states are right, and how often it raises an alarm.

    python benchmarks/calibration.py --clean 40 --hidden 40 --out scores.jsonl
    python benchmarks/calibration.py --runs runs.tsv --out scores.jsonl
    python benchmarks/calibration.py --from benchmarks/results/calibration.jsonl --probability 0.8

Sessions come from simulators that share no code with bampipe (benchmarks/independent): the seed
draws a machine, a day, up to five effects and their strengths. ``--runs`` diagnoses run folders
that exist instead: a table, tab-separated, with the columns ``id``, ``run``, ``effects`` (such as
``stribeck:yaw=0.5+base_tilt``) and ``outside``. A line of JSON a session holds the raw scores and
the truth; ``--from`` makes the tables from such lines in a second, with other criteria where they
are given.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

from independent.draws import draw_session, record_drawn
from recovery import PIPELINE
from scores import Scores, read_scores, write_tables

import bampipe
from bampipe.diagnosis.criteria import Criteria


def diagnose(name: str, run: bampipe.Run | Path, truth: Mapping[str, Any]) -> Scores:
    """Diagnose the bare model of a run without the truth, and keep the scores."""
    known = {"effects": dict(truth["effects"]), "outside": tuple(truth["outside"])}
    begun = time.process_time()
    try:
        found = bampipe.diagnose(run, "base", jobs=1, trust_setup=True)
    except Exception as problem:  # a crash is a failure of this session, not of the benchmark
        return Scores(name, **known, failure=f"{type(problem).__name__}: {problem}")
    axes = found["axes"]
    return Scores(
        name, **known,
        effects_found={
            row["effect"]: round(row["probability"], 4)
            for row in found["ranking"] if row["probability"] >= 0.001
        },
        sets=[{k: v for k, v in s.items() if v is not None} for s in found["sets"]],
        drops={
            row["effect"]: (round(row["score"], 2), row["p_value"])
            for row in found["ranking"] if row["effect"] in found["selected"]
        },
        chance=[round(v, 2) for v in found["chance"]["largest"]],
        beside=round(found["chance"]["measured"], 2),
        unknown={axis: round(e["unknown"], 4) for axis, e in axes.items()},
        over_floor={
            axis: round(e["rmse_after"] / e["noise_floor"], 3)
            for axis, e in axes.items() if e["noise_floor"]
        },
        no_verdict=[a for a, e in axes.items() if e["verdict"] == "no_verdict"],
        seconds=round(time.process_time() - begun, 1),
    )  # fmt: skip


def record_and_diagnose(seed: int, clean: bool) -> Scores:
    """Record the session of a seed, identify the bare model and diagnose it."""
    machine, day, effects = draw_session(seed, clean)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        truth = record_drawn(root / "session", seed, machine, day, effects)
        named = {"effects": {e: effects[e] for e in truth["effects"]}, "outside": truth["outside"]}
        (root / "calibration.toml").write_text(PIPELINE)
        try:
            run = bampipe.run_session(
                root / "session", runs=root / "runs", pipeline=str(root / "calibration.toml")
            )
        except Exception as problem:
            failure = f"{type(problem).__name__}: {problem}"
            return Scores(f"{machine} {day} {seed}", **named, failure=failure)
        return diagnose(f"{machine} {day} {seed}", run, named)


def diagnose_row(row: Mapping[str, str]) -> Scores:
    """Diagnose a copy of a run folder of a table; strengths that it does not state are 1."""
    hidden = [e.partition("=") for e in (row["effects"] or "").split("+") if e]
    outside = [e for e in (row.get("outside") or "").split("+") if e]
    truth = {"effects": {e: float(s or 1.0) for e, _, s in hidden}, "outside": outside}
    with tempfile.TemporaryDirectory() as folder:
        return diagnose(row["id"], shutil.copytree(row["run"], Path(folder) / "run"), truth)


def main(arguments: Sequence[str]) -> None:
    """Score sessions, or read scores, and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--clean", type=int, default=0, help="sessions with nothing hidden")
    parser.add_argument("--hidden", type=int, default=0, help="sessions with effects")
    parser.add_argument("--first-seed", type=int, default=20001)
    parser.add_argument("--runs", type=Path, help="a table of run folders to diagnose")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, help="add the scores as JSON, a line a session")
    parser.add_argument("--from", dest="read", type=Path, nargs="+", help="scores to read")
    parser.add_argument("--probability", type=float, default=Criteria.probability)
    given = parser.parse_args(arguments)
    criteria = Criteria(probability=given.probability)
    scores = [one for path in given.read or () for one in read_scores(path)]
    if not given.read:
        rows = list(csv.DictReader(given.runs.open(), delimiter="\t")) if given.runs else []
        plan = [(given.first_seed + k, True) for k in range(given.clean)]
        plan += [(given.first_seed + k, False) for k in range(given.hidden)]
        plan.sort()
        with ProcessPoolExecutor(given.jobs) as pool:
            tasks = [pool.submit(diagnose_row, row) for row in rows]
            tasks += [pool.submit(record_and_diagnose, *one) for one in plan]
            for task in tasks:
                scores.append(one := task.result())
                print(f"{one.id} {one.seconds:.1f} s {one.failure}", file=sys.stderr, flush=True)
                if given.out:
                    with given.out.open("a", encoding="utf-8") as log:
                        log.write(json.dumps(asdict(one)) + "\n")
    print(write_tables(scores, criteria))


if __name__ == "__main__":
    main(sys.argv[1:])
