"""By how much each threshold of a diagnosis could move before anything comes out otherwise.

    python benchmarks/margins.py bam joint axis damper --vary joint axis --out margins.json
    python benchmarks/margins.py --table margins.json --figure docs/figures/margins.svg

Sessions come from the independent simulators: of each machine two with nothing hidden, two with one
effect, two with two, one with an effect outside the library. Each is diagnosed once with every
threshold watched: whatever is compared with it is recorded as the value of the threshold at which
that comparison would turn. Between the nearest of these below and above, no decision of the session
depends on the threshold.

Beyond that interval a comparison turns, which need not change a verdict. So some sessions are
diagnosed again with one threshold halved or doubled at a time, wherever that lies outside the
interval, or where a threshold enters a number before that is compared. What counts is whether the
effects found, a verdict by axis or a drafted formula change.
"""

from __future__ import annotations

import argparse
import json
import operator
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any
from unittest import mock

import matplotlib
import numpy as np
from independent import record
from independent.sensors import Conditions
from pydantic import TypeAdapter
from recovery import PIPELINE

import bampipe
from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model_file import identified, load_model, read_recipe
from bampipe.discover import search
from bampipe.discover.diagnosis import diagnose
from bampipe.discover.drafts.search import draft
from bampipe.discover.settings import Settings
from bampipe.physics import compile_model
from bampipe.physics.recipe import Recipe
from bampipe.results import standing
from bampipe.results.identify import IdentifyResult
from bampipe.trials.measured import MeasuredTrials, read_measured_trials

matplotlib.use("Agg")
from matplotlib import pyplot as plt

SHORT = {
    "bam": Conditions(creep=True, trials=3, seconds=8.0, rate_hz=250.0),
    "joint": Conditions(creep=True, trials=4, seconds=10.0),
    "axis": Conditions(creep=True, trials=4, seconds=5.0),
    "damper": Conditions(creep=True, trials=4, seconds=10.0),
}
HIDDEN = {
    "bam": ("", "stribeck:yaw+return_spring:pitch", "detent:yaw", "presliding:pitch", "",
            "stribeck:extension", "force_bias:x+asymmetric_coulomb:yaw"),
    "joint": ("", "stribeck:joint+return_spring:joint", "detent:joint",
              "load_dependent_friction:joint", "", "torque_ripple:joint",
              "quadratic_drag:joint+asymmetric_coulomb:joint"),
    "axis": ("", "torque_ripple:carriage+presliding:carriage", "rough_patch:carriage",
             "stribeck:carriage", "", "asymmetric_coulomb:carriage",
             "quadratic_drag:carriage+return_spring:carriage"),
    "damper": ("", "quadratic_drag:piston+asymmetric_coulomb:piston", "soft_oil:piston",
               "hysteresis:piston", "", "return_spring:piston",
               "channel_lag:current+return_spring:piston"),
}  # fmt: skip
VARIED = 3
"""Sessions of a machine, the first ones, that are diagnosed again."""
DRAFTED = (0, 2)
"""Sessions of a machine on which a formula is drafted: nothing hidden, and outside the library."""

OF_STANDING = {name: getattr(standing, name) for name in ("AT_FLOOR", "FLOOR_SDS", "IMPLAUSIBLE")}
NO_THRESHOLDS = ("jobs", "seed")
DEFAULTS = OF_STANDING | {
    f.name: f.default for f in fields(Settings) if f.name not in NO_THRESHOLDS
}
IN_A_NUMBER = (
    "worth_at_floor", "above_floor_sd", "held_out_weight", "score_error", "score_sd",
    "replay_error", "close", "closer", "draft_close", "other_band_ratio",
)  # fmt: skip
"""Never compared by themselves."""
IN_BOTH = ("AT_FLOOR", "worth")
"""Compared by themselves here, as a part of something else there: the interval is of the former."""
OF_SENTENCES = (
    "rival_score", "other_band_replicates", "other_band_ratio", "variable_share",
    "mentioned_share", "ripple_share", "direction_likeness", "bump_height", "bump_width",
)  # fmt: skip
"""They decide what is said of a finding, and nothing else."""
OF_THE_NEXT_TRIAL = ("confused", "confusion_left", "lowered", "least_odds")
"""No part of a diagnosis."""
WATCHED = [n for n, v in DEFAULTS.items() if isinstance(v, float) and n not in IN_A_NUMBER]


@dataclass
class Margin:
    """What was compared with a threshold.

    Attributes:
        count: comparisons.
        below, above: nearest values of the threshold at which one would have turned.
    """

    count: int = 0
    below: float = -np.inf
    above: float = np.inf

    def add(self, default: float, turns: np.ndarray) -> None:
        """Take comparisons that turn where the threshold is ``turns``."""
        turns = turns[~np.isnan(turns)]
        self.count += turns.size
        self.below = float(turns[turns <= default].max(initial=self.below))
        self.above = float(turns[turns > default].min(initial=self.above))

    def joined(self, other: Margin) -> Margin:
        """Of two sessions."""
        return Margin(
            self.count + other.count, max(self.below, other.below), min(self.above, other.above)
        )


class Watched(float):
    """A threshold, or a number made of thresholds, that notes what it is compared with.

    ``slopes`` are its derivatives by each threshold that it is made of.
    """

    # Arrays and numpy's scalars leave the operation to this class.
    __array_ufunc__ = None

    slopes: Mapping[str, float]
    log: dict[str, Margin]

    def __new__(cls, value: float, slopes: Mapping[str, float], log: dict[str, Margin]) -> Watched:
        made = super().__new__(cls, value)
        made.slopes, made.log = slopes, log
        return made

    def _made(self, value: float, own: float, other: Any = None, theirs: float = 0.0) -> Watched:
        slopes = {name: own * slope for name, slope in self.slopes.items()}
        for name, slope in getattr(other, "slopes", {}).items():
            slopes[name] = slopes.get(name, 0.0) + theirs * slope
        return Watched(value, slopes, self.log)

    def __add__(self, other: Any) -> Any:
        if np.ndim(other):
            return float(self) + other
        return self._made(float(self) + float(other), 1.0, other, 1.0)

    def __sub__(self, other: Any) -> Any:
        if np.ndim(other):
            return float(self) - other
        return self._made(float(self) - float(other), 1.0, other, -1.0)

    def __rsub__(self, other: Any) -> Any:
        if np.ndim(other):
            return other - float(self)
        return self._made(float(other) - float(self), -1.0)

    def __mul__(self, other: Any) -> Any:
        if np.ndim(other):
            return float(self) * other
        return self._made(float(self) * float(other), float(other), other, float(self))

    def __truediv__(self, other: float) -> Watched:
        return self._made(float(self) / float(other), 1.0 / float(other))

    def __neg__(self) -> Watched:
        return self._made(-float(self), -1.0)

    __radd__, __rmul__ = __add__, __mul__

    def _compare(self, other: Any, how: Callable[[Any, Any], Any]) -> Any:
        gap, slopes = float(self) - np.asarray(other, dtype=float), dict(self.slopes)
        for name, slope in getattr(other, "slopes", {}).items():
            slopes[name] = slopes.get(name, 0.0) - slope
        for name, slope in slopes.items():
            if slope:
                self.log[name].add(DEFAULTS[name], np.atleast_1d(DEFAULTS[name] - gap / slope))
        return how(float(self), float(other) if isinstance(other, Watched) else other)

    def __lt__(self, other: Any) -> Any:
        return self._compare(other, operator.lt)

    def __le__(self, other: Any) -> Any:
        return self._compare(other, operator.le)

    def __gt__(self, other: Any) -> Any:
        return self._compare(other, operator.gt)

    def __ge__(self, other: Any) -> Any:
        return self._compare(other, operator.ge)


def watch_all() -> tuple[dict[str, Watched], dict[str, Margin]]:
    """Every threshold that is a float, watched, and what will have been compared with each."""
    log = {name: Margin() for name in WATCHED}
    return {name: Watched(DEFAULTS[name], {name: 1.0}, log) for name in WATCHED}, log


@contextmanager
def thresholds(values: Mapping[str, float]) -> Iterator[None]:
    """Let all `Settings` made in this context, and `standing`, have other defaults."""
    defaults = tuple(values.get(f.name, f.default) for f in fields(Settings))
    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(Settings.__init__, "__defaults__", defaults))
        for name in {*OF_STANDING} & {*values}:
            for module in (standing, search):
                if hasattr(module, name):
                    stack.enter_context(mock.patch.object(module, name, values[name]))
        yield


def other_values(name: str) -> tuple[float, float]:
    """Half and twice a threshold; of a share above a half, halfway to one instead of twice."""
    value = DEFAULTS[name]
    if name == "AT_FLOOR":
        return 1.0 + 0.5 * (value - 1.0), 1.0 + 2.0 * (value - 1.0)
    if isinstance(value, int):
        return max(value // 2, 1), 2 * value
    return 0.5 * value, 2.0 * value if value < 0.5 or value >= 1.0 else 0.5 * (1.0 + value)


@dataclass(frozen=True)
class Case:
    """One session: the number of its kind in `HIDDEN`, its seed, how strong what is hidden is."""

    machine: str
    kind: int
    seed: int
    strength: float = 0.5

    @property
    def effects(self) -> tuple[str, ...]:
        """What is hidden."""
        return tuple(filter(None, HIDDEN[self.machine][self.kind].split("+")))


@dataclass(frozen=True)
class Session:
    """A session that is ready to be diagnosed."""

    case: Case
    trials: MeasuredTrials
    recipe: Recipe
    start: np.ndarray

    def diagnosed(self) -> tuple[list[str], list[str]]:
        """Verdict by axis, then the effects found; and what is said of each axis."""
        settings = Settings(jobs=1, seed=self.case.seed)
        found = diagnose(self.trials, self.recipe, self.start, settings)
        decisions = [*(axis.verdict for axis in found.axes), *sorted(found.selected)]
        return decisions, [axis.sentence for axis in found.axes]

    def drafts(self) -> list[str]:
        """Formulas on the axis where something is hidden, or on the first one."""
        axes = [c.name for c in self.recipe.model().device.coordinates]
        at = axes.index(self.case.effects[0].partition(":")[2]) if self.case.effects else 0
        settings = Settings(jobs=1, seed=self.case.seed)
        found = draft(self.trials, self.recipe, self.start, [at], settings, "a benchmark")
        return [term.canonical for axis in found for term in axis.terms]


@dataclass
class Outcome:
    """What came of one session.

    Attributes:
        case: the session; decisions, sentences: of its diagnosis; drafts: formulas.
        margins: by threshold.
        changes: by threshold, what the halved and the doubled one decide otherwise; "" where
            nothing; missing where that was not asked.
    """

    case: Case
    decisions: list[str]
    sentences: list[str]
    drafts: list[str]
    margins: dict[str, Margin]
    changes: dict[str, list[str]] = field(default_factory=dict)


@contextmanager
def recorded(case: Case) -> Iterator[Session]:
    """Record a session, in a temporary folder, and run it up to its diagnosis."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        effects = dict.fromkeys(case.effects, case.strength)
        record(case.machine, root / "session", case.seed, effects, SHORT[case.machine])
        (root / "recovery.toml").write_text(PIPELINE)
        made = bampipe.run_session(
            root / "session", runs=root / "runs", pipeline=str(root / "recovery.toml")
        )
        run = RunFolder(made.root)
        model = load_model(run, "base")
        system = compile_model(model)
        timing = run.read(IdentifyResult, "base").input_timing
        trials = read_measured_trials(run, system, every_input=True, timing=timing)
        trials = replace(trials, motions=tuple(trials.motions))
        yield Session(
            case, trials, read_recipe(run, "base", model), identified(run, "base", system)
        )


def measure(case: Case, varied: bool) -> Outcome:
    """Diagnose one session with every threshold watched, then with each one halved and doubled."""
    with recorded(case) as session:
        values, log = watch_all()
        with thresholds(values):
            decisions, sentences = session.diagnosed()
            drafts = session.drafts() if case.kind in DRAFTED else []
        outcome = Outcome(case, decisions, sentences, drafts, log)
        for name in DEFAULTS if varied else ():
            no_draft = name.startswith("draft_") and case.kind not in DRAFTED
            if name in OF_THE_NEXT_TRIAL or no_draft:
                continue
            outcome.changes[name] = [
                _change(session, outcome, name, value) for value in other_values(name)
            ]
    return outcome


def _change(session: Session, known: Outcome, name: str, value: float) -> str:
    """What another value of a threshold decides otherwise; "" where nothing."""
    margin = known.margins.get(name)
    if margin and name not in IN_BOTH and margin.below < value < margin.above:
        return ""  # no comparison turns
    with thresholds({name: value}):
        if name.startswith("draft_"):
            was, now = known.drafts, session.drafts()
        else:
            which = int(name in OF_SENTENCES)
            was = (known.decisions, known.sentences)[which]
            now = session.diagnosed()[which]
    return "" if was == now else f"{', '.join(was)} -> {', '.join(now)}"


def pool(outcomes: Sequence[Outcome]) -> dict[str, Margin]:
    """Margins over all sessions, by threshold."""
    pooled = {name: Margin() for name in WATCHED}
    for outcome in outcomes:
        for name, margin in outcome.margins.items():
            pooled[name] = pooled[name].joined(margin)
    return pooled


def count_changes(outcomes: Sequence[Outcome], name: str) -> list[str]:
    """How many of the varied sessions a halved and a doubled threshold change: "1 of 8" each."""
    asked = [o.changes[name] for o in outcomes if name in o.changes]
    return [f"{sum(bool(one[k]) for one in asked)} of {len(asked)}" for k in (0, 1)]


def _number(value: float) -> str:
    return "–" if value < 0.0 or np.isinf(value) else f"{value:.4g}"


def write_table(outcomes: Sequence[Outcome]) -> str:
    """One row a threshold, as Markdown."""
    pooled = pool(outcomes)
    lines = [
        "| threshold | default | comparisons | none turns from | to | lower: changed | "
        "higher: changed |",
        "|-|-|-|-|-|-|-|",
    ]
    for name, default in DEFAULTS.items():
        margin = pooled.get(name, Margin())
        ends = ("–", "–") if not margin.count else map(_number, (margin.below, margin.above))
        count = f"{margin.count}" if name in pooled else "–"
        star = "\\*" if name in IN_BOTH else ""
        changed = [
            f"{value:.3g}: {how}" if not how.endswith(" of 0") else "–"
            for value, how in zip(other_values(name), count_changes(outcomes, name), strict=True)
        ]
        lines.append(
            f"| `{name}`{star} | {default:.3g} | {count} | {' | '.join(ends)} | "
            f"{' | '.join(changed)} |"
        )
    return "\n".join(lines)


def draw_figure(outcomes: Sequence[Outcome], path: Path) -> None:
    """The interval of each threshold over its default, and what its half and its double change."""
    pooled = pool(outcomes)
    varied = {name for outcome in outcomes for name in outcome.changes}
    rows = [name for name in DEFAULTS if name in varied or pooled.get(name, Margin()).count]
    figure, panel = plt.subplots(figsize=(8.0, 0.18 * len(rows) + 1.4), layout="constrained")
    low, high = 0.1, 10.0
    for row, name in enumerate(rows):
        default, margin = DEFAULTS[name], pooled.get(name, Margin())
        if margin.count:
            ends = np.clip([margin.below / default, margin.above / default], low, high)
            panel.barh(row, ends[1] - ends[0], left=ends[0], height=0.7, color="C0", alpha=0.35)
            known = [outcome.margins[name] for outcome in outcomes]
            near = np.array([(one.below, one.above) for one in known]).ravel() / default
            near = near[(near > low) & (near < high)]
            panel.plot(near, np.full(len(near), row), "|", color="black", ms=5, mew=0.7)
        for k, value in enumerate(other_values(name)):
            asked = [outcome.changes[name][k] for outcome in outcomes if name in outcome.changes]
            changed = sum(map(bool, asked))
            if changed:
                at = {"ha": "center", "va": "center", "color": "white", "fontsize": 6}
                panel.plot(value / default, row, "o", color="C3", ms=8)
                panel.text(value / default, row, f"{changed}", **at)
            elif asked:
                panel.plot(value / default, row, "o", color="C2", ms=4)
    panel.axvline(1.0, color="black", lw=1.0)
    panel.set(xscale="log", xlim=(low, high), ylim=(len(rows) - 0.4, -0.6))
    ticks = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0]
    panel.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    panel.set_yticks(range(len(rows)), rows, fontsize=7)
    panel.set_xlabel(
        "threshold over its default\nbar: no comparison turns; line: nearest comparison of one "
        "session\ndot: sessions changed by this value, red with their number, green for none",
        fontsize=8,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with plt.rc_context({"svg.hashsalt": "margins"}):
        figure.savefig(path, metadata={"Date": None})


def main(arguments: Sequence[str]) -> None:
    """Measure, print the table, draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("machines", nargs="*", help=", ".join(SHORT))
    parser.add_argument("--vary", nargs="*", default=[], help="machines diagnosed again")
    parser.add_argument("--strength", type=float, default=0.5, help="of what is hidden")
    parser.add_argument("--first-seed", type=int, default=52000)
    parser.add_argument("--out", type=Path, help="write the outcomes as JSON, session by session")
    parser.add_argument("--table", type=Path, nargs="*", default=[], help="of such files")
    parser.add_argument("--figure", type=Path, help="draw the intervals")
    options = parser.parse_args(arguments)
    adapter = TypeAdapter(list[Outcome])
    outcomes = [o for path in options.table for o in adapter.validate_json(path.read_bytes())]
    for machine in options.machines:
        for kind in reversed(range(len(HIDDEN[machine]))):
            seed = options.first_seed + 100 * [*SHORT].index(machine) + kind
            case = Case(machine, kind, seed, options.strength)
            outcome = measure(case, machine in options.vary and kind < VARIED)
            outcomes.append(outcome)
            hidden = HIDDEN[machine][kind] or "nothing"
            print(machine, seed, hidden, "->", *outcome.decisions, *outcome.drafts, flush=True)
            for name, changes in outcome.changes.items():
                for value, change in zip(other_values(name), changes, strict=True):
                    if change:
                        print(f"  {name} {value:g}: {change}", flush=True)
            if options.out:
                options.out.write_text(json.dumps([asdict(o) for o in outcomes]))
    print(write_table(outcomes))
    if options.figure:
        draw_figure(outcomes, options.figure)


if __name__ == "__main__":
    main(sys.argv[1:])
