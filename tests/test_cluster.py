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
from bampipe.run import pipeline as pipelines
from bampipe.run.cluster import _placed, run_on_cluster
from bampipe.run.events import unheard
from bampipe.run.request import Request, Step
from bampipe.run.runner import run_session
from bampipe.run.state import RunState

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


@pytest.mark.slow
def test_workers_publish_what_they_have_run(toy: Toy, cluster: Any) -> None:
    pytest.importorskip("fsspec", reason="the remote extra is not installed")
    from bampipe.run.publish import fetch, published

    url = f"file://{toy.folder / 'far'}"
    given = [replace(request, publish=url) for request in requests(toy)]
    outcomes = run_on_cluster(given, cluster.scheduler_address, unheard)
    check(toy, given, [outcome.state for outcome in outcomes])
    assert published(url) == sorted(
        request.root.name for request in given if request is not given[1]
    )
    back = fetch(url, given[0].root.name, toy.folder / "back")
    assert contents(back) == contents(given[0].root)


def test_a_stage_on_a_worker_starts_no_processes(tmp_path: Path) -> None:
    """Dask's workers are daemons, and a daemon may have no children: a diagnosis must know."""
    request = replace(
        Request(tmp_path / "runs/s", pipelines.load("diagnose")),
        processes=1,
        accepted=Path("accepted"),
    )
    step = Step("diagnose", "base")
    assert _placed(request).accepted == Path.cwd() / "accepted"
    state = RunState(_placed(replace(request, processes=2)))
    assert state.configure(step, state.settings(step)).jobs == 1


def test_no_scheduler_is_one_line(toy: Toy) -> None:
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        run_on_cluster([toy.request()], "tcp://127.0.0.1:1", unheard)
