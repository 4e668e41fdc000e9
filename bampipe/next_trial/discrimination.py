"""Discrimination of alternative effects by trials: the error of the wrong one after a refit."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import combinations
from operator import add

import numpy as np
from scipy.special import ndtr

from bampipe.arrays import Array, Indices
from bampipe.diagnosis.candidates import Candidate
from bampipe.diagnosis.columns import compute_added_residual
from bampipe.diagnosis.session import Fit, Session
from bampipe.estimate.bounded import invert_scaled
from bampipe.results.next import ExpectedConfusion, join_effects
from bampipe.trials.folds import Folds
from bampipe.trials.likelihood import Likelihood
from bampipe.trials.linearisation import Linearisation, linearise_fit
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import ModelOnTrial
from bampipe.trials.samples import BIASES, Noise, lay_out_samples, take_samples

_SLOPE_STEP = 1e-3
"""Relative step of a parameter for the slope of the residual of its effect."""


@dataclass(frozen=True)
class Alternative:
    """Effects that a model may lack.

    Attributes:
        items: the candidates; empty if nothing is missing.
        values: the parameters of each, in the order of its file.
        odds: probability of this alternative.
        slopes: fitted parameters: index of the item, and of the parameter in it.
    """

    items: tuple[Candidate, ...]
    values: tuple[Array, ...]
    odds: float = 0.0
    slopes: tuple[tuple[int, int], ...] = ()

    @property
    def name(self) -> str:
        """Canonical names of its effects."""
        return join_effects(item.name for item in self.items)


@dataclass(frozen=True)
class Sums:
    """Sums of products over the samples of some trials.

    Attributes:
        squares: (n_q, m, m) of all columns over the standard deviation of the noise, scaled to
            independent samples: the nuisance and the free parameters of the model, then the force
            of each alternative and its slopes with respect to its own parameters.
        independent: (n_q,) independent samples.
        added: (n_q, alternatives) squared force of each alternative; applied: (n_q,) squared
            applied force; both over all samples, (N.m)^2 or N^2.
    """

    squares: Array
    independent: Array
    added: Array
    applied: Array

    def __add__(self, other: "Sums") -> "Sums":
        return Sums(*map(add, vars(self).values(), vars(other).values()))

    def scale_by(self, factor: float) -> "Sums":
        """Return the sums of trials that are ``factor`` times as long."""
        return Sums(*(factor * values for values in vars(self).values()))


@dataclass(frozen=True)
class Remainder:
    """Remainder of a target after a fit of other columns.

    Attributes:
        squares: sum of squares by axis, (n_q,), in variances of the noise.
        prior: twice the cost of the parameters' distance from their priors, nats.
        share: both together over the sum of squares of the target on all axes.
    """

    squares: Array
    prior: float
    share: float

    def distance(self, independent: Array, factor: Array | float = 1.0) -> Array:
        """Return the expected log likelihood ratio of ``factor`` times the target, nats, (...).

        There are ``independent`` (n_q,) samples.
        """
        by_axis = np.square(factor)[..., None] * self.squares / np.maximum(independent, 1e-300)
        return np.asarray(0.5 * (np.log1p(by_axis) @ independent + np.square(factor) * self.prior))


@dataclass(frozen=True)
class Contrast:
    """Difference between two alternatives on some trials.

    Attributes:
        distance: expected log likelihood ratio of the right one over the wrong one refitted, nats;
            the smaller one if the roles are exchanged.
        left: (n_q,) root mean square error of the wrong one, in standard deviations of the noise;
            the smaller one likewise.
    """

    distance: float
    left: Array


@dataclass(frozen=True)
class Comparison:
    """Alternative effects beside one model, under the likelihood of the trials at hand.

    Attributes:
        session: the trials and the criteria; fit: the model without any of the alternatives.
        final: the fitted model with the most probable effects, whose error sets the noise.
        alternatives: the effects.
    """

    session: Session
    fit: Fit
    final: Fit
    alternatives: tuple[Alternative, ...]

    @cached_property
    def scale(self) -> Array:
        """Mean square error of the better model, in variances of the noise, (n_q,)."""
        return self.final.solution.left / self.final.problem.count

    @cached_property
    def independent_share(self) -> Array:
        """Share of the samples that are independent in the presence of model errors, (n_q,).

        Errors of the better model recur with the motion, so that many samples hold the same
        information; they are counted as the diagnosis counts them.
        """
        counted = self.final.count_independent(self.session.criteria)
        pairs = zip(counted, self.final.likelihood.samples, strict=True)
        return np.array([ours.independent / max(all_.independent, 1e-300) for ours, all_ in pairs])

    @cached_property
    def sums_now(self) -> Sums:
        """The sums over the trials at hand."""
        return self._sums_of(self.fit.linearisation, self.fit.likelihood)

    def sums(self, motions: Sequence[Motion]) -> Sums:
        """Return the sums over ``motions``, replicates of the model."""
        return reduce(add, (self._sums_of(*self._observe(motion)) for motion in motions))

    def _observe(self, motion: Motion) -> tuple[Linearisation, Likelihood]:
        """Return the model on a replicate, with the noise of the trials at each speed."""
        e, c = self.fit.linearisation, self.session.criteria
        name = motion.trial_id
        seen = linearise_fit(
            e.system, [motion], e.band, e.p, Folds.of_trials([name], (), [name]),
            most_iterations=0, timing=e.timing,
        )  # fmt: skip
        samples = lay_out_samples(seen, c.block_s)
        speed = [np.abs(motion.qd[e.band.thinned_rows(len(motion.t))])]
        bias, variance, classes = [], [], []
        for axis, here in enumerate(samples):
            # A single replicate is its own bias, with the noise of one replicate.
            bias.append(take_samples(seen.residual, here, axis))
            speeds, variances, numbers = self._noise_by_speed[axis]
            at = np.searchsorted(speeds[:-1], take_samples(speed, here, axis))
            variance.append(variances[at])
            classes.append(numbers[at])
        nothing = tuple(np.zeros((len(b), len(BIASES) - 1)) for b in bias)
        noise = Noise(tuple(bias), tuple(variance), nothing, (), tuple(classes))
        force_sd = self.session.trials.sensors.force_sd
        return seen, Likelihood.of(seen, samples, noise, c.bias_error, c.discrepancy, force_sd)

    @cached_property
    def _noise_by_speed(self) -> list[tuple[Array, Array, Indices]]:
        """By axis: sorted speeds of the trials, variance of replicates there, and their classes."""
        e, likelihood, found = self.fit.linearisation, self.fit.likelihood, []
        speeds = [np.abs(m.qd[e.band.thinned_rows(len(m.t))]) for m in e.motions]
        for axis, here in enumerate(likelihood.samples):
            speed, noise = take_samples(speeds, here, axis), likelihood.noise
            order = np.argsort(speed)
            # An axis that never moves has no samples and does not count.
            known = speed[order], noise.variance[axis][order], noise.speed[axis][order]
            found.append(known if speed.size else (np.zeros(1), np.zeros(1), np.zeros(1, np.int64)))
        return found

    def _sums_of(self, linearisation: Linearisation, likelihood: Likelihood) -> Sums:
        e, n_q = linearisation, len(likelihood.samples)
        rows = [
            np.hstack([a for r in self.alternatives for a in self._added_by(r, base)])
            for base in e.fitted
        ]
        width = rows[0].shape[1] // n_q
        by_trial = []
        for k, values in enumerate(e.band.thin_trials(rows, [*range(n_q)] * width)):
            columns = values.reshape(len(values), width, n_q).transpose(0, 2, 1)
            timing = [by[:, :, None] for by in e.by_timing[k : k + 1]]
            columns = columns * e.used[k][:, :, None]
            by_trial.append(np.concatenate([e.jacobian[k], *timing, columns], axis=2))
        squares, plain, applied = [], [], []
        independent = self.independent_share * [s.independent for s in likelihood.samples]
        for axis, here in enumerate(likelihood.samples):
            x = take_samples(by_trial, here, axis)
            nuisance = np.zeros((len(x), len(BIASES) * n_q))
            nuisance[:, axis::n_q] = likelihood.noise.biases(axis)
            joined = np.concatenate([nuisance, x], axis=1)
            targets = [target for target, _ in self._places(joined.shape[1])]
            plain.append(np.sum(joined[:, targets] ** 2, axis=0))
            applied.append(float(likelihood.applied[axis] @ likelihood.applied[axis]))
            share = independent[axis] / (max(len(x), 1) * self.scale[axis])
            joined *= likelihood.root[axis][:, None] * np.sqrt(share)
            squares.append(joined.T @ joined)
        return Sums(np.array(squares), independent, np.array(plain), np.array(applied))

    def _added_by(self, alternative: Alternative, base: ModelOnTrial) -> list[Array]:
        """Return the residual of an alternative and its slopes by its parameters, each (T, n_q)."""

        def residual(number: int, values: Array) -> Array:
            item = alternative.items[number]
            count = len(item.system.parameters) - len(values)
            return compute_added_residual(item, np.append(base.p[:count], values), base)

        here = [residual(k, values) for k, values in enumerate(alternative.values)]
        rows = [np.sum(here, axis=0) if here else np.zeros(base.motion.q.shape)]
        for number, place in alternative.slopes:
            q = alternative.items[number].parameters[place]
            moved = alternative.values[number].copy()
            step = _SLOPE_STEP * max(abs(moved[place]), _SLOPE_STEP * q.sd)
            step = -step if moved[place] + step > q.upper else step
            moved[place] += step
            rows.append((residual(number, moved) - here[number]) / step)
        return rows

    def _places(self, width: int) -> list[tuple[int, list[int]]]:
        """Return, for each alternative, the column of its residual and those of its slopes."""
        widths = [1 + len(alternative.slopes) for alternative in self.alternatives]
        ends = width - sum(widths) + np.cumsum(widths)
        firsts = [int(end) - w for end, w in zip(ends, widths, strict=True)]
        return [(k, [*range(k + 1, k + w)]) for k, w in zip(firsts, widths, strict=True)]

    @cached_property
    def _precision(self) -> Array:
        """Prior precisions of the nuisance parameters and of the model's own."""
        e = self.fit.linearisation
        of_timing = [12.0 / (e.timing[1] - e.timing[0]) ** 2] if e.by_timing else []
        return np.concatenate([np.ones(len(BIASES) * len(self.scale)), e.precision, of_timing])

    def find_remainders(self, total: Sums) -> list[Remainder]:
        """Return the remainder of each alternative after a fit of the model alone."""
        targets = [target for target, _ in self._places(total.squares.shape[1])]
        return self._find_remainders(total, targets, [])

    def information(self, total: Sums, number: int) -> Array:
        """Return the information on the fitted parameters of an alternative, else on its size."""
        target, slopes = self._places(total.squares.shape[1])[number]
        columns = slopes or [target]
        nb = len(self._precision)
        squares = total.squares.sum(axis=0)
        taken = squares[:nb, columns].T @ self._fit(total, columns, [])
        return np.asarray(squares[np.ix_(columns, columns)] - taken)

    def contrasts(self, total: Sums, on: Sums | None = None) -> dict[tuple[int, int], Contrast]:
        """Return the contrast of each pair of alternatives, with the trials of ``total`` fitted.

        `Contrast.left` is taken on the trials of ``on``, the same by default.
        """
        places, on = self._places(total.squares.shape[1]), on or total
        found = {}
        for i, j in combinations(range(len(self.alternatives)), 2):
            ways = []
            for right, wrong in ((i, j), (j, i)):
                if self.alternatives[right].items:
                    target, fitted = places[right][0], places[wrong][1]
                    (left,) = self._find_remainders(total, [target], fitted)
                    (shown,) = self._find_remainders(total, [target], fitted, on)
                    each = np.sqrt(shown.squares / np.maximum(on.independent, 1e-300))
                    ways.append((float(left.distance(total.independent)), each))
            found[i, j] = Contrast(
                min(way[0] for way in ways), min((way[1] for way in ways), key=lambda w: w.sum())
            )
        return found

    def _find_remainders(
        self, total: Sums, targets: Sequence[int], fitted: Sequence[int], on: Sums | None = None
    ) -> list[Remainder]:
        """Return the remainder of each target after a fit of the model and ``fitted`` columns."""
        on, nb = on or total, len(self._precision)
        taken, columns = self._fit(total, targets, fitted), [*range(nb), *fitted]
        by_fitted = on.squares[:, columns]
        whole = np.diagonal(on.squares, axis1=1, axis2=2)[:, list(targets)].T
        left = whole - 2.0 * np.einsum("apr,pr->ra", by_fitted[:, :, list(targets)], taken)
        left += np.einsum("apr,pr->ra", by_fitted[:, :, columns] @ taken, taken)
        left = np.maximum(left, 0.0)
        prior = np.einsum("pr,p,pr->r", taken[:nb], self._precision, taken[:nb])
        share = (left.sum(axis=1) + prior) / np.maximum(whole.sum(axis=1), 1e-300)
        every = zip(left, prior, share, strict=True)
        return [Remainder(squares, float(p), float(s)) for squares, p, s in every]

    def _fit(self, total: Sums, targets: Sequence[int], fitted: Sequence[int]) -> Array:
        """Coefficients with which model and ``fitted`` columns come closest to targets, (k, m)."""
        squares, nb = total.squares.sum(axis=0), len(self._precision)
        columns = [*range(nb), *fitted]
        normal = squares[np.ix_(columns, columns)]
        normal[range(nb), range(nb)] += self._precision
        return np.asarray(invert_scaled(normal) @ squares[np.ix_(columns, list(targets))])

    def weights(self) -> dict[tuple[int, int], float]:
        """Return Box-Hill weights (1967): the product of the odds of each pair, normalised."""
        pairs = list(combinations(range(len(self.alternatives)), 2))
        products = [self.alternatives[i].odds * self.alternatives[j].odds for i, j in pairs]
        total = sum(products) or 1.0
        return {pair: product / total for pair, product in zip(pairs, products, strict=True)}

    @cached_property
    def contrasts_now(self) -> dict[tuple[int, int], Contrast]:
        """The contrast of each pair of alternatives on the trials at hand."""
        return self.contrasts(self.sums_now)

    def confusions(
        self, contrasts: Mapping[tuple[int, int], Contrast]
    ) -> dict[tuple[int, int], float]:
        """Return the chance of confusing each pair of alternatives, with more trials."""
        odds, now = [one.odds for one in self.alternatives], self.contrasts_now
        return {
            (i, j): chance_of_confusion(odds[i], odds[j], found.distance - now[i, j].distance)
            for (i, j), found in contrasts.items()
        }

    def confusion_with(self, motion: Motion) -> float:
        """Return the weighted chance over all pairs once ``motion`` is recorded too."""
        found = self.confusions(self.contrasts(self.sums_now + self.sums([motion])))
        return sum(weight * found[pair] for pair, weight in self.weights().items())

    def expect(self, motions: Sequence[Motion]) -> tuple[ExpectedConfusion, ...]:
        """Return the expected confusion of each pair: the median over versions of a trial."""
        sums = [self.sums([motion]) for motion in motions]
        then = [self.contrasts(self.sums_now + new, new) for new in sums]
        chances, weights = [self.confusions(found) for found in then], self.weights()
        before = self.confusions(self.contrasts_now)
        axes = self.fit.linearisation.system.coordinates
        expected = []
        for pair in self.contrasts_now:
            left = np.median([found[pair].left for found in then], axis=0).tolist()
            expected.append(
                ExpectedConfusion(
                    between=tuple(self.alternatives[k].name for k in pair),
                    weight=weights[pair],
                    before=before[pair],
                    after=float(np.median([found[pair] for found in chances])),
                    left=dict(zip(axes, left, strict=True)),
                )
            )
        return tuple(expected)


def chance_of_confusion(first: float, second: float, gained: float) -> float:
    """Return the chance that the less probable of two is the right one, after more trials.

    Args:
        first, second: present odds.
        gained: expected log likelihood ratio from the trials, nats; its variance is twice that.
    """
    total = first + second
    if gained <= 0.0:
        return min(first, second) / total
    lead, spread = np.log(first / second), np.sqrt(2.0 * gained)
    wrong = first * ndtr(-(gained + lead) / spread) + second * ndtr(-(gained - lead) / spread)
    return float(wrong / total)
