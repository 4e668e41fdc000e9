"""The report stage: what it declares is what it reads and writes."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from run_folders import write_ingested

from bampipe.data.run_folder import RunFolder
from bampipe.progress import silent
from bampipe.stages import report

AXES = {"slide": {"unit": "m", "resolution": 1e-5}}


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    """A session of a device with one axis and no paper, ingested only."""

    t = np.arange(0.0, 2.0, 0.01)
    frame = pd.DataFrame({"t": t, "q_slide": np.sin(t), "force_x": t, "brake_slide": 0.0 * t})
    folder = tmp_path / "slider-01"
    return write_ingested(
        folder, {"t01": frame}, {"t01": ("free", None)}, AXES, device="slider", rate=100.0
    )


def test_writes_what_it_declares_and_mentions_no_paper(run: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "out"
    summary = report.execute(run, out, report.Config(), silent)
    written = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert written == {"report/report.pdf", "report/report.html", "report/explore.html"}
    assert written <= set(report.OUTPUTS)
    assert summary["sections"] == [
        "Summary", "Data", "Identification", "Validation", "Diagnosis", "Provenance",
    ]  # fmt: skip
    report.execute(run, tmp_path, report.Config(), silent)
    page = (tmp_path / "report/report.html").read_text(encoding="utf-8")
    assert "paper's" not in page
    assert "slide" in page


def test_what_the_stage_needs_and_does_not_import() -> None:
    declared = report.INPUTS
    required = {name for name in declared if "*" not in name and not name.endswith("?")}
    assert required == {"ingest/session.json", "ingest/trials.parquet"}
    code = "import bampipe.stages.report, sys; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
