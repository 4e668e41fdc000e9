"""Stiffness and play of gears, from encoders on their two sides."""

from pathlib import Path

import pytest
from independent import arm

import bampipe
from bampipe.errors import InputError
from bampipe.files import read_json
from bampipe.report.document import Table
from bampipe.report.run_results import Results
from bampipe.report.sections import stiffness
from bampipe.setup.proposal import propose, write_proposal

SECOND = """
[channels.second_{axis}]
column = "motor_side_{axis}_rad"
unit = "rad"
second_encoder_of = "{axis}"
"""


def recorded(root: Path, effects: dict[str, float]) -> Path:
    """A session of an arm whose log has positions of joints and motors."""
    folder = root / "arm"
    arm.record_logs(folder, 41, "ZYY", effects, style="joint_states", trials=2, seconds=8.0)
    write_proposal(folder, propose(folder))
    return folder


def test_wind_up_and_play_of_a_gear_are_those_of_the_truth(tmp_path: Path) -> None:
    folder = recorded(tmp_path, {"gear_windup:elbow": 1.0})
    with (folder / "session.toml").open("a") as file:
        file.write(SECOND.format(axis="elbow") + SECOND.format(axis="base_yaw"))
    bampipe.run_session(folder, runs=tmp_path / "runs", last="stiffness")
    found = read_json(tmp_path / "runs/arm/stiffness/stiffness.json")
    truth = read_json(tmp_path / "arm.truth.json")["effects"]["gear_windup:elbow"]
    gear = found["gears"]["elbow"]
    assert gear["side"] == "motor" and gear["unit"] == "N.m/rad"
    assert abs(gear["stiffness"] - truth["stiffness"]) < max(
        4 * gear["sd"], 0.05 * gear["stiffness"]
    )
    if gear["play"] is not None:
        assert abs(gear["play"] - truth["play"]) < max(4 * gear["play_sd"], 0.1 * truth["play"])
    assert gear["explained"] > 0.95
    assert "gear of elbow" in found["headline"]
    # Its motor follows the base's joint exactly.
    assert found["gears"]["base_yaw"]["stiffness"] is None
    assert any(note.startswith("base_yaw: its two encoders") for note in found["notes"])
    section = stiffness.section(Results(tmp_path / "runs/arm"))
    assert section is not None
    (table,) = (block for block in section.blocks if isinstance(block, Table))
    assert [row[0] for row in table.rows] == ["base_yaw", "elbow"]
    assert table.rows[0][1] == "not seen" and table.rows[1][5] == "motor"


def test_a_second_encoder_is_of_an_axis_and_in_its_unit(tmp_path: Path) -> None:
    folder = recorded(tmp_path, {"gear_windup:elbow": 1.0})
    text = (folder / "session.toml").read_text()
    for change, said in (
        (('second_encoder_of = "elbow"', 'second_encoder_of = "elbo"'), "no axis 'elbo'"),
        (('unit = "rad"', 'unit = "m"'), "a unit of m, expected one of rad"),
    ):
        (folder / "session.toml").write_text(text + SECOND.format(axis="elbow").replace(*change))
        with pytest.raises(InputError, match=said):
            bampipe.run_session(folder, runs=tmp_path / "runs", last="ingest")
