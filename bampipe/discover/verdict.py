"""The verdict on each axis, from what a search came to and the noise floor of its final model."""

from __future__ import annotations

import numpy as np

from bampipe.discover.candidates import Scorer
from bampipe.discover.chance import candidates_of
from bampipe.discover.findings import AxisFinding, Diagnosis
from bampipe.discover.ranking import rank
from bampipe.discover.search import Search
from bampipe.discover.settings import Settings
from bampipe.discover.shape import explainable_share
from bampipe.results.diagnose import Verdict
from bampipe.results.standing import standing
from bampipe.trials.noise_floor import NoiseFloor


def conclude(search: Search, s: Settings) -> Diagnosis:
    """Say of each axis whether something is missing, and whether what was found explains it."""
    before, after = search.initial.held_out_rmse, search.evidence.held_out_rmse
    floor = NoiseFloor.of_errors([r.held_out_rmse for r in search.final])
    bare_floor = NoiseFloor.of_errors([r.held_out_rmse for r in search.level.replicates]).mean
    shares = np.array([r.share for r in search.final])
    reach = {n: _reach(search, n, s.worth) for n in search.selected}
    findings = []
    unknown = set()
    for axis in range(len(before)):
        level, scatter = float(floor.mean[axis]), float(floor.sd[axis])
        by_chance = float(shares[:, axis].max())
        given = _share_beyond_chance(explainable_share(search.initial, axis), by_chance)
        share = given
        if search.selected:
            share = _share_beyond_chance(explainable_share(search.evidence, axis), by_chance)
        here = tuple(n for n in search.selected if search.main[n] == axis or axis in reach[n])
        excess = before[axis] ** 2 - min(level, bare_floor[axis]) ** 2
        left = max(after[axis] ** 2 - level**2, 0.0)
        against_floor = standing(float(after[axis]), level, scatter)
        above = after[axis] / max(level, 1e-30)
        lacking = against_floor == "above_floor" and (above > s.surely or share > s.predictable)
        verdict: Verdict = "missing" if here else "nothing_missing"
        if against_floor in ("floor_implausible", "floor_missing"):
            verdict = "undecided"
        explained = max(0.0, 1.0 - left / max(excess, 1e-30)) if here else 0.0
        if lacking and explained < (s.explained_far if above > s.far else s.explained):
            verdict = "unknown_effect"
            unknown |= {n for n in here if search.main[n] == axis}
        findings.append(
            AxisFinding(
                verdict,
                float(before[axis]),
                float(after[axis]),
                level,
                scatter,
                against_floor,
                given,
                share,
                by_chance,
                here if verdict in ("missing", "undecided") else (),
                lacking and verdict == "missing",
                here if verdict == "unknown_effect" else (),
                explained,
            )
        )
    kept = [n for n in search.selected if n not in unknown]
    ranking = rank(search, kept, before)
    groups = {n: search.groups.get(n, ()) for n in kept}
    return Diagnosis(
        tuple(findings), tuple(ranking), tuple(kept), groups, search.evidence, search.initial
    )


def _reach(search: Search, name: str, worth: float) -> set[int]:
    """Axes on which an effect acts and whose error it lowers."""
    item = candidates_of(search.recipe, (name,))[0].system
    acts = range(len(item.coordinates)) if item.moves_sensors else item.touched
    if name not in search.first:
        return set()
    drop = search.level.excess(search.first[name]) / Scorer(search.initial).independent
    return {axis for axis in acts if drop[axis] > worth}


def _share_beyond_chance(share: float, by_chance: float) -> float:
    """Explained share beyond the one that replays give, of what they leave."""
    return float(max(0.0, (share - by_chance) / max(1.0 - by_chance, 1e-9)))
