"""The likelihood: weights, what replicates share, stops, heavy tails, bounds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from sessions import fit_from_priors

from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.session import Session, system_of
from bampipe.identification.least_squares_estimate import fit_squares
from bampipe.trials.likelihood import Likelihood
from bampipe.trials.linear_problem import (
    LinearProblem,
    pose_problem,
    solve_bounded,
    solve_scaled,
)
from bampipe.trials.samples import Noise, Samples, describe_noise, take_samples

pytest_plugins = ("recorded",)


@pytest.fixture(scope="module")
def fitted(record):
    """The arm, which lacks nothing, fitted under the likelihood."""
    trials, spec = record("bam", 6)
    session = Session(trials, Criteria())
    return session, session.fit(spec, fit_from_priors(session, spec).linearisation.p)


def factors(fit, residual):
    """Of the common bias, of the replicate that stops and of a wider sign, (3, n_q)."""
    y = tuple(r * root for r, root in zip(residual, fit.likelihood.root, strict=True))
    problem = replace(pose_problem(fit.likelihood, fit.linearisation), y=y)
    return (problem.to_parameters @ problem.solve().base)[-3 * len(residual) :].reshape(3, -1)


def test_a_replicate_has_unit_variance_in_units_of_its_noise(fitted):
    """Fast or slow; by replicates that the noise was not made of."""
    session, fit = fitted
    e, samples = fit.linearisation, fit.likelihood.samples
    nothing = [np.zeros((*r.shape, 2)) for r in e.residual]
    noise = describe_noise(session.replicate(e, 24), nothing, e, samples)
    fresh = replace(session, seed=1).replicate(e, 24)
    for axis, here in enumerate(samples):
        rows = take_samples(fresh, here, axis).T - noise.bias[axis]
        square = rows**2 / noise.variance[axis]
        speed = noise.speed[axis]
        # A replicate in which one reversal comes late is far from the others.
        by_speed = [np.median(square[:, speed == k].mean(axis=1)) for k in np.unique(speed)]
        assert 0.6 < min(by_speed) and max(by_speed) < 1.7
        spread = np.sqrt(noise.variance[axis])
        assert spread.max() > 1.5 * spread.min()


def test_the_cost_of_a_step_is_that_of_the_problem_there(fitted):
    session, fit = fitted
    e, p, steps = fit.linearisation, fit.linearisation.p.copy(), -0.02 * fit.linearisation.p
    p, steps = p + steps, steps[list(e.free)]
    there = pose_problem(fit.likelihood, session.linearise(fit.spec, p, e))
    exact, rows = there.solve_nuisance(len(steps)).cost, e.residual_of(e.system, p)
    assert fit.problem.cost_of_step(rows, steps) == pytest.approx(exact, abs=0.1)
    assert exact > fit.solution.cost + 10.0


def test_replicates_are_the_same_in_other_processes(fitted):
    session, fit = fitted
    e = fit.linearisation
    alone = session.replicate(e, 3)
    beside = replace(session, jobs=2).replicate(e, 3)
    assert len(alone) == len(e.motions)
    assert all(np.array_equal(a, b) for a, b in zip(alone, beside, strict=True))
    assert not np.array_equal(alone[0][:, :, 0], alone[0][:, :, 1])


def test_a_model_of_less_mass_averages_noise_of_the_motion(fitted):
    session, fit = fitted
    e, p = fit.linearisation, fit.linearisation.p.copy()
    p[[q.name for q in e.system.parameters].index("mass")] *= 0.5
    lighter = replace(fit, linearisation=session.linearise(fit.spec, p, e))
    assert session.compare_noise(fit, fit) == pytest.approx(np.ones(3))
    assert 0.25 < session.compare_noise(fit, lighter)[2] < 0.9  # the rest is that of the force


def test_what_a_model_may_be_wrong_by_weighs_less_where_the_force_is_large(fitted):
    _, fit = fitted
    like = fit.likelihood
    force_sd = np.zeros(len(fit.linearisation.system.model.device.forces))
    loose = Likelihood.of(fit.linearisation, like.samples, like.noise, 1e-9, 0.05, force_sd)
    for force, root in zip(loose.applied, loose.root, strict=True):
        large, small = np.abs(force) > np.quantile(np.abs(force), [[0.9], [0.1]])
        assert root[large].mean() < 0.6 * root[~small].mean()
    exact = Likelihood.of(fit.linearisation, like.samples, like.noise, 0.0, 0.0, force_sd)
    for root, variance in zip(exact.root, like.noise.variance, strict=True):
        np.testing.assert_allclose(root**2 * variance, 1.0)


@pytest.mark.parametrize("share", [0.3, 1.0, 1.4])
def test_what_all_replicates_share_goes_to_the_factors_of_the_biases(fitted, share):
    _, fit = fitted
    noise = fit.likelihood.noise
    by_replicate = [
        r[0] + (share - 1.0) * b for r, b in zip(noise.residuals, noise.bias, strict=True)
    ]
    for axis, found in enumerate(factors(fit, by_replicate).T):
        off = noise.biases(axis) @ found - share * noise.bias[axis]
        assert np.std(off) < 0.2 * np.std(noise.bias[axis])


@pytest.mark.parametrize(
    ("common", "share", "found"),
    [
        (1.0, 0.8, (1.0, 0.8)),
        (-1.0, 0.7, (0.0, 0.7)),
        (4.0, 0.7, (1.5, 0.7)),
        (1.0, -1.0, (1.0, 0.0)),
    ],
)
def test_friction_that_stops_has_a_factor_within_bounds(fitted, common, share, found):
    _, fit = fitted
    noise = fit.likelihood.noise
    # Unlike anything the model's own parameters could do, and the common bias.
    rng, stops = np.random.default_rng(3), []
    for b, root in zip(noise.bias, fit.likelihood.root, strict=True):
        other, weight = np.abs(b).max() * rng.normal(size=b.shape), root**2 * b
        stops.append(other - b * (weight @ other) / (weight @ b))
    turns = [np.column_stack([s, np.zeros_like(s)]) for s in stops]
    like = replace(fit.likelihood, noise=replace(noise, reversals=turns))
    residual = [common * b + share * s for b, s in zip(noise.bias, stops, strict=True)]
    solved = np.transpose(factors(replace(fit, likelihood=like), residual))
    np.testing.assert_allclose(solved, [(*found, 0.0)] * 3, atol=0.1)


def problem_of(y, base, *, independent=None, lower=-np.inf, upper=np.inf, absence=None):
    """A problem of one axis whose parameters (n,) are known to be about zero, sd 100."""
    n, rows = base.shape[1], len(y)
    nothing, place = np.zeros(rows), np.zeros(rows, dtype=np.int64)
    samples = Samples(np.arange(rows), place, place, independent or float(rows))
    noise = Noise((nothing,), (nothing + 1.0,), (np.zeros((rows, 2)),), (nothing[None],), (place,))
    ones = nothing + 1.0
    slopes = (np.ones((rows, 1)),)
    like = Likelihood((samples,), noise, (ones,), (nothing,), (ones,), None, ones[:1], 0.0)
    vars(like).update(slopes=slopes, force_share=(nothing,))
    bounds = np.broadcast_to(lower, n), np.broadcast_to(upper, n)
    precision = 1e-4 * np.eye(n)
    scale = np.zeros(1), np.zeros((1, n))
    return LinearProblem(
        like, (y,), (base,), precision, np.zeros(n), *scale, np.eye(n), *bounds, absence or {}
    )


@pytest.fixture
def line():
    """y + 2 x0 - x1 + noise = 0 at (2, -1)... in the sign of a residual, and its columns."""
    rng = np.random.default_rng(1)
    base = rng.normal(size=(400, 2))
    return -base @ [2.0, -1.0] + 0.1 * rng.normal(size=400), base


def test_parameters_and_strengths_stay_within_bounds_and_the_rest_moves_along(line):
    y, base = line
    free = problem_of(y, base).solve()
    assert free.base == pytest.approx([2.0, -1.0], abs=0.03)
    held = problem_of(y, base, upper=np.array([1.5, np.inf])).solve()
    assert held.base[0] == pytest.approx(1.5)
    given = np.linalg.lstsq(base[:, 1:], -y - 1.5 * base[:, 0], rcond=None)[0]
    assert held.base[1] == pytest.approx(given[0], abs=1e-3)
    assert held.cost > free.cost
    # A column beyond the model's own, whose strength would be negative, is left out.
    one = problem_of(y, base[:, :1])
    xx, xy, yy = (base.T @ base)[None], (base.T @ y)[None], np.array([y @ y])
    out = solve_bounded(one, xx, xy, yy, np.array([0.0]), np.array([np.inf]))
    assert out.held.tolist() == [True] and out.unknowns[1] == 0.0
    inside = solve_bounded(one, xx, xy, yy, np.array([-3.0]), np.array([0.0]))
    assert inside.unknowns == pytest.approx(free.base, abs=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_bounds_that_are_crossed_together_do_not_all_hold_at_the_minimum(seed):
    rng = np.random.default_rng(seed)
    base = rng.normal(size=(200, 6)) @ rng.normal(size=(6, 6))
    y = rng.normal(size=200) - base @ rng.normal(size=6)
    lower, upper = np.minimum(rng.normal(size=6) - 1.0, 0.0), 0.5
    found = problem_of(y, base, lower=lower, upper=upper).solve().base
    wanted = lsq_linear(base, -y, (lower, upper)).x
    assert np.sum((y + base @ found) ** 2) < 1.001 * np.sum((y + base @ wanted) ** 2)
    assert np.all((lower - 1e-5 < found) & (found < upper + 1e-5))


def test_what_is_taken_away_changes_the_rest_unless_another_parameter_replaces_it(line):
    y, base = line
    problem = problem_of(y, base)
    gone = solve_bounded(problem, *problem.sums(), absent={1: 0.25})
    assert gone.base[1] == pytest.approx(0.25)
    given = np.linalg.lstsq(base[:, :1], -y - 0.25 * base[:, 1], rcond=None)[0]
    assert gone.base[0] == pytest.approx(given[0], abs=1e-3)
    # Of two parameters that do the same, the trials determine the sum alone.
    both = np.array([[0.5, 0.0], [0.5, 0.0], [0.0, 1.0]])
    held = replace(problem_of(y, base), to_parameters=both)
    loose = replace(held, loose=np.array([[1.0], [-1.0], [0.0]]))
    assert loose.hold({1: -3.0})[1].shape == (2, 2)
    assert held.hold({1: -3.0})[1].shape == (2, 1)
    _, free = loose.hold({1: -3.0, 2: 0.0})
    assert free.shape == (2, 1) and free[1, 0] == pytest.approx(0.0, abs=1e-12)


def test_normal_equations_of_nothing_and_of_a_negative_eigenvalue_are_solved():
    assert solve_scaled(np.zeros((0, 0)), np.zeros(0)).shape == (0,)
    assert solve_scaled(np.zeros((0, 0)), np.zeros((0, 3))).shape == (0, 3)
    indefinite = np.array([[4.0, 10.0], [10.0, 4.0]])
    np.testing.assert_allclose(solve_scaled(indefinite, np.array([14.0, 14.0])), 1.0, rtol=1e-6)


def test_a_few_samples_that_no_replicate_has_do_not_decide_under_heavy_tails(line):
    y, base = line
    y = y.copy()
    wild = np.arange(0, 400, 40)
    y[wild] += 6.0 * np.sign(base[wild, 0])
    plain = problem_of(y, base)
    off = abs(plain.solve().base[0] - 2.0)
    problem = plain
    for _ in range(4):
        like = plain.likelihood.with_heavy_tails(problem.residual_rows(), tails=4.0)
        root = like.root[0]
        problem = replace(plain, y=(root * y,), base=(root[:, None] * base,))
    assert abs(problem.solve().base[0] - 2.0) < 0.5 * off
    calm = np.setdiff1d(np.arange(400), wild)
    assert like.root[0][wild].max() < 0.5 * like.root[0][calm].mean()


def test_what_comes_back_with_the_motion_counts_as_few_independent_samples(fitted):
    """Noise keeps its samples, white or a hum; what goes as the applied force is a few of them."""
    _, fit = fitted
    like = fit.likelihood
    forces = [f * root for f, root in zip(like.applied, like.root, strict=True)]

    def counted(left):
        return np.array([s.independent for s in like.count_independent(left, 100)])

    before = np.array([s.independent for s in like.samples])
    rows = zip(like.noise.residuals, like.noise.bias, like.root, strict=True)
    replicate = [(r[0] - b) * root for r, b, root in rows]
    assert np.all(counted(replicate) > 0.8 * before)
    assert np.all(counted([np.cos(2.5 * s.rows) for s in like.samples]) > 0.8 * before)
    assert np.all(counted(forces) < 0.3 * before)


def test_a_shape_is_found_from_a_start_far_away(record):
    """Where a step promises more than it keeps, and where no strength tells the shape."""
    trials, spec = record("bam", 8, "stribeck:extension", creep=False)
    wider = replace(spec, effects=(*spec.effects, "stribeck:extension"))
    system, start = system_of(wider), system_of(spec).prior
    known = fit_squares(trials, spec, system_of(spec), start, 2.0).p
    names = [q.name for q in system.parameters]
    for force, speed in [(3.0, 0.009), (0.0, 0.012)]:
        begun = np.array([*known[:-1], force, speed])
        found = fit_squares(trials, wider, system, begun, 2.0).p
        assert found[names.index("stribeck.extension.force")] == pytest.approx(2.45, rel=0.05)
        assert found[names.index("stribeck.extension.speed")] == pytest.approx(0.0183, rel=0.05)
