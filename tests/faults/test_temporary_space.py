"""A disk of temporary files that is full or absent is named; it is not that of the run folder."""

import os
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bampipe.errors import InputError
from bampipe.report import typeset
from bampipe.report.document import Document
from bampipe.trials.kept import KeptItems
from bampipe.trials.motion import Motion


@pytest.fixture
def full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder for temporary files on a disk of its own, where nothing has room."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=16k", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("a small disk can be mounted by root only, and not everywhere")
    (folder / "filler").write_bytes(b"x" * 12288)
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def motion(size: int = 20000) -> Motion:
    t = np.arange(size) / 500.0
    q = np.random.default_rng(0).normal(size=(size, 1))
    return Motion("t01", t, q, q, q, q, {})


def test_stored_trials(full: Path) -> None:
    with pytest.raises(InputError, match="written: the disk is full") as caught:
        KeptItems([motion()], most=1)
    assert caught.value.where == str(full) and "TMPDIR" in caught.value.remedy
    assert [path.name for path in full.iterdir()] == ["filler"]


def test_the_report(full: Path) -> None:
    (full / "more").write_bytes(b"x" * 4096)
    with pytest.raises(InputError, match="no temporary files can be written"):
        typeset.render_pdf(Document("title", "subtitle", ()), 0)


def test_no_folder_at_all(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere() -> str:
        raise FileNotFoundError(2, "No usable temporary directory found in ['/tmp']")

    monkeypatch.setattr(tempfile, "gettempdir", nowhere)
    with pytest.raises(InputError, match="no folder for temporary files"):
        KeptItems([motion(10)], most=1)
