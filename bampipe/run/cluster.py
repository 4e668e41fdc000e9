"""Sessions on the workers of a Dask cluster: one session is one task.

Workers read sessions and write run folders themselves, so both must lie on a file system that every
worker sees under the same path. If only the sessions do, ``publish`` of a request takes the
finished run folders elsewhere (see :mod:`bampipe.run.publish`).
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent import futures
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

from bampipe.errors import InputError
from bampipe.run.batch import guarded
from bampipe.run.events import Event, Listener, ignore_event
from bampipe.run.request import Outcome, Request

if TYPE_CHECKING:
    from distributed import Client

PATIENCE_S = 10.0
"""Time for which a scheduler may be silent or without workers."""
POLL_S = 1.0

Answer = TypeVar("Answer")


def run_on_cluster(requests: Sequence[Request], scheduler: str, listen: Listener) -> list[Outcome]:
    """Run several sessions, no two of which share a run folder, on a Dask cluster.

    A session whose worker dies is run again on another; one that kills several workers is reported
    as crashed. If the cluster is lost, sessions that were not finished are refused. The scheduler
    has the address ``tcp://host:port``; "" starts a cluster of worker processes on this machine for
    the duration of the run.

    Raises:
        InputError: Dask is not installed, the scheduler does not answer, or has no workers.
    """
    from bampipe.data.readers.trial import need

    distributed = need("distributed", "dask")
    # Lost connections are reported once, below, not by Dask's log.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    client = _connect(scheduler) if scheduler else distributed.Client(threads_per_worker=1)
    outcomes: dict[int, Outcome] = {}
    lost = ""
    try:
        tasks = {
            client.submit(guarded, _place(request), ignore_event, pure=False): number
            for number, request in enumerate(requests)
        }
        watch = _watch(client)
        while tasks and not lost:
            for task in [task for task in tasks if task.done()]:
                number = tasks.pop(task)
                root = requests[number].root
                if task.status in ("cancelled", "lost"):
                    lost = "the Dask scheduler was lost"
                    continue
                try:
                    outcomes[number] = replace(task.result(), root=root)
                except Exception as error:  # the worker could not start the task
                    text = f"its worker failed: {type(error).__name__}: {error}"
                    outcomes[number] = Outcome(root, "crashed", error=text)
                listen(Event(root.name, "", "done", 1.0))
            lost = lost or next(watch)
            time.sleep(0.0 if lost or not tasks else 0.05)
    finally:
        with contextlib.suppress(Exception):
            _within(PATIENCE_S / 5.0, client.close)
    if lost and not outcomes:
        raise InputError(lost, where=scheduler, remedy="finished steps are kept: run it again")
    for number, request in enumerate(requests):
        message = f"{lost}; finished steps are kept: run it again"
        outcomes.setdefault(number, Outcome(request.root, "refused", error=message))
    return [outcomes[number] for number in range(len(requests))]


def _connect(scheduler: str) -> "Client":
    """Return a client of the scheduler at this address.

    Raises:
        InputError: nothing answers there, or something other than a scheduler.
    """
    from distributed import Client

    try:
        return _within(PATIENCE_S, lambda: Client(scheduler, timeout=f"{PATIENCE_S:g}s"))
    except TimeoutError as error:
        raise InputError(
            f"no Dask scheduler answers within {PATIENCE_S:g} s", where=scheduler
        ) from error
    # The other end decides which exception is raised, such as MemoryError for a bogus message.
    except Exception as error:
        what = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(f"no Dask scheduler answers: {what}", where=scheduler) from error


def _within(seconds: float, call: Callable[[], Answer]) -> Answer:
    """Return the result of ``call``; Dask itself waits for ever for a silent connection.

    Raises:
        TimeoutError: it takes longer.
    """
    answer: futures.Future[Answer] = futures.Future()

    def ask() -> None:
        try:
            answer.set_result(call())
        except Exception as error:
            answer.set_exception(error)

    # An executor's thread would keep the program from ending.
    threading.Thread(target=ask, daemon=True).start()
    return answer.result(timeout=seconds)


def _watch(client: "Client") -> Iterator[str]:
    """Yield, each time that it is asked, the fault of the cluster; "" if there is none."""
    asked = manned = time.monotonic()
    while True:
        now, fault = time.monotonic(), ""
        if now - asked >= POLL_S:
            asked = now
            try:
                if _within(PATIENCE_S, lambda: client.scheduler_info()["workers"]):
                    manned = now
            except Exception:
                fault = "the Dask scheduler was lost"
            if not fault and now - manned > PATIENCE_S:
                fault = f"the Dask scheduler has had no workers for {PATIENCE_S:g} s"
        yield fault


def _place(request: Request) -> Request:
    """Return the request as a worker needs it: absolute paths, and no processes of its own.

    A Dask worker is a daemon, which may have no children; its cores are used by other sessions.
    """
    given = {name: getattr(request, name) for name in ("root", "session", "accepted")}
    placed = {name: path.resolve() for name, path in given.items() if path is not None}
    return replace(request, **placed, processes=1)
