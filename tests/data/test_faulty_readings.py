"""Wild readings and dead sensors, told from what machines do."""

import numpy as np
import pytest

from bampipe.data.quality.faulty_readings import (
    INPUT,
    POSITION,
    find_equal_runs,
    find_spikes,
    find_wild_inputs,
)

T = np.arange(4000) / 500.0
RNG = np.random.default_rng(3)
FORCE = 8.0 * np.sin(3.0 * T) + 0.05 * RNG.standard_normal(T.size)
COUNTS = np.rint(3000.0 * np.sin(2.0 * T))


@pytest.mark.parametrize("width", [1, 2])
@pytest.mark.parametrize(("values", "rule", "size"), [(FORCE, INPUT, 4.0), (COUNTS, POSITION, 400)])
def test_wild_readings_are_found(
    values: np.ndarray, rule: tuple[float, float], size: float, width: int
) -> None:
    spoilt = values.copy()
    for at, sign in ((500, 1.0), (1700, -1.0), (3100, 1.0)):
        spoilt[at : at + width] += sign * size
    expected = [at + k for at in (500, 1700, 3100) for k in range(width)]
    assert np.flatnonzero(find_spikes(spoilt, rule)).tolist() == expected


@pytest.mark.parametrize(
    ("values", "rule"),
    [
        (FORCE, INPUT),
        (COUNTS, POSITION),
        (FORCE + 3.0 * np.sign(np.sin(9.0 * T)), INPUT),  # friction turns round at once
        (np.rint(FORCE), INPUT),  # coarse steps
        (2000.0 * np.abs(np.sin(4.0 * T)), POSITION),  # a bounce off a stop
        (np.repeat(FORCE[::40], 40), INPUT),  # a command held for many samples
        (np.zeros(100), INPUT),
        (FORCE[:5], INPUT),
    ],
)
def test_what_machines_do_is_not_wild(values: np.ndarray, rule: tuple[float, float]) -> None:
    assert not find_spikes(values, rule).any()


def test_friction_that_turns_with_an_axis_for_two_samples_is_not_wild() -> None:
    at = int(np.argmax(T > 0.2))  # the axis moves upwards, and down for two samples
    turned = COUNTS - 60.0 * (np.arange(T.size) >= at) - 60.0 * (np.arange(T.size) > at)
    pulse = FORCE + 3.0 * np.sign(np.cos(2.0 * T)) - 6.0 * np.isin(np.arange(T.size), (at, at + 1))
    assert not find_wild_inputs(pulse, [turned]).any()
    assert np.flatnonzero(find_wild_inputs(pulse, [COUNTS])).tolist() == [at, at + 1]
    pulse[at : at + 2] -= 60.0
    assert np.flatnonzero(find_wild_inputs(pulse, [turned])).tolist() == [at, at + 1]


def test_what_a_drive_does_is_not_wild() -> None:
    """Neither kicks that answer leaps of an axis nor a train of pulses, in numbers of up to 1 %."""
    leaps = COUNTS + 80.0 * np.searchsorted((700, 1900, 2500, 3600), np.arange(T.size))
    kicked = FORCE - 12.0 * np.isin(np.arange(T.size), (701, 1901, 2501, 3601))
    assert [find_wild_inputs(kicked, [q]).sum() for q in (COUNTS, leaps)] == [4, 0]
    pulses = 0.02 * RNG.standard_normal(T.size) + 5.0 * (np.arange(T.size) % 250 == 100)
    assert not find_wild_inputs(pulses, [COUNTS]).any()


def test_a_dead_second_is_found_and_a_controllers_kick_is_not_wild() -> None:
    """It leaves the drive unsteady, as no wild reading does."""
    kicked = FORCE.copy()
    kicked[2000:2006] += [0.0, -30.0, -9.0, 6.0, 3.0, 1.0]
    assert not find_spikes(kicked, INPUT).any()
    spoilt = FORCE.copy()
    spoilt[1000:1500] = spoilt[1000]
    assert find_equal_runs(spoilt, T) == [(1000, 1500)]


@pytest.mark.parametrize(
    "values",
    [
        FORCE,
        np.clip(FORCE, -4.0, 4.0),  # at its limit
        np.rint(FORCE),  # rests on a coarse step
        np.sign(np.sin(5.0 * T)),  # steps of a command
        np.floor(T),  # a set-point
        np.interp(T, [0.0, 2.0, 4.0, 8.0], [0.0, 1.0, 1.0, 5.0]),  # a ramp with a plateau
    ],
)
def test_what_inputs_do_is_not_dead(values: np.ndarray) -> None:
    assert find_equal_runs(values, T) == []
