"""Code kept on disk: what cannot be read, or was made from other sources, is made again."""

import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numba.core import caching

from bampipe import compiled, generated_code
from bampipe.errors import InputError
from bampipe.physics import registry
from bampipe.physics.model import Model
from bampipe.physics.system import System, compile_model

CALLED = """
from numba import float64
from bampipe.compiled import njit

@njit(float64(float64))
def inner(x):
    return {factor} * x
"""
CALLER = """
from numba import float64
from bampipe.compiled import njit
from inner_of_test import inner

@njit(float64(float64))
def outer(x):
    return inner(x) + 1.0
"""


def load(path: Path) -> ModuleType:
    """A fresh copy of a module, as a new process would load it."""
    generated_code.hash_sources.cache_clear()
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def cached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of all cached code."""
    monkeypatch.setenv("BAMPIPE_CACHE_DIR", str(tmp_path / "cache"))
    # Two versions of a module written within a second pass for one where bytecode is kept.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return tmp_path / "cache"


Call = Callable[..., float]


@pytest.fixture
def call(tmp_path: Path, cached: Path) -> Call:
    """Compile a function that calls another, as a new process would, and call it."""

    def load_and_call(factor: float, checkout: str = "code") -> float:
        folder = tmp_path / checkout
        folder.mkdir(exist_ok=True)
        for name, text in (("inner", CALLED.format(factor=factor)), ("outer", CALLER)):
            (folder / f"{name}_of_test.py").write_text(text)
        load(folder / "inner_of_test.py")
        return float(load(folder / "outer_of_test.py").outer(3.0))

    assert load_and_call(2.0) == 7.0
    return load_and_call


def code_files(cached: Path) -> dict[str, Path]:
    return {path.name.partition("-")[0]: path for path in sorted(cached.rglob("*.nb[ci]"))}


@pytest.fixture
def saved(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Functions whose code is written from here on."""
    names: list[str] = []
    save = caching.IndexDataCacheFile._save_data

    def noting(self: Any, name: str, data: Any) -> None:
        names.append(name.partition("-")[0])
        save(self, name, data)

    monkeypatch.setattr(caching.IndexDataCacheFile, "_save_data", noting)
    return names


def test_code_is_cached_and_read_again(call: Call, cached: Path, saved: list[str]) -> None:
    assert set(code_files(cached)) == {"inner_of_test.inner", "outer_of_test.outer"}
    assert call(2.0) == 7.0
    assert saved == [], "nothing was compiled again"


def test_sources_elsewhere_find_the_code_and_a_changed_callee_recompiles_its_callers(
    call: Call, saved: list[str]
) -> None:
    assert call(2.0, checkout="another") == 7.0
    assert saved == []
    assert call(5.0) == 16.0
    assert saved == ["inner_of_test.inner", "outer_of_test.outer"]
    saved.clear()
    assert call(2.0) == 7.0 and saved == [], "both versions stay side by side"


def test_code_that_nothing_used_for_a_month_is_removed(call: Call, cached: Path) -> None:
    (old,) = {path.parent for path in code_files(cached).values()}
    os.utime(old, (0.0, 0.0))
    assert call(2.0) == 7.0 and old.stat().st_mtime > 0.0
    os.utime(old, (0.0, 0.0))
    assert call(5.0) == 16.0
    assert not old.exists()


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("content", [0, 100, 4000])
def test_code_that_was_cut_off_is_compiled_again(
    call: Call, cached: Path, saved: list[str], suffix: str, content: int
) -> None:
    (target,) = cached.rglob(f"outer_of_test*{suffix}")
    target.write_bytes(os.urandom(4000) if content == 4000 else target.read_bytes()[:content])
    assert call(2.0) == 7.0
    assert saved == ["outer_of_test.outer"]
    saved.clear()
    assert call(2.0) == 7.0 and saved == []


def full(*_: object, **__: object) -> None:
    raise OSError(28, "No space left on device")


def test_a_full_disk_costs_the_cache_only(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(caching.IndexDataCacheFile, "_open_for_write", full)
    monkeypatch.setattr(compiled.FileLock, "acquire", full)
    assert call(4.0) == 13.0


def test_without_a_folder_every_process_compiles_for_itself(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("BAMPIPE_CACHE_DIR", str(tmp_path / "file" / "cache"))
    assert call(4.0) == 13.0


COMPILE = """
import sys, time
sys.path.insert(0, {folder!r})
from bampipe import compiled, generated_code
save = compiled._Cache.save_overload
def slow_save(self, *given):
    time.sleep(0.5)
    print(self._impl.filename_base.partition("-")[0])
    save(self, *given)
compiled._Cache.save_overload = slow_save
import outer_of_test
assert outer_of_test.outer(3.0) == 7.0
"""


def test_processes_that_start_together_compile_once(
    call: Call, cached: Path, tmp_path: Path
) -> None:
    for path in next(iter(code_files(cached).values())).parent.iterdir():
        path.unlink()
    command = [sys.executable, "-c", COMPILE.format(folder=str(tmp_path / "code"))]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    printed = "".join(process.communicate()[0] for process in running)
    assert all(process.returncode == 0 for process in running)
    assert sorted(printed.split()) == ["inner_of_test.inner", "outer_of_test.outer"]


class Cache(compiled._Cache):
    """A function's cache as another process would see it: nothing compiled yet."""

    index = property(lambda self: self.folder / "function.nbi")

    def __init__(self, folder: Path) -> None:
        self.folder = folder


def test_a_process_that_dies_while_compiling_holds_up_nobody(tmp_path: Path) -> None:
    code = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "sys.path.insert(0, sys.argv[2])\n"
        "from test_code_cache import Cache, compiled\n"
        "with compiled._one_process_at_a_time(Cache(Path(sys.argv[1]))):\n"
        "    os._exit(0)\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path), str(Path(__file__).parent)]
    subprocess.run(command, check=True)
    assert (tmp_path / "function.lock").exists(), "it had begun"
    begun = time.monotonic()
    with compiled._one_process_at_a_time(Cache(tmp_path)):
        assert time.monotonic() - begun < 10.0


def test_a_process_that_hangs_while_compiling_is_not_waited_for_without_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiled, "_PATIENCE_S", 0.1)
    with compiled._one_process_at_a_time(Cache(tmp_path)):
        begun = time.monotonic()
        with compiled._one_process_at_a_time(Cache(tmp_path)):
            assert 0.1 <= time.monotonic() - begun < 10.0


# Generated source


@pytest.fixture
def model(cached: Path) -> Model:
    return Model(registry.device("slider"), ("quadratic_drag:carriage",))


def inertia(system: System) -> float:
    """Something that the generated columns compute; as a new process would."""
    for name in [name for name in sys.modules if name.startswith("bampipe_generated_")]:
        del sys.modules[name]
    one = np.ones((1, len(system.coordinates)))
    return float(system.mass_matrix(one, system.prior)[0, 0, 0])


@pytest.mark.parametrize("name", ["", "_whole"])
@pytest.mark.parametrize("content", [b"", b"\x00\xff import os", b'{"facts": {', b"[]"])
def test_damaged_generated_code_is_generated_again(
    model: Model, cached: Path, name: str, content: bytes
) -> None:
    right = inertia(compile_model(model))
    (path,) = cached.rglob(f"model_{model.key}{name}.json")
    sound = path.read_bytes()
    path.write_bytes(content)
    assert inertia(compile_model(model)) == right
    assert path.read_bytes() == sound


def test_the_memory_of_an_effect_is_compiled_once_for_all_joints(cached: Path) -> None:
    """Its text knows columns by number only; on either axis it uses its own."""
    device = registry.device("bam")
    axes = tuple(c.name for c in device.coordinates)[:2]
    systems = [compile_model(Model(device, (f"presliding:{axis}",))) for axis in axes]
    t = np.linspace(0.0, 0.5, 200)
    still = np.zeros((len(t), len(device.coordinates)))
    for k, system in enumerate(systems):
        u = np.zeros((len(t), len(system.inputs)))
        qd = still.copy()
        qd[:, k] = 0.3 * np.sin(12.0 * t)
        assert np.ptp(system.memory(still, qd, still, u, system.prior, t)) > 0.0
        assert np.ptp(system.memory(still, np.roll(qd, 1, 1), still, u, system.prior, t)) == 0.0
    (source,) = {system._code.sources["memory0"] for system in systems}
    both = compile_model(Model(device, [f"presliding:{axis}" for axis in axes]))
    assert {both._code.sources[g.module] for g in both.state_groups} == {source}
    together = both.memory(still, qd, still, u, both.prior, t)
    alone = systems[1].memory(still, qd, still, u, systems[1].prior, t)
    np.testing.assert_array_equal(together[:, 1:], alone)


def test_generated_code_that_cannot_be_kept_is_said(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full)
        with pytest.raises(InputError, match=r"the disk is full; set BAMPIPE_CACHE_DIR"):
            compile_model(model)
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("BAMPIPE_CACHE_DIR", str(tmp_path / "file" / "cache"))
    with pytest.raises(InputError, match=r"cannot make .*not a directory.*BAMPIPE_CACHE_DIR"):
        compile_model(model)


@pytest.mark.slow
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
