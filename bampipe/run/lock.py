"""Exclusive access to a folder; the lock of a killed process is free, with a notice."""

import contextlib
import os
import platform
from collections.abc import Callable, Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from bampipe.errors import InputError
from bampipe.files import STORAGE_FAULTS

Tell = Callable[[str, str], None]
"""Called with ``waiting`` once before waiting, and with ``taken over`` if the last holder was
killed; and with the name of that holder."""


@contextlib.contextmanager
def hold(
    folder: Path, name: str, wait: bool = True, tell: Tell = lambda kind, holder: None
) -> Iterator[None]:
    """Hold ``folder``, creating it if needed, by the lock of the file ``name`` in it.

    The operating system frees it when its holder ends, even if killed. The holder writes its name
    into the file and removes it at the end, so a remaining name is that of a killed process.

    Args:
        wait: whether to wait while another process holds it; otherwise refuse.

    Raises:
        InputError: another process holds it and ``wait`` is false; or the disk is full, read-only
            or otherwise faulty, now or while it is held.
    """
    path = folder / name
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _hold_file(path, wait, tell):
            yield
    except FileNotFoundError as error:
        if path.parent.exists():
            raise
        raise InputError("no folder can be made here", where=str(folder)) from error
    except OSError as error:
        if error.errno not in STORAGE_FAULTS:
            raise
        raise InputError(
            STORAGE_FAULTS[error.errno],
            where=os.fspath(error.filename or folder),
            remedy="earlier results are untouched",
        ) from error


@contextlib.contextmanager
def _hold_file(path: Path, wait: bool, tell: Tell) -> Iterator[None]:
    lock = FileLock(path, poll_interval=0.1, fallback_to_soft=False)
    try:
        lock.acquire(blocking=False)
    except Timeout as error:
        if not wait:
            raise InputError(
                f"another bampipe is at work here, {_read_holder(path)}".rstrip(", "),
                where=str(path),
                remedy="wait until it is done, or leave out --no-wait",
            ) from error
        tell("waiting", _read_holder(path))
        lock.acquire()
    try:
        if left := _read_holder(path):
            tell("taken over", left)
        with contextlib.suppress(OSError):  # on a full disk, the lock holds without a name
            path.write_text(f"process {os.getpid()} on {platform.node()}")
        yield
    finally:
        with contextlib.suppress(OSError):
            path.write_text("")
        lock.release()


def _read_holder(path: Path) -> str:
    try:
        return path.read_text(errors="replace")[:200]
    except PermissionError:  # Windows reserves locked bytes for their holder
        return ""
