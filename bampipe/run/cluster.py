"""Sessions on the workers of a Dask cluster: one session is one task.

Workers read sessions and write run folders themselves, so both must lie on a file system that
every worker sees under the same path. Where only the sessions do, a request's ``publish`` takes
the finished run folders elsewhere (see :mod:`bampipe.run.publish`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from bampipe.errors import InputError
from bampipe.run.batch import guarded
from bampipe.run.events import Event, Listener, unheard
from bampipe.run.request import Outcome, Request


def run_on_cluster(requests: Sequence[Request], scheduler: str, listen: Listener) -> list[Outcome]:
    """Run several sessions on a Dask cluster.

    A session whose worker dies is run again on another; one that kills worker after worker is
    reported as crashed.

    Args:
        requests: one for each session; no two may share a run folder.
        scheduler: address of the scheduler, ``tcp://host:port``; "" starts a cluster of worker
            processes on this machine for the time of the run.
        listen: told when a session is done.

    Returns:
        The outcomes, in the order of the requests.

    Raises:
        InputError: Dask is not installed, or the scheduler does not answer.
    """
    try:
        from distributed import Client, KilledWorker, as_completed
    except ImportError as error:
        raise InputError(
            "--engine dask needs Dask", remedy="pip install 'bampipe[dask]'"
        ) from error
    options = {"address": scheduler} if scheduler else {"threads_per_worker": 1}
    try:
        client = Client(**options, timeout="10s")
    except (OSError, ValueError) as error:
        raise InputError(f"no Dask scheduler answers: {error}", where=scheduler) from error
    outcomes: dict[int, Outcome] = {}
    with client:
        tasks = {}
        for number, request in enumerate(requests):
            tasks[client.submit(guarded, _placed(request), unheard, pure=False)] = number
        for task in as_completed(tasks):
            number = tasks[task]
            root = requests[number].root
            try:
                outcomes[number] = replace(task.result(), root=root)
            except KilledWorker as error:
                outcomes[number] = Outcome(root, "crashed", error=f"its workers died: {error}")
            listen(Event(root.name, "", "done", 1.0))
    return [outcomes[number] for number in range(len(requests))]


def _placed(request: Request) -> Request:
    """Return the request as a worker needs it: absolute paths, and no processes of its own.

    A Dask worker is a daemon, which may have no children; its cores are used by other sessions.
    """
    session = None if request.session is None else request.session.resolve()
    accepted = None if request.accepted is None else request.accepted.resolve()
    root = request.root.resolve()
    return replace(request, root=root, session=session, accepted=accepted, processes=1)
