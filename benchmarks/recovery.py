"""What comes back of effects hidden by simulators that share no code with bampipe.

    python benchmarks/recovery.py bam --counts 0 1 3 --seeds 4
    python benchmarks/recovery.py joint --hidden stribeck:joint nothing --conditions "mains hum"

Each session hides a drawn set of effects (``--counts``) or a named one (``--hidden``, joined by
``+``). It is diagnosed once, or followed by ``extend --auto``, without the truth; one line a
session, then a table. With ``--given`` the model is given the hidden effects, and what is asked is
whether their parameters are found and their intervals hold, by each method named. ``--out`` is
written session by session, and ``--table`` makes the table of such files, of a run that was ended
early as well. ``--list`` prints what each machine can hide.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from independent import MACHINES, record
from independent.draws import DAYS, draw_effects
from independent.sensors import Conditions
from pydantic import TypeAdapter

import bampipe
from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model_file import load_model
from bampipe.diagnosis.criteria import Criteria
from bampipe.files import write_text
from bampipe.progress import silent
from bampipe.results.identify import IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.rounding import NORMAL_95
from bampipe.results.validate import ValidateResult
from bampipe.run import models
from bampipe.stages import filter as filter_stage
from bampipe.stages import identify, ingest, validate

PIPELINE = """schema = "bampipe.pipeline/1"
name = "recovery"
stages = ["ingest", "filter", "identify", "validate"]
"""
RIGHT = "right"
OTHERWISE = {"shear_thinning": ("viscous", "coulomb")}
"""Effects that simulators write in other mathematics, with the parameters of the same axis that
take part in the difference: of them, such a session has no truth."""


@dataclass(frozen=True)
class Case:
    """One session to record and judge."""

    machine: str
    effects: tuple[str, ...]
    strength: float
    day: str
    creep: bool
    seed: int
    replicates: int
    auto: bool
    given: tuple[str, ...]
    trials: int | None = None
    seconds: float | None = None
    stop: bool = False
    pace: float = 1.0

    @property
    def conditions(self) -> Conditions:
        """How the session is recorded."""
        day = replace(DAYS[self.day], creep=self.creep, stop=self.stop)
        if self.pace != 1.0:
            day = replace(day, pace=self.pace)
        if self.trials is not None:
            day = replace(day, trials=self.trials)
        if self.seconds is not None:
            day = replace(day, seconds=self.seconds)
        if any(effect.startswith("brake") for effect in self.effects):
            day = replace(day, viscous_trials=3)
        return day


@dataclass(frozen=True)
class Found:
    """A parameter of a right model: its truth, and what was found.

    Attributes:
        kind: "device", "strength" or "shape"; bound: its Cramer-Rao bound.
        determined: whether its effect counts as identified.
        method: asked for; published: of the method chosen.
    """

    name: str
    kind: str
    truth: float
    estimate: float
    sd: float
    bound: float
    determined: bool
    method: str
    published: str

    @property
    def z(self) -> float:
        """Error in standard deviations."""
        return (self.estimate - self.truth) / self.sd

    @property
    def determinable(self) -> bool:
        """Whether any method could find it to `_limit`, by its Cramer-Rao bound at 95 %."""
        return bool(NORMAL_95 * self.bound < self._limit)

    @property
    def near(self) -> bool:
        """Whether it is off by less than `_limit`."""
        return abs(self.estimate - self.truth) < self._limit

    @property
    def _limit(self) -> float:
        """15 % of the truth of a shape, 5 % of anything else."""
        return (0.15 if self.kind == "shape" else 0.05) * abs(self.truth)


@dataclass(frozen=True)
class Outcome:
    """What came of one session.

    Attributes:
        case: the session.
        hidden, outside: effects hidden that the library has, and that it has not.
        named: effects found, in order; probabilities: of each, by the diagnosis that named it; none
            where it was followed to its end; groups: what each was said to be like.
        verdicts: of the last diagnosis, by axis; remains: whether more is missing than it names.
        over_floor: held-out error over noise floor with what was found, by axis.
        parameters: those that have a truth, where the set is right.
        seconds: of the diagnosis, or of the whole loop, or of the identification.
        failure: the message, if a stage refused.
    """

    case: Case
    hidden: tuple[str, ...] = ()
    outside: tuple[str, ...] = ()
    named: tuple[str, ...] = ()
    probabilities: tuple[float, ...] = ()
    groups: tuple[tuple[str, ...], ...] = ()
    verdicts: tuple[str, ...] = ()
    remains: bool = False
    over_floor: tuple[float, ...] = ()
    parameters: tuple[Found, ...] = ()
    seconds: float = 0.0
    failure: str = ""

    def _reaches(self) -> list[set[str]]:
        return [{n, *g} for n, g in zip(self.named, self.groups, strict=True)]

    @property
    def found(self) -> int:
        """Hidden effects that were named, or stand in the group of one that was."""
        return sum(any(e in reach for reach in self._reaches()) for e in self.hidden)

    @property
    def right(self) -> int:
        """Named effects that were hidden, or stand for one that was."""
        return sum(bool(reach & set(self.hidden)) for reach in self._reaches())

    @property
    def first(self) -> bool:
        """The first effect named is itself one of the hidden."""
        return bool(self.named) and self.named[0] in self.hidden

    @property
    def unknown(self) -> bool:
        """Something was said to be missing that the library has no name for."""
        return self.remains or "unknown_effect" in self.verdicts

    def line(self) -> str:
        """One line of the log."""
        if self.failure:
            said = f"FAILED {self.failure}"
        elif self.case.given:
            worst: dict[str, Found] = {}
            for found in sorted(self.parameters, key=lambda found: abs(found.z)):
                worst[found.method] = found
            said = ", ".join(
                f"{method} ({w.published}): {w.name} {w.z:+.1f} sd" for method, w in worst.items()
            )
            said += "".join(f" | {r:.2f}" for r in self.over_floor)
        else:
            chances = self.probabilities or (None,) * len(self.named)
            alike = [
                n + (f" {p:.2f}" if p is not None else "") + (f" (or {', '.join(g)})" if g else "")
                for n, p, g in zip(self.named, chances, self.groups, strict=True)
            ]
            ratios = ", ".join(f"{r:.2f}" for r in self.over_floor)
            said = f"{' + '.join(alike) or '-'} | {', '.join(self.verdicts)} | {ratios}"
        hidden = " + ".join(self.case.effects) or "nothing"
        return f"{self.case.machine} {self.case.day} {self.case.seed} | {hidden} -> {said}"


def run_case(case: Case) -> Outcome:
    """Record one session and judge it, in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        strengths = dict.fromkeys(case.effects, case.strength)
        truth = record(case.machine, root / "session", case.seed, strengths, case.conditions)
        try:
            if case.given:
                return _identify_given(case, root, truth["parameters"])
            return _search(case, root, truth)
        except bampipe.InputError as problem:
            return Outcome(case, failure=str(problem))


def _search(case: Case, root: Path, truth: dict[str, Any]) -> Outcome:
    (root / "recovery.toml").write_text(PIPELINE)
    run = bampipe.run_session(
        root / "session", runs=root / "runs", pipeline=str(root / "recovery.toml")
    )
    begun = time.perf_counter()
    if case.auto:
        run = bampipe.follow(run)
        named = models.read(run.root, run.model).effects
    diagnosis = bampipe.diagnose(run, replicates=case.replicates, jobs=1, seed=case.seed)
    seconds = time.perf_counter() - begun
    axes = diagnosis["axes"].values()
    ranked = {} if case.auto else {row["effect"]: row for row in diagnosis["ranking"]}
    named = named if case.auto else tuple(diagnosis["selected"])
    parameters: tuple[Found, ...] = ()
    if set(named) == set(case.effects) and case.auto:
        parameters = _hold_against(RunFolder(run.root), run.model, truth["parameters"], "auto")
    return Outcome(
        case,
        tuple(truth["effects"]),
        tuple(truth["outside"]),
        named,
        tuple(round(ranked[n]["probability"], 3) for n in named if ranked),
        tuple(tuple(ranked[n]["indistinguishable_from"]) if ranked else () for n in named),
        tuple(a["verdict"] for a in axes),
        any(a["remains"] for a in axes),
        tuple(round(a["rmse_after"] / (a["noise_floor"] or np.nan), 3) for a in axes),
        parameters,
        seconds=seconds,
    )


def _identify_given(case: Case, root: Path, truth: dict[str, float]) -> Outcome:
    """Identify the model that has the hidden effects."""
    run = RunFolder(root / "run")
    ingest.execute(run, run.root, ingest.Config(session=str(root / "session")), silent)
    device = run.read(IngestResult).device
    model = f"""schema = "bampipe.model/1"
name = "{RIGHT}"
device = "{device}"
effects = {json.dumps(case.effects)}
"""
    bare = model.replace(RIGHT, "base").replace(json.dumps(case.effects), "[]")
    write_text(run.path("models/base/model.toml"), bare)
    write_text(run.path(f"models/{RIGHT}/model.toml"), model)
    filter_stage.execute(run, run.root, filter_stage.Config(), silent)
    begun = time.process_time()
    parameters: list[Found] = []
    over_floor: tuple[float, ...] = ()
    for method in case.given:
        found = [p for p in parameters if p.published == method]
        if found:  # `auto` has published that method's estimate
            parameters += [replace(p, method=method) for p in found if p.method == "auto"]
            continue
        config = identify.Config(model=RIGHT, method=method)
        try:
            identify.execute(run, run.root, config, silent)
        except bampipe.InputError:
            if method == "auto":
                raise
            continue  # said in place of numbers: nothing to hold against the truth
        parameters += _hold_against(run, RIGHT, truth, method)
    if case.given == ("auto",):
        validate.execute(run, run.root, validate.Config(model=RIGHT, free_run=False), silent)
        axes = run.read(ValidateResult, RIGHT).axes.values()
        over_floor = tuple(round(a.held_out_rmse / (a.noise_floor or np.nan), 3) for a in axes)
    return Outcome(
        case,
        hidden=case.effects,
        over_floor=over_floor,
        parameters=tuple(parameters),
        seconds=time.process_time() - begun,
    )


def _hold_against(
    run: RunFolder, model: str, truth: dict[str, float], method: str
) -> tuple[Found, ...]:
    """The parameters of a model that have a truth."""
    loaded = load_model(run, model)
    of_device = {item.name for item in loaded.device.parameters}
    strengths = {item.name for item in loaded.parameters if item.strength}
    result = run.read(IdentifyResult, model)
    shared = {
        f"{name}.{axis}"
        for effect, _, axis in (full.partition(":") for full in result.effects)
        for name in OTHERWISE.get(effect, ())
    }
    return tuple(
        Found(
            name,
            "device" if name in of_device else "strength" if name in strengths else "shape",
            value,
            result.parameters[name].estimate,
            result.parameters[name].sd,
            result.parameters[name].bound_sd or np.nan,
            all(
                found.identified
                for effect, found in result.effects.items()
                if name.startswith(f"{effect.replace(':', '.')}.")
            ),
            method,
            result.method,
        )
        for name, value in truth.items()
        if name in result.parameters and name not in shared
    )


def write_table(outcomes: Sequence[Outcome]) -> str:
    """Counts and ratios by machine, day and number of hidden effects, as Markdown."""
    lines = [
        "| machine | day | hidden | sessions | found | named right | first right | "
        "false alarms | unknown | error / floor | s |",
        "|-|-|-|-|-|-|-|-|-|-|-|",
    ]
    done = [o for o in outcomes if not o.failure]
    searched = [o for o in done if not o.case.given]
    lines = lines if searched else []

    def kind(o: Outcome) -> tuple[str, str, int, int]:
        return o.case.machine, o.case.day, len(o.hidden), len(o.outside)

    for key in sorted({kind(o) for o in searched}):
        some = [o for o in searched if kind(o) == key]
        machine, day, hidden, outside = key
        clean = not hidden and not outside
        named = sum(len(o.named) for o in some)
        axes = sum(len(o.verdicts) for o in some)
        alarms = sum(v != "nothing_missing" for o in some for v in o.verdicts)
        worst = [max(o.over_floor) for o in some]
        first = sum(o.first for o in some)
        lines.append(
            f"| {machine} | {day} | {hidden}{f' and {outside} outside' if outside else ''} | "
            f"{len(some)} | "
            + (f"{sum(o.found for o in some)}/{hidden * len(some)}" if hidden else "-")
            + f" | {f'{sum(o.right for o in some)}/{named}' if named else '-'} | "
            + (f"{first}/{len(some)}" if hidden else "-")
            + f" | {f'{alarms} in {axes} axes' if clean else '-'} | "
            + (f"{sum(o.unknown for o in some)}/{len(some)}" if outside else "-")
            + f" | {np.median(worst):.2f}, at most {max(worst):.2f} | "
            f"{np.median([o.seconds for o in some]):.0f} |"
        )
    lines += _coverage(done)
    failed = len(outcomes) - len(done)
    if failed:
        lines.append(f"\n{failed} sessions were refused.")
    return "\n".join(lines)


def _coverage(outcomes: Sequence[Outcome]) -> list[str]:
    """How often intervals of right models hold the truth, and how near strengths and shapes are."""
    found = [(o.case, p) for o in outcomes for p in o.parameters]
    if not found:
        return []
    lines = []
    groupings: dict[str, Callable[[Case, Found], str]] = {
        "kind": lambda _, p: p.kind,
        "day": lambda case, _: case.day,
        "machine": lambda case, _: case.machine,
    }
    for title, group_of in groupings.items():
        lines += [
            f"\n| method | {title} | parameters | within 1.96 sd | beyond 3 | beyond 4 | farthest"
            " | near, of those that sensors can tell | not identified |",
            "|-|-|-|-|-|-|-|-|-|",
        ]
        keys = sorted({(p.method, group_of(case, p)) for case, p in found})
        keys += [(method, "all") for method in sorted({p.method for _, p in found})]
        for method, group in keys:
            some = [p for c, p in found if p.method == method and group in ("all", group_of(c, p))]
            z = np.abs([p.z for p in some])
            near = [p.near for p in some if p.determinable]
            lines.append(
                f"| {method} | {group} | {len(z)} | {np.mean(z < 1.96):.1%} | {np.sum(z > 3.0)}"
                f" | {np.sum(z > 4.0)} | {z.max():.1f} | {sum(near)} of {len(near)}"
                f" | {sum(not p.determined for p in some)} |"
            )
    return lines


def _outcomes_of(path: Path) -> list[Outcome]:
    """The outcomes in a file that ``--out`` wrote."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return [TypeAdapter(Outcome).validate_json(line) for line in lines]


def main(arguments: Sequence[str]) -> None:
    """Run the cases asked for, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("machine", nargs="*", default=["bam"], help=", ".join(MACHINES))
    parser.add_argument("--hidden", nargs="*", default=[], help="effects joined by +, or nothing")
    parser.add_argument("--counts", nargs="*", type=int, default=[], help="effects to draw")
    parser.add_argument("--outside", type=int, default=0, help="effects outside to draw beside")
    parser.add_argument("--conditions", nargs="*", default=["good"], choices=list(DAYS))
    parser.add_argument("--strength", type=float, default=1.0)
    parser.add_argument("--creep", action="store_true", help="dry friction smoothed, as in bampipe")
    parser.add_argument("--pace", type=float, default=1.0, help="how fast the motion is")
    parser.add_argument("--stop", action="store_true", help="the damper's friction truly stops it")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--trials", type=int, help="trials a session, in place of the usual")
    parser.add_argument("--seconds", type=float, help="length of each")
    parser.add_argument("--replicates", type=int, default=Criteria.replicates)
    parser.add_argument(
        "--given", nargs="*", metavar="METHOD", help="give the model the hidden effects (auto)"
    )
    parser.add_argument("--auto", action="store_true", help="follow the diagnosis to its end")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, help="add the outcomes as JSON, a line each")
    parser.add_argument("--table", type=Path, nargs="+", help="the table of such files alone")
    parser.add_argument("--list", action="store_true", help="print what each machine can hide")
    options = parser.parse_args(arguments)
    if options.list:
        for name, machine in MACHINES.items():
            print(f"{name}: {' '.join(machine.EFFECTS)}\n  outside: {' '.join(machine.UNKNOWN)}")
        return
    if options.table:
        print(write_table([outcome for path in options.table for outcome in _outcomes_of(path)]))
        return
    given = () if options.given is None else tuple(options.given or ["auto"])
    cases = []
    for machine in options.machine:
        for day in options.conditions:
            for seed in range(options.first_seed, options.first_seed + options.seeds):
                sets = [tuple(h.split("+")) if h != "nothing" else () for h in options.hidden]
                sets += [
                    draw_effects(machine, count, options.outside, seed) for count in options.counts
                ]
                cases += [
                    Case(machine, effects, options.strength, day, options.creep, seed,
                         options.replicates, options.auto, given, options.trials, options.seconds,
                         options.stop, options.pace)
                    for effects in sets
                ]  # fmt: skip
    outcomes = []
    with ProcessPoolExecutor(options.jobs) as pool:
        for outcome in pool.map(run_case, cases):
            outcomes.append(outcome)
            print(outcome.line(), flush=True)
            if options.out:
                with options.out.open("a", encoding="utf-8") as log:
                    log.write(json.dumps(asdict(outcome)) + "\n")
    print(write_table(outcomes))


if __name__ == "__main__":
    main(sys.argv[1:])
