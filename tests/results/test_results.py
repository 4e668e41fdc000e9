"""Records of results: what they refuse, what they leave out, how a faulty file is named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from bampipe.data.run_folder import RunFolder
from bampipe.errors import InputError
from bampipe.results.ingest import IngestResult
from bampipe.results.validate import AxisError, ForceError, JudgedError, TrialError, ValidateResult

ERROR = AxisError(
    rmse=1.0,
    rmse_without_friction=2.0,
    held_out_rmse=1.5,
    published_rmse=1.5,
    relative_error_percent=10.0,
    held_out_relative_error_percent=15.0,
    fit_percent=None,
    unit="N",
)
JUDGED = JudgedError(
    **ERROR.model_dump(),
    noise_floor=1.4,
    noise_floor_sd=0.1,
    standing="at_floor",
    estimate="accepted",
)
def test_what_is_wrong_with_a_file_is_said_in_one_line(
    tmp_path: Path, change: Any, message: str
) -> None:
    run = RunFolder(changed(tmp_path, change))
    with pytest.raises(InputError, match=rf"validate\.json: {message}") as caught:
        run.read(ValidateResult, "base")
    assert "bampipe validate --force" in caught.value.remedy
    assert "\n" not in str(caught.value)


def test_what_another_version_added_is_passed_over(tmp_path: Path) -> None:
    def add(content: dict[str, Any]) -> None:
        content["later"] = 1
        content["axes"]["yaw"]["later"] = {"a": 1}

    assert RunFolder(changed(tmp_path, add)).read(ValidateResult, "base") == made()


def test_a_result_that_is_not_there_names_the_command(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"run `bampipe ingest .*` first"):
        RunFolder(tmp_path).read(IngestResult)
