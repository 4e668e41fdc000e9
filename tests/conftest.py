"""Fixtures of the whole test suite: toy stages, folders to work in, paths of shared modules."""

import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from jsonschema import Draft202012Validator
from numba.core import dispatcher

TOYS = Path(__file__).parent / "toys"
sys.path.insert(0, str(TOYS))
# The simulators that share no code with bampipe serve tests and benchmarks alike.
sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
SCHEMAS = Path(__file__).parent.parent / "schemas"
# How fast values come says how busy the machine is, and nothing of the code under test.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")

import install_toys  # noqa: E402

import bampipe.stages  # noqa: E402
from bampipe.run import pipeline as pipelines  # noqa: E402
from bampipe.run.events import Event  # noqa: E402
from bampipe.run.request import Outcome, Request  # noqa: E402
from bampipe.run.runner import run_session  # noqa: E402
from bampipe.stages import base  # noqa: E402


def leave_compiling_unmeasured() -> None:
    """Stop coverage while numba compiles, where it would trace every line of numba for nothing."""
    compile_types = dispatcher._FunctionCompiler.compile

    def compile_untraced(*arguments: Any) -> Any:
        trace = sys.gettrace()
        sys.settrace(None)
        try:
            return compile_types(*arguments)
        finally:
            sys.settrace(trace)

    dispatcher._FunctionCompiler.compile = compile_untraced


if "coverage" in sys.modules:
    leave_compiling_unmeasured()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put files with slow tests first: begun last, they keep one process and idle the rest."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


Command = Callable[..., tuple[int, str, str]]
"""``bampipe ARGUMENTS`` in this process: exit code, output and errors."""


class Toy:
    """A session of the toy stages in a folder of its own, and how to run it."""

    def __init__(self, folder: Path, log: Path) -> None:
        self.folder = folder
        self.session = install_toys.make_session(folder / "sessions" / "first")
        self.pipeline_file = install_toys.make_pipeline(folder)
        self.runs = folder / "runs"
        self.root = self.runs / "first"
        self.log = log
        self.events: list[Event] = []

    def request(self, **changes: Any) -> Request:
        pipeline = pipelines.load(str(self.pipeline_file))
        return replace(Request(self.root, pipeline, session=self.session, judge=True), **changes)

    def many(self, sessions: Mapping[str, str]) -> list[Request]:
        """Requests for further sessions, which have these numbers by name."""
        made = [
            install_toys.make_session(self.folder / "many" / name, numbers)
            for name, numbers in sessions.items()
        ]
        return [self.request(root=self.runs / path.name, session=path) for path in made]

    @property
    def options(self) -> tuple[str, ...]:
        """Command-line options that select the pipeline and the folder of runs."""
        return ("--pipeline", str(self.pipeline_file), "--runs", str(self.runs))

    def start(
        self, *arguments: str, pause: float = 0.0, jobs: int = 0, limit: int | None = None
    ) -> subprocess.Popen[str]:
        """``bampipe run`` of the toys in another process.

        Args:
            arguments: of the command; pause: for which doubling a number waits, s; jobs: processes
                in which numbers are doubled; limit: of the size of a file, bytes.
        """

        def prepare() -> None:
            # A shell has its background jobs ignore Ctrl-C, and so their children.
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            if limit is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

        toys = {
            "TOY_PAUSE": str(pause), "TOY_JOBS": str(jobs),
            "TOY_WORKERS": str(self.folder / "workers"),
        }  # fmt: skip
        return subprocess.Popen(
            [sys.executable, str(TOYS / "toy_bampipe.py"), "run", *arguments, *self.options],
            cwd=self.folder, env={**os.environ, **toys}, preexec_fn=prepare, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip

    def run(self, **changes: Any) -> Outcome:
        return run_session(self.request(**changes), self.events.append)

    def ran(self) -> list[str]:
        """Names of the toys that ran since the last call."""
        if not self.log.exists():
            return []
        names = [line.strip('"') for line in self.log.read_text().splitlines()]
        self.log.unlink()
        return names

    def files(self) -> dict[str, bytes]:
        """Everything in the run folder, run.json and what is private apart."""
        return contents(self.root)


def contents(root: Path) -> dict[str, bytes]:
    """The files of a run by path: results, without run.json and the private folder."""
    return {
        name: content
        for name, content in bytes_of(root).items()
        if not name.endswith("run.json") and not name.startswith(".bampipe/")
    }


def bytes_of(folder: Path) -> dict[str, bytes]:
    """All files below a folder by path."""
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def misfits(root: Path) -> list[str]:
    """What the JSON files of a run, a lab or a simulation have that their schemas do not allow."""
    found = []
    for path in sorted(root.rglob("*.json")):
        if ".bampipe" in path.parts:
            continue
        name = "ingest" if path.parent.name == "ingest" else path.stem.rpartition(".")[2]
        content = json.loads(path.read_text(encoding="utf-8"))
        found += [f"{path}: {misfit}" for misfit in schema_misfits(content, name)]
    return found


def schema_misfits(content: object, name: str) -> list[str]:
    """What ``content`` has that ``schemas/<name>.schema.json`` does not allow."""
    schema = json.loads((SCHEMAS / f"{name}.schema.json").read_text(encoding="utf-8"))
    errors = Draft202012Validator(schema).iter_errors(content)
    return [f"{error.json_path}: {error.message}" for error in errors]


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Toy]:
    """A toy session; the stages of bampipe are replaced by the toys for the test."""
    path = list(bampipe.stages.__path__)
    for name in install_toys.TABLES:
        monkeypatch.setattr(base, name, getattr(base, name))
    install_toys.install()
    monkeypatch.setenv("TOY_LOG", str(tmp_path / "log"))
    yield Toy(tmp_path, tmp_path / "log")
    bampipe.stages.__path__[:] = path


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Run ``bampipe ARGUMENTS`` in this process; returns exit code, output and errors."""
    from bampipe.cli import main

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["bampipe", *map(str, arguments)])
        capsys.readouterr()
        code: object = 0
        try:
            main()
        except SystemExit as stop:
            code = stop.code or 0
        printed = capsys.readouterr()
        assert isinstance(code, int)
        return code, printed.out, printed.err

    return call
