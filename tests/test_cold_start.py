"""On a cold start, processes beside the run compile what later stages need; once warm, none do."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from bampipe import compile_ahead, generated_code


class Started:
    """Takes the place of `subprocess.Popen`; notes what was started and ended."""

    def __init__(self) -> None:
        self.codes: list[str] = []
        self.ended = 0

    def __call__(self, command: list[str], **_: Any) -> "Started":
        self.codes.append(command[-1])
        return self

    def terminate(self) -> None:
        self.ended += 1

    def wait(self) -> None:
        assert self.ended, "waited for before it was ended"


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Started:
    found = Started()
    monkeypatch.setattr(compile_ahead.subprocess, "Popen", found)
    return found


def test_they_run_beside_a_run_where_nothing_was_compiled_from_these_sources(
    started: Started, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BAMPIPE_CACHE_DIR", str(tmp_path))
    with compile_ahead.compiling_ahead(2) as cold:
        assert len(started.codes) == 1 and cold and not started.ended
    with compile_ahead.compiling_ahead(3):
        assert len(started.codes) == 1 + len(compile_ahead._PARTS)
    assert started.ended == len(started.codes)
    started.codes.clear()
    estimate = Path(compile_ahead.__file__).with_name("estimate")
    folder = generated_code.make_compiled_folder(estimate)
    (folder / "simulation._run-1.py3.nbi").touch()
    with compile_ahead.compiling_ahead(2) as cold:
        assert len(started.codes) == 1 and "simulation" not in started.codes[0] and cold
    (folder / "square_root.filter_square_root-1.py3.nbi").touch()
    with compile_ahead.compiling_ahead(2) as cold:
        assert len(started.codes) == 1 and not cold


@pytest.mark.parametrize(("cores", "cache"), [(1, "."), (2, "file")])
def test_none_run_on_one_core_or_without_a_folder(
    started: Started, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cores: int, cache: str
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("BAMPIPE_CACHE_DIR", str(tmp_path / cache))
    with compile_ahead.compiling_ahead(cores):
        pass
    assert not started.codes


def test_what_they_compile_is_kept_and_nothing_comes_from_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, started: Started
) -> None:
    monkeypatch.setenv("BAMPIPE_CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "numba.py").write_text("raise SystemExit('imported from the working folder')")
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    with compile_ahead.compiling_ahead(3):  # of two processes, what the first compiles is little
        compiling = started.codes[0].removeprefix(f"{compile_ahead._END_WITH_PARENT}; ")
    monkeypatch.undo()
    noted = (
        "from bampipe import compiled; "
        "compiled._Cache.save_overload = lambda self, *_: print(self._impl.filename_base)"
    )
    for before in ("pass", noted):
        path, _, functions = compiling.partition("; ")
        done = subprocess.run(
            [sys.executable, "-P", "-c", f"import sys; {path}; {before}; {functions}"],
            cwd=tmp_path, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
    assert done.stdout == "", "compiled again"
