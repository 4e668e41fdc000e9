"""Code kept on disk is checked before it runs: damaged, outdated or foreign code never does."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np
import pytest

from bampipe import compiled
from bampipe.errors import InputError
from bampipe.physics import generated, registry
from bampipe.physics.model import Model
from bampipe.physics.system import System, compile_model

CALLED = """
from numba import float64
from bampipe.compiled import njit

@njit(float64(float64), cache=True)
def inner(x):
    return {factor} * x
"""
CALLER = """
from numba import float64
from bampipe.compiled import njit
from inner_of_test import inner

@njit(float64(float64), cache=True)
def outer(x):
    return inner(x) + 1.0
"""


def load(path: Path) -> ModuleType:
    """A fresh copy of a module, as a new process would load it."""
    compiled._sources.cache_clear()
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def function(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Compile a function that calls another; returns how to load both again, and their files."""
    # Beside the sources, wherever the environment keeps the code of other modules.
    # The variable too: numba reads it again when it first compiles.
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    folder = tmp_path / "code"
    folder.mkdir()

    def again(factor: float) -> float:
        text = CALLED.format(factor=factor)
        inner = folder / "inner_of_test.py"
        if not inner.exists() or inner.read_text() != text:
            inner.write_text(text)
        (folder / "outer_of_test.py").write_text(CALLER)
        load(inner)
        return float(load(folder / "outer_of_test.py").outer(3.0))

    assert again(2.0) == 7.0
    return again, folder / "__pycache__"


def kept(folder: Path) -> dict[str, Path]:
    return {path.name.partition("-")[0]: path for path in sorted(folder.glob("*.nbc"))}


def test_code_is_kept_and_read_again(function: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    again, folder = function
    assert set(kept(folder)) == {"inner_of_test.inner", "outer_of_test.outer"}
    saved: list[object] = []
    monkeypatch.setattr(compiled._CodeFiles, "save", lambda self, key, data: saved.append(key))
    assert again(2.0) == 7.0
    assert saved == [], "nothing was compiled again"


def test_a_changed_callee_recompiles_its_callers_in_other_files(function: Any) -> None:
    again, folder = function
    before = set(folder.glob("*.nbc"))
    assert again(5.0) == 16.0
    after = set(folder.glob("*.nbc"))
    assert len(after) == 2 and not after & before, "what older sources left is dropped"


@pytest.mark.parametrize("damage", ["truncated", "flipped", "garbage", "empty", "swapped"])
def test_damaged_code_is_compiled_again(function: Any, damage: str) -> None:
    again, folder = function
    files = kept(folder)
    sound = {name: path.read_bytes() for name, path in files.items()}
    target, other = files["outer_of_test.outer"], files["inner_of_test.inner"]
    content = bytearray(target.read_bytes())
    content[-100] ^= 1
    target.write_bytes(
        {
            "truncated": target.read_bytes()[:200],
            "flipped": bytes(content),
            "garbage": os.urandom(4000),
            "empty": b"",
            "swapped": other.read_bytes(),
        }[damage]
    )
    broken = target.read_bytes()
    assert again(2.0) == 7.0
    assert target.read_bytes() != broken
    assert kept(folder).keys() == sound.keys()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file to somebody else")
def test_code_of_another_user_is_not_run(function: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    again, folder = function
    for path in folder.glob("*.nbc"):
        os.chown(path, 4321, 4321)
    monkeypatch.setattr(compiled.pickle, "loads", lambda content: pytest.fail("it was read"))
    assert again(2.0) == 7.0


def test_a_full_disk_costs_the_cache_only(function: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    again, folder = function

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(compiled.tempfile, "mkstemp", full)
    assert again(4.0) == 13.0
    assert not list(folder.glob(".*"))


def code_files(folder: Path) -> compiled._CodeFiles:
    """What another process would see of one function: claims of files are the file's, not ours."""
    return compiled._CodeFiles(folder, "module.function", "stamp", {os.geteuid()})


def test_what_another_process_compiles_is_waited_for(tmp_path: Path) -> None:
    first, second = code_files(tmp_path), code_files(tmp_path)
    assert first.load("key") is None
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(second.load, "key")
        with pytest.raises(TimeoutError):
            waiting.result(timeout=0.2)
        first.save("key", "code")
        assert waiting.result(timeout=10.0) == "code"
    assert [path.suffix for path in tmp_path.iterdir()] == [".nbc"], "no claim is left"


def test_a_process_that_dies_while_compiling_holds_up_nobody(tmp_path: Path) -> None:
    first, second = code_files(tmp_path), code_files(tmp_path)
    assert first.load("key") is None
    for handle in first._claims.values():
        os.close(handle)  # as its end would
    assert second.load("key") is None
    second.save("key", "code")
    assert first.load("key") == "code"


def test_a_process_that_hangs_while_compiling_is_not_waited_for_without_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiled, "_PATIENCE_S", 0.1)
    first, second = code_files(tmp_path), code_files(tmp_path)
    assert first.load("key") is None
    assert second.load("key") is None
    second.save("key", "code")
    assert code_files(tmp_path).load("key") == "code"


# Generated source


@pytest.fixture
def model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Model:
    monkeypatch.setenv("BAMPIPE_CACHE_DIR", str(tmp_path / "cache"))
    return Model(registry.device("slider"), ("quadratic_drag:carriage",))


def energy(system: System) -> float:
    """Something that the generated columns compute; as a new process would."""
    for name in [name for name in sys.modules if name.startswith("bampipe_generated_")]:
        del sys.modules[name]
    one = np.ones((1, len(system.coordinates)))
    kinetic, potential = system.energy(one, one, system.prior)
    return float(kinetic[0] + potential[0])


@pytest.mark.parametrize("name", ["columns", "compiled", "rows", "meta"])
@pytest.mark.parametrize("damage", ["truncated", "edited", "garbage", "gone"])
def test_damaged_generated_code_is_generated_again(
    model: Model, tmp_path: Path, name: str, damage: str
) -> None:
    right = energy(compile_model(model))
    (path,) = (tmp_path / "cache").rglob(f"{name}_*")
    sound = path.read_bytes()
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes(
            {
                "truncated": sound[: len(sound) // 2],
                "edited": sound.replace(b"0.5", b"0.7").replace(b"true", b"false"),
                "garbage": b"\x00\xff import os",
            }[damage]
        )
    assert energy(compile_model(model)) == right
    assert path.read_bytes() == sound


def test_code_that_nobody_vouches_for_is_not_run(model: Model, tmp_path: Path) -> None:
    """A module planted for a model that was never generated is overwritten, not executed."""
    folder = generated.folder_of_user()
    planted = folder / f"columns_{model.key}.py"
    planted.write_text("raise SystemExit('planted code ran')\n")
    energy(compile_model(model))
    assert "planted" not in planted.read_text()


def test_no_byte_code_stands_beside_generated_source(model: Model, tmp_path: Path) -> None:
    energy(compile_model(model))
    assert not list((tmp_path / "cache").rglob("*.pyc"))


@pytest.mark.parametrize("place", ["python", "__pycache__"])
def test_a_cache_that_others_may_write_is_refused(model: Model, tmp_path: Path, place: str) -> None:
    folder = generated.folder_of_user()
    assert folder.stat().st_mode & 0o777 == 0o700
    target = folder if place == "python" else folder / place
    target.mkdir(exist_ok=True)
    target.chmod(0o777)
    with pytest.raises(InputError, match=r"other users may write .*BAMPIPE_CACHE_DIR"):
        compile_model(model)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder to somebody else")
def test_a_cache_of_another_user_is_refused(model: Model, tmp_path: Path) -> None:
    os.chown(generated.folder_of_user(), 4321, 4321)
    with pytest.raises(InputError, match="belongs to another user"):
        compile_model(model)


def test_a_cache_that_cannot_be_made_is_said(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("BAMPIPE_CACHE_DIR", str(tmp_path / "file" / "cache"))
    with pytest.raises(InputError, match=r"cannot make .*not a directory.*BAMPIPE_CACHE_DIR"):
        compile_model(model)


def test_generated_code_that_cannot_be_written_is_said(
    model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(generated.tempfile, "mkstemp", full)
    with pytest.raises(InputError, match=r"no space left on device; set BAMPIPE_CACHE_DIR"):
        compile_model(model)


def test_facts_are_json(model: Model, tmp_path: Path) -> None:
    compile_model(model)
    (path,) = (tmp_path / "cache").rglob("meta_*.json")
    content = json.loads(path.read_text())
    assert set(content) == {"format", "facts", "sources", "hash"}


def test_a_read_only_home_needs_one_line(tmp_path: Path) -> None:
    """The cache is only wanted once a model is; then its place is named."""
    (tmp_path / "home").write_text("no folder")
    environment = {**os.environ, "HOME": str(tmp_path / "home")}
    for name in ("BAMPIPE_CACHE_DIR", "XDG_CACHE_HOME"):
        environment.pop(name, None)
    command = [sys.executable, "-m", "bampipe", "simulate", str(tmp_path / "out"), "--quiet"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and "BAMPIPE_CACHE_DIR" in done.stderr
    assert not (tmp_path / "out").exists()
