"""White noise of a record is found beside what else is in it."""

from __future__ import annotations

import numpy as np
import pytest

from bampipe.estimate.white_noise import white_noise_sd


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
