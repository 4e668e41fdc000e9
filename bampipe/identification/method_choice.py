"""Which estimate is published: the one whose parameters predict trials that they have not seen.

The filter is the most precise where the model is right and its noise white. Where the model lacks
something, or the motion is sampled too coarsely for it, it can settle anywhere. Least squares on
the force is consistent even there, also under feedback, since what the model lacks is in the force
and not in what it is regressed on; output error and the filter are not. So the filter is published
where it predicts as well as the best, and otherwise the method that does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bampipe.errors import InputError
from bampipe.identification.estimates import Estimate
from bampipe.phrases.results import METHODS
from bampipe.physics import System
from bampipe.results.identify import Method, MethodTried, MethodValue
from bampipe.results.intervals import NORMAL_95
from bampipe.results.rounding import round_with_sd, significant
from bampipe.trials.bias import UnbiasedFit
from bampipe.trials.folds import Folds

Array = NDArray[np.float64]

AS_GOOD = 1.02
"""Held-out error over that of the best method, on the worst axis, up to which a method predicts as
well. Where a model is right and no load moves an encoder, methods are within 1.005."""
_SOUND = 1.2
"""The same beyond which a method counts for nothing: validate would refuse its parameters."""
_SCATTERED = 1.3
"""Standard deviations of the filter over those of least squares, from which on least squares are
published. In eight of 46 identifications of a joint they were: there the filter's true errors were
1.6 to 32 times those of least squares."""
_UNSURE = 3.0
"""The same with what the width of the smoothed sign leaves open."""
_BIASED = 0.5
"""Bias of least squares over what is left, from which on it is an extrapolation."""
_APART = 2.0
"""Uncertainties of both from which on two methods are said to disagree."""
_SCATTER = 3.0
"""Standard deviations of nonlinear least squares within which their scatter is no evidence."""


@dataclass(frozen=True)
class Judged:
    """An estimate with its held-out error.

    Attributes:
        estimate: the parameters; error: (n_q,) held-out, N.m or N.
        published_error: (n_q,) of the parameters themselves on the same trials, N.m or N: those of
            a filter that a late sample has thrown off are not those that it had without a trial.
    """

    estimate: Estimate
    error: Array
    published_error: Array

    @property
    def worse_error(self) -> Array:
        """The larger of both, (n_q,)."""
        return np.maximum(self.error, self.published_error)


def judge(squares: UnbiasedFit, folds: Folds, estimate: Estimate) -> Judged:
    """Return the error (n_q,) of predictions of each trial by parameters that have not seen it.

    A prediction from filtered motions needs the parameters that a fit to such motions would have
    if these were true: filtering blurs a change of direction, and the truth itself would look
    worse than a fit that has taken on the blur.

    Args:
        squares: the fit to all trials, linearised, of the same problem.
        folds: of its trials; estimate: whose `held_out` parameters are judged.
    """
    problem, raw = squares.problem, squares.raw
    shift = _bias(squares, estimate)
    n_q = len(raw.residual_sd)
    total, count = np.zeros((2, n_q)), np.zeros(n_q)
    for trial, (stacked, left_out) in enumerate(zip(raw.stacked, estimate.held_out, strict=True)):
        if not folds.judged[trial]:
            continue
        for which, given in enumerate((left_out, estimate.p)):
            p = given.copy()
            p[problem.free] = np.clip(p[problem.free] + shift, problem.lower, problem.upper)
            if problem.linear:
                found = stacked.residual + stacked.slope @ (p - raw.p)[problem.free]
            else:
                found = problem.band.thin(problem.residual(trial, p)) * stacked.used
            total[which] += np.sum(found**2, axis=0)
        count += np.sum(stacked.used, axis=0)
    return Judged(estimate, *np.sqrt(total / np.maximum(count, 1.0)))


def _bias(squares: UnbiasedFit, estimate: Estimate) -> Array:
    """Return what filtering would add to a fit if an estimate were true, (n_free,)."""
    nothing = np.zeros(squares.problem.free.size)
    if squares.bias is None or squares.bias_at is None:
        return nothing
    if squares.problem.linear:
        return squares.bias
    with suppress(InputError):
        return squares.bias_at(estimate.p)
    return nothing


def relative_errors(system: System, judged: Sequence[Judged]) -> Array:
    """Return each method's error over the least of all, on the worst axis that is driven."""
    driven = [axis not in system.undriven for axis in system.coordinates]
    error = np.array([each.worse_error for each in judged])[:, driven]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.nan_to_num(error / error.min(axis=0), nan=1.0, posinf=np.inf)
    return np.asarray(ratio.max(axis=1, initial=1.0))


def choose(system: System, judged: Sequence[Judged]) -> int:
    """Return the index of the estimate to publish.

    The first that predicts as well as the best and that nothing speaks against; failing that, the
    first that predicts as well; methods come in the order of their precision. Within their
    uncertainties of the best, parameters count as good: a model can turn a small difference of a
    parameter into much noise.
    """
    good, least = _good(system, judged)
    return [*good, least][0]


def prefer_steady(system: System, judged: Sequence[Judged], chosen: int) -> int:
    """Return least squares' index where the filter was chosen and they scatter far less, else it.

    A filter that a single reversal has thrown off scatters from block to block, and one whose
    answer hangs on how friction changes its sign is unsure; neither is the more precise.
    """
    published = judged[chosen].estimate
    for k in _good(system, judged)[0]:
        other = judged[k].estimate
        rivals = (published.method, other.method) == ("ukf", "least-squares")
        if not rivals or other.doubts:
            continue
        scatters = _looser(published, other, smoothing=False) > _SCATTERED
        if scatters or _looser(published, other, smoothing=True) > _UNSURE:
            return k
    return chosen


def _good(system: System, judged: Sequence[Judged]) -> tuple[list[int], int]:
    """Return which methods predict as well as the best, those not in doubt first, and the best."""
    ratio = relative_errors(system, judged)
    least = int(np.argmin(ratio))
    best = judged[least].estimate
    good = [
        k
        for k, each in enumerate(judged)
        if ratio[k] <= AS_GOOD
        or (ratio[k] <= _SOUND and not (_apart(each.estimate, best) & ~_open(system, best)).any())
    ]
    return sorted(good, key=lambda k: bool(judged[k].estimate.doubts)), least


def _looser(one: Estimate, other: Estimate, smoothing: bool) -> float:
    """Return how many times the standard deviations of one are those of another, typically.

    Args:
        smoothing: whether what the width of the smoothed sign leaves open counts as well.
    """
    least = np.finfo(float).tiny
    known = np.zeros(len(one.sd))
    if not smoothing and one.details:
        known = np.array([entry.get("smoothing_sd", 0.0) for entry in one.details])
    sd = np.sqrt(np.maximum(one.sd**2 - known**2, least))
    return float(np.exp(np.mean(np.log(sd / np.maximum(other.sd, least)))))


def _apart(one: Estimate, other: Estimate) -> NDArray[np.bool_]:
    """Return which parameters lie farther apart than both uncertainties allow, (n,)."""
    size = _APART * np.hypot(one.sd, other.sd)
    return np.asarray(np.abs(one.value - other.value) > size)


def _open(system: System, estimate: Estimate) -> NDArray[np.bool_]:
    """Return which parameters are of an effect whose size or shape an estimate leaves open, (n,).

    Strength and shape of an effect trade off: of one that is uncertain by its own size, or from
    which least squares take off half as much as bias, neither speaks against another method's.
    """
    names = [system.parameters[place].name for place in estimate.free]
    bias = [
        entry.get("least_squares_bias", 0.0) if estimate.method == "least-squares" else 0.0
        for entry in estimate.details
    ]
    unknown = {
        name
        for name, value, sd, off in zip(names, estimate.value, estimate.sd, bias, strict=True)
        if max(NORMAL_95 * sd, abs(off) / _BIASED) >= abs(value)
    }
    found: set[str] = set()
    for effect in system.model.effects:
        strengths = {item.name for item in effect.parameters if item.strength}
        shapes = {item.name for item in effect.parameters if item.shape and item.lower >= 0.0}
        if strengths and (strengths <= unknown or shapes & unknown):
            found |= {item.name for item in effect.parameters}
    return np.array([name in found for name in names])


def widen(
    system: System, judged: Sequence[Judged], published: int, squares: UnbiasedFit
) -> Estimate:
    """Return the published estimate, its uncertainties widened by what sound methods say against.

    They see the same data and err alike by noise, but not by what the model lacks: where the
    model is right, a difference stays below the sum of the variances and adds nothing.
    """
    chosen = judged[published].estimate
    ratio = relative_errors(system, judged)
    systematic = np.zeros(len(chosen.value))
    for k, other in enumerate(judged):
        if k != published and ratio[k] <= _SOUND and not other.estimate.doubts:
            apart = _disagreement(chosen, other.estimate, squares)
            systematic = np.maximum(systematic, np.where(_open(system, other.estimate), 0.0, apart))
    details = [
        {**fields, "systematic_sd": size}
        for fields, size in zip(chosen.details, systematic, strict=True)
    ]
    covariance = chosen.covariance + np.diag(systematic**2)
    return replace(chosen, covariance=covariance, details=details)


def _disagreement(one: Estimate, other: Estimate, squares: UnbiasedFit) -> Array:
    """Return how far two estimates lie apart beyond their standard deviations, (n,).

    Where the model is nonlinear, least squares know less than the others and scatter on their own:
    they are asked what they would be if the other answer were true, and count if that is not so.
    A fit to filtered motions can move by many times what the truth does, so that this does not say
    how far the two are apart.
    """
    by_squares = [each.method == "least-squares" for each in (one, other)]
    variance = one.sd**2 + other.sd**2
    if any(by_squares):
        # That their bias is of some trials only is no reason to trust the other more.
        drawn = np.diag(squares.covariance - squares.raw.covariance)
        variance -= drawn[: len(variance)]
    difference = np.abs(one.value - other.value)
    if not squares.problem.linear and any(by_squares) and np.any(difference**2 > variance):
        # An answer that cannot be replayed is all the more in doubt.
        with suppress(InputError):
            gap = np.abs(squares.gap(other.p if by_squares[0] else one.p)[: len(difference)])
            difference = np.where(gap < _SCATTER * np.sqrt(variance), 0.0, difference)
    return np.asarray(np.sqrt(np.maximum(difference**2 - variance, 0.0)))


def tabulate_methods(
    system: System, published: Estimate, judged: Sequence[Judged], lost: str = ""
) -> dict[Method, MethodTried]:
    """Return what identify.json says of each method, the published one first.

    Args:
        system: the model; published: as `widen` returns it; judged: all estimates.
        lost: what happened to the filter where it lost the motion.
    """
    names = [system.parameters[place].name for place in published.free]
    found: dict[Method, MethodTried] = {}
    for each in sorted(judged, key=lambda item: item.estimate.method != published.method):
        estimate = published if each.estimate.method == published.method else each.estimate
        apart = _apart(estimate, published)
        found[estimate.method] = MethodTried(
            held_out_rmse=dict(zip(system.coordinates, each.error, strict=True)),
            parameters={
                name: MethodValue(estimate=value, sd=sd)
                for name, value, sd in zip(names, estimate.value, estimate.sd, strict=True)
            },
            disagrees=tuple(name for name, is_apart in zip(names, apart, strict=True) if is_apart),
            doubts=estimate.doubts,
        )
        if lost and len(found) == 1:
            found["ukf"] = MethodTried(doubts=(lost,))
    return found


def describe_methods(system: System, methods: Mapping[Method, MethodTried]) -> list[str]:
    """Say what the methods tried that are not published have against them, and where they differ.

    Args:
        system: the model; methods: from `tabulate_methods`.
    """
    method, published = next(iter(methods.items()))
    words = METHODS[method]
    sentences = [f"Published by {words}, although {doubt}." for doubt in published.doubts]
    for other, tried in methods.items():
        if other == method:
            continue
        against = [*_worse(system, published, tried), *tried.doubts]
        if tried.disagrees:
            against.append(
                "the latter puts "
                + ", ".join(
                    f"`{name}` at {round_with_sd(one.estimate, one.sd)}"
                    for name in tried.disagrees
                    for one in (tried.parameters[name],)
                )
            )
        if against:
            sentences.append(
                f"Published by {words}, not by {METHODS[other]}: {'; '.join(against)}."
            )
    return sentences


def _worse(system: System, published: MethodTried, tried: MethodTried) -> list[str]:
    """Say on which axis a method predicts worse than the published one."""
    units = {
        axis: unit
        for axis, unit in zip(system.coordinates, system.torque_units, strict=True)
        if tried.held_out_rmse.get(axis, 0.0) > AS_GOOD * published.held_out_rmse[axis]
    }
    if not units:
        return []
    axis = max(units, key=lambda a: tried.held_out_rmse[a] - published.held_out_rmse[a])
    return [
        f"on trials left out the latter errs by {significant(tried.held_out_rmse[axis])}"
        f" {units[axis]} on {axis}, the former by {significant(published.held_out_rmse[axis])}"
    ]
