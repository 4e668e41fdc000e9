"""Code that bampipe writes and later runs: generated source, and what numba compiles.

All of it is in a folder that must be the user's and closed to others. Every generated file must
have the hash that was noted when it was written; what fails the check is generated again. What is
compiled is in one folder for each content of the sources, wherever these are.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import stat
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any

from bampipe.errors import InputError
from bampipe.files import digest_bytes, digest_content, write_text

_FORMAT = 2
_OTHERS_MAY_WRITE = stat.S_IWGRP | stat.S_IWOTH
_SHARED = ("compiled.py", "model_functions.py")
"""Modules beside this one that all compiled code depends on."""
_GENERATOR = Path(__file__).with_name("physics")
"""What generates code, and whose functions that may call."""
_LONGEST_UNUSED_S = 30 * 86400.0
"""Compiled code of other sources is removed after this time."""
_REMEDY = "set BAMPIPE_CACHE_DIR to a folder of your own"


@dataclass(frozen=True)
class Generated:
    """The generated code of one model, as it was checked.

    Attributes:
        key: hash of everything it depends on.
        folder: where its files are.
        facts: what the generator says of the model; JSON can hold it.
        sources: Python source of each module, by name.
    """

    key: str
    folder: Path
    facts: dict[str, Any]
    sources: Mapping[str, str]

    def module(self, name: str) -> ModuleType:
        """Return the module ``name``, executed once a process, after those that it imports."""
        path = self._path(name)
        title = module_title(name, self.sources[name])
        if title in sys.modules:
            return sys.modules[title]
        for other, source in self.sources.items():
            if other != name and f"from {module_title(other, source)} " in self.sources[name]:
                self.module(other)
        module = ModuleType(title)
        module.__file__ = str(path)
        vars(module)["__sources__"] = _GENERATOR
        # Compiled here, not imported: a byte-code file beside the source would not be checked.
        code = compile(self.sources[name], str(path), "exec")
        sys.modules[title] = module
        try:
            exec(code, vars(module))
        except BaseException:
            del sys.modules[title]
            raise
        return module

    def _path(self, name: str) -> Path:
        return _source_path(self.folder, name, digest_bytes(self.sources[name].encode()))

    def write(self) -> None:
        """Write all files, the one that vouches for the others last.

        Raises:
            InputError: the folder cannot be written.
        """
        for name, source in self.sources.items():
            _write(self._path(name), source)
        content = {
            "format": _FORMAT,
            "facts": self.facts,
            "sources": {n: digest_bytes(source.encode()) for n, source in self.sources.items()},
        }
        content["hash"] = digest_content(content)
        _write(self.folder / f"meta_{self.key}.json", json.dumps(content, sort_keys=True))


def module_title(name: str, source: str) -> str:
    """Name under which the module ``name`` of a model is imported by others of the same model.

    It is named by what is in it: models with the same text share what is compiled from it.
    """
    return f"bampipe_generated_{_stem(name, digest_bytes(source.encode()))}"


def load(key: str, generate: Callable[[], tuple[dict[str, Any], Mapping[str, str]]]) -> Generated:
    """Return the code under ``key``, generated and written where it is missing or damaged.

    Args:
        key: hash of everything the code depends on.
        generate: returns the facts and the source of each module.

    Raises:
        InputError: the folder cannot be used or written.
    """
    folder = folder_of_user()
    code = _read(folder, key)
    if code is None:
        code = Generated(key, folder, *generate())
        code.write()
    return code


def _read(folder: Path, key: str) -> Generated | None:
    try:
        content = json.loads((folder / f"meta_{key}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        return None
    noted = content.pop("hash", None)
    if noted != digest_content(content):
        return None
    sources = {}
    for name, digest in content["sources"].items():
        try:
            sources[name] = _source_path(folder, name, digest).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            return None
        if digest_bytes(sources[name].encode()) != digest:
            return None
    return Generated(key, folder, content["facts"], sources)


def _source_path(folder: Path, name: str, digest: str) -> Path:
    """Where the source of a module is, whose hash is ``digest``."""
    return folder / f"{_stem(name, digest)}.py"


def _stem(name: str, digest: str) -> str:
    return f"{name}_{digest[:24]}"


def folder_of_user() -> Path:
    """Folder of code to run: in ``BAMPIPE_CACHE_DIR``, else in the user's cache folder.

    Raises:
        InputError: it cannot be made, belongs to somebody else, or others may write into it.
    """
    root = os.environ.get("BAMPIPE_CACHE_DIR")
    if not root:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        root = str(Path(base) / "bampipe")
    folder = Path(root) / f"python{sys.version_info.major}.{sys.version_info.minor}"
    try:
        Path(root).mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        _require_private(folder)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(
            f"cannot make the folder of generated code: {reason}", where=str(folder), remedy=_REMEDY
        ) from error
    return folder


@cache
def hash_sources(folder: Path) -> str:
    """Hash of the Python sources in ``folder``, and of what all compiled code depends on.

    Taken once a process, as modules are imported once.
    """
    digest = hashlib.sha256()
    for path in [*sorted(folder.glob("*.py")), *(Path(__file__).with_name(n) for n in _SHARED)]:
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def compiled_folder(sources: Path) -> Path:
    """Where that is which numba compiled from the modules in ``sources``, made or not.

    Raises:
        InputError: as `folder_of_user`.
    """
    key = f"{version('numba')} {hash_sources(sources)}"
    return folder_of_user() / f"numba_{digest_bytes(key.encode())[:24]}"


def make_compiled_folder(sources: Path) -> Path:
    """Make the `compiled_folder`, and remove those that nothing has used for a month.

    Raises:
        InputError: as `folder_of_user`. OSError: it cannot be made.
    """
    folder = compiled_folder(sources)
    if not folder.exists():
        folder.mkdir(mode=0o700, exist_ok=True)
        for other in folder.parent.glob("numba_*"):
            if time.time() - other.stat().st_mtime > _LONGEST_UNUSED_S:
                shutil.rmtree(other, ignore_errors=True)
    _require_private(folder)
    with suppress(OSError):
        os.utime(folder)
    return folder


def _require_private(folder: Path) -> None:
    if not hasattr(
        os, "geteuid"
    ):  # Windows: a user's folders are closed to others by its own means
        return
    status = folder.stat()
    if status.st_uid != os.geteuid():
        raise InputError(
            "generated code is run from here, and the folder belongs to another user",
            where=str(folder),
            remedy=_REMEDY,
        )
    if status.st_mode & _OTHERS_MAY_WRITE:
        raise InputError(
            "generated code is run from here, and other users may write into the folder",
            where=str(folder),
            remedy=f"chmod go-w '{folder}', or {_REMEDY}",
        )


def _write(path: Path, text: str) -> None:
    """Write whole or not at all: several processes may generate the same model at once."""
    try:
        write_text(path, text, durable=False)
    except InputError as error:
        raise InputError(error.what, where=str(path), remedy=f"{_REMEDY} that has room") from error
