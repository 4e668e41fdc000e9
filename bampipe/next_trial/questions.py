"""What the next trial is for: effects to distinguish, effects that these trials do not show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.candidates import Candidate, list_candidates
from bampipe.discover.chance import candidates_of, fit_trials, system_of
from bampipe.discover.odds import odds_by_score
from bampipe.discover.scorer import Scorer
from bampipe.discover.settings import Settings
from bampipe.discover.stops import WIDTHS
from bampipe.estimate.simulation import Runaway
from bampipe.next_trial.discrimination import Contest, Rival, Sums
from bampipe.next_trial.sensitivity import (
    Bar,
    Visibility,
    gain_at,
    growth_of_jump,
    refine,
    typical_rival,
    weigh_visibility,
)
from bampipe.physics.recipe import Recipe
from bampipe.physics.registry import effect_from
from bampipe.results.diagnose import DiagnoseResult
from bampipe.trials.draw import draw_trials
from bampipe.trials.evidence import Evidence
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.motion import Motion
from bampipe.trials.noise_floor import FLOOR_SEED, replay_evidence
from bampipe.trials.replay import StandIn, keep_motion

Array = NDArray[np.float64]

_MOST_RIVALS = 4


@dataclass(frozen=True)
class Ambiguity:
    """Effects that a diagnosis could not tell apart.

    Attributes:
        odds: by effect; "" for none.
        others: effects found beside them, which are taken for granted.
    """

    odds: Mapping[str, float]
    others: tuple[str, ...]


def find_ambiguity(found: DiagnoseResult) -> Ambiguity | None:
    """The most open question of a diagnosis; None where every effect found stands clear."""
    s, open_questions = Settings(), []
    for name in found.selected:
        contest = found.contests.get(name, ())
        scores = {c.effect: c.score for c in contest}
        known = {c.effect: c.odds for c in contest if c.odds > 0.0}
        ranked = {row.effect: row.score for row in found.ranking}
        alike = {name, *found.groups.get(name, ())}
        if len(known) > 1:
            # Replays tell the others from it, however close their scores are; but no replay is
            # perfect, and one that scores better than what was found stays a rival.
            scores = {
                o: score
                for o, score in scores.items()
                if o in known or o in alike or score > scores[name]
            }
        scores |= {other: ranked[other] for other in alike - {*scores} if other in ranked}
        if len(scores) < 2 or max(scores.values()) <= 0.0:
            continue
        odds = odds_by_score(scores, s)
        if known.get(name):
            # Replays were heard: on the scale of the others.
            odds |= {o: share / known[name] * odds[name] for o, share in known.items()}
        open_questions.append((odds, tuple(n for n in found.selected if n != name)))
    for axis in found.axes.values():
        if axis.verdict == "undecided" and axis.likely and not axis.effects:
            odds = {
                name: share for name, share in axis.likely.items() if name not in found.selected
            }
            if odds:
                odds |= {"": max(1.0 - sum(odds.values()), s.least_odds)}
                open_questions.append((odds, found.selected))
    best: Ambiguity | None = None
    for odds, others in open_questions:
        total = sum(odds.values())
        shares = {
            name: share / total for name, share in odds.items() if share > s.least_odds * total
        }
        shares = dict(sorted(shares.items(), key=lambda pair: -pair[1])[:_MOST_RIVALS])
        if len(shares) > 1 and (best is None or max(shares.values()) < max(best.odds.values())):
            total = sum(shares.values())
            best = Ambiguity({n: share / total for n, share in shares.items()}, others)
    return best


def make_contest(
    trials: MeasuredTrials,
    recipe: Recipe,
    start: Array,
    asked: Ambiguity,
    values: Mapping[str, float],
    floor: Array,
) -> Contest | None:
    """The rivals of ``asked`` fitted to the trials; None where fewer than two can be.

    Args:
        trials: the measured trials; recipe: the model that was diagnosed.
        start: (n_p,) its parameters.
        values: of effects beside the rivals, by parameter.
        floor: (n_q,) noise floor of each axis.
    """
    wider = replace(recipe, effects=(*recipe.effects, *asked.others))
    system = system_of(wider)
    known = {q.name: value for q, value in zip(system_of(recipe).parameters, start, strict=True)}
    begin = np.array([known.get(q.name, values.get(q.name, q.prior)) for q in system.parameters])
    evidence = fit_trials(trials, wider, begin)
    scorer, rivals = Scorer(evidence), []
    named = [name for name in asked.odds if name]
    for item in candidates_of(wider, named):
        score = scorer.score(item)
        if score is not None:
            rivals.append(Rival(item, score.values, asked.odds[item.name]))
    if "" in asked.odds:
        rivals.append(Rival(None, np.zeros(0), asked.odds[""]))
    if len(rivals) < 2:
        return None
    return Contest(system, evidence.p, tuple(rivals), trials.band, floor)


@dataclass(frozen=True)
class Blindness:
    """What the trials at hand would have shown of the library's effects.

    Attributes:
        contest: every effect at its typical strength; at_hand: its sums over the trials.
        found: from which strength on each would have been found.
        bar: what a diagnosis asks of an effect.
    """

    contest: Contest
    at_hand: Sums
    found: tuple[Visibility, ...]
    bar: Bar

    @property
    def hidden(self) -> list[int]:
        """Numbers of the effects that would go unnoticed at their typical size, worst first."""
        order = sorted(range(len(self.found)), key=lambda k: -self.found[k].factor)
        return [k for k in order if self.found[k].is_hidden]

    @property
    def unpromised(self) -> list[str]:
        """Names of those of which nothing is said; see `Visibility.is_promised`."""
        return [one.rival.name for one in self.found if not one.is_promised]

    @property
    def of_brakes(self) -> list[str]:
        """Names of the effects that show where brakes are on."""
        rivals = [one.rival for one in self.found]
        return [rival.name for rival in rivals if rival.item and rival.item.system.braked]

    def narrowed(self, chosen: Sequence[int]) -> Blindness:
        """The same for some of the effects."""
        contest = replace(self.contest, rivals=tuple(self.found[k].rival for k in chosen))
        start = self.at_hand.squares.shape[1] - len(self.contest.rivals)
        rows = [*range(start), *(start + k for k in chosen)]
        squares = self.at_hand.squares[:, rows][:, :, rows]
        found = tuple(self.found[k] for k in chosen)
        return Blindness(contest, replace(self.at_hand, squares=squares), found, self.bar)

    def factors_with(self, motions: Sequence[Motion]) -> Array:
        """From which factor on each effect is found once ``motions`` have been recorded."""
        now, before = np.array([one.factor for one in self.found]), self._factors_at_hand
        after = self._factors(self.at_hand + self.contest.sums(motions))
        # What is not linear in its strength is taken to change alike.
        ratio = np.ones(len(now))
        known = np.isfinite(before) & np.isfinite(now)
        ratio[known] = now[known] / before[known]
        return np.asarray(after * ratio)

    @cached_property
    def _factors_at_hand(self) -> Array:
        return self._factors(self.at_hand)

    def _factors(self, sums: Sums) -> Array:
        return np.array([v.factor for v in weigh_visibility(self.contest, sums, self.bar)])


def find_blindness(
    evidence: Evidence,
    trials: MeasuredTrials,
    recipe: Recipe,
    error: Array,
    floor: Array,
    floor_sd: Array,
) -> Blindness:
    """What the trials would have shown of every effect of the library that the model lacks.

    Args:
        evidence: the model's fit to the trials; recipe: the model.
        error: (n_q,) held-out error; floor, floor_sd: (n_q,) of its noise, N.m or N.
    """
    device, extra = recipe.model().device, [effect_from(e) for e in recipe.extra]
    scale = Scorer(evidence).machine_scale
    items = candidates_of(recipe, list_candidates(device, recipe.effects, extra))
    rivals = [rival for item in items if (rival := typical_rival(item, scale)) is not None]
    # The trials may be late already, and an effect goes on from there.
    timing_s = trials.limit_s + abs(trials.late_s) if trials.limit_s else 0.0
    contest = Contest(
        evidence.system, evidence.p, tuple(rivals), evidence.band, error, False, timing_s
    )
    motions = trials.weighed
    at_hand, bar = contest.sums(motions), Bar.of_errors(error, floor, floor_sd, len(items))
    found = refine(contest, motions, weigh_visibility(contest, at_hand, bar), bar)
    found = [replace(v, growth=growth_of_jump(contest, motions, v)) for v in found]
    jumping = [v.rival.item for v in found if v.growth > 0.0 and v.rival.item is not None]
    still = _gain_by_standing_still(trials, recipe, evidence, jumping)
    found = [
        replace(v, imitated=still[v.rival.name] > gain_at(contest, at_hand, v, left))
        if v.rival.name in still and np.isfinite(v.factor)
        else v
        for v, left in zip(found, contest.left_by_model(at_hand), strict=True)
    ]
    return Blindness(contest, at_hand, tuple(found), bar)


def _gain_by_standing_still(
    trials: MeasuredTrials, recipe: Recipe, evidence: Evidence, items: Sequence[Candidate]
) -> dict[str, float]:
    """Log likelihood that effects gain where the model stands still as its motion turns round.

    The most of replays with either narrow sign. Nothing of a robot, whose replays take minutes.
    """
    robot = evidence.system.model.device.robot is not None
    if robot or not items or keep_motion(evidence.fitted):
        return {}
    chosen = draw_trials(evidence.sizes)
    motions = [evidence.motions[k] for k in chosen]
    gained: dict[str, float] = {}
    for width in WIDTHS:
        moved = system_of(recipe.with_sign_widths(width))
        stand_in = StandIn(moved, evidence.p, motions, trials.sensors.rate_hz)
        with suppress(Runaway):
            replayed = replay_evidence(
                stand_in, evidence.system, evidence.p, trials.sensors, trials.kinematics,
                trials.band, evidence.folds.subset(chosen), (FLOOR_SEED,),
            )  # fmt: skip
            scorer, share = Scorer(replayed), sum(evidence.sizes) / sum(replayed.sizes)
            for score in filter(None, map(scorer.score, items)):
                gained[score.name] = max(gained.get(score.name, 0.0), share * score.total)
    return gained
