"""The ladder of models, and what the file of one may hold fixed."""

from pathlib import Path

import numpy as np
import pytest
from made_results import write_model, write_result

from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model_file import read_estimate
from bampipe.errors import InputError
from bampipe.physics import Model, compile_model, registry
from bampipe.progress import silent
from bampipe.results.compare import CompareResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.validate import ValidateResult
from bampipe.stages import compare


def add(root: Path, name: str, parent: str, floor: float | None = None, **errors: float) -> None:
    """A model version with these held-out errors by axis, over this noise floor."""
    effects = tuple(part.replace(".", ":") for part in name.split("+")[1:])
    write_model(root, name, *effects, parent=parent)
    write_result(root, IdentifyResult, model=name, parameters={})
    standing = "at_floor" if floor else "floor_missing"
    known = {"standing": standing, "noise_floor": floor, "unit": "N.m"}
    axes = {axis: {"held_out_rmse": error, **known} for axis, error in errors.items()}
    write_result(root, ValidateResult, model=name, axes=axes)


def compared(root: Path) -> CompareResult:
    compare.execute(RunFolder(root), root, compare.Config(), silent)
    return CompareResult.read(root / CompareResult.FILE)


def test_the_best_confirmed_model_counts(tmp_path: Path) -> None:
    add(tmp_path, "base", "", yaw=0.50, pitch=0.2)
    add(tmp_path, "base+a.yaw", "base", yaw=0.30, pitch=0.2)
    add(tmp_path, "base+a.yaw+b.yaw", "base+a.yaw", yaw=0.20, pitch=0.2)
    add(tmp_path, "base+c.yaw", "base", yaw=0.25, pitch=0.2)
    found = compared(tmp_path)
    assert {rung.model: rung.confirmed for rung in found.ladder} == dict.fromkeys(
        RunFolder(tmp_path).models(), True
    )
    assert found.best == RunFolder(tmp_path).default_model() == "base+a.yaw+b.yaw"


@pytest.mark.parametrize(
    "errors",
    [
        {"yaw": 0.50, "pitch": 0.2},  # the same
        {"yaw": 0.498, "pitch": 0.2},  # a fall that a superfluous effect has, too
        {"yaw": 0.40, "pitch": 0.3},  # one axis pays for the other
    ],
)
def test_a_child_that_is_no_better_does_not_count(tmp_path: Path, errors: dict[str, float]) -> None:
    add(tmp_path, "base", "", yaw=0.50, pitch=0.2)
    add(tmp_path, "base+a.yaw", "base", **errors)
    add(tmp_path, "base+a.yaw+b.yaw", "base+a.yaw", yaw=0.1, pitch=0.1)
    found = compared(tmp_path)
    assert [rung.confirmed for rung in found.ladder] == [True, False, False]
    assert found.best == RunFolder(tmp_path).default_model() == "base"


def test_a_child_whose_floor_is_lost_does_not_count(tmp_path: Path) -> None:
    for name, parent, error, floor in (("base", "", 0.5, 0.1), ("base+a.yaw", "base", 0.05, None)):
        add(tmp_path, name, parent, floor, yaw=error)
    found = compared(tmp_path)
    assert [rung.confirmed for rung in found.ladder] == [True, False]
    assert found.best == "base"


def test_a_damaged_ladder_is_as_none(tmp_path: Path) -> None:
    add(tmp_path, "base", "", yaw=0.5)
    add(tmp_path, "base+a.yaw", "base", yaw=0.2)
    compared(tmp_path)
    (tmp_path / CompareResult.FILE).write_text("{")
    assert RunFolder(tmp_path).default_model() == "base"


@pytest.mark.parametrize("error", [0.2, 0.5])
def test_only_a_confirmed_model_shows_that_another_was_biased(tmp_path: Path, error: float) -> None:
    for name, parent, mass in (("base", "", 2.0), ("base+a.yaw", "base", 3.0)):
        add(tmp_path, name, parent, yaw=error if parent else 0.5)
        entry = {"estimate": mass, "sd": 0.1, "unit": "kg"}
        write_result(tmp_path, IdentifyResult, model=name, parameters={"mass": entry})
    said = ["mass moved from 2.00 ± 0.10 to 3.00 ± 0.10 kg: without what was added it was biased."]
    assert [one.sentence for one in compared(tmp_path).moved] == (said if error < 0.5 else [])


def test_what_is_fixed_stands_at_its_prior_and_what_is_missing_is_named(tmp_path):
    system = compile_model(
        Model(registry.device("servo_pendulum"), ["load_dependent_friction:joint"])
    )
    free = [item.name for item in system.parameters if not item.fixed]
    assert len(free) < len(system.parameters)
    found = {name: {"estimate": 1.0 + k, "sd": 0.1} for k, name in enumerate(free)}
    write_result(tmp_path, IdentifyResult, parameters=found)
    p = read_estimate(RunFolder(tmp_path), "base", system)
    for item, value in zip(system.parameters, p, strict=True):
        assert value == (item.prior if item.fixed else found[item.name]["estimate"])
    assert np.isfinite(p).all()
    del found["armature"]
    write_result(tmp_path, IdentifyResult, parameters=found)
    with pytest.raises(InputError, match=r"identify\.json: no parameter 'armature'; bampipe iden"):
        read_estimate(RunFolder(tmp_path), "base", system)
    with pytest.raises(InputError, match="bampipe identify"):
        read_estimate(RunFolder(tmp_path), "other", system)
