"""Derivatives of quantised motions: right, within their error bands, and sound at the ends."""

import numpy as np
import pytest

from bampipe.arrays import Array
from bampipe.estimate import butterworth, kalman_smoother
from bampipe.estimate.differentiation import Derivatives, spline_curvature, uniform_grid
from bampipe.trials.motion import TIMING_ORDERS, Motion, input_derivatives

RATE = 500.0
RESOLUTION = 5e-5
NOISE_SD = RESOLUTION / np.sqrt(12.0)
METHODS = ("kalman", "butterworth")


def motion(seed: int, seconds: float = 8.0) -> tuple[Array, Array, Array]:
    """Return position, velocity and acceleration of a sum of sines up to 4 Hz, cut anywhere."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * RATE)) / RATE
    x = np.zeros((3, len(t)))
    for frequency in rng.uniform(0.1, 4.0, 8):
        w, phase = 2 * np.pi * frequency, rng.uniform(0, 2 * np.pi)
        size = 0.3 / (1.0 + frequency**2)
        x[0] += size * np.sin(w * t + phase)
        x[1] += size * w * np.cos(w * t + phase)
        x[2] -= size * w**2 * np.sin(w * t + phase)
    return x[0], x[1], x[2]


def quantised(position: Array) -> Array:
    """Return what the encoder reads."""
    return np.round(position / RESOLUTION) * RESOLUTION


def differentiate(method: str, position: Array, cutoff_hz: float = 40.0) -> Derivatives:
    """Return the motion by ``method``, all with the same bandwidth."""
    if method == "butterworth":
        return butterworth.smooth(position, RATE, cutoff_hz, NOISE_SD)
    ratio = kalman_smoother.ratio_for(cutoff_hz, 3, RATE)
    return kalman_smoother.smooth(position, kalman_smoother.MotionModel(3, NOISE_SD, ratio, RATE))


def fitted(position: Array) -> Derivatives:
    """Return the motion by the Kalman smoother of the greater likelihood."""
    seen = np.ones(len(position), dtype=bool)
    fits = [
        kalman_smoother.maximum_likelihood(
            [(position, seen)], RATE, RESOLUTION, order=order, bandwidth_limits_hz=(3.0, 100.0)
        )
        for order in kalman_smoother.ORDERS
    ]
    best, _ = max(fits, key=lambda fit: fit[1])
    return kalman_smoother.smooth(position, best)


def coverage(found: Derivatives, truth: tuple[Array, Array, Array]) -> list[float]:
    """Return the share of samples within 2 sd, for position, velocity and acceleration."""
    values = (found.position, found.velocity, found.acceleration)
    bands = (found.position_sd, found.velocity_sd, found.acceleration_sd)
    return [
        float(np.mean(np.abs(value - true) < 2.0 * band))
        for value, true, band in zip(values, truth, bands, strict=True)
    ]


def test_bands_of_the_fitted_smoother_are_neither_too_narrow_nor_too_wide() -> None:
    shares, spread = [], []
    for seed in range(6):
        truth = motion(seed)
        found = fitted(quantised(truth[0]))
        shares.append(coverage(found, truth))
        error = found.velocity - truth[1]
        spread.append(np.sqrt(np.mean(error**2) / np.mean(found.velocity_sd**2)))
    assert np.all(np.mean(shares, axis=0) > 0.92)
    assert 0.5 < np.mean(spread) < 1.2


@pytest.mark.parametrize("method", ["fitted", *METHODS])
def test_ends_are_not_wild(method: str) -> None:
    """In the first and last 0.1 s the errors are a few bands, and small against the motion."""
    ends = np.r_[0:50, -50:0]
    for seed in range(6):
        truth = motion(seed)
        position = quantised(truth[0])
        found = fitted(position) if method == "fitted" else differentiate(method, position)
        for value, true, band in (
            (found.velocity, truth[1], found.velocity_sd),
            (found.acceleration, truth[2], found.acceleration_sd),
        ):
            error = np.abs(value - true)[ends]
            assert np.max(error / band[ends]) < 6.0
            assert np.max(error) < 0.3 * np.std(true)
            assert np.max(band) < 20.0 * np.median(band)


@pytest.mark.parametrize("method", METHODS)
def test_a_parabola_is_kept_to_its_ends(method: str) -> None:
    t = np.arange(1500) / RATE
    found = differentiate(method, 0.3 - 0.4 * t + 1.5 * t**2)
    np.testing.assert_allclose(found.velocity, -0.4 + 3.0 * t, atol=2e-3)
    np.testing.assert_allclose(found.acceleration, 3.0, atol=0.1)


@pytest.mark.parametrize("method", METHODS)
def test_half_of_the_amplitude_at_the_cut_off(method: str) -> None:
    """The bandwidth means the same for both."""
    t = np.arange(4000) / RATE
    found = differentiate(method, np.sin(2 * np.pi * 25.0 * t), 25.0)
    gain = np.sqrt(2.0) * np.std(found.position[500:-500])
    assert gain == pytest.approx(0.5, abs=0.05)


def test_error_bands_are_the_scatter_of_filtered_noise() -> None:
    rng = np.random.default_rng(0)
    found = butterworth.smooth(np.zeros(400), RATE, 25.0, 1.0)
    draws = [butterworth.zero_phase(rng.standard_normal(400), RATE, 25.0) for _ in range(800)]
    measured = np.std(np.array(draws), axis=0)
    for value, band in zip(
        measured, (found.position_sd, found.velocity_sd, found.acceleration_sd), strict=True
    ):
        np.testing.assert_allclose(value, band, rtol=0.15)


class TestUniformGrid:
    """Time stamps as they come."""

    def test_exact_stamps_are_left_alone(self) -> None:
        t = np.arange(100) / RATE + 3.0
        grid = uniform_grid(t, RATE)
        assert grid.exact and not grid.bridged.any()
        np.testing.assert_array_equal(grid.resample(np.sin(t)), np.sin(t))

    def test_jitter_and_a_gap(self) -> None:
        rng = np.random.default_rng(0)
        t = np.arange(1000) / RATE + rng.uniform(-3e-4, 3e-4, 1000)
        t = np.delete(t, np.arange(400, 440))
        grid = uniform_grid(t, RATE)
        np.testing.assert_allclose(np.diff(grid.t), 1.0 / RATE)
        assert grid.t[0] == t[0]
        assert 37 <= grid.bridged.sum() <= 40
        nearest = (grid.t + grid.stamp_offset)[~grid.bridged, None]
        assert np.abs(nearest - t).min(axis=1).max() < 1e-12
        assert np.max(np.abs(grid.stamp_offset) * RATE + grid.bridged) <= 1.0
        signal = np.sin(2 * np.pi * 2.0 * t)
        error = np.abs(grid.resample(signal) - np.sin(2 * np.pi * 2.0 * grid.t))
        assert np.max(error[~grid.bridged]) < 5e-4

    def test_jitter_leaves_fast_motion_as_it_is(self) -> None:
        """Eight samples a period, as of a damper shaken at 60 Hz and recorded at 500."""
        rng = np.random.default_rng(1)
        t = np.cumsum((1.0 + 0.14 * rng.standard_normal(2000)) / RATE)
        turn = 2 * np.pi * RATE / 8.0
        grid = uniform_grid(t, RATE)
        error = grid.resample(np.sin(turn * t)) - np.sin(turn * grid.t)
        assert np.std(error[20:-20]) < 2e-3

    def test_stamps_that_nearly_coincide_do_not_throw_the_rest(self) -> None:
        rng = np.random.default_rng(2)
        t = np.arange(400) / RATE
        t[1::7] = t[0::7][: len(t[1::7])] + 1e-7
        noise = rng.standard_normal(len(t))
        grid = uniform_grid(t, RATE)
        assert np.max([np.std(grid.resample(noise, jumps)) for jumps in (False, True)]) < 1.2

    def test_a_command_is_held_between_stamps_that_increase(self) -> None:
        t = np.array([0.0, 0.002, 0.0041, 0.008, 0.010])
        held = uniform_grid(t, RATE).hold(np.array([0.0, 1.0, 2.0, 3.0, 4.0]))
        np.testing.assert_array_equal(held, [0.0, 1.0, 1.0, 2.0, 3.0, 4.0])
        with pytest.raises(ValueError, match="increase"):
            uniform_grid(np.array([0.0, 0.002, 0.002]), RATE)


@pytest.mark.parametrize("cutoff", [0.0, 250.0])
def test_cut_off_out_of_range(cutoff: float) -> None:
    with pytest.raises(ValueError, match="cut-off"):
        butterworth.zero_phase(np.zeros(100), RATE, cutoff)


def test_curvature_of_inputs_is_that_of_splines_which_end_at_gaps() -> None:
    rng = np.random.default_rng(3)
    t = np.delete(np.arange(400) * 0.01, slice(200, 230)) + rng.uniform(-1e-3, 1e-3, 370)
    values = np.column_stack([np.sin(9.0 * t), np.cos(5.0 * t)])
    found = spline_curvature(t, values)
    inside = np.r_[8:192, 208:362]  # the ends of a natural spline are straight
    np.testing.assert_allclose(found[inside, 0], -81.0 * values[inside, 0], atol=0.5)
    np.testing.assert_allclose(found[inside, 1], -25.0 * values[inside, 1], atol=0.1)
    np.testing.assert_allclose(found[[0, 199, 200, -1]], 0.0, atol=1e-9)
    assert not spline_curvature(t[:2], values[:2]).any()


def test_inputs_move_by_half_a_sample_up_to_the_highest_frequency_of_a_residual():
    rate, cutoff = 100.0, 40.0
    t = np.arange(400) / rate
    inner = slice(60, -60)
    for frequency, error in ((5.0, 1e-3), (10.0, 2e-3), (20.0, 1.2e-2)):
        w = 2.0 * np.pi * frequency
        found = butterworth.rates(np.sin(w * t), rate, cutoff, 6)
        np.testing.assert_allclose(found[0][inner], w * np.cos(w * t)[inner], atol=0.005 * w)
        names = input_derivatives("f")[:TIMING_ORDERS]
        channels = {"f": np.sin(w * t), **dict(zip(names, found, strict=False))}
        motion = Motion("t", t, *[np.zeros((len(t), 1))] * 4, channels)
        late_s = 0.5 / rate
        moved = motion.with_input_timing(late_s)
        true = np.sin(w * (t - late_s))
        np.testing.assert_allclose(moved.channels["f"][inner], true[inner], atol=error)
