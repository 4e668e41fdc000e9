"""The Dask engine on a real cluster of two worker processes on this machine."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import install_toys
import pytest
from conftest import TOYS, Toy, contents

from bampipe.errors import InputError
from bampipe.run.cluster import run_on_cluster
from bampipe.run.events import unheard
from bampipe.run.request import Request
from bampipe.run.runner import run_session

distributed = pytest.importorskip("distributed", reason="the dask extra is not installed")


def prepare(folder: str, pause: str) -> None:
    """Make the toy stages known to a worker."""
    sys.path.insert(0, folder)
    os.environ["TOY_PAUSE"] = pause
    import install_toys

    install_toys.install()


@pytest.fixture
def cluster() -> Iterator[Any]:
    settings = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with (
        distributed.LocalCluster(**settings) as cluster,
        distributed.Client(cluster) as client,
    ):
        client.register_worker_callbacks(lambda: prepare(str(TOYS), "0.3"))
        yield cluster


def requests(toy: Toy) -> list[Request]:
    texts = {"a": "1 2", "b": "two", "c": "3", "d": "4 5 6"}
    folders = [install_toys.make_session(toy.folder / "many" / n, t) for n, t in texts.items()]
    return [
        replace(toy.request(), root=toy.runs / folder.name, session=folder) for folder in folders
    ]


def check(toy: Toy, given: list[Request], states: list[str]) -> None:
    assert states == ["done", "refused", "done", "done"]
    for request in given:
        if request.session is not None and request.session.name != "b":
            alone = replace(request, root=toy.folder / "alone" / request.root.name)
            run_session(alone)
            assert contents(alone.root) == contents(request.root)


@pytest.mark.slow
def test_same_bytes_as_the_local_engine(toy: Toy, cluster: Any) -> None:
    given = requests(toy)
    outcomes = run_on_cluster(given, cluster.scheduler_address, unheard)
    check(toy, given, [outcome.state for outcome in outcomes])


@pytest.mark.slow
def test_a_worker_killed_in_mid_run_loses_nothing(toy: Toy, cluster: Any) -> None:
    given = requests(toy)
    victim = next(iter(cluster.workers.values())).pid

    def kill() -> None:
        staging = Path(".bampipe", "staging", "toy_double")
        while not any((request.root / staging).exists() for request in given):
            time.sleep(0.02)
        os.kill(victim, signal.SIGKILL)

    thread = threading.Thread(target=kill)
    thread.start()
    outcomes = run_on_cluster(given, cluster.scheduler_address, unheard)
    thread.join()
    check(toy, given, [outcome.state for outcome in outcomes])


def test_no_scheduler_is_one_line(toy: Toy) -> None:
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        run_on_cluster([toy.request()], "tcp://127.0.0.1:1", unheard)
