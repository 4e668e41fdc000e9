"""Exclusive access to a folder; the lock of a killed process is free, with a notice."""

import contextlib
import os
import platform
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from filelock import lock_descriptor

from bampipe.errors import InputError

_held: set[int] = set()


def _close_in_child() -> None:
    # A lock belongs to the open file. A forked worker shares that, and would keep the lock alive.
    for handle in _held:
        os.close(handle)
    _held.clear()


if hasattr(os, "register_at_fork"):  # nothing is forked on Windows
    os.register_at_fork(after_in_child=_close_in_child)


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
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    _held.add(handle)
    try:
        if not lock_descriptor(handle, blocking=False):
            if not wait:
                raise InputError(
                    f"another bampipe is at work here, {_name(handle)}".rstrip(", "),
                    where=str(path),
                    remedy="wait until it is done, or leave out --no-wait",
                )
            waiting(_name(handle))
            while not lock_descriptor(handle, blocking=False):
                time.sleep(0.1)
        left = _name(handle)
        if left:
            taking_over(left)
        _write_name(handle, f"process {os.getpid()} on {platform.node()}")
        try:
            yield
        finally:
            _write_name(handle, "")
    finally:
        _held.discard(handle)
        os.close(handle)


def _write_name(handle: int, name: str) -> None:
    with contextlib.suppress(OSError):  # on a full disk, the lock holds without a name
        os.ftruncate(handle, 0)
        os.lseek(handle, 0, os.SEEK_SET)
        os.write(handle, name.encode())


def _name(handle: int) -> str:
    os.lseek(handle, 0, os.SEEK_SET)
    try:
        return os.read(handle, 200).decode(errors="replace")
    except PermissionError:  # Windows reserves locked bytes for their holder
        return ""
