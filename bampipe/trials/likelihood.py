"""The likelihood of what was measured, given a model: the one by which everything is judged.

Of the samples of an axis that count, in the words of docs/method_residual:

    y = f(motion; theta) + beta b + gamma c + e
    var e ~ s^2 (v(z) + tau^2 (b^2 + g^2 c^2) + h^2 + (delta F)^2), with the tails of Student's t

It is that of the measured quantity: with the log of what the model's effects leave of it, see
`scale`. y is what the fitted model leaves, low-passed; b the mean of replays of the model (what
filters do to its residual where friction turns, which the measurement shares); c the residual of a
replay whose friction truly stops the machine where it turns, and g a first guess of its factor; v
what single replays leave around b, by speed; h what friction is off because no log says when
between two samples a machine turns; F the applied force; s a scale of each axis, which is found
with the rest. Parameters have their priors and bounds; so have the nuisance parameters: the factors
beta and gamma of each axis, and the time by which inputs were sampled late.
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
"""Classes of speed in which the variance of replays is averaged, finer where an axis is slow."""
_LEAST = 1e-3
"""Of the mean variance: no sample weighs more than a thousand average ones."""
NOTHING = 1e-4
"""Standard deviations by which a parameter moves what is measured over all of its range: none."""
_DETERMINED = 1e-9
"""Of the largest eigenvalue of the scaled normal equations, below which a direction of the model's
own parameters is not determined by the trials, and stays."""
_LOOSE = 1e-6
"""Of a parameter in units of its uncertainty, from which on a direction without effect moves it."""
_SLOW = 3.0
"""Sign widths: slow motion, in which dry friction is as large as it gets."""
_MOST_STOPPING = 1.5
"""Largest factor of the residual of a replay that truly stops."""
_TOGETHER = 100_000
"""Rows of columns that are weighted at once."""
_FREQUENCIES = 256
"""At which the share of white noise that a low-pass leaves is summed."""
_RIDGE = 1e-10
_PASSES, _REWEIGHTS = 8, 5
_STEADY = 0.02
"""Relative change of the weights up to which they are done: the cost changes by its square."""


@dataclass(frozen=True)
class Samples:
    """The samples of one axis that count, of all trials in order.

    Attributes:
        rows: their places among the thinned samples of all trials, (n,).
        trial: number of the trial of each; block: of the stretch of time, both (n,).
        independent: how many independent ones they are.
    """

    rows: Indices
    trial: Indices
    block: Indices
    independent: float

    def take(self, values: Iterable[Array], axis: int) -> Iterator[Array]:
        """By trial, the rows of one axis, (k,) or (k, m), of values, each (K, n_q[, m])."""
        end = 0
        for each in values:
            first, end = end, end + len(each)
            rows = self.rows[slice(*np.searchsorted(self.rows, (first, end)))]
            yield each[rows - first, axis]


def lay_out_samples(evidence: Evidence, block_s: float) -> tuple[Samples, ...]:
    """Return the samples of each axis that count; blocks of ``block_s`` seconds are numbered."""
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
    """Return the rows of one axis, (n,) or (n, m), of values by trial, each (K, n_q[, m])."""
    return np.concatenate([*samples.take(values, axis)])


def _join(parts: Iterable[Array]) -> Iterator[tuple[slice, Array]]:
    """Arrays one below the other, `_TOGETHER` rows or a few more at a time, and which rows."""
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
    """What replays of a fitted model leave, which lacks nothing.

    Attributes:
        bias: their mean at each sample, by axis, each (n,), N.m or N.
        variance: of what single replays leave around it, smoothed by speed, each (n,).
        stopping: of a replay without noise whose friction truly stops it, each (n,).
        residuals: of each replay, by axis, each (replays, n).
        speed: class of speed of each sample, by axis, each (n,).
    """

    bias: Sequence[Array]
    variance: Sequence[Array]
    stopping: Sequence[Array]
    residuals: Sequence[Array]
    speed: Sequence[Indices]

    def variance_of_bias(self, axis: int, y: Array) -> Array:
        """How far the bias of a residual ``y``, (n,), may be off, for a relative error of one.

        Half of it where the replays have it, half wherever the axis is as slow: where exactly a
        machine turns, no replay knows.
        """
        b, c, at = self.bias[axis], self.stopping[axis], self.speed[axis]
        both = np.column_stack([b, c]) / np.sqrt(self.variance[axis] + 1e-300)[:, None]
        target = y / np.sqrt(self.variance[axis] + 1e-300)
        factor = np.linalg.lstsq(both, target, rcond=1e-6)[0][1] if len(y) else 0.0
        square = b**2 + (np.clip(factor, 0.0, _MOST_STOPPING) * c) ** 2
        count = np.maximum(np.bincount(at, minlength=_SPEEDS), 1)
        return np.asarray(0.5 * (square + (np.bincount(at, square, minlength=_SPEEDS) / count)[at]))

    def without(self, replay: int) -> tuple[Array, ...]:
        """The bias by all replays but one."""
        n = len(self.residuals[0])
        return tuple(
            (n * b - r[replay]) / (n - 1) for b, r in zip(self.bias, self.residuals, strict=True)
        )


def describe_noise(
    residuals: Sequence[Array],
    stopping: Sequence[Array],
    evidence: Evidence,
    samples: Sequence[Samples],
) -> Noise:
    """Return the noise that replays show.

    Args:
        residuals: of replays, by trial, each (K, n_q, replays).
        stopping: of one whose friction truly stops it, by trial, each (K, n_q).
        evidence: the model on the measured trials; samples: of it that count.
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
    """Weights of the samples of a session and the nuisance columns of its model.

    Attributes:
        samples: of each axis that count; noise: of replays.
        root: one over the standard deviation of each sample, by axis, each (n,).
        bias_variance: how far the bias may be off where the machine turns, by axis, each (n,).
        applied: the applied force, by axis, each (n,), N.m or N.
        model: that was weighted, without its residual and slopes.
        force_sd: noise of each measured force, (n_forces,), in its unit.
        discrepancy: of any model, relative.
        factors: of what is measured where the weights are those of the residual; see `Evidence`.
    """

    samples: tuple[Samples, ...]
    noise: Noise
    root: Sequence[Array]
    bias_variance: Sequence[Array]
    applied: Sequence[Array]
    model: Evidence
    force_sd: Array
    discrepancy: float
    factors: tuple[float, ...] = ()

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
        """Weight samples by the noise of replays, the error of their bias and any model's.

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
            # Where nothing scatters, all samples weigh alike.
            root.append(1.0 / np.sqrt(np.maximum(variance, least)) if least else np.ones(len(f)))
            force.append(f)
            bias_variance.append(of_bias)
        model = replace(e, residual=(), jacobian=(), used=())  # their memory
        return cls(
            samples, noise, KeptItems(root), KeptItems(bias_variance), KeptItems(force), model,
            force_sd, discrepancy, e.factors,
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
        """Share of the noise of each sample that is that of the measured forces, by axis, (n,)."""
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
        """The same where all samples of an axis weigh alike on which the model lacks much.

        Noise of replays says nothing of an error that is many times as large. Nor is that noise: it
        repeats with the path, and each sample counts against what is known beforehand.

        Args:
            problem: the fit, its solution at zero; lacking: scale from which on an axis does.
        """
        scale = np.sqrt(problem.solve().left / problem.count)
        root, samples = list(self.root), list(self.samples)
        for axis in np.flatnonzero(scale > lacking).tolist():
            rows = samples[axis].rows.size
            root[axis] = np.full(rows, np.sqrt(np.mean(self.root[axis] ** 2)))
            samples[axis] = replace(samples[axis], independent=float(rows))
        return replace(self, root=KeptItems(root), samples=tuple(samples))

    def with_heavy_tails(self, problem: Problem, tails: float) -> Likelihood:
        """Weights of samples as under Student's t distribution, at a fit of the model.

        A few fast reversals that no replay has would otherwise decide (Lange, Little and Taylor
        1989, Journal of the American Statistical Association 84, 881).

        Args:
            problem: the fit, its solution at zero; tails: degrees of freedom.
        """
        solved, root = problem.solve(), []
        for axis, (y, base) in enumerate(zip(problem.y, problem.base, strict=True)):
            square = (y + base @ solved.base) ** 2
            mean = max(float(solved.left[axis]) / problem.count[axis], 1e-300)
            root.append(self.root[axis] * np.sqrt((tails + 1.0) / (tails + square / mean)))
        return replace(self, root=KeptItems(root))

    def count_independent(self, problem: Problem, lags: int) -> tuple[Samples, ...]:
        """Count the samples of each axis that are independent in what a fit of the model leaves.

        What a model lacks comes back with the motion, sample after sample; noise does not, coloured
        or white. For what goes with the motion, as the applied force does, there are fewer samples
        by the sum of the products of both autocorrelations (Bartlett 1935, Journal of the Royal
        Statistical Society 98, 536), over the largest that a replay has.

        Args:
            problem: the fit, its solution at zero; lags: the most that are summed.
        """
        solved, counted = problem.solve(), []
        for axis, here in enumerate(self.samples):
            root = self.root[axis]
            force = _correlate(self.applied[axis] * root, here, lags)

            def inflation(values: Array, at: Samples = here, force: Array = force) -> float:
                return max(2.0 * float(_correlate(values, at, lags) @ force) - 1.0, 1e-3)

            ours = inflation(problem.y[axis] + problem.base[axis] @ solved.base)
            noise = (self.noise.residuals[axis] - self.noise.bias[axis]) * root
            replays = max((inflation(values) for values in noise), default=1.0)
            counted.append(replace(here, independent=here.independent * min(replays / ours, 1.0)))
        return tuple(counted)

    def pose(self, evidence: Evidence) -> Problem:
        """Weight the residual of a linearised model; join what is known of its parameters."""
        samples, noise, n_q, weights = self.samples, self.noise, len(self.samples), self.root
        if evidence.factors:  # in units of what is measured: small factors explain nothing
            ratio = np.array(self.factors) / np.array(evidence.factors)
            weights = [root * by for root, by in zip(weights, ratio, strict=True)]
        timing = evidence.timing if evidence.by_timing else ()
        n = len(evidence.free) + len(timing[:1])

        def weighted_columns(axis: int) -> Iterator[tuple[slice, Array]]:
            """By all unknowns, (k, n_all), a part of the rows after the other: all are large."""
            bias, stopping, weight = noise.bias[axis], noise.stopping[axis], weights[axis]
            for part, slopes in _join(samples[axis].take(evidence.slopes, axis)):
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

        # What lies evenly between two bounds has a standard deviation of 0.29 of their distance.
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
        # What changes nothing over its range stays, as a shape does whose strength is zero.
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
    """The samples of all axes in units of their noise: what is left, and the model's own columns.

    Attributes:
        likelihood: weights and samples.
        y: by axis, (n,); base: by axis, (n, P), by the determined combinations of parameters.
        known_precision, known_moment: of what is known of these beforehand, (P, P) and (P,).
        log_scale: mean log of what the model's effects leave of the measured quantity, by axis,
            (n_q,); log_scale_slopes: by the same combinations, (n_q, P).
        to_parameters: (n_all, P) from these to the free parameters, nuisance parameters last.
        lower, upper: bounds of the change of those, (n_all,).
        absence: of each effect of the model, by the place of each of its parameters among the free
            ones, the change that takes it away.
        spread: of each, the standard deviations of these strengths before any data; shapes: the
            places of the parameters that it has beside them.
        cost_of_known: negative log density of what is known beforehand, where nothing changes.
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
        """Samples of each axis, (n_q,), one at least."""
        return np.array([max(float(len(y)), 1.0) for y in self.y])

    @property
    def moment(self) -> Array:
        """Slope of the log density of all but the residual where nothing changes, (P,)."""
        return np.asarray(self.known_moment + self.independent @ self.log_scale_slopes)

    @cached_property
    def precision(self) -> Array:
        """Its curvature, (P, P): a share of the scale is linear in the strength of an effect."""
        slopes = self.log_scale_slopes
        return np.asarray(self.known_precision + (self.independent * slopes.T) @ slopes)

    @property
    def fixed_cost(self) -> float:
        """Negative log density of all but the residual where nothing changes, nats."""
        return self.cost_of_known - float(self.independent @ self.log_scale)

    def sums(self) -> tuple[Array, Array, Array]:
        """Products of the base with itself, with y, and of y with itself, by axis."""
        return (
            np.array([b.T @ b for b in self.base]),
            np.array([b.T @ y for b, y in zip(self.base, self.y, strict=True)]),
            np.array([float(y @ y) for y in self.y]),
        )

    def sums_of(self, parts: Sequence[Indices], count: int) -> tuple[Array, Array, Array]:
        """`sums` of each of ``count`` parts; ``parts``: of each sample, by axis, each (n,)."""
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
        """Unknowns (n,) at which parameters have given values, and (n, m) directions still free.

        A value that a direction reaches in which nothing measured changes holds nothing else.

        Args:
            values: by number of the parameter.
            n: of unknowns, the model's own first; these alone by default.
        """
        nb, places = self.to_parameters.shape[1], list(values)
        n = nb if n is None else n
        fixed, free = np.zeros(n), np.eye(n)
        rows, wanted = self.to_parameters[places], np.array(list(values.values()))
        # Each row in its own unit; what does not move is held already.
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

    def solve(self) -> Solved:
        """The change of the model's own parameters that is most likely."""
        return solve_bounded(self, *self.sums())

    def log_likelihood(self) -> float:
        """Of the samples at the solution, nats, up to a constant that no weights change."""
        roots = [float(np.mean(np.log(r))) if r.size else 0.0 for r in self.likelihood.root]
        return float(self.independent @ roots) - self.solve().cost

    def solve_nuisance(self, count: int) -> Solved:
        """The nuisance parameters that are most likely where the first ``count``, the model's own,
        stay as they are.
        """
        return solve_bounded(self, *self.sums(), absent=dict.fromkeys(range(count), 0.0))


def expect_strengths(squares: Sequence[Array], applied: Sequence[Array]) -> Array:
    """What is known beforehand of the strengths of an effect: their precision about zero, (m, m).

    What it adds has the root mean square of the applied force as its standard deviation, so that
    no two effects cancel each other with forces that the machine does not have.

    Args:
        squares: by axis, products of what unit strengths add, (m, m); applied: by axis, (n,).
    """
    pairs = zip(squares, applied, strict=True)
    return np.asarray(sum(square / max(float(f @ f), 1e-300) for square, f in pairs))


def _correlate(values: Array, samples: Samples, lags: int) -> Array:
    """Autocorrelation of values (n,) within trials, (lags + 1,); one and zeros of nothing."""
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
    """What is not known of friction as a log does not say when between two samples a machine turns.

    By trial, each (T, n_q), N.m or N: the change of friction from sample to sample, times the
    standard deviation of a moment that lies evenly between two of them.
    """
    width = evidence.system.sign_widths
    for dry, motion in zip(dry_friction(evidence), evidence.motions, strict=True):
        yield dry * np.gradient(np.tanh(motion.qd / width), axis=0) / np.sqrt(12.0)


def dry_friction(evidence: Evidence) -> Iterator[Array]:
    """What turns with the motion in a model, by trial, each (T, n_q), N.m or N.

    Half the difference between moving slowly one way and the other, brakes included.
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
    """Places among the free parameters of the strengths of an effect, or of its shapes."""
    names = {q.name for q in item.parameters if (q.strength if strengths else q.shape)}
    parameters = evidence.system.parameters
    return [k for k, number in enumerate(evidence.free) if parameters[number].name in names]


def _absence(evidence: Evidence, item: BoundEffect) -> dict[int, float]:
    away = {
        place: -float(evidence.p[evidence.free[place]])
        for place in _places(evidence, item, strengths=True)
    }
    # Without its strength a shape says nothing: it does not move to where it was expected.
    return away | dict.fromkeys(_places(evidence, item, strengths=False), 0.0)


@dataclass(frozen=True)
class Solved:
    """The most likely unknowns of a linear problem.

    Attributes:
        unknowns: (n,), the first of them of the model's own combinations of parameters.
        held: which of the others stay at zero, being out of their bounds else, (n - P,).
        left: sum of squares by axis, (n_q,); weight: of the squares there.
        cost: half the independent samples times the log of the mean square, over all axes.
    """

    unknowns: Array
    held: Flags
    left: Array
    weight: Array
    cost: float

    @property
    def base(self) -> Array:
        """Those of the model's own parameters."""
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
) -> Solved:
    """Minimise the negative log likelihood: weights of the axes and bounds found in turn.

    An unknown that leaves its bounds is held at the one it left by.

    Args:
        problem: the model's own columns, which are the first of all.
        xx, xy, yy: sums of products by axis, (n_q, n, n), (n_q, n), (n_q,).
        low, high: bounds of the unknowns beyond the model's own, (n - P,).
        absent: given changes of the model's parameters, by number.
        weight: of the squares of each axis to start from, (n_q,).
        expected: precision of the unknowns beyond the model's own about zero, (n - P, n - P).
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
    return Solved(b, held & (bound == 0.0), left, weight, cost)


def solve_scaled(normal: Array, right: Array) -> Array:
    """Solve a symmetric system whose unknowns have different units; right (n,) or (n, k)."""
    size = 1.0 / np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    scaled = normal * size * size[:, None]
    scaled.flat[:: len(scaled) + 1] += _RIDGE
    by = size if right.ndim == 1 else size[:, None]
    return np.asarray(np.linalg.solve(scaled, right * by) * by)
