"""Content hashes of files, configurations, sessions, and of the code that made a result."""

import importlib.metadata
import importlib.util
import platform
from collections.abc import Mapping
from functools import cache
from pathlib import Path, PurePosixPath

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

    These are ``session.toml``, the trial files and, if the session has its own device file, that
    file and the URDF that it names. Only files inside the session folder count, since ingest
    refuses others.
    """
    session = folder / "session.toml"
    files = {"session.toml": session}
    try:
        content = read_toml(session)
    except InputError:  # ingest reports its fault
        return files
    trials, device = content.get("trials"), content.get("device")
    entries = trials if isinstance(trials, list) else []
    names = [trial.get("file") for trial in entries if isinstance(trial, dict)]
    if isinstance(device, str) and device.endswith(".toml"):
        names += [device, *_urdf_of(folder, device)]
    for name in names:
        # The session file may say ./a.csv for a.csv.
        if isinstance(name, str) and is_inside(folder, PurePosixPath(name).as_posix()):
            files[name] = folder / name
    return files


def _urdf_of(folder: Path, device: str) -> list[str]:
    """Return the URDF that a session's device file names, as a path in the session folder."""
    try:
        robot = read_toml(folder / device).get("robot")
    except InputError:  # ingest reports its fault
        return []
    urdf = robot.get("urdf") if isinstance(robot, dict) else None
    return [str(PurePosixPath(device).parent / urdf)] if isinstance(urdf, str) else []


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
