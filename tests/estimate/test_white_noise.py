"""White noise is distinguished from mains hum, fast signals and coarse quantisation."""

from dataclasses import replace

import numpy as np
import pytest

from bampipe.estimate.spectral_lines import remove_mains
from bampipe.estimate.white_noise import slow_noise_sd, white_noise_sd
from bampipe.trials.sensors import RecordNoise, settle_force


@pytest.mark.parametrize("rate_hz", [94.0, 250.0, 1000.0])
@pytest.mark.parametrize("hum", [0.0, 3.0, 10.0])
@pytest.mark.parametrize("jitter", [0.0, 0.02])
def test_a_hum_is_no_white_noise(rate_hz, hum, jitter):
    """Mains at 50 Hz and its third harmonic, so many times the noise, aliased or not."""
    rng = np.random.default_rng(1)
    t = (np.arange(3000) + jitter * rng.normal(size=3000)) / rate_hz
    motion = 5.0 * np.sin(4.4 * t) + 2.0 * np.sin(13.0 * t)
    mains = np.sin(100.0 * np.pi * t + 1.0) + 0.2 * np.sin(300.0 * np.pi * t)
    record = motion + 0.02 * (rng.normal(size=t.size) + hum * mains)
    assert white_noise_sd(record, t) == pytest.approx(0.02, rel=0.2)
    assert not slow_noise_sd(record, t) > 0.03


def test_a_fast_signal_or_a_smoothing_sensor_is_told_from_noise():
    """A stroke of noise up to 60 Hz beside smooth ones, as dampers are tested with."""
    rng = np.random.default_rng(2)
    t = np.arange(5000) / 500.0
    smooth = 50.0 * np.sin(8.0 * t)
    tones = np.arange(1.0, 60.0, 0.1)
    fast = np.sin(np.outer(t, 2.0 * np.pi * tones) + rng.uniform(0.0, 6.0, tones.size)).sum(axis=1)
    signals = (smooth, smooth + 20.0 * fast, smooth, smooth + 20.0 * fast)
    records = [RecordNoise.of(signal + rng.normal(size=t.size), t) for signal in signals]
    assert records[1].slow_sd > 10.0
    found = settle_force("force", "N", None, records)
    assert found.noise_sd == pytest.approx(1.0, rel=0.15)
    rng = np.random.default_rng(3)
    t = np.arange(20000) / 1000.0
    smoothed = np.convolve(rng.normal(size=t.size), np.ones(10) / 10.0, "same")
    record = RecordNoise.of(np.sin(3.0 * t) + smoothed, t)
    assert settle_force("force", "N", None, [record]).noise_sd == pytest.approx(0.316, rel=0.1)
    assert settle_force("force", "N", record.white_sd, [record]).noise_sd == record.white_sd


def test_the_noise_of_short_trials_is_not_underestimated():
    rng, t = np.random.default_rng(5), np.arange(900) / 90.0
    trials = [RecordNoise.of(rng.normal(size=900), t) for _ in range(100)]
    sessions = [trials[k : k + 4] for k in range(0, 100, 4)]
    found = [settle_force("force", "N", None, session).noise_sd for session in sessions]
    assert np.mean(found) == pytest.approx(1.0, abs=0.015)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.4, 0.8, 2.0])
def test_noise_of_a_record_in_counts(noise):
    """In steps, and their rounding counts; a median of whole counts alone is off by up to 30 %."""
    rng = np.random.default_rng(4)
    t = np.arange(6000) / 500.0
    smooth = 180.0 * np.sin(3.0 * t) + 60.0 * np.sin(7.0 * t + 1.0)
    found = RecordNoise.of(np.round(smooth + noise * rng.normal(size=t.size)), t)
    assert found.step == 1.0
    assert found.white_sd == pytest.approx(np.hypot(noise, 1.0 / np.sqrt(12.0)), rel=0.15)


@pytest.mark.parametrize("read_noise", [0.0, 0.01])
def test_what_a_controller_makes_of_counts_is_no_noise(read_noise):
    """Gains on counts and their differences, two samples late; a load that knows nothing of it."""
    rng = np.random.default_rng(3)
    t = np.arange(6000) / 500.0
    counts = np.floor((np.sin(4.4 * t) + 0.3 * np.sin(11.0 * t)) / 4e-4) * 4e-4
    wanted = 60.0 * counts + 1500.0 * np.diff(counts, prepend=counts[0])
    command = 80.0 * np.sin(4.0 * t) - np.roll(wanted, 2) + read_noise * rng.normal(size=t.size)
    load = 3.0 * np.sin(5.0 * t) + 0.05 * rng.normal(size=t.size)
    found = RecordNoise.of_inputs({"command": command, "load": load}, [counts], t)
    assert RecordNoise.of(command, t).white_sd > 0.1
    assert found["command"].white_sd == pytest.approx(read_noise, rel=0.2, abs=1e-3)
    assert found["load"] == RecordNoise.of(load, t)


def test_pulses_of_a_controller_whose_log_keeps_every_fourth_sample_are_noise():
    """A slow motion gives a pulse now and then, of which a median sees nothing."""
    rng = np.random.default_rng(6)
    t = np.arange(24000) / 1000.0
    wanted = 0.3 * np.sin(1.4 * t) + 0.1 * np.sin(3.3 * t)
    counts = np.floor(wanted / 1.5e-3) * 1.5e-3
    smooth = 60.0 * (0.01 * np.sin(1.4 * t + 0.3)) - 3.0 * np.gradient(wanted, t)
    pulses = 3.0 * (np.gradient(wanted, t) - 1000.0 * np.diff(counts, prepend=counts[0]))
    command = smooth + pulses + 0.02 * rng.normal(size=t.size)
    every, few = command[::4], slice(None, None, 4)
    found = RecordNoise.of_inputs({"command": every}, [counts[few]], t[few])["command"]
    assert RecordNoise.of(every, t[few]).white_sd < 0.3 * pulses.std()
    # Half of it follows the reading at the same instant.
    assert found.white_sd == pytest.approx(pulses.std() / np.sqrt(2.0), rel=0.15)
    calm = replace(found, white_sd=0.1 * found.white_sd)
    settled = settle_force("command", "N.m", None, [found, calm, calm]).noise_sd
    assert settled == pytest.approx(found.white_sd * np.sqrt(1.02 / 3.0))
    whole = RecordNoise.of_inputs({"command": command}, [counts], t)["command"]
    assert whole.white_sd == pytest.approx(0.02, rel=0.1)


NOISE = 0.02


def _signal(t, rng):
    """Weight and dry friction along a hand's motion."""
    tones, phases = rng.uniform(1.0, 13.0, 6), rng.uniform(0.0, 6.0, 6)
    moved = np.sin(np.outer(t, tones) + phases).sum(axis=1)
    return 5.0 * np.sin(4.4 * t) + 2.0 * np.tanh(30.0 * moved)


@pytest.mark.parametrize(
    ("rate_hz", "jitter"), [(94.0, 0.02), (250.0, 0.0), (500.0, 0.0), (5000.0, 0.0)]
)
def test_mains_and_their_third_harmonic_are_taken_off(rate_hz, jitter):
    rng = np.random.default_rng(1)
    t = (np.arange(int(16.0 * rate_hz)) + jitter * rng.normal(size=int(16.0 * rate_hz))) / rate_hz
    sound = _signal(t, rng) + NOISE * rng.normal(size=t.size)
    mains = 2.0 * np.pi * 50.013 * t
    hum = 10.0 * NOISE * (np.sin(mains + 1.0) + 0.2 * np.sin(3.0 * mains))
    clear, found = remove_mains(sound + hum, t)
    assert found[50.0] == pytest.approx(10.0 * NOISE, rel=0.05)
    assert np.std(clear - sound) < 0.2 * np.std(hum)


@pytest.mark.parametrize("rate_hz", [94.0, 500.0, 1000.0])
def test_without_hum_a_record_stays_as_it_is(rate_hz):
    """Nor are the lines of friction along a test machine's sine a hum, or a motion at 50 Hz."""
    rng = np.random.default_rng(2)
    t = np.arange(int(16.0 * rate_hz)) / rate_hz
    noise = NOISE * rng.normal(size=t.size)
    periodic = 2.0 * np.tanh(30.0 * np.sin(2.0 * np.pi * 2.0 * t))
    for record in (_signal(t, rng) + noise, periodic + noise, noise[:100]):
        clear, found = remove_mains(record, t[: record.size])
        assert not found
        np.testing.assert_array_equal(clear, record)
    shaken = np.sin(2.0 * np.pi * 50.0 * t + 0.3) + noise
    assert not remove_mains(3.0 * shaken, t, moving=[shaken])[1]
