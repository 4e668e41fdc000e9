"""How well trials tell alternative effects apart: what is left when the wrong one is refitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import combinations
from operator import add

import numpy as np
from scipy.special import ndtr

from bampipe.arrays import Array, Indices
from bampipe.diagnosis.candidates import Candidate
from bampipe.diagnosis.columns import added_residual
from bampipe.diagnosis.session import Fit, Session
from bampipe.results.next import ExpectedConfusion, join_effects
from bampipe.trials.evidence import Evidence, gather_evidence
from bampipe.trials.folds import Folds
from bampipe.trials.likelihood import Likelihood, Noise, lay_out_samples, take_samples
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import ModelOnTrial

_STEP = 1e-3
"""Of a parameter, for the slope of what its effect adds to the residual."""


@dataclass(frozen=True)
class Alternative:
    """Effects that may be what a model lacks.

    Attributes:
        items: the candidates; none where nothing is missing.
        values: the parameters of each, in the order of its file.
        odds: that it is these.
        slopes: parameters that are fitted: number of the item, and of the parameter in it.
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
        squares: (n_q, m, m) of all columns over the standard deviation of the noise, by
            independent samples: the nuisance and the free parameters of the model, then what each
            alternative adds, and its slopes by its own parameters.
        independent: (n_q,) samples.
        added: (n_q, alternatives) of what each adds with itself; applied: (n_q,) of the applied
            force, both of all samples, N.m or N squared.
    """

    squares: Array
    independent: Array
    added: Array
    applied: Array

    def __add__(self, other: Sums) -> Sums:
        return Sums(*map(add, vars(self).values(), vars(other).values()))

    def scaled(self, factor: float) -> Sums:
        """The sums of trials that are ``factor`` times as long."""
        return Sums(*(factor * values for values in vars(self).values()))


@dataclass(frozen=True)
class Remainder:
    """What fitted columns leave of a target.

    Attributes:
        squares: sum by axis, (n_q,), in variances of the noise.
        prior: twice what the parameters' departure from what is known of them costs, nats.
        share: both together, of the sum of squares of the target on all axes.
    """

    squares: Array
    prior: float
    share: float

    def distance(self, independent: Array, factor: Array | float = 1.0) -> Array:
        """Expected log likelihood ratio of the target times a factor over what is fitted, nats.

        Args:
            independent: (n_q,) samples; factor: one, or several, (...).
        """
        by_axis = np.square(factor)[..., None] * self.squares / np.maximum(independent, 1e-300)
        return np.asarray(0.5 * (np.log1p(by_axis) @ independent + np.square(factor) * self.prior))


@dataclass(frozen=True)
class Contrast:
    """How two alternatives differ on some trials.

    Attributes:
        distance: expected log likelihood ratio of the right one over the wrong one refitted, nats,
            the smaller of both ways.
        left: (n_q,) root mean square that the wrong one leaves of the right one, in standard
            deviations of the noise, the smaller of both ways.
    """

    distance: float
    left: Array


@dataclass(frozen=True)
class Comparison:
    """Alternative effects beside one model, under the likelihood of the trials at hand.

    Attributes:
        session: the trials, and what decides; fit: the model without any of the alternatives.
        final: the model by whose error they are weighed: the better one, fitted.
        alternatives: the effects.
    """

    session: Session
    fit: Fit
    final: Fit
    alternatives: tuple[Alternative, ...]

    @cached_property
    def scale(self) -> Array:
        """Mean square that the better model leaves, in variances of the noise, (n_q,)."""
        return self.final.solved.left / self.final.problem.count

    @cached_property
    def independent_share(self) -> Array:
        """Independent samples over those by the noise alone, (n_q,), as the diagnosis counts.

        What the better model lacks comes back with the motion: many samples then say one thing.
        """
        counted = self.final.count_independent(self.session.criteria)
        pairs = zip(counted, self.final.likelihood.samples, strict=True)
        return np.array([ours.independent / max(all_.independent, 1e-300) for ours, all_ in pairs])

    @cached_property
    def at_hand(self) -> Sums:
        """The sums over the trials at hand."""
        return self._sums_of(self.fit.evidence, self.fit.likelihood)

    def sums(self, motions: Sequence[Motion]) -> Sums:
        """The sums over ``motions``, replays of the model through the sensors."""
        return reduce(add, (self._sums_of(*self._observe(motion)) for motion in motions))

    def _observe(self, motion: Motion) -> tuple[Evidence, Likelihood]:
        """The model on a replay, whose noise goes with speed as in the trials at hand."""
        e, c = self.fit.evidence, self.session.criteria
        name = motion.trial_id
        seen = gather_evidence(
            e.system, [motion], e.band, e.p, Folds.of_trials([name], (), [name]),
            most_iterations=0, timing=e.timing,
        )  # fmt: skip
        samples = lay_out_samples(seen, c.block_s)
        speed = [np.abs(motion.qd[e.band.thinned_rows(len(motion.t))])]
        bias, variance, classes = [], [], []
        for axis, here in enumerate(samples):
            # One replay is its bias with the noise of one.
            bias.append(take_samples(seen.residual, here, axis))
            speeds, variances, numbers = self._noise_by_speed[axis]
            at = np.searchsorted(speeds[:-1], take_samples(speed, here, axis))
            variance.append(variances[at])
            classes.append(numbers[at])
        nothing = tuple(np.zeros_like(b) for b in bias)
        noise = Noise(tuple(bias), tuple(variance), nothing, (), tuple(classes))
        force_sd = self.session.trials.sensors.force_sd
        return seen, Likelihood.of(seen, samples, noise, c.bias_error, c.discrepancy, force_sd)

    @cached_property
    def _noise_by_speed(self) -> list[tuple[Array, Array, Indices]]:
        """By axis: speeds at hand in order, the variance of replays there, and their classes."""
        e, likelihood, found = self.fit.evidence, self.fit.likelihood, []
        speeds = [np.abs(m.qd[e.band.thinned_rows(len(m.t))]) for m in e.motions]
        for axis, here in enumerate(likelihood.samples):
            speed, noise = take_samples(speeds, here, axis), likelihood.noise
            order = np.argsort(speed)
            # An axis that never moves has none, and counts for nothing.
            known = speed[order], noise.variance[axis][order], noise.speed[axis][order]
            found.append(known if speed.size else (_ZERO, _ZERO, np.zeros(1, dtype=np.int64)))
        return found

    def _sums_of(self, evidence: Evidence, likelihood: Likelihood) -> Sums:
        e, n_q = evidence, len(likelihood.samples)
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
            nuisance = np.zeros((len(x), 2 * n_q))
            nuisance[:, axis] = likelihood.noise.bias[axis]
            nuisance[:, n_q + axis] = likelihood.noise.stopping[axis]
            joined = np.concatenate([nuisance, x], axis=1)
            targets = [target for target, _ in self._places(joined.shape[1])]
            plain.append(np.sum(joined[:, targets] ** 2, axis=0))
            applied.append(float(likelihood.applied[axis] @ likelihood.applied[axis]))
            share = independent[axis] / (max(len(x), 1) * self.scale[axis])
            joined *= likelihood.root[axis][:, None] * np.sqrt(share)
            squares.append(joined.T @ joined)
        return Sums(np.array(squares), independent, np.array(plain), np.array(applied))

    def _added_by(self, alternative: Alternative, base: ModelOnTrial) -> list[Array]:
        """What an alternative adds to the residual, its slopes by its parameters, each (T, n_q)."""

        def residual(number: int, values: Array) -> Array:
            item = alternative.items[number]
            count = len(item.system.parameters) - len(values)
            return added_residual(item, np.append(base.p[:count], values), base)

        here = [residual(k, values) for k, values in enumerate(alternative.values)]
        rows = [np.sum(here, axis=0) if here else np.zeros(base.motion.q.shape)]
        for number, place in alternative.slopes:
            q = alternative.items[number].parameters[place]
            moved = alternative.values[number].copy()
            step = _STEP * max(abs(moved[place]), _STEP * q.sd)
            step = -step if moved[place] + step > q.upper else step
            moved[place] += step
            rows.append((residual(number, moved) - here[number]) / step)
        return rows

    def _places(self, width: int) -> list[tuple[int, list[int]]]:
        """For each alternative, the column of what it adds and those of its slopes."""
        widths = [1 + len(alternative.slopes) for alternative in self.alternatives]
        ends = width - sum(widths) + np.cumsum(widths)
        firsts = [int(end) - w for end, w in zip(ends, widths, strict=True)]
        return [(k, [*range(k + 1, k + w)]) for k, w in zip(firsts, widths, strict=True)]

    @cached_property
    def _precision(self) -> Array:
        """What is known beforehand of the nuisance parameters and of the model's own."""
        e = self.fit.evidence
        of_timing = [12.0 / (e.timing[1] - e.timing[0]) ** 2] if e.by_timing else []
        return np.concatenate([np.ones(2 * len(self.scale)), e.precision, of_timing])

    def find_remainders(self, total: Sums) -> list[Remainder]:
        """What the model alone leaves of each alternative."""
        targets = [target for target, _ in self._places(total.squares.shape[1])]
        return self._find_remainders(total, targets, [])

    def information(self, total: Sums, number: int) -> Array:
        """On the parameters of an alternative by which there are slopes, else on a factor of it."""
        target, slopes = self._places(total.squares.shape[1])[number]
        columns = slopes or [target]
        nb = len(self._precision)
        squares = total.squares.sum(axis=0)
        taken = squares[:nb, columns].T @ self._fit(total, columns, [])
        return np.asarray(squares[np.ix_(columns, columns)] - taken)

    def contrasts(self, total: Sums, on: Sums | None = None) -> dict[tuple[int, int], Contrast]:
        """How each pair of alternatives differs once the trials of ``total`` are fitted.

        Args:
            total: of all trials that the fit sees.
            on: of those on which `Contrast.left` is taken; the same by default.
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
        """What the model and ``fitted`` columns leave of each target on some trials."""
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
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))[:, None]
        moments = squares[np.ix_(columns, list(targets))]
        solved = np.linalg.lstsq(normal * scale * scale.T, scale * moments, rcond=1e-9)[0]
        return np.asarray(scale * solved)

    def weights(self) -> dict[tuple[int, int], float]:
        """Weight of each pair, after Box and Hill (1967): the product of their odds, sum one."""
        pairs = list(combinations(range(len(self.alternatives)), 2))
        products = [self.alternatives[i].odds * self.alternatives[j].odds for i, j in pairs]
        total = sum(products) or 1.0
        return {pair: product / total for pair, product in zip(pairs, products, strict=True)}

    @cached_property
    def now(self) -> dict[tuple[int, int], Contrast]:
        """How each pair of alternatives differs on the trials at hand."""
        return self.contrasts(self.at_hand)

    def confusions(
        self, contrasts: Mapping[tuple[int, int], Contrast]
    ) -> dict[tuple[int, int], float]:
        """Chance of taking one of each pair of alternatives for the other, with more trials."""
        odds = [alternative.odds for alternative in self.alternatives]
        return {
            (i, j): chance_of_confusion(odds[i], odds[j], found.distance - self.now[i, j].distance)
            for (i, j), found in contrasts.items()
        }

    def confusion_with(self, motion: Motion) -> float:
        """Chance over all pairs, by their weights, once ``motion`` has been recorded, too."""
        found = self.confusions(self.contrasts(self.at_hand + self.sums([motion])))
        return sum(weight * found[pair] for pair, weight in self.weights().items())

    def expect(self, motions: Sequence[Motion]) -> tuple[ExpectedConfusion, ...]:
        """What one trial says of each pair, the median over ``motions``, its versions."""
        sums = [self.sums([motion]) for motion in motions]
        then = [self.contrasts(self.at_hand + new, new) for new in sums]
        chances, weights = [self.confusions(found) for found in then], self.weights()
        before, axes = self.confusions(self.now), self.fit.evidence.system.coordinates
        expected = []
        for pair, now in self.now.items():
            left = np.median([found[pair].left for found in then], axis=0).tolist()
            expected.append(
                ExpectedConfusion(
                    between=tuple(self.alternatives[k].name for k in pair),
                    weight=weights[pair],
                    before=before[pair],
                    after=float(np.median([found[pair] for found in chances])),
                    distance_before=now.distance,
                    distance_after=float(np.median([found[pair].distance for found in then])),
                    left=dict(zip(axes, left, strict=True)),
                )
            )
        return tuple(expected)


_ZERO = np.zeros(1)


def chance_of_confusion(first: float, second: float, gained: float) -> float:
    """Chance that the less probable of two is the right one, after more trials.

    Args:
        first, second: odds as they stand.
        gained: expected log likelihood ratio by the trials, nats; its variance is twice that.
    """
    total = first + second
    if gained <= 0.0:
        return min(first, second) / total
    lead, spread = np.log(first / second), np.sqrt(2.0 * gained)
    wrong = first * ndtr(-(gained + lead) / spread) + second * ndtr(-(gained - lead) / spread)
    return float(wrong / total)
