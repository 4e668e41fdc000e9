"""numba's ``njit``, whose cache on disk is a folder named by what was compiled.

numba keeps what it compiled of a function as long as that function's own file stays as it is; code
that calls a function of another file would go on calling the old one after that file was changed.
So the folder has the hash of all sources beside the function's own in its name
(`bampipe.generated_code`), the same wherever these are. A cache that cannot be read or written
costs time, nothing more.

Processes that start together share the work: what one of them is compiling, another waits for.
"""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numba
from filelock import FileLock, Timeout
from numba.core import caching, typeinfer

from bampipe.errors import InputError
from bampipe.generated_code import make_compiled_folder

_PATIENCE_S = 60.0
"""Time to wait for another process before compiling its function here."""


def njit(signature: Any, **options: Any) -> Any:
    """``numba.njit`` for one signature, whose code is kept as this module describes.

    Args:
        options: those of ``numba.njit``. A function that others take as an argument needs
            ``no_cfunc_wrapper=False``: the entry point for that is a tenth of the time to compile.
    """
    options.setdefault("no_cfunc_wrapper", True)

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        with suppress(InputError, OSError):  # no folder: every process compiles for itself
            dispatcher._cache = _Cache(function)
        _promise(dispatcher, signature)
        if not options["no_cfunc_wrapper"]:
            dispatcher.compile_promised()
        return dispatcher

    return decorate


def _promise(dispatcher: Any, signature: Any) -> None:
    """Compile a function for its signature at its first call from Python."""

    def compile_promised(*arguments: Any) -> Any:
        del dispatcher._compile_for_args
        with (
            typeinfer.register_dispatcher(dispatcher),
            _collector_at_rest(),
            _one_process_at_a_time(dispatcher._cache),
        ):
            dispatcher.compile(signature)
        dispatcher.disable_compile()
        return dispatcher  # numba's hook

    dispatcher.compile_promised = dispatcher._compile_for_args = compile_promised


def part(*, fastmath: Any = False, **options: Any) -> Any:
    """``njit`` of a function that compiled functions alone call: compiled where one of them is.

    Args:
        fastmath: as in numba, but for the default: numba takes that of the first that calls.
        options: the others.
    """
    wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return numba.njit(fastmath=fastmath, **wrappers, **options)


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
    if not isinstance(cache, _Cache) or cache.index.exists():
        yield
        return
    lock = FileLock(cache.index.with_suffix(".lock"), timeout=_PATIENCE_S, poll_interval=0.02)
    with suppress(Timeout, OSError, NotImplementedError):  # late, or a disk without locks
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


class _Locator(caching._CacheLocator):
    """A folder for each content of the sources; generated code names its callees."""

    def __init__(self, function: Callable[..., Any], path: str) -> None:
        self._line, self._py_file = function.__code__.co_firstlineno, path
        self._folder = make_compiled_folder(
            function.__globals__.get("__sources__", Path(path).parent)
        )

    from_function = classmethod(lambda cls, function, path: cls(function, path))

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._folder.name

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Code(caching.CompileResultCacheImpl):
    _locator_classes = (_Locator,)


class _Cache(caching.FunctionCache):
    """numba's cache of one function, disabled by a damaged file or a full disk."""

    _impl_class = _Code

    @property
    def index(self) -> Path:
        """A file that exists once the function is compiled."""
        return Path(self._cache_file._index_path)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return compiled code; None if none can be read."""
        try:
            return super().load_overload(signature, target)
        except Exception:  # any exception of pickle for a truncated file
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, signature: Any, data: Any) -> None:
        """Save compiled code; a full or unwritable disk leaves it uncached."""
        with suppress(OSError):
            super().save_overload(signature, data)
