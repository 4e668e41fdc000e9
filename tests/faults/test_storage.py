"""A disk that is full or read-only, records that are damaged: one line, and nothing lost."""

import json
import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from conftest import Toy

from bampipe.api import loop
from bampipe.errors import InputError
from bampipe.report import typeset
from bampipe.report.document import Document
from bampipe.run import record
from bampipe.run.events import Event
from bampipe.run.status import verify
from bampipe.trials.kept import KeptItems
from bampipe.trials.motion import Motion


def run_toys(toy: Toy, limit: int | None = None) -> tuple[int, str]:
    """Run the toy stages in another process; return its exit code and standard error."""
    process = toy.start(str(toy.session), "--quiet", limit=limit)
    said = process.communicate()[1]
    return process.returncode, said


def assert_refused(toy: Toy, message: str, limit: int | None = None) -> None:
    """A run says ``message`` in one line and leaves with exit code 2."""
    code, said = run_toys(toy, limit)
    assert code == 2 and said.count("\n") == 1 and message in said, said


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[Callable[[str], None]]:
    """Put a folder on a disk of its own; gives how to mount it again otherwise."""
    folder.mkdir()

    def mount(*arguments: str) -> bool:
        command = ["mount", *arguments, str(folder)]
        return subprocess.run(command, capture_output=True).returncode == 0

    if os.geteuid() != 0 or not mount("-t", "tmpfs", "-o", f"size={size}", "tmpfs"):
        pytest.skip("a small disk can be mounted by root only, and not everywhere")
    try:
        yield lambda options: pytest.fail("remount") if not mount("-o", options) else None
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture
def disk(toy: Toy) -> Iterator[Callable[[str], None]]:
    """The run folders are on a disk of 1 MB, which can be mounted again otherwise."""
    with small_disk(toy.runs, "1m") as remount:
        yield remount


LONG = [pytest.param(room, marks=pytest.mark.long) for room in (4096, 8192, 16384, 24576)]


@pytest.mark.parametrize("room", [0, *LONG])
def test_a_full_disk_is_said_and_costs_nothing(
    toy: Toy, disk: Callable[[str], None], room: int
) -> None:
    assert run_toys(toy)[0] == 0
    good = toy.files()
    (toy.session / "numbers.txt").write_text("4 5 6 7 8")
    ballast = toy.runs / "ballast"
    free = os.statvfs(toy.runs)
    ballast.write_bytes(b"x" * (free.f_bavail * free.f_frsize - room))
    assert_refused(toy, "disk is full")
    for name, content in toy.files().items():
        if name.endswith(".json"):
            json.loads(content)
    assert not list(toy.root.rglob("*.partial"))
    ballast.unlink()
    assert run_toys(toy)[0] == 0
    whole = toy.files()
    assert verify(toy.root) == []
    (toy.session / "numbers.txt").write_text("1 2 3")
    assert run_toys(toy)[0] == 0
    assert toy.files() == good != whole


def test_a_read_only_disk_is_said_and_can_still_be_read(
    toy: Toy, disk: Callable[[str], None]
) -> None:
    assert run_toys(toy)[0] == 0
    good = toy.files()
    disk("remount,ro")
    assert_refused(toy, "read-only")
    assert toy.files() == good
    assert verify(toy.root) == []


@pytest.mark.parametrize(
    "limit", [60, *(pytest.param(n, marks=pytest.mark.long) for n in (0, 300, 1500))]
)
def test_a_file_that_may_not_grow_is_said(
    toy: Toy, monkeypatch: pytest.MonkeyPatch, limit: int
) -> None:
    monkeypatch.delenv("TOY_LOG")  # which would be such a file
    assert run_toys(toy)[0] == 0
    good = toy.files()
    (toy.session / "numbers.txt").write_text("4 5 6")
    assert_refused(toy, "larger than this system allows", limit)
    (toy.session / "numbers.txt").write_text("1 2 3")
    assert run_toys(toy)[0] == 0
    assert toy.files() == good
    assert verify(toy.root) == []


def test_a_file_where_the_runs_should_be(toy: Toy) -> None:
    toy.runs.write_text("")
    assert_refused(toy, "a file is in the way of a folder")


# Damaged records


def test_a_damaged_record_is_named_by_verify_and_rebuilt(toy: Toy) -> None:
    toy.run()
    good = toy.files()
    (toy.root / "run.json").write_text('{"schema"')
    assert ("run.json", "damaged") in verify(toy.root)
    assert {step.reason for step in toy.run().steps} == {"run.json was damaged"}
    assert toy.files() == good
    assert verify(toy.root) == []


# Extending


def test_extending_respects_the_lock(toy: Toy) -> None:
    toy.run()
    events: list[Event] = []
    options = loop.LoopOptions(toy.request(session=None, judge=False, wait=False), events.append)
    before = toy.files()
    with (
        record.lock(toy.root, False),
        pytest.raises(InputError, match="another bampipe is at work"),
    ):
        loop.extend(options, "base", ("stribeck:yaw",))
    assert toy.files() == before


# Temporary files


@pytest.fixture
def full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder for temporary files in which nothing has room."""
    folder = tmp_path / "temporary"
    with small_disk(folder, "16k"):
        (folder / "filler").write_bytes(b"x" * 12288)
        monkeypatch.setattr(tempfile, "tempdir", str(folder))
        yield folder


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
        typeset.render_pdf([Document("title", "subtitle", ())])


def test_no_folder_at_all(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere() -> str:
        raise FileNotFoundError(2, "No usable temporary directory found in ['/tmp']")

    monkeypatch.setattr(tempfile, "gettempdir", nowhere)
    with pytest.raises(InputError, match="no folder for temporary files"):
        KeptItems([motion(10)], most=1)
