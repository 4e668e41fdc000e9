"""The filtered residual: same filter on both sides, standstill left out, parameters recovered."""

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt
from sessions import RATE, SENSORS, TRUTH, bam, made

from bampipe.discover.chance import system_of
from bampipe.discover.evidence import fit, told, velocity_sd
from bampipe.estimate.low_pass import Band
from bampipe.trials.observation import Motion


def test_thinning_equals_the_library_filter_away_from_the_ends():
    band = Band(RATE)
    values = np.random.default_rng(0).normal(size=(3000, 2))
    sections = butter(2, band.cutoff_hz, fs=RATE, output="sos")
    expected = sosfiltfilt(sections, values, axis=0)[band.kept(3000)]
    inner = slice(8, -8)
    assert np.allclose(band.thin(values)[inner], expected[inner], atol=1e-6)


def test_parameters_come_back_from_a_replayed_session():
    session = made(bam(), {}, trials=3)
    system = system_of(bam())
    found = fit(system, session.motions, session.sensors, session.band, system.prior)
    for parameter, value in zip(system.parameters, found.p, strict=True):
        assert value == pytest.approx(TRUTH[parameter.name], rel=0.02), parameter.name


def test_standstill_is_left_out_and_quick_reversals_stay():
    t = np.arange(2000) / RATE
    qd = np.zeros((2000, 3))
    qd[:, 0] = np.sin(2 * np.pi * 0.5 * t)
    qd[:, 1] = np.where((t > 3.0) & (t < 4.0), 0.0, 1.0)
    qd[:, 2] = 1.0
    motion = Motion("t01", t, qd, qd, qd, {})
    used = told(motion, SENSORS, Band(RATE))
    kept_t = t[Band(RATE).kept(2000)]
    assert used[:, 0].all() and used[:, 2].all()
    assert not used[(kept_t > 3.1) & (kept_t < 3.9), 1].any()
    assert used[kept_t < 2.7, 1].all()
    assert np.all(velocity_sd(SENSORS) > 0)
