"""One process at a time in a folder; a lock whose holder was killed is free, and that is said."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import platform
import stat
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from bampipe.errors import InputError

_held: set[int] = set()


def _close_in_child() -> None:
    # A lock belongs to the open file, which a forked worker shares: it would outlive its holder.
    for handle in _held:
        os.close(handle)
    _held.clear()


os.register_at_fork(after_in_child=_close_in_child)


@contextlib.contextmanager
def hold(
    path: Path,
    wait: bool = True,
    waiting: Callable[[str], None] = lambda holder: None,
    taking_over: Callable[[str], None] = lambda holder: None,
) -> Iterator[None]:
    """Hold the lock that the file ``path`` stands for.

    The system frees it when its holder ends, killed or not. The holder writes its name into the
    file and empties it at the end: a name that is left is that of a process that was killed.

    Args:
        path: the lock file; made if it is not there.
        wait: wait while another process holds it; else refuse.
        waiting: called once, before waiting, with the name of the holder.
        taking_over: called with the name of a holder that was killed.

    Raises:
        InputError: it is no regular file, or another process holds it and ``wait`` is false.
        OSError: the file cannot be made.
    """
    handle = _open(path)
    _held.add(handle)
    try:
        if not _take(handle):
            if not wait:
                raise InputError(
                    f"another bampipe is at work here, {_name(handle)}".rstrip(", "),
                    where=str(path),
                    remedy="wait until it is done, or leave out --no-wait",
                )
            waiting(_name(handle))
            while not _take(handle):
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


def _open(path: Path) -> int:
    """Open the lock file without waiting for the other end of a pipe, nor following a link."""
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    try:
        handle = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise _not_a_lock(path) from error
        raise
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise _not_a_lock(path)
    return handle


def _not_a_lock(path: Path) -> InputError:
    return InputError(
        "no regular file, where a lock is expected", where=str(path), remedy="remove it"
    )


def _take(handle: int) -> bool:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
            raise
        return False
    return True


def _write_name(handle: int, name: str) -> None:
    with contextlib.suppress(OSError):  # a full disk: the lock holds without a name
        os.ftruncate(handle, 0)
        os.pwrite(handle, name.encode(), 0)


def _name(handle: int) -> str:
    return os.pread(handle, 200, 0).decode(errors="replace")
