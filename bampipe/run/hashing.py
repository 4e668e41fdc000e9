"""Content hashes of files, configurations, sessions, and of the code that made a result."""

import importlib.metadata
import importlib.util
import platform
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

import bampipe
from bampipe.errors import InputError
from bampipe.files import digest_content, digest_file, digest_input, is_inside, read_toml
from bampipe.results.run import SESSION
from bampipe.stages import base

PACKAGES = ("h5py", "matplotlib", "numba", "numpy", "pandas", "pyarrow", "scipy", "sympy", "typst")
"""Packages whose version may change a result."""

_OUTER = ("api", "cli", "lab", "monitor", "report", "run", "simulator", "stages")
"""Sub-packages that no stage calls; a change in another or in a single file reruns every stage."""

ABSENT = "absent"


def session_files(folder: Path) -> dict[str, Path]:
    """Return the files of a session, by the name that the session file gives them.

    These are ``session.toml``, the trial files with their parts and, if the session has its own
    device file, that file and the drawing that it names. Only files inside the session folder
    count, since ingest refuses others.
    """
    session = folder / "session.toml"
    files = {"session.toml": session}
    try:
        content = read_toml(session)
    except InputError:  # ingest reports its fault
        return files
    trials, device = _list_tables(content.get("trials")), content.get("device")
    parts = [part for trial in trials for part in _list_tables(trial.get("parts"))]
    named = (entry.get("file") for entry in (*trials, *parts))
    names = [name for name in named if isinstance(name, str)]
    if isinstance(device, str) and device.endswith(".toml") and _is_inside(folder, device):
        from bampipe.data.device_file import find_robot_file  # slow to import

        names.append(device)
        with suppress(InputError):  # ingest reports its fault
            if drawing := find_robot_file(folder / device):
                names.append(drawing.relative_to(folder).as_posix())
    return files | {name: folder / name for name in names if _is_inside(folder, name)}


def _is_inside(folder: Path, name: str) -> bool:
    return is_inside(folder, PurePosixPath(name).as_posix())  # it may say ./a.csv for a.csv


def _list_tables(value: object) -> list[dict[str, Any]]:
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def digest_session(folder: Path) -> dict[str, str]:
    """Return the hash of each file of a session; ``"absent"`` if it is missing."""
    return {
        f"{SESSION}{name}": digest_input(path) if path.is_file() else ABSENT
        for name, path in sorted(session_files(folder).items())
    }


@cache
def _digest_tree(root: Path) -> str:
    found = sorted(root.rglob("*")) if root.is_dir() else [root]
    sources = [path for path in found if path.suffix in {".py", ".toml", ".typ", ".mplstyle"}]
    return digest_content([(str(path.relative_to(root)), digest_file(path)) for path in sources])


def digest_code(stage: str) -> str:
    """Return the hash of the source that ``stage`` may call, without importing it."""
    package = Path(bampipe.__file__).parent
    rooms = (path.parent for path in sorted(package.glob("*/__init__.py")))
    parts = [room for room in rooms if room.name not in _OUTER]
    parts += [*sorted(package.glob("*.py")), package / "stages/base.py"]
    if stage in base.PRINTING:
        parts.append(package / "report")
    spec = importlib.util.find_spec(f"bampipe.stages.{stage}")
    if spec is not None and spec.origin is not None:
        parts.append(Path(spec.origin))
    return digest_content([(part.name, _digest_tree(part)) for part in parts if part.exists()])


@cache
def versions() -> Mapping[str, str]:
    """Return the version of bampipe, of Python and of every package that may change a result."""
    found = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {"bampipe": bampipe.__version__, "python": platform.python_version(), **found}
