"""Stiffness recovered from loops of known stiffness, whatever the friction looks like."""

import numpy as np
import pytest
from loops import Array, bouc_wen, elements, load_cycles, measure

from bampipe.estimate import hysteresis as hy
from bampipe.estimate.white_noise import white_noise_sd

RATE = 500.0
K, AMPLITUDE = 2300.0, 50.0


def simulate(kind: str, torque: Array, stiffness: float, friction: float, slip: float) -> Array:
    """Return the deflection under ``torque`` of the loop model ``kind``."""
    if kind == "jenkins":
        return elements(torque, stiffness, friction, np.array([slip]))
    if kind == "iwan":
        return elements(torque, stiffness, friction, slip * np.linspace(0.1, 2.0, 8))
    return bouc_wen(torque, stiffness, friction, slip, float(kind.removeprefix("bouc_wen_")))


@pytest.mark.parametrize("kind", ["jenkins", "iwan", "bouc_wen_1", "bouc_wen_2", "bouc_wen_0.5"])
@pytest.mark.parametrize(("friction", "slip"), [(0.01, 0.03), (0.06, 0.03), (0.06, 0.1)])
def test_stiffness_within_a_percent(kind: str, friction: float, slip: float) -> None:
    load = load_cycles(4, AMPLITUDE, seed=3)
    true = simulate(kind, load, K, friction * AMPLITUDE, slip * AMPLITUDE / K)
    for resolution, noise_sd in ((4.7e-5, 0.05), (6e-4, 0.05), (6e-4, 0.3)):
        found = hy.measure_hysteresis(*measure(load, true, resolution, noise_sd), RATE)
        assert found.yielded
        assert found.stiffness == pytest.approx(K, rel=0.01)
        assert len(found.cycles) == 3
        widths = [cycle.loop_width for cycle in found.cycles]
        assert np.mean(widths) == pytest.approx(2 * friction * AMPLITUDE, rel=0.1)


def test_coarse_readings_and_noise_do_not_stiffen_the_axis() -> None:
    """The extension of the BAM: 109 kN/m under 120 N is 73 counts of 30 um."""
    stiffness, errors = 109e3, []
    for seed in range(4):
        load = load_cycles(4, 120.0, seed=seed)
        true = bouc_wen(load, stiffness, 7.0, 1.2e-4, 1.0)
        found = hy.measure_hysteresis(*measure(load, true, 3e-5, 0.05, seed), RATE)
        errors.append(found.stiffness / stiffness - 1.0)
    assert np.max(np.abs(errors)) < 0.003
    load = load_cycles(6, AMPLITUDE, seed=5)
    true = simulate("bouc_wen_1", load, K, 3.0, 0.03 * AMPLITUDE / K)
    found = hy.measure_hysteresis(*measure(load, true, 4.7e-5, 6.0), RATE)
    assert found.stiffness == pytest.approx(K, rel=0.01)


def test_energy_is_the_area_of_the_loop() -> None:
    """Rigid-plastic friction F: a loop of range X loses 2 F (X - slip range), a rectangle."""
    friction, slip = 3.0, 1e-4
    load = load_cycles(4, AMPLITUDE, seed=2)
    true = elements(load, K, friction, np.array([slip]))
    found = hy.measure_hysteresis(*measure(load, true, 4.7e-5, 0.02), RATE)
    for cycle in found.cycles:
        part = true[cycle.start : cycle.stop + 1]
        assert cycle.energy == pytest.approx(2 * friction * (np.ptp(part) - 2 * slip), rel=0.05)


def test_a_load_below_friction_and_the_scatter_of_cycles_are_said() -> None:
    load = load_cycles(4, AMPLITUDE, seed=2)
    true = simulate("bouc_wen_1", load, K, 15.0, 0.6 * AMPLITUDE / K)
    found = hy.measure_hysteresis(*measure(load, true, 4.7e-5, 0.05), RATE)
    assert not found.yielded
    assert found.slope_change > 0.02
    load = load_cycles(6, 120.0, seed=1)
    true = bouc_wen(load, 109e3, 7.0, 1.2e-4, 1.0)
    found = hy.measure_hysteresis(*measure(load, true, 3e-5, 0.05), RATE)
    scatter = np.std([c.stiffness for c in found.cycles], ddof=1)
    assert 1e-5 < scatter / found.stiffness < 0.01
    assert found.standard_error >= scatter / np.sqrt(len(found.cycles))
    t = np.arange(0.0, 16.0, 1.0 / RATE)
    phase = t + 0.6 * np.sin(2 * np.pi * t / 4.0 * 3.0) / 3.0
    load = AMPLITUDE * np.sin(2 * np.pi * phase / 4.0) + 0.6 * np.sin(2 * np.pi * 9.0 * t)
    assert len(hy.find_reversals(hy.smooth_torque(load, RATE))) == 8
    rng = np.random.default_rng(0)
    signal = load_cycles(3, AMPLITUDE) + 0.2 * rng.standard_normal(6000)
    signal[100] += 40.0
    assert white_noise_sd(signal) == pytest.approx(0.2, rel=0.05)


@pytest.mark.parametrize("cycles", [0.2, 0.6])
def test_no_whole_cycle(cycles: float) -> None:
    load = AMPLITUDE * np.sin(2 * np.pi * np.linspace(0.0, cycles, 1000))
    with pytest.raises(ValueError, match="no whole load cycle"):
        hy.measure_hysteresis(load, load / K, RATE)


def test_a_deflection_of_a_few_counts() -> None:
    load = load_cycles(4, AMPLITUDE)
    with pytest.raises(ValueError, match="fewer than 8 encoder counts"):
        hy.measure_hysteresis(load, np.round(load / K / 0.02) * 0.02, RATE)


@pytest.mark.parametrize("noise_sd", [0.05, 0.3])
def test_the_uncertainty_holds_the_truth(noise_sd: float) -> None:
    """Loops that turn round along exponentials never become quite straight."""
    rng = np.random.default_rng(5)
    stiffness, errors = 2200.0, []
    for _ in range(30):
        t = np.arange(12000) / RATE
        true = np.sin(2 * np.pi * t / rng.uniform(3.5, 4.0)) * 40.0 / stiffness
        length = rng.uniform(0.05, 0.15) * 40.0 / stiffness
        friction = np.zeros(len(t))
        for k, step in enumerate(np.diff(true)):
            side = np.sign(step)
            friction[k + 1] = side + (friction[k] - side) * np.exp(-abs(step) / length)
        load = stiffness * true + friction
        noisy = load + noise_sd * rng.standard_normal(len(t))
        found = hy.measure_hysteresis(noisy, np.floor(true / 4.7e-5) * 4.7e-5, RATE)
        sd = np.hypot(found.standard_error, found.systematic)
        errors.append((found.stiffness - stiffness) / sd)
    # Of 30 draws at 95 %, fewer than 26 within are one case in eighty.
    assert np.sum(np.abs(errors) < 1.96) >= 26
    assert np.abs(errors).max() < 4.0
    assert 0.4 < np.sqrt(np.mean(np.square(errors))) < 1.4
