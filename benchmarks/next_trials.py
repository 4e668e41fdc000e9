"""Whether the trial that `bampipe next` proposes gives what was forecast, on sessions never seen.

    python benchmarks/next_trials.py precision --machine joint --seeds 5001 5010
    python benchmarks/next_trials.py precision --timid drag-thinning --trials 4 --seconds 15
    python benchmarks/next_trials.py decision --seeds 5101 5110
    python benchmarks/next_trials.py decision --timid lag-delay --seeds 5201 5202
    python benchmarks/next_trials.py sensitivity --machine joint --seeds 9811 9813

Sessions come from simulators that share no code with bampipe. A proposal is followed there by
somebody who follows well, and by somebody who covers half the range at twice the speed; beside it,
one more trial of the motion at hand of the same length is recorded. ``decision`` does so wherever a
diagnosis is not right at once, be it undecided or mistaken, with what `bampipe next` proposes then
by itself. ``sensitivity`` hides each effect at the smallest strength that the session without it
claims to show with 90 % probability, and counts those that a diagnosis finds. With ``--timid``, the
motion is confined to where two effects look alike; ``--trials`` and ``--seconds`` say how much of
it there is, ``--added`` how long the trial more is. Precision is asked of the worst-known
parameter, or with ``--of all`` of all together.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import independent
import numpy as np
from independent.person import Task
from independent.sensors import Conditions

import bampipe
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.next import NextResult

USUAL = {
    "joint": Conditions(creep=True, trials=5, seconds=15.0),
    "bam": Conditions(creep=True, trials=4, seconds=12.0, rate_hz=250.0),
    "axis": Conditions(creep=True, trials=4, seconds=6.0),
}
POOR = {
    "joint": Conditions(creep=True, trials=2, seconds=8.0, pace=0.4),
    "bam": Conditions(creep=True, trials=2, seconds=8.0, rate_hz=250.0, pace=0.4),
    "axis": Conditions(creep=True, trials=2, seconds=5.0, pace=0.4),
}
HIDDEN = (
    ("joint", "quadratic_drag:joint"), ("joint", "shear_thinning:joint"),
    ("joint", "actuator_delay"), ("joint", "actuator_lag:current"),
    ("joint", "presliding:joint"), ("joint", "stribeck:joint"),
    ("axis", "actuator_delay"), ("axis", "presliding:carriage"),
    ("bam", "force_bias:x"), ("bam", "return_spring:yaw"), ("bam", "base_tilt"),
)  # fmt: skip


BRIEF = {
    "joint": Conditions(creep=True, trials=3, seconds=8.0),
    "bam": Conditions(creep=True, trials=3, seconds=8.0, rate_hz=250.0),
    "axis": Conditions(creep=True, trials=3, seconds=5.0),
}
SMALL = {
    "joint": (
        "quadratic_drag:joint", "actuator_delay", "actuator_lag:current",
        "load_dependent_friction:joint", "asymmetric_coulomb:joint", "stribeck:joint",
    ),
    "bam": ("return_spring:yaw", "quadratic_drag:pitch", "stribeck:yaw"),
    "axis": ("quadratic_drag:carriage", "actuator_delay", "stribeck:carriage"),
}  # fmt: skip
"""Effects by machine whose strength is one number there and here."""


def _timid(seconds: float, coarse: float = 1.0, **moves: tuple[float, float, float]) -> Conditions:
    """Two trials of strokes by axis: middle and half the range, rad or m, and speed, per s."""
    strokes = {
        axis: {"low": middle - half, "high": middle + half, "slow": 0.85 * speed, "fast": speed}
        for axis, (middle, half, speed) in moves.items()
    }
    tasks = (Task(strokes, {}, seconds),) * 2
    return Conditions(creep=True, trials=0, seconds=seconds, coarse=coarse, tasks=tasks)


_ONE_POSE = _timid(8.0, yaw=(0.3, 0.15, 0.25), pitch=(0.2, 0.1, 0.25), extension=(1.1, 0.05, 0.1))
TIMID = {
    "drag-thinning": (
        "joint", ("quadratic_drag:joint", "shear_thinning:joint"),
        _timid(8.0, joint=(0.0, 0.3, 0.4)),
    ),
    "lag-delay": (
        "joint", ("actuator_lag:current", "actuator_delay"), _timid(8.0, joint=(0.0, 0.8, 0.3)),
    ),
    "presliding-stribeck": (
        "joint", ("presliding:joint", "stribeck:joint"),
        _timid(8.0, 4.0, joint=(0.0, 0.5, 0.2)),
    ),
    "bias-gain": ("bam", ("force_bias:x", "force_gain:x"), replace(_ONE_POSE, rate_hz=250.0)),
    "spring-tilt": ("bam", ("return_spring:yaw", "base_tilt"), replace(_ONE_POSE, rate_hz=250.0)),
}  # fmt: skip
"""By pair of effects: machine, the two, and motion that is confined to where they look alike."""
PIPELINE = """schema = "bampipe.pipeline/1"
name = "short"
stages = ["ingest", "filter", "identify", "validate"]
"""


def run_of(
    folder: Path, machine: str, seed: int, effects: Mapping[str, float], conditions: Conditions
) -> tuple[bampipe.Run, dict[str, float]]:
    """Record a session into ``folder``, identify and validate it; the run, and the truth."""
    folder.mkdir()
    truth = independent.record(machine, folder / machine, seed, effects, conditions)
    (folder / "short.toml").write_text(PIPELINE)
    run = bampipe.run_session(
        folder / machine, runs=folder / "runs", pipeline=str(folder / "short.toml")
    )
    return run, truth["parameters"]


def propose(run: bampipe.Run, **settings: object) -> tuple[NextResult, Path]:
    """The proposal for the base model, and its file."""
    bampipe.run_stage(run, "next", "base", **settings)
    path = run.root / NextResult.file("base")
    return NextResult.read(path), path


@dataclass(frozen=True)
class Known:
    """What a session says of the parameters: published standard deviations, and true errors."""

    sd: dict[str, float]
    error: dict[str, float]


def known_of(run: bampipe.Run, truth: Mapping[str, float]) -> Known:
    """What ``run`` says of the parameters of which the truth is known."""
    found = IdentifyResult.read(run.root / IdentifyResult.file("base")).parameters
    named = {name: entry for name, entry in found.items() if name in truth}
    return Known(
        {name: entry.sd for name, entry in named.items()},
        {name: abs(entry.estimate - truth[name]) for name, entry in named.items()},
    )


def worst_known(run: bampipe.Run) -> str:
    """The parameter with the largest standard deviation over its estimate."""
    found = IdentifyResult.read(run.root / IdentifyResult.file("base")).parameters
    return max(found, key=lambda name: found[name].sd / max(abs(found[name].estimate), 1e-12))


def ways_on(conditions: Conditions, path: Path) -> dict[str, Conditions]:
    """One trial more: the proposal in ``path`` followed well, sloppily, or the motion at hand."""
    free = conditions.trials or 0
    well, sloppy = (
        tuple(task.of_trials(free, conditions.tasks) for task in Task.read(path, **sloppiness))
        for sloppiness in ({}, {"reach": 0.5, "haste": 2.0})
    )
    at_hand: dict[str, object] = {"trials": (conditions.trials or 0) + 1}
    if conditions.tasks:
        again = replace(conditions.tasks[0], seconds=sum(task.seconds for task in well))
        at_hand = {"tasks": (*conditions.tasks, again)}
    return {
        "well": replace(conditions, tasks=(*conditions.tasks, *well)),
        "sloppy": replace(conditions, tasks=(*conditions.tasks, *sloppy)),
        "free": replace(conditions, **at_hand),
    }


def measure_precision(
    machine: str, conditions: Conditions, seeds: range, added_s: float, of_all: bool
) -> None:
    """Print forecast over actual uncertainties, and the gain against free and sloppy motion.

    Args:
        machine, conditions, seeds: of the sessions; added_s: length of the trial more.
        of_all: whether the trial is for all parameters, and not for the worst-known one.
    """
    ratios: dict[str, list[float]] = {"asked": [], "all": [], "said as a number": []}
    in_range: list[bool] = []
    narrower: dict[str, list[float]] = {"well": [], "sloppy": []}
    shares, errors, lasted = [], [], []
    for seed in seeds:
        with tempfile.TemporaryDirectory() as name:
            root = Path(name)
            run, truth = run_of(root / "now", machine, seed, {}, conditions)
            before = known_of(run, truth)
            target = worst_known(run)
            start = time.perf_counter()
            purpose = "precision" if of_all else target
            found, path = propose(run, purpose=purpose, seconds=added_s)
            lasted.append(time.perf_counter() - start)
            then = {
                kind: known_of(*run_of(root / kind, machine, seed, {}, chosen))
                for kind, chosen in ways_on(conditions, path).items()
            }
        forecast = found.proposals[0].sd
        names = list(before.sd)
        judged = names if of_all else [target]
        came = {name: then["well"].sd[name] / forecast[name].after for name in names}
        ratios["all"] += came.values()
        ratios["said as a number"] += [came[name] for name in names if forecast[name].is_sharp]
        in_range += [
            forecast[name].low <= then["well"].sd[name] <= forecast[name].high for name in names
        ]
        ratios["asked"] += [came[name] for name in judged]
        for kind, list_of in narrower.items():
            list_of.append(mean_ratio(then["free"].sd, then[kind].sd, judged))
        gain = {k: np.log(mean_ratio(before.sd, one.sd, judged)) for k, one in then.items()}
        shares.append(gain["sloppy"] / gain["well"])
        errors += [[one.error[n] / one.sd[n] for n in judged] for one in then.values()]
        print(f"{machine} {seed}: {found.sentence}")
        print(
            f"  {target}: now {before.sd[target]:.3g}, forecast {forecast[target].number}; "
            + ", ".join(
                f"{kind} {one.sd[target]:.3g} (off by {one.error[target]:.2g})"
                for kind, one in then.items()
            ),
            flush=True,
        )
        print(
            f"  sd after a free trial over that after the proposed {narrower['well'][-1]:.2f},"
            f" followed sloppily {narrower['sloppy'][-1]:.2f}",
            flush=True,
        )
    for which, values in ratios.items():
        inside = sum(1 / 1.3 < ratio < 1.3 for ratio in values)
        print(f"{which}: {inside} of {len(values)} uncertainties within 1.3 of the forecast")
    print(f"all: {sum(in_range)} of {len(in_range)} between the ends of the forecast")
    for kind, list_of in narrower.items():
        print(
            f"sd after a free trial, over that after the proposed followed {kind}: median"
            f" {np.median(list_of):.2f}, from {min(list_of):.2f} to {max(list_of):.2f}"
        )
    print(f"share of the fall of log sd when followed sloppily: median {np.median(shares):.2f}")
    apart = np.concatenate(errors)
    print(f"errors beyond two published sd: {np.sum(apart > 2.0)} of {apart.size}")
    print(f"seconds of a proposal: at most {max(lasted):.1f}")


def mean_ratio(above: Mapping[str, float], below: Mapping[str, float], names: list[str]) -> float:
    """Geometric mean over ``names`` of one number over another."""
    return float(np.exp(np.mean([np.log(above[name] / below[name]) for name in names])))


def verdict(run: bampipe.Run, truth: str) -> str:
    """``right`` where the diagnosis names what is hidden and nothing else; else what it says."""
    bampipe.run_stage(run, "diagnose", "base", replicates=4, jobs=1, trust_setup=True)
    found = DiagnoseResult.read(run.root / DiagnoseResult.file("base"))
    unsure = any(axis.verdict == "undecided" for axis in found.axes.values())
    if not unsure and found.selected == (truth,):
        return "right"
    return "undecided" if unsure else f"said {', '.join(found.selected) or 'nothing'}"


@dataclass(frozen=True)
class Hidden:
    """One effect to hide on a machine, and how its session is recorded."""

    machine: str
    effect: str
    conditions: Conditions


def unresolved_sessions(
    root: Path, hidden: Sequence[Hidden], seeds: range
) -> Iterator[tuple[Hidden, int, bampipe.Run, str]]:
    """Sessions of which the diagnosis is not right at once, with what it says."""
    for seed in seeds:
        for one in hidden:
            folder = root / f"{one.machine}-{one.effect.replace(':', '.')}-{seed}"
            run, _ = run_of(folder, one.machine, seed, {one.effect: 1.0}, one.conditions)
            said = verdict(run, one.effect)
            print(f"{one.machine} {seed} {one.effect}: at once {said}", flush=True)
            if said != "right":
                yield one, seed, run, said


def measure_decision(hidden: Sequence[Hidden], seeds: range, added_s: float | None) -> None:
    """Print what the diagnosis says after the proposed trial, and after one more free trial.

    Args:
        hidden: effects and sessions; seeds: of these.
        added_s: length of the trial more; that of the trials at hand where it is None.
    """
    ways = ("well", "sloppy", "free")
    counts: dict[str, dict[str, Counter[str]]] = {}
    cases = 0
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        for one, seed, run, at_once in unresolved_sessions(root, hidden, seeds):
            head = f"{one.machine} {seed} {one.effect}"
            start = time.perf_counter()
            found, path = propose(run, seconds=added_s or one.conditions.seconds)
            lasted, best = time.perf_counter() - start, found.proposals[0]
            cases += 1
            told = counts.setdefault(at_once.partition(" ")[0], {kind: Counter() for kind in ways})
            said = {}
            for kind, chosen in ways_on(one.conditions, path).items():
                folder = root / f"{kind}-{cases}"
                after, _ = run_of(folder, one.machine, seed, {one.effect: 1.0}, chosen)
                said[kind] = verdict(after, one.effect)
                told[kind][said[kind].partition(" ")[0]] += 1
            print(f"{head}: for {found.purpose}, {lasted:.0f} s: {found.sentence}")
            for pair in best.confusion:
                between = " or ".join(pair.between)
                print(f"  {between}: confusion {pair.before:.2f} to {pair.after:.2f}")
            if one.effect in found.sensitivity:
                seen = found.sensitivity[one.effect]
                print(f"  smallest {seen.smallest} to {seen.with_proposal}, typical {seen.typical}")
            print(f"  {said}", flush=True)
    for at_once, told in counts.items():
        print(f"where the diagnosis at once {at_once}, after one more trial:")
        for kind, count in told.items():
            print(f"  {kind}: {dict(count)}")


def measure_sensitivity(machine: str, brief: Conditions, seeds: range) -> None:
    """Print what a diagnosis says of effects as small as a session claims to show.

    Args:
        machine, brief, seeds: of the sessions.
    """
    told: Counter[str] = Counter()
    by_effect: dict[str, Counter[str]] = {}
    for seed in seeds:
        with tempfile.TemporaryDirectory() as name:
            root = Path(name)
            run, _ = run_of(root / "clean", machine, seed, {}, brief)
            print(f"{machine} {seed}: without any, {verdict(run, '')}", flush=True)
            table = propose(run, purpose="sensitivity")[0].sensitivity
            for k, effect in enumerate(SMALL[machine]):
                entry = table.get(effect)
                if entry is None or entry.smallest is None:
                    continue
                full = independent.record(machine, root / f"full{k}", seed, {effect: 1.0}, brief)
                strength = entry.smallest / abs(full["parameters"][entry.parameter])
                hidden, _ = run_of(root / f"{k}", machine, seed, {effect: strength}, brief)
                said = verdict(hidden, effect)
                print(f"  {effect} at {entry.smallest:.3g} {entry.unit}: {said}", flush=True)
                kind = said.partition(" ")[0]
                told[kind] += 1
                by_effect.setdefault(effect, Counter())[kind] += 1
    for effect, count in by_effect.items():
        print(f"{effect}: {dict(count)}")
    print(f"all: {dict(told)}")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", choices=("precision", "decision", "sensitivity"))
    parser.add_argument("--machine", choices=sorted(USUAL), default="joint")
    parser.add_argument("--seeds", type=int, nargs=2, default=(5001, 5004), metavar=("A", "B"))
    parser.add_argument(
        "--timid", choices=sorted(TIMID), help="confined motion, by pair of effects"
    )
    parser.add_argument("--of", choices=("worst", "all"), default="worst", help="parameters")
    parser.add_argument("--trials", type=int, help="how many timid trials; 2 by default")
    parser.add_argument("--seconds", type=float, help="of each timid trial; 8 by default")
    parser.add_argument("--added", type=float, help="s, of the trial more; else as at hand")
    given = parser.parse_args()
    if not given.timid and (given.trials or given.seconds or given.added):
        parser.error("--trials, --seconds and --added go with --timid")
    seeds = range(given.seeds[0], given.seeds[1] + 1)
    if given.timid:
        machine, either, motion = TIMID[given.timid]
        first = motion.tasks[0]
        task = replace(first, seconds=given.seconds or first.seconds)
        tasks = (task,) * (given.trials or len(motion.tasks))
        timid = replace(motion, seconds=task.seconds, tasks=tasks)
    if given.what == "precision":
        if not given.timid:
            machine, timid = given.machine, USUAL[given.machine]
        added_s = given.added or timid.seconds
        measure_precision(machine, timid, seeds, added_s, given.of == "all")
    elif given.what == "sensitivity":
        measure_sensitivity(given.machine, BRIEF[given.machine], seeds)
    elif given.timid:
        hidden = [Hidden(machine, effect, timid) for effect in either]
        measure_decision(hidden, seeds, given.added)
    else:
        hidden = [Hidden(machine, effect, POOR[machine]) for machine, effect in HIDDEN]
        measure_decision(hidden, seeds, None)
    return 0


if __name__ == "__main__":
    sys.exit(main())
