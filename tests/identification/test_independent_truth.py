"""Estimates and their intervals, held against simulators that share no code with bampipe."""

import numpy as np
import pytest
from independent_runs import record_run

import bampipe
from bampipe.files import read_json

DAYS = {
    "noise five times what is stated": {"noise_factor": 5.0},
    "mains hum and coarse encoders": {"hum": 10.0, "coarse": 8.0},
    "dropped samples and jitter": {"dropped": 0.02, "jitter": 0.1},
    "true standstill": {"creep": False, "trials": 2},
}


def deviations(run, truth):
    """Estimate minus truth in standard deviations, by parameter of the bare device."""
    table = run.parameters("base")
    assert set(truth) == set(table.index)
    return {name: (table.estimate[name] - truth[name]) / table.sd[name] for name in truth}


@pytest.mark.parametrize(
    "day", [pytest.param(d, marks=[pytest.mark.long] * (d != "true standstill")) for d in DAYS]
)
def test_the_arm_is_identified_on_bad_days(tmp_path, day):
    run, truth = record_run(tmp_path, "bam", 17, **DAYS[day])
    off = deviations(run, truth)
    assert max(map(abs, off.values())) < 4.0, off
    assert np.sqrt(np.mean(np.square(list(off.values())))) < 2.0, off
    estimates = run.parameters("base").estimate
    for name, value in truth.items():
        assert estimates[name] == pytest.approx(value, rel=0.03), name


SHAKEN = {"trials": 3, "seconds": 4.0, "rate_hz": 100.0}
"""At up to 60 Hz: trials that no filter can follow at this rate are left out."""


@pytest.mark.parametrize(
    ("machine", "seed", "conditions"),
    [
        ("joint", 18, {}),
        pytest.param("axis", 19, {}, marks=pytest.mark.long),
        ("damper", 9401, SHAKEN),
    ],
)
def test_machines_that_lack_nothing_are_identified(tmp_path, machine, seed, conditions):
    run, truth = record_run(tmp_path, machine, seed, **conditions)
    off = deviations(run, truth)
    assert max(map(abs, off.values())) < 4.0, off
    axes = run.validation("base")
    assert (axes.held_out_rmse < 1.25 * axes.noise_floor).all()


@pytest.mark.long
def test_an_effect_that_is_not_there_does_not_count_as_identified(tmp_path):
    run, _ = record_run(tmp_path, "axis", 19)
    run = bampipe.extend(run, "stribeck:carriage")
    found = read_json(run.root / "models/base+stribeck.carriage/identify.json")
    entry = found["effects"]["stribeck:carriage"]
    assert not entry["identified"]
    assert any("`stribeck.carriage." in reason for reason in entry["reasons"])
    assert found["headline"].startswith("not identified: stribeck:carriage; ")
    assert found["notes"][0].startswith("`stribeck:carriage` does not count as identified: ")
