"""Worker processes, which end with their parent, however it ends."""

import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
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
        hear: called with every message of `send_to_parent`.
    """
    workers: list[_Worker] = []

    def start() -> None:
        workers.append(_Worker(initialize, arguments, nested))

    try:
        for _ in range(jobs):
            start()
        yield ProcessPool(workers, start, hear)
    finally:
        for worker in workers:
            worker.process.kill()
        for worker in workers:
            worker.process.join()
            worker.pipe.close()


class ProcessPool:
    """Deals tasks to worker processes.

    The executor of the standard library is unsuitable: an exception in the block, such as that of
    Ctrl-C, waits for every task, or for ever while the processes start.
    """

    def __init__(
        self, workers: "list[_Worker]", start: Callable[[], None], hear: Callable[[Any], None]
    ) -> None:
        self._workers, self._start, self._hear = workers, start, hear
        self._waiting: deque[_Task] = deque()
        self._results: dict[int, _Reply] = {}
        self._number = 0

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
        first = self._number
        for task in tasks:
            self._waiting.append(_Task(self._number, function, task, lost))
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
                worker.task = self._waiting.popleft()
                try:
                    worker.pipe.send((worker.task.function, worker.task.argument))
                except BrokenPipeError as error:
                    raise worker.lost() from error

    def _collect(self) -> None:
        """Wait until a worker is done, and give it what comes next."""
        busy = {worker.pipe: worker for worker in self._workers if worker.task is not None}
        for pipe in multiprocessing.connection.wait(list(busy)):
            worker = busy[pipe]  # type: ignore[index]
            task = worker.task
            assert task is not None
            try:
                answer = worker.pipe.recv()
            except (EOFError, ConnectionResetError) as error:
                if task.lost is None:
                    raise worker.lost() from error
                self._results[task.number] = task.lost(task.argument, worker.lost()), None
                self._workers.remove(worker)
                worker.pipe.close()
                if self._waiting:
                    self._start()
                continue
            if isinstance(answer, _Message):
                self._hear(answer.content)
                continue
            self._results[task.number] = answer
            worker.task = None
        self._deal()


@dataclass(frozen=True)
class _Task:
    """A call in a worker, and the replacement of its result if the worker is killed."""

    number: int
    function: Callable[[Any], Any]
    argument: Any
    lost: Callable[[Any, InputError], Any] | None


@dataclass(frozen=True)
class _Message:
    """A message of a task before its end."""

    content: object


_Reply = tuple[object, Exception | None]


class _Worker:
    """A worker process, the pipe to it, and the task it is at."""

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
        self.task: _Task | None = None

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
        reply: _Reply
        try:
            reply = (function(task), None)
        except Exception as error:
            error.add_note(traceback.format_exc())
            reply = (None, error)
        pipe.send(reply)
