"""Run the stages of one session: order, cache by content, whole files, provenance."""

from __future__ import annotations

import copy
import errno
import json
import os
import platform
import re
import shutil
import time
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bampipe.errors import InputError
from bampipe.run import hashing, models, record
from bampipe.run.gates import Verdict, judge
from bampipe.run.pipeline import Pipeline
from bampipe.run.settings import configure, plain
from bampipe.stages import base

COMMIT = ".commit.json"
NEUTRAL = ("session", "jobs")
STORAGE_FAULTS = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EROFS: "the file system is read-only",
    errno.EACCES: "no permission to write",
    errno.EPERM: "no permission to write",
}


@dataclass(frozen=True)
class Event:
    """Something that happened in a run, for whoever shows it.

    Attributes:
        run: name of the run folder.
        step: a stage, or ``stage:model``.
        kind: "waiting", "start", "progress", "done", "unchanged" or "failed".
        fraction: how much of the step is done, 0 to 1.
        message: what is under way, why the step runs, or what went wrong.
    """

    run: str
    step: str
    kind: str
    fraction: float = 0.0
    message: str = ""


Listener = Callable[[Event], None]


def unheard(event: Event) -> None:
    """A listener that shows nothing."""


@dataclass(frozen=True)
class Step:
    """One stage, for one model where the stage runs once for each.

    Attributes:
        stage: name of the stage.
        model: name of the model, or "".
    """

    stage: str
    model: str = ""

    @property
    def name(self) -> str:
        """The key of the step in ``run.json``."""
        return f"{self.stage}:{self.model}" if self.model else self.stage


@dataclass(frozen=True)
class Request:
    """What is asked of the runner.

    Attributes:
        root: the run folder.
        pipeline: the pipeline.
        session: the session folder; None takes the one recorded in the run folder.
        settings: settings by stage and field, before those of the pipeline.
        first: first stage that runs; earlier ones are taken as they stand. "" for the first.
        last: last stage that runs, "" for the last.
        force: run every selected step, changed or not.
        model: the only model to run; "" for the base model and what was run of the others.
        judged: the model the gates judge; "" for no gates.
        wait: wait while another process holds the run folder, else refuse.
    """

    root: Path
    pipeline: Pipeline
    session: Path | None = None
    settings: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    first: str = ""
    last: str = ""
    force: bool = False
    model: str = ""
    judged: str = ""
    wait: bool = True


@dataclass(frozen=True)
class StepResult:
    """What came of one step.

    Attributes:
        step: name of the step.
        state: "done", "unchanged" or "failed".
        reason: why it ran.
        seconds: how long it took.
        summary: what the stage returned.
    """

    step: str
    state: str
    reason: str
    seconds: float
    summary: dict[str, object]


@dataclass(frozen=True)
class Outcome:
    """What came of a run.

    Attributes:
        root: the run folder.
        state: "done", "refused" (bad input) or "crashed" (a fault of bampipe).
        steps: the steps in order.
        verdicts: of the gates.
        error: one line on what went wrong, or "".
        traceback: where bampipe itself failed, or "".
    """

    root: Path
    state: str
    steps: tuple[StepResult, ...] = ()
    verdicts: tuple[Verdict, ...] = ()
    error: str = ""
    traceback: str = ""

    @property
    def exit_code(self) -> int:
        """0 done, 1 a gate failed, 2 bad input, 3 a fault of bampipe."""
        if self.state != "done":
            return {"refused": 2, "crashed": 3}[self.state]
        return int(any(verdict.state == "failed" for verdict in self.verdicts))

    def content(self) -> dict[str, object]:
        """Return the outcome as a table that JSON can hold."""
        return {
            "run": str(self.root),
            "state": self.state,
            "error": self.error,
            "steps": {
                result.step: {"state": result.state, "summary": result.summary}
                for result in self.steps
            },
            "gates": [verdict.content() for verdict in self.verdicts],
        }


def session_id(session: Path) -> str:
    """Return the name of the run folder for ``session``: the id in its session file.

    Raises:
        InputError: there is no session, or its id is no name for a folder.
    """
    path = session / "session.toml"
    if not path.is_file():
        if not session.exists():
            raise InputError("no such session folder", where=str(session))
        if session.is_dir() and any(session.glob("*/session.toml")):
            raise InputError(
                "this is a folder of sessions",
                where=str(session),
                remedy=f"give them one by one, or as '{session}/*'",
            )
        raise InputError(
            "no session.toml here",
            where=str(session),
            remedy="give the folder of a session",
        )
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"not valid TOML: {error}", where=str(path)) from error
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error
    name = content.get("session_id")
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9._+-]{0,127}", name):
        raise InputError(
            f"session_id must be a name of letters, digits, '.', '_', '+' or '-', not {name!r}",
            where=str(path),
        )
    return name


def _selected(request: Request) -> tuple[str, ...]:
    stages = request.pipeline.stages
    for name in (request.first, request.last):
        if name:
            base.check_name(name)
        if name and name not in stages:
            raise InputError(
                f"pipeline {request.pipeline.name!r} has no stage {name!r}",
                remedy=f"it has {', '.join(stages)}",
            )
    start = stages.index(request.first) if request.first else 0
    stop = stages.index(request.last) + 1 if request.last else len(stages)
    if start >= stop:
        raise InputError(
            f"--from {request.first} comes after --until {request.last}",
            remedy=f"the order is {', '.join(stages)}",
        )
    return stages[start:stop]


class _Run:
    """The state of one run while it holds its folder."""

    def __init__(self, request: Request, listen: Listener) -> None:
        self.request = request
        self.listen = listen
        self.root = request.root
        self.folder = base.RunFolder(request.root)
        self.content = record.read(request.root)
        self.written = copy.deepcopy(self.content)
        self.records: dict[str, dict[str, Any]] = self.content.setdefault("stages", {})
        self.timings: dict[str, Any] = self.content.setdefault("timings", {})
        self.failures: dict[str, str] = self.content.setdefault("failures", {})
        self.place: dict[str, Any] = self.content.setdefault("place", {})
        self.digests: dict[tuple[str, int, int, int], str] = {}
        self.memory = hashing.HashMemory(self.root / record.PRIVATE / "hashes.json")
        self.session = request.session

    # What a step depends on

    def digest(self, relative: str) -> str:
        """Hash of a file in the run folder, read once as long as it is the same file."""
        path = self.root / relative
        status = path.stat()
        key = (relative, status.st_ino, status.st_size, status.st_mtime_ns)
        if key not in self.digests:
            self.digests[key] = hashing.digest_file(path)
        return self.digests[key]

    def settings(self, step: Step) -> dict[str, object]:
        """Settings of the step as given, without the session: its content counts, not its place."""
        settings = dict(self.request.pipeline.settings.get(step.stage, {}))
        settings.update(self.request.settings.get(step.stage, {}))
        if step.model:
            settings["model"] = step.model
        return settings

    def session_folder(self) -> Path:
        if self.session is None:
            place = self.place.get("session")
            if not isinstance(place, str) or not Path(place).is_dir():
                raise InputError(
                    "the session of this run is not known or no longer there",
                    where=str(self.root),
                    remedy="name the session folder, or start later with --from",
                )
            self.session = Path(place)
        return self.session

    def configure(self, step: Step, settings: Mapping[str, object]) -> Any:
        where = self.request.pipeline.where
        if step.stage in self.request.settings:
            where = ""
        if step.stage in base.READS_SESSION:
            settings = {**settings, "session": str(self.session_folder().resolve())}
        return configure(step.stage, settings, where)

    def inputs(self, step: Step, declared: tuple[str, ...]) -> dict[str, str]:
        """Hashes of all inputs, by path relative to the run folder."""
        found: dict[str, str] = {}
        for pattern in declared:
            if "*" in pattern:
                names = self.folder.glob(pattern)
            else:
                name = pattern.removesuffix("?")
                if not self.folder.exists(name):
                    if pattern.endswith("?"):
                        continue
                    raise self.missing(name)
                names = (name,)
            for name in names:
                self.check_untouched(name)
                path = self.root / name
                is_text = path.suffix == ".toml"
                found[name] = hashing.digest_input(path) if is_text else self.digest(name)
        if step.stage in base.READS_SESSION:
            found.update(hashing.digest_session(self.session_folder(), self.memory))
        return dict(sorted(found.items()))

    def missing(self, name: str) -> InputError:
        maker = _maker(name)
        remedy = f"run `bampipe {maker}` first" if maker else ""
        return InputError(f"{name} is missing", where=str(self.root), remedy=remedy)

    def check_untouched(self, name: str) -> None:
        for step, made in self.records.items():
            written = made.get("outputs", {}).get(name)
            if written is not None and self.digest(name) != written:
                raise InputError(
                    f"{name} was changed since {step} wrote it",
                    where=str(self.root),
                    remedy=f"run `bampipe {step.partition(':')[0]}` again to rebuild it",
                )

    def key(self, step: Step, config: Mapping[str, object], inputs: Mapping[str, str]) -> str:
        return hashing.digest_content(
            {
                "stage": step.stage,
                "config": config,
                "inputs": inputs,
                "code": hashing.digest_code(step.stage),
                "versions": hashing.versions(),
            }
        )

    # Whether a step must run

    def declared(self, step: Step) -> tuple[dict[str, object], tuple[str, ...], Any]:
        """Configuration as recorded, declared inputs, and the configuration itself.

        Where the same settings met the same code before, the record answers, and the module of
        the stage (which may import much) stays unloaded; the configuration is then None.
        """
        made = self.records.get(step.name, {})
        if made.get("settings") == self.settings(step) and made.get("code") == hashing.digest_code(
            step.stage
        ):
            return made["config"], tuple(made["declared_inputs"]), None
        config = self.configure(step, self.settings(step))
        return _lasting(config), base.load(step.stage).inputs(config), config

    def reason(self, step: Step) -> str:
        """Why the step must run; "" if it need not."""
        made = self.records.get(step.name)
        if made is None:
            return "never run"
        if self.request.force:
            return "forced"
        for name, written in made["outputs"].items():
            if not self.folder.exists(name):
                return f"{name} is gone"
            if self.digest(name) != written:
                return f"{name} was changed since it was written"
        config, declared, _ = self.declared(step)
        inputs = self.inputs(step, declared)
        if self.key(step, config, inputs) == made["key"]:
            return ""
        if config != made["config"]:
            return "settings changed"
        for name in sorted(inputs.keys() | made["inputs"].keys()):
            if inputs.get(name) != made["inputs"].get(name):
                return f"{name.removeprefix('session:')} changed"
        if dict(hashing.versions()) != made["versions"]:
            return "versions changed"
        return "the code of the stage changed"

    # Running it

    def staging(self, step: Step) -> Path:
        return self.root / record.PRIVATE / "staging" / step.name.replace(":", "@")

    def execute(self, step: Step, reason: str) -> StepResult:
        name = self.root.name
        self.listen(Event(name, step.name, "start", 0.0, reason))
        started = datetime.now(UTC)
        clock = time.perf_counter()
        config = self.configure(step, self.settings(step))
        module = base.load(step.stage)
        declared = module.inputs(config)
        inputs = self.inputs(step, declared)
        staging = self.staging(step)
        shutil.rmtree(staging, ignore_errors=True)
        staging.mkdir(parents=True)
        outputs = module.outputs(config)
        for pattern in outputs:
            fixed = pattern.partition("*")[0]
            (staging / fixed).parent.mkdir(parents=True, exist_ok=True)
            if fixed.endswith("/"):
                (staging / fixed).mkdir(parents=True, exist_ok=True)

        def progress(fraction: float, message: str) -> None:
            self.listen(Event(name, step.name, "progress", fraction, message))

        summary = module.execute(self.folder, staging, config, progress)
        written = _written(staging, outputs, step)
        settings = _lasting(config)
        previous = self.records.get(step.name, {}).get("outputs", {})
        made: dict[str, Any] = {
            "key": self.key(step, settings, inputs),
            "config": settings,
            "settings": self.settings(step),
            "declared_inputs": list(declared),
            "inputs": inputs,
            "outputs": written,
            "code": hashing.digest_code(step.stage),
            "versions": dict(hashing.versions()),
            "summary": _as_stored(summary, step),
        }
        seconds = time.perf_counter() - clock
        timing = {
            "started_at": started.isoformat(timespec="seconds"),
            "seconds": round(seconds, 3),
        }
        # From here on the step counts as done: a kill leaves the rest to the next run.
        record.replace_json(
            staging / COMMIT,
            {
                "step": step.name,
                "record": made,
                "timing": timing,
                "remove": sorted(previous.keys() - written.keys()),
            },
        )
        self.commit(staging)
        self.listen(Event(name, step.name, "done", 1.0))
        return StepResult(step.name, "done", reason, seconds, made["summary"])

    def commit(self, staging: Path) -> None:
        """Move the outputs of a finished step into the run folder; may be repeated."""
        entry = json.loads((staging / COMMIT).read_text(encoding="utf-8"))
        for relative in entry["record"]["outputs"]:
            source, target = staging / relative, self.root / relative
            if source.is_file():
                target.parent.mkdir(parents=True, exist_ok=True)
                source.replace(target)
        for relative in entry["remove"]:
            (self.root / relative).unlink(missing_ok=True)
        self.records[entry["step"]] = entry["record"]
        self.failures.pop(entry["step"], None)
        self.timings[entry["step"]] = entry["timing"]
        self.save()
        shutil.rmtree(staging)

    def recover(self) -> None:
        """Finish what a killed run had completed, drop what it had not."""
        parent = self.root / record.PRIVATE / "staging"
        for staging in sorted(parent.glob("*")):
            if (staging / COMMIT).is_file():
                self.commit(staging)
            else:
                shutil.rmtree(staging)

    def save(self) -> None:
        self.content["schema"] = record.SCHEMA
        self.content["run"] = self.root.name
        self.content["versions"] = dict(hashing.versions())
        self.place["machine"] = platform.platform()
        if self.session is not None:
            self.place["session"] = str(self.session.resolve())
        record.write(self.root, self.content)

    def failed(self, step: Step, error: str) -> None:
        """Note that the step failed; what its last success left stays, and stays recorded."""
        shutil.rmtree(self.staging(step), ignore_errors=True)
        self.failures[step.name] = error
        self.save()
        self.listen(Event(self.root.name, step.name, "failed", 0.0, error))

    # All of it

    def steps(self, stage: str) -> tuple[Step, ...]:
        if stage not in base.PER_MODEL:
            return (Step(stage),)
        if self.request.model:
            return (Step(stage, self.request.model),)
        children = (
            name
            for name in models.names(self.root)
            if name != models.BASE and Step(stage, name).name in self.records
        )
        return (Step(stage, models.BASE), *(Step(stage, name) for name in children))

    def run(self) -> Outcome:
        results: list[StepResult] = []
        pipeline = self.request.pipeline
        for stage in _selected(self.request):
            if stage in base.PER_MODEL:
                models.ensure_base(self.root, pipeline.device, pipeline.effects)
                if self.request.model:
                    models.read(self.root, self.request.model)
            for step in self.steps(stage):
                results.append(self.step(step))
        verdicts: list[Verdict] = []
        if self.request.judged:
            for gate in pipeline.gates:
                verdicts += judge(gate, self.root, self.request.judged)
        noted = {**self.content, "failures": dict(self.failures)}
        if self.request.judged:
            noted["pipeline"] = pipeline.content()
            noted["gates"] = [verdict.content() for verdict in verdicts]
        if self.session is not None:
            noted["place"] = {**self.place, "session": str(self.session.resolve())}
        if noted != self.written:
            self.content.update(noted)
            self.place = self.content["place"]
            self.save()
        if self.memory.changed:
            record.replace_json(self.memory.path, self.memory.notes)
        return Outcome(self.root, "done", tuple(results), tuple(verdicts))

    def step(self, step: Step) -> StepResult:
        try:
            reason = self.reason(step)
            if reason:
                return self.execute(step, reason)
        except InputError as error:
            self.failed(step, str(error))
            raise
        except Exception as error:
            self.failed(step, f"{type(error).__name__}: {error}")
            raise
        self.failures.pop(step.name, None)
        self.listen(Event(self.root.name, step.name, "unchanged", 1.0))
        return StepResult(step.name, "unchanged", "", 0.0, self.records[step.name]["summary"])


def _maker(name: str) -> str:
    """Return the stage that writes the file ``name``, or ""."""
    head, _, rest = name.partition("/")
    if head != "models":
        return head if head in base.STAGES else ""
    model = rest.partition("/")[0]
    for stage in base.PER_MODEL:
        if name in base.load(stage).outputs(configure(stage, {"model": model})):
            return stage
    return ""


def _lasting(config: object) -> dict[str, object]:
    """Return the fields of a configuration that a result depends on.

    Not the session's place (its content counts) nor the number of processes.
    """
    return {name: value for name, value in plain(config).items() if name not in NEUTRAL}


def _written(staging: Path, declared: tuple[str, ...], step: Step) -> dict[str, str]:
    """Hash what a stage wrote, and hold it to what it declared."""
    files = {
        path.relative_to(staging).as_posix(): path
        for path in sorted(staging.rglob("*"))
        if path.is_file()
    }
    allowed: set[str] = set()
    for pattern in declared:
        if "*" in pattern:
            allowed |= {
                path.relative_to(staging).as_posix()
                for path in staging.glob(pattern)
                if path.is_file()
            }
        elif pattern in files:
            allowed.add(pattern)
        else:
            raise RuntimeError(f"stage {step.name} did not write {pattern}, which it declares")
    undeclared = sorted(files.keys() - allowed)
    if undeclared:
        raise RuntimeError(f"stage {step.name} wrote {undeclared[0]}, which it does not declare")
    return {name: hashing.digest_file(path) for name, path in files.items()}


def _as_stored(summary: dict[str, object], step: Step) -> dict[str, object]:
    """Return the summary as it reads back from JSON."""
    try:
        stored: dict[str, object] = json.loads(json.dumps(summary, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise RuntimeError(f"the summary of stage {step.name} is not JSON: {error}") from error
    return stored


def run_session(request: Request, listen: Listener = unheard) -> Outcome:
    """Run the selected stages of one session.

    Args:
        request: what to run, where.
        listen: told of every event.

    Returns:
        What came of it.

    Raises:
        InputError: bad input; results of earlier runs stay as they were.
    """
    _selected(request)
    fresh = not request.root.exists()
    try:
        with record.lock(
            request.root,
            request.wait,
            lambda: listen(Event(request.root.name, "", "waiting")),
        ):
            run = _Run(request, listen)
            run.recover()
            try:
                return run.run()
            except InputError:
                if fresh and not run.records:
                    shutil.rmtree(request.root)
                raise
    except OSError as error:
        if error.errno not in STORAGE_FAULTS:
            raise
        raise InputError(
            STORAGE_FAULTS[error.errno],
            where=os.fspath(error.filename or request.root),
            remedy="earlier results are untouched",
        ) from error


@dataclass(frozen=True)
class StepStatus:
    """Where one step of a run stands.

    Attributes:
        step: name of the step.
        state: "current", "stale", "failed" or "not run".
        reason: why it would run again, or what went wrong.
        started_at: when it last ran, UTC, or "".
        seconds: how long it took, or None.
    """

    step: str
    state: str
    reason: str
    started_at: str
    seconds: float | None


def status(root: Path, pipeline: Pipeline) -> list[StepStatus]:
    """Return where each step of the run ``root`` stands; changes nothing.

    Args:
        root: the run folder.
        pipeline: the pipeline whose settings count.
    """
    run = _Run(Request(root, pipeline), unheard)
    found = []
    shown = [
        stage
        for stage in base.STAGES
        if stage in pipeline.stages or any(name.startswith(stage) for name in run.records)
    ]
    stale = False
    for stage in shown:
        for step in run.steps(stage):
            timing = run.timings.get(step.name, {})
            if step.name in run.failures:
                state, reason = "failed", run.failures[step.name]
            elif step.name not in run.records:
                state, reason = "not run", ""
            else:
                try:
                    reason = run.reason(step)
                except InputError as error:
                    reason = str(error)
                if not reason and stale:
                    reason = "an earlier stage is stale"
                state = "stale" if reason else "current"
            stale = stale or state != "current"
            found.append(
                StepStatus(
                    step.name,
                    state,
                    reason,
                    timing.get("started_at", ""),
                    timing.get("seconds"),
                )
            )
    return found


def verify(root: Path) -> list[tuple[str, str]]:
    """Recompute every hash that ``run.json`` records.

    Args:
        root: the run folder.

    Returns:
        Pairs of a file and what became of it: "changed", "gone", or "unknown" for a file that no
        stage recorded. Empty where all is as it was written.
    """
    content = record.read(root)
    found: dict[str, str] = {}
    recorded: set[str] = {record.FILE}
    for made in content["stages"].values():
        for name, written in made.get("outputs", {}).items():
            recorded.add(name)
            path = root / name
            if not path.is_file():
                found[name] = "gone"
            elif hashing.digest_file(path) != written:
                found[name] = "changed"
        for name, written in made.get("inputs", {}).items():
            if name.startswith("session:"):
                continue
            recorded.add(name)
            path = root / name
            if name in found:
                continue
            if not path.is_file():
                found[name] = "gone"
            elif hashing.digest_input(path) != written and path.suffix == ".toml":
                found[name] = "changed"
    place = content.get("place", {}).get("session")
    for stage in base.READS_SESSION:
        noted = content["stages"].get(stage, {}).get("inputs", {})
        if not noted:
            continue
        if not isinstance(place, str) or not Path(place).is_dir():
            found["session"] = "gone"
            continue
        now = hashing.digest_session(Path(place))
        for name in sorted(noted.keys() | now.keys()):
            if name.startswith("session:") and noted.get(name) != now.get(name):
                gone = now.get(name) in (None, hashing.ABSENT)
                found[name] = "gone" if gone else "changed"
    for path in sorted(root.rglob("*")):
        relative = path.relative_to(root)
        private = relative.parts[0] == record.PRIVATE
        if path.is_file() and not private and relative.as_posix() not in recorded:
            found[relative.as_posix()] = "unknown"
    return sorted(found.items())
