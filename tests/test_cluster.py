"""The Dask engine on a real cluster of two worker processes on this machine."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from conftest import TOYS, Toy, contents

from bampipe.errors import InputError
from bampipe.run import cluster as engine
from bampipe.run import pipeline as pipelines
from bampipe.run.cluster import _place, run_on_cluster
from bampipe.run.events import Event, ignore_event
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
    with distributed.LocalCluster(**settings) as cluster, distributed.Client(cluster) as client:
        client.register_worker_callbacks(lambda: prepare(str(TOYS), "0.3"))
        yield cluster


FOUR = {"a": "1 2", "b": "two", "c": "3", "d": "4 5 6"}


def check(toy: Toy, given: list[Request], states: list[str]) -> None:
    assert states == ["done", "refused", "done", "done"]
    for request in given:
        if request.session is not None and request.session.name != "b":
            alone = replace(request, root=toy.folder / "alone" / request.root.name)
            run_session(alone)
            assert contents(alone.root) == contents(request.root)


@pytest.mark.slow
def test_a_worker_killed_in_mid_run_loses_nothing(toy: Toy, cluster: Any) -> None:
    given = toy.many(FOUR)
    victim = next(iter(cluster.workers.values())).pid

    def kill() -> None:
        staging = Path(".bampipe", "staging", "toy_double")
        while not any((request.root / staging).exists() for request in given):
            time.sleep(0.02)
        os.kill(victim, signal.SIGKILL)

    thread = threading.Thread(target=kill)
    thread.start()
    outcomes = run_on_cluster(given, cluster.scheduler_address, ignore_event)
    thread.join()
    check(toy, given, [outcome.state for outcome in outcomes])


@pytest.mark.long
def test_workers_publish_what_they_have_run(toy: Toy, cluster: Any) -> None:
    pytest.importorskip("fsspec", reason="the remote extra is not installed")
    from bampipe.run.publish import fetch, published

    url = f"file://{toy.folder / 'far'}"
    given = [replace(request, publish=url) for request in toy.many(FOUR)]
    outcomes = run_on_cluster(given, cluster.scheduler_address, ignore_event)
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
    assert _place(request).accepted == Path.cwd() / "accepted"
    state = RunState(_place(replace(request, processes=2)))
    assert state.configure(step, state.settings(step)).jobs == 1


# A cluster that is not there, or not any longer


class Listener:
    """A server that takes connections and answers each with the same bytes, or not at all."""

    def __init__(self, answer: bytes) -> None:
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self.socket.getsockname()[1]}"
        self.open: list[socket.socket] = []
        threading.Thread(target=self._answer, args=(answer,), daemon=True).start()

    def _answer(self, answer: bytes) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self.socket.accept()
                self.open.append(connection)
                connection.sendall(answer)


ANSWERS = {"silence": b"", "HTTP": b"HTTP/1.1 400 Bad Request\r\n\r\n" * 20, "bytes": b"\xff" * 999}


@pytest.mark.long
@pytest.mark.parametrize("answer", ANSWERS.values(), ids=ANSWERS)
def test_what_is_no_scheduler_is_one_line(
    toy: Toy, answer: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "PATIENCE_S", 3.0)
    server = Listener(answer)
    began = time.monotonic()
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        run_on_cluster([toy.request()], server.address, ignore_event)
    assert time.monotonic() - began < 8.0
    server.socket.close()


@pytest.mark.parametrize(
    "address", ["tcp://127.0.0.1:1", "tls://127.0.0.1:1", "nothing://x:1", "tcp://127.0.0.1"]
)
def test_an_address_that_nobody_answers_at_is_one_line(
    toy: Toy, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "PATIENCE_S", 0.5)
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        run_on_cluster([toy.request()], address, ignore_event)


@contextlib.contextmanager
def scheduler(tmp_path: Path, *workers: str) -> Iterator[tuple[str, list[Any]]]:
    """A scheduler, and workers, in processes of their own; gives its address and them."""
    file = tmp_path / "scheduler.json"
    plain = ("--scheduler-file", str(file), "--no-dashboard")
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    alone = ["--no-nanny", "--nthreads", "1", "--preload", str(TOYS / "toy_worker.py"), "--name"]
    commands = [
        [sys.executable, "-m", f"distributed.cli.dask_{program}", *plain, *options]
        for program, options in (
            ("scheduler", ["--host", "127.0.0.1", "--port", "0"]),
            *(("worker", [*alone, name]) for name in workers),
        )
    ]
    started = [subprocess.Popen(commands[0], cwd=tmp_path, **quiet)]
    try:
        deadline = time.monotonic() + 30.0
        while not file.exists() or not file.read_text().strip().endswith("}"):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        started += [subprocess.Popen(command, cwd=tmp_path, **quiet) for command in commands[1:]]
        address = json.loads(file.read_text())["address"]
        if workers:
            with distributed.Client(address, set_as_default=False) as client:
                client.wait_for_workers(len(workers), timeout=60.0)
        yield address, started
    finally:
        for process in started:
            process.kill()
            process.wait()


@pytest.mark.long
def test_a_scheduler_without_workers_is_one_line(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "PATIENCE_S", 4.0)
    with scheduler(toy.folder) as (address, _):
        began = time.monotonic()
        with pytest.raises(InputError, match="has had no workers for 4 s"):
            run_on_cluster([toy.request()], address, ignore_event)
        assert time.monotonic() - began < 9.0


@pytest.mark.long
def test_a_worker_in_place_of_a_scheduler_is_one_line(toy: Toy, cluster: Any) -> None:
    worker = next(iter(cluster.workers.values()))
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        run_on_cluster([toy.request()], worker.worker_address, ignore_event)


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "frozen"])
def test_a_scheduler_lost_in_mid_run_keeps_what_was_done(
    toy: Toy, number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TOY_PAUSE", "0.2")
    monkeypatch.setattr(engine, "PATIENCE_S", 4.0)
    given = toy.many({"a": "1", "b": "1 " * 400})
    lost: list[float] = []
    with scheduler(toy.folder, "one") as (address, processes):

        def lose(event: Event) -> None:
            lost.append(time.monotonic())
            processes[0].send_signal(number)

        outcomes = run_on_cluster(given, address, lose)
        assert time.monotonic() - lost[0] < 9.0
        processes[0].send_signal(signal.SIGCONT)
    assert [outcome.state for outcome in outcomes] == ["done", "refused"]
    assert "the Dask scheduler was lost" in outcomes[1].error
    assert [outcome.exit_code for outcome in outcomes] == [0, 2]
    processes[1].wait()
    monkeypatch.setenv("TOY_PAUSE", "0")
    run_session(replace(given[1], root=toy.folder / "alone/b"))
    run_session(given[1])
    assert contents(given[1].root) == contents(toy.folder / "alone/b")
