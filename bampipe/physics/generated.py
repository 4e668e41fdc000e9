"""Generated code on disk: whole, checked, and the user's own.

A model's functions are Python source that is executed, so the folder that holds it must be the
user's and closed to others, and every file must have the hash that was noted when it was written.
What fails the check is generated again.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from bampipe.errors import InputError

_FORMAT = 1
_OTHERS_MAY_WRITE = stat.S_IWGRP | stat.S_IWOTH


@dataclass(frozen=True)
class Generated:
    """The generated code of one model, as it was checked.

    Attributes:
        key: hash of everything it depends on.
        folder: where its files are; compiled code is kept beside them.
        facts: what the generator says of the model; JSON can hold it.
        sources: Python source of each module, by name.
    """

    key: str
    folder: Path
    facts: dict[str, Any]
    sources: Mapping[str, str]

    def module(self, name: str) -> ModuleType:
        """Return the module ``name``, executed once a process."""
        path = self._path(name)
        title = f"bampipe_generated_{path.stem}"
        if title in sys.modules:
            return sys.modules[title]
        module = ModuleType(title)
        module.__file__ = str(path)
        source = self.sources[name]
        vars(module)["__stamp__"] = _hash(source)
        # Compiled here, not imported: a byte-code file beside the source would not be checked.
        code = compile(source, str(path), "exec")
        sys.modules[title] = module
        try:
            exec(code, vars(module))
        except BaseException:
            del sys.modules[title]
            raise
        return module

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}_{self.key}.py"

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
            "sources": {name: _hash(source) for name, source in self.sources.items()},
        }
        content["hash"] = _hash(json.dumps(content, sort_keys=True))
        _write(self.folder / f"meta_{self.key}.json", json.dumps(content, sort_keys=True))


def read(folder: Path, key: str) -> Generated | None:
    """Return what was generated under ``key``; None where it is missing or damaged.

    Args:
        folder: from `folder_of_user`.
        key: hash of everything the code depends on.
    """
    try:
        content = json.loads((folder / f"meta_{key}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        return None
    noted = content.pop("hash", None)
    if noted != _hash(json.dumps(content, sort_keys=True)):
        return None
    sources = {}
    for name, digest in content["sources"].items():
        try:
            sources[name] = (folder / f"{name}_{key}.py").read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            return None
        if _hash(sources[name]) != digest:
            return None
    return Generated(key, folder, content["facts"], sources)


def folder_of_user() -> Path:
    """Folder of generated code: in ``BAMPIPE_CACHE_DIR``, else in the user's cache folder.

    Raises:
        InputError: it cannot be made, belongs to somebody else, or others may write into it.
    """
    root = os.environ.get("BAMPIPE_CACHE_DIR")
    if not root:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        root = str(Path(base) / "bampipe")
    folder = Path(root) / f"python{sys.version_info.major}.{sys.version_info.minor}"
    remedy = "set BAMPIPE_CACHE_DIR to a folder of your own"
    try:
        Path(root).mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        for place in (folder, folder / "__pycache__"):
            status = place.stat() if place.exists() else folder.stat()
            if status.st_uid != os.geteuid():
                raise InputError(
                    "generated code is run from here, and the folder belongs to another user",
                    where=str(place),
                    remedy=remedy,
                )
            if status.st_mode & _OTHERS_MAY_WRITE:
                raise InputError(
                    "generated code is run from here, and other users may write into the folder",
                    where=str(place),
                    remedy=f"chmod go-w '{place}', or {remedy}",
                )
    except OSError as error:
        raise _cannot("make the folder of generated code", folder, error) from error
    return folder


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _cannot(what: str, path: Path, error: OSError) -> InputError:
    return InputError(
        f"cannot {what}: {(error.strerror or str(error)).lower()}",
        where=str(path),
        remedy="set BAMPIPE_CACHE_DIR to a folder of your own that has room",
    )


def _write(path: Path, text: str) -> None:
    """Write whole or not at all: several processes may generate the same model at once."""
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(text)
            os.replace(name, path)
        except OSError:
            os.unlink(name)
            raise
    except OSError as error:
        raise _cannot("write generated code", path, error) from error
