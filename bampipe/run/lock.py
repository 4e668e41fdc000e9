"""Exclusive access to a folder; the lock of a killed process is free, with a notice."""

import contextlib
import os
import platform
from collections.abc import Callable, Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from bampipe.errors import InputError


@contextlib.contextmanager
def hold(
    path: Path,
    wait: bool = True,
    waiting: Callable[[str], None] = lambda holder: None,
    taking_over: Callable[[str], None] = lambda holder: None,
) -> Iterator[None]:
    """Hold the lock of the file ``path``.

    The operating system frees it when its holder ends, even if killed. The holder writes its name
    into the file and removes it at the end, so a remaining name is that of a killed process.
    ``waiting`` is called once, before waiting, with the name of the holder, and ``taking_over``
    with the name of one that was killed.

    Raises:
        InputError: another process holds it and ``wait`` is false.
        OSError: the file cannot be made.
    """
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
        waiting(_read_holder(path))
        lock.acquire()
    try:
        left = _read_holder(path)
        if left:
            taking_over(left)
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
