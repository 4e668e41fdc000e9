"""Models with effects: what trials cannot determine, and how the truth is judged."""

import pytest
from independent_runs import record_run

import bampipe
from bampipe.files import read_json


def extended(run, effect):
    """What identify and validate say of the bare model with one effect added."""
    run = bampipe.extend(run, effect)
    folder = run.root / "models" / f"base+{effect.replace(':', '.')}"
    return read_json(folder / "identify.json"), read_json(folder / "validate.json")


@pytest.mark.long
def test_friction_that_fades_with_speed_is_found_and_leaves_the_floor(tmp_path):
    """A plain fit to filtered motions sharpens it, and leaves a third less than the truth does."""
    run, truth = record_run(tmp_path, "bam", 7301, "stribeck:extension", rate_hz=500.0)
    found, judged = extended(run, "stribeck:extension")
    assert found["effects"]["stribeck:extension"]["identified"]
    parameters = found["parameters"]
    for name, value in truth.items():
        near = 0.15 if name.endswith(".speed") else 0.05
        assert parameters[name]["estimate"] == pytest.approx(value, rel=near), name
    assert judged["axes"]["extension"]["standing"] == "at_floor"


@pytest.mark.long
def test_an_effect_that_is_not_there_does_not_count_as_identified(tmp_path):
    run, _ = record_run(tmp_path, "axis", 19)
    found, _ = extended(run, "stribeck:carriage")
    entry = found["effects"]["stribeck:carriage"]
    assert not entry["identified"]
    assert any("`stribeck.carriage." in reason for reason in entry["reasons"])
    assert found["headline"].startswith("not identified: stribeck:carriage; ")
    assert found["notes"][0].startswith("`stribeck:carriage` does not count as identified: ")
