"""A disk that is full or read-only, records that are damaged: one line, and nothing lost."""

import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest
from conftest import TOYS, Toy

from bampipe.api import loop
from bampipe.errors import InputError
from bampipe.run import record
from bampipe.run.events import Event
from bampipe.run.verify import verify


def bampipe(toy: Toy, *more: str, limit: int | None = None) -> subprocess.CompletedProcess[str]:
    """Run the toys in another process; ``limit``: of the size of a file, bytes."""

    def limited() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    toys = ["--pipeline", str(toy.pipeline_file), "--runs", str(toy.runs), "--quiet"]
    command = [sys.executable, str(TOYS / "toy_bampipe.py"), "run", str(toy.session), *toys]
    return subprocess.run(
        [*command, *more], cwd=toy.folder, capture_output=True, text=True, preexec_fn=limited
    )


def refused(done: subprocess.CompletedProcess[str], message: str) -> None:
    """The process said ``message`` in one line and left with exit code 2."""
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1 and message in done.stderr, done.stderr


@pytest.fixture
def disk(toy: Toy) -> Iterator[Callable[[str], None]]:
    """Put the run folders on a disk of 1 MB; returns how to mount it again otherwise."""
    toy.runs.mkdir()

    def mount(*arguments: str) -> bool:
        command = ["mount", *arguments, str(toy.runs)]
        return subprocess.run(command, capture_output=True).returncode == 0

    if os.geteuid() != 0 or not mount("-t", "tmpfs", "-o", "size=1m", "tmpfs"):
        pytest.skip("a small disk can be mounted by root only, and not everywhere")
    try:
        yield lambda options: pytest.fail("remount") if not mount("-o", options) else None
    finally:
        subprocess.run(["umount", "-l", str(toy.runs)], check=True)


LONG = [pytest.param(room, marks=pytest.mark.long) for room in (4096, 8192, 16384, 24576)]


@pytest.mark.parametrize("room", [0, *LONG])
def test_a_full_disk_is_said_and_costs_nothing(
    toy: Toy, disk: Callable[[str], None], room: int
) -> None:
    assert bampipe(toy).returncode == 0
    good = toy.files()
    (toy.session / "numbers.txt").write_text("4 5 6 7 8")
    ballast = toy.runs / "ballast"
    free = os.statvfs(toy.runs)
    ballast.write_bytes(b"x" * (free.f_bavail * free.f_frsize - room))
    refused(bampipe(toy), "disk is full")
    for name, content in toy.files().items():
        if name.endswith(".json"):
            json.loads(content)
    assert not list(toy.root.rglob("*.partial"))
    ballast.unlink()
    assert bampipe(toy).returncode == 0
    whole = toy.files()
    assert verify(toy.root) == []
    (toy.session / "numbers.txt").write_text("1 2 3")
    assert bampipe(toy).returncode == 0
    assert toy.files() == good != whole


def test_a_read_only_disk_is_said_and_can_still_be_read(
    toy: Toy, disk: Callable[[str], None]
) -> None:
    assert bampipe(toy).returncode == 0
    good = toy.files()
    disk("remount,ro")
    refused(bampipe(toy), "read-only")
    assert toy.files() == good
    assert verify(toy.root) == []


@pytest.mark.parametrize(
    "limit", [60, *(pytest.param(n, marks=pytest.mark.long) for n in (0, 300, 1500))]
)
def test_a_file_that_may_not_grow_is_said(toy: Toy, limit: int) -> None:
    assert bampipe(toy).returncode == 0
    good = toy.files()
    (toy.session / "numbers.txt").write_text("4 5 6")
    toy.ran()
    environment = dict(os.environ)
    os.environ.pop("TOY_LOG")
    try:
        refused(bampipe(toy, limit=limit), "larger than this system allows")
        (toy.session / "numbers.txt").write_text("1 2 3")
        assert bampipe(toy).returncode == 0
    finally:
        os.environ.update(environment)
    assert toy.files() == good
    assert verify(toy.root) == []


def test_a_file_where_the_runs_should_be(toy: Toy) -> None:
    toy.runs.write_text("")
    refused(bampipe(toy), "a file is in the way of a folder")


# Damaged records


def test_a_damaged_record_is_named_by_verify_and_rebuilt(toy: Toy) -> None:
    toy.run()
    good = toy.files()
    (toy.root / "run.json").write_text('{"schema"')
    assert ("run.json", "damaged") in verify(toy.root)
    assert {step.reason for step in toy.run().steps} == {"run.json was damaged"}
    assert toy.files() == good
    assert verify(toy.root) == []


def test_a_commit_whose_files_were_cut_off_is_dropped(toy: Toy) -> None:
    """A sealed step, as a kill before its files were moved leaves it."""
    toy.run()
    good = toy.files()
    made = json.loads((toy.root / "run.json").read_text())["stages"]["toy_double"]
    folder = toy.root / ".bampipe" / "staging" / "toy_double"
    (folder / "toy").mkdir(parents=True)
    entry = {"step": "toy_double", "record": made, "timing": {}, "remove": []}
    (folder / ".commit.json").write_text(json.dumps(entry))
    (folder / "toy" / "double.json").write_text("{}")
    toy.run()
    assert toy.files() == good


# Extending


def test_extending_respects_the_lock(toy: Toy) -> None:
    toy.run()
    events: list[Event] = []
    options = loop.LoopOptions(toy.root, toy.request().pipeline, False, False, events.append)
    before = toy.files()
    with (
        record.lock(toy.root, False),
        pytest.raises(InputError, match="another bampipe is at work"),
    ):
        loop.extend(options, "base", ("stribeck:yaw",))
    assert toy.files() == before
