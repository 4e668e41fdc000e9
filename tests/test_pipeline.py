"""The main job on a shipped session: the run folder that other programs read, twice the same."""

import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import contents, misfits

ROOT = Path(__file__).parent.parent
SESSION = ROOT / "sample_runs" / "first"

pytestmark = pytest.mark.slow


def bampipe(folder: Path, *arguments: object, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "bampipe", *map(str, arguments)]
    environment = {**os.environ, "SOURCE_DATE_EPOCH": "0", **variables}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("work")
    done = bampipe(folder, "run", SESSION)
    assert done.returncode == 0, done.stderr
    return folder / "runs" / "first"


def test_the_run_folder_is_as_promised(run: Path) -> None:
    for name in (
        "run.json",
        "ingest/trials.parquet",
        "ingest/samples.parquet",
        "ingest/session.json",
        "filter/kinematics.parquet",
        "stiffness/stiffness.json",
        "stiffness/loops.parquet",
        "models/base/model.toml",
        "models/base/identify.json",
        "models/base/states.parquet",
        "models/base/validate.json",
        "models/base/residuals.parquet",
        "compare.json",
        "report/report.pdf",
        "report/report.html",
    ):
        assert (run / name).stat().st_size > 0, name
    assert list((run / "report" / "figures").iterdir())


def test_every_json_file_is_as_its_schema_says(run: Path) -> None:
    assert len(list(run.rglob("*.json"))) > 9
    assert misfits(run) == []


def test_nothing_changed_nothing_runs_and_soon(run: Path) -> None:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = bampipe(run.parent.parent, "run", SESSION, "--json")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    # Processor time: other work on the machine does not count.
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    steps = json.loads(done.stdout)["sessions"][0]["steps"]
    assert {step["state"] for step in steps.values()} == {"unchanged"}
    assert seconds < 3.0
    assert bampipe(run.parent.parent, "verify", "first").returncode == 0


def test_twice_the_same_bytes(run: Path, tmp_path: Path) -> None:
    """Elsewhere, in another process for each trial, with other hashes and threads: the same."""
    shutil.copytree(SESSION, tmp_path / "moved" / "first")
    variables = {
        "PYTHONHASHSEED": "7", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1",
        "NUMBA_NUM_THREADS": "1", "LC_ALL": "C", "TZ": "Asia/Tokyo", "COLUMNS": "40",
    }  # fmt: skip
    done = bampipe(tmp_path, "run", "moved/first", "--jobs", "2", **variables)
    assert done.returncode == 0, done.stderr
    first, second = contents(run), contents(tmp_path / "runs" / "first")
    assert set(first) == set(second)
    assert [name for name in first if first[name] != second[name]] == []


@pytest.mark.long
def test_the_report_follows_a_setting_that_changed_no_result(run: Path) -> None:
    page = run / "report" / "report.html"
    kinematics = (run / "filter" / "kinematics.parquet").read_bytes()
    assert "tuning_samples = 120000" in page.read_text(encoding="utf-8")
    for command in (("filter", "first", "--set", "tuning_samples=120001"), ("report", "first")):
        done = bampipe(run.parent.parent, *command)
        assert done.returncode == 0, done.stderr
    assert (run / "filter" / "kinematics.parquet").read_bytes() == kinematics
    assert "tuning_samples = 120001" in page.read_text(encoding="utf-8")
