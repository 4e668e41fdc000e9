"""Where the thresholds of a verdict belong: clean sessions beside weak effects.

    python benchmarks/thresholds.py --clean 20 --weak 20 --figure docs/figures/thresholds.svg

Sessions come from the independent simulators with fresh seeds. Of each axis it takes the held-out
error over the noise floor, the share of the residual that can be predicted beyond chance, and the
largest fall of the log error that any candidate brings: by chance where nothing is hidden, and of
the right effect where a weak one is. Then one table: quantiles of the clean axes, and what share of
the weak effects lies above each.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib
import numpy as np
from independent import record
from independent.sensors import Conditions
from recovery import PIPELINE

import bampipe

matplotlib.use("Agg")
from matplotlib import pyplot as plt

SHORT = {
    "bam": Conditions(trials=3, seconds=8.0, rate_hz=250.0),
    "joint": Conditions(trials=4, seconds=10.0),
    "axis": Conditions(trials=4, seconds=5.0),
}
WEAK = {
    "bam": ("stribeck:yaw", "stribeck:extension", "presliding:pitch", "quadratic_drag:yaw",
            "position_dependent_friction:extension", "load_dependent_friction:extension",
            "return_spring:yaw", "asymmetric_coulomb:pitch"),
    "joint": ("stribeck:joint", "load_dependent_friction:joint", "asymmetric_coulomb:joint"),
    "axis": ("stribeck:carriage", "asymmetric_coulomb:carriage", "torque_ripple:carriage"),
}  # fmt: skip
STRENGTHS = (0.1, 0.2, 0.35)
SCALES = ("force_gain", "encoder_scale")
"""Effects that make both sides of the equation smaller, and with them any error."""

MEASURES = {
    "ratio": "held-out error over noise floor",
    "share": "predictable share of the residual beyond chance",
    "gain": "fall of the log error by one effect",
}


@dataclass(frozen=True)
class Case:
    """One session to record and diagnose; ``strength`` is zero where nothing is hidden."""

    machine: str
    seed: int
    creep: bool
    effect: str = ""
    strength: float = 0.0

    @property
    def group(self) -> str:
        """What it is pooled with: a machine, and how its dry friction stops it."""
        return f"{self.machine}, {'smoothed friction' if self.creep else 'true standstill'}"


@dataclass(frozen=True)
class Point:
    """One axis of a session, by the names of MEASURES; ``named``: something was said to lack."""

    case: Case
    ratio: float
    share: float
    gain: float
    named: bool


def measure(case: Case, replicates: int) -> list[Point]:
    """Record and diagnose one session; its axes, or the one that the weak effect acts on."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        effects = {case.effect: case.strength} if case.effect else {}
        conditions = replace(SHORT[case.machine], creep=case.creep)
        record(case.machine, root / "session", case.seed, effects, conditions)
        (root / "recovery.toml").write_text(PIPELINE)
        run = bampipe.run_session(
            root / "session", runs=root / "runs", pipeline=str(root / "recovery.toml")
        )
        found = bampipe.diagnose(run, replicates=replicates, jobs=1, seed=case.seed)
    points = []
    for axis, entry in found["axes"].items():
        if case.effect and not case.effect.endswith(f":{axis}"):
            continue
        gains = [
            np.log(row["held_out_rmse_before"] / row["held_out_rmse_after"])
            for row in found["ranking"]
            if row["axis"] == axis
            and case.effect in ("", row["effect"])
            and not row["effect"].startswith(SCALES)
        ]
        ratio = entry["rmse_before"] / entry["noise_floor"]
        points.append(
            Point(case, ratio, entry["explainable_share"], max(gains, default=0.0),
                  entry["verdict"] != "nothing_missing")
        )  # fmt: skip
    return points


def write_table(points: Sequence[Point]) -> str:
    """Quantiles of the clean axes and the share of the weak effects beyond them, as Markdown."""
    lines = []
    for group in sorted({p.case.group for p in points}):
        clean = [p for p in points if p.case.group == group and not p.case.effect]
        weak = [p for p in points if p.case.group == group and p.case.effect]
        accused = sum(p.named for p in clean)
        lines += [
            f"\n{group}: {len(clean)} clean axes, {accused} of them said to lack something\n",
            "| measure | 50 % | 90 % | 95 % | largest | "
            + " | ".join(f"weak effects at {s:g} above the 95 %" for s in STRENGTHS) + " |",
            "|-" * (5 + len(STRENGTHS)) + "|",
        ]  # fmt: skip
        for name, words in MEASURES.items():
            values = np.array([getattr(p, name) for p in clean])
            if not len(values):
                continue
            limits = [*np.quantile(values, (0.5, 0.9, 0.95)), values.max()]
            row = [f"{v:.3f}" for v in limits]
            for strength in STRENGTHS:
                some = [getattr(p, name) for p in weak if p.case.strength == strength]
                row.append(f"{sum(v > limits[2] for v in some)} of {len(some)}")
            lines.append(f"| {words} | {' | '.join(row)} |")
    return "\n".join(lines)


def draw_figure(points: Sequence[Point], path: Path) -> None:
    """Cumulative distribution of each measure, clean axes beside weak effects."""
    figure, panels = plt.subplots(1, len(MEASURES), figsize=(10.0, 3.2), layout="constrained")
    for panel, (name, words) in zip(panels, MEASURES.items(), strict=True):
        for creep, style in ((True, "-"), (False, "--")):
            for strength in (0.0, *STRENGTHS):
                chosen = [p for p in points if (p.case.creep, p.case.strength) == (creep, strength)]
                values = np.sort([getattr(p, name) for p in chosen])
                if len(values):
                    label = f"strength {strength:g}" if strength else "nothing hidden"
                    colour = f"C{STRENGTHS.index(strength) + 1}" if strength else "black"
                    label = label if creep else f"{label}, true standstill"
                    share = np.arange(1, len(values) + 1) / len(values)
                    panel.step(values, share, style, color=colour, label=label, where="post")
        panel.set_xlabel(words)
    panels[0].set_xlim(0.5, 4.0)
    panels[0].set_ylabel("share of axes")
    panels[-1].legend(fontsize=6)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})


def main(arguments: Sequence[str]) -> None:
    """Measure, print the table, draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("machines", nargs="*", default=["bam"], help=", ".join(SHORT))
    parser.add_argument("--clean", type=int, default=10, help="clean sessions of each machine")
    parser.add_argument("--weak", type=int, default=10, help="sessions with a weak effect")
    parser.add_argument(
        "--standstill", action="store_true", help="also dry friction that truly stops"
    )
    parser.add_argument("--first-seed", type=int, default=7000)
    parser.add_argument("--replicates", type=int, default=10)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--figure", type=Path, help="draw the distributions")
    options = parser.parse_args(arguments)
    cases = []
    for machine in options.machines:
        for creep in (True, False) if options.standstill else (True,):
            seeds = range(options.first_seed, options.first_seed + options.clean)
            cases += [Case(machine, seed, creep) for seed in seeds]
            for k in range(options.weak):
                effect = WEAK[machine][k // len(STRENGTHS) % len(WEAK[machine])]
                strength = STRENGTHS[k % len(STRENGTHS)]
                cases.append(Case(machine, seeds.stop + k, creep, effect, strength))
    points: list[Point] = []
    with ProcessPoolExecutor(options.jobs) as pool:
        for some in pool.map(measure, cases, [options.replicates] * len(cases)):
            points += some
            for p in some:
                print(
                    f"{p.case.group} {p.case.seed} {p.case.effect or 'nothing'} "
                    f"{p.case.strength:g}: {p.ratio:.2f} {p.share:.2f} {p.gain:.3f}"
                    f"{' named' if p.named else ''}",
                    flush=True,
                )
    print(write_table(points))
    if options.figure:
        draw_figure(points, options.figure)


if __name__ == "__main__":
    main(sys.argv[1:])
