"""The filtered residual: same filter on both sides, standstill left out, parameters recovered."""

from dataclasses import replace

import numpy as np
import pytest
from physics.small_arm import ARM
from scipy.signal import butter, sosfiltfilt
from sessions import BAND, KINEMATICS, RATE, bam, folds

from bampipe.diagnosis.session import system_of
from bampipe.estimate.least_squares import residual_and_slopes
from bampipe.estimate.low_pass import Band
from bampipe.physics import Model, compile_model
from bampipe.physics.device import LAST_ORDER, derivative
from bampipe.physics.registry import device_from
from bampipe.trials.linearisation import linearise_fit
from bampipe.trials.motion import Motion, Recording
from bampipe.trials.residuals import problem_of


def test_thinning_is_that_of_the_library_with_a_cut_off_an_axis():
    band = Band(RATE, (8.0, 8.0))
    values = np.random.default_rng(0).normal(size=(3000, 2))
    sections = butter(2, 8.0, fs=RATE, output="sos")
    expected = sosfiltfilt(sections, values, axis=0)[band.thinned_rows(3000)]
    inner = slice(8, -8)
    assert np.allclose(band.thin(values)[inner], expected[inner], atol=1e-6)
    values, band = np.random.default_rng(1).normal(size=(3000, 2)), Band(RATE, (8.0, 20.0))
    both, rows = band.thin(values), band.thinned_rows(3000)
    for column, cutoff in enumerate((8.0, 20.0)):
        alone = butter(2, cutoff, fs=RATE, output="sos")
        expected = sosfiltfilt(alone, values[:, column])[rows]
        assert np.allclose(both[60:-60, column], expected[60:-60], atol=1e-6)


def test_standstill_is_left_out_and_quick_reversals_stay():
    t = np.arange(2000) / RATE
    qd = np.zeros((2000, 3))
    qd[:, 0] = np.sin(2 * np.pi * 0.5 * t)
    qd[:, 1] = np.where((t > 3.0) & (t < 4.0), 0.0, 1.0)
    qd[:, 2] = 1.0
    system = system_of(bam())
    channels = {name: np.zeros(2000) for name in system.inputs}
    motion = Motion("t01", t, qd, qd, 0.0 * qd, np.full_like(qd, 1e-3), channels)
    used = linearise_fit(system, [motion], BAND, system.prior, folds(1)).used[0]
    rows = t[BAND.thinned_rows(2000)]
    assert used[:, 0].all() and used[:, 2].all()
    assert not used[(rows > 3.1) & (rows < 3.9), 1].any()
    assert used[rows < 2.7, 1].all()


def test_forces_of_bodies_follow_a_motion_that_the_timing_of_inputs_moves():
    """Wound up by its drive, a joint is elsewhere when its torque is read at another time."""
    system = compile_model(Model(device_from(ARM), ("transmission_compliance:two",)))
    rng, count = np.random.default_rng(2), 400
    t = np.arange(count) / RATE
    q, qd, qdd = 0.3 * rng.normal(size=(3, count, 3))
    channels = {name: rng.normal(size=count) for name in channels_of(system)}
    motions = [Motion("t", t, q, qd, qdd, np.full_like(q, 1e-4), channels)]
    p = np.append(system.prior, 0.0)
    p[system.index("transmission_compliance.two.compliance")] = 0.01
    late = np.append(p[:-1], 0.3 / RATE)

    moved = problem_of(system, motions, Band(RATE, (8.0,) * 3), timing=True)
    moved.residual(0, p)
    afresh = problem_of(system, motions, Band(RATE, (8.0,) * 3), timing=True)
    np.testing.assert_array_equal(moved.residual(0, late), afresh.residual(0, late))
    assert np.abs(moved.residual(0, late) - moved.residual(0, p)).max() > 1e-3


def test_a_descent_with_a_timing_follows_the_tangent_to_the_minimum():
    """A force swings at 8 Hz and acts 4 ms late: a secant over half a sample is off by over 5 %."""
    rate = 100.0
    band, t = Band(rate, (20.0,) * 3), np.arange(2000) / rate
    system = system_of(bam(["stribeck:yaw"]))
    phase = 2.0 * np.pi * 8.0 * t[:, None] + np.arange(3)
    q, qd, qdd = 0.01 * np.sin(phase), 0.5 * np.cos(phase), -25.0 * np.sin(phase)
    channels = {name: np.zeros(len(t)) for name in system.inputs if name != "t"}
    for axis, name in enumerate(("force_x", "force_y")):
        for k in range(LAST_ORDER + 1):
            turned = np.sin(phase[:, axis] + 0.5 * np.pi * k + 1.0)
            channels[derivative(name, k)] = 8.0 * (2.0 * np.pi * 8.0) ** k * turned
    motion = Motion("t", t, q + np.array([0.0, 0.0, 0.7]), qd, qdd, np.full_like(q, 1e-4), channels)
    start = np.append(system.prior, 0.004)
    problem = problem_of(system, [motion], band, timing=True)
    _, slopes = residual_and_slopes(problem, 0, start)
    step = 1e-6
    late, early = (problem.residual(0, np.append(system.prior, 0.004 + by)) for by in (step, -step))
    tangent = (late - early) / (2.0 * step)
    assert np.abs(tangent).max() > 10.0
    np.testing.assert_allclose(slopes[:, :, -1], tangent, atol=0.05 * np.abs(tangent).max())


def channels_of(system):
    """Names of its forces and all their time derivatives."""
    forces = system.model.device.forces
    return [derivative(name, k) for name in forces for k in range(LAST_ORDER + 1)]


@pytest.mark.parametrize("method", ["kalman", "butterworth"])
def test_the_mechanism_moves_as_if_its_encoders_did_not_wind_up(method):
    """By a force that turns within a sample: no filter of the readings alone follows that."""
    kinematics = replace(KINEMATICS, method=method)
    system = system_of(bam(["transmission_compliance:yaw"]))
    values = {"transmission_compliance.yaw.compliance": 0.001}
    p = np.array([values.get(item.name, item.prior) for item in system.parameters])
    t = np.arange(2000) / RATE
    truth = np.column_stack([0.3 * np.sin(3.0 * t), 0.1 + 0.0 * t, 1.1 + 0.0 * t])
    channels = {name: np.zeros(t.size) for name in system.inputs}
    channels["force_x"] = 15.0 * np.tanh(100.0 * np.cos(3.0 * t))
    u = np.column_stack([channels[name] for name in system.inputs])
    read = truth - system.offset(truth, u, p)

    seen = kinematics.observe(Recording("t", read, channels), ("force_x",))
    wanted = kinematics.observe(Recording("t", truth, channels), ("force_x",))
    moved = seen.of_mechanism(system, u, p)

    assert np.abs(seen.qdd - wanted.qdd)[:, 0].max() > 10.0
    assert np.abs(moved.q - wanted.q).max() < 1e-8
    assert np.abs(moved.qdd - wanted.qdd).max() < 1e-4
