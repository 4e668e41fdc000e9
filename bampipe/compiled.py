"""numba's ``njit``, whose cache on disk is checked before it is used.

numba keeps compiled code in two files, an index and the code, and trusts both: one that is cut off
stops the program, one with a flipped bit runs, and code that calls a function of another file goes
on calling the old one after that file was changed. So the folder is the user's own and its name the
hash of all sources beside the function's own (`bampipe.generated_code`), the same wherever these
are; and every file ends with the hash of its name and content. Anything else is passed over, and
the function is compiled again. A cache that cannot be written costs time, nothing more.

Processes that start together share the work: what one of them is compiling, another waits for.
"""

from __future__ import annotations

import gc
import hashlib
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from inspect import isfunction
from pathlib import Path
from typing import Any, BinaryIO

import numba
from filelock import lock_descriptor
from numba.core import caching, typeinfer

from bampipe import compile_ahead
from bampipe.errors import InputError
from bampipe.generated_code import make_compiled_folder

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
    cached = options.pop("cache", False)
    options.setdefault("no_cfunc_wrapper", True)
    wanted = list(signatures)
    if wanted and isinstance(wanted[0], list):
        wanted = wanted[0]

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        if cached:
            with suppress(RuntimeError):  # no folder: every process compiles for itself
                dispatcher._cache = _CheckedCache(function)
        if wanted:
            with typeinfer.register_dispatcher(dispatcher), _collector_at_rest():
                with _one_process_at_a_time(dispatcher._cache):
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


@contextmanager
def _one_process_at_a_time(cache: Any) -> Iterator[None]:
    """Wait while another process compiles the function of ``cache``, unless it is compiled.

    A process that ends without saving, killed or not, has released its lock.
    """
    if not isinstance(cache, _CheckedCache) or cache.index.exists():
        yield
        return
    lock = cache.index.with_suffix(".lock")
    try:
        handle = os.open(lock, os.O_CREAT | os.O_RDWR, 0o600)
    except OSError:
        yield
        return
    try:
        deadline = time.monotonic() + _PATIENCE_S
        while time.monotonic() < deadline:
            try:
                if lock_descriptor(handle, blocking=False):
                    break
                time.sleep(0.02)
            except OSError:  # a file system without locks
                break
        yield
    finally:
        with suppress(FileNotFoundError, PermissionError):  # Windows keeps what is open
            lock.unlink()
        os.close(handle)


class _Locator(caching._CacheLocator):
    """A folder for each content of the sources; generated code names those that it calls."""

    def __init__(self, function: Callable[..., Any], path: str) -> None:
        self._py_file, self._line = path, function.__code__.co_firstlineno
        sources = function.__globals__.get("__sources__", Path(path).parent)
        self._folder = make_compiled_folder(sources)

    @classmethod
    def from_function(cls, function: Callable[..., Any], path: str) -> _Locator | None:
        try:
            return cls(function, path)
        except (InputError, OSError):
            return None

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._folder.name

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Code(caching.CompileResultCacheImpl):
    _locator_classes = (_Locator,)


class _CheckedFiles(caching.IndexDataCacheFile):
    """numba's index and code, each with its hash behind it, where pickle does not look."""

    @contextmanager
    def _open_for_write(self, path: str) -> Iterator[BinaryIO]:
        with super()._open_for_write(path) as stream:
            yield stream
            stream.flush()
            stream.write(_digest(path, Path(stream.name).read_bytes()))

    def _load_index(self) -> dict[Any, str]:
        return super()._load_index() if _is_sound(self._index_path) else {}

    def _load_data(self, name: str) -> Any:
        return super()._load_data(name) if _is_sound(self._data_path(name)) else None


def _is_sound(path: str) -> bool:
    try:
        content = Path(path).read_bytes()
    except OSError:
        return False
    return _digest(path, content[:-_HASH_LENGTH]) == content[-_HASH_LENGTH:]


def _digest(path: str, content: bytes) -> bytes:
    return hashlib.sha256(os.path.basename(path).encode() + content).digest()


class _CheckedCache(caching.FunctionCache):
    """numba's cache of one function, on files that are checked."""

    _impl_class = _Code

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        stamp = self._impl.locator.get_source_stamp()
        self._cache_file = _CheckedFiles(self._cache_path, self._impl.filename_base, stamp)
        self._generated = "__sources__" in function.__globals__

    @property
    def index(self) -> Path:
        """File that is there once the function is compiled."""
        return Path(self._cache_file._index_path)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return compiled code; None where there is none that may be used."""
        found = super().load_overload(signature, target)
        if found is None and not self._generated:
            compile_ahead.report_missing()
        return found

    def save_overload(self, signature: Any, data: Any) -> None:
        """Save compiled code; a full or unwritable disk leaves it uncached."""
        with suppress(OSError):
            super().save_overload(signature, data)
