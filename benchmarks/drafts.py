"""How often a drafted formula brings the error to its floor, and how near it comes to the truth.

    python benchmarks/drafts.py --cases bam:detent:yaw joint:winding_cable:joint --strengths 1 0.5
    python benchmarks/drafts.py --nothing 5
    python benchmarks/drafts.py --forced 5

Sessions of simulators that share no code with bampipe (benchmarks/independent), each with one
effect that the library does not have, or with none. What is left without a name is drafted; the
effects that the diagnosis names count where they leave no more. One line a session, then a table.
With --forced, formulas are looked for on every axis of sessions with nothing hidden, whatever a
diagnosis would say.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import independent
import numpy as np
import pandas as pd
from independent.sensors import Conditions, hold_back

import bampipe
from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model_file import load_model, read_estimate, read_spec
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.drafts.search import draft_formulas
from bampipe.diagnosis.session import Session
from bampipe.physics import compile_model
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.identify import IdentifyResult
from bampipe.trials.linearisation import linearise_fit
from bampipe.trials.measured import read_measured_trials

CASES = (
    "bam:detent:yaw", "bam:detent:extension", "bam:rough_patch:pitch", "bam:winding_cable:yaw",
    "bam:hum:yaw", "bam:slack_spring:yaw", "bam:slack_spring:pitch", "bam:speed_band:yaw",
    "bam:speed_band:extension", "bam:tightening:pitch", "bam:imbalance:yaw",
    "bam:hose:yaw", "bam:sensor_hysteresis:x", "bam:sensor_hysteresis:z", "joint:detent:joint",
    "joint:winding_cable:joint", "joint:slack_spring:joint", "joint:speed_band:joint",
    "axis:rough_patch:carriage", "axis:detent:carriage",
)  # fmt: skip
CONDITIONS = {
    "bam": Conditions(creep=True, trials=5, seconds=15.0, rate_hz=250.0),
    "joint": Conditions(creep=True, trials=5, seconds=12.0),
    "axis": Conditions(creep=True, trials=5, seconds=6.0),
}

Law = Callable[[dict[str, float], np.ndarray, np.ndarray, np.ndarray, float], np.ndarray]


def _relaxed(law: dict[str, float], q: np.ndarray, step: float) -> np.ndarray:
    rest = q.copy()
    for k in range(1, len(q)):
        rest[k] = rest[k - 1] + (q[k - 1] - rest[k - 1]) * step / law["cable_time"]
    return -law["cable"] * (q - rest)


# The forces of benchmarks/independent/friction.py, written again for a motion that was measured.
FORCES: dict[str, Law] = {
    "detent": lambda law, q, v, s, h: -law["detent"] * (q - law["detent_at"]) / law["detent_width"]
    * np.exp(0.5 - 0.5 * ((q - law["detent_at"]) / law["detent_width"]) ** 2),
    "rough_patch": lambda law, q, v, s, h: -law["rough"]
    * np.exp(-(((q - law["rough_at"]) / law["rough_width"]) ** 2)) * s,
    "winding_cable": lambda law, q, v, s, h: _relaxed(law, q, h),
    "slack_spring": lambda law, q, v, s, h: -law["slack_spring"] * np.sign(q - law["slack_at"])
    * np.maximum(np.abs(q - law["slack_at"]) - law["slack"], 0.0),
    "speed_band": lambda law, q, v, s, h: -law["band"]
    * np.exp(-(((np.abs(v) - law["band_at"]) / law["band_width"]) ** 2)) * s,
    "tightening": lambda law, q, v, s, h: -law["tightening"] * (q - law["tightening_from"])
    * s,
    "imbalance": lambda law, q, v, s, h: law["cogging"]
    * np.sin(law["cogging_wavenumber"] * q + law["cogging_phase"]),
}  # fmt: skip


AXIS_OF_FORCE = {"x": "yaw", "y": "pitch", "z": "extension"}
"""Of the arm: where an error of a force component acts."""


def reading_error(law: dict[str, float], read: np.ndarray) -> np.ndarray:
    """What a sensor with hysteresis adds to a force, from what it reads."""
    # The inverse of a spring that slips, in line with another, is one of these as well.
    slope = law["height"] / law["width"]
    return law["height"] * hold_back(read, (1.0 + slope) * law["width"])


PIPELINE = """schema = "bampipe.pipeline/1"
name = "drafts"
stages = ["ingest", "filter", "identify", "validate", "compare"]
[settings.identify]
method = "least-squares"
"""


@dataclass(frozen=True)
class Outcome:
    """What came of one session.

    Attributes:
        case: machine, effect and axis; strength, seed: of the session.
        verdict: of the diagnosis on the axis, or on all axes where nothing is hidden.
        named: effects of the library that were added; drafted: formulas that were.
        p_value: of the first formula; NaN where none was looked for.
        before, after: error over noise floor on the axis without and with what was added.
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


def run_case(case: str, strength: float, seed: int, replicates: int) -> Outcome:
    """Record one session, take one turn of the loop, and hold what was added against the truth."""
    machine, _, effect = case.partition(":")
    hidden = {} if effect == "nothing" else {effect: strength}
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        truth = independent.record(machine, root / machine, seed, hidden, CONDITIONS[machine])
        (root / "drafts.toml").write_text(PIPELINE)
        run = bampipe.run_session(
            root / machine, runs=root / "runs", pipeline=str(root / "drafts.toml")
        )
        found = bampipe.diagnose(run, "base", replicates=replicates, jobs=1)
        axes = found["axes"]
        axis = effect.partition(":")[2] if hidden else next(iter(axes))
        axis = AXIS_OF_FORCE.get(axis, axis)
        named, drafted = tuple(found["selected"]), ()
        p_value, seconds = float("nan"), 0.0
        if diagnosis_of(run).unnamed_axes:
            begun = time.perf_counter()
            written = bampipe.draft(run, "base", jobs=1)
            seconds = time.perf_counter() - begun
            p_value = min(a["chance"][0]["p_value"] for a in written["axes"].values())
            drafted = tuple(written["selected"])
        added = drafted or named
        rungs = bampipe.extend(run, added, "base").ladder if added else run.ladder
        first, last = rungs.loc["base"], rungs.iloc[-1]
        off = float("nan")
        if hidden and added:
            child = rungs.index[-1]
            off = curve_error(RunFolder(run.root), child, axis, effect, truth)
        return Outcome(
            case, strength, seed,
            axes[axis]["verdict"] if hidden else "/".join(a["verdict"] for a in axes.values()),
            () if drafted else named, drafted, p_value, over_floor(first, axis),
            over_floor(last, axis), off, seconds,
        )  # fmt: skip


def force_drafts(machine: str, seed: int) -> dict[str, tuple[float, tuple[str, ...]]]:
    """Look for formulas on a session with nothing hidden: p-value and what was drafted, by axis."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        independent.record(machine, root / machine, seed, {}, CONDITIONS[machine])
        (root / "drafts.toml").write_text(PIPELINE)
        run = RunFolder(
            bampipe.run_session(
                root / machine, runs=root / "runs", pipeline=str(root / "drafts.toml")
            ).root
        )
        model = load_model(run, "base")
        system = compile_model(model)
        timing = run.read(IdentifyResult, "base").input_timing
        trials = read_measured_trials(run, system, every_input=True, timing=timing)
        session = Session(replace(trials, motions=tuple(trials.motions)), Criteria())
        found = draft_formulas(
            session, read_spec(run, "base", model), read_estimate(run, "base", system),
            range(len(system.coordinates)), "a benchmark",
        )  # fmt: skip
        return {
            system.coordinates[axis.axis]: (
                axis.chance[0].p_value,
                tuple(term.form.canonical_name for term in axis.terms),
            )
            for axis in found
        }


def diagnosis_of(run: bampipe.Run) -> DiagnoseResult:
    """The diagnosis of the bare device."""
    return RunFolder(run.root).read(DiagnoseResult, "base")


def over_floor(rung: pd.Series, axis: str) -> float:
    """Held-out error of a rung of the ladder over its noise floor."""
    return float(rung[f"held_out_rmse.{axis}"] / rung[f"noise_floor.{axis}"])


def curve_error(run: RunFolder, model: str, axis: str, effect: str, truth: dict[str, Any]) -> float:
    """Error of what was added as a share of the hidden force, along the measured motion.

    Both are low-passed; what the device's own parameters can do as well is left out of both.
    """
    name = effect.partition(":")[0]
    if effect not in truth["hidden_laws"]:
        return float("nan")
    law = truth["hidden_laws"][effect]
    system = compile_model(load_model(run, model))
    p = read_estimate(run, model, system)
    bare = compile_model(load_model(run, "base"))
    trials = read_measured_trials(run, bare, every_input=True)
    linearisation = linearise_fit(
        bare, trials.motions, trials.band, read_estimate(run, "base", bare), trials.folds
    )
    number = bare.coordinates.index(axis)
    width = bare.model.device.coordinates[number].sign_width
    wanted, given, slopes = [], [], []
    for k, motion in enumerate(trials.motions):
        used = linearisation.used[k][:, number]
        step, rate = float(np.median(np.diff(motion.t))), motion.qd[:, number]
        u = motion.inputs(system.inputs)
        if name in FORCES:
            force = FORCES[name](law, motion.q[:, number], rate, np.tanh(rate / width), step)
        elif name == "hose":
            reach = motion.q[:, 2] - law["hose_root"]
            force = -law["hose"] * reach * (motion.q[:, 0] - law["hose_rest"])
        else:
            component = tuple(AXIS_OF_FORCE).index(effect.partition(":")[2])
            error = reading_error(law, motion.channels[bare.model.device.forces[component]])
            force = -bare.input_map(motion.q)[:, number, component] * error
        z = system.memory(motion.q, motion.qd, motion.qdd, u, p, motion.t)
        added = system.contribution(motion.q, motion.qd, motion.qdd, z, u, p)[:, number]
        both = trials.band.thin(np.column_stack([force, added]), [number, number])[used]
        wanted.append(both[:, 0])
        given.append(both[:, 1])
        slopes.append(linearisation.jacobian[k][used, number])
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
            f"\n{len(clean)} sessions with nothing hidden: a formula drafted in "
            f"{sum(bool(o.drafted) for o in clean)}."
        )
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> None:
    """Run the cases asked for and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", nargs="*", default=list(CASES), help="machine:effect:axis")
    parser.add_argument("--strengths", nargs="*", type=float, default=[1.0, 0.5])
    parser.add_argument("--nothing", type=int, default=0, help="sessions with nothing hidden")
    parser.add_argument("--forced", type=int, default=0, help="the same, whatever a diagnosis says")
    parser.add_argument("--first-seed", type=int, default=4000)
    parser.add_argument("--replicates", type=int, default=4, help="replicates of the diagnosis")
    parser.add_argument("--out", type=Path, help="write the outcomes as JSON, session by session")
    options = parser.parse_args(arguments)
    machines = ("bam", "joint", "axis")
    for k in range(options.forced):
        print(machines[k % 3], force_drafts(machines[k % 3], options.first_seed + k), flush=True)
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
