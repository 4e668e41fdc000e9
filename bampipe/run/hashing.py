"""Content hashes: of files, of configuration, of sessions, of the code that made a result."""

from __future__ import annotations

import contextlib
import importlib.metadata
import importlib.util
import os
import platform
import time
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path, PurePosixPath

import bampipe
from bampipe.errors import InputError
from bampipe.files import (
    digest_content,
    digest_file,
    digest_input,
    is_inside,
    read_json_table,
    read_toml,
)
from bampipe.run.record import SESSION
from bampipe.stages import base

PACKAGES = (
    "h5py",
    "matplotlib",
    "numba",
    "numpy",
    "pandas",
    "pyarrow",
    "scikit-learn",
    "scipy",
    "sympy",
    "typst",
)
"""Packages whose version may change a result."""

SHARED_CODE = (
    "physics",
    "estimate",
    "results",
    "phrases",
    "data",
    "declarations",
    "trials",
    "setup",
    "identification",
    "diagnosis",
    "next_trial",
)
"""Sub-packages that stages call, beside the single files; a change in one reruns every stage."""

ABSENT = "absent"

# A file changed within this time of being hashed could change again without its time stamp showing.
RACY_NS = 2_000_000_000


class HashMemory:
    """Hashes of large files outside the run folder, kept with their size and time stamp.

    A file is read again when its size or modification time differs from what was noted. A file
    modified less than two seconds before it was hashed is not noted at all.

    Args:
        path: JSON file that holds the notes; a damaged one is started afresh.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.changed = False
        self.notes: dict[str, list[object]] = {}
        with contextlib.suppress(InputError):
            self.notes = read_json_table(path)

    def digest(self, path: Path) -> str:
        """Return the hash of the file ``path`` as :func:`digest_input` would."""
        key = os.path.realpath(path)
        now = time.time_ns()
        status = path.stat()
        stamp = [status.st_size, status.st_mtime_ns]
        note = self.notes.get(key)
        if isinstance(note, list) and len(note) == 3 and note[:2] == stamp:
            return str(note[2])
        value = digest_input(path)
        if now - status.st_mtime_ns > RACY_NS:
            self.notes[key] = [*stamp, value]
            self.changed = True
        return value


def session_files(folder: Path) -> dict[str, Path]:
    """Return the files a session consists of, by the name the session file gives them.

    These are ``session.toml``, the trial files and, where the device is a file, that file and the
    URDF that it names.
    Only files inside the session folder count, since ingest refuses others.

    Args:
        folder: the session folder.
    """
    session = folder / "session.toml"
    files = {"session.toml": session}
    try:
        content = read_toml(session)
    except InputError:  # ingest says what is wrong with it
        return files
    trials, device = content.get("trials"), content.get("device")
    names = (
        [trial.get("file") for trial in trials if isinstance(trial, dict)]
        if isinstance(trials, list)
        else []
    )
    if isinstance(device, str) and device.endswith(".toml"):
        names += [device, *_urdf_of(folder, device)]
    for name in names:
        # The session file may say ./a.csv for a.csv.
        if isinstance(name, str) and is_inside(folder, PurePosixPath(name).as_posix()):
            files[name] = folder / name
    return files


def _urdf_of(folder: Path, device: str) -> list[str]:
    """The URDF that a device file of the session names, by its path in the session folder."""
    try:
        robot = read_toml(folder / device).get("robot")
    except InputError:  # ingest says what is wrong with it
        return []
    urdf = robot.get("urdf") if isinstance(robot, dict) else None
    return [str(PurePosixPath(device).parent / urdf)] if isinstance(urdf, str) else []


def digest_session(folder: Path, memory: HashMemory | None = None) -> dict[str, str]:
    """Return the hash of each file of a session, ``"absent"`` where there is none.

    Args:
        folder: the session folder.
        memory: notes on files hashed before; without it every file is read.
    """
    digest = memory.digest if memory is not None else digest_input
    return {
        f"{SESSION}{name}": digest(path) if path.is_file() else ABSENT
        for name, path in sorted(session_files(folder).items())
    }


def _source_files(root: Path) -> Iterable[Path]:
    if root.is_file():
        yield root
        return
    for path in sorted(root.rglob("*")):
        if path.suffix in {".py", ".toml", ".typ"} and "__pycache__" not in path.parts:
            yield path


@cache
def _digest_tree(root: Path) -> str:
    return digest_content(
        [(str(path.relative_to(root)), digest_file(path)) for path in _source_files(root)]
    )


def digest_code(stage: str) -> str:
    """Return the hash of the source that ``stage`` may call, without importing it.

    Args:
        stage: name of a stage.
    """
    package = Path(bampipe.__file__).parent
    parts = [package / name for name in SHARED_CODE]
    parts += [*sorted(package.glob("*.py")), package / "stages/base.py"]
    if stage in base.PRINTING:
        parts.append(package / "report")
    spec = importlib.util.find_spec(f"bampipe.stages.{stage}")
    if spec is not None and spec.origin is not None:
        origin = Path(spec.origin)
        parts.append(origin.parent if origin.name == "__init__.py" else origin)
    return digest_content([(part.name, _digest_tree(part)) for part in parts if part.exists()])


@cache
def versions() -> Mapping[str, str]:
    """Return the version of bampipe, of Python and of every package that may change a result."""
    found = {"bampipe": bampipe.__version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = ABSENT
    return found
