"""Whether `identify` finds the truth once the model is right, for every effect of the library.

    python benchmarks/right_models.py --seeds 1 2

Each session hides one effect. It is identified and validated by the bare device and by the model
with that effect, and what comes out is held against the truth file: held-out error over noise
floor of both, how far each parameter is off in its standard deviations (z), and how wide these
are beside the least that the sensors allow (Cramér-Rao).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from estimators import MODEL, prepare
from hidden_effects import SINGLES

from bampipe.data.run_folder import RunFolder
from bampipe.files import write_text
from bampipe.progress import silent
from bampipe.results.identify import IdentifyResult
from bampipe.results.validate import ValidateResult
from bampipe.simulator import simulated_session as simulate
from bampipe.stages import identify, validate


@dataclass(frozen=True)
class Outcome:
    """What came out of one session.

    Attributes:
        effect: the hidden one; seed: of the session; method: of the identification.
        before, after: largest held-out error over noise floor of any axis, without and with it.
        z: parameters of the effect, then of the device, off by so many standard deviations.
        widths: standard deviations over their Cramér-Rao bounds, in the same order.
        own: how many of these are of the effect.
        seconds: CPU time of identifying the model with the effect.
    """

    effect: str
    seed: int
    method: str
    before: float
    after: float
    z: tuple[float, ...]
    widths: tuple[float, ...]
    own: int
    seconds: float

    def line(self) -> str:
        """One line of the table."""
        z, widths = np.abs(self.z), np.array(self.widths)
        return (
            f"{self.effect:38s} {self.seed:5d}  {self.method:13s} {self.before:7.1f} "
            f"{self.after:6.2f} {z[: self.own].max():6.1f} {z[self.own :].max():6.1f} "
            f"{widths[: self.own].max():7.1f} {self.seconds:6.1f}"
        )


def _ratio(run: RunFolder, name: str) -> float:
    validate.execute(run, run.root, validate.Config(model=name, free_run=False), silent)
    axes = run.read(ValidateResult, name).axes.values()
    return max(axis.held_out_rmse / axis.noise_floor for axis in axes if axis.noise_floor)


def outcome(effect: str, seed: int) -> Outcome:
    """Simulate a session with one effect and identify it without and with that effect."""
    braked = effect.startswith("brake")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        config = simulate.Config(effects=(effect,), seed=seed, viscous_trials=3 if braked else 0)
        run, truth = prepare(root, config)
        right = MODEL.replace("[]", json.dumps([effect])).replace('"base"', '"right"', 1)
        write_text(run.path("models/right/model.toml"), right)
        ratios, seconds = [], 0.0
        for name in ("base", "right"):
            begun = time.process_time()
            identify.execute(run, run.root, identify.Config(model=name), silent)
            seconds = time.process_time() - begun
            ratios.append(_ratio(run, name))
        found = run.read(IdentifyResult, "right")
    entries = found.parameters
    head = effect.split(":")[0]
    own = [name for name in entries if name.startswith(f"{head}.")]
    names = [*own, *(name for name in entries if name not in own)]
    return Outcome(
        effect,
        seed,
        found.method,
        *ratios,
        tuple((entries[n].estimate - truth[n]) / entries[n].sd for n in names),
        tuple(entries[n].sd / (entries[n].bound_sd or np.inf) for n in names),
        len(own),
        seconds,
    )


def report(outcomes: Sequence[Outcome]) -> None:
    """Print what the sessions have in common."""
    z = np.concatenate([o.z for o in outcomes])
    own = np.concatenate([o.z[: o.own] for o in outcomes])
    after = np.array([o.after for o in outcomes])
    widths = np.concatenate([o.widths[: o.own] for o in outcomes])
    print(
        f"\n{len(outcomes)} sessions, {own.size} parameters of effects, {z.size} in all\n"
        f"  error over floor with the effect: median {np.median(after):.2f}, largest "
        f"{after.max():.2f}\n"
        f"  truth within 1.96 standard deviations: {np.mean(np.abs(own) < 1.96):.1%} of the "
        f"effects' parameters, {np.mean(np.abs(z) < 1.96):.1%} of all\n"
        f"  farthest off: {np.abs(own).max():.1f} and {np.abs(z).max():.1f} standard deviations\n"
        f"  standard deviation over Cramér-Rao bound, the effects' parameters: median "
        f"{np.median(widths):.2f}, 90 % below {np.quantile(widths, 0.9):.1f}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--effects", nargs="+", default=list(SINGLES), metavar="NAME")
    parser.add_argument("--jobs", type=int, default=2)
    chosen = parser.parse_args(arguments)
    print(
        f"{'effect':38s} {'seed':>5s}  {'method':13s} {'before':>7s} {'after':>6s} {'z own':>6s} "
        f"{'others':>6s} {'sd/CRB':>7s} {'CPU s':>6s}"
    )
    cases = [(effect, seed) for seed in chosen.seeds for effect in chosen.effects]
    outcomes = []
    with ProcessPoolExecutor(chosen.jobs) as pool:
        for found in pool.map(outcome, *zip(*cases, strict=True)):
            outcomes.append(found)
            print(found.line())
            sys.stdout.flush()
    report(outcomes)


if __name__ == "__main__":
    main()
