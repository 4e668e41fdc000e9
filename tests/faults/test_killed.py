"""Commands that are killed or stopped while their worker processes run: no orphan, no lock left."""

import os
import signal
import subprocess
import time
from collections.abc import Callable

import psutil
import pytest
from conftest import Toy

from bampipe.errors import InputError
from bampipe.run import record
from bampipe.run.events import Event
from bampipe.workers import process_pool


def wait_for(condition: Callable[[], object], seconds: float = 20.0) -> None:
    """Wait until ``condition`` holds."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "nothing happened"
        time.sleep(0.02)


def workers_of(toy: Toy, process: subprocess.Popen[str], number: int) -> list[psutil.Process]:
    """Wait for ``number`` busy workers; returns every process below ``process``."""
    folder = toy.folder / "workers"
    wait_for(lambda: folder.is_dir() and len(list(folder.iterdir())) == number)
    found = psutil.Process(process.pid).children(recursive=True)
    assert {int(path.name) for path in folder.iterdir()} <= {one.pid for one in found}
    return found


def ended(processes: list[psutil.Process], seconds: float = 3.0) -> bool:
    return not psutil.wait_procs(processes, timeout=seconds)[1]


SIGNALS = [signal.SIGKILL, signal.SIGTERM, signal.SIGINT]


@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
def test_workers_and_lock_go_with_the_command(toy: Toy, number: signal.Signals) -> None:
    toy.run()
    good = toy.files()
    process = toy.start(str(toy.session), "--force", pause=60.0, jobs=2)
    workers = workers_of(toy, process, 2)
    began = time.monotonic()
    process.send_signal(number)
    _, said = process.communicate(timeout=10.0)
    assert ended(workers)
    assert time.monotonic() - began < 5.0
    events: list[Event] = []
    with record.lock(toy.root, False, events.append):
        pass
    if number is signal.SIGKILL:
        assert process.returncode == -number
        assert [(event.kind, event.message) for event in events] == [
            ("taken over", f"process {process.pid} on {os.uname().nodename}")
        ]
    else:
        assert process.returncode == 128 + number, said
        assert said.splitlines()[-1] == (
            "bampipe: stopped at toy_double of first; every stage that had finished is kept, and"
            " the same command without --force goes on from there"
        )
        assert events == []
    assert toy.files() == good
    toy.run(force=True)
    assert toy.files() == good


@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
def test_workers_of_workers_go_too(toy: Toy, number: signal.Signals) -> None:
    """Several sessions at once: each in a process of its own, which has workers in its turn."""
    given = toy.many(dict.fromkeys("ab", "1 2 3"))
    process = toy.start(*(str(r.session) for r in given), "--jobs", "2", pause=60.0, jobs=2)
    workers = workers_of(toy, process, 4)
    process.send_signal(number)
    process.communicate(timeout=10.0)
    assert ended(workers)
    for request in given:
        with record.lock(request.root, False):
            pass


def test_the_next_command_says_that_it_takes_over(toy: Toy) -> None:
    process = toy.start(str(toy.session), pause=60.0, jobs=1)
    workers_of(toy, process, 1)
    process.kill()
    process.communicate()
    again = toy.start(str(toy.session), "--no-wait", jobs=1)
    _, said = again.communicate(timeout=30.0)
    assert again.returncode == 0
    assert f"bampipe: process {process.pid} on " in said and " was killed in first" in said


def double(number: int) -> int:
    if number < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 13:
        raise ValueError("an unlucky number")
    return 2 * number


def test_results_come_in_order_and_what_ends_a_worker_is_said() -> None:
    with process_pool(3, os.getpid) as pool:
        first, second = pool.map(double, range(5)), pool.map(double, range(20, 25))
        pairs = list(zip(first, second, strict=True))
    assert pairs == [(2 * k, 40 + 2 * k) for k in range(5)]
    with (
        pytest.raises(InputError, match=r"a worker process was ended \(exit code -9\)"),
        process_pool(2, os.getpid) as pool,
    ):
        list(pool.map(double, [1, 2, -1, 3]))
    with pytest.raises(ValueError, match="unlucky") as caught, process_pool(2, os.getpid) as pool:
        list(pool.map(double, [1, 13]))
    assert "in double" in caught.value.__notes__[0]
