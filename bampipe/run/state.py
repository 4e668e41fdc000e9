"""State of a run folder: its record, the dependencies of each step, and which must run again."""

import dataclasses
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bampipe.data.run_folder import BASE, RunFolder
from bampipe.errors import InputError, MissingResultError
from bampipe.files import digest_content, digest_file, digest_input
from bampipe.results.run import SESSION
from bampipe.run import hashing, record
from bampipe.run.request import Request, Step
from bampipe.schema import refusal
from bampipe.stages import base

FIRST_TIME = "never run"
"""Reason of a step without a result."""
_NEUTRAL = ("session", "jobs")
"""Fields of a configuration that affect no result: a place, and a number of processes."""


def configure(stage: str, settings: Mapping[str, object], where: str = "") -> Any:
    """Return the configuration of ``stage`` with ``settings`` in place of the defaults.

    Settings are as TOML or the command line gives them; ``where`` names their file in messages.

    Raises:
        InputError: an unknown field, a value of the wrong type, or one the stage refuses.
    """
    from pydantic import ValidationError

    kind = base.load_stage(stage).Config
    try:
        return kind(**settings)
    except ValidationError as error:
        inside = ("settings", stage) if where else (stage,)
        raise refusal(error, kind, where, inside) from None


def list_lasting(config: Any) -> dict[str, object]:
    """Return the fields of a configuration that affect a result, as JSON can hold them."""
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in dataclasses.asdict(config).items()
        if name not in _NEUTRAL
    }


class RunState:
    """The record of a run folder, the dependencies of its steps, and which of them must run."""

    def __init__(self, request: Request) -> None:
        self.request = request
        self.root = request.root
        self.folder = RunFolder(request.root)
        self.damaged = record.is_damaged(request.root)
        self.written = record.read(request.root)
        self.records = dict(self.written.stages)
        self.timings = dict(self.written.timings)
        self.failures = dict(self.written.failures)
        self.digests: dict[tuple[str, int, int, int], str] = {}
        self.session = request.session

    # Dependencies of a step

    def digest(self, relative: str) -> str:
        """Hash of a file in the run folder, computed once as long as it is the same file."""
        path = self.root / relative
        status = path.stat()
        key = (relative, status.st_ino, status.st_size, status.st_mtime_ns)
        if key not in self.digests:
            self.digests[key] = digest_file(path)
        return self.digests[key]

    def settings(self, step: Step) -> dict[str, object]:
        """Settings of the step as given, without the session, whose content counts instead."""
        settings = dict(self.request.pipeline.settings.get(step.stage, {}))
        settings.update(self.request.settings.get(step.stage, {}))
        if step.model:
            settings["model"] = step.model
        return settings

    def session_folder(self) -> Path:
        if self.session is None:
            place = self.written.place.session
            if place is None or not Path(place).is_dir():
                raise InputError(
                    "the session of this run is not known or no longer there",
                    where=str(self.root),
                    remedy="name the session folder, or start later with --from",
                )
            self.session = Path(place)
        return self.session

    def configure(self, step: Step, settings: Mapping[str, object]) -> Any:
        where = self.request.pipeline.where * (step.stage not in self.request.settings)
        if step.stage in base.READS_SESSION:
            settings = {**settings, "session": str(self.session_folder().resolve())}
        fields = base.load_stage(step.stage).Config.__dataclass_fields__
        if self.request.processes and "jobs" in fields:
            settings = {"jobs": self.request.processes, **settings}
        return configure(step.stage, settings, where)

    def inputs(self, step: Step, declared: tuple[str, ...]) -> dict[str, str]:
        """Hashes of all inputs, by path relative to the run folder."""
        found: dict[str, str] = {}
        for pattern in declared:
            names = self.folder.glob(pattern.removesuffix("?"))
            if not names and not pattern.endswith("?") and "*" not in pattern:
                raise self.missing(pattern)
            for name in names:
                if name == record.FILE:
                    # Only its entries on other steps count, not times and places.
                    others = {k: made.key for k, made in self.records.items() if k != step.name}
                    found[name] = digest_content(others)
                    continue
                for other, made in self.records.items():
                    if name in made.outputs and self.digest(name) != made.outputs[name]:
                        raise record.touched(self.root, name, other)
                is_text = name.endswith(".toml")
                found[name] = digest_input(self.root / name) if is_text else self.digest(name)
        if step.stage in base.READS_SESSION:
            found.update(hashing.digest_session(self.session_folder()))
        return dict(sorted(found.items()))

    def missing(self, name: str) -> MissingResultError:
        maker = _maker(name)
        reads = "SESSION" if maker in base.READS_SESSION else self.root
        return self.folder.missing(name, f"{maker} {reads}" if maker else "")

    def key(self, step: Step, config: Mapping[str, object], inputs: Mapping[str, str]) -> str:
        return digest_content(
            {
                "stage": step.stage,
                "config": config,
                "inputs": inputs,
                "code": hashing.digest_code(step.stage),
                "versions": hashing.versions(),
            }
        )

    # Whether a step must run

    def declared(self, step: Step) -> tuple[dict[str, object], tuple[str, ...]]:
        """Configuration as recorded, and declared inputs.

        If the settings and the code are those of the record, the record supplies both, and the
        module of the stage (which may import much) stays unloaded.
        """
        made = self.records.get(step.name)
        code = hashing.digest_code(step.stage)
        if made is not None and made.settings == self.settings(step) and made.code == code:
            return made.config, made.declared_inputs
        config = self.configure(step, self.settings(step))
        return list_lasting(config), base.paths_of(step.model, base.load_stage(step.stage).INPUTS)

    def reason(self, step: Step) -> str:
        """Return the reason why the step must run, or ""."""
        made = self.records.get(step.name)
        if made is None:
            return "run.json was damaged" if self.damaged else FIRST_TIME
        if self.request.force:
            return "forced"
        for name, written in made.outputs.items():
            if not self.folder.exists(name):
                return f"{name} is gone"
            if self.digest(name) != written:
                return f"{name} was changed since it was written"
        config, declared = self.declared(step)
        inputs = self.inputs(step, declared)
        if self.key(step, config, inputs) == made.key:
            return ""
        if config != made.config:
            return "settings changed"
        for name in sorted(inputs.keys() | made.inputs.keys()):
            if inputs.get(name) != made.inputs.get(name):
                return f"{name.removeprefix(SESSION)} changed"
        if dict(hashing.versions()) != made.versions:
            return "versions changed"
        return "the code of the stage changed"

    def steps(self, stage: str) -> tuple[Step, ...]:
        if stage not in base.PER_MODEL:
            return (Step(stage),)
        if self.request.model:
            return (Step(stage, self.request.model),)
        counting = self.folder.default_model()
        children = (
            name
            for name in self.folder.models()
            if name != BASE and (name == counting or Step(stage, name).name in self.records)
        )
        return (Step(stage, BASE), *(Step(stage, name) for name in children))

    # Storage

    def save(self, **judged: object) -> None:
        """Write ``run.json``, with what the gates ``judged``, unless it is unchanged.

        Versions and the machine are those of the last change.
        """
        place = self.written.place
        if self.session is not None:
            place = place.model_copy(update={"session": str(self.session.resolve())})
        tables = ("timings", "failures")
        update = {name: dict(getattr(self, name)) for name in tables} | {"place": place, **judged}
        noted = self.written.model_copy(update={"stages": dict(self.records), **update})
        if noted != self.written:
            place = place.model_copy(update={"machine": platform.platform()})
            update = {"run": self.root.name, "versions": dict(hashing.versions()), "place": place}
            self.written = noted.model_copy(update=update)
            self.written.write(self.root)


def _maker(name: str) -> str:
    """Return the stage that writes the file ``name``, or ""."""
    head, _, rest = name.partition("/")
    if head != "models":
        return head if head in base.STAGES else ""
    model = rest.partition("/")[0]
    for stage in base.PER_MODEL:
        if name in base.paths_of(model, base.load_stage(stage).OUTPUTS):
            return stage
    return ""
