"""The verdict on each axis, from what a search came to and the noise floor of its final model."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bampipe.discover.chance import candidates_of
from bampipe.discover.findings import Diagnosis
from bampipe.discover.influence import error_without_second
from bampipe.discover.odds import odds_by_score
from bampipe.discover.polish import comes_close
from bampipe.discover.ranking import rank
from bampipe.discover.scorer import Scorer
from bampipe.discover.search import Search
from bampipe.discover.settings import Settings
from bampipe.results.diagnose import AxisVerdict, Contender, TransientCandidate, Verdict
from bampipe.results.standing import AT_FLOOR, FLOOR_WRONG, standing
from bampipe.trials.noise_floor import NoiseFloor


def conclude(search: Search, s: Settings) -> Diagnosis:
    """Say of each axis whether something is missing, and whether what was found explains it."""
    evidence = search.evidence
    before, after = search.initial.held_out_rmse, evidence.held_out_rmse
    floor, creeping = search.floor, NoiseFloor.of_errors([r.held_out_rmse for r in search.final])
    bare_floor = NoiseFloor.of_errors([r.held_out_rmse for r in search.level.replicates]).level
    shares = np.array([r.share for r in (*search.final, *search.still)])
    reach = {n: _reach(search, n, s.worth) for n in search.selected}
    odds = {n: _odds_of_group(search, n, s) for n in search.selected}
    axes = range(len(before))
    here = [
        tuple(n for n in search.selected if search.main[n] == axis or axis in reach[n])
        for axis in axes
    ]
    excess = before**2 - np.minimum(floor.level, bare_floor) ** 2
    left = np.maximum(after**2 - floor.level**2, 0.0)
    explained = [
        max(0.0, float(1.0 - left[axis] / max(excess[axis], 1e-30))) if here[axis] else 0.0
        for axis in axes
    ]
    by_chance = [float(shares[:, axis].max()) for axis in axes]
    given, share = (
        [_share_beyond_chance(float(known[axis]), by_chance[axis]) for axis in axes]
        for known in (search.explainable, search.explainable_after)
    )
    seconds = [error_without_second(evidence, axis) for axis in axes]
    lacking = [
        standing(rest, float(floor.level[axis]), float(floor.sd[axis])) == "above_floor"
        and (rest / max(floor.level[axis], 1e-30) > s.surely or share[axis] > s.predictable)
        for axis, (_, rest) in enumerate(seconds)
    ]
    fails = [lacking[axis] and explained[axis] < s.explained for axis in axes]
    # What explains too little where it helps most was not found, whatever it does elsewhere.
    weak = {n for n in search.selected if fails[search.main[n]]}
    raised = floor.level > AT_FLOOR * creeping.level
    findings = []
    for axis in axes:
        level, scatter = float(floor.level[axis]), float(floor.sd[axis])
        against_floor = standing(float(after[axis]), level, scatter)
        worst, but_for_it = seconds[axis]
        verdict: Verdict
        at: dict[str, float] = {}
        if against_floor in FLOOR_WRONG:
            verdict = "undecided"
        elif here[axis]:
            verdict = "missing"
            alike = [n for n in here[axis] if search.groups[n]]
            unsure = [n for n in alike if max(odds[n].values()) < s.decided]
            if unsure:
                verdict, at = "undecided", odds[unsure[0]]
            if fails[axis] or weak.issuperset(here[axis]):
                verdict = "undecided" if explained[axis] > s.resembles else "unknown_effect"
                at = at or {n: 1.0 for n in here[axis]}
        elif lacking[axis]:
            at = _odds_of_likely(search, axis, s)
            verdict = "undecided" if at else "unknown_effect"
        else:
            verdict = "nothing_missing"
        findings.append(
            AxisVerdict(
                verdict=verdict,
                effects=tuple(n for n in here[axis] if n not in weak),
                likely=at,
                rmse_before=before[axis],
                rmse_after=after[axis],
                noise_floor=level,
                noise_floor_sd=scatter,
                creeping_floor=creeping.level[axis] if raised[axis] else None,
                standing=against_floor,
                worst_second=worst.stretch,
                rmse_without_worst_second=but_for_it,
                other_band=None,
                unit=evidence.system.torque_units[axis],
                explainable_share=given[axis],
                explainable_after=share[axis],
                explainable_chance=by_chance[axis],
                remains=lacking[axis],
                explained_by_effects=explained[axis],
                sentence="",
            )
        )
    kept = [n for n in search.selected if n not in weak]
    ranking = rank(search, kept)
    groups = {n: search.groups[n] for n in kept}
    contests = {n: _listed(search.contests.get(n, ()), odds[n], s) for n in kept}
    return Diagnosis(
        tuple(findings), tuple(ranking), tuple(kept), groups, contests, search.steps,
        search.cut_short, _transients(search), evidence, search.initial, search.refused,
        search.wider,
    )  # fmt: skip


def _transients(search: Search) -> tuple[TransientCandidate, ...]:
    """Candidates that only one second speaks for, with the axis where they help most."""
    axes = search.initial.system.coordinates
    return tuple(
        TransientCandidate(
            effect=name, axis=axes[np.argmax(search.first[name].gain)], second=second.stretch
        )
        for name, second in search.transient.items()
        if name in search.first and name not in search.selected
    )


def _odds_of_group(search: Search, name: str, s: Settings) -> dict[str, float]:
    """Odds of an effect found and of those that replays cannot tell from it.

    None of those that hold it and something more which adds nothing.
    Where no replay looks like the measurement, scores err by as much as that: their scale grows by
    the Birge ratio (Birge 1932, Physical Review 40, 207).
    """
    among = {name, *search.groups[name], *search.unlike} - search.wider.get(name, frozenset())
    scores = {c.effect: c.score for c in search.contests.get(name, ()) if c.effect in among}
    believed = search.log_prior.get(name, {})
    return odds_by_score(scores or {name: 0.0}, s, float(np.sqrt(search.misfit)), believed)


def _odds_of_likely(search: Search, axis: int, s: Settings) -> dict[str, float]:
    """Odds of candidates that would lower the error of an axis but do not beat chance."""
    count = Scorer(search.evidence).independent_samples[axis]
    here = {n: (p, gain[axis]) for n, (p, gain) in search.likely.items() if gain[axis] > s.worth}
    if not here:
        return {}
    odds = odds_by_score({n: float(gain * count) for n, (_, gain) in here.items()}, s)
    found = {n: (1.0 - here[n][0]) * share for n, share in odds.items()}
    return dict(sorted(found.items(), key=lambda pair: -pair[1]))


def _listed(
    contest: tuple[Contender, ...], odds: Mapping[str, float], s: Settings
) -> tuple[Contender, ...]:
    """The effect found, and the rivals that come close to it by any of the scores."""
    if not contest or contest[0].score <= 0.0:
        # Its linear step from the model without it leads astray: no number to compare by.
        return ()
    mine = contest[0]

    shown = [c for c in contest if c.effect in odds or comes_close(c, mine, s)]
    own = odds.get(mine.effect, 0.0)
    found = []
    for c in shown:
        rate = odds.get(c.effect, 0.0)
        beside = ""
        if c is not mine and rate * s.clear_odds > own:
            beside = "about as likely" if rate < own * s.clear_odds else "likelier by score"
        found.append(c.model_copy(update={"odds": rate, "beside": beside}))
    return tuple(found)


def _reach(search: Search, name: str, worth: float) -> set[int]:
    """Axes on which an effect acts and whose error it lowers."""
    item = candidates_of(search.recipe, (name,))[0].system
    acts = range(len(item.coordinates)) if item.moves_sensors else item.touched
    if name not in search.first:
        return set()
    drop = search.level.excess(search.first[name]) / Scorer(search.initial).independent_samples
    return {axis for axis in acts if drop[axis] > worth}


def _share_beyond_chance(share: float, by_chance: float) -> float:
    """Explained share beyond the one that replays give, of what they leave."""
    return float(max(0.0, (share - by_chance) / max(1.0 - by_chance, 1e-9)))
