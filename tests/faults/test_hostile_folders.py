"""Run folders that somebody else prepared: nothing outside them is read, written or removed."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import Command, Toy

from bampipe.api import loop
from bampipe.data.session import read_session
from bampipe.errors import InputError
from bampipe.files import digest_bytes, is_inside, is_normal, read_json, read_toml
from bampipe.results.run import is_result
from bampipe.run.events import ignore_event

PLANTED = digest_bytes(b"planted")


def are_said(lines: str) -> bool:
    """Whether what stands on standard error is messages, and no traceback."""
    return all(line.startswith("bampipe: ") for line in lines.splitlines())


def everything(folder: Path) -> dict[str, bytes | None]:
    return {str(path): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@pytest.fixture
def outside(toy: Toy) -> Path:
    """A folder beside the run folders that no command has any business in."""
    toy.run()
    folder = toy.folder / "outside"
    for name in ("toy_double/mine.txt", "other/mine.txt", "double.json", "lock"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("mine")
    return folder


def plant(
    toy: Toy,
    outputs: dict[str, str],
    remove: tuple[str, ...] = (),
    step: str = "toy_double",
    files: tuple[str, ...] = (),
) -> Path:
    """Leave a commit file as a killed run would, which names ``outputs`` and ``remove``."""
    kept = json.loads((toy.root / "run.json").read_text())
    made = kept["stages"]["toy_double"]
    folder = toy.root / ".bampipe" / "staging" / "toy_double"
    folder.mkdir(parents=True, exist_ok=True)
    for name in files or outputs:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("planted")
    entry = {
        "step": step,
        "record": {**made, "outputs": {**made["outputs"], **outputs}},
        "timing": kept["timings"]["toy_double"],
        "remove": list(remove),
    }
    (folder / ".commit.json").write_text(json.dumps(entry))
    return folder


@pytest.mark.parametrize("name", ["run.json", ".bampipe/lock", ".bampipe/staging", "toy"])
def test_a_folder_for_a_file_or_a_file_for_a_folder_is_one_line_or_mended(
    toy: Toy, outside: Path, command: Command, name: str
) -> None:
    path = toy.root / name
    if path.is_dir():
        shutil.rmtree(path)
        path.write_text("in the way")
    else:
        path.unlink(missing_ok=True)
        path.mkdir()
    code, _, said = command("run", toy.session, *toy.options, "--force")
    assert code == 2 and "in the way" in said.splitlines()[-1]
    assert "Traceback" not in said


# Names


NOT_NORMAL = [
    "", ".", "..", "/etc/passwd", "./a", "a/./b", "a//b", "a/", "a/../b", "../a", "a\\b", "a\0b",
    "a\nb", ".bam\u200cpipe/x", "\ud800", None,
]  # fmt: skip


@pytest.mark.parametrize("name", NOT_NORMAL)
def test_a_name_that_is_not_normal_is_no_name_of_a_result(tmp_path: Path, name: object) -> None:
    assert not is_normal(name)
    assert not is_inside(tmp_path, name)
    assert not is_result(name)


@pytest.mark.parametrize(
    "name", ["run.json", ".bampipe", ".bampipe/lock", ".bampipe/staging/x", ".BAMPIPE/lock"]
)
def test_files_of_the_runner_are_no_results(name: str) -> None:
    assert is_normal(name) and not is_result(name)


def test_inside_means_links_followed(tmp_path: Path) -> None:
    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / "a/out").symlink_to("../..")
    (tmp_path / "a/in").symlink_to("b")
    (tmp_path / "a/self").symlink_to("self")
    assert is_inside(tmp_path, "a/b/new.json") and is_inside(tmp_path, "a/in/new.json")
    assert not is_inside(tmp_path, "a/out/new.json")
    assert not is_inside(tmp_path, "a/self/new.json")


# Planted commits


@pytest.mark.parametrize(
    ("outputs", "remove", "step"),
    [
        ({"../../../../outside/double.json": PLANTED}, (), "toy_double"),
        ({"run.json": PLANTED}, (), "toy_double"),
        ({"toy/more.json": PLANTED}, ("../../outside/double.json",), "toy_double"),
        ({"toy/more.json": PLANTED}, (), "toy_read"),
        ({"toy/more.json": PLANTED}, (), "../toy_double"),
    ],
)
def test_a_planted_commit_that_reaches_further_is_dropped(
    toy: Toy, outside: Path, outputs: dict[str, str], remove: tuple[str, ...], step: str
) -> None:
    good, kept = toy.files(), everything(outside)
    plant(toy, outputs, remove, step, files=("toy/more.json",))
    toy.run()
    assert toy.files() == good
    assert everything(outside) == kept


def test_a_commit_whose_files_were_cut_off_is_dropped(toy: Toy, outside: Path) -> None:
    """A sealed step, as a kill before its files were moved leaves it."""
    good = toy.files()
    toy.ran()
    plant(toy, {}, files=("toy/double.json",))
    toy.run()
    assert toy.files() == good and toy.ran() == [], "what was there counts"


def test_a_commit_through_a_link_in_staging_is_dropped(toy: Toy, outside: Path) -> None:
    staging = plant(toy, {"toy/link/double.json": digest_bytes(b"mine")}, files=("toy/x",))
    (staging / "toy/link").symlink_to(outside)
    toy.run()
    assert (outside / "double.json").read_text() == "mine"


# The record


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("stages", "toy_double", "declared_inputs"), ["../../outside/*"]),
        (("stages", "toy_double", "outputs"), {"../../outside/double.json": digest_bytes(b"mine")}),
        (("failures",), {"toy_double": 5}),
        (("place",), {"session": "\0"}),
        (("pipeline",), {"name": "x", "stages": 5, "settings": [], "device": 5, "effects": 5}),
        (("stages",), []),
    ],
)
def test_an_edited_record_is_one_line_or_rebuilt(
    toy: Toy, outside: Path, command: Command, path: tuple[str, ...], value: object
) -> None:
    good, kept = toy.files(), everything(outside)
    content = json.loads((toy.root / "run.json").read_text())
    table = content
    for key in path[:-1]:
        table = table[key]
    table[path[-1]] = value
    (toy.root / "run.json").write_text(json.dumps(content))
    for given in (("status",), ("verify",), ("extend", "stribeck:yaw"), ("accept",)):
        code, _, said = command(given[0], "first", *given[1:], "--runs", toy.runs)
        assert code in (0, 1, 2) and are_said(said), said
    code, _, said = command("run", toy.session, *toy.options)
    assert code == 0, said
    assert toy.files() == good and everything(outside) == kept


UNREADABLE = {
    "empty": b"",
    "digits": b'{"schema": ' + b"9" * 5000 + b"}",
    "brackets": b"[" * 200_000,
    "tables": b'{"a":' * 200_000,
    "bytes": b"\xff\xfe\x00",
    "nul": b"\0" * 100,
    "a list": b"[]",
}


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *(("run.json", kind) for kind in UNREADABLE),
        (".bampipe/staging/toy_double/.commit.json", "brackets"),
        (".bampipe/staging/toy_double/.commit.json", "tables"),
        ("toy/double.json", "bytes"),
        ("models/base/model.toml", "nul"),
    ],
)
def test_what_json_and_toml_can_do_is_one_line_or_rebuilt(
    toy: Toy, outside: Path, command: Command, name: str, kind: str
) -> None:
    good = toy.files()
    path = toy.root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(UNREADABLE[kind])
    for given in ("status", "verify"):
        code, _, said = command(given, "first", "--runs", toy.runs)
        assert code in (0, 1, 2) and are_said(said), said
    code, _, said = command("run", toy.session, *toy.options)
    assert code == 0, said
    assert toy.files() == good


@pytest.mark.parametrize("read", [read_json, read_toml])
@pytest.mark.parametrize("name", [".", "fifo", "/dev/zero", "nothing", "\0"])
def test_only_regular_files_are_opened(
    tmp_path: Path, read: Callable[[Path], object], name: str
) -> None:
    os.mkfifo(tmp_path / "fifo")
    with pytest.raises(InputError):
        read(tmp_path / name)


@pytest.mark.parametrize("trials", ["5", "[5]", '{ file = "a" }'])
def test_trials_that_are_no_tables_are_one_line(toy: Toy, command: Command, trials: str) -> None:
    file = toy.session / "session.toml"
    head = file.read_text().partition("[[trials]]")[0]
    file.write_text(f"{head}trials = {trials}\n")
    code, _, said = command("run", toy.session, *toy.options)
    assert code == 0, said  # the toys want no trials
    with pytest.raises(InputError, match="trials"):
        read_session(toy.session)


# Extending


def test_an_effect_whose_name_is_a_path_writes_nothing(toy: Toy, outside: Path) -> None:
    """A diagnosis in a run folder names effects: `extend --auto` takes them from there."""
    options = loop.LoopOptions(toy.request(session=None, judge=False, wait=False), ignore_event)
    before = everything(toy.folder)
    for name in ("../../../outside/x", "a/b:yaw", "x:../../y", "\0", ".."):
        with pytest.raises(InputError):
            loop.extend(options, "base", (name,))
    changed = {k for k, v in everything(toy.folder).items() if before.get(k, 0) != v}
    assert changed <= {str(toy.root / ".bampipe/lock")}
