"""Mains hum is taken off a record, and nothing else is."""

import numpy as np
import pytest

from bampipe.estimate.spectral_lines import remove_mains

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
