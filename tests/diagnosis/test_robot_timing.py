"""The timing of a robot's inputs, whatever one drive lacks and friction does where joints turn."""

from dataclasses import replace

import numpy as np
import pytest

from bampipe.estimate.low_pass import Band
from bampipe.estimate.standstill import find_turns
from bampipe.physics import Model, System, compile_model
from bampipe.physics.device import LAST_ORDER, derivative
from bampipe.physics.registry import device_from
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import ModelOnTrial, find_robot_timing
from tests.physics.small_arm import ARM

RATE = 250.0
HERTZ = np.array([[0.31, 0.73, 1.1], [0.37, 0.61, 1.3], [0.23, 0.83, 0.97]])
SIZE = np.array([0.8, 0.3, 0.1])
DRY = 2.0
CLOCK_S = 1.5e-3


@pytest.fixture(scope="module")
def system() -> System:
    return compile_model(Model(device_from(ARM), []))


def moved(t: np.ndarray) -> Motion:
    w = 2.0 * np.pi * HERTZ
    phase = t[:, None, None] * w + np.arange(9.0).reshape(3, 3)
    q, qd, qdd = (
        np.sum(SIZE * part, axis=2)
        for part in (np.sin(phase), w * np.cos(phase), -(w**2) * np.sin(phase))
    )
    nothing = dict.fromkeys("abc", np.zeros(len(t)))
    return Motion("t", t=t, q=q, qd=qd, qdd=qdd, qd_sd=np.full((1, 3), 1e-4), channels=nothing)


def logged(system: System, late_s: np.ndarray, stuck_s: float = 0.0) -> Motion:
    """A trial whose drives act ``late_s`` after their log, (3,), and friction after the motion."""
    t = np.arange(0.0, 20.0, 1.0 / RATE)
    forces = {}
    for k, name in enumerate("abc"):
        there = moved(t + late_s[k])
        needed = -ModelOnTrial(system, system.prior, [there]).residual[:, k]
        before = moved(t + late_s[k] - stuck_s).qd[:, k]
        forces[name] = needed + DRY * (np.sign(before) - np.sign(there.qd[:, k]))
    rng = np.random.default_rng(1)
    channels = {}
    for name, x in forces.items():
        channels[name] = x + 0.01 * rng.standard_normal(len(t))
        for order in range(1, LAST_ORDER + 1):  # as the filter finds them, without the noise
            x = np.gradient(x, t)
            channels[derivative(name, order)] = x
    return replace(moved(t), channels=channels)


@pytest.mark.parametrize("late_drive", [None, 0, 2])
@pytest.mark.parametrize("stuck_s", [0.0, 0.02])
def test_the_clock_is_what_most_drives_agree_on(system, late_drive, stuck_s) -> None:
    late = np.full(3, CLOCK_S)
    if late_drive is not None:
        late[late_drive] += 9e-3
    motion = logged(system, late, stuck_s)
    band = Band(RATE, (8.0, 8.0, 8.0))
    found, sd = find_robot_timing(system, [motion], band, system.prior)
    assert sd < 3e-4
    assert found == pytest.approx(CLOCK_S, abs=4.0 * sd)


def test_drives_with_a_delay_of_their_own_do_not_tell_the_clock() -> None:
    named = ("drive_delay:a", "drive_delay:b")
    system = compile_model(Model(device_from(ARM), named))
    late = np.array([9e-3, 9e-3, CLOCK_S])
    motion = logged(compile_model(Model(device_from(ARM), [])), late)
    p = system.prior
    for name in named:
        p[system.index(f"{name.replace(':', '.')}.delay")] = late[0]
    assert system.has_free_delay and not system.takes_timing
    # Two of three are 9 ms late, of which the model says so.
    found, sd = find_robot_timing(system, [motion], Band(RATE, (8.0, 8.0, 8.0)), p)
    assert found == pytest.approx(CLOCK_S, abs=4.0 * sd)
    system = compile_model(Model(device_from(ARM), [f"drive_delay:{name}" for name in "abc"]))
    assert system.takes_timing
    motion = logged(compile_model(Model(device_from(ARM), [])), np.full(3, CLOCK_S))
    found, sd = find_robot_timing(system, [motion], Band(RATE, (8.0, 8.0, 8.0)), system.prior)
    assert (found, sd) == (0.0, np.inf)


def test_turns_reach_30_ms_to_either_side() -> None:
    qd = np.column_stack([np.linspace(-1.0, 1.0, 101) + 1e-3, np.ones(101)])
    turns = find_turns(qd, 100.0)
    assert np.flatnonzero(turns[:, 0]).tolist() == list(range(46, 54))
    assert not turns[:, 1].any()
