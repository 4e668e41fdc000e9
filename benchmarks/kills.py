"""Kill bampipe at random moments of every stage; the next run must finish with the same bytes.

A run folder goes back and forth between two versions of a session, so that a mixture of old and
new files would show. Each round changes the version, starts `bampipe run` (or `bampipe extend`),
sends SIGKILL, SIGTERM or SIGINT to the command, or to one of its worker processes, at a random
moment after a randomly chosen stage has begun. Then no process may be left, the lock must be free,
the exit code that of the signal, and every recorded file whole; the same command runs again, and
every file is compared with those of a run that nobody disturbed; `bampipe verify` must have
nothing to say.

Usage: python benchmarks/kills.py --kills 200 --seed 1
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import psutil

from bampipe.run import record
from bampipe.run.status import verify
from bampipe.stages import base

PIPELINE = """
schema = "bampipe.pipeline/1"
name = "kills"
stages = {stages}
[settings.filter]
tuning_samples = 2000
[settings.diagnose]
replicates = 4
jobs = 2
"""
EFFECT = "stribeck:carriage"
CHILD = "base+stribeck.carriage"
# Diagnosis, report and the next trial take longest: they have run folders of their own.
SLOW = ("diagnose", "next", "report")
# A formula is drafted where something is unknown; here nothing is.
STAGES = tuple(stage for stage in base.STAGES if stage != "draft")
KINDS = {
    kind: tuple(stage for stage in STAGES if stage not in SLOW or stage == kind)
    for kind in ("core", *SLOW)
}


def steps() -> dict[str, str]:
    """Every step that is killed, and the kind of run folder it is killed in."""
    found = {}
    for stage in STAGES:
        kind = stage if stage in SLOW else "core"
        models = ("base",) if stage in SLOW else ("base", CHILD)
        names = [f"{stage}:{model}" for model in models] if stage in base.PER_MODEL else [stage]
        found |= dict.fromkeys(names, kind)
    return found


EXTEND = "extend"
LONGEST = 600.0
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
ORPHAN_S = 5.0
"""How long a worker may outlive its command: compiled code is not interrupted."""


def start(folder: Path, *arguments: str) -> int:
    """Start ``bampipe ARGUMENTS`` in a process group of its own; everything is imported already.

    Returns:
        Its process id.
    """
    pid = os.fork()
    if pid:
        return pid
    os.setsid()
    # A shell has jobs in the background ignore SIGINT, and so would this one.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.chdir(folder)
    log = os.open("log.txt", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 1)
    os.dup2(log, 2)
    code = 1
    try:
        from bampipe.cli import main

        sys.argv = ["bampipe", *arguments]
        main()
        code = 0
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except Exception:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def finish(folder: Path, *arguments: str) -> None:
    """Run ``bampipe ARGUMENTS`` to its end.

    Raises:
        RuntimeError: it left with another exit code than 0.
    """
    _, status = os.waitpid(start(folder, *arguments), 0)
    code = os.waitstatus_to_exitcode(status)
    if code != 0:
        tail = (folder / "log.txt").read_text()[-2000:]
        raise RuntimeError(f"bampipe {' '.join(arguments)} left with {code}:\n{tail}")


def contents(root: Path) -> dict[str, str]:
    """Hashes of the files of a run, its record and what is private apart."""
    return {
        path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
        and path.name != "run.json"
        and path.relative_to(root).parts[0] != ".bampipe"
    }


def check_recorded(root: Path, apart: str) -> None:
    """Straight after a kill: every file that the record names is there as it was recorded.

    A file may be newer than its record only while a sealed step waits to be moved. Files below
    ``apart`` were taken away on purpose.
    """
    record = json.loads((root / "run.json").read_text())
    sealed: set[str] = set()
    for path in (root / ".bampipe" / "staging").glob("*/.commit.json"):
        entry = json.loads(path.read_text())
        sealed |= {*entry["record"]["outputs"], *entry["remove"]}
        sealed |= set(record["stages"].get(entry["step"], {}).get("outputs", {}))
    now = contents(root)
    for step, made in record["stages"].items():
        for name, digest in made["outputs"].items():
            if name not in sealed and not name.startswith(apart) and now.get(name) != digest:
                raise RuntimeError(f"after a kill, {name} of {step} is not as recorded")


class Folder:
    """A run folder that goes back and forth between two versions of a session.

    Args:
        work: where the sessions and the run folders are.
        kind: which stages are run.
    """

    def __init__(self, work: Path, kind: str) -> None:
        self.work = work
        self.session = work / kind / "session"
        self.root = work / kind / "runs" / "session"
        places = (f"{kind}/session", "--runs", f"{kind}/runs", "--quiet")
        self.command = ("run", *places, "--pipeline", f"{kind}/pipeline.toml")
        self.extend = (EXTEND, places[0], EFFECT, "--model", "base", *places[1:])
        (work / kind).mkdir()
        stages = json.dumps(KINDS[kind])
        (work / kind / "pipeline.toml").write_text(PIPELINE.format(stages=stages))
        self.expected = [self.undisturbed(version) for version in (0, 1)]
        if self.expected[0] == self.expected[1]:
            raise RuntimeError("the two versions must differ")
        self.version = 1
        timings = json.loads((self.root / "run.json").read_text())["timings"]
        self.seconds = {step: float(timing["seconds"]) for step, timing in timings.items()}

    def take(self, version: int) -> None:
        """Put ``version`` in the place of the session."""
        self.version = version
        shutil.rmtree(self.session, ignore_errors=True)
        shutil.copytree(self.work / f"version{version}" / "session", self.session)

    def undisturbed(self, version: int) -> dict[str, str]:
        """What a run of ``version`` gives that nobody disturbs."""
        shutil.rmtree(self.root, ignore_errors=True)
        self.take(version)
        finish(self.work, *self.command)
        finish(self.work, *self.extend)
        finish(self.work, *self.command)
        return contents(self.root)

    def kill(self, step: str, draw: random.Random, number: signal.Signals) -> str:
        """Start a run and send it a signal during or just after ``step``.

        Returns:
            Who got it, "command" or "worker"; "" where the run had ended before.

        Raises:
            RuntimeError: a process or the lock was left, or the exit code is wrong.
        """
        if step == EXTEND:
            shutil.rmtree(self.root / "models" / CHILD)
            pid = start(self.work, *self.extend)
            seconds = sum(self.seconds[f"{stage}:{CHILD}"] for stage in ("identify", "validate"))
            begun = self.root / ".bampipe"
        else:
            pid = start(self.work, *self.command)
            seconds = self.seconds[step]
            begun = self.root / ".bampipe" / "staging" / step.replace(":", "@")
        alive = moment_after(pid, begun, draw.uniform(0.0, 1.2 * seconds))
        workers = psutil.Process(pid).children(recursive=True) if alive else []
        to_worker = bool(workers) and draw.random() < 0.5
        said = (self.work / "log.txt").stat().st_size
        with contextlib.suppress(ProcessLookupError):
            os.kill(draw.choice(workers).pid if to_worker else pid, number)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        left = psutil.wait_procs(workers, timeout=ORPHAN_S)[1]
        if left:
            raise RuntimeError(f"{number.name} to {pid}: {[one.pid for one in left]} are left")
        # A worker may have been idle or done, and the command may have been about to leave.
        expected = {0, 2} if to_worker else {0, -9 if number == signal.SIGKILL else 128 + number}
        with (self.work / "log.txt").open() as log:
            log.seek(said)
            tail = log.read()
        if code not in expected or "Traceback" in tail:
            raise RuntimeError(f"{number.name}, to a worker: {to_worker}: left with {code}\n{tail}")
        with record.lock(self.root, False):
            pass
        if not alive:
            return ""
        return "worker" if to_worker else "command"


def make_versions(work: Path) -> None:
    """Simulate two sessions of the same name."""
    for version in (0, 1):
        made = work / f"version{version}" / "session"
        finish(
            work,
            *("simulate", str(made), "--device", "slider", "--effect", EFFECT, "--trials", "3"),
            *("--duration", "4", "--sample-rate", "200", "--seed", str(version), "--quiet"),
        )


@contextlib.contextmanager
def working_folder(keep: str) -> Iterator[Path]:
    """A folder to work in, kept where it has a name."""
    if keep:
        Path(keep).mkdir(parents=True)
        yield Path(keep).resolve()
        return
    with tempfile.TemporaryDirectory(prefix="bampipe-kills-") as name:
        yield Path(name)


def moment_after(pid: int, staging: Path, pause: float) -> bool:
    """Wait until ``staging`` is there, and ``pause`` seconds more; False if ``pid`` ends first."""
    deadline = time.monotonic() + LONGEST
    end = None
    while time.monotonic() < deadline:
        if os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None:
            return False
        if end is None and staging.exists():
            end = time.monotonic() + pause
        if end is not None and time.monotonic() >= end:
            return True
        time.sleep(0.001)
    raise RuntimeError(f"nothing happened for {LONGEST} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", default="", help="work in this new folder and leave it")
    options = parser.parse_args()
    draw = random.Random(options.seed)
    killed: Counter[str] = Counter()
    sent: Counter[str] = Counter()
    missed = wrong = 0
    began = time.perf_counter()
    # Imported once, here: the kills then meet the work, not Python's start.
    for stage in STAGES:
        base.load_stage(stage)
    kinds = steps()
    targets = (*kinds, EXTEND)
    with working_folder(options.keep) as work:
        make_versions(work)
        folders = {kind: Folder(work, kind) for kind in KINDS}
        while killed.total() < options.kills:
            step = targets[(killed.total() + missed) % len(targets)]
            folder = folders[kinds.get(step, "core")]
            folder.take(1 - folder.version)
            number = SIGNALS[killed.total() % len(SIGNALS)]
            victim = folder.kill(step, draw, number)
            alive = bool(victim)
            killed[step] += alive
            sent[f"{number.name} to the {victim}"] += alive
            missed += not alive
            check_recorded(folder.root, f"models/{CHILD}/" if step == EXTEND else "//")
            if step == EXTEND:
                finish(folder.work, *folder.extend)
            finish(folder.work, *folder.command)
            found, expected = contents(folder.root), folder.expected[folder.version]
            touched = verify(folder.root)
            if found != expected or touched:
                wrong += 1
                names = sorted(expected.keys() | found.keys())
                differing = [name for name in names if found.get(name) != expected.get(name)]
                print(f"kill {killed.total()}, {step}: {differing[:5]} {touched[:5]}", flush=True)
            if killed.total() % 10 == 0 and alive:
                print(f"{killed.total()} kills, {wrong} wrong", flush=True)
    print(f"{killed.total()} kills in {time.perf_counter() - began:.0f} s (seed {options.seed}):")
    for step in targets:
        print(f"  {step:40s} {killed[step]:4d}")
    for kind in sorted(sent):
        print(f"  {kind:40s} {sent[kind]:4d}")
    print("no process and no lock was left")
    print(f"{missed} rounds in which the run had ended before the signal")
    print(f"{wrong} rounds after which a file differed or `bampipe verify` found one touched")
    sys.exit(int(wrong > 0))


if __name__ == "__main__":
    main()
