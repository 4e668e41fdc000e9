"""Forward simulation on a mass with friction whose answers are known by hand."""

import numpy as np
import pytest
from numba import njit, types

from bampipe.errors import InputError
from bampipe.estimate.simulation import Arm, make_plant, simulate

WIDTH = np.array([2.5e-4])


@njit(types.void(*[types.float64[::1]] * 5), error_model="numpy")
def slider(x, u, p, w, dx):
    """A mass; u: force, brake, force rate; p: mass, viscous, Coulomb."""
    dx[0] = x[1]
    drag = p[1] * x[1] + (p[2] + u[1]) * np.tanh(x[1] / 2.5e-4)
    dx[1] = (u[0] + w[0] - drag) / p[0]


def run(u, p, v0=0.0, **options):
    plant = make_plant(np.array(p), 1, WIDTH, **options)
    return simulate(slider, plant, np.array([0.0, v0]), u, 0.002)[0]


def test_friction_decays_stops_and_holds():
    x = run(np.zeros((1001, 3)), [2.0, 3.0, 0.0], v0=1.0)
    t = 0.002 * np.arange(1001)
    np.testing.assert_allclose(x[:, 1], np.exp(-1.5 * t), rtol=1e-9)
    p = [3.5, 0.0, 3.5]
    u = np.zeros((2001, 3))
    u[:, 0] = 0.9 * 3.5 * (np.arange(2001) > 1000)
    x = run(u, p, v0=0.5)
    assert x[250, 1] == pytest.approx(0.0, abs=2.5e-4)
    assert x[200, 0] == pytest.approx(0.5 * 0.4 - 0.5 * 0.4**2, rel=1e-3)
    assert np.abs(x[1010:, 1]).max() < 5e-4  # creeps within the smoothing, does not slide


def test_a_smooth_force_keeps_its_strength_between_coarse_samples():
    frequency, force, mass = 2 * np.pi * 10.0, 5.0, 2.0
    t = 0.01 * np.arange(301)
    u = np.zeros((len(t), 3))
    u[:, 0] = force * np.cos(frequency * t)
    speed = force / mass / frequency * np.sin(frequency * t)
    plant = make_plant(np.array([mass, 0.0, 0.0]), 1, WIDTH)

    def moved(**options):
        x, _ = simulate(slider, plant, np.zeros(2), u, 0.01, **options)
        return speed @ x[:, 1] / (speed @ speed)

    assert moved() == pytest.approx(np.sinc(0.1) ** 2, abs=1e-3)
    assert moved(smooth=[0]) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("brake", [60.0, 600.0])
def test_a_strong_brake_stays_stable(brake):
    u = np.zeros((1001, 3))
    u[:, 0] = 30.0 * np.sin(2 * np.pi * 0.002 * np.arange(1001))
    u[:, 1] = brake
    x = run(u, [3.5, 10.0, 3.5], v0=0.3)
    assert np.isfinite(x).all()
    assert np.abs(x[100:, 1]).max() < 2.5e-4


def test_step_length_does_not_change_the_answer_and_growth_is_reported():
    rng = np.random.default_rng(1)
    t = 0.002 * np.arange(3000)
    u = np.zeros((3000, 3))
    u[:, 0] = 8 * np.sin(np.outer(t, rng.uniform(1, 10, 5)) + rng.uniform(0, 6, 5)).sum(axis=1)
    coarse, fine = run(u, [3.5, 10.0, 3.5]), run(u, [3.5, 10.0, 3.5], max_step=2e-5)
    assert np.abs(coarse - fine).max() < 2e-4
    with pytest.raises(InputError, match="without bounds after"):
        run(np.zeros((3000, 3)), [1.0, -800.0, 0.0], v0=1.0)


T = 0.002 * np.arange(4000)
WANTED = 0.15 * np.sin(2 * np.pi * 0.4 * T)[:, None]


def recording(**options):
    """A stick-slip motion and the force that made it."""
    rate = np.gradient(WANTED, T, axis=0)
    return track(np.zeros((4000, 3)), [3.5, 10.0, 3.5], WANTED, rate, **options)


def track(u, p, q_ref, qd_ref, rate=(), **options):
    start, plant = np.array([q_ref[0, 0], qd_ref[0, 0]]), make_plant(np.array(p), 1, WIDTH)
    arm = Arm(q_ref, qd_ref, [0], rate)
    return simulate(slider, plant, start, u, 0.002, arm=arm, **options)


def test_the_arm_follows_the_motion_it_wants_and_its_force_gives_it_again():
    x, u = recording()
    assert np.abs(x[:, 0] - WANTED[:, 0]).max() < 0.05
    assert np.abs(u[:, 0]).max() > 3.5
    again, _ = simulate(slider, make_plant(np.array([3.5, 10.0, 3.5]), 1, WIDTH), x[0], u, 0.002)
    np.testing.assert_allclose(again, x, atol=1e-12)
    again, total = track(u, [3.5, 10.0, 3.5], x[:, :1], x[:, 1:])
    np.testing.assert_allclose(again, x, atol=1e-9)
    np.testing.assert_allclose(total, u, atol=1e-6)
    again, total = track(u, [3.5, 10.0, 4.5], x[:, :1], x[:, 1:])
    assert np.abs(again[:, 0] - x[:, 0]).max() < 0.01
    moving = np.abs(x[:, 1]) > 0.1
    extra = (total[:, 0] - u[:, 0])[moving] * np.sign(x[moving, 1])
    assert np.median(extra) == pytest.approx(1.0, abs=0.15)  # the arm supplies the added friction


def test_the_rate_of_the_arm_force_is_its_rate():
    _, u = recording(rate=[2])
    np.testing.assert_allclose(u[2:-2, 2], np.gradient(u[:, 0], T)[2:-2], atol=2.0)


def test_brakes_render_the_damping():
    x, u = recording(brake=[1], brake_gain=np.full((4000, 1), 40.0))
    late = np.abs(np.interp(T - 0.011, T, x[:, 1]))
    np.testing.assert_allclose(u[500:, 1], 40 * late[500:], atol=0.5)
