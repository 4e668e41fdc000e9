"""The law of the house: which layer may import what, and how soon the command line answers."""

import ast
import resource
import subprocess
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import bampipe
from bampipe.run import hashing
from bampipe.stages import base

PACKAGE = Path(bampipe.__file__).parent
HEAVY = (
    "h5py", "matplotlib", "numba", "numpy", "pandas", "pyarrow", "pydantic", "scipy", "sympy",
)  # fmt: skip


def law(libraries: str, rooms: str) -> set[str]:
    """What a layer may import: libraries by name, rooms and single files of bampipe by theirs."""
    own = [*rooms.split(), *(["arrays"] if "numpy" in libraries else [])]
    return {*libraries.split(), *(f"bampipe.{room}" for room in own)}


# What each layer may import beside the standard library and itself.
LAWS = {
    "physics": law(
        "numpy sympy numba llvmlite pydantic",
        "compiled generated_code errors model_functions schema",
    ),
    "estimate": law("numpy scipy numba llvmlite filterpy", "compiled errors model_functions"),
    "diagnosis": law(
        "numpy scipy sympy numba pyoperon pydantic",
        "errors lists physics estimate results schema trials workers",
    ),
    "results": law("pydantic", "errors files schema"),
    "phrases": law("", "errors lists results"),
    "data": law("numpy scipy pandas pyarrow h5py pydantic", "errors lists schema files results"),
    "trials": law("numpy scipy pandas pyarrow numba", "errors files results physics estimate data"),
    "setup": law("numpy scipy", "errors files lists results physics estimate data trials"),
    "identification": law(
        "numpy scipy pandas pyarrow numba pydantic",
        "schema errors lists results phrases progress physics estimate data trials diagnosis",
    ),
    "next_trial": law(
        "numpy scipy",
        "errors lists results phrases physics estimate trials identification diagnosis",
    ),
    "declarations": law(
        "numpy scipy pandas pydantic matplotlib",
        "errors files lists schema stages.base results physics data",
    ),
    "simulator": law(
        "numpy scipy pandas pyarrow numba pydantic",
        "errors files lists schema results progress physics estimate data",
    ),
    "monitor": law(
        "numpy scipy pandas pyarrow numba",
        "errors files results physics estimate data declarations trials identification",
    ),
    "stages": law(
        "numpy scipy pandas pyarrow numba pydantic",
        "errors files lists schema results phrases progress physics estimate data declarations "
        "trials identification setup diagnosis next_trial report",
    ),
    "report": law(
        "numpy matplotlib typst pandas pyarrow bampipe",
        "data declarations errors lists files results phrases",
    ),
    "run": law(
        "pydantic dask distributed filelock fsspec bampipe",
        "progress compile_ahead errors files schema results phrases data declarations "
        "stages.base workers",
    ),
    "lab": law(
        "numpy scipy", "progress errors lists files results phrases data report run stages.base"
    ),
    "api": law(
        "numpy pandas",
        "progress errors files lists results phrases physics report run stages data declarations "
        "trials diagnosis",
    ),
    "cli": law(
        "typer rich bampipe",
        "progress api errors files results phrases report run lab stages physics diagnosis data "
        "declarations monitor setup simulator",
    ),
}


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imported(path: Path, lazily: bool = True) -> set[str]:
    """Full names of the modules that ``path`` imports; ``lazily``: inside functions too."""
    tree, found = tree_of(path), set()
    for node in ast.walk(tree) if lazily else _at_import(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def _at_import(tree: ast.AST) -> list[ast.AST]:
    """Nodes that run when the module is imported, type-checking blocks apart."""
    found: list[ast.AST] = []
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            continue
        found += [node, *_at_import(node)]
    return found


def sources(layer: str) -> list[Path]:
    return sorted((PACKAGE / layer).rglob("*.py"))


def allowed(name: str, layer: str) -> bool:
    top = name.partition(".")[0]
    if top in sys.stdlib_module_names or top == "__future__":
        return True
    if name.startswith(f"bampipe.{layer}.") or name == f"bampipe.{layer}":
        return True
    for permitted in LAWS[layer]:
        if permitted == "bampipe":
            if name == "bampipe" or name == "bampipe.__version__":
                return True
        elif name == permitted or name.startswith(permitted + "."):
            return True
    return False


@pytest.mark.parametrize("layer", LAWS)
def test_a_layer_imports_only_what_the_law_allows(layer: str) -> None:
    broken = [
        f"{path.relative_to(PACKAGE)} imports {name}"
        for path in sources(layer)
        for name in sorted(imported(path))
        if not allowed(name, layer)
    ]
    assert sources(layer)
    assert broken == []


@pytest.mark.parametrize("layer", LAWS)
def test_no_modules_of_a_layer_import_each_other_in_a_circle(layer: str) -> None:
    """Not lazily either, nor for types alone."""
    modules = {}
    for path in sources(layer):
        parts = ["bampipe", *path.relative_to(PACKAGE).with_suffix("").parts]
        modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path

    def module_of(name: str) -> str:
        return name if name in modules else name.rpartition(".")[0]

    graph = {
        module: {module_of(name) for name in imported(path)} & modules.keys()
        for module, path in modules.items()
    }
    assert any(graph.values()) or layer == "stages"  # no stage imports another
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"a circle of imports: {' <- '.join(error.args[1])}")


def test_every_layer_is_under_the_law_and_what_is_compiled_kept() -> None:
    layers = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()}
    assert layers == set(LAWS)
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.name != "compiled.py":
            names = imported(path) | {f"numba.{text}" for text in _attributes_of_numba(path)}
            assert not names & {"numba.njit", "numba.jit"}, f"{path}: take njit of bampipe.compiled"


def _attributes_of_numba(path: Path) -> set[str]:
    return {
        node.attr
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id == "numba"
    }


def test_a_change_in_whatever_stages_import_reruns_them(monkeypatch: pytest.MonkeyPatch) -> None:
    before = {stage: hashing.digest_code(stage) for stage in ("filter", "next")}
    for name in sorted(room for room in LAWS["stages"] if room.startswith("bampipe.")):
        # Of all stages but its own, only that with the protocol sheet uses the report.
        stages = ["next"] if name == "bampipe.report" else list(before)
        path = PACKAGE.joinpath(*name.split(".")[1:])
        changed = path if path.is_dir() else path.with_suffix(".py")
        monkeypatch.setattr(
            hashing,
            "_digest_tree",
            lambda part, changed=changed, original=hashing._digest_tree.__wrapped__: (
                "changed" if part == changed else original(part)
            ),
        )
        for stage in stages:
            assert hashing.digest_code(stage) != before[stage], (name, stage)
        monkeypatch.undo()


def test_no_stage_imports_another_and_filterpy_is_known_to_its_engine_only() -> None:
    names = set(base.STAGES)
    for name in names:
        path = PACKAGE / "stages" / f"{name}.py"
        if not path.is_file():
            continue
        others = {f"bampipe.stages.{other}" for other in names - {name}}
        for found in imported(path):
            assert not any(found == o or found.startswith(o + ".") for o in others), (name, found)
    for path in sources("estimate"):
        assert not any(name.startswith("filterpy") for name in imported(path, lazily=False)), path


@pytest.mark.parametrize("layer", ["run", "cli"])
def test_nothing_heavy_is_imported_before_a_command_needs_it(layer: str) -> None:
    others = ("stages/base.py", "files.py", "errors.py", "lab/folders.py")
    for path in [*sources(layer), *(PACKAGE / name for name in others)]:
        tops = {name.partition(".")[0] for name in imported(path, lazily=False)}
        assert tops.isdisjoint({*HEAVY, "rich"}), path


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys, bampipe\n"
        "assert 'typer' not in sys.modules\n"
        "from bampipe.cli.app import app\n"
        "app(['--help'], standalone_mode=False)\n"
        f"print([n for n in {HEAVY!r} if n in sys.modules], file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"


def test_the_report_draws_nothing_before_it_is_written() -> None:
    code = "import bampipe.stages.report, sys; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_what_only_posix_has_is_not_needed_to_import(tmp_path: Path) -> None:
    """As on Windows: modules that are not there, functions and flags that `os` lacks."""
    code = (
        "import os, sys\n"
        "for name in ('fcntl', 'grp', 'pwd', 'resource', 'termios'): sys.modules[name] = None\n"
        "for name in ('O_CLOEXEC', 'O_NOFOLLOW', 'O_NONBLOCK', 'fork', 'geteuid', 'pread',\n"
        "             'pwrite', 'register_at_fork', 'sched_getaffinity'): delattr(os, name)\n"
        "from bampipe.cli.app import app\n"
        "import bampipe.compiled, bampipe.run.lock, bampipe.run.runner, bampipe.workers\n"
        "app(['--help'], standalone_mode=False)\n"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, check=True)


def test_help_is_quick() -> None:
    """0.4 s warm on an idle machine; processor time, so that a busy one changes little."""
    seconds = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-m", "bampipe", "--help"], capture_output=True, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert min(seconds) < 1.0


@pytest.mark.parametrize("name", base.STAGES)
def test_the_static_tables_agree_with_the_stages(name: str) -> None:
    module = base.load_stage(name)
    fields = set(module.Config.__dataclass_fields__)
    assert ("model" in fields) == (name in base.PER_MODEL)
    assert ("session" in fields) == (name in base.READS_SESSION)
