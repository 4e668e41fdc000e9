"""What the best motion could give beside free motion of the same length, by the Cramér-Rao bound.

    python benchmarks/best_designs.py --machine bam --seeds 8701 8702
    python benchmarks/best_designs.py --timid bias-gain --seeds 8701 8701
    python benchmarks/best_designs.py --run runs/2026-10-03_s01

A session of usual motion, or with ``--timid`` of confined motion, is recorded in a simulator that
shares no code with bampipe, and identified; ``--run`` takes one that has been. Printed are standard
deviations by one mean trial at hand over those by designs of its length that are followed exactly:
the designs of `bampipe next`; the same and others up to the highest speed and acceleration of the
session over all of the range that the device states, with other axes elsewhere; and the best
mixture of these, for each parameter alone and for all together.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from next_trials import TIMID, USUAL, run_of
from numpy.typing import NDArray

from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model_file import load_model, read_estimate
from bampipe.identification.identifiability import find_information
from bampipe.identification.sensor_noise import FilterChoice, untuned_settings
from bampipe.next_trial.primitives import (
    Envelope,
    Primitive,
    list_primitives,
    vary_surroundings,
)
from bampipe.next_trial.rehearsal import Rehearsal
from bampipe.physics import compile_model
from bampipe.results.identify import IdentifyResult
from bampipe.trials.measured import read_measured_trials
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import problem_of

Array = NDArray[np.float64]

_STEPS = 400
"""Of the multiplicative algorithm (Silvey, Titterington and Torsney 1978)."""
_BEST = 4
"""Designs of each parameter that are tried in other surroundings."""


class Session:
    """A session and what motions say of its parameters."""

    def __init__(self, root: Path) -> None:
        run = RunFolder(root)
        self.system = compile_model(load_model(run, "base"))
        p = read_estimate(run, "base", self.system)
        found = run.read(IdentifyResult, "base")
        trials = read_measured_trials(run, self.system, every_input=True, timing=found.input_timing)
        self.motions = [trials.motions[k] for k in trials.folds.fitted_trials]
        self.band, self.timed = trials.band, found.input_timing.limit > 0.0
        self.full = np.append(p, found.input_timing.estimate)
        self.noise = untuned_settings(trials.sensors, self.system, self.motions, p, FilterChoice())
        self.seen = Envelope.of_trials(trials.motions, self.system, p)
        self.rehearsal = Rehearsal(self.system, p, trials.sensors, trials.kinematics, self.seen, 0)
        problem = problem_of(self.system, self.motions[:1], self.band, timing=self.timed)
        assumed = [q.sd for q in self.system.parameters]
        sd = [assumed[i] if i < len(p) else problem.upper[-1] for i in problem.free]
        self.prior = np.diag(np.array(sd) ** -2.0)
        self.names = [self.system.parameters[i].name for i in problem.free if i < len(p)]

    def information(self, motion: Motion) -> Array:
        problem = problem_of(self.system, [motion], self.band, timing=self.timed)
        return find_information(self.system, motion, problem, 0, self.full, self.noise)

    def of_designs(self, designs: Sequence[Primitive]) -> Array:
        return np.array([self.information(self.rehearsal.record(one, 0)) for one in designs])

    def covariance(self, information: Array) -> Array:
        total = information + self.prior
        scale = 1.0 / np.sqrt(np.diag(total))
        return np.linalg.inv(total * np.outer(scale, scale)) * np.outer(scale, scale)

    def sd(self, information: Array) -> Array:
        return np.sqrt(np.diag(self.covariance(information))[: len(self.names)])

    def best_mixture(self, designs: Array, place: int | None) -> Array:
        """Information of the mixture that is best for one parameter, or None: for all together."""
        shares = np.full(len(designs), 1.0 / len(designs))
        for _ in range(_STEPS):
            covariance = self.covariance(np.einsum("i,ipq->pq", shares, designs))
            if place is None:
                slope = np.einsum("ipq,qp->i", designs, covariance)
            else:
                column = covariance[:, place]
                slope = np.einsum("p,ipq,q->i", column, designs, column) / column[place]
            shares = shares * np.sqrt(np.maximum(slope, 0.0))
            shares /= shares.sum()
        return np.einsum("i,ipq->pq", shares, designs)


def report(title: str, session: Session) -> None:
    """Print standard deviations by a mean trial at hand over those by designs."""
    seconds = float(np.mean([m.t[-1] - m.t[0] for m in session.motions]))
    free = np.mean(
        [session.information(m) * seconds / (m.t[-1] - m.t[0]) for m in session.motions], axis=0
    )
    at_hand, seen = session.sd(free), session.seen
    reach = seen.wider or seen
    # Bands of speed end at 0.6 of what an envelope has, accelerations at a quarter.
    hard = replace(
        reach,
        speed=np.maximum(reach.speed, seen.speed / 0.6),
        acceleration=np.maximum(reach.acceleration, seen.acceleration / 0.25),
        wider=None,
    )
    own = list_primitives(seen, seconds, seen.moved_axes, with_rests=True)
    hard_ones = [
        *list_primitives(hard, seconds, seen.moved_axes, with_rests=True),
        *list_primitives(
            replace(hard, low=seen.low, high=seen.high), seconds, seen.moved_axes, with_rests=True
        ),
    ]
    by_own, every = session.of_designs(own), [*own, *hard_ones]
    by_all = np.concatenate([by_own, session.of_designs(hard_ones)])
    narrow = np.argsort([session.sd(one) for one in by_all], axis=0)[:_BEST]
    varied = [
        other for k in dict.fromkeys(narrow.ravel()) for other in vary_surroundings(seen, every[k])
    ]
    if varied:  # one axis alone has no surroundings
        by_all = np.concatenate([by_all, session.of_designs(varied)])
    for which, designs in (("of next", by_own), ("any", by_all)):
        single = at_hand / np.array([session.sd(one) for one in designs])
        alone = [
            at_hand[k] / session.sd(session.best_mixture(designs, k))[k]
            for k in range(len(session.names))
        ]
        together = at_hand / session.sd(session.best_mixture(designs, None))
        print(f"{title}, {len(designs)} designs ({which}):")
        for k, name in enumerate(session.names):
            print(
                f"  {name}: best design {single[:, k].max():.2f}, best mixture {alone[k]:.2f},"
                f" mixture for all {together[k]:.2f}"
            )
        print(
            f"  all, geometric mean: best design {np.exp(np.log(single).mean(axis=1)).max():.2f},"
            f" mixture for all {np.exp(np.log(together).mean()):.2f}",
            flush=True,
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--machine", choices=sorted(USUAL), default="bam")
    parser.add_argument(
        "--timid", choices=sorted(TIMID), help="confined motion, by pair of effects"
    )
    parser.add_argument("--run", type=Path, help="of a session that has been identified")
    parser.add_argument("--seeds", type=int, nargs=2, default=(8701, 8701), metavar=("A", "B"))
    given = parser.parse_args()
    if given.run:
        report(given.run.name, Session(given.run))
        return 0
    machine, conditions = given.machine, USUAL[given.machine]
    if given.timid:
        machine, _, conditions = TIMID[given.timid]
    for seed in range(given.seeds[0], given.seeds[1] + 1):
        with tempfile.TemporaryDirectory() as name:
            run, _ = run_of(Path(name) / "now", machine, seed, {}, conditions)
            report(f"{machine} {seed}", Session(run.root))
    return 0


if __name__ == "__main__":
    sys.exit(main())
