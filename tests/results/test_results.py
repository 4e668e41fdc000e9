"""Records of results: what they refuse, what they leave out, how a faulty file is named."""

import json
from pathlib import Path
from typing import Any, get_args

import pytest
from made_results import filled
from pydantic import ValidationError

from bampipe.data.run_folder import RunFolder
from bampipe.errors import InputError
from bampipe.results.compare import Rung
from bampipe.results.floor import FloorStatus
from bampipe.results.ingest import IngestResult
from bampipe.results.validate import AxisError, ValidateResult

ERROR = filled(AxisError)


def made(yaw: Any = ERROR) -> ValidateResult:
    """A result with the error ``yaw`` of that axis."""
    trials = {"t01": {"held_out": True, "yaw": ERROR}}
    fields = {"model": "base", "axes": {"yaw": yaw}, "trials": trials}
    return ValidateResult.model_validate(filled(ValidateResult, fields))


def changed(root: Path, change: Any) -> Path:
    """A run folder whose validate.json was changed by ``change``."""
    content = made().write(root)
    change(content)
    (root / ValidateResult.file("base")).write_text(json.dumps(content))
    return root


def test_a_result_reads_back_as_it_was_written(tmp_path: Path) -> None:
    made().write(tmp_path)
    found = RunFolder(tmp_path).read(ValidateResult, "base")
    assert found == made()
    assert found.trials["t01"].axes == {"yaw": AxisError(**ERROR)}


def test_a_field_without_a_default_is_written_even_if_null_and_others_only_if_held() -> None:
    content = made().model_dump(mode="json")
    assert content["axes"]["yaw"]["fit_percent"] is None
    assert "free_run" not in content


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0, "small", None])
def test_a_number_that_is_none_is_refused_with_its_place(value: object) -> None:
    with pytest.raises(ValidationError, match=r"axes\.yaw\.rmse"):
        made(ERROR | {"rmse": value})


def test_a_field_that_is_not_declared_is_refused() -> None:
    with pytest.raises(ValidationError, match="nois_floor"):
        made(ERROR | {"nois_floor": 1.0})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("model"), "'model' is missing"),
        (lambda c: c["axes"]["yaw"].update(rmse="1.0"), 'axes.yaw.rmse: found "1.0", expected a n'),
        (lambda c: c["axes"]["yaw"].update(rmse=None, unit=3), r"axes.yaw.rmse: .*\(and 1 more\)"),
        (lambda c: c["trials"]["t01"].update(yaw=1), "trials.t01.yaw: "),
    ],
)
def test_what_is_wrong_with_a_file_is_said_in_one_line(
    tmp_path: Path, change: Any, message: str
) -> None:
    run = RunFolder(changed(tmp_path, change))
    with pytest.raises(InputError, match=rf"validate\.json: {message}") as caught:
        run.read(ValidateResult, "base")
    assert "bampipe validate --force" in caught.value.remedy
    assert "\n" not in str(caught.value)


def test_what_another_version_added_is_passed_over_and_an_absent_result_is_named(
    tmp_path: Path,
) -> None:
    def add(content: dict[str, Any]) -> None:
        content["later"] = 1
        content["axes"]["yaw"]["later"] = {"a": 1}

    assert RunFolder(changed(tmp_path, add)).read(ValidateResult, "base") == made()
    with pytest.raises(InputError, match=r"run `bampipe ingest .*` first"):
        RunFolder(tmp_path).read(IngestResult)


def test_a_version_far_below_its_floor_is_no_better() -> None:
    near, before, below, without = (
        Rung.model_construct(held_out_rmse={"joint": error}, standing={"joint": word})
        for error, word in zip((1.0, 2.7, 0.1, 0.1), get_args(FloorStatus), strict=True)
    )
    assert [r.improves_on(before) for r in (near, below, without)] == [True, False, False]
