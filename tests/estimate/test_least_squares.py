"""Least squares on the inverse dynamics of a slider with friction."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from slider import RATE, TRUTH, record

from bampipe.errors import InputError
from bampipe.estimate.butterworth import zero_phase
from bampipe.estimate.influence import RemovedStretch, find_worst_stretch
from bampipe.estimate.least_squares import (
    Linearised,
    Problem,
    Stacked,
    as_measured,
    covariance_by_blocks,
    minimise,
    stacked_residual,
)
from bampipe.estimate.low_pass import Band
from bampipe.estimate.standstill import find_moving_samples, find_standstill

BOUNDS = (np.array([0.0, 0.0, 0.01]), np.array([np.inf, np.inf, np.inf]))


def problem(count: int = 3, truth: np.ndarray = TRUTH, **changes: object) -> Problem:
    """The slider as residuals; p = viscous, Coulomb, mass."""
    motions = []
    for seed in range(count):
        trial = record(seed, truth=truth)
        _, qd, qdd = zero_phase(trial.y[:, 0], RATE, 25.0)
        motions.append((qd, qdd, trial.u[:, 0]))

    def residual(trial: int, p: np.ndarray) -> np.ndarray:
        qd, qdd, force = motions[trial]
        return (force - p[0] * qd - p[1] * np.tanh(qd / 1e-3) - p[2] * qdd)[:, None]

    standard: dict[str, object] = {
        "residual": residual,
        "n_trials": count,
        "free": np.arange(3),
        "lower": BOUNDS[0],
        "upper": BOUNDS[1],
        "step": np.ones(3),
        "linear": True,
        "band": Band(RATE, (8.0,)),
        "standstill": [np.zeros((len(m[0]), 1), dtype=bool) for m in motions],
    } | changes
    nothing = np.zeros(len(standard["free"]))  # type: ignore[arg-type]
    return Problem(**({"precision": nothing, "known": nothing} | standard))  # type: ignore[arg-type]


def error_of(found: Linearised) -> float:
    """Root mean square of what a fit leaves."""
    left = np.concatenate([s.residual[s.used] for s in found.stacked])
    return float(np.sqrt(np.mean(left**2)))


def rows_of(
    stacked: Sequence[Stacked], block_s: float
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Slopes and residual of one axis in its standard deviations, and the blocks they are in."""
    residual = np.concatenate([s.residual[:, 0] for s in stacked])
    scale = np.sqrt(np.mean(residual**2))
    slope = np.concatenate([s.slope[:, 0] for s in stacked])
    samples = round(block_s * RATE / Band(RATE, (8.0,)).step)
    numbers = [100 * k + np.arange(len(s.residual)) // samples for k, s in enumerate(stacked)]
    return (slope / scale, residual / scale), np.concatenate(numbers)


def sd_of(found: Linearised, inner: Problem, block_s: float = 2.0) -> np.ndarray:
    """Standard deviations by blocks of time."""
    rows, blocks = rows_of([*as_measured(inner, found.p, found.stacked)], block_s)
    alone = float(inner.band.independent_share[0]) * len(blocks)
    covariance = covariance_by_blocks([rows], np.diag(inner.precision), [blocks], [alone])
    return np.sqrt(np.diag(covariance))


@pytest.mark.parametrize("factor", [0.2, 1.0, 5.0])
def test_recovers_the_truth_from_any_start(factor: float) -> None:
    found = minimise(problem(), factor * TRUTH)
    np.testing.assert_allclose(found.p, TRUTH, rtol=1e-2)


def test_gauss_newton_finds_what_is_not_linear_within_bounds() -> None:
    inner = problem()

    def residual(trial: int, p: np.ndarray) -> np.ndarray:
        return inner.residual(trial, np.exp(p))

    unbounded = np.full(3, -np.inf)
    curved = problem(residual=residual, linear=False, step=np.full(3, 1e-5), lower=unbounded)
    found = minimise(curved, np.log(2.0 * TRUTH))
    np.testing.assert_allclose(np.exp(found.p), minimise(inner, TRUTH).p, rtol=1e-5)
    truth = np.array([4.0, 0.0, 2.0])
    inside = problem(truth=truth, lower=np.array([0.0, 0.5, 0.01]))
    found = minimise(inside, TRUTH)
    assert found.p[1] == 0.5
    free = minimise(problem(truth=truth, lower=unbounded), TRUTH)
    assert error_of(found) > error_of(free)


@pytest.mark.parametrize("start", [0.1, 1.0, 8.0])
def test_a_scale_that_is_free_does_not_collapse(start: float) -> None:
    """A force read in other units: all of the equation gets small with what it is multiplied by."""
    inner = problem()
    rng = np.random.default_rng(4)
    noise = [1.5 * rng.normal(size=(len(s), 1)) for s in inner.standstill]

    def residual(trial: int, p: np.ndarray) -> np.ndarray:
        required = -inner.residual(trial, p[:3]) + inner.residual(trial, np.zeros(3))
        read = (inner.residual(trial, np.zeros(3)) + noise[trial]) / 5.0
        return p[3] * read - required

    known, precision = np.array([0.0, 0.0, 0.0, 4.0]), np.array([0.0, 0.0, 0.0, 1.0])
    scaled = {
        "residual": residual, "free": np.arange(4), "step": np.ones(4), "known": known,
        "precision": precision, "lower": np.zeros(4), "upper": np.full(4, np.inf),
    }  # fmt: skip
    free = problem(multiplied=np.array([-1, -1, -1, 0]), **scaled)
    found = minimise(free, np.append(TRUTH, start))
    # As known beforehand, and no better: the trials say nothing of it.
    np.testing.assert_allclose(found.p[3], 4.0, rtol=0.02)
    np.testing.assert_allclose(sd_of(found, free)[3], 1.0, rtol=0.03)
    np.testing.assert_allclose(found.p[:3] / found.p[3], TRUTH / 5.0, rtol=0.03)
    assert minimise(problem(**scaled), np.append(TRUTH, start)).p[3] < 0.1
    # What is made of the fit afterwards sees a minimum there, and no way down to no scale at all.
    sd = sd_of(found, free)
    assert largest_step(found, [*as_measured(free, found.p, found.stacked)], free, sd) < 1e-3
    assert largest_step(found, found.stacked, free, sd) > 1.0


def largest_step(
    found: Linearised, stacked: Sequence[Stacked], inner: Problem, sd: np.ndarray
) -> float:
    """Of Gauss and Newton from a fit of one axis, in its standard deviations."""
    scale = error_of(found)
    slope = np.concatenate([s.slope[:, 0] for s in stacked]) / scale
    residual = np.concatenate([s.residual[:, 0] for s in stacked]) / scale
    score = inner.precision * (inner.known - found.p) - slope.T @ residual
    step = np.linalg.solve(slope.T @ slope + np.diag(inner.precision), score)
    return float(np.abs(step / sd).max())


def test_parameters_held_and_trials_left_out_are_as_never_seen() -> None:
    bounds = {"lower": np.zeros(2), "upper": np.full(2, np.inf)}
    held = problem(free=np.array([0, 1]), step=np.ones(2), **bounds)
    found = minimise(held, np.array([1.0, 1.0, 2.0]))
    assert found.p[2] == 2.0
    assert found.stacked[0].slope.shape[2] == 2
    whole = problem(3)
    direct = minimise(whole, TRUTH, trials=[0, 2]).p
    stacked = [stacked_residual(whole, k, TRUTH) for k in (0, 2)]
    slope = np.concatenate([s.slope[:, 0] for s in stacked])
    residual = np.concatenate([s.residual[:, 0] for s in stacked])
    solved = TRUTH - np.linalg.lstsq(slope, residual, rcond=None)[0]
    np.testing.assert_allclose(direct, solved, rtol=1e-6)
    at = stacked_residual(problem(1), 0, TRUTH)
    moved = stacked_residual(problem(1), 0, TRUTH + np.array([0.3, -0.2, 0.1]))
    step = at.slope @ np.array([0.3, -0.2, 0.1])
    np.testing.assert_allclose(moved.residual - at.residual, step, atol=1e-9)


def test_intervals_cover_coloured_noise() -> None:
    """Noise with a memory of 0.2 s: intervals from white residuals would be far too narrow."""
    rng = np.random.default_rng(0)
    inner = problem(4)
    inside = []
    for _ in range(30):
        noise = [_coloured(rng, 4000, 0.2) for _ in range(4)]
        noisy = problem(4, residual=_with(inner.residual, noise))
        found = minimise(noisy, TRUTH)
        clean = minimise(inner, TRUTH).p
        inside.append(np.abs(found.p - clean) < 1.96 * sd_of(found, noisy))
    assert 0.8 <= np.mean(inside) <= 1.0


def test_intervals_of_fewer_blocks_than_parameters_hold() -> None:
    """Five trials of a second: their blocks cannot show the scatter of three parameters."""
    rng = np.random.default_rng(1)
    count = int(1.2 * RATE)
    whole = problem(5)

    def short(trial: int, p: np.ndarray) -> np.ndarray:
        return whole.residual(trial, p)[500 : 500 + count]

    still = [np.zeros((count, 1), dtype=bool)] * 5
    clean = minimise(problem(5, residual=short, standstill=still), TRUTH).p
    off = []
    for _ in range(60):
        noise = [rng.standard_normal(count) for _ in range(5)]
        noisy = problem(5, residual=_with(short, noise), standstill=still)
        found = minimise(noisy, TRUTH)
        off.append(np.abs(found.p - clean) / sd_of(found, noisy))
    assert 0.92 <= np.mean(np.array(off) < 1.96) <= 0.99
    assert np.max(off) < 4.0


def test_neither_the_pull_of_a_prior_nor_what_it_fixes_is_scatter() -> None:
    rng = np.random.default_rng(2)
    x, left = np.ones((400, 1)), rng.normal(size=400)
    blocks = [np.arange(400) // 20]
    alone = covariance_by_blocks([(x, left)], np.zeros((1, 1)), blocks, [400.0])
    beside, prior = np.hstack([x, rng.normal(size=(400, 1))]), np.diag([0.0, 1e12])
    pulled = covariance_by_blocks([(beside, left + 0.5)], prior, blocks, [400.0])
    assert pulled[0, 0] == pytest.approx(alone[0, 0])


def _with(
    residual: Callable[[int, np.ndarray], np.ndarray], noise: list[np.ndarray]
) -> Callable[[int, np.ndarray], np.ndarray]:
    return lambda trial, p: residual(trial, p) + noise[trial][:, None]


def _coloured(rng: np.random.Generator, count: int, memory_s: float) -> np.ndarray:
    fade = np.exp(-1.0 / (memory_s * RATE))
    out = np.zeros(count)
    for i in range(1, count):
        out[i] = fade * out[i - 1] + rng.standard_normal() * np.sqrt(1 - fade**2)
    return 0.2 * out


def test_rest_is_told_from_a_change_of_direction() -> None:
    t = np.arange(0.0, 4.0, 1.0 / RATE)
    qd = np.sin(2 * np.pi * t)[:, None]
    qd[1000:1200] = 0.0
    still = find_standstill(qd, np.full_like(qd, 1e-3), RATE)
    assert still[1001:1199].all()
    assert not still[:990].any()
    # The velocity stays within its noise for 0.16 s, and a rest of 0.1 s within the same noise.
    t = np.arange(-2.0, 2.0, 1.0 / RATE)[:, None]
    sd = np.full_like(t, 1e-3)
    turning = np.abs(0.0625 * t) < 5e-3
    assert np.sum(turning) / RATE == pytest.approx(0.16, abs=0.01)
    assert not find_standstill(0.0625 * t, sd, RATE).any()
    rests = 0.0625 * np.sign(t) * np.maximum(np.abs(t) - 0.05, 0.0)
    still = find_standstill(rests, sd, RATE)
    np.testing.assert_array_equal(still, np.abs(rests) < 5e-3)


@pytest.mark.parametrize("rate", [100.0, 1000.0])
def test_a_rest_is_seen_through_the_ringing_of_a_smoothed_velocity(rate: float) -> None:
    """It comes to rest slowly, stays for 60 ms and breaks away, which a smoother foretells."""
    t = np.arange(-1.0, 1.0, 1.0 / rate)
    slowing = np.where(t < -0.06, -np.minimum(7e-3 - 0.5 * (t + 0.06), 0.1), 0.0)
    leaving = -8.0 * np.maximum(t, 0.0)
    rings = np.where((t > -0.06) & (t < 0.0), 7.5e-3 * np.sin(2 * np.pi * (t + 0.06) / 0.04), 0.0)
    qd = (slowing + rings + leaving)[:, None]
    still = find_standstill(qd, np.full_like(qd, 1e-3), rate)[:, 0]
    middle = (t > -0.045) & (t < -0.005)
    assert still[middle].all() and not still[np.abs(t + 0.03) > 0.05].any()
    # Noise on a turn of a machine at its usual speed is no such ringing.
    rng = np.random.default_rng(1)
    turn = (2.0 * t + 1e-3 * rng.standard_normal(t.size))[:, None]
    assert not find_standstill(turn, np.full_like(turn, 1e-3), rate).any()


def test_samples_at_rest_do_not_count_unless_a_brake_may_hold_the_axis() -> None:
    """The low-passed rest passes zero there, which makes none of its friction small."""
    band = Band(RATE, (8.0,), 0.1)
    rest = np.zeros((4000, 1), dtype=bool)
    rest[2000:2016] = True
    used = find_moving_samples(rest, band)[:, 0]
    left_out = np.flatnonzero(~used)
    alone = used[1:-1] & ~used[:-2] & ~used[2:]
    assert left_out.size and not alone.any()
    t = np.arange(0.0, 2.0, 1.0 / RATE)
    qd = np.stack(2 * [np.sin(2 * np.pi * t)], axis=1)
    still = find_standstill(qd, np.full_like(qd, 1e-2), RATE, np.array([False, True]))
    assert not still[:, 0].any()
    np.testing.assert_array_equal(still[:, 1], np.abs(qd[:, 1]) < 0.1)
    assert 0.04 < still[:, 1].mean() < 0.09
    inner = problem(1)
    mask = np.zeros((4000, 1), dtype=bool)
    mask[1000:2000] = True
    spoiled = np.zeros((4000, 1))
    spoiled[1200:1800] = 50.0
    braked = problem(1, residual=lambda k, p: inner.residual(k, p) + spoiled, standstill=[mask])
    found = minimise(braked, TRUTH)
    np.testing.assert_allclose(found.p, TRUTH, rtol=2e-2)


def test_what_cannot_be_fitted_is_refused() -> None:
    inner = problem(1)
    rest = np.ones((len(inner.residual(0, TRUTH)), 1), dtype=bool)
    with pytest.raises(ValueError, match="clear of standstill"):
        minimise(problem(1, standstill=[rest]), TRUTH)
    few = {"residual": lambda k, p: inner.residual(k, p)[:220], "standstill": [~rest[:220]]}
    with pytest.raises(ValueError, match="fewer samples"):
        minimise(problem(1, **few), TRUTH)

    def lost(trial: int, p: np.ndarray) -> np.ndarray:
        return inner.residual(trial, p) + np.sqrt(5.0 - p[0])

    with np.errstate(invalid="ignore"), pytest.raises(InputError, match="no finite force"):
        minimise(problem(1, residual=lost, linear=False), np.array([6.0, 1.0, 2.0]))
    with np.errstate(invalid="ignore"), pytest.raises(InputError, match="parameter number 1, 5"):
        minimise(problem(1, residual=lost, linear=False), np.array([5.0, 1.0, 2.0]))
    run_away = problem(1, residual=lambda k, p: 1e180 * inner.residual(k, p))
    with pytest.raises(InputError, match="no finite force"):
        minimise(run_away, TRUTH)


def test_the_low_pass_ends_at_a_fifth_of_a_low_sampling_rate():
    assert Band(500.0, (8.0,)).cutoff_hz == (8.0,)
    slow = Band(20.0, (8.0,))
    assert slow.cutoff_hz == (4.0,) and slow.step == 1
    assert np.isfinite(slow.thin(np.ones((100, 1)))).all()


def test_axes_that_count_unequally_and_disagree_are_weighed_to_rest() -> None:
    """The steps minimise a cost in which each sample counts once, or they come to no end."""
    rng = np.random.default_rng(1)
    x, noise = rng.normal(size=(2000, 2)), rng.normal(size=(2000, 2))
    rest = np.zeros((2000, 2), dtype=bool)
    rest[200:, 1] = True
    force = np.array([1.0, 3.0]) * x + np.array([0.3, 2.0]) * noise

    shared = problem(
        1,
        residual=lambda trial, p: force - p[0] * x,
        free=np.array([0]), lower=np.zeros(1), upper=np.full(1, 9.0), step=np.ones(1),
        band=Band(RATE, (8.0, 8.0)), standstill=[rest],
        known=np.array([2.0]), precision=np.array([1e3]),
    )  # fmt: skip
    found = minimise(shared, np.array([5.0]))
    assert found.cost < min(found.moved(found.p + step).cost for step in (-1e-3, 1e-3))
    few = minimise(shared, np.array([5.0]), most_iterations=10)
    np.testing.assert_allclose(few.p, found.p, rtol=1e-5)


def worst_second(found: Linearised, inner: Problem) -> tuple[RemovedStretch, np.ndarray]:
    """The second of most influence on a fit of one axis, and its standard deviations."""
    (slope, left), seconds = rows_of(found.stacked, 1.0)
    sd, inverse = sd_of(found, inner), np.linalg.inv(slope.T @ slope)
    places = {int(k): (int(k) // 100, inner.band.margin_s + k % 100) for k in np.unique(seconds)}
    return find_worst_stretch([(slope @ inverse, left)], [seconds], places, sd), sd


def test_the_second_with_a_transient_is_found() -> None:
    inner = problem(3)
    bump = np.zeros(inner.standstill[1].shape)
    first = int(4.5 * RATE)
    bump[first : first + int(0.3 * RATE)] = 30.0
    hit = problem(3, residual=lambda k, p: inner.residual(k, p) + (k == 1) * bump)
    found = minimise(hit, TRUTH)
    worst, sd = worst_second(found, hit)
    assert worst.trial == 1
    assert worst.start_s <= 4.65 < worst.start_s + 1.0
    # Where the fit without the bump is; the scatter of a sandwich is all the bump's, and hides it.
    clean = (minimise(inner, TRUTH).p - found.p) / sd
    assert np.all(np.abs(clean) < 1.0)
    np.testing.assert_array_equal(np.sign(worst.move), np.sign(clean))
    place = int(np.argmax(np.abs(worst.move)))
    assert abs(worst.move[place]) > max(2.0, 6.0 * worst.typical[place])
    undisturbed, _ = worst_second(minimise(inner, TRUTH), inner)
    assert np.all(np.abs(undisturbed.move) < 6.0 * undisturbed.typical)
