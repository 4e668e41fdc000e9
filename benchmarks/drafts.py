"""How often a drafted formula brings the error to its floor, and how near it comes to the truth.

    python benchmarks/drafts.py --cases bam:detent:yaw joint:winding_cable:joint --strengths 1 0.5
    python benchmarks/drafts.py --nothing 5

Sessions of simulators that share no code with bampipe (benchmarks/independent), each with one
effect that the library does not have, or with none. What is left without a name is drafted; the
effects that the diagnosis names count where they leave no more. One line a session, then a table.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import independent
import numpy as np
from independent.sensors import Conditions

from bampipe.data.run_folder import RunFolder
from bampipe.discover.chance import system_of
from bampipe.discover.diagnosis import diagnose
from bampipe.discover.drafts.search import draft
from bampipe.discover.settings import Settings
from bampipe.physics import registry
from bampipe.physics.recipe import Recipe
from bampipe.progress import silent
from bampipe.results.standing import FLOOR_WRONG
from bampipe.stages import filter as filter_stage
from bampipe.stages import ingest
from bampipe.trials.measured import MeasuredTrials, read_measured_trials
from bampipe.trials.noise_floor import find_noise_floor
from bampipe.trials.residuals import Evidence

CASES = (
    "bam:detent:yaw", "bam:detent:extension", "bam:rough_patch:pitch", "bam:winding_cable:yaw",
    "bam:hum:yaw", "bam:slack_spring:yaw", "bam:slack_spring:pitch", "bam:speed_band:yaw",
    "bam:speed_band:extension", "bam:tightening:pitch", "bam:imbalance:yaw", "joint:detent:joint",
    "joint:winding_cable:joint", "joint:slack_spring:joint", "joint:speed_band:joint",
    "axis:rough_patch:carriage", "axis:detent:carriage",
)  # fmt: skip
CONDITIONS = {
    "bam": Conditions(creep=True, trials=5, seconds=15.0, rate_hz=250.0),
    "joint": Conditions(creep=True, trials=5, seconds=12.0),
    "axis": Conditions(creep=True, trials=5, seconds=6.0),
}
BUILT_IN = {"bam": "bam", "axis": "slider"}

Law = Callable[[dict[str, float], np.ndarray, np.ndarray, np.ndarray, float], np.ndarray]


def _relaxed(law: dict[str, float], q: np.ndarray, step: float) -> np.ndarray:
    rest = q.copy()
    for k in range(1, len(q)):
        rest[k] = rest[k - 1] + (q[k - 1] - rest[k - 1]) * step / law["cable_time"]
    return -law["cable"] * (q - rest)


# The forces of benchmarks/independent/friction.py, written again for a motion that was measured.
FORCES: dict[str, Law] = {
    "detent": lambda law, q, v, t, h: -law["detent"] * (q - law["detent_at"]) / law["detent_width"]
    * np.exp(0.5 - 0.5 * ((q - law["detent_at"]) / law["detent_width"]) ** 2),
    "rough_patch": lambda law, q, v, t, h: -law["rough"]
    * np.exp(-(((q - law["rough_at"]) / law["rough_width"]) ** 2)) * np.sign(v),
    "winding_cable": lambda law, q, v, t, h: _relaxed(law, q, h),
    "slack_spring": lambda law, q, v, t, h: -law["slack_spring"] * np.sign(q - law["slack_at"])
    * np.maximum(np.abs(q - law["slack_at"]) - law["slack"], 0.0),
    "speed_band": lambda law, q, v, t, h: -law["band"]
    * np.exp(-(((np.abs(v) - law["band_at"]) / law["band_width"]) ** 2)) * np.sign(v),
    "tightening": lambda law, q, v, t, h: -law["tightening"] * (q - law["tightening_from"])
    * np.sign(v),
    "imbalance": lambda law, q, v, t, h: law["cogging"]
    * np.sin(law["cogging_wavenumber"] * q + law["cogging_phase"]),
}  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What came of one session.

    Attributes:
        case: machine, effect and axis; strength, seed: of the session.
        verdict: of the diagnosis on the axis; named: effects of the library that were added.
        drafted: formulas added; p_value: of the first.
        before, after: error over noise floor on the axis without and with all of them.
        curve: error of what was added as a share of the hidden force, what the device's own
            parameters can do left out; NaN where the force is not known.
        seconds: of the draft alone.
    """

    case: str
    strength: float
    seed: int
    verdict: str
    named: tuple[str, ...]
    drafted: tuple[str, ...]
    p_value: float
    before: float
    after: float
    curve: float
    seconds: float


def read_trials(folder: Path, machine: str, seed: int, effects: dict[str, float]) -> tuple[
    MeasuredTrials, Recipe, dict[str, Any]
]:  # fmt: skip
    """Record a session and filter it; its trials, the bare device, and the truth."""
    truth = independent.record(machine, folder / machine, seed, effects, CONDITIONS[machine])
    run = RunFolder(folder / "run")
    for stage in ("ingest", "filter"):
        run.path(stage).mkdir(parents=True)
    ingest.execute(run, run.root, ingest.Config(session=str(folder / machine)), silent)
    filter_stage.execute(run, run.root, filter_stage.Config(), silent)
    device = (
        registry.device(BUILT_IN[machine])
        if machine in BUILT_IN
        else registry.device_from(tomllib.loads(independent.MACHINES[machine].DEVICE))
    )
    recipe = Recipe(device.declaration, (), ())
    trials = read_measured_trials(run, system_of(recipe), every_input=True)
    return replace(trials, motions=tuple(trials.motions)), recipe, truth


def run_case(case: str, strength: float, seed: int, replicates: int) -> Outcome:
    """Record one session, add what has a name, draft the rest, and hold it against the truth."""
    machine, _, effect = case.partition(":")
    hidden = {} if effect == "nothing" else {effect: strength}
    with tempfile.TemporaryDirectory() as folder:
        trials, recipe, truth = read_trials(Path(folder), machine, seed, hidden)
    settings = Settings(replicates=replicates, jobs=1, seed=seed)
    start = system_of(recipe).prior
    found = diagnose(trials, recipe, start, settings)
    names = system_of(recipe).coordinates
    axis = names.index(effect.partition(":")[2]) if hidden else 0
    bare = found.initial
    verdict = found.axes[axis].verdict if hidden else "/".join(a.verdict for a in found.axes)
    begun = time.perf_counter()
    # Where nothing is hidden a draft is asked for all the same: on every axis, to see how often
    # chance gives one.
    unnamed = [
        i
        for i, a in enumerate(found.axes)
        if not hidden or (a.remains and a.standing not in FLOOR_WRONG)
    ]
    drafts = draft(trials, recipe, bare.p, unnamed, settings, "a benchmark") if unnamed else []
    seconds = time.perf_counter() - begun
    worth = np.exp(-settings.draft_worth)
    beaten = [d for d in drafts if d.terms and d.after >= worth * found.axes[d.axis].rmse_after]
    named, terms = found.selected, [t for d in drafts for t in d.terms]
    evidence = found.evidence if named else bare
    if terms and not (named and beaten):
        named, evidence = (), drafts[-1].evidence
    else:
        terms = []
    floor = find_noise_floor(evidence, trials.sensors, trials.kinematics, seed, 2)
    return Outcome(
        case, strength, seed, verdict, named, tuple(t.canonical for t in terms),
        min((d.chance[0].p_value for d in drafts), default=float("nan")),
        float(bare.held_out_rmse[axis] / floor.level[axis]),
        float(evidence.held_out_rmse[axis] / floor.level[axis]),
        curve_error(bare, evidence, axis, effect, truth) if hidden else float("nan"), seconds,
    )  # fmt: skip


def curve_error(
    bare: Evidence, evidence: Evidence, axis: int, effect: str, truth: dict[str, Any]
) -> float:
    """Error of what was added as a share of the hidden force, along the measured motion.

    Both are low-passed; what the device's own parameters can do as well is left out of both.
    """
    name = effect.partition(":")[0]
    if name not in FORCES:
        return float("nan")
    law = truth["hidden_laws"][effect]
    wanted, given, slopes = [], [], []
    for k, motion in enumerate(bare.motions):
        used = bare.used[k][:, axis]
        step = float(np.median(np.diff(motion.t)))
        force = FORCES[name](law, motion.q[:, axis], motion.qd[:, axis], motion.t, step)
        system = evidence.system
        u = motion.inputs(system.inputs)
        z = system.memory(motion.q, motion.qd, motion.qdd, u, evidence.p, motion.t)
        added = system.contribution(motion.q, motion.qd, motion.qdd, z, u, evidence.p)[:, axis]
        both = bare.band.thin(np.column_stack([force, added]), [axis, axis])[used]
        wanted.append(both[:, 0])
        given.append(both[:, 1])
        slopes.append(bare.jacobian[k][used, axis])
    columns = np.concatenate(slopes)
    columns = columns[:, np.any(columns != 0.0, axis=0)]

    def beyond(values: np.ndarray) -> np.ndarray:
        return values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0]

    hidden = beyond(np.concatenate(wanted))
    off = beyond(np.concatenate(given)) - hidden
    return float(np.linalg.norm(off) / np.linalg.norm(hidden))


def table(outcomes: Sequence[Outcome]) -> str:
    """The summary as Markdown."""
    lines = [
        "| hidden | strength | verdict | added | error / floor before | after | curve off, % | s |",
        "|-|-|-|-|-|-|-|-|",
    ]
    for o in outcomes:
        added = ", ".join(f"`{name}`" for name in (*o.named, *o.drafted)) or "–"
        curve = "–" if np.isnan(o.curve) else f"{100 * o.curve:.0f}"
        lines.append(
            f"| {o.case} | {o.strength:g} | {o.verdict.replace('_', ' ')} | {added} | "
            f"{o.before:.1f} | {o.after:.2f} | {curve} | {o.seconds:.0f} |"
        )
    some = [o for o in outcomes if not o.case.endswith(":nothing")]
    if some:
        after, curves = [o.after for o in some], [o.curve for o in some if not np.isnan(o.curve)]
        lines.append(
            f"\n{len(some)} sessions: error at most 1.3 floors in "
            f"{100 * np.mean(np.array(after) <= 1.3):.0f} %, at most 2 floors in "
            f"{100 * np.mean(np.array(after) <= 2.0):.0f} %; curve within 10 % in "
            f"{100 * np.mean(np.array(curves) <= 0.1):.0f} % of {len(curves)}; median "
            f"{np.median([o.seconds for o in some if o.drafted] or [np.nan]):.0f} s a draft."
        )
    clean = [o for o in outcomes if o.case.endswith(":nothing")]
    if clean:
        lines.append(
            f"\n{len(clean)} sessions with nothing hidden, a draft asked for on every axis: "
            f"{sum(bool(o.drafted) for o in clean)} drafted."
        )
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> None:
    """Run the cases asked for and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", nargs="*", default=list(CASES), help="machine:effect:axis")
    parser.add_argument("--strengths", nargs="*", type=float, default=[1.0, 0.5])
    parser.add_argument("--nothing", type=int, default=0, help="sessions with nothing hidden")
    parser.add_argument("--first-seed", type=int, default=4000)
    parser.add_argument("--replicates", type=int, default=4, help="replays of the diagnosis")
    parser.add_argument("--out", type=Path, help="write the outcomes as JSON, session by session")
    options = parser.parse_args(arguments)
    machines = ("bam", "joint", "axis")
    plan = [(f"{machines[k % 3]}:nothing", 1.0) for k in range(options.nothing)]
    plan += [(case, strength) for strength in options.strengths for case in options.cases]
    outcomes = []
    for number, (case, strength) in enumerate(plan):
        outcome = run_case(case, strength, options.first_seed + number, options.replicates)
        outcomes.append(outcome)
        print(
            case, strength, outcome.verdict, outcome.named, outcome.drafted,
            f"p {outcome.p_value:.2g}, {outcome.before:.2f} -> {outcome.after:.2f} floors,",
            f"curve {outcome.curve:.3f}, {outcome.seconds:.0f} s", flush=True,
        )  # fmt: skip
        if options.out:
            options.out.write_text(json.dumps([asdict(o) for o in outcomes], indent=1))
    print(table(outcomes))


if __name__ == "__main__":
    main(sys.argv[1:])
