"""What a further trial would do for the parameters: information added, standard deviations left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.least_squares import stacked_residual
from bampipe.estimate.low_pass import Band
from bampipe.identification.filter_choice import FilterChoice
from bampipe.identification.identifiability import find_information
from bampipe.identification.sensor_noise import Noise
from bampipe.physics import System
from bampipe.results.identify import IdentifyResult
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import problem_of

Array = NDArray[np.float64]

_BLOCK_S = FilterChoice.block_s
_ALIKE = 0.2
"""How far the scatter of blocks beyond what an estimator believes differs between parameters."""


@dataclass(frozen=True)
class Precision:
    """What is known of the parameters, and what trials would add.

    Attributes:
        names: of the estimated parameters, in order.
        sd: (n,) published standard deviations.
        formal_sd: (n,) those of the estimator alone, were noise as it assumes.
        systematic: (n,) the part of ``sd`` by which methods disagree.
        lasting: (n,) the part that no further trial takes away: of sensors known so well only, and
            of friction that is smoothed.
        blocks: of time in the trials at hand, of which the scatter is in ``sd``.
        information: (m, m) of the trials at hand with what was assumed beforehand; the timing of
            the inputs last where it is estimated, m is then n + 1.
        of_motion: information (m, m) of a motion.
    """

    names: tuple[str, ...]
    sd: Array
    formal_sd: Array
    systematic: Array
    lasting: Array
    blocks: int
    information: Array
    of_motion: Callable[[Motion], Array]

    @classmethod
    def of_trials(
        cls,
        system: System,
        motions: Sequence[Motion],
        band: Band,
        p: Array,
        identified: IdentifyResult,
        noise: Noise,
    ) -> Precision:
        """What the trials at hand say, by the noise that the published estimate has.

        The filter's uncertainty is that of a regression in the coloured noise of the sensors; that
        of least squares has the scatter of the residual in its band.

        Args:
            system: the model; motions: the trials that were fitted; band: of residuals.
            p: (n_p,) the published parameters; identified: with their uncertainty.
            noise: of the sensors.
        """
        timed = identified.input_timing.limit > 0.0
        full = np.append(p, identified.input_timing.estimate)
        by_filter = identified.method == "ukf"
        scatter = identified.residual_sd or {}
        weight = np.array([scatter.get(axis, 1.0) ** -2.0 for axis in system.coordinates])
        weight *= band.independent_share

        def of_motion(motion: Motion) -> Array:
            problem = problem_of(system, [motion], band, timing=timed)
            if by_filter:
                return find_information(system, motion, problem, 0, full, noise)
            slope = stacked_residual(problem, 0, full).slope
            return np.asarray(np.einsum("tap,taq,a->pq", slope, slope, weight))

        problem = problem_of(system, motions[:1], band, timing=timed)
        assumed = np.array([q.sd for q in system.parameters])
        names = [system.parameters[i].name for i in problem.free if i < len(p)]
        prior = np.array([assumed[i] if i < len(p) else problem.upper[-1] for i in problem.free])
        entries = [identified.parameters[name] for name in names]
        lasting = [np.hypot(e.smoothing_sd or 0.0, e.calibration_sd or 0.0) for e in entries]
        total = np.sum([of_motion(motion) for motion in motions], axis=0)
        total += np.diag(1.0 / np.maximum(prior, 1e-300) ** 2)
        formal = np.sqrt(np.diag(_covariance(total))[: len(names)])
        if by_filter:
            known = zip(entries, formal, strict=True)
            formal = np.array([e.filter_sd or found for e, found in known])
        return cls(
            tuple(names),
            np.array([e.sd for e in entries]),
            formal,
            np.array([e.systematic_sd or 0.0 for e in entries]),
            np.array(lasting),
            sum(_blocks_of(motion) for motion in motions),
            np.asarray(total),
            of_motion,
        )

    def sd_with(self, added: Array, seconds: float) -> Array:
        """Standard deviations, (n,), once there are trials more.

        A published one is what the estimator believes, times how much more blocks of time scatter
        than it believes they do, but never less. That scatter is taken with few blocks, and is
        uncertain accordingly: what it is of one parameter is held against what it is of all.
        Methods disagree by what each makes of noise that the motion at hand hardly exceeds: the
        estimate is a mean by information, in which a trial that does exceed it dilutes that.

        Args:
            added: (m, m) information of the trials; seconds: of them together.
        """
        n = len(self.names)
        before, after = (
            np.diag(_covariance(matrix))[:n]
            for matrix in (self.information, self.information + added)
        )
        blocks = self.blocks + max(1, int(seconds / _BLOCK_S))
        rest = self.systematic**2 + self.lasting**2
        statistical = np.sqrt(np.maximum(self.sd**2 - rest, 1e-300))
        scatter = np.log(statistical / self.formal_sd / self._few(self.blocks))
        trust = _ALIKE**2 / (_ALIKE**2 + 0.5 / max(self.blocks - len(self.information), 1))
        scatter = np.exp(scatter.mean() + trust * (scatter - scatter.mean()))
        share = after / before
        formal = self.formal_sd * np.sqrt(share)
        noise = formal * np.maximum(scatter * self._few(blocks), 1.0)
        apart = np.hypot(share * self.systematic, self.lasting)
        return np.asarray(np.hypot(noise, apart))

    def _few(self, blocks: int) -> float:
        """By how much few blocks widen a standard deviation."""
        return float(np.sqrt(blocks / max(blocks - len(self.information), 1)))

    def gain(self, added: Array) -> float:
        """Half the drop of the log determinant of the covariance of all parameters, nats."""
        n = len(self.names)
        before, after = (
            np.linalg.slogdet(_correlation(_covariance(matrix)[:n, :n], self.sd))[1]
            for matrix in (self.information, self.information + added)
        )
        return float(0.5 * (before - after))


def _covariance(information: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(information))
    return np.asarray(np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale))


def _correlation(covariance: Array, sd: Array) -> Array:
    """The covariance in units of ``sd``, so that its determinant neither over- nor underflows."""
    return np.asarray(covariance / np.outer(sd, sd))


def _blocks_of(motion: Motion) -> int:
    return max(1, int((motion.t[-1] - motion.t[0]) / _BLOCK_S))
