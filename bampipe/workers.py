"""Worker processes: they end with the process that started them, however that one ends."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from bampipe.errors import InputError

Task = TypeVar("Task")
Returned = TypeVar("Returned")


def end_with_parent() -> None:
    """Tie this process to the one that started it; called first in every worker process.

    A parent that is killed can tell nobody, but the system then closes the pipe between the two.
    Ctrl-C reaches every process of a terminal: the parent answers it, and ends its workers.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    parent = multiprocessing.parent_process()
    if parent is None:
        raise RuntimeError("this process was not started as a worker")
    threading.Thread(target=_end_after, args=(parent.sentinel,), daemon=True).start()


def _end_after(sentinel: int) -> None:
    multiprocessing.connection.wait([sentinel])
    os._exit(1)


@contextmanager
def process_pool(
    jobs: int, initialize: Callable[..., object], *arguments: Any
) -> Iterator[ProcessPool]:
    """A pool of worker processes for the length of the block; what they are at then is given up.

    Args:
        jobs: number of processes.
        initialize: called in each process before its first task, with ``arguments``.
    """
    workers: list[_Worker] = []
    try:
        for _ in range(jobs):
            workers.append(_Worker(initialize, arguments))
        yield ProcessPool(workers)
    finally:
        for worker in workers:
            worker.process.kill()
        for worker in workers:
            worker.process.join()
            worker.pipe.close()


class ProcessPool:
    """Deals tasks to worker processes.

    The executor of the standard library does not do here: an exception in the block, such as that
    of Ctrl-C, waits there for every task, or for ever if it comes while the processes start.
    """

    def __init__(self, workers: list[_Worker]) -> None:
        self._workers = workers
        self._waiting: deque[tuple[int, object]] = deque()
        self._results: dict[int, _Reply] = {}
        self._number = 0

    def map(
        self, function: Callable[[Task], Returned], tasks: Iterable[Task]
    ) -> Iterator[Returned]:
        """Start ``function`` on every task, and return the results in the order of the tasks.

        Raises:
            InputError: a worker process was ended by another.
            Exception: what ``function`` raised, with the traceback of the worker as a note.
        """
        first = self._number
        for task in tasks:
            self._waiting.append((self._number, (function, task)))
            self._number += 1
        self._deal()
        return self._in_order(range(first, self._number))

    def _in_order(self, numbers: range) -> Iterator[Any]:
        for number in numbers:
            while number not in self._results:
                self._collect()
            value, error = self._results.pop(number)
            if error is not None:
                raise error
            yield value

    def _deal(self) -> None:
        for worker in self._workers:
            if worker.task is None and self._waiting:
                worker.task, call = self._waiting.popleft()
                try:
                    worker.pipe.send(call)
                except BrokenPipeError as error:
                    raise worker.lost() from error

    def _collect(self) -> None:
        """Wait until a worker is done, and give it what comes next."""
        busy = {worker.pipe: worker for worker in self._workers if worker.task is not None}
        for pipe in multiprocessing.connection.wait(list(busy)):
            worker = busy[pipe]  # type: ignore[index]
            assert worker.task is not None
            try:
                self._results[worker.task] = worker.pipe.recv()
            except (EOFError, ConnectionResetError) as error:
                raise worker.lost() from error
            worker.task = None
        self._deal()


_Reply = tuple[object, Exception | None]


class _Worker:
    """A worker process, the pipe to it, and the number of the task it is at."""

    def __init__(self, initialize: Callable[..., object], arguments: tuple[Any, ...]) -> None:
        self.pipe, far = multiprocessing.Pipe()
        self.process = multiprocessing.Process(
            target=_serve, args=(far, initialize, arguments), daemon=True
        )
        self.process.start()
        far.close()
        self.task: int | None = None

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
    end_with_parent()
    initialize(*arguments)
    while True:
        function, task = pipe.recv()
        reply: _Reply
        try:
            reply = (function(task), None)
        except Exception as error:
            error.add_note(traceback.format_exc())
            reply = (None, error)
        pipe.send(reply)
