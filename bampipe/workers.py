"""Worker processes, which end with their parent, however it ends."""

import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from bampipe.errors import InputError

Task = TypeVar("Task")
Returned = TypeVar("Returned")


def end_with_parent() -> None:
    """Tie this process to the one that started it; called first in every worker process.

    If the parent is killed, the system closes the pipe between the two. Ctrl-C reaches every
    process of a terminal: the parent handles it, and ends its workers.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    parent = multiprocessing.parent_process()
    if parent is None:
        raise RuntimeError("this process was not started as a worker")
    sentinel = parent.sentinel

    def end_after_parent() -> None:
        multiprocessing.connection.wait([sentinel])
        os._exit(1)

    threading.Thread(target=end_after_parent, daemon=True).start()


_parent: multiprocessing.connection.Connection | None = None
"""In a worker process: the pipe to its parent."""


def send_to_parent(message: object) -> None:
    """In a worker process: have the ``hear`` of `process_pool` called with ``message``."""
    if _parent is None:
        raise RuntimeError("this process was not started as a worker")
    _parent.send(_Message(message))


@contextmanager
def process_pool(
    jobs: int,
    initialize: Callable[..., object],
    *arguments: Any,
    nested: bool = False,
    hear: Callable[[Any], None] = lambda message: None,
) -> "Iterator[ProcessPool]":
    """A pool of worker processes for the length of the block; unfinished tasks are then dropped.

    Args:
        initialize: called in each process before its first task, with ``arguments``.
        nested: whether tasks start processes of their own; the workers then begin afresh.
        hear: called with every message of `send_to_parent`, one at a time.
    """
    pool = ProcessPool(jobs, lambda: _Worker(initialize, arguments, nested), hear)
    try:
        for _ in range(jobs):  # forked before there are threads
            pool.start()
        yield pool
    finally:
        pool.close()


class ProcessPool:
    """Deals tasks to worker processes, each of which a thread waits for.

    The executor of processes of the standard library is unsuitable: an exception in the block, such
    as that of Ctrl-C, waits for every task, and the death of one worker ends them all.
    """

    def __init__(
        self, jobs: int, make: "Callable[[], _Worker]", hear: Callable[[Any], None]
    ) -> None:
        self._make, self._hear, self._lock = make, hear, threading.Lock()
        self._own, self._workers, self._closing = threading.local(), list[_Worker](), False
        fresh = iter(self._workers)
        self._threads = ThreadPoolExecutor(
            jobs, initializer=lambda: setattr(self._own, "worker", next(fresh))
        )

    def start(self) -> "_Worker":
        """Start a worker, unless the pool is being closed."""
        with self._lock:
            if self._closing:
                raise CancelledError
            self._workers.append(self._make())
            return self._workers[-1]

    def map(
        self,
        function: Callable[[Task], Returned],
        tasks: Iterable[Task],
        lost: Callable[[Task, InputError], Returned] | None = None,
    ) -> Iterator[Returned]:
        """Start ``function`` on every task, and return the results in the order of the tasks.

        Args:
            function: of a module, with arguments and results that can be pickled; tasks: its
            arguments.
            lost: gives the result of a task whose worker process was killed; another process
                replaces it.

        Raises:
            InputError: a worker process was killed, and there is no ``lost``.
            Exception: what ``function`` raised, with the traceback of the worker as a note.
        """
        futures = deque(self._threads.submit(self._call, function, task, lost) for task in tasks)
        return (futures.popleft().result() for _ in range(len(futures)))

    def _call(
        self,
        function: Callable[[Task], Returned],
        task: Task,
        lost: Callable[[Task, InputError], Returned] | None,
    ) -> Returned:
        """In a thread: have its worker do a task."""
        self._own.worker = worker = self._own.worker or self.start()
        try:
            worker.pipe.send((function, task))
            while isinstance(answer := worker.pipe.recv(), _Message):
                with self._lock:
                    self._hear(answer.content)
        except (BrokenPipeError, EOFError, ConnectionResetError) as error:
            fault = worker.lost()
            if lost is None or self._closing:
                raise fault from error
            self._own.worker = None
            return lost(task, fault)
        value, failure = answer
        if failure is not None:
            raise failure
        return value  # type: ignore[no-any-return]

    def close(self) -> None:
        """End the worker processes, whatever they are at."""
        with self._lock:
            self._closing = True
        for worker in self._workers:
            worker.process.kill()
        self._threads.shutdown(cancel_futures=True)
        for worker in self._workers:
            worker.process.join()
            worker.pipe.close()


@dataclass(frozen=True)
class _Message:
    """A message of a task before its end."""

    content: object


class _Worker:
    """A worker process and the pipe to it."""

    def __init__(
        self, initialize: Callable[..., object], arguments: tuple[Any, ...], nested: bool
    ) -> None:
        self.pipe, far = multiprocessing.Pipe()
        kind = multiprocessing.get_context("spawn") if nested else multiprocessing.get_context()
        self.process = kind.Process(
            target=_serve, args=(far, initialize, arguments), daemon=not nested
        )
        self.process.start()
        far.close()

    def lost(self) -> InputError:
        self.process.join()
        return InputError(
            f"a worker process was ended (exit code {self.process.exitcode})",
            remedy="if memory was short, free some or use fewer processes (jobs); run it again",
        )


def _serve(
    pipe: multiprocessing.connection.Connection,
    initialize: Callable[..., object],
    arguments: tuple[Any, ...],
) -> None:
    global _parent
    end_with_parent()
    _parent = pipe
    initialize(*arguments)
    while True:
        function, task = pipe.recv()
        reply: tuple[object, Exception | None]
        try:
            reply = (function(task), None)
        except Exception as error:
            error.add_note(traceback.format_exc())
            reply = (None, error)
        pipe.send(reply)
