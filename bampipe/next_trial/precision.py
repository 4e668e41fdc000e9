"""The gain of a further trial for the parameters: information and remaining uncertainty."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from bampipe.arrays import Array
from bampipe.estimate.bounded import invert_scaled
from bampipe.estimate.least_squares import Problem, stacked_residual
from bampipe.estimate.low_pass import Band
from bampipe.estimate.square_root import FilterSettings
from bampipe.identification.identifiability import find_information
from bampipe.identification.sensor_noise import FilterChoice
from bampipe.physics import System
from bampipe.results.identify import IdentifyResult
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import problem_of

_BLOCK_S = FilterChoice.block_s
_SCATTER_SPREAD = 0.2
"""Spread between parameters of the ratio of block scatter to formal uncertainty, log scale."""
_NORMAL_80 = 1.28
"""Standard deviations on either side of the mean that contain 80 % of a normal distribution."""
_RESIDUAL_DOMINATES = 2.0
"""Ratio of uncertainties by the residual to those by the sensors above which the residual, not the
sensor noise, counts as noise."""


@dataclass(frozen=True)
class Expected:
    """Expected standard deviations, each (n,): the outcome lies between ``low`` and ``high`` in
    eight of ten cases."""

    low: Array
    median: Array
    high: Array


@dataclass(frozen=True)
class Precision:
    """The present uncertainty of the parameters, and the information that trials would add.

    Attributes:
        sd: (n,) published standard deviations of the estimated parameters, in order.
        formal_sd: (n,) those of the estimator alone, if its assumptions on noise held.
        irreducible_sd: (n,) the part that no further trial reduces: calibration of the sensors and
            smoothing of friction.
        blocks: number of blocks of time in the trials at hand, whose scatter is in ``sd``.
        information: (m, m) of the trials at hand and the priors, with the input delay last if it is
            estimated; m is then n + 1.
        prior_precision: (m,) part of its diagonal that the fit treats as data; zero for parameters
            that the trials alone determine.
        of_motion: returns the information (m, m) of a motion.
    """

    names: tuple[str, ...]
    sd: Array
    formal_sd: Array
    irreducible_sd: Array
    blocks: int
    information: Array
    prior_precision: Array
    of_motion: Callable[[Motion], Array]

    @classmethod
    def of_trials(
        cls,
        system: System,
        motions: Sequence[Motion],
        band: Band,
        p: Array,
        identified: IdentifyResult,
        noise: FilterSettings,
    ) -> Self:
        """Return the precision that the trials at hand give.

        The uncertainty is that of a regression in the coloured noise of the sensors, whatever
        method was used; if the residual of least squares is far larger than the noise of the
        sensors, its scatter in its band counts instead.

        Args:
            motions: the trials that were fitted; band: of residuals.
            p: (n_p,) the published parameters; identified: their record, with uncertainties.
        """
        timed = identified.input_timing.limit > 0.0
        full = np.append(p, identified.input_timing.estimate)
        scatter = identified.residual_sd or {}
        weight = np.array([(scatter.get(axis) or 1.0) ** -2.0 for axis in system.coordinates])
        weight *= band.independent_share

        def pose(motion: Motion) -> Problem:
            return problem_of(system, [motion], band, timing=timed)

        def by_sensors(motion: Motion) -> Array:
            return find_information(system, motion, pose(motion), 0, full, noise)

        def by_residual(motion: Motion) -> Array:
            slope = stacked_residual(pose(motion), 0, full).slope
            return np.asarray(np.einsum("tap,taq,a->pq", slope, slope, weight))

        problem = pose(motions[0])
        assumed = np.array([q.sd for q in system.parameters])
        names = [system.parameters[i].name for i in problem.free if i < len(p)]
        prior = np.array([assumed[i] if i < len(p) else problem.upper[-1] for i in problem.free])
        before = np.diag(1.0 / np.maximum(prior, 1e-300) ** 2)
        entries = [identified.parameters[name] for name in names]
        lasting = [np.hypot(e.smoothing_sd or 0.0, e.calibration_sd or 0.0) for e in entries]

        def known_by(of_motion: Callable[[Motion], Array]) -> tuple[Array, Array]:
            """Return the information of the trials at hand and the standard deviations it gives."""
            total = np.sum([of_motion(motion) for motion in motions], axis=0) + before
            return np.asarray(total), np.sqrt(np.diag(invert_scaled(total))[: len(names)])

        of_motion: Callable[[Motion], Array] = by_sensors
        total, formal = known_by(by_sensors)
        if identified.method == "ukf":
            formal = np.array([e.filter_sd or sd for e, sd in zip(entries, formal, strict=True)])
        elif scatter:
            other, by_scatter = known_by(by_residual)
            if np.exp(np.mean(np.log(by_scatter / formal))) > _RESIDUAL_DOMINATES:
                of_motion, total, formal = by_residual, other, by_scatter
        return cls(
            tuple(names), np.array([e.sd for e in entries]), formal,
            np.array(lasting), sum(max(1, int((m.t[-1] - m.t[0]) / _BLOCK_S)) for m in motions),
            total, problem.precision, of_motion,
        )  # fmt: skip

    def expect(self, added: Array, seconds: float) -> Expected:
        """Return the standard deviations expected once further trials are recorded.

        A published standard deviation is the formal one times the excess scatter of blocks of time.
        That factor is estimated from few blocks, so that it is uncertain: the value of a parameter
        is shrunk towards the mean of all. Priors do not scatter.

        Args:
            added: (m, m) information of the trials; seconds: their total length.
        """
        (before, by_data), (after, by_data_then) = (
            self._split_variance(matrix) for matrix in (self.information, self.information + added)
        )
        share, new = after / before, max(1, int(seconds / _BLOCK_S))
        statistical = np.maximum(self.sd**2 - self.irreducible_sd**2, 1e-300) / self.formal_sd**2
        scattered = np.maximum(statistical - (1.0 - by_data), 1e-12)
        scatter = 0.5 * np.log(scattered / np.maximum(by_data, 1e-12))
        scatter -= np.log(self._widen_for_few(self.blocks))
        chance = 0.5 / max(self.blocks - self._free_count, 1)
        # If the prior dominates an uncertainty, the blocks show nothing of the scatter.
        trust = by_data * _SCATTER_SPREAD**2 / (_SCATTER_SPREAD**2 + chance)
        mean = float(np.average(scatter, weights=np.maximum(by_data, 1e-12)))
        scatter = mean + trust * (scatter - mean)
        informative = np.maximum(share * self.blocks + (1.0 - share) * new, 1.0)
        least = self.formal_sd * np.sqrt(share)
        determined = max(float(by_data.sum()), 1.0)
        wide = _NORMAL_80 * np.sqrt(trust * chance + chance / determined + 0.5 / informative)

        def sd(widening: Array | float, at_least: Array | float = least) -> Array:
            data = np.exp(scatter) * self._widen_for_few(self.blocks + new) * widening
            size = least * np.sqrt(by_data_then * data**2 + (1.0 - by_data_then))
            return np.asarray(np.hypot(np.maximum(size, at_least), self.irreducible_sd))

        return Expected(low=sd(np.exp(-wide), 0.0), median=sd(1.0), high=sd(np.exp(wide)))

    def _split_variance(self, information: Array) -> tuple[Array, Array]:
        """Return variances of the parameters, (n,), and the share of each that is due to trials."""
        covariance, n = invert_scaled(information), len(self.names)
        variance = np.diag(covariance)[:n]
        weighed = np.einsum("ij,j,ij->i", covariance, self.prior_precision, covariance)[:n]
        return variance, np.clip(1.0 - weighed / variance, 0.0, 1.0)

    @property
    def _free_count(self) -> int:
        """Number of parameters that the trials alone determine."""
        return int(np.count_nonzero(self.prior_precision == 0.0))

    def _widen_for_few(self, blocks: int) -> float:
        """Return the factor by which few blocks widen a standard deviation."""
        taken = max(blocks, 2 * self._free_count)
        return float(np.sqrt(taken / (taken - self._free_count)))

    def utility(self, added: Array, seconds: float, parameter: str = "") -> float:
        """Return the utility of trials in nats, for one parameter or for all together.

        Args:
            added: (m, m) information of the trials; seconds: their total length.
            parameter: if given, the utility is the drop of the logarithm of its sd.
        """
        if not parameter:
            return self.gain(added)
        place = self.names.index(parameter)
        return float(np.log(self.sd[place] / self.expect(added, seconds).median[place]))

    def gain(self, added: Array) -> float:
        """Return half the drop of the log determinant of the covariance, nats."""
        n = len(self.names)
        # In units of the standard deviations, so that no determinant over- or underflows.
        before, after = (
            np.linalg.slogdet(invert_scaled(matrix)[:n, :n] / np.outer(self.sd, self.sd))[1]
            for matrix in (self.information, self.information + added)
        )
        return float(0.5 * (before - after))
