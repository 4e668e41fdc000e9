"""Runs published on file systems that fsspec knows: whole or not at all, and fetched back."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import Command, Toy, contents

from bampipe.errors import InputError
from bampipe.run.publish import CURRENT, fetch, publish, published

fsspec = pytest.importorskip("fsspec", reason="the remote extra is not installed")


@pytest.fixture(params=["memory", "file"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    if request.param == "file":
        yield f"file://{tmp_path / 'published'}"
        return
    memory = fsspec.filesystem("memory")
    yield "memory://published"
    if memory.exists("/published"):
        memory.rm("/published", recursive=True)


def make_run(root: Path, text: str = "1") -> Path:
    for name in ("run.json", "ingest/session.json", "report/figures/a.svg"):
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{name} {text}")
    (root / ".bampipe").mkdir(exist_ok=True)
    (root / ".bampipe/lock").write_text("")
    return root


def everything(url: str) -> dict[str, bytes]:
    system, base = fsspec.core.url_to_fs(url)
    return {str(path): system.cat_file(path) for path in system.find(base)}


def test_what_is_published_comes_back_and_is_not_sent_again(tmp_path: Path, url: str) -> None:
    root = make_run(tmp_path / "runs/s1")
    first = publish(root, url)
    assert published(url) == ["s1"]
    assert not any("/.bampipe/" in name for name in everything(url))
    back = fetch(url, "s1", tmp_path / "elsewhere")
    assert contents(back) == contents(root)
    assert (back / "run.json").read_bytes() == (root / "run.json").read_bytes()
    assert [path.name for path in (tmp_path / "elsewhere").iterdir()] == ["s1"]
    before = everything(url)
    assert publish(root, url) == first
    assert everything(url) == before


def test_a_cut_short_upload_shows_the_old_version_and_is_completed(
    tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = make_run(tmp_path / "runs/s1")
    publish(root, url)
    old = contents(root)
    make_run(root, "2, longer")
    kind = type(fsspec.core.url_to_fs(url)[0])
    whole = kind.put_file
    sent: list[str] = []

    def failing(self: Any, source: str, target: str, *more: Any, **options: Any) -> None:
        if sent:
            raise OSError(5, "the line is dead")
        sent.append(target)
        whole(self, source, target, *more, **options)

    monkeypatch.setattr(kind, "put_file", failing)
    with pytest.raises(InputError, match="cannot be published"):
        publish(root, url)
    monkeypatch.setattr(kind, "put_file", whole)
    assert contents(fetch(url, "s1", tmp_path / "a")) == old
    publish(root, url)
    assert contents(fetch(url, "s1", tmp_path / "b")) == contents(root) != old


def test_the_pointer_is_never_half_written(
    tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = make_run(tmp_path / "runs/s1")
    publish(root, url)
    old = contents(root)
    make_run(root, "2")
    system, _ = fsspec.core.url_to_fs(url)

    def killed(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(type(system.transaction), "complete", killed)
    with pytest.raises(KeyboardInterrupt):
        publish(root, url)
    monkeypatch.undo()
    system.transaction.files.clear()
    system.end_transaction()
    assert contents(fetch(url, "s1", tmp_path / "a")) == old


def test_a_file_that_changed_on_the_way_is_refused(tmp_path: Path, url: str) -> None:
    publish(make_run(tmp_path / "runs/s1"), url)
    system, base = fsspec.core.url_to_fs(url)
    name = next(str(path) for path in system.find(base) if str(path).endswith("a.svg"))
    system.pipe_file(name, b"other")
    with pytest.raises(InputError, match=r"figures/a\.svg is not as it was published"):
        fetch(url, "s1", tmp_path / "elsewhere")
    assert list((tmp_path / "elsewhere").iterdir()) == []


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("files", {"../../out.txt": "0"}, "is not that of a result"),
        ("files", {".bampipe/lock": "0"}, "is not that of a result"),
        ("files", {"run.json": None}, "expected text"),
        ("files", ["run.json"], "expected a table"),
        ("version", "../../s2/current", "expected a name that matches"),
        ("version", None, "expected text"),
        ("schema", "bampipe.published/2", 'expected "bampipe.published/1"'),
    ],
)
def test_what_a_hostile_store_says_stays_in_the_run_folder(
    tmp_path: Path, url: str, field: str, value: object, said: str
) -> None:
    publish(make_run(tmp_path / "runs/s1"), url)
    system, base = fsspec.core.url_to_fs(url)
    pointer = f"{base}/s1/{CURRENT}"
    content = json.loads(system.cat_file(pointer)) | {field: value}
    system.pipe_file(pointer, json.dumps(content).encode())
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match=said):
        fetch(url, "s1", tmp_path / "elsewhere")
    assert sorted(tmp_path.rglob("*")) == before


def test_a_listing_names_sessions_only(
    tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A store may list what it likes: `..` with --force would replace the folder of runs."""
    publish(make_run(tmp_path / "runs/s1"), url)
    system, base = fsspec.core.url_to_fs(url)
    listed = [f"{base}/s1", f"{base}/..", f"{base}/.", f"{base}/a\x1bb"]
    monkeypatch.setattr(type(system), "ls", lambda *_, **__: listed)
    monkeypatch.setattr(type(system), "exists", lambda *_, **__: True)
    assert published(url) == ["s1"]


def test_another_run_is_replaced_only_when_told(tmp_path: Path, url: str) -> None:
    root = make_run(tmp_path / "runs/s1")
    publish(root, url)
    assert fetch(url, "s1", tmp_path / "runs") == root
    make_run(root, "2")
    with pytest.raises(InputError, match="another run"):
        fetch(url, "s1", tmp_path / "runs")
    fetch(url, "s1", tmp_path / "runs", force=True)
    assert (root / "run.json").read_text() == "run.json 1"
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["s1"]


def test_a_session_that_is_not_published_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no session 's1' is published"):
        fetch(f"file://{tmp_path / 'empty'}", "s1", tmp_path / "runs")


def test_run_publishes_and_fetch_fetches(toy: Toy, command: Command) -> None:
    url = f"file://{toy.folder / 'far'}"
    arguments = (*toy.options, "--publish", url)
    assert command("run", toy.session, *arguments)[0] == 0
    files = toy.files()
    shutil.rmtree(toy.root)
    code, out, _ = command("fetch", url, "--runs", toy.runs)
    assert code == 0 and "first" in out
    assert toy.files() == files
    code, _, err = command("fetch", url, "frist", "--runs", toy.runs)
    assert code == 2 and "did you mean 'first'?" in err
    # What was fetched is a run like any other: nothing needs to run again.
    code, out, _ = command("run", toy.session, *arguments, "--json")
    states = {step["state"] for step in json.loads(out)["sessions"][0]["steps"].values()}
    assert code == 0 and states == {"unchanged"}


@pytest.mark.parametrize("url", ["nowhere://x", "dir://x", "hdfs://x"])
def test_an_address_of_no_use_is_said_before_the_run(toy: Toy, command: Command, url: str) -> None:
    code, _, said = command("run", toy.session, *toy.options, "--publish", url)
    assert code == 2 and said.count("\n") == 1 and "no such file system" in said
    assert toy.ran() == []
    assert command("fetch", url, "--runs", toy.runs)[0] == 2
