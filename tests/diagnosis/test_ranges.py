"""Shapes are looked for at the scale of the machine."""

from dataclasses import replace

import numpy as np
import pytest
from sessions import AXIS, bam, fit_trials, made

from bampipe.diagnosis.ranges import MachineScale
from bampipe.physics import Model, registry


def range_of(effect, parameter, scale=AXIS):
    item = Model(registry.device("slider"), [effect]).effects[0]
    return next(scale.range_of(item, p) for p in item.parameters if p.name.endswith(parameter))


@pytest.mark.parametrize(
    ("effect", "parameter", "low", "high"),
    [
        ("presliding:carriage", "distance", 25e-6, 0.025),
        ("flexible_load:carriage", "frequency", 25.0, 2.0 * np.pi * 24.0),
        ("stribeck:carriage", "speed", 6e-4, 0.15),
        ("torque_ripple:carriage", "wavenumber", 4 * np.pi / 0.25, 60 * np.pi / 0.25),
        ("transmission_compliance:carriage", "compliance", 2.5e-7, 2.5e-4),
        ("drive_sag:carriage", "sag", 1e-4, 0.03),
        ("actuator_delay", "delay", 2e-4, 0.08),
        ("thermal_damping:carriage", "time_constant", 1.0, 60.0),
        ("loose_drive:carriage", "gap", 25e-5, 0.0125),
        ("loose_drive:carriage", "drive_inertia", 7.5, 42.5),
    ],
)
def test_a_range_follows_travel_speed_load_and_sampling(effect, parameter, low, high):
    found = range_of(effect, parameter)
    assert found.by_ratio
    assert (found.low, found.high) == pytest.approx((low, high), rel=1e-9)


def test_where_drives_are_late_and_stops_are_looked_for():
    """Less than that is what friction leaves where it stops a joint, and the timing of all."""
    lag = f"actuator_lag:{registry.device('slider').components[0]}"
    beside = replace(AXIS, coordinates={**AXIS.coordinates, "tool": ("m", "N")})
    assert range_of(lag, "time_constant").low == pytest.approx(2e-4)
    assert range_of(lag, "time_constant", beside).low == pytest.approx(5e-4)
    upper, lower = (range_of(f"{name}_stop:carriage", "position") for name in ("upper", "lower"))
    assert (upper.low, upper.high) == pytest.approx((0.0125, 0.195))
    assert (lower.low, lower.high) == pytest.approx((-0.045, 0.1375))
    ends = range_of("gas_spring:carriage", "end")
    shares = np.linspace(0.0, 1.0, 21)
    found = np.array([ends.value_at(ends.interpolate(share)) for share in shares])
    above, below = found[shares > 0.5], found[shares < 0.5]
    # The travel goes from -0.05 to 0.2 m: nearly at it, and where any gas is a straight line.
    assert above.min() == pytest.approx(0.205)
    assert below.max() == pytest.approx(-0.055)
    assert above.max() == pytest.approx(0.075 + 5 * 0.25)
    assert below.min() == pytest.approx(0.075 - 5 * 0.25)
    assert (np.diff(above) <= 0.0).all() and (np.diff(below) <= 0.0).all()
    assert np.isfinite(found).all()


def test_the_scale_of_a_session_is_that_of_its_motion():
    session = made(bam(), {}, trials=2)
    scale = MachineScale.of_trials(fit_trials(session, bam()))
    q = np.concatenate([m.q for m in session.motions])
    np.testing.assert_allclose(scale.highest - scale.lowest, np.ptp(q, axis=0))
    force = np.concatenate([m.channels["force_z"] for m in session.motions])
    assert scale.load[2] == pytest.approx(np.abs(force).max())
    assert scale.interval == pytest.approx(
        1.0 / session.motions[0].t.size * scale.duration, rel=0.01
    )


def test_no_ripple_falls_between_two_values_that_are_tried():
    """Of two wavenumbers a wave on the travel apart neither tells of the other."""
    waves = range_of("torque_ripple:carriage", "wavenumber")
    values = [waves.interpolate(share) for share in np.linspace(0.0, 1.0, waves.grid_size)]
    on_travel = np.array(values) * 0.25 / (2.0 * np.pi)
    assert on_travel[-1] == pytest.approx(30.0)
    assert np.diff(on_travel).max() <= 0.6


def test_no_resonance_falls_between_two_frequencies_that_are_tried():
    """A part that swings with a twentieth of critical damping shows within a tenth of it."""
    frequency = range_of("flexible_load:carriage", "frequency")
    values = [frequency.interpolate(share) for share in np.linspace(0.0, 1.0, frequency.count)]
    assert np.divide(values[1:], values[:-1]).max() < 1.12
