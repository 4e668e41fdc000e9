"""numba's ``njit``, with a cache on disk that is checked before it is used.

numba keeps compiled code in two files, an index and the code, and trusts both: one that is cut off
stops the program, one with a flipped bit runs, and code that calls a function of another file goes
on calling the old one after that file was changed. Here each compiled function is one file that
appears whole, bears the hash of its content, and is used only where it was made

- by the same numba for the same signature and processor,
- from the same sources: those of all modules beside the function's own,
- by this user, or by whoever owns the sources.

Anything else on disk is passed over, and the function is compiled again. A cache that cannot be
written costs time, nothing more.

Processes that start together share the work: what one of them is compiling, another waits for.
"""

from __future__ import annotations

import fcntl
import gc
import hashlib
import os
import pickle
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from inspect import isfunction
from pathlib import Path
from typing import Any

import numba
from numba.core import typeinfer
from numba.core.caching import FunctionCache
from numba.core.serialize import dumps

from bampipe import compile_ahead

_MARK = b"bampipe compiled 1\n"
_HASH_LENGTH = hashlib.sha256().digest_size
_PATIENCE_S = 60.0
"""How long to wait for another process before compiling what it does not finish."""


def njit(*signatures: Any, **options: Any) -> Any:
    """``numba.njit`` whose ``cache=True`` keeps code as this module describes.

    Args:
        signatures: at most one signature, or a list of them; with none, types are taken from the
            first call. As in numba, a bare function may stand here.
        options: those of ``numba.njit``. A function that others take as an argument needs
            ``no_cfunc_wrapper=False``: the entry point for that is a tenth of the time to compile.
    """
    if signatures and isfunction(signatures[0]):
        return numba.njit(signatures[0])
    kept = options.pop("cache", False)
    options.setdefault("no_cfunc_wrapper", True)
    wanted = list(signatures)
    if wanted and isinstance(wanted[0], list):
        wanted = wanted[0]

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        if kept:
            _keep(dispatcher)
        if wanted:
            with typeinfer.register_dispatcher(dispatcher), _collector_at_rest():
                for signature in wanted:
                    dispatcher.compile(signature)
                dispatcher.disable_compile()
        return dispatcher

    return decorate


def record_type(record: type, *fields: Any) -> Any:
    """Return numba's type of a NamedTuple with ``fields``: how kernels take records."""
    return numba.types.BaseTuple.from_types(fields, record)


@contextmanager
def _collector_at_rest() -> Iterator[None]:
    """Pause the search for reference cycles: a fifth of the time that numba takes, for nothing."""
    searched = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if searched:
            gc.enable()


def _keep(dispatcher: Any) -> None:
    """Keep what ``dispatcher`` compiles on disk, where there is a place for it."""
    try:
        dispatcher._cache = _CheckedCache(dispatcher.py_func)
    except RuntimeError:
        # numba found no folder that can be written: every process compiles for itself.
        return


@cache
def _sources(folder: Path) -> str:
    """Hash of all Python sources in ``folder``: what a function of it may call."""
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.py")):
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def _generated_stamp(function: Callable[..., Any]) -> str | None:
    """Stamp of the module of ``function`` where it states one: generated code stands by itself."""
    stamp = function.__globals__.get("__stamp__")
    return stamp if isinstance(stamp, str) else None


class _CheckedCache(FunctionCache):  # type: ignore[misc]
    """numba's cache of one function, on files that are checked."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        source = Path(function.__code__.co_filename)
        generated = _generated_stamp(function)
        self._generated = generated is not None
        stamp = generated or _sources(source.parent)
        self._cache_file = _CodeFiles(
            Path(self._cache_path),
            self._impl.filename_base,
            hashlib.sha256(f"{numba.__version__} {stamp}".encode()).hexdigest()[:16],
            {os.geteuid(), source.stat().st_uid},
        )

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return compiled code; None where there is none that may be used."""
        found = super().load_overload(signature, target)
        if found is None and not self._generated:
            compile_ahead.missing()
        return found

    def save_overload(self, signature: Any, data: Any) -> None:
        """Keep compiled code; a full or unwritable disk leaves it uncached."""
        try:
            super().save_overload(signature, data)
        except OSError:
            return


class _CodeFiles:
    """The files of one function: ``<function>.<stamp>.<key>.nbc``, one for each signature.

    Args:
        folder: where they are.
        base: first part of their names: function, line and Python version.
        stamp: hash of numba's version and the sources.
        owners: whose files are trusted.
    """

    def __init__(self, folder: Path, base: str, stamp: str, owners: set[int]) -> None:
        self.folder = folder
        self.base = base
        self.stamp = stamp
        self.owners = owners
        self._claims: dict[Path, int] = {}

    def path(self, key: object) -> Path:
        """Return the file of ``key``: signature, processor and hash of the function's own code."""
        name = hashlib.sha256(repr(key).encode()).hexdigest()[:16]
        return self.folder / f"{self.base}.{self.stamp}.{name}.nbc"

    def load(self, key: object) -> Any:
        """Return what was saved under ``key``; None where there is nothing sound.

        After None, the caller compiles and saves: other processes that ask meanwhile wait for it.
        """
        found = self._read(key)
        if found is None and self._claim(key):
            found = self._read(key)
            if found is not None:
                self._release(key)
        return found

    def _claim(self, key: object) -> bool:
        """Announce that this process compiles ``key``; whether another may have done so first.

        Waits while another process is at it. One that ends without saving, killed or not, has
        released its claim.
        """
        path = self._claim_of(key)
        if path in self._claims:
            return False
        try:
            handle = os.open(path, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        except OSError:
            return False
        deadline = time.monotonic() + _PATIENCE_S
        while True:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() < deadline:
                    time.sleep(0.02)
                    continue
                os.close(handle)
                return True
            except OSError:  # a file system without locks
                os.close(handle)
                return False
            self._claims[path] = handle
            return True

    def _claim_of(self, key: object) -> Path:
        path = self.path(key)
        return path.with_name(f".{path.name}.lock")

    def _release(self, key: object) -> None:
        path = self._claim_of(key)
        handle = self._claims.pop(path, None)
        if handle is not None:
            path.unlink(missing_ok=True)
            os.close(handle)

    def _read(self, key: object) -> Any:
        try:
            with self.path(key).open("rb") as stream:
                if os.fstat(stream.fileno()).st_uid not in self.owners:
                    return None
                content = stream.read()
        except OSError:
            return None
        start = len(_MARK) + _HASH_LENGTH
        payload = content[start:]
        if content[:start] != _MARK + hashlib.sha256(payload).digest():
            return None
        found, data = pickle.loads(payload)
        return data if found == repr(key) else None

    def save(self, key: object, data: object) -> None:
        """Write ``data`` under ``key``, whole or not at all; drop what older sources left."""
        try:
            self._write(key, data)
        finally:
            self._release(key)

    def _write(self, key: object, data: object) -> None:
        payload = dumps((repr(key), data))
        path = self.path(key)
        handle, partial = tempfile.mkstemp(dir=self.folder, prefix=f".{self.base}.")
        try:
            with os.fdopen(handle, "wb") as stream:
                stream.write(_MARK + hashlib.sha256(payload).digest() + payload)
            os.replace(partial, path)
        except OSError:
            os.unlink(partial)
            raise
        for old in self.folder.glob(f"{self.base}.*.nbc"):
            if not old.name.startswith(f"{self.base}.{self.stamp}."):
                old.unlink(missing_ok=True)

    def flush(self) -> None:
        """Drop everything that was saved."""
        for path in self.folder.glob(f"{self.base}.*.nbc"):
            path.unlink(missing_ok=True)
