"""A plan: trials, chosen one by one, that bring every uncertainty below its goal."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np

from bampipe.arrays import Array
from bampipe.next_trial.design_sentence import describe_design
from bampipe.next_trial.discrimination import Sums
from bampipe.next_trial.forecast import Forecast, describe_moves
from bampipe.next_trial.precision import Expected
from bampipe.next_trial.primitives import FEWEST_STROKES, Primitive
from bampipe.next_trial.ranking import RankedDesign
from bampipe.results.next import Plan, PlannedConfusion, PlannedSd, PlannedTrial

_MOST_DESIGNS = 8
"""Largest number of designs: a new plan after these trials is better than a longer one."""
_LEAST_PROGRESS = 0.01
"""Smallest progress towards the goal, nats, that makes a further trial worth recording."""
_SHORTENED_TO = 0.5
_SHORTEST_TRIAL_S = 5.0
"""Shortest trial; strokes need the time of a few of them as well."""


@dataclass(frozen=True)
class Goal:
    """The goal of a plan.

    Attributes:
        sd: largest standard deviation of each parameter, (n,); infinite if it does not matter.
        confusion: largest chance of confusing two alternatives.
    """

    sd: Array
    confusion: float


@dataclass(frozen=True)
class _Option:
    """A design and the information that one trial of it adds, by its median version."""

    design: Primitive
    information: Array
    sums: Sums | None

    def scale_to(self, seconds: float) -> "_Option":
        """Return the option at another length: information is proportional to time."""
        share = seconds / self.design.seconds
        return _Option(
            replace(self.design, seconds=seconds),
            share * self.information,
            self.sums.scale_by(share) if self.sums is not None else None,
        )


def choose_trials(
    forecast: Forecast, ranked: Sequence[RankedDesign], goal: Goal
) -> tuple[list[_Option], bool]:
    """Choose trials greedily until the goal is reached, then drop or shorten superfluous ones.

    Also return whether these are as many as a plan may have, so that further ones would still help.
    """
    options = [_make_option(forecast, one) for one in ranked]
    chosen: list[_Option] = []
    if _find_distance(_find_present(forecast), goal) <= 0.0:
        return chosen, False
    # A published uncertainty may be small by chance: progress is measured from the uncertainty
    # that the trials at hand would be expected to give if they were recorded again.
    left = _find_distance(_find_outcome(forecast, chosen), goal)
    for _ in range(_MOST_DESIGNS):
        wider = ([*chosen, one] for one in options)
        distances = [_find_distance(_find_outcome(forecast, plan), goal) for plan in wider]
        best = int(np.argmin(distances))
        if 0.0 < distances[best] and distances[best] > left - _LEAST_PROGRESS:
            return chosen, False
        chosen, left = [*chosen, options[best]], distances[best]
        if left <= 0.0:
            return _shorten_plan(forecast, chosen, goal), False
    return chosen, True


def _shorten_plan(forecast: Forecast, chosen: list[_Option], goal: Goal) -> list[_Option]:
    """Drop or shorten trials as long as the goal stays reached."""
    for k in range(len(chosen) - 1, -1, -1):
        fewer = [*chosen[:k], *chosen[k + 1 :]]
        if fewer and _find_distance(_find_outcome(forecast, fewer), goal) <= 0.0:
            chosen = fewer
            continue
        shortest = _find_shortest(chosen[k].design)
        while (seconds := _SHORTENED_TO * chosen[k].design.seconds) >= shortest:
            shorter = [*chosen[:k], chosen[k].scale_to(seconds), *chosen[k + 1 :]]
            if _find_distance(_find_outcome(forecast, shorter), goal) > 0.0:
                break
            chosen = shorter
    return chosen


def _find_shortest(design: Primitive) -> float:
    """Return the shortest length of a design, s: below it, information is not proportional."""
    if design.example is not None:
        # Part of a trial need not cover the whole motion.
        return min(design.seconds, max(_SHORTEST_TRIAL_S, float(np.ptp(design.example.motion.t))))
    stroke_s = max((stroke.typical_s for stroke in design.strokes.values()), default=0.0)
    return design.parts * max(_SHORTEST_TRIAL_S, FEWEST_STROKES * stroke_s)


def _make_option(forecast: Forecast, ranked: RankedDesign) -> _Option:
    """Return the option of a design, by the version with the median information."""
    added = forecast.added_by(ranked)
    order = np.argsort([forecast.precision.gain(one) for one in added])
    middle, comparison = int(order[(len(order) - 1) // 2]), forecast.comparison
    sums = comparison.sums([ranked.expected_motions[middle]]) if comparison else None
    return _Option(ranked.design, added[middle], sums)


_Outcome = tuple[Expected, dict[tuple[int, int], float]]
"""Standard deviations, and the chance of confusing each pair of alternatives."""


def _find_present(forecast: Forecast) -> _Outcome:
    """Return the present standard deviations, as published, and chances of confusion."""
    now = forecast.precision.sd
    return Expected(now, now, now), _find_confusion(forecast, ())


def _find_outcome(forecast: Forecast, chosen: Sequence[_Option]) -> _Outcome:
    """Return the outcome expected with ``chosen`` trials recorded."""
    nothing = np.zeros_like(forecast.precision.information)
    added = sum((one.information for one in chosen), nothing)
    seconds = sum(one.design.seconds for one in chosen)
    return forecast.precision.expect(added, seconds), _find_confusion(forecast, chosen)


def _find_confusion(forecast: Forecast, chosen: Sequence[_Option]) -> dict[tuple[int, int], float]:
    comparison = forecast.comparison
    if comparison is None:
        return {}
    sums = reduce(add, (one.sums for one in chosen if one.sums is not None), comparison.sums_now)
    return comparison.confusions(comparison.contrasts(sums))


def _find_distance(outcome: _Outcome, goal: Goal) -> float:
    """Return the distance from the goal: sum of the logarithms of excessive values, nats."""
    sd, confusion = outcome
    far = float(np.sum(np.log(np.maximum(sd.median / goal.sd, 1.0))))
    return far + sum(max(float(np.log(c / goal.confusion)), 0.0) for c in confusion.values())


def plan_trials(forecast: Forecast, ranked: Sequence[RankedDesign], goal: Goal) -> Plan:
    """Return the trials that reach the goal or come nearest to it, and their expected outcome."""
    chosen, is_full = choose_trials(forecast, ranked, goal)
    outcome = _find_outcome(forecast, chosen) if chosen else _find_present(forecast)
    is_enough = _find_distance(outcome, goal) <= 0.0
    planned = [one.design for one in chosen]
    system, seen = forecast.rehearsal.system, forecast.rehearsal.seen
    seconds = sum(design.seconds for design in planned)
    confusion: tuple[PlannedConfusion, ...] = ()
    sd: dict[str, PlannedSd] = {}
    if (comparison := forecast.comparison) is not None:
        now, names = comparison.confusions(comparison.contrasts_now), comparison.alternatives
        confusion = tuple(
            PlannedConfusion(between=(names[i].name, names[j].name), before=now[i, j], after=after)
            for (i, j), after in outcome[1].items()
        )
    else:
        pairs = zip(forecast.tabulate_sd(outcome[0]).items(), goal.sd, strict=True)
        sd = {name: PlannedSd.of(entry, asked=asked) for (name, entry), asked in pairs}
    designs = {id(design): design for design in planned}
    times = Counter(map(id, planned))
    what = "uncertainties" if comparison is None else "confusion"
    return Plan(
        sentence=_say_plan(sum(one.parts for one in planned), seconds, what, is_enough, is_full),
        seconds=seconds,
        is_enough=is_enough,
        trials=tuple(
            PlannedTrial(
                # One trial of the design: the sheet lists the number of repetitions beside it.
                sentence=describe_design(
                    replace(design, seconds=design.part_s, parts=1), seen, system.model.device
                ),
                seconds=design.part_s,
                times=times[key] * design.parts,
                moves=describe_moves(design, forecast.rehearsal),
            )
            for key, design in designs.items()
        ),
        sd=sd,
        confusion=confusion,
    )


def _say_plan(count: int, seconds: float, what: str, is_enough: bool, is_full: bool) -> str:
    asked = "chance of confusing two effects is expected to fall below the limit"
    if what == "uncertainties":
        asked = "uncertainty is expected to fall below the requested limit"
    if not count:
        if is_enough:
            return "The present trials suffice: nothing needs to be recorded."
        return f"No further trial would bring the {what} nearer to the limit."
    head = f"With {'one trial' if count == 1 else f'{count} trials'}, {seconds:.0f} s in all,"
    if is_enough:
        return f"{head} every {asked}."
    again, little = "ask again once they are recorded", "more trials like these add little"
    return f"{head} not every {asked}; {again if is_full else little}."
