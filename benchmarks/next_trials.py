"""Whether the trial that `bampipe next` proposes gives what was forecast, on sessions never seen.

    python benchmarks/next_trials.py precision --machine joint --seeds 5001 5010
    python benchmarks/next_trials.py decision --seeds 5101 5110

Sessions come from simulators that share no code with bampipe. A proposal is followed there by
somebody who follows well, and by somebody who covers half the range at twice the speed; beside it,
one more trial of the usual motion of the same length is recorded.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import independent
import numpy as np
from independent.person import Task
from independent.sensors import Conditions

import bampipe
from bampipe.errors import InputError
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
PIPELINE = """schema = "bampipe.pipeline/1"
name = "short"
stages = ["ingest", "filter", "identify", "validate"]
"""


def run_of(
    folder: Path, machine: str, seed: int, effects: Mapping[str, float], conditions: Conditions
) -> bampipe.Run:
    """Record a session into ``folder``, identify and validate it."""
    folder.mkdir()
    independent.record(machine, folder / machine, seed, effects, conditions)
    (folder / "short.toml").write_text(PIPELINE)
    return bampipe.run_session(
        folder / machine, runs=folder / "runs", pipeline=str(folder / "short.toml")
    )


def propose(run: bampipe.Run, **settings: object) -> tuple[NextResult, Path]:
    """The proposal for the base model, and its file."""
    bampipe.run_stage(run, "next", "base", **settings)
    path = run.root / NextResult.file("base")
    return NextResult.read(path), path


def sds(run: bampipe.Run) -> dict[str, float]:
    """Published standard deviations."""
    found = IdentifyResult.read(run.root / IdentifyResult.file("base"))
    return {name: entry.sd for name, entry in found.parameters.items()}


def measure_precision(machine: str, seeds: range) -> None:
    """Print forecast over actual uncertainties, and the gain against free and sloppy motion."""
    conditions = USUAL[machine]
    ratios, free_gain, sloppy_gain = [], [], []
    for seed in seeds:
        with tempfile.TemporaryDirectory() as name:
            root = Path(name)
            run = run_of(root / "now", machine, seed, {}, conditions)
            before = sds(run)
            dry = [n for n in before if n.startswith("coulomb.")]
            target = dry[seed % len(dry)]
            found, path = propose(run, purpose=target, seconds=conditions.seconds)
            followed = {
                kind: sds(run_of(root / kind, machine, seed, {}, chosen))
                for kind, chosen in {
                    "well": replace(conditions, tasks=(Task.read(path),)),
                    "sloppy": replace(conditions, tasks=(Task.read(path, reach=0.5, haste=2.0),)),
                    "free": replace(conditions, trials=(conditions.trials or 0) + 1),
                }.items()
            }
            forecast = found.proposals[0].sd
            ratios += [followed["well"][n] / forecast[n].after for n in forecast]
            gain = {k: sd[target] ** -2 - before[target] ** -2 for k, sd in followed.items()}
            free_gain.append(gain["well"] / gain["free"])
            sloppy_gain.append(gain["sloppy"] / gain["well"])
            print(
                f"{machine} {seed} {target}: now {before[target]:.3g}, forecast"
                f" {forecast[target].after:.3g}, well {followed['well'][target]:.3g}, sloppy"
                f" {followed['sloppy'][target]:.3g}, free {followed['free'][target]:.3g}",
                flush=True,
            )
    within = np.mean([1 / 1.3 < ratio < 1.3 for ratio in ratios])
    print(
        f"{machine}: {len(ratios)} uncertainties, {100 * within:.0f} % within 1.3 of the forecast"
    )
    print(f"information added, over that of a free trial: median {np.median(free_gain):.2f}")
    print(f"of it when followed sloppily: median {np.median(sloppy_gain):.2f}")


def verdict(run: bampipe.Run, truth: str) -> str:
    """``right`` where the diagnosis names what is hidden and nothing else; else what it says."""
    bampipe.run_stage(run, "diagnose", "base", replicates=4, jobs=1, trust_setup=True)
    found = DiagnoseResult.read(run.root / DiagnoseResult.file("base"))
    unsure = any(axis.verdict == "undecided" for axis in found.axes.values())
    if not unsure and found.selected == (truth,):
        return "right"
    return "undecided" if unsure else f"said {', '.join(found.selected) or 'nothing'}"


def ambiguous_sessions(root: Path, seeds: range) -> Iterator[tuple[str, str, int, bampipe.Run]]:
    """Sessions of poor motion whose diagnosis leaves something to decide."""
    for seed in seeds:
        for machine, effect in HIDDEN:
            folder = root / f"{machine}-{effect.replace(':', '.')}-{seed}"
            run = run_of(folder, machine, seed, {effect: 1.0}, POOR[machine])
            if verdict(run, effect) == "undecided":
                yield machine, effect, seed, run


def measure_decision(seeds: range) -> None:
    """Print what the diagnosis says after the proposed trial, and after one more free trial."""
    counts: dict[str, int] = {"well": 0, "sloppy": 0, "free": 0}
    cases = 0
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        for machine, effect, seed, run in ambiguous_sessions(root, seeds):
            conditions = POOR[machine]
            try:
                found, path = propose(run, purpose="decision", seconds=conditions.seconds)
            except InputError as error:
                print(f"{machine} {seed} {effect}: {error}", flush=True)
                continue
            cases += 1
            pair = max(found.proposals[0].confusion, key=lambda one: one.weight * one.before)
            said = {}
            for kind, chosen in {
                "well": replace(conditions, tasks=(Task.read(path),)),
                "sloppy": replace(conditions, tasks=(Task.read(path, reach=0.5, haste=2.0),)),
                "free": replace(conditions, trials=(conditions.trials or 0) + 1),
            }.items():
                folder = root / f"{kind}-{cases}"
                said[kind] = verdict(run_of(folder, machine, seed, {effect: 1.0}, chosen), effect)
                counts[kind] += said[kind] == "right"
            print(
                f"{machine} {seed} {effect}: {' or '.join(pair.between)}, confusion"
                f" {pair.before:.2f} to {pair.after:.2f}; {said}",
                flush=True,
            )
    print(f"{cases} undecided sessions; decided rightly: {counts}")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", choices=("precision", "decision"))
    parser.add_argument("--machine", choices=sorted(USUAL), default="joint")
    parser.add_argument("--seeds", type=int, nargs=2, default=(5001, 5004), metavar=("A", "B"))
    given = parser.parse_args()
    seeds = range(given.seeds[0], given.seeds[1] + 1)
    if given.what == "precision":
        measure_precision(given.machine, seeds)
    else:
        measure_decision(seeds)
    return 0


if __name__ == "__main__":
    sys.exit(main())
