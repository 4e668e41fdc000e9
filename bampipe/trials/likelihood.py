"""The likelihood of the measured quantity under a model, by which all models are judged.

For each sample of an axis that counts, with the symbols of docs/method_residual.md:

    y = f(motion; theta) + beta b + gamma c + eta d + e
    var e ~ s^2 (v(z) + tau^2 (b^2 + g^2 c^2) + h^2 + (delta F)^2), with the tails of Student's t

y is the low-passed residual of the fitted model; b the common bias, the mean of replicates; c the
stopping bias, the residual of a replicate whose friction truly stops the axis, and g a first guess
of its factor gamma; d the bias of a sign twice as wide; v the variance of replicates around b in
classes z of speed; h the uncertainty of dry friction because the instant of a reversal between two
samples is unknown; F the applied force; s the scale of the axis, which is fitted. Parameters have
priors and bounds, and so have the nuisance parameters: beta, gamma and eta of each axis, and the
input delay. The density is that of the measured force: `scale` gives the change of variables from
the residual.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from bampipe.arrays import Array
from bampipe.trials.kept import KeptItems
from bampipe.trials.linearisation import Linearisation
from bampipe.trials.samples import Noise, Samples, take_samples
from bampipe.trials.scale import bare_slopes

_LEAST = 1e-3
"""Smallest variance relative to the mean: no sample weighs more than a thousand average ones."""
_SLOW = 3.0
"""Speed in sign widths that counts as slow, where dry friction is fully developed."""
_FREQUENCIES = 256
"""Frequencies over which the power of white noise behind a low-pass is averaged."""


@dataclass(frozen=True)
class Likelihood:
    """Weights of a session's samples, and the statistics of the replicates behind them.

    Attributes:
        samples: of each axis, those that count; noise: statistics of the replicates.
        root: one over the standard deviation of each sample, by axis, each (n,).
        bias_variance: variance due to errors of the biases and of the instants of reversals, by
            axis, each (n,).
        applied: the applied force, by axis, each (n,), N.m or N.
        model: the weighted model, without its residual and slopes.
        force_sd: noise of each measured force, (n_forces,), in its unit.
        discrepancy: relative error that any model may have.
    """

    samples: tuple[Samples, ...]
    noise: Noise
    root: Sequence[Array]
    bias_variance: Sequence[Array]
    applied: Sequence[Array]
    model: Linearisation
    force_sd: Array
    discrepancy: float

    @classmethod
    def of(
        cls,
        linearisation: Linearisation,
        samples: tuple[Samples, ...],
        noise: Noise,
        bias_error: float,
        discrepancy: float,
        force_sd: Array,
    ) -> Self:
        """Weight samples by the noise of replicates, the error of the biases and the discrepancy.

        Args:
            force_sd: noise of each measured force, (n_forces,), in its unit.
        """
        e = linearisation
        axes = range(len(samples))
        applied = e.thin(lambda at: at.applied)
        turning = [np.zeros_like(r) for r in e.residual]
        if bias_error:
            turning = e.band.thin_trials(_error_of_turning(e), axes)
        root, force, bias_variance = [], [], []
        for axis, here in enumerate(samples):
            f, y = take_samples(applied, here, axis), take_samples(e.residual, here, axis)
            of_bias = bias_error**2 * noise.variance_of_bias(axis, y)
            of_bias = of_bias + take_samples(turning, here, axis) ** 2
            variance = noise.variance[axis] + of_bias + (discrepancy * f) ** 2
            least = _LEAST * float(variance.mean()) if variance.size else 0.0
            # Without any scatter, all samples have equal weight.
            root.append(1.0 / np.sqrt(np.maximum(variance, least)) if least else np.ones(len(f)))
            force.append(f)
            bias_variance.append(of_bias)
        model = replace(e, residual=(), jacobian=(), used=())  # their memory
        return cls(
            samples, noise, KeptItems(root), KeptItems(bias_variance), KeptItems(force), model,
            force_sd, discrepancy,
        )  # fmt: skip

    @cached_property
    def slopes(self) -> tuple[Array, ...]:
        """Derivative of ``applied`` by each measured force, effects included, (n, n_forces)."""
        e = self.model
        bare = bare_slopes(e.system, e.joined, e.band, e.p)
        total = [a + b for a, b in zip(bare, e.slopes_by_force, strict=True)]
        return tuple(take_samples(total, here, axis) for axis, here in enumerate(self.samples))

    @cached_property
    def force_share(self) -> tuple[Array, ...]:
        """Fraction of each sample's variance that is due to force noise, by axis, (n,)."""
        band, found = self.model.band, list[Array]()
        white = band.passed_power(_FREQUENCIES).mean(axis=0) / band.step
        parts = zip(
            self.slopes, self.noise.variance, self.bias_variance, self.applied, white, strict=True
        )
        for slope, noise, of_bias, f, passed in parts:
            variance = noise + of_bias + (self.discrepancy * f) ** 2
            of_force = np.sum((slope * self.force_sd) ** 2, axis=1) * passed
            found.append(np.minimum(of_force / np.maximum(variance, 1e-300), 1.0))
        return tuple(found)

    def log_of_filter(self, axis: int, gain: float, scale: float) -> Array:
        """Log of the factor of a filter on the density of the measured force, (n,).

        It reduces the noise of the forces and any excess over the replicates, but not the noise of
        the motion.

        Args:
            gain: share of the variance of force noise that passes; scale: s^2 of the axis.
        """
        kept = (1.0 - self.force_share[axis]) / max(scale, 1.0)
        return np.asarray(0.5 * np.log(kept + (1.0 - kept) * gain))

    def with_equal_weights(self, left: Iterable[Array], lacking: float) -> "Likelihood":
        """Give all samples equal weight on axes where the scale of a fit exceeds ``lacking``.

        The noise of replicates says nothing about so large an error. The error is not noise either:
        it recurs with the motion, so each sample counts as independent beside the priors.
        ``left`` is the weighted residual of the fit, by axis, each (n,).
        """
        root, samples = list(self.root), list(self.samples)
        for axis, rows in enumerate(left):
            if rows.size and np.mean(rows**2) > lacking**2:
                root[axis] = np.full(rows.size, np.sqrt(np.mean(root[axis] ** 2)))
                samples[axis] = replace(samples[axis], independent=float(rows.size))
        return replace(self, root=KeptItems(root), samples=tuple(samples))

    def with_heavy_tails(self, left: Iterable[Array], tails: float) -> "Likelihood":
        """Reweight samples by Student's t distribution at a fit of the model.

        Otherwise a few fast reversals that no replicate shows would decide (Lange, Little and
        Taylor 1989, Journal of the American Statistical Association 84, 881).

        Args:
            left: weighted residual of the fit, by axis, each (n,); tails: degrees of freedom.
        """
        root = []
        for known, rows in zip(self.root, left, strict=True):
            scaled = rows**2 / max(float(rows @ rows) / max(rows.size, 1), 1e-300)
            root.append(known * np.sqrt((tails + 1.0) / (tails + scaled)))
        return replace(self, root=KeptItems(root))

    def count_independent(self, left: Iterable[Array], lags: int) -> tuple[Samples, ...]:
        """Count the independent samples of each axis in the residual that a fit leaves.

        The error of a model recurs with the motion, whereas noise does not. For a quantity that
        varies like the applied force, the number is divided by the sum over lags of the product of
        both autocorrelations (Bartlett 1935, Journal of the Royal Statistical Society 98, 536),
        relative to the largest such sum of a replicate.

        Args:
            left: weighted residual of the fit, by axis, each (n,); lags: how many are summed.
        """
        counted = []
        for axis, (here, rows) in enumerate(zip(self.samples, left, strict=True)):
            root = self.root[axis]
            force = _correlate(self.applied[axis] * root, here, lags)

            def inflation(values: Array, at: Samples = here, force: Array = force) -> float:
                return max(2.0 * float(_correlate(values, at, lags) @ force) - 1.0, 1e-3)

            noise = (self.noise.residuals[axis] - self.noise.bias[axis]) * root
            share = max((inflation(values) for values in noise), default=1.0) / inflation(rows)
            counted.append(replace(here, independent=here.independent * min(share, 1.0)))
        return tuple(counted)


def _correlate(values: Array, samples: Samples, lags: int) -> Array:
    """Autocorrelation of values (n,) within trials, (lags + 1,); (1, 0, ...) if all are zero."""
    total = np.zeros(lags + 1)
    for trial in np.unique(samples.trial):
        here = samples.trial == trial
        rows = samples.rows[here]
        series = np.zeros(int(np.ptp(rows)) + 1)
        series[rows - rows[0]] = values[here]
        size = 2 * len(series)
        found = np.fft.irfft(np.abs(np.fft.rfft(series, size)) ** 2, size)
        found = found[: min(len(series), lags + 1)]
        total[: len(found)] += found
    return np.asarray(total / total[0]) if total[0] > 0.0 else np.eye(1, lags + 1)[0]


def _error_of_turning(linearisation: Linearisation) -> Iterator[Array]:
    """Standard deviation of dry friction because the instants of reversals are unknown.

    By trial, each (T, n_q), N.m or N: the change of friction between two samples, times the
    standard deviation of an instant that is uniformly distributed between them.
    """
    width = linearisation.system.sign_widths
    for dry, motion in zip(dry_friction(linearisation), linearisation.motions, strict=True):
        yield dry * np.gradient(np.tanh(motion.qd / width), axis=0) / np.sqrt(12.0)


def dry_friction(linearisation: Linearisation) -> Iterator[Array]:
    """Dry friction of a model, by trial, each (T, n_q), N.m or N.

    It is half the difference between slow motion in either direction, brakes included.
    """
    slow = _SLOW * linearisation.system.sign_widths
    for at in linearisation.along:
        q, qd, qdd = at.mechanism.kinematics
        back, on = (
            at.system.residual(q, side * slow + np.zeros_like(qd), qdd, at.memory, at.inputs, at.p)
            for side in (-1.0, 1.0)
        )
        yield from (0.5 * (back - on)[part] for part in at.motion.parts)
