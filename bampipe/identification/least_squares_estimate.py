"""Least squares on the inverse dynamics under the likelihood by which models are judged.

Weights of samples, biases of filters and of stopping friction, the input delay and the nuisance
parameters are those of `bampipe.trials.likelihood`.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd

from bampipe.arrays import Array, Flags, Indices
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.session import Fit, Session
from bampipe.errors import InputError
from bampipe.estimate.bounded import invert_scaled
from bampipe.estimate.influence import RemovedStretch, find_worst_stretch
from bampipe.estimate.least_squares import (
    BLOCKS_A_PARAMETER,
    Problem,
    covariance_by_blocks,
    minimise,
)
from bampipe.estimate.simulation import Runaway
from bampipe.estimate.standstill import find_moving_samples
from bampipe.identification.estimates import Estimate, input_timing
from bampipe.identification.filter_tables import as_filtered
from bampipe.physics import System
from bampipe.physics.model_spec import ModelSpec
from bampipe.results.identify import Convergence, StateBound
from bampipe.trials.kept import KeptItems
from bampipe.trials.linear_problem import solve_bounded
from bampipe.trials.measured import MeasuredTrials, cut_blocks
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import problem_of, rms
from bampipe.trials.samples import BIASES, lay_out_samples, take_samples

_REPLICATES = 6
_LACKING = 3.0
"""Ratio of the residual to the part due to sensors, filters and discrepancy above which weights are
meaningless: the verdict then says that something unknown remains."""
_PASSES = 6
"""Largest number of fits of a nonlinear model, each with replicates of the one before."""
_SETTLED = 1.0
"""Such fits end when one gains fewer nats of log likelihood; the most likely one is taken."""
_FARTHEST = 3.0
"""Largest change of a nonlinear fit when a trial is left out, in standard deviations."""
_PERIODS = 10
"""Length of the shortest independent block, in periods of the band."""
_TAILED = 0.75
"""Mean slope of a sample's score under Student's t distribution over its weight, for normal errors
and four degrees of freedom: weights that depend on the errors overstate the information."""
_STRETCH_S = 1.0
_STATES = 500_000
"""Number of samples, spread over all trials, for the typical uncertainty of a state."""


@dataclass(frozen=True)
class SquaresFit:
    """A model fitted to trials under the likelihood.

    Attributes:
        fit: the fit; trials: the fitted trials; problem: their inverse dynamics, for other
            estimators.
        has_replicates: whether the model could be simulated; otherwise all samples have equal
            weight.
        p: (n_p + 1,) parameters, the change of the input delay from that of ``trials`` last, s.
        block_s: longest independent block of time, s.
    """

    fit: Fit
    trials: MeasuredTrials
    problem: Problem
    has_replicates: bool
    p: Array
    block_s: float

    @property
    def free(self) -> Indices:
        """(n,) indices in ``p`` of the estimated parameters, the input delay last if estimated."""
        return self.problem.free

    @property
    def at_bound(self) -> Flags:
        """(n,) which of them are at a bound."""
        value, slack = self.p[self.free], 1e-9 * (self.problem.upper - self.problem.lower)
        slack = np.where(np.isfinite(slack), slack, 0.0)
        low, high = self.problem.lower + slack, self.problem.upper - slack
        return np.asarray((value <= low) | (value >= high))

    @cached_property
    def _left(self) -> Sequence[tuple[Array, float]]:
        """By axis: the residual, (n,), and its root mean square."""
        every = self.fit.problem.residual_rows(self.fit.solution.base)
        return KeptItems(
            (left, max(float(np.sqrt(np.mean(left**2))), 1e-300) if left.size else 1.0)
            for left in every
        )

    @property
    def rows(self) -> Iterator[tuple[Array, Array]]:
        """By axis: slopes (n, P) by the determined unknowns, and residual (n,); both weighted.

        They are computed on each access, because storing them would double the problem's memory.
        """
        pairs = zip(self.fit.problem.base, self._left, strict=True)
        return ((x / scale, left / scale) for x, (left, scale) in pairs)

    @cached_property
    def normal(self) -> Array:
        """Normal equations by the determined unknowns, including priors, (P, P)."""
        products = sum(x.T @ x for x, _ in self.rows)
        return np.asarray(products + self.fit.problem.precision)

    @cached_property
    def information(self) -> Array:
        """Normal equations by the free parameters, then the nuisance parameters, (m, m)."""
        back = np.linalg.pinv(self.fit.problem.to_parameters)
        return np.asarray(back.T @ self.normal @ back)

    def respond(self, changes: Sequence[Array], held: Iterable[int] = ()) -> Array:
        """Return the first-order change of the parameters (n,) by changes of the measurement.

        Args:
            changes: changes of the residual, by axis, each (n,), N.m or N.
            held: indices of parameters that stay; nuisance parameters follow the others.
        """
        parts = zip(self.rows, self._left, self.fit.likelihood.root, changes, strict=True)
        score = sum(x.T @ (root / scale * c) for (x, _), (_, scale), root, c in parts)
        to, count = self.fit.problem.to_parameters, self.free.size
        _, chosen = self.fit.problem.hold(dict.fromkeys(held, 0.0))
        step = chosen @ invert_scaled(chosen.T @ self.normal @ chosen) @ (chosen.T @ score)
        return np.asarray(-(to @ step)[:count])

    def residual_change(self, residual: Iterable[Array]) -> list[Array]:
        """Return the differences of unfiltered residuals (T, n_q) from its own, by axis, (n,)."""
        linearisation, samples = self.fit.linearisation, self.fit.likelihood.samples
        thin = linearisation.band.thin_trials(residual, range(len(samples)))
        change = [there - here for there, here in zip(thin, linearisation.residual, strict=True)]
        return [take_samples(change, here, axis) for axis, here in enumerate(samples)]

    @cached_property
    def covariance(self) -> Array:
        """(n, n) by the scatter of blocks of time; see `covariance_by_blocks`."""
        pose = self.fit.problem
        inverse = invert_scaled(self.normal)
        fitted = float(np.trace(inverse @ (self.normal - pose.precision)))
        # With fewer than three blocks per parameter, use shorter blocks.
        band = self.trials.band
        seconds = sum(self.fit.linearisation.sizes) / band.rate_hz
        most = max(
            seconds / (BLOCKS_A_PARAMETER * max(fitted, 1.0)), _PERIODS / min(band.cutoff_hz)
        )
        samples = lay_out_samples(self.fit.linearisation, min(self.block_s, most))
        tailed = [_TAILED if np.any(root != root[:1]) else 1.0 for root in self.fit.likelihood.root]
        rows = ((x, left / by) for (x, left), by in zip(self.rows, tailed, strict=True))
        independent = [s.independent * by**2 for s, by in zip(samples, tailed, strict=True)]
        found = covariance_by_blocks(rows, pose.precision, [s.block for s in samples], independent)
        to = pose.to_parameters[: self.free.size]
        return np.asarray(to @ found @ to.T)

    @cached_property
    def sd(self) -> Array:
        """(n,) standard deviations."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @cached_property
    def by_trial(self) -> tuple[Array, Array, Array]:
        """Sums of products by trial; see `sums_of`."""
        trials = [here.trial for here in self.fit.likelihood.samples]
        return self.fit.problem.sums_of(trials, len(self.trials.motions))

    def refit(self, xx: Array, xy: Array, yy: Array) -> Array:
        """Return the parameters (n_p + 1,) from sums of some samples, to first order."""
        pose, count = self.fit.problem, self.free.size
        lower, upper = pose.lower.copy(), pose.upper.copy()
        if not self.problem.linear:
            step = (pose.to_parameters @ self.fit.solution.base)[:count]
            reach = _FARTHEST * np.maximum(self.sd, 1e-300)
            lower[:count] = np.maximum(lower[:count], step - reach)
            upper[:count] = np.minimum(upper[:count], step + reach)
        bounded = replace(pose, lower=lower, upper=upper)
        yy = np.maximum(yy, 1e-300)
        found = solve_bounded(bounded, xx, xy, yy, weight=self.fit.solution.weight)
        moved = pose.to_parameters @ (found.base - self.fit.solution.base)
        p = self.p.copy()
        p[self.free] = np.clip(p[self.free] + moved[:count], self.problem.lower, self.problem.upper)
        return p

    @cached_property
    def parts(self) -> Sequence[Motion]:
        """The parts left out in turn: trials, or blocks of a single one."""
        motions: Sequence[Motion] = self.trials.motions
        return motions if len(motions) > 1 else cut_blocks(motions[0], self.trials.band)

    @cached_property
    def moves(self) -> list[Array]:
        """Change of the estimates, (n,), if each part is left out; see `Influence`.

        In a single trial, a period of the band on either side is left out as well.
        """
        band, groups = self.trials.band, np.array(self.trials.folds.groups)
        if len(self.parts) == 1:
            return [np.zeros(self.free.size)]
        if len(groups) > 1:
            found = {
                each: self._move_to([s[groups != each].sum(axis=0) for s in self.by_trial])
                for each in np.unique(groups)
            }
            return [found[group] for group in groups]
        t, *blocks = (m.t[band.thinned_rows(len(m.t))] for m in (*self.trials.motions, *self.parts))
        gap_s = 1.0 / min(band.cutoff_hz)
        samples, moves = self.fit.likelihood.samples, []
        for block in blocks:
            gone = (t >= block[0] - gap_s) & (t <= block[-1] + gap_s)
            parts = self.fit.problem.sums_of([gone[here.rows] for here in samples], 2)
            moves.append(self._move_to([s[0] for s in parts]))
        return moves

    def _move_to(self, sums: Sequence[Array]) -> Array:
        return np.asarray((self.refit(*sums) - self.p)[self.free])

    def held_out_rmse(self, p: Array) -> Array:
        """Return the error of an estimate on held-out parts, by axis, (n_q,), N.m or N.

        ``p`` (n_p + 1,) is the estimate, by any method; it is moved as least squares are.
        """
        trials, limits = self.trials, (self.problem.lower, self.problem.upper)
        problem = problem_of(
            self.fit.linearisation.system, self.parts, trials.band, timing=trials.timed
        )

        def residual(part: int) -> Array:
            without = p.copy()
            without[self.free] = np.clip(p[self.free] + self.moves[part], *limits)
            return trials.band.thin(problem.residual(part, without))

        used = (find_moving_samples(still, trials.band) for still in problem.standstill)
        return rms(map(residual, range(problem.n_trials)), used)

    def find_worst_second(self) -> RemovedStretch:
        """Return the second of a trial without which some parameter would change most."""
        linearisation = self.fit.linearisation
        samples = lay_out_samples(linearisation, _STRETCH_S)
        to = self.fit.problem.to_parameters[: self.free.size] @ invert_scaled(self.normal)
        steps = ((x @ to.T, left) for x, left in self.rows)
        band, places = linearisation.band, dict[int, tuple[int, float]]()
        first = np.cumsum([0, *map(len, linearisation.residual)])
        for here in samples:
            block, at = np.unique(here.block, return_index=True)
            trial = here.trial[at]
            t = (here.rows[at] - first[trial]) * band.step / band.rate_hz
            start = band.margin_s + np.floor(t / _STRETCH_S) * _STRETCH_S
            starts = zip(trial.tolist(), start.tolist(), strict=True)
            places.update(zip(block.tolist(), starts, strict=True))
        return find_worst_stretch(steps, [here.block for here in samples], places, self.sd)

    @property
    def bias(self) -> Array:
        """Bias of the parameters due to filters and stopping friction, (n,)."""
        unknowns = self.fit.problem.to_parameters.shape[0]
        factors = range(unknowns - len(BIASES) * len(self._left), unknowns)
        return self.respond(self.fit.bias, factors)


def fit_squares(
    trials: MeasuredTrials,
    spec: ModelSpec,
    system: System,
    start: Array,
    block_s: float,
    remove_bias: bool = True,
) -> SquaresFit:
    """Fit a model under the likelihood, from the parameters ``start`` (n_p,).

    The `timing` of the trials bounds the input delay; ``block_s`` is as in `SquaresFit`; with
    ``remove_bias``, replicates give weights and bias.

    Raises:
        ValueError: fewer samples are clear of standstill than there are parameters.
    """
    session = Session(trials, Criteria(replicates=_REPLICATES), keeps_timing=True)
    problem = problem_of(system, trials.motions, trials.band, timing=trials.timed)
    # Shapes of effects keep the values of their search, which stopping friction would bias here.
    effects = () if problem.linear else system.model.effects
    plain = problem_of(
        system, trials.motions, trials.band, held=[q.name for e in effects for q in e.parameters]
    )
    begun = minimise(plain, np.append(start, 0.0), trials.folds.fitted_trials).p[:-1]
    at, found = begun, None
    with suppress(Runaway):
        for number in range(0 if not remove_bias else 1 if problem.linear else _PASSES):
            again = _with_values(session.fit(spec, at, lacking=_LACKING), trials, problem, block_s)
            # Replicates of a model with an error push the next fit the opposite way, so average.
            there = again.fit.linearisation.p
            at = there if found is None else 0.5 * (at + there)
            gain = again.fit.log_likelihood - found.fit.log_likelihood if found else np.inf
            found = again if gain > 0.0 else found
            if number > 1 and gain < _SETTLED:
                break
    if found is None:
        plain_fit = session.fit_plainly(spec, begun)
        squares = _with_values(plain_fit, trials, problem, block_s)
        found = replace(squares, has_replicates=False)
    return found


def _with_values(fit: Fit, trials: MeasuredTrials, problem: Problem, block_s: float) -> SquaresFit:
    """Return the fit with its parameters, and the last step of its linear problem if that holds."""
    p = np.append(fit.linearisation.p, 0.0)
    if problem.linear or fit.has_settled:
        change = (fit.problem.to_parameters @ fit.solution.base)[: problem.free.size]
        p[problem.free] = np.clip(p[problem.free] + change, problem.lower, problem.upper)
    return SquaresFit(fit, trials, problem, True, p, block_s)


def estimate_by_least_squares(system: System, squares: SquaresFit) -> Estimate:
    """Return the least-squares estimate; its trace is the fit to the trials up to each time."""
    motions: Sequence[Motion] = squares.trials.motions
    count = int(np.sum(squares.free < len(system.parameters)))
    stride = -(-sum(squares.fit.linearisation.sizes) // _STATES)
    bound = 3.0 * np.median(np.concatenate([m.qd_sd[::stride] for m in motions]), axis=0)

    def trace() -> list[Mapping[str, object]]:
        rows: list[Mapping[str, object]] = []
        clock = 0.0
        so_far = [np.cumsum(s, axis=0) for s in squares.by_trial]
        trial_of = np.concatenate([here.trial for here in squares.fit.likelihood.samples])
        counts = np.cumsum(np.bincount(trial_of, minlength=len(motions)))
        for number, motion in enumerate(motions):
            clock += float(motion.t[-1])
            p = squares.refit(*(s[number] for s in so_far))
            share = float(counts[number] / max(counts[-1], 1))
            row: dict[str, object] = {"t_total": clock, "trial_id": motion.trial_id}
            for k, place in enumerate(squares.free[:count]):
                name = system.parameters[place].name
                sd = squares.sd[k] / np.sqrt(share) if share else system.parameters[place].sd
                row |= {name: p[place], f"{name}_sd": sd}
            rows.append(row)
        return rows

    residual = squares.fit.linearisation.rmse()
    return Estimate(
        method="least-squares",
        p=squares.p,
        problem=squares.problem,
        covariance=squares.covariance[:count, :count],
        at_bound=squares.at_bound[:count],
        held_out_rmse=squares.held_out_rmse(squares.p),
        details=[{"least_squares_bias": bias} for bias in squares.bias[:count]],
        report={
            "input_timing": input_timing(squares.p, squares.problem, squares.covariance),
            "convergence": Convergence(converged=True),
            "state_3sigma": {
                axis: StateBound(velocity=bound[i]) for i, axis in enumerate(system.coordinates)
            },
            "residual_sd": dict(zip(system.coordinates, residual, strict=True)),
        },
        tabulate=lambda: (
            (as_filtered(system, m, squares.p[:-1]) for m in motions),
            pd.DataFrame(trace()),
        ),
    )


def require_enough(squares: SquaresFit, where: str) -> None:
    """Raise :class:`InputError` if there are fewer than two independent samples per parameter."""
    samples = lay_out_samples(squares.fit.linearisation, squares.block_s)
    moving = int(sum(here.independent for here in samples))
    if moving < 2 * squares.free.size:
        raise InputError(
            f"the free trials have {moving} independent samples in motion, fewer than twice the"
            f" {squares.free.size} parameters",
            where=where,
            remedy="record faster motion at a higher rate, or more of it",
        )
