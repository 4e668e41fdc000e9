"""Code that bampipe writes and later runs: generated source, and what numba compiles.

All of it is in one folder of the user: the source of each model in one file, by the hash of what it
depends on, and what is compiled in one folder for each content of the sources, wherever these are.
If the folder cannot be made, used or written, an `InputError` is raised.
"""

import hashlib
import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from bampipe.errors import InputError
from bampipe.files import digest_bytes, write_text

_SHARED = ("compiled.py", "model_functions.py")
"""Modules beside this one that all compiled code depends on."""
_GENERATOR = Path(__file__).with_name("physics")
"""Packages that generate code, or whose functions it may call."""
_LONGEST_UNUSED_S = 30 * 86400.0
"""Compiled code of other sources is removed after this time."""
_REMEDY = "set BAMPIPE_CACHE_DIR to a folder of your own"


@dataclass(frozen=True)
class Generated:
    """The generated code of one model.

    Attributes:
        facts: results of the generator that JSON can hold.
        sources: Python source of each module, by name.
    """

    facts: dict[str, Any]
    sources: Mapping[str, str]

    def module(self, name: str) -> ModuleType:
        """Return the module ``name``, executed once a process, after those that it imports."""
        title = module_title(name, self.sources[name])
        if title in sys.modules:
            return sys.modules[title]
        for other, source in self.sources.items():
            if other != name and f"from {module_title(other, source)} " in self.sources[name]:
                self.module(other)
        module = ModuleType(title)
        module.__file__ = f"{title}.py"
        vars(module)["__sources__"] = _GENERATOR
        code = compile(self.sources[name], module.__file__, "exec")
        sys.modules[title] = module
        try:
            exec(code, vars(module))
        except BaseException:
            del sys.modules[title]
            raise
        return module


def module_title(name: str, source: str) -> str:
    """Name under which the module ``name`` of a model is imported by others of the same model.

    It is named by what is in it: models with the same text share what is compiled from it, whatever
    number the module has in each.
    """
    return f"bampipe_generated_{name.rstrip('0123456789')}_{digest_bytes(source.encode())[:24]}"


def load(key: str, generate: Callable[[], tuple[dict[str, Any], Mapping[str, str]]]) -> Generated:
    """Return the code under ``key``, generated and written if none can be read.

    Args:
        key: hash of everything the code depends on.
        generate: returns the facts and the source of each module.
    """
    path = folder_of_user() / f"model_{key}.json"
    with suppress(OSError, ValueError, TypeError):
        return Generated(**json.loads(path.read_bytes()))
    code = Generated(*generate())
    try:
        # Whole or not at all: several processes may generate the same model at once.
        write_text(path, json.dumps(asdict(code), sort_keys=True), durable=False)
    except InputError as error:
        raise InputError(error.what, where=str(path), remedy=f"{_REMEDY} that has room") from error
    return code


def folder_of_user() -> Path:
    """Folder of code to run: in ``BAMPIPE_CACHE_DIR``, else in the user's cache folder."""
    root = os.environ.get("BAMPIPE_CACHE_DIR")
    if not root:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        root = str(Path(base) / "bampipe")
    folder = Path(root) / f"python{sys.version_info.major}.{sys.version_info.minor}"
    try:
        Path(root).mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(
            f"cannot make the folder of generated code: {reason}", where=str(folder), remedy=_REMEDY
        ) from error
    return folder


@cache
def hash_sources(folder: Path) -> str:
    """Return the hash of the Python sources in ``folder`` and of all that compiled code depends on.

    It is computed once per process, as modules are imported once.
    """
    digest = hashlib.sha256()
    for path in [*sorted(folder.glob("*.py")), *(Path(__file__).with_name(n) for n in _SHARED)]:
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def compiled_folder(sources: Path) -> Path:
    """Return the folder of numba's code for the modules in ``sources``, existing or not."""
    return folder_of_user() / f"numba_{hash_sources(sources)[:24]}"


def make_compiled_folder(sources: Path) -> Path:
    """Make the `compiled_folder`, and remove those that nothing has used for a month.

    Raises:
        InputError: as `folder_of_user`. OSError: it cannot be made.
    """
    folder = compiled_folder(sources)
    if not folder.exists():
        folder.mkdir(exist_ok=True)
        for other in folder.parent.glob("numba_*"):
            if time.time() - other.stat().st_mtime > _LONGEST_UNUSED_S:
                shutil.rmtree(other, ignore_errors=True)
    with suppress(OSError):
        os.utime(folder)
    return folder
