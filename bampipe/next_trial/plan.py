"""A set of trials, chosen one after another, that brings every uncertainty below what is asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np

from bampipe.arrays import Array
from bampipe.next_trial.choice import RankedDesign
from bampipe.next_trial.discrimination import Sums
from bampipe.next_trial.forecast import Forecast, describe_moves
from bampipe.next_trial.precision import Expected
from bampipe.next_trial.primitives import FEWEST_STROKES, Primitive
from bampipe.next_trial.words import describe
from bampipe.results.next import Plan, PlannedConfusion, PlannedSd, PlannedTrial

_MOST_DESIGNS = 8
"""In a plan: what more of them would do is better asked once these are there."""
_WORTHWHILE = 0.01
"""Fall of the distance to the goal, in nats, below which a further trial is not worth recording."""
_SHORTER = 0.5
_SHORTEST_S = 5.0
"""Of each trial; strokes also take the time of some of them."""


@dataclass(frozen=True)
class Goal:
    """What is asked of a plan.

    Attributes:
        sd: most standard deviation of each parameter, (n,); infinite where nothing is asked.
        confusion: most chance of confusing two alternatives.
    """

    sd: Array
    confusion: float


@dataclass(frozen=True)
class _Option:
    """A design and what one trial of it adds, its median version taken."""

    design: Primitive
    information: Array
    sums: Sums | None

    def scale_to(self, seconds: float) -> _Option:
        """The same for another time: what a trial adds is in proportion to that."""
        share = seconds / self.design.seconds
        return _Option(
            replace(self.design, seconds=seconds),
            share * self.information,
            self.sums.scaled(share) if self.sums is not None else None,
        )


@dataclass(frozen=True)
class TrialPlan:
    """Trials to record, in order.

    Attributes:
        designs: what to do.
        sd: standard deviations expected in the end.
        confusion: chance of confusing each pair of alternatives in the end.
        is_enough: whether the goal is reached.
        is_full: whether more trials would bring it nearer, and there are only too many already.
    """

    designs: tuple[Primitive, ...]
    sd: Expected
    confusion: dict[tuple[int, int], float]
    is_enough: bool
    is_full: bool


def plan_trials(forecast: Forecast, ranked: Sequence[RankedDesign], goal: Goal) -> TrialPlan:
    """Choose trials greedily until the goal is reached, then leave out and shorten what can be.

    Args:
        forecast: of what trials give; ranked: the designs to choose from; goal: what is asked.
    """
    options = [_option(forecast, one) for one in ranked]
    chosen: list[_Option] = []
    now = forecast.precision.sd
    outcome, is_full = (Expected(now, now, now), _confusion(forecast, ())), False
    is_enough = _distance(outcome, goal) <= 0.0
    # A published uncertainty may be small by chance: what a trial adds is held against what the
    # trials at hand would be expected to give another time.
    left = _distance(_outcome(forecast, chosen), goal)
    while not (is_enough or is_full):
        distances = [_distance(_outcome(forecast, [*chosen, one]), goal) for one in options]
        best = int(np.argmin(distances))
        if 0.0 < distances[best] and distances[best] > left - _WORTHWHILE:
            break
        chosen, left = [*chosen, options[best]], distances[best]
        is_enough = left <= 0.0
        is_full = not is_enough and len(chosen) == _MOST_DESIGNS
    if is_enough:
        chosen = _trimmed(forecast, chosen, goal)
    if chosen:
        outcome = _outcome(forecast, chosen)
    return TrialPlan(tuple(one.design for one in chosen), *outcome, is_enough, is_full)


def _trimmed(forecast: Forecast, chosen: list[_Option], goal: Goal) -> list[_Option]:
    """The same without trials, or with shorter ones, as long as the goal stays reached."""
    for k in range(len(chosen) - 1, -1, -1):
        fewer = [*chosen[:k], *chosen[k + 1 :]]
        if fewer and _distance(_outcome(forecast, fewer), goal) <= 0.0:
            chosen = fewer
            continue
        while (seconds := _SHORTER * chosen[k].design.seconds) >= _shortest(chosen[k].design):
            shorter = [*chosen[:k], chosen[k].scale_to(seconds), *chosen[k + 1 :]]
            if _distance(_outcome(forecast, shorter), goal) > 0.0:
                break
            chosen = shorter
    return chosen


def _shortest(design: Primitive) -> float:
    """How long a design takes at least, s: what it adds is in proportion only from there on."""
    if design.example is not None:
        # Part of a trial need not cover what all of it does.
        return min(design.seconds, max(_SHORTEST_S, float(np.ptp(design.example.motion.t))))
    stroke_s = max((stroke.typical_s for stroke in design.strokes.values()), default=0.0)
    return design.parts * max(_SHORTEST_S, FEWEST_STROKES * stroke_s)


def _option(forecast: Forecast, ranked: RankedDesign) -> _Option:
    """A design by the version whose information is the median one."""
    added = forecast.added_by(ranked)
    order = np.argsort([forecast.precision.gain(one) for one in added])
    middle, comparison = int(order[(len(order) - 1) // 2]), forecast.comparison
    sums = comparison.sums([ranked.expected_motions[middle]]) if comparison else None
    return _Option(ranked.design, added[middle], sums)


_Outcome = tuple[Expected, dict[tuple[int, int], float]]
"""Standard deviations, and the chance of confusing each pair of alternatives."""


def _outcome(forecast: Forecast, chosen: Sequence[_Option]) -> _Outcome:
    """What is expected with ``chosen`` trials recorded."""
    nothing = np.zeros_like(forecast.precision.information)
    added = sum((one.information for one in chosen), nothing)
    seconds = sum(one.design.seconds for one in chosen)
    return forecast.precision.expect(added, seconds), _confusion(forecast, chosen)


def _confusion(forecast: Forecast, chosen: Sequence[_Option]) -> dict[tuple[int, int], float]:
    comparison = forecast.comparison
    if comparison is None:
        return {}
    sums = reduce(add, (one.sums for one in chosen if one.sums is not None), comparison.at_hand)
    return comparison.confusions(comparison.contrasts(sums))


def _distance(outcome: _Outcome, goal: Goal) -> float:
    """How far trials are from the goal: sum of the logarithms of what is too large, nats."""
    sd, confusion = outcome
    far = float(np.sum(np.log(np.maximum(sd.median / goal.sd, 1.0))))
    return far + sum(max(float(np.log(c / goal.confusion)), 0.0) for c in confusion.values())


def record_plan(forecast: Forecast, goal: Goal, found: TrialPlan) -> Plan:
    """The record of a plan."""
    system, precision, seen = forecast.rehearsal.system, forecast.precision, forecast.rehearsal.seen
    units = {q.name: q.unit for q in system.parameters}
    seconds = sum(design.seconds for design in found.designs)
    confusion: tuple[PlannedConfusion, ...] = ()
    sd: dict[str, PlannedSd] = {}
    if (comparison := forecast.comparison) is not None:
        now, names = comparison.confusions(comparison.now), comparison.alternatives
        confusion = tuple(
            PlannedConfusion(between=(names[i].name, names[j].name), before=now[i, j], after=after)
            for (i, j), after in found.confusion.items()
        )
    else:
        columns = zip(
            precision.names, precision.sd, found.sd.median, found.sd.low, found.sd.high, goal.sd,
            strict=True,
        )  # fmt: skip
        sd = {
            name: PlannedSd(
                before=before, after=after, low=low, high=high, asked=asked, unit=units[name]
            )
            for name, before, after, low, high, asked in columns
        }
    counted: dict[int, tuple[Primitive, int]] = {}
    for design in found.designs:
        counted[id(design)] = design, counted.get(id(design), (design, 0))[1] + 1
    return Plan(
        sentence=_sentence(found, seconds, "uncertainties" if comparison is None else "confusion"),
        seconds=seconds,
        is_enough=found.is_enough,
        trials=tuple(
            PlannedTrial(
                # One trial of the design: a sheet has how often it is recorded beside it.
                sentence=describe(
                    replace(design, seconds=design.part_s, parts=1), seen, system.model.device
                ),
                seconds=design.part_s,
                times=times * design.parts,
                moves=describe_moves(design, forecast.rehearsal),
            )
            for design, times in counted.values()
        ),
        sd=sd,
        confusion=confusion,
    )


def _sentence(found: TrialPlan, seconds: float, what: str) -> str:
    count = sum(design.parts for design in found.designs)
    asked = {
        "uncertainties": "uncertainty is expected to fall below what is asked",
        "confusion": "chance of confusing two effects is expected to fall below what is asked",
    }[what]
    if not count:
        if found.is_enough:
            return "The trials at hand are enough: nothing needs to be recorded."
        return f"No trial that could be recorded here brings the {what} nearer to what is asked."
    head = f"With {'one trial' if count == 1 else f'{count} trials'}, {seconds:.0f} s in all,"
    if found.is_enough:
        return f"{head} every {asked}."
    again, little = "ask again once they are recorded", "more trials like these add little"
    return f"{head} not every {asked}; {again if found.is_full else little}."
