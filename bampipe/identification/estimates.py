"""An estimate of a model's parameters, by any method, and its record in identify.json."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from bampipe.arrays import Array, Flags, Indices
from bampipe.estimate.bounded import invert_scaled
from bampipe.estimate.influence import RemovedStretch
from bampipe.estimate.least_squares import Problem
from bampipe.phrases.results import TIMING_AT_LIMIT, describe_unidentified
from bampipe.physics import System
from bampipe.physics.effect import BoundEffect
from bampipe.results.identify import (
    Covariance,
    EffectEstimate,
    IdentifiabilityReport,
    IdentifyResult,
    Influence,
    InputTiming,
    Method,
    ParameterEstimate,
    WorstSecond,
)
from bampipe.results.rounding import NORMAL_95, round_with_sd

MOST_SHOWN = 24
"""Largest number of parameters in a headline."""
_MOVES, _OUTLYING = 2.0, 15.0
"""The worst second is reported if it moves a parameter by more standard deviations than the first
number, and by more than the second number times the effect of noise. In 32 sound sessions no second
reached the first limit (1.9 at friction reversals); one with a dead sensor reached 3.5 and 35."""


@dataclass(frozen=True)
class Estimate:
    """Parameters in physical units, with the covariance and record of the estimated ones.

    Attributes:
        p: (n_p + 1,) all parameters, followed by the input delay.
        problem: the inverse dynamics; its free parameters are the estimated ones, with the input
            delay last if it is estimated.
        method: estimation method.
        covariance: (n, n) of the estimated parameters of the model.
        at_bound: (n,) which are at a bound.
        held_out_rmse: held-out error by axis, (n_q,), N.m or N.
        details: by parameter, further fields of its record.
        report: further fields of the result.
        tabulate: returns the tables of the states, one per trial or a single one, and the table of
            the parameters along the data.
        doubts: objections to the estimate, a clause each.
        notes: other reservations, a sentence each.
    """

    method: Method
    p: Array
    problem: Problem
    covariance: Array
    at_bound: Flags
    held_out_rmse: Array
    details: Sequence[dict[str, float]]
    report: dict[str, Any]
    tabulate: Callable[[], tuple[Iterable[pd.DataFrame], pd.DataFrame]]
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def evidence(self) -> dict[str, Any]:
        """The filter's results on model and noise, published or not."""
        return {key: self.report[key] for key in ("nis", "innovations", "noise")}

    @property
    def free(self) -> Indices:
        """(n,) indices of the estimated parameters of the model."""
        return self.problem.free[: len(self.covariance)]

    @property
    def value(self) -> Array:
        """(n,) estimated parameters of the model."""
        return np.asarray(self.p[self.free])

    @property
    def sd(self) -> Array:
        """(n,) their standard deviations."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def input_timing(p: Array, problem: Problem, covariance: Array) -> InputTiming:
    """The record of the input delay, which is the last of ``p`` (n_p + 1,).

    ``problem`` says whether it is estimated; ``covariance`` is (n_free, n_free).
    """
    timed = problem.free[-1] == len(p) - 1
    return InputTiming(
        estimate=p[-1],
        sd=np.sqrt(covariance[-1, -1]) if timed else 0.0,
        unit="s",
        limit=problem.upper[-1] if timed else 0.0,
    )


def collect_result(
    system: System,
    estimate: Estimate,
    identifiability: IdentifiabilityReport,
    trials: Sequence[str],
    moves: Mapping[str, Array],
    worst: RemovedStretch,
    late: tuple[float, float],
    **further: Any,
) -> IdentifyResult:
    """Return the content of identify.json.

    Args:
        estimate: the published one; trials: names of the trials.
        moves: (n_free,) change of the estimated quantities, the input delay last if it is among
            them, if a trial, or block of a single one, is left out; by its name.
        worst: the second with the largest influence on least squares.
        late: input delay used by residuals, and its standard deviation, s.
        further: other fields of the result; its notes come after those on effects.
    """
    free, sd = estimate.free, estimate.sd
    names = tuple(system.parameters[i].name for i in free)
    parameters = {
        name: ParameterEstimate(
            estimate=estimate.p[place],
            sd=sd[i],
            unit=system.parameters[place].unit,
            at_bound=estimate.at_bound[i],
            bound_sd=identifiability.parameters[name].bound_sd,
            **estimate.details[i],
        )
        for i, (name, place) in enumerate(zip(names, free, strict=True))
    }
    effects = {
        each.name: _judge_effect(each, parameters, estimate.covariance)
        for each in system.model.effects
    }
    unknown = [name for name, found in effects.items() if not found.identified]
    warning = f"not identified: {', '.join(unknown)}; " if unknown else ""
    timing = estimate.report["input_timing"]
    # The trials are not shifted if the timing may be zero.
    taken = 0.0
    if timing.limit > 0.0 and abs(late[0]) >= NORMAL_95 * late[1]:
        taken = float(np.clip(late[0], -timing.limit, timing.limit))
    timing = timing.model_copy(update={"of_residual": taken})
    influence = _assess_influence(names, sd, timing.sd, trials, moves, worst)
    notes = further.pop("notes")
    return IdentifyResult(
        headline=warning + _headline(parameters),
        method=estimate.method,
        parameters=parameters,
        effects=effects,
        influence=influence,
        covariance=Covariance(names=names, matrix=estimate.covariance.tolist()),
        trials=tuple(trials),
        identifiability=identifiability,
        notes=(
            *filter(None, (describe_unidentified(*pair) for pair in effects.items())),
            *([_describe_limit(timing)] if timing.is_at_limit else []),
            *filter(None, [influence.worst_second.sentence]),
            *notes,
            *identifiability.sentences,
            *(
                f"`{name}` is at the limit of its range, so its interval is not valid."
                for name, there in zip(names, estimate.at_bound, strict=True)
                if there
            ),
        ),
        **{**further, **estimate.report, "input_timing": timing},
    )


def _headline(parameters: Mapping[str, ParameterEstimate]) -> str:
    """Return the parameters in one line, truncated if there are many."""
    shown = [
        f"{name} {round_with_sd(entry.estimate, entry.sd)} {entry.unit}".rstrip()
        for name, entry in parameters.items()
    ]
    if len(shown) <= MOST_SHOWN:
        return ", ".join(shown)
    return f"{', '.join(shown[:MOST_SHOWN])} and {len(shown) - MOST_SHOWN} more"


def _assess_influence(
    names: Sequence[str],
    sd: Array,
    timing_sd: float,
    trials: Sequence[str],
    moves: Mapping[str, Array],
    worst: RemovedStretch,
) -> Influence:
    """Return how far each trial, and the worst second, move the parameters."""
    count = len(names)
    every = (*names, "input_timing")
    known = dict(zip(every, np.maximum([*sd, timing_sd], np.finfo(float).tiny), strict=True))
    place = int(np.argmax(np.abs(worst.move[:count])))
    trial, move = trials[worst.trial], float(worst.move[place])
    stands_out = abs(move) > max(_MOVES, _OUTLYING * float(worst.typical[place]))
    return Influence(
        trials={
            trial: {
                name: float(by / known[name])
                for name, by in zip(every[: len(row)], row, strict=True)
            }
            for trial, row in moves.items()
        },
        worst_second=WorstSecond(
            trial=trial,
            start_s=worst.start_s,
            parameter=names[place],
            move=move,
            sentence=f"Without the second from {worst.start_s:.1f} s of trial {trial} on,"
            f" `{names[place]}` changes by {abs(move):.1f} standard deviations, without a typical"
            f" one by {worst.typical[place]:.2g}: look there for a transient or an outlier."
            if stands_out
            else "",
        ),
    )


def _judge_effect(
    effect: BoundEffect, parameters: Mapping[str, ParameterEstimate], covariance: Array
) -> EffectEstimate:
    """Judge whether an effect is identified: its strength is not zero, and its shape is known.

    Several strengths, such as those of sine and cosine, are tested jointly, because correlated
    errors may leave none of them determined alone. A shape that cannot be negative needs an
    interval smaller than its value. ``covariance`` is (n, n), of all ``parameters`` in their order.
    """
    free = [(item, parameters[item.name]) for item in effect.parameters if item.name in parameters]
    faults = {item.name: _fault(item.name, entry) for item, entry in free}
    strengths = [faults[item.name] for item, _ in free if item.strength]
    shapes = [
        faults[item.name]
        for item, entry in free
        if item.shape and (item.lower >= 0.0 or entry.at_bound)
    ]
    reasons = [fault for fault in shapes if fault]
    places = [list(parameters).index(item.name) for item, _ in free if item.strength]
    value = np.array([entry.estimate for item, entry in free if item.strength])
    has_strength = not places or _differs_from_zero(value, covariance[np.ix_(places, places)])
    if not has_strength:
        reasons = [*filter(None, strengths), *reasons]
    return EffectEstimate(has_strength=has_strength, identified=not reasons, reasons=tuple(reasons))


def _differs_from_zero(value: Array, covariance: Array) -> bool:
    """Return whether zero lies outside the 95 % region of estimates (k,), covariance (k, k)."""
    sd = np.sqrt(np.diag(covariance))
    if np.any((sd == 0.0) & (value != 0.0)):
        return True
    distance = value @ invert_scaled(covariance) @ value
    return bool(distance > stats.chi2.ppf(0.95, len(value)))


def _fault(name: str, entry: ParameterEstimate) -> str:
    """Return why a parameter is not determined; "" if it is."""
    if entry.at_bound:
        return f"`{name}` is at the limit of its range"
    if NORMAL_95 * entry.sd >= abs(entry.estimate):
        half = NORMAL_95 * entry.sd
        return (
            f"`{name}` is {round_with_sd(entry.estimate, half)} {entry.unit}".rstrip()
            + ", an interval larger than itself"
        )
    return ""


def _describe_limit(timing: InputTiming) -> str:
    way = "later" if timing.estimate > 0.0 else "earlier"
    if abs(timing.estimate) < NORMAL_95 * timing.sd:
        return (
            f"The input delay is at its limit of half a sample ({1e3 * timing.limit:.3g} ms {way}"
            f" than logged, ± {1e3 * timing.sd:.2g} ms): these trials do not determine it, or"
            f" {TIMING_AT_LIMIT}."
        )
    return (
        f"The force acts at least {1e3 * timing.limit:.3g} ms {way} than logged, the limit of half"
        f" a sample: {TIMING_AT_LIMIT}."
    )
