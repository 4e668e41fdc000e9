"""Several sessions, in sequence or in worker processes; a failure of one stops no other."""

import os
import traceback
from collections.abc import Sequence
from functools import partial

from bampipe.errors import InputError
from bampipe.run import record
from bampipe.run.events import Listener
from bampipe.run.publish import open_place, publish
from bampipe.run.request import Outcome, Request
from bampipe.run.runner import run_session
from bampipe.workers import process_pool, send_to_parent


def share(jobs: int) -> int:
    """Return how many cores each of ``jobs`` processes may use."""
    return max(1, (os.cpu_count() or 1) // max(1, jobs))


def limit_threads(jobs: int) -> None:
    """Give each of ``jobs`` processes its share of the cores, unless the user has set a number.

    Linear algebra always gets one thread: the number of threads changes the last bits of a sum, but
    the same inputs must give the same bytes. To be called before numpy is imported.
    """
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, str(share(jobs)))


def run_and_publish(request: Request, listen: Listener) -> Outcome:
    """Run one session and, if requested, publish its run folder."""
    if request.publish:
        open_place(request.publish)  # an address may be refused before hours of work
    outcome = run_session(request, listen)
    if request.publish:
        with record.lock(request.root, request.wait, listen):
            publish(request.root, request.publish)
    return outcome


def guarded(request: Request, listen: Listener) -> Outcome:
    """Run one session; any error becomes part of its outcome."""
    try:
        return run_and_publish(request, listen)
    except InputError as error:
        return Outcome(request.root, "refused", error=str(error))
    except Exception as error:
        text = f"{type(error).__name__}: {error}"
        return Outcome(request.root, "crashed", error=text, traceback=traceback.format_exc())


def run_sessions(requests: Sequence[Request], jobs: int, listen: Listener) -> list[Outcome]:
    """Run several sessions, no two of which share a run folder; return their outcomes in order.

    A worker process that dies (killed, out of memory) costs only its current session, whose run
    folder the next run completes. With one job everything runs in this process.
    """
    if jobs <= 1 or len(requests) <= 1:
        return [guarded(request, listen) for request in requests]

    def crash(request: Request, error: InputError) -> Outcome:
        return Outcome(request.root, "crashed", error=error.what)

    with process_pool(min(jobs, len(requests)), os.getpid, nested=True, hear=listen) as pool:
        return list(pool.map(partial(guarded, listen=send_to_parent), requests, crash))
