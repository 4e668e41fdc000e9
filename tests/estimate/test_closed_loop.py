"""A mass on a proportional controller against the solutions known by hand."""

import numpy as np
import pytest
from slider import argument

from bampipe.errors import InputError
from bampipe.estimate.closed_loop import simulate_controlled
from bampipe.estimate.simulation import make_plant
from bampipe.model_functions import COMMAND, DERIVATIVE, MEASURE

MASS, STIFFNESS, DAMPING = 2.0, 800.0, 8.0
DT, WIDTH = 0.002, np.array([1e-3])


@argument(DERIVATIVE.signature, error_model="numpy")
def derivative(x, u, p, w, dx):
    dx[0] = x[1]
    dx[1] = (u[0] + w[0]) / p[0]


@argument(MEASURE.signature)
def measure(x, u, p, y):
    y[0] = x[0] + p[1] * u[0]
    y[1] = x[1]


@argument(COMMAND.signature)
def command(y, r, none, out):
    out[0] = min(max(r[1] * (r[0] - y[0]) - 8.0 * y[1], -r[2]), r[2])


def run(count: int, start: float, limit: float = 1e9, compliance: float = 0.0, rate: float = 1e6):
    r = np.tile([0.0, STIFFNESS, limit], (count, 1))
    return simulate_controlled(
        derivative, measure, command, make_plant(np.array([MASS, compliance]), 1, WIDTH),
        np.array([start, 0.0]), np.full((count, 1), 7.0), r, DT, force=[0], rate_hz=rate,
    )  # fmt: skip


def test_a_fast_controller_is_a_spring_and_a_damper():
    x, u, seen = run(501, 0.01)
    t = DT * np.arange(501)
    decay = DAMPING / (2.0 * MASS)
    ringing = np.sqrt(STIFFNESS / MASS - decay**2)
    known = (
        0.01 * np.exp(-decay * t) * (np.cos(ringing * t) + decay / ringing * np.sin(ringing * t))
    )
    np.testing.assert_allclose(x[:, 0], known, atol=1e-6)
    np.testing.assert_allclose(seen, x)
    np.testing.assert_allclose(u[:, 0], -STIFFNESS * x[:, 0] - DAMPING * x[:, 1], atol=1e-9)


def test_a_controller_is_late_saturates_and_sees_its_encoders():
    """Late by h/2, the spring takes damping away: k h / 2."""
    coarse = run(501, 0.01, rate=1.0 / DT)[0]
    fine = run(501, 0.01)[0]
    lost = STIFFNESS * DT / 2.0 / (2.0 * MASS)
    at = np.arange(0, 501, 5)
    size = [np.hypot(x[at, 0], x[at, 1] / np.sqrt(STIFFNESS / MASS)) for x in (coarse, fine)]
    grown = np.polyfit(DT * at, np.log(size[0] / size[1]), 1)[0]
    assert grown == pytest.approx(lost, rel=0.1)
    x, u, _ = run(51, 1.0, limit=3.0)
    assert np.all(u == -3.0)
    np.testing.assert_allclose(x[-1, 0], 1.0 - 0.5 * 3.0 / MASS * (50 * DT) ** 2, rtol=1e-9)
    x, u, seen = run(501, 0.01, compliance=2e-4)
    np.testing.assert_allclose(seen[5:, 0], x[5:, 0] + 2e-4 * u[5:, 0], atol=2e-5)
    assert np.abs(seen[5:, 0] - x[5:, 0]).max() > 5e-4
    r = np.tile([0.0, -1e8, np.inf], (2000, 1))
    with pytest.raises(InputError, match="grows without bounds"):
        simulate_controlled(
            derivative, measure, command, make_plant(np.array([MASS, 0.0]), 1, WIDTH),
            np.array([0.01, 0.0]), np.zeros((2000, 1)), r, DT, force=[0],
        )  # fmt: skip


@argument(COMMAND.signature)
def with_integral(y, r, s, out):
    out[0] = r[1] * (r[0] - y[0]) - 80.0 * y[1] + 400.0 * s[0] - 6.0
    out[1] = r[0] - y[0]


@pytest.mark.parametrize(("limit", "left"), [(1.0, 0.0), (0.01, (6.0 - 4.0) / STIFFNESS)])
def test_an_integral_part_takes_a_lasting_load_off_unless_it_is_full(limit, left):
    r = np.tile([0.0, STIFFNESS], (8001, 1))
    x, u, _ = simulate_controlled(
        derivative, measure, with_integral, make_plant(np.array([MASS, 0.0]), 1, WIDTH),
        np.array([0.0, 0.0]), np.full((8001, 1), 5.0), r, DT, force=[0], limits=[(-limit, limit)],
    )  # fmt: skip
    # It starts where the recorded command of 5 N comes out, if it may.
    assert u[0, 0] == pytest.approx(5.0 if limit == 1.0 else -2.0, abs=1e-6)
    assert x[-1, 0] == pytest.approx(-left, abs=1e-5)
