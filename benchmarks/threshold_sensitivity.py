"""Which thresholds of a diagnosis its verdicts hang on: each at half and at twice its odds.

    python benchmarks/threshold_sensitivity.py --first-seed 8100 --jobs 2

Sessions come from the independent simulators: one with nothing hidden, weak effects, several at
once, and what the library does not have. Each is diagnosed as it stands, then once for every
threshold of `Settings` moved either way: a share by a factor of two in its odds, what may exceed
one by a factor of two itself. The table has what then is named otherwise.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path

from independent import record
from recovery import PIPELINE
from thresholds import SHORT

import bampipe
from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model_file import identified, load_model, read_recipe
from bampipe.discover.diagnosis import diagnose
from bampipe.discover.settings import Settings
from bampipe.physics import compile_model
from bampipe.results.identify import IdentifyResult
from bampipe.trials.measured import read_measured_trials

SESSIONS = (
    ("joint", {}),
    ("joint", {"stribeck:joint": 0.35}),
    ("joint", {"load_dependent_friction:joint": 1.0, "presliding:joint": 1.0}),
    ("joint", {"actuator_lag:current": 1.0, "asymmetric_coulomb:joint": 0.5}),
    ("joint", {"detent:joint": 1.0}),
    ("axis", {}),
    ("axis", {"torque_ripple:carriage": 0.35}),
    ("axis", {"presliding:carriage": 1.0, "quadratic_drag:carriage": 1.0}),
    ("axis", {"rough_patch:carriage": 1.0}),
)
DRAFTS = "draft_"
"""Settings of the search for formulas, which no diagnosis reads."""


@dataclass(frozen=True)
class Answer:
    """What one diagnosis said: verdicts in the order of the axes, and what it would add."""

    verdicts: tuple[str, ...]
    selected: frozenset[str]


def moved(value: float) -> tuple[float, float]:
    """The threshold with half and with twice its odds, or size."""
    if value >= 1.0:
        return value / 2.0, 2.0 * value
    odds = value / (1.0 - value)
    return odds / (2.0 + odds), 2.0 * odds / (1.0 + 2.0 * odds)


def thresholds() -> list[str]:
    """Names of the settings that are thresholds: real numbers, not those of drafts."""
    return [
        f.name
        for f in fields(Settings)
        if isinstance(f.default, float) and not f.name.startswith(DRAFTS)
    ]


def answer_all(number: int, seed: int, replicates: int) -> dict[tuple[str, str], Answer]:
    """Record a session and diagnose it; answers by threshold and way it was moved."""
    machine, effects = SESSIONS[number]
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        record(machine, root / "session", seed, effects, SHORT[machine])
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
        recipe, start = read_recipe(run, "base", model), identified(run, "base", system)
        plain = Settings(replicates=replicates, jobs=1, seed=seed)

        def answer(settings: Settings) -> Answer:
            found = diagnose(trials, recipe, start, settings)
            return Answer(tuple(a.verdict for a in found.axes), frozenset(found.selected))

        answers = {("", ""): answer(plain)}
        for name in thresholds():
            for way, value in zip(("half", "twice"), moved(getattr(plain, name)), strict=True):
                answers[name, way] = answer(replace(plain, **{name: value}))
    return answers


def _words(answer: Answer) -> str:
    named = ", ".join(f"`{name}`" for name in sorted(answer.selected))
    return f"{', '.join(answer.verdicts).replace('_', ' ')}{': ' if named else ''}{named}"


def main(arguments: Sequence[str]) -> None:
    """Diagnose every session under every setting, and print what hangs on which."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first-seed", type=int, default=8100)
    parser.add_argument("--replicates", type=int, default=4)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args(arguments)
    seeds = [options.first_seed + k for k in range(len(SESSIONS))]
    names = thresholds()
    held = dict.fromkeys(names, 0)
    lines = []
    with ProcessPoolExecutor(options.jobs) as pool:
        asked = [pool.submit(answer_all, k, s, options.replicates) for k, s in enumerate(seeds)]
        for (machine, effects), seed, one in zip(SESSIONS, seeds, asked, strict=True):
            answers = one.result()
            hidden = ", ".join(f"{e} at {s:g}" for e, s in effects.items()) or "nothing"
            usual = answers["", ""]
            print(f"{machine}, seed {seed}, {hidden}: {_words(usual)}", flush=True)
            for name in names:
                others = {way: answers[name, way] for way in ("half", "twice")}
                if all(other == usual for other in others.values()):
                    held[name] += 1
                lines += [
                    f"| {name} | {way} | {machine}, {hidden} | {_words(other)} |"
                    for way, other in others.items()
                    if other != usual
                ]
    print("\n| threshold | moved to | session | answer |\n|-|-|-|-|")
    print("\n".join(sorted(lines)))
    firm = [name for name in names if held[name] == len(SESSIONS)]
    print(f"\n{len(firm)} of {len(names)} thresholds change no answer: {', '.join(firm)}.")


if __name__ == "__main__":
    main(sys.argv[1:])
