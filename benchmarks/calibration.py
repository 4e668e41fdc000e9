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
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from independent import MACHINES, record
from independent.sensors import Conditions
from recovery import DAYS, PIPELINE, draw_effects
from scipy.stats import beta

import bampipe
from bampipe.diagnosis.criteria import Criteria

USUAL = {
    "bam": Conditions(creep=True, trials=4, seconds=8.0, rate_hz=250.0),
    "joint": Conditions(creep=True, trials=4, seconds=10.0),
    "axis": Conditions(creep=True, trials=4, seconds=5.0),
    "damper": Conditions(creep=True, trials=4, seconds=10.0),
    "wrist": Conditions(creep=True, trials=4, seconds=10.0),
}
"""Sessions that are recorded and diagnosed within seconds."""
MOST = {"bam": 5, "joint": 3, "axis": 3, "damper": 2, "wrist": 1}
"""Effects hidden at once."""
TENTHS = np.linspace(0.0, 1.0, 11)


@dataclass(frozen=True)
class Scores:
    """What a diagnosis of one session computed, and the truth.

    Attributes:
        id: of the session; effects: hidden, of the library, by their strength; outside: not of it.
        sets: effects, axis of something unknown, log evidence (nats) and probability of each.
        drops: log evidence lost without each effect of the most probable set, nats, with p-values.
        chance: largest gain of any candidate on each replay of the final model, nats.
        beside: the same on the measured trials.
        unknown: probability of something unknown, by axis.
        over_floor: held-out error over the noise floor, by axis.
        exceeds: axes that leave more than any model may, whatever that probability.
        no_verdict: axes without a verdict; seconds: of the diagnosis; failure: why there is none.
    """

    id: str
    effects: Mapping[str, float]
    outside: Sequence[str]
    sets: Sequence[Mapping[str, Any]] = ()
    drops: Mapping[str, Sequence[float]] = field(default_factory=dict)
    chance: Sequence[float] = ()
    beside: float = 0.0
    unknown: Mapping[str, float] = field(default_factory=dict)
    over_floor: Mapping[str, float] = field(default_factory=dict)
    exceeds: Sequence[str] = ()
    no_verdict: Sequence[str] = ()
    seconds: float = 0.0
    failure: str = ""

    def probabilities(self, criteria: Criteria) -> dict[str, float]:
        """Of each effect of any probable set; no surer than chance allows."""
        found: dict[str, float] = {}
        for one in self.sets:
            for effect in one["effects"]:
                found[effect] = min(found.get(effect, 0.0) + one["probability"], 1.0)
        for effect, (_, p_value) in self.drops.items():
            if p_value > criteria.significance:
                found[effect] = min(found.get(effect, 0.0), 1.0 - p_value)
        return found

    def finds_unknown(self, criteria: Criteria) -> bool:
        """Whether something is said to be missing that no effect of the library is."""
        sure = max(self.unknown.values(), default=0.0) >= criteria.probability
        return sure or bool(self.exceeds)


def diagnose(name: str, run: bampipe.Run | Path, truth: Mapping[str, Any]) -> Scores:
    """Diagnose the bare model of a run without the truth, and keep the scores."""
    known = {"effects": dict(truth["effects"]), "outside": tuple(truth["outside"])}
    begun = time.perf_counter()
    try:
        found = bampipe.diagnose(run, "base", jobs=1, trust_setup=True)
    except bampipe.InputError as problem:
        return Scores(name, **known, failure=str(problem))
    limit, axes = Criteria().probability, found["axes"]
    return Scores(
        name, **known,
        sets=[{k: v for k, v in s.items() if v is not None} for s in found["sets"]],
        drops={
            row["effect"]: (round(row["score"], 2), row["p_value"])
            for row in found["ranking"] if row["effect"] in found["sets"][0]["effects"]
        },
        chance=[round(v, 2) for v in found["chance"]["largest"]],
        beside=round(found["chance"]["measured"], 2),
        unknown={axis: round(e["unknown"], 4) for axis, e in axes.items()},
        over_floor={
            axis: round(e["rmse_after"] / e["noise_floor"], 3)
            for axis, e in axes.items() if e["noise_floor"]
        },
        exceeds=[a for a, e in axes.items() if e["remains"] and e["unknown"] < limit],
        no_verdict=[a for a, e in axes.items() if e["verdict"] == "no_verdict"],
        seconds=round(time.perf_counter() - begun, 1),
    )  # fmt: skip


def draw_session(seed: int, clean: bool) -> tuple[str, str, dict[str, float]]:
    """Machine, day and hidden effects with their strengths, 0.1 to 1, each as likely by ratio."""
    rng = np.random.default_rng([seed, clean])
    machine = list(MACHINES)[seed % len(MACHINES)]
    day = "good" if rng.uniform() < 0.5 else str(rng.choice([d for d in DAYS if d != "good"]))
    count = 0 if clean else int(rng.integers(1, MOST[machine] + 1))
    outside = int(count > 1 and rng.uniform() < 0.2)
    names = () if clean else draw_effects(machine, count - outside, outside, seed)
    return machine, day, {n: round(float(10 ** rng.uniform(-1.0, 0.0)), 3) for n in names}


def record_and_diagnose(seed: int, clean: bool) -> Scores:
    """Record the session of a seed, identify the bare model and diagnose it."""
    machine, day, effects = draw_session(seed, clean)
    usual, drawn = USUAL[machine], DAYS[day]
    conditions = replace(
        drawn, creep=True, trials=drawn.trials or usual.trials,
        seconds=drawn.seconds or usual.seconds, rate_hz=drawn.rate_hz or usual.rate_hz,
        viscous_trials=3 * any(e.startswith("brake") for e in effects),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        truth = record(machine, root / "session", seed, effects, conditions)
        named = {"effects": {e: effects[e] for e in truth["effects"]}, "outside": truth["outside"]}
        (root / "calibration.toml").write_text(PIPELINE)
        try:
            run = bampipe.run_session(
                root / "session", runs=root / "runs", pipeline=str(root / "calibration.toml")
            )
        except bampipe.InputError as problem:
            return Scores(f"{machine} {day} {seed}", **named, failure=str(problem))
        return diagnose(f"{machine} {day} {seed}", run, named)


def diagnose_row(row: Mapping[str, str]) -> Scores:
    """Diagnose a copy of a run folder of a table; strengths that it does not state are 1."""
    hidden = [e.partition("=") for e in (row["effects"] or "").split("+") if e]
    outside = [e for e in (row.get("outside") or "").split("+") if e]
    truth = {"effects": {e: float(s or 1.0) for e, _, s in hidden}, "outside": outside}
    with tempfile.TemporaryDirectory() as folder:
        return diagnose(row["id"], shutil.copytree(row["run"], Path(folder) / "run"), truth)


def write_tables(scores: Sequence[Scores], criteria: Criteria) -> str:
    """Reliability, alarms and sets at the given criteria, as Markdown."""
    done = [s for s in scores if not s.failure]
    clean = [s for s in done if not s.effects and not s.outside]
    hidden = [s for s in done if s.effects and not s.outside]
    outside = [s for s in done if s.outside]
    lines = [
        f"{len(done)} sessions, {len(scores) - len(done)} refused; probability"
        f" {criteria.probability:g}, significance {criteria.significance:g}",
        "",
        *_reliability([*hidden, *outside], criteria),
        "",
        *_alarms(clean, criteria),
        *_sets(hidden, criteria),
    ]
    if outside:
        lines.append(
            f"Of {len(outside)} sessions with an effect outside the library, something unknown is"
            f" said to be missing in {sum(s.finds_unknown(criteria) for s in outside)}."
        )
    seconds = [s.seconds for s in done] or [np.nan]
    lines.append(f"A diagnosis took {np.median(seconds):.1f} s, at most {max(seconds):.1f} s.")
    return "\n".join(lines)


def _reliability(scores: Iterable[Scores], criteria: Criteria) -> list[str]:
    """Of the effects given each tenth of probability, how many are there."""
    stated = [(p, e in s.effects) for s in scores for e, p in s.probabilities(criteria).items()]
    lines = ["| stated probability | effects | mean stated | there | wrong |", "|-|-|-|-|-|"]
    for low, high in pairwise(TENTHS):
        here = [(p, t) for p, t in stated if low <= p < high or (high == 1.0 and p == 1.0)]
        if here:
            true = sum(t for _, t in here)
            lines.append(
                f"| {low:.1f} to {high:.1f} | {len(here)} | {np.mean([p for p, _ in here]):.3f} |"
                f" {true / len(here):.3f} | {len(here) - true} |"
            )
    return lines


def _alarms(clean: Sequence[Scores], criteria: Criteria) -> list[str]:
    """Sessions where nothing is missing of which something else is said."""
    if not clean:
        return []
    least = 1.0 - criteria.probability
    named = [max(s.probabilities(criteria).values(), default=0.0) for s in clean]
    sure = sum(
        p >= criteria.probability or s.finds_unknown(criteria)
        for p, s in zip(named, clean, strict=True)
    )
    unsure = sum(
        least <= max(p, *s.unknown.values()) < criteria.probability
        for p, s in zip(named, clean, strict=True)
    )
    bound = float(beta.ppf(0.95, sure + 1, len(clean) - sure)) if sure < len(clean) else 1.0
    return [
        f"Of {len(clean)} clean sessions, {sure} are said to lack something (at most"
        f" {100 * bound:.1f} % at 95 % confidence), {unsure} are left undecided, and"
        f" {sum(bool(s.no_verdict) for s in clean)} have an axis without a verdict."
    ]


def _sets(hidden: Sequence[Scores], criteria: Criteria) -> list[str]:
    """Whole sets and single effects, where all that is hidden is of the library."""
    if not hidden:
        return []
    first = [set(s.sets[0]["effects"]) == set(s.effects) for s in hidden]
    among = [any(set(o["effects"]) == set(s.effects) and o["probability"] >= 0.1 for o in s.sets)
             for s in hidden]  # fmt: skip
    lines = [
        f"Of {len(hidden)} sessions with effects of the library alone, the most probable set is the"
        f" hidden one in {sum(first)}, and a set of probability 0.1 or more is in {sum(among)}."
    ]
    for low, high in ((0.1, 0.2), (0.2, 0.5), (0.5, 1.01)):
        chances = [s.probabilities(criteria).get(e, 0.0) for s in hidden
                   for e, strength in s.effects.items() if low <= strength < high]  # fmt: skip
        if chances:
            found = sum(p >= criteria.probability for p in chances)
            open_still = sum(1 - criteria.probability <= p < criteria.probability for p in chances)
            lines.append(
                f"At strengths {low:g} to {min(high, 1.0):g}, {found} of {len(chances)} effects are"
                f" called missing, and {open_still} more are undecided."
            )
    return lines


def read_scores(path: Path) -> Iterator[Scores]:
    """The scores of a file, a line each."""
    for line in path.read_text(encoding="utf-8").splitlines():
        yield Scores(**json.loads(line))


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
    parser.add_argument("--significance", type=float, default=Criteria.significance)
    given = parser.parse_args(arguments)
    criteria = Criteria(probability=given.probability, significance=given.significance)
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
