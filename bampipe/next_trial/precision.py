"""What a further trial would do for the parameters: information added, standard deviations left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array
from bampipe.estimate.least_squares import Problem, stacked_residual
from bampipe.estimate.low_pass import Band
from bampipe.identification.filter_choice import FilterChoice
from bampipe.identification.identifiability import find_information
from bampipe.identification.sensor_noise import Noise
from bampipe.physics import System
from bampipe.results.identify import IdentifyResult
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import problem_of

_BLOCK_S = FilterChoice.block_s
_ALIKE = 0.2
"""How far the scatter of blocks beyond what an estimator believes differs between parameters."""
_EIGHT_OF_TEN = 1.28
"""Standard deviations of a normal distribution on either side that hold eight of ten."""
_LACKING = 2.0
"""Uncertainties by the residual over those by the sensors, from which on the model lacks more than
the sensors leave, and the residual counts as noise."""


@dataclass(frozen=True)
class Expected:
    """Standard deviations that are expected, each (n,): what comes lies between ``low`` and
    ``high`` in eight of ten cases."""

    low: Array
    median: Array
    high: Array


@dataclass(frozen=True)
class Precision:
    """What is known of the parameters, and what trials would add.

    Attributes:
        names: of the estimated parameters, in order.
        sd: (n,) published standard deviations.
        formal_sd: (n,) those of the estimator alone, were noise as it assumes.
        systematic_sd: (n,) the part of ``sd`` by which methods disagree.
        irreducible_sd: (n,) the part that no further trial takes away: of sensors known so well
            only, and of friction that is smoothed.
        blocks: of time in the trials at hand, of which the scatter is in ``sd``.
        information: (m, m) of the trials at hand with what was assumed beforehand; the timing of
            the inputs last where it is estimated, m is then n + 1.
        prior_precision: (m,) part of its diagonal that the fit weighs as data; zero for what the
            trials alone determine.
        of_motion: information (m, m) of a motion.
    """

    names: tuple[str, ...]
    sd: Array
    formal_sd: Array
    systematic_sd: Array
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
        noise: Noise,
    ) -> Precision:
        """What the trials at hand say.

        The uncertainty of an estimate is that of a regression in the coloured noise of the sensors,
        whatever method made it; where least squares leave far more than the sensors do, it has
        the scatter of the residual in its band.

        Args:
            motions: the trials that were fitted; band: of residuals.
            p: (n_p,) the published parameters; identified: with their uncertainty.
        """
        timed = identified.input_timing.limit > 0.0
        full = np.append(p, identified.input_timing.estimate)
        scatter = identified.residual_sd or {}
        weight = np.array([scatter.get(axis, 1.0) ** -2.0 for axis in system.coordinates])
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
            """Information of the trials at hand, and the standard deviations that it leaves."""
            total = np.sum([of_motion(motion) for motion in motions], axis=0) + before
            return np.asarray(total), np.sqrt(np.diag(_covariance(total))[: len(names)])

        of_motion: Callable[[Motion], Array] = by_sensors
        total, formal = known_by(by_sensors)
        if identified.method == "ukf":
            formal = np.array([e.filter_sd or sd for e, sd in zip(entries, formal, strict=True)])
        elif scatter:
            other, by_scatter = known_by(by_residual)
            if np.exp(np.mean(np.log(by_scatter / formal))) > _LACKING:
                of_motion, total, formal = by_residual, other, by_scatter
        return cls(
            tuple(names), np.array([e.sd for e in entries]), formal,
            np.array([e.systematic_sd or 0.0 for e in entries]), np.array(lasting),
            sum(max(1, int((m.t[-1] - m.t[0]) / _BLOCK_S)) for m in motions),
            total, problem.precision, of_motion,
        )  # fmt: skip

    def expect(self, added: Array, seconds: float) -> Expected:
        """What will be published once there are trials more.

        A published standard deviation is what the estimator believes, times how much more blocks
        of time scatter than it believes they do. That scatter is taken with few blocks, now and
        then again, and is uncertain accordingly: what it is of one parameter is held against what
        it is of all, and the blocks that tell most then are those of the trial that adds most.
        Methods disagree by what each makes of noise that the motion at hand hardly exceeds: the
        estimate is a mean by information, in which a trial that does exceed it dilutes that at
        least. Mostly it goes beside such a trial, for a method that was misled is found out.
        What was known beforehand and weighed as data does not scatter.

        Args:
            added: (m, m) information of the trials; seconds: of them together.
        """
        (before, by_data), (after, by_data_then) = (
            self._variance(matrix) for matrix in (self.information, self.information + added)
        )
        share, new = after / before, max(1, int(seconds / _BLOCK_S))
        rest = self.systematic_sd**2 + self.irreducible_sd**2
        statistical = np.maximum(self.sd**2 - rest, 1e-300) / self.formal_sd**2
        scattered = np.maximum(statistical - (1.0 - by_data), 1e-12)
        scatter = 0.5 * np.log(scattered / np.maximum(by_data, 1e-12))
        scatter -= np.log(self._few(self.blocks))
        chance = 0.5 / max(self.blocks - self._fitted, 1)
        # Where prior knowledge is most of an uncertainty, nothing is seen of the scatter.
        trust = by_data * _ALIKE**2 / (_ALIKE**2 + chance)
        mean = float(np.average(scatter, weights=np.maximum(by_data, 1e-12)))
        scatter = mean + trust * (scatter - mean)
        informative = np.maximum(share * self.blocks + (1.0 - share) * new, 1.0)
        least = self.formal_sd * np.sqrt(share)
        determined = max(float(by_data.sum()), 1.0)
        wide = _EIGHT_OF_TEN * np.sqrt(trust * chance + chance / determined + 0.5 / informative)

        def noise(widening: Array | float) -> Array:
            data = np.exp(scatter) * self._few(self.blocks + new) * widening
            return np.asarray(least * np.sqrt(by_data_then * data**2 + (1.0 - by_data_then)))

        low, median, high = (
            np.hypot(np.hypot(size, disagreement), self.irreducible_sd)
            for size, disagreement in (
                (noise(np.exp(-wide)), 0.0),
                (np.maximum(noise(1.0), least), share**2 * self.systematic_sd),
                (np.maximum(noise(np.exp(wide)), least), share * self.systematic_sd),
            )
        )
        return Expected(low, median, high)

    def _variance(self, information: Array) -> tuple[Array, Array]:
        """Variances of the parameters, (n,), and the share of each that trials alone make."""
        covariance, n = _covariance(information), len(self.names)
        variance = np.diag(covariance)[:n]
        weighed = np.einsum("ij,j,ij->i", covariance, self.prior_precision, covariance)[:n]
        return variance, np.clip(1.0 - weighed / variance, 0.0, 1.0)

    @property
    def _fitted(self) -> int:
        """How many numbers the trials alone determine."""
        return int(np.count_nonzero(self.prior_precision == 0.0))

    def _few(self, blocks: int) -> float:
        """By how much few blocks widen a standard deviation; for very few, shorter ones count."""
        taken = max(blocks, 2 * self._fitted)
        return float(np.sqrt(taken / (taken - self._fitted)))

    def worth_of(self, motion: Motion, parameter: str) -> float:
        """`worth` of one trial."""
        return self.worth(self.of_motion(motion), float(motion.t[-1]), parameter)

    def worth(self, added: Array, seconds: float, parameter: str = "") -> float:
        """What trials are worth, nats: for one parameter, or where none is named for all.

        Args:
            added: (m, m) information of the trials; seconds: of them together.
            parameter: whose standard deviation counts, by the fall of its logarithm.
        """
        if not parameter:
            return self.gain(added)
        place = self.names.index(parameter)
        return float(np.log(self.sd[place] / self.expect(added, seconds).median[place]))

    def gain(self, added: Array) -> float:
        """Half the drop of the log determinant of the covariance of all parameters, nats."""
        n = len(self.names)
        # In units of the deviations, so that no determinant over- or underflows.
        before, after = (
            np.linalg.slogdet(_covariance(matrix)[:n, :n] / np.outer(self.sd, self.sd))[1]
            for matrix in (self.information, self.information + added)
        )
        return float(0.5 * (before - after))


def _covariance(information: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(information))
    return np.asarray(np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale))
