"""A limit on the processor time that a computation in pure Python may take."""

import ctypes
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_POLL_S, _AGAIN_S = 0.1, 2.0


class OutOfTime(BaseException):
    """A computation exceeded its `time_limit`; no `Exception`, so that no handler swallows it."""


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise `OutOfTime` in the block once it has taken ``seconds`` of processor time.

    Processor time rather than wall time: a busy machine refuses nothing that an idle one accepts.
    An exception set from a second thread, because signals reach the main thread only and stages
    also run in the threads of cluster workers.
    """
    worker, clock = threading.get_ident(), _thread_clock()
    start, done, lock = clock(), threading.Event(), threading.Lock()
    raised = False

    def interrupt(kind: type[BaseException] | None) -> None:
        ctypes.pythonapi.PyThreadState_SetAsyncExc(
            ctypes.c_ulong(worker), None if kind is None else ctypes.py_object(kind)
        )

    def watch() -> None:
        nonlocal raised
        pause = _POLL_S
        while not done.wait(pause):
            with lock:
                if not done.is_set() and clock() - start > seconds:
                    raised = True
                    interrupt(OutOfTime)
                    # Again, should a finalizer that ran just then have swallowed it.
                    pause = _AGAIN_S

    watcher = threading.Thread(target=watch, name="time limit", daemon=True)
    watcher.start()
    try:
        yield
    except OutOfTime:
        raised = False  # delivered
        raise
    finally:
        with lock:
            done.set()
            if raised:  # set, but the block ended before it was delivered
                interrupt(None)


def _thread_clock() -> Callable[[], float]:
    """Processor time of this thread, readable from any other; of the process where unknown."""
    if hasattr(time, "pthread_getcpuclockid"):
        clock = time.pthread_getcpuclockid(threading.get_ident())
        return lambda: time.clock_gettime(clock)
    return time.process_time
