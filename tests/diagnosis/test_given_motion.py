"""Joints whose motion a position controller gives: what the right effect explains is found."""

from __future__ import annotations

from pathlib import Path

import pytest
from independent import prescribed
from independent.sensors import Conditions
from independent_runs import PIPELINE

import bampipe


@pytest.mark.parametrize(
    ("hidden", "named", "strength"),
    [
        ("actuator_delay", "actuator_delay", 2.0),
        ("falling_friction:joint", "stribeck:joint", 1.0),
    ],
    ids=["a delay that takes all friction from the bare model", "no drive that hardly acts"],
)
def test_what_is_hidden_is_named(tmp_path: Path, hidden: str, named: str, strength: float) -> None:
    conditions = Conditions(trials=3, seconds=10.0, rate_hz=500.0 if strength > 1.0 else 200.0)
    prescribed.record(tmp_path / "logs", 7, {hidden: strength}, conditions)
    (tmp_path / "short.toml").write_text(PIPELINE)
    run = bampipe.run_session(
        tmp_path / "logs", runs=tmp_path / "runs", pipeline=str(tmp_path / "short.toml")
    )
    found = bampipe.diagnose(run, "base", jobs=1)
    assert tuple(found["selected"]) == (named,), found["sentence"]
