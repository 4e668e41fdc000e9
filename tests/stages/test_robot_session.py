"""A robot from URDF and log to parameters, beside the truth of a simulator of its own."""

from pathlib import Path
from typing import Any

import pytest
from binary_logs import to_parquet
from independent import arm

import bampipe
from bampipe.data.device_file import read_device_file
from bampipe.data.run_folder import RunFolder
from bampipe.files import read_json
from bampipe.physics.base_parameters import base_parameters
from bampipe.physics.registry import device_from
from bampipe.physics.robot import Robot
from bampipe.setup.proposal import propose, write_proposal

SEED, KINDS = 3, "ZYY"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunFolder, dict[str, Any]]:
    """A run up to validation, and the truth; bodies differ from the drawing by 15 %."""
    folder = tmp_path_factory.mktemp("robot") / "arm"
    truth = arm.record_logs(folder, SEED, KINDS, style="joint_states", drawing_error=0.15)
    write_proposal(folder, propose(to_parquet(folder)))
    bampipe.run_session(folder, runs=folder.parent / "runs", last="validate")
    return RunFolder(folder.parent / "runs" / "arm"), truth["parameters"]


def true_robot(folder: Path) -> Robot:
    """The robot as its drawing would be without errors."""
    (folder / "arm.urdf").write_text(arm.urdf(arm.build(KINDS, SEED)))
    (folder / "device.toml").write_text('name = "arm"\n[robot]\nurdf = "arm.urdf"\n')
    return device_from(read_device_file(folder / "device.toml")).robot


@pytest.mark.slow
def test_friction_and_base_parameters_are_those_of_the_truth(recorded, tmp_path: Path) -> None:
    run, friction = recorded
    found = read_json(run.path("models/base/identify.json"))
    assert found["method"] == "least-squares"
    for name, truth in friction.items():
        entry = found["parameters"][name]
        assert abs(entry["estimate"] - truth) < max(4.0 * entry["sd"], 0.03 * truth), name
    robot = true_robot(tmp_path)
    numbers = {p.name: p.prior for p in robot.parameters}
    checked = 0
    for base, entry in zip(base_parameters(robot), found["base_parameters"], strict=True):
        # The first inertia and that of the drive are one number to any motion.
        if entry["shown"] and "inertia_zz" not in entry["combination"]:
            expected = sum(factor * numbers[name] for name, factor in base.terms.items())
            off = abs(entry["estimate"] - expected)
            assert off < 4.0 * entry["sd"] + 0.02 * abs(expected), entry["combination"]
            checked += 1
    assert checked >= 4


@pytest.mark.slow
def test_nothing_is_left_but_noise(recorded) -> None:
    for axis in read_json(recorded[0].path("models/base/validate.json"))["axes"].values():
        assert axis["held_out_rmse"] < 1.5 * axis["noise_floor"]
        assert axis["fit_percent"] > 95.0
