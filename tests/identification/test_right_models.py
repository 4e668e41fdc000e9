"""An effect that trials do not show."""

import pytest
from independent_runs import record_run

import bampipe
from bampipe.files import read_json


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
