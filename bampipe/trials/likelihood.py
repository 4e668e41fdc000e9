"""The likelihood of the measured quantity under a model, by which all models are judged.

For each sample of an axis that counts, with the symbols of docs/method_residual.md:

    y = f(motion; theta) + beta b + gamma c + e
    var e ~ s^2 (v(z) + tau^2 (b^2 + g^2 c^2) + h^2 + (delta F)^2), with the tails of Student's t

y is the low-passed residual of the fitted model; b the common bias, the mean of replicates; c the
stopping bias, the residual of a replicate whose friction truly stops the axis, and g a first guess
of its factor gamma; v the variance of replicates around b in classes z of speed; h the uncertainty
of dry friction because the instant of a reversal between two samples is unknown; F the applied
force; s the scale of the axis, which is fitted. Parameters have priors and bounds, and so have the
nuisance parameters: beta and gamma of each axis, and the input delay. The density is that of the
measured force: `scale` gives the change of variables from the residual.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from bampipe.arrays import Array, Flags, Indices
from bampipe.physics.effect import BoundEffect
from bampipe.trials.evidence import Evidence
from bampipe.trials.kept import KeptItems
from bampipe.trials.scale import bare_slopes

_SPEEDS = 12
"""Classes of speed in which the variance of replicates is averaged, finer at low speeds."""
_LEAST = 1e-3
"""Smallest variance relative to the mean: no sample weighs more than a thousand average ones."""
NOTHING = 1e-4
"""A parameter whose whole range moves the data by fewer standard deviations has no effect."""
_DETERMINED = 1e-9
"""A direction of the model's parameters is undetermined, and keeps its value, if its eigenvalue of
the scaled normal equations is below this fraction of the largest."""
_LOOSE = 1e-6
"""Smallest part of a parameter, in its standard deviations, in a direction without effect."""
_SLOW = 3.0
"""Speed in sign widths that counts as slow, where dry friction is fully developed."""
_MOST_STOPPING = 1.5
"""Upper bound of gamma, the factor of the stopping bias."""
_TOGETHER = 100_000
"""Rows of columns that are weighted in one pass."""
_FREQUENCIES = 256
"""Frequencies over which the power of white noise behind a low-pass is averaged."""
_RIDGE = 1e-10
_PASSES, _REWEIGHTS = 8, 5
_STEADY = 0.02
"""Relative change of the weights at convergence; the cost changes by its square."""


@dataclass(frozen=True)
class Samples:
    """The samples of one axis that count, of all trials in order.

    Attributes:
        rows: indices among the thinned samples of all trials, (n,).
        trial: number of each sample's trial; block: number of its block of time; both (n,).
        independent: the equivalent number of independent samples.
    """

    rows: Indices
    trial: Indices
    block: Indices
    independent: float

    def take(self, values: Iterable[Array], axis: int) -> Iterator[Array]:
        """Yield the rows of one axis, (k,) or (k, m), of each trial's values (K, n_q[, m])."""
        end = 0
        for each in values:
            first, end = end, end + len(each)
            rows = self.rows[slice(*np.searchsorted(self.rows, (first, end)))]
            yield each[rows - first, axis]


def lay_out_samples(evidence: Evidence, block_s: float) -> tuple[Samples, ...]:
    """Return the samples of each axis that count, divided into blocks of ``block_s`` seconds."""
    band, sizes = evidence.band, [len(r) for r in evidence.residual]
    trial = np.repeat(np.arange(len(sizes), dtype=np.int32), sizes)
    seconds = np.concatenate([np.arange(n) * band.step / band.rate_hz for n in sizes])
    within = np.floor(seconds / block_s).astype(np.int64)
    block = np.unique(trial * (within.max() + 1) + within, return_inverse=True)[1].astype(np.int32)
    used = np.concatenate(evidence.used)
    found = []
    for axis, share in enumerate(band.independent_share):
        rows = np.flatnonzero(used[:, axis])
        found.append(Samples(rows, trial[rows], block[rows], float(share) * rows.size))
    return tuple(found)


def take_samples(values: Iterable[Array], samples: Samples, axis: int) -> Array:
    """Return the rows of one axis, (n,) or (n, m), of the trials' values, each (K, n_q[, m])."""
    return np.concatenate([*samples.take(values, axis)])


def _stack_chunks(parts: Iterable[Array]) -> Iterator[tuple[slice, Array]]:
    """Yield the stacked arrays in chunks of `_TOGETHER` rows or a few more, with their rows."""
    few, end, size = list[Array](), 0, 0
    for part in parts:
        few, size = [*few, part], size + len(part)
        if size >= _TOGETHER:
            yield slice(end, end + size), np.concatenate(few)
            few, end, size = [], end + size, 0
    if few:
        yield slice(end, end + size), np.concatenate(few)


@dataclass(frozen=True)
class Noise:
    """Statistics of the residuals of replicates, which lack nothing.

    Attributes:
        bias: mean of the replicates at each sample, by axis, each (n,), N.m or N.
        variance: variance of the replicates around it, averaged by speed, each (n,).
        stopping: stopping bias, of a noise-free replicate whose friction truly stops, each (n,).
        residuals: by axis, each (replicates, n).
        speed: class of speed of each sample, by axis, each (n,).
    """

    bias: Sequence[Array]
    variance: Sequence[Array]
    stopping: Sequence[Array]
    residuals: Sequence[Array]
    speed: Sequence[Indices]

    def variance_of_bias(self, axis: int, y: Array) -> Array:
        """Variance of the biases in a residual ``y`` (n,) for a relative error of one, (n,).

        Half of it applies at the sample itself, and half is spread over samples of the same speed,
        because no replicate reverses at exactly the right instant.
        """
        b, c, at = self.bias[axis], self.stopping[axis], self.speed[axis]
        both = np.column_stack([b, c]) / np.sqrt(self.variance[axis] + 1e-300)[:, None]
        target = y / np.sqrt(self.variance[axis] + 1e-300)
        factor = np.linalg.lstsq(both, target, rcond=1e-6)[0][1] if len(y) else 0.0
        square = b**2 + (np.clip(factor, 0.0, _MOST_STOPPING) * c) ** 2
        count = np.maximum(np.bincount(at, minlength=_SPEEDS), 1)
        return np.asarray(0.5 * (square + (np.bincount(at, square, minlength=_SPEEDS) / count)[at]))


def describe_noise(
    residuals: Sequence[Array],
    stopping: Sequence[Array],
    evidence: Evidence,
    samples: Sequence[Samples],
) -> Noise:
    """Compute the statistics of replicates.

    Args:
        residuals: of the replicates, by trial, each (K, n_q, replicates).
        stopping: of one whose friction truly stops the axes, by trial, each (K, n_q).
        evidence: the model on the measured trials; samples: those of it that count.
    """
    thinned = evidence.band.thinned_rows
    speeds = [np.abs(m.qd[thinned(len(m.t))]) for m in evidence.motions]
    by_axis = KeptItems(
        np.ascontiguousarray(take_samples(residuals, here, axis).T)
        for axis, here in enumerate(samples)
    )
    biases, variances, classes = [], [], []
    for axis, (here, left) in enumerate(zip(samples, by_axis, strict=True)):
        around = left.var(axis=0, ddof=1)
        speed = take_samples(speeds, here, axis)
        shares = np.linspace(0.0, 1.0, _SPEEDS + 1)[1:-1] ** 2
        at = np.searchsorted(np.quantile(speed, shares), speed) if speed.size else np.zeros(0, int)
        count = np.maximum(np.bincount(at, minlength=_SPEEDS), 1)
        biases.append(left.mean(axis=0))
        variances.append((np.bincount(at, around, minlength=_SPEEDS) / count)[at])
        classes.append(at.astype(np.int8))
    stops = [take_samples(stopping, here, axis) for axis, here in enumerate(samples)]
    return Noise(KeptItems(biases), KeptItems(variances), KeptItems(stops), by_axis, classes)


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
    model: Evidence
    force_sd: Array
    discrepancy: float

    @classmethod
    def of(
        cls,
        evidence: Evidence,
        samples: tuple[Samples, ...],
        noise: Noise,
        bias_error: float,
        discrepancy: float,
        force_sd: Array,
    ) -> Likelihood:
        """Weight samples by the noise of replicates, the error of the biases and the discrepancy.

        Args:
            force_sd: noise of each measured force, (n_forces,), in its unit.
        """
        e = evidence
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

    def with_equal_weights(self, problem: Problem, lacking: float) -> Likelihood:
        """Give all samples equal weight on axes whose scale at a fit exceeds ``lacking``.

        The noise of replicates says nothing about so large an error. The error is not noise either:
        it recurs with the motion, so each sample counts as independent beside the priors.
        """
        scale = np.sqrt(problem.solve().left / problem.count)
        root, samples = list(self.root), list(self.samples)
        for axis in np.flatnonzero(scale > lacking).tolist():
            rows = samples[axis].rows.size
            root[axis] = np.full(rows, np.sqrt(np.mean(self.root[axis] ** 2)))
            samples[axis] = replace(samples[axis], independent=float(rows))
        return replace(self, root=KeptItems(root), samples=tuple(samples))

    def with_heavy_tails(self, problem: Problem, tails: float) -> Likelihood:
        """Reweight samples by Student's t distribution at a fit of the model.

        Otherwise a few fast reversals that no replicate shows would decide (Lange, Little and
        Taylor 1989, Journal of the American Statistical Association 84, 881).

        Args:
            problem: the fit, with its solution at zero; tails: degrees of freedom.
        """
        solved, root = problem.solve(), []
        for axis, (y, base) in enumerate(zip(problem.y, problem.base, strict=True)):
            square = (y + base @ solved.base) ** 2
            mean = max(float(solved.left[axis]) / problem.count[axis], 1e-300)
            root.append(self.root[axis] * np.sqrt((tails + 1.0) / (tails + square / mean)))
        return replace(self, root=KeptItems(root))

    def count_independent(self, problem: Problem, lags: int) -> tuple[Samples, ...]:
        """Count the independent samples of each axis in the residual that a fit leaves.

        The error of a model recurs with the motion, whereas noise does not. For a quantity that
        varies like the applied force, the number is divided by the sum over lags of the product of
        both autocorrelations (Bartlett 1935, Journal of the Royal Statistical Society 98, 536),
        relative to the largest such sum of a replicate.

        Args:
            problem: the fit, with its solution at zero; lags: how many are summed.
        """
        solved, counted = problem.solve(), []
        for axis, here in enumerate(self.samples):
            root = self.root[axis]
            force = _correlate(self.applied[axis] * root, here, lags)

            def inflation(values: Array, at: Samples = here, force: Array = force) -> float:
                return max(2.0 * float(_correlate(values, at, lags) @ force) - 1.0, 1e-3)

            ours = inflation(problem.y[axis] + problem.base[axis] @ solved.base)
            noise = (self.noise.residuals[axis] - self.noise.bias[axis]) * root
            most = max((inflation(values) for values in noise), default=1.0)
            counted.append(replace(here, independent=here.independent * min(most / ours, 1.0)))
        return tuple(counted)

    def pose_problem(self, evidence: Evidence) -> Problem:
        """Weight the residual and slopes of a linearised model, and add its priors."""
        samples, noise, n_q, weights = self.samples, self.noise, len(self.samples), self.root
        if evidence.factors:  # the unit is that of the measured force: small factors gain nothing
            ratio = np.array(self.model.factors) / np.array(evidence.factors)
            weights = [root * by for root, by in zip(weights, ratio, strict=True)]
        timing = evidence.timing if evidence.by_timing else ()
        n = len(evidence.free) + len(timing[:1])

        def weighted_columns(axis: int) -> Iterator[tuple[slice, Array]]:
            """Yield the columns of all unknowns, (k, n_all), in chunks, since they are large."""
            bias, stopping, weight = noise.bias[axis], noise.stopping[axis], weights[axis]
            for part, slopes in _stack_chunks(samples[axis].take(evidence.slopes, axis)):
                columns = np.zeros((len(slopes), n + 2 * n_q))
                columns[:, :n] = slopes
                columns[:, n + axis] = -bias[part]
                columns[:, n + n_q + axis] = -stopping[part]
                columns *= weight[part, None]
                yield part, columns

        def combined_columns(axis: int) -> Array:
            out = np.empty((len(samples[axis].rows), to.shape[1]))
            for part, x in weighted_columns(axis):
                out[part] = x @ to
            return out

        # The standard deviation of a uniform distribution is 0.29 of its width.
        of_timing = [(3.5 / max(timing[1] - timing[0], 1e-12)) ** 2] if timing else []
        n_timing, none = len(of_timing), np.zeros(n_q)
        precision = np.concatenate([evidence.precision, of_timing, none + 1.0, none + 1.0])
        known = np.concatenate([evidence.known, np.zeros(n_timing), none + 1.0, none])
        lower = np.concatenate([evidence.lower, timing[:1], none - np.inf, none])
        upper = np.concatenate([evidence.upper, timing[1:], none + np.inf, none + _MOST_STOPPING])
        y = [
            take_samples(evidence.residual, here, axis) * weights[axis]
            for axis, here in enumerate(samples)
        ]
        weight = [
            s.independent / max(float(v @ v), 1e-300) for s, v in zip(samples, y, strict=True)
        ]
        products = (
            w * (x.T @ x) for axis, w in enumerate(weight) for _, x in weighted_columns(axis)
        )
        known_precision, moment = np.diag(precision), precision * known
        cost_of_known = 0.5 * float(precision @ known**2)
        effects, p = evidence.system.model.effects, evidence.p[list(evidence.free)]
        strengths = [_places(evidence, item, strengths=True) for item in effects]
        if at := [place for places in strengths for place in places]:
            member = np.repeat(np.arange(len(effects)), [*map(len, strengths)])
            own = (take_samples(evidence.slopes, here, a)[:, at] for a, here in enumerate(samples))
            expected = expect_strengths([x.T @ x for x in own], self.applied)
            expected = expected * (member[:, None] == member)
            known_precision[np.ix_(at, at)] += expected
            moment[at] -= expected @ p[at]
            cost_of_known += 0.5 * float(p[at] @ expected @ p[at])
        normal = sum(products) + known_precision
        # Unknowns without effect over their range stay, like the shape of an effect of no strength.
        size, parameters = np.sqrt(np.diag(normal)), evidence.system.parameters
        reach = np.ones(size.size)
        reach[: len(evidence.free)] = [parameters[i].sd or 1.0 for i in evidence.free]
        per_unit = np.divide(1.0, size, out=np.zeros_like(size), where=size * reach > NOTHING)
        values, vectors = np.linalg.eigh(normal * per_unit * per_unit[:, None])
        kept = values > _DETERMINED * values[-1]
        to = vectors[:, kept] / np.sqrt(values[kept]) * per_unit[:, None]
        loose = vectors[:, ~kept] * per_unit[:, None]
        log_scale, by_parameters = evidence.log_scale
        by_parameters = np.pad(by_parameters, ((0, 0), (0, 2 * n_q)))
        return Problem(
            self, KeptItems(y), KeptItems(map(combined_columns, range(n_q))),
            to.T @ known_precision @ to, to.T @ moment, log_scale,
            by_parameters @ to, to, lower, upper,
            {item.name: _absence(evidence, item) for item in effects},
            {
                item.name: np.array([q.sd for q in item.parameters if q.strength and not q.fixed])
                for item in effects
            },
            {item.name: tuple(_places(evidence, item, strengths=False)) for item in effects},
            cost_of_known, loose,
        )  # fmt: skip


@dataclass(frozen=True)
class Problem:
    """A weighted linear problem: the residual of all axes in units of noise, and its columns.

    Attributes:
        likelihood: weights and samples.
        y: residual by axis, (n,); base: by axis, (n, P), columns of the determined combinations of
            the model's parameters.
        known_precision, known_moment: (P, P) and (P,), the priors of these.
        log_scale: mean log of the fraction of the measured quantity that the effects leave, by
            axis, (n_q,); log_scale_slopes: its slopes by the same combinations, (n_q, P).
        to_parameters: (n_all, P), from these to the free parameters, nuisance parameters last.
        lower, upper: bounds of the change of the parameters, (n_all,).
        absence: by effect, the change of each of its free parameters (by index) that removes it.
        spread: by effect, prior standard deviations of its free strengths; shapes: by effect, the
            indices of its free shape parameters.
        cost_of_known: negative log density of the priors if nothing changes.
        loose: (n_all, m) directions of the parameters in which nothing measured changes.
    """

    likelihood: Likelihood
    y: Sequence[Array]
    base: Sequence[Array]
    known_precision: Array
    known_moment: Array
    log_scale: Array
    log_scale_slopes: Array
    to_parameters: Array
    lower: Array
    upper: Array
    absence: Mapping[str, Mapping[int, float]] = field(default_factory=dict)
    spread: Mapping[str, Array] = field(default_factory=dict)
    shapes: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    cost_of_known: float = 0.0
    loose: Array | None = None

    @property
    def independent(self) -> Array:
        """Independent samples of each axis, (n_q,)."""
        return np.array([s.independent for s in self.likelihood.samples])

    @property
    def count(self) -> Array:
        """Number of samples of each axis, at least one, (n_q,)."""
        return np.array([max(float(len(y)), 1.0) for y in self.y])

    @property
    def moment(self) -> Array:
        """Gradient of the log density, without the residual, if nothing changes, (P,)."""
        return np.asarray(self.known_moment + self.independent @ self.log_scale_slopes)

    @cached_property
    def precision(self) -> Array:
        """Its curvature, (P, P): a fraction of the scale is linear in the strength of an effect."""
        slopes = self.log_scale_slopes
        return np.asarray(self.known_precision + (self.independent * slopes.T) @ slopes)

    @property
    def fixed_cost(self) -> float:
        """Negative log density, without the residual, if nothing changes, nats."""
        return self.cost_of_known - float(self.independent @ self.log_scale)

    def sums(self) -> tuple[Array, Array, Array]:
        """Products of the base with itself, of the base with y, and of y with itself, by axis."""
        return (
            np.array([b.T @ b for b in self.base]),
            np.array([b.T @ y for b, y in zip(self.base, self.y, strict=True)]),
            np.array([float(y @ y) for y in self.y]),
        )

    def sums_of(self, parts: Sequence[Indices], count: int) -> tuple[Array, Array, Array]:
        """`sums` of ``count`` parts separately; ``parts`` numbers each axis' samples, (n,)."""
        n_q, n = len(self.y), self.to_parameters.shape[1]
        xx, xy, yy = (np.zeros((count, n_q, *shape)) for shape in ((n, n), (n,), ()))
        for axis, (y, base, part) in enumerate(zip(self.y, self.base, parts, strict=True)):
            order = np.argsort(part, kind="stable")
            ends = np.searchsorted(part[order], np.arange(count + 1))
            for k, (first, last) in enumerate(pairwise(ends)):
                b, v = base[order[first:last]], y[order[first:last]]
                xx[k, axis], xy[k, axis], yy[k, axis] = b.T @ b, b.T @ v, v @ v
        return xx, xy, yy

    def hold(self, values: Mapping[int, float], n: int | None = None) -> tuple[Array, Array]:
        """Fix some parameters: unknowns (n,) with the given values, and (n, m) free directions.

        A value that can be reached along a direction without effect constrains nothing else.

        Args:
            values: values by index of the parameter.
            n: number of unknowns, the model's own first; by default these alone.
        """
        nb, places = self.to_parameters.shape[1], list(values)
        n = nb if n is None else n
        fixed, free = np.zeros(n), np.eye(n)
        rows, wanted = self.to_parameters[places], np.array(list(values.values()))
        # Scale each row to its own unit; a row of zeros needs no constraint.
        norm = np.linalg.norm(rows, axis=1)
        moves = norm > 0.0
        rows, wanted = rows[moves] / norm[moves, None], wanted[moves] / norm[moves]
        if self.loose is not None and rows.size:
            u, size, _ = np.linalg.svd(self.loose[places][moves] / norm[moves, None])
            bound = u[:, int(np.sum(size > _LOOSE)) :].T
            rows, wanted = bound @ rows, bound @ wanted
        if not rows.size:
            return fixed, free
        u, size, vt = np.linalg.svd(rows)
        rank = int(np.sum(size > 1e-9 * max(float(size[0]), 1e-300)))
        fixed[:nb] = vt[:rank].T @ ((u.T @ wanted)[:rank] / size[:rank])
        free = np.zeros((n, n - rank))
        free[:nb, : nb - rank] = vt[rank:].T
        free[nb:, nb - rank :] = np.eye(n - nb)
        return fixed, free

    def solve(self) -> LinearSolution:
        """The most likely change of the model's own parameters."""
        return solve_bounded(self, *self.sums())

    def log_likelihood(self) -> float:
        """Log likelihood of the samples at the solution, nats, up to a constant free of weights."""
        roots = [float(np.mean(np.log(r))) if r.size else 0.0 for r in self.likelihood.root]
        return float(self.independent @ roots) - self.solve().cost

    def solve_nuisance(self, count: int) -> LinearSolution:
        """The most likely nuisance parameters while the model's ``count`` parameters stay."""
        return solve_bounded(self, *self.sums(), absent=dict.fromkeys(range(count), 0.0))


def expect_strengths(squares: Sequence[Array], applied: Sequence[Array]) -> Array:
    """Return the prior precision of the strengths of an effect about zero, (m, m).

    The contribution of the effect has the root mean square of the applied force as its standard
    deviation, so that similar effects cannot cancel each other with excessive forces.

    Args:
        squares: by axis, products of the columns of unit strength, (m, m); applied: by axis, (n,).
    """
    pairs = zip(squares, applied, strict=True)
    return np.asarray(sum(square / max(float(f @ f), 1e-300) for square, f in pairs))


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


def _error_of_turning(evidence: Evidence) -> Iterator[Array]:
    """Standard deviation of dry friction because the instants of reversals are unknown.

    By trial, each (T, n_q), N.m or N: the change of friction between two samples, times the
    standard deviation of an instant that is uniformly distributed between them.
    """
    width = evidence.system.sign_widths
    for dry, motion in zip(dry_friction(evidence), evidence.motions, strict=True):
        yield dry * np.gradient(np.tanh(motion.qd / width), axis=0) / np.sqrt(12.0)


def dry_friction(evidence: Evidence) -> Iterator[Array]:
    """Dry friction of a model, by trial, each (T, n_q), N.m or N.

    It is half the difference between slow motion in either direction, brakes included.
    """
    slow = _SLOW * evidence.system.sign_widths
    for at in evidence.along:
        q, qd, qdd = at.mechanism.kinematics
        back, on = (
            at.system.residual(q, side * slow + np.zeros_like(qd), qdd, at.memory, at.inputs, at.p)
            for side in (-1.0, 1.0)
        )
        yield from (0.5 * (back - on)[part] for part in at.motion.parts)


def _places(evidence: Evidence, item: BoundEffect, *, strengths: bool) -> list[int]:
    """Indices, among the free parameters, of the strengths or of the shapes of an effect."""
    names = {q.name for q in item.parameters if (q.strength if strengths else q.shape)}
    parameters = evidence.system.parameters
    return [k for k, number in enumerate(evidence.free) if parameters[number].name in names]


def _absence(evidence: Evidence, item: BoundEffect) -> dict[int, float]:
    away = {
        place: -float(evidence.p[evidence.free[place]])
        for place in _places(evidence, item, strengths=True)
    }
    # Without a strength the data say nothing of the shape: it stays, not moving to its prior.
    return away | dict.fromkeys(_places(evidence, item, strengths=False), 0.0)


@dataclass(frozen=True)
class LinearSolution:
    """The most likely unknowns of a linear problem.

    Attributes:
        unknowns: (n,), of which the first P are the model's own combinations of parameters.
        held: which of the other unknowns are held at zero by a bound, (n - P,).
        left: sum of squares by axis, (n_q,); weight: that of the squares at the solution.
        cost: negative log density, nats.
    """

    unknowns: Array
    held: Flags
    left: Array
    weight: Array
    cost: float

    @property
    def base(self) -> Array:
        """The first P unknowns, those of the model."""
        return self.unknowns[: len(self.unknowns) - len(self.held)]


def solve_bounded(
    problem: Problem,
    xx: Array,
    xy: Array,
    yy: Array,
    low: Array | None = None,
    high: Array | None = None,
    absent: Mapping[int, float] | None = None,
    weight: Array | None = None,
    expected: Array | None = None,
) -> LinearSolution:
    """Minimise the negative log likelihood, alternating between axis weights and bounds.

    An unknown that leaves its bounds is held at the bound it crossed.

    Args:
        problem: the model's own columns, which come first.
        xx, xy, yy: sums of products by axis, (n_q, n, n), (n_q, n), (n_q,).
        low, high: bounds of the other unknowns, (n - P,).
        absent: prescribed changes of the model's parameters, by index.
        weight: initial weight of the squares of each axis, (n_q,).
        expected: prior precision of the other unknowns about zero, (n - P, n - P).
    """
    p, n = problem, xx.shape[1]
    nb, independent = p.to_parameters.shape[1], p.independent
    low = np.zeros(0) if low is None else low
    high = np.zeros(0) if high is None else high
    precision, moment = np.zeros((n, n)), np.zeros(n)
    precision[:nb, :nb], moment[:nb] = p.precision, p.moment
    precision[nb:, nb:] = 0.0 if expected is None else expected
    fixed_at = dict(absent or {})
    held, bound = np.zeros(n - nb, dtype=bool), np.zeros(n - nb)
    weight = independent / np.maximum(yy, 1e-300) if weight is None else weight
    for _ in range(_PASSES):
        fixed, free = p.hold(fixed_at, n)
        fixed[nb:] = bound
        chosen = free[:, np.append(np.ones(free.shape[1] - n + nb, dtype=bool), ~held)]
        for _ in range(_REWEIGHTS):
            normal = np.tensordot(weight, xx, 1) + precision
            right = moment - weight @ xy - normal @ fixed
            b = fixed + chosen @ solve_scaled(chosen.T @ normal @ chosen, chosen.T @ right)
            left = np.maximum(yy + 2.0 * xy @ b + (xx @ b) @ b, 1e-12 * yy)
            left = left + 1e-300
            before, weight = weight, independent / left
            if np.all(np.abs(weight - before) <= _STEADY * before):
                break
        out = ~held & ((b[nb:] < low - 1e-12) | (b[nb:] > high + 1e-12))
        change = p.to_parameters @ b[:nb]
        slack = 1e-6 * (1.0 + np.abs(change))
        below, above = change < p.lower - slack, change > p.upper + slack
        fresh = {*np.flatnonzero(below | above).tolist()} - {*fixed_at}
        if not out.any() and not fresh:
            break
        held |= out
        bound[out] = np.clip(b[nb:], low, high)[out]
        fixed_at |= {k: float(p.lower[k] if below[k] else p.upper[k]) for k in fresh}
    cost = float(independent @ (0.5 * np.log(left / p.count)))
    off = b[:nb]
    cost += p.fixed_cost + 0.5 * float(off @ p.precision @ off) - float(p.moment @ off)
    return LinearSolution(b, held & (bound == 0.0), left, weight, cost)


def solve_scaled(normal: Array, right: Array) -> Array:
    """Solve a symmetric system whose unknowns have different units; ``right``: (n,) or (n, k)."""
    size = 1.0 / np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    scaled = normal * size * size[:, None]
    scaled.flat[:: len(scaled) + 1] += _RIDGE
    by = size if right.ndim == 1 else size[:, None]
    return np.asarray(np.linalg.solve(scaled, right * by) * by)
