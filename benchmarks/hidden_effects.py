"""How often the diagnosis names the effect that was hidden in a simulated session.

Simulates sessions with fresh seeds, each with no, one or two hidden effects, diagnoses them without
the truth and prints one line a session, then a table: hits, false alarms, error over noise floor,
seconds. ``python benchmarks/hidden_effects.py --help`` lists the options.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

import bampipe
from bampipe.diagnosis.criteria import Criteria
from bampipe.progress import silent
from bampipe.simulator import simulated_session as simulate

SINGLES = (
    "stribeck:yaw", "stribeck:pitch", "stribeck:extension", "presliding:yaw", "presliding:pitch",
    "presliding:extension", "asymmetric_coulomb:yaw", "asymmetric_coulomb:extension",
    "quadratic_drag:yaw", "quadratic_drag:pitch", "quadratic_drag:extension",
    "position_dependent_friction:yaw", "position_dependent_friction:pitch",
    "position_dependent_friction:extension", "load_dependent_friction:yaw",
    "load_dependent_friction:extension", "thermal_damping:yaw", "thermal_damping:extension",
    "return_spring:yaw", "return_spring:extension", "inertia_mismatch:yaw",
    "inertia_mismatch:pitch", "handle_payload", "base_tilt", "gravity_compensator_lag",
    "gravity_compensator_rate_limit", "gravity_compensator_mistuned",
    "transmission_compliance:yaw", "transmission_compliance:pitch", "backlash:yaw",
    "force_bias:x", "force_bias:z", "force_gain:x", "force_gain:z", "force_crosstalk:xy",
    "force_crosstalk:zx", "force_delay", "force_drift:y", "force_application_point",
    "shear_thinning:yaw", "maxwell_slip:yaw", "upper_stop:yaw", "lower_stop:extension",
    "friction_by_pose:yaw-extension", "encoder_scale:yaw", "encoder_scale:extension", "brake_lag",
    "brake_residual_torque:yaw",
)  # fmt: skip
PIPELINE = """schema = "bampipe.pipeline/1"
name = "hidden"
stages = ["ingest", "filter", "identify"]
[settings.identify]
method = "least-squares"
"""
PLANTS = Path(__file__).parent / "plants"
OTHER_FORMS = {
    "stribeck_exponential:yaw": "stribeck:yaw",
    "stribeck_lorentzian:pitch": "stribeck:pitch",
    "presliding_spring:extension": "presliding:extension",
    "thermal_by_time:yaw": "thermal_damping:yaw",
    "thermal_by_work:extension": "thermal_damping:extension",
    "drag_three_halves:pitch": "quadratic_drag:pitch",
    "viscous_by_direction:yaw": "asymmetric_coulomb:yaw",
    "ripple_square:extension": "position_dependent_friction:extension",
    "end_cushion:yaw": "upper_stop:yaw",
}
"""The same physics as an effect of the library in other mathematics: that effect is to be named."""

OUTSIDE = (
    "detent:pitch", "detent:extension", "cogging:yaw", "friction_patch:pitch",
    "hum:yaw", "speed_resonance:yaw", "yaw_by_extension",
)  # fmt: skip
"""What no effect of the library says: unknown is the answer, or an error at the floor."""

PAIRS = (
    ("stribeck:yaw", "gravity_compensator_lag"),
    ("presliding:extension", "quadratic_drag:yaw"),
    ("position_dependent_friction:pitch", "force_delay"),
    ("handle_payload", "stribeck:extension"),
)


@dataclass(frozen=True)
class Case:
    """One session to simulate and diagnose."""

    effects: tuple[str, ...]
    strength: float
    seed: int
    replicates: int


@dataclass(frozen=True)
class Outcome:
    """What came of one session; ``named`` are the effects found, ``groups`` their equals."""

    effects: tuple[str, ...]
    strength: float
    seed: int
    named: tuple[str, ...]
    groups: tuple[tuple[str, ...], ...]
    verdicts: tuple[str, ...]
    ranked: tuple[str, ...]
    over_floor: tuple[float, ...]
    seconds: float

    @property
    def hit(self) -> bool:
        """Every hidden effect is named first, or within the group of one that is named.

        An effect outside the library is dealt with if an axis is called unknown, or if what was
        named brings every axis to its floor.
        """
        if any(e in OUTSIDE for e in self.effects):
            explained = bool(self.named) and max(self.over_floor) < 1.15
            return "unknown_effect" in self.verdicts or explained
        reach = [{n, *g} for n, g in zip(self.named, self.groups, strict=True)]
        wanted = [OTHER_FORMS.get(e, e) for e in self.effects]
        return all(any(e in group for group in reach) for e in wanted)

    @property
    def false_alarms(self) -> int:
        """Axes said to lack something in a session with nothing hidden."""
        return 0 if self.effects else sum(v != "nothing_missing" for v in self.verdicts)


def run_case(case: Case) -> Outcome:
    """Simulate and diagnose one case in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        config = simulate.Config(
            effects=case.effects, strength=case.strength, seed=case.seed,
            viscous_trials=3 * any(e.startswith("brake") for e in case.effects),
            locked_trials=False, effect_files=tuple(str(f) for f in sorted(PLANTS.glob("*.toml"))),
        )  # fmt: skip
        simulate.simulate_session(root / "session", config, silent)
        (root / "hidden.toml").write_text(PIPELINE)
        run = bampipe.run_session(
            root / "session", runs=root / "runs", pipeline=str(root / "hidden.toml")
        )
        begun = time.perf_counter()
        found = bampipe.diagnose(run, "base", replicates=case.replicates, jobs=1, seed=case.seed)
        seconds = time.perf_counter() - begun
    ranked, axes = {row["effect"]: row for row in found["ranking"]}, found["axes"].values()
    return Outcome(
        case.effects, case.strength, case.seed, tuple(found["selected"]),
        tuple(tuple(ranked[n]["indistinguishable_from"]) for n in found["selected"]),
        tuple(a["verdict"] for a in axes),
        tuple(ranked)[:5],
        tuple(round(a["rmse_after"] / (a["noise_floor"] or np.nan), 3) for a in axes), seconds,
    )  # fmt: skip


def table(outcomes: Sequence[Outcome]) -> str:
    """The summary as Markdown."""
    lines = [
        "| hidden | strength | sessions | found | error / floor, worst axis | s |",
        "|-|-|-|-|-|-|",
    ]
    keys = sorted({(o.effects, o.strength) for o in outcomes})
    for effects, strength in keys:
        some = [o for o in outcomes if (o.effects, o.strength) == (effects, strength)]
        if effects:
            hits = f"{sum(o.hit for o in some)}/{len(some)}"
        else:
            hits = f"{sum(o.false_alarms for o in some)} false alarms in {3 * len(some)} axes"
        worst = np.median([max(o.over_floor) for o in some])
        seconds = np.median([o.seconds for o in some])
        name = " + ".join(effects) or "nothing"
        lines.append(
            f"| {name} | {strength:g} | {len(some)} | {hits} | {worst:.2f} | {seconds:.0f} |"
        )
    for strength in sorted({o.strength for o in outcomes if o.effects}, reverse=True):
        some = [o for o in outcomes if len(o.effects) == 1 and o.strength == strength]
        if some:
            rate = 100 * np.mean([o.hit for o in some])
            lines.append(
                f"\nOne effect at strength {strength:g}: found in {rate:.0f} % of {len(some)}."
            )
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> None:
    """Run the cases asked for and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--effects", nargs="*", help="effects to hide (default: every one)")
    parser.add_argument("--strengths", nargs="*", type=float, default=[1.0, 0.5, 0.25])
    parser.add_argument("--seeds", type=int, default=2, help="sessions for each")
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--nothing", type=int, default=10, help="sessions with nothing hidden")
    parser.add_argument("--pairs", action="store_true", help="two effects at once too")
    parser.add_argument("--plants", action="store_true", help="other forms, and effects outside")
    parser.add_argument("--replicates", type=int, default=Criteria.replicates)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, help="write the outcomes as JSON")
    options = parser.parse_args(arguments)
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    chosen = SINGLES if options.effects is None else tuple(options.effects)
    plan = [((), 1.0, options.first_seed + 500 + k) for k in range(options.nothing)]
    plan += [((e,), s, seed) for s in options.strengths for e in chosen for seed in seeds]
    if options.pairs:
        plan += [(pair, 1.0, seed) for pair in PAIRS for seed in seeds]
    if options.plants:
        foreign = (*OTHER_FORMS, *OUTSIDE)
        plan += [((e,), s, seed) for s in options.strengths for e in foreign for seed in seeds]
    cases = [Case(*entry, options.replicates) for entry in plan]
    outcomes = []
    with ProcessPoolExecutor(options.jobs) as pool:
        for outcome in pool.map(run_case, cases):
            outcomes.append(outcome)
            mark = ("ok " if outcome.hit else "MISS") if outcome.effects else (
                "ok " if not outcome.false_alarms else "FALSE")  # fmt: skip
            print(
                mark, "+".join(outcome.effects) or "nothing", outcome.strength, outcome.seed, "->",
                outcome.named, outcome.groups, outcome.verdicts, outcome.ranked[:3],
                outcome.over_floor, f"{outcome.seconds:.0f}s", flush=True,
            )  # fmt: skip
    print(table(outcomes))
    if options.out:
        options.out.write_text(json.dumps([asdict(o) for o in outcomes], indent=1))


if __name__ == "__main__":
    main(sys.argv[1:])
