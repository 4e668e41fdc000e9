"""What filtering does to a fit by least squares, measured by replays and taken off."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bampipe.errors import InputError
from bampipe.estimate.least_squares import LeastSquares, Problem, fit
from bampipe.physics import System
from bampipe.trials.draw import draw_trials
from bampipe.trials.kinematics import Kinematics
from bampipe.trials.motion import Motion, trial_sizes
from bampipe.trials.replay import UNLIKE, StandIn, replay_motions
from bampipe.trials.residuals import problem_of
from bampipe.trials.sensors import Sensors

Array = NDArray[np.float64]

_CORRECTIONS = 5
"""Most replays of a nonlinear model, until its fit is the measured one's."""
_AVERAGED = 4
"""Replays whose mean is the bias where noise of the forces is part of it."""
_SAME = 1.0
"""Standard deviations within which the two fits are the same."""
_SLOPE = (0.3, 3.0)
"""Range of how far the fit to a replay moves with a parameter: 1 where there is no bias."""


@dataclass(frozen=True)
class UnbiasedFit:
    """Least squares with its bias taken off.

    Attributes:
        raw: the fit; p: (n_p + 1,) without its bias, within the bounds.
        bias: (n_free,) what was taken off; None where no replay resembles the machine.
        problem: what was fitted.
        bias_at: (n_p + 1,) parameters to their bias (n_free,), by a replay, which may raise
            :class:`InputError`; None where there is no bias.
        drawn_covariance: (n_free, n_free) of the bias of the trials drawn for it about that of all,
            and of noise in it; zero where all were replayed without noise, and None where there is
            no bias.
    """

    raw: LeastSquares
    p: Array
    bias: Array | None
    problem: Problem
    bias_at: Callable[[Array], Array] | None = None
    drawn_covariance: Array | None = None

    @property
    def covariance(self) -> Array:
        """(n_free, n_free) of the parameters without bias."""
        if self.drawn_covariance is None:
            return self.raw.covariance
        return self.raw.covariance + self.drawn_covariance

    def gap(self, p: Array) -> Array:
        """Return how far the fit would be from what it is if ``p`` (n_p + 1,) were true, (n_free,).

        Raises:
            InputError: the model cannot be replayed with these parameters.
        """
        free = self.problem.free
        bias = np.zeros(free.size) if self.bias_at is None else self.bias_at(p)
        return np.asarray(p[free] + bias - self.raw.p[free])


def remove_bias(
    sensors: Sensors,
    kinematics: Kinematics,
    system: System,
    motions: Sequence[Motion],
    problem: Problem,
    raw: LeastSquares,
) -> UnbiasedFit:
    """Take off what the filters alone do to the fit.

    Filtering blurs changes of direction and shortens accelerations, so that the fit to a perfect
    machine is not its truth. How far off it is, is measured: the fitted model is replayed along
    the trials, read by the same encoders, sent through the same filters and fitted again
    (parametric bootstrap, Efron and Tibshirani 1993, chapter 10). The force sensor is without
    noise there: its noise adds scatter, not bias. Where it moves the mechanism, as through play, it
    does: then several replays with that noise are averaged. Where the model is nonlinear in its
    parameters and the bias is large, it is not that at the answer: those parameters are looked for
    whose replay is fitted as the measurement is (indirect inference, Gourieroux, Monfort and
    Renault 1993). Of a long session, trials drawn from all are replayed; how far their bias may be
    from that of all, and what noise makes of a mean, is given as a covariance.

    Args:
        sensors: that read the trials; kinematics: the filters they went through.
        system: the model; motions: the trials; problem: as fitted; raw: the fit.
    """
    free = problem.free
    count = len(system.parameters)
    timing = bool(free[-1] == count)

    drawn = draw_trials(trial_sizes(motions))
    left_out = 1.0 - len(drawn) / len(motions)
    replayed = [motions[number] for number in drawn] if left_out else motions
    noisy = system.moves_sensors
    averaged = _AVERAGED if noisy else 1
    known: dict[bytes, list[LeastSquares]] = {}

    def bias_at(p: Array) -> Array:
        found = np.mean([each.p for each in refits(p)], axis=0)
        return np.asarray((found - np.append(p[:count], 0.0))[free])

    def refits(p: Array) -> list[LeastSquares]:
        if p.tobytes() not in known:
            stand_in = StandIn(system, p[:count], replayed, sensors.rate_hz)
            known[p.tobytes()] = [fit_replay(stand_in, number) for number in range(averaged)]
        return known[p.tobytes()]

    def fit_replay(stand_in: StandIn, number: int) -> LeastSquares:
        replays = replay_motions(
            stand_in, sensors, kinematics, (0, number), force_noise=noisy, alone=True
        )
        # Of a replay no input is late, unless the timing is found anew.
        start = raw.p if timing else np.append(raw.p[:count], 0.0)
        again = fit(problem_of(system, replays, problem.band, timing=timing), start)
        if np.any(again.residual_sd > UNLIKE * raw.residual_sd):
            raise InputError("the replay of the model does not resemble the machine")
        return replace(again, stacked=(), measured=())

    def moved(bias: Array) -> Array:
        p = raw.p.copy()
        p[free] = np.clip(p[free] - bias, problem.lower, problem.upper)
        return p

    try:
        bias = bias_at(raw.p)
    except InputError:
        # Replays of a model that lacks much, or of a damper stiffer than the arm that leads it, do
        # not hold the motion: their bias says nothing of this fit.
        return UnbiasedFit(raw, raw.p, None, problem)
    # A large bias of a nonlinear model changes on the way to the answer, by some bias^2 / p.
    sd = np.sqrt(np.diag(raw.covariance))
    drawn_covariance = refits(raw.p)[0].covariance
    about_all = (left_out + (1.0 / averaged if noisy else 0.0)) * drawn_covariance
    found = UnbiasedFit(raw, moved(bias), bias, problem, bias_at, about_all)
    if not problem.linear and np.any((bias**2 > sd * np.abs(raw.p[free]))[free < count]):
        bias = _settled(found, bias, moved)
        found = replace(found, p=moved(bias), bias=bias)
    return found


def _settled(squares: UnbiasedFit, bias: Array, moved: Callable[[Array], Array]) -> Array:
    """Return the bias (n_free,) at the parameters that it leads to, by secants, one by one.

    Args:
        squares: the fit; bias: at the fit itself; moved: parameters with a bias taken off.
    """
    raw, free = squares.raw, squares.problem.free
    sd = np.maximum(np.sqrt(np.diag(raw.covariance)), np.finfo(float).tiny)
    best, least = bias, np.inf
    before, off_before = raw.p[free], bias
    for _ in range(_CORRECTIONS):
        p = moved(bias)
        try:
            off = squares.gap(p)
        except InputError:
            break
        size = float(np.max(np.abs(off) / sd))
        if size < least:
            best, least = bias, size
        if size < _SAME:
            break
        step = p[free] - before
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.nan_to_num((off - off_before) / step, nan=1.0, posinf=1.0, neginf=1.0)
        before, off_before = p[free], off
        bias = raw.p[free] - (p[free] - off / np.clip(slope, *_SLOPE))
    return best
