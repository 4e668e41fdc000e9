"""``run.json``: steps, settings, inputs and outputs of a run."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from bampipe.files import is_normal
from bampipe.results.record import Names, Record, Result, Size
from bampipe.schema import Declaration, Text, fault

PRIVATE = ".bampipe"
"""Folder of the runner's own files in a run folder."""
SESSION = "session:"
"""Prefix of a session's files among the inputs of a step."""


def is_result(name: object) -> bool:
    """Whether ``name`` can be a result: a normal path, and none of the runner's own files."""
    own = str(name).partition("/")[0].casefold() == PRIVATE
    return is_normal(name) and name != RunResult.FILE and not own


def _check_result(name: str) -> str:
    if not is_result(name):
        raise fault(f"the name {name!r} is not that of a result")
    return name


def _check_input(name: str) -> str:
    if not name.startswith(SESSION) and not is_normal(name):
        raise fault(f"the name {name!r} leads out of the run folder")
    return name


def _check_published(name: str) -> str:
    return name if name == RunResult.FILE else _check_result(name)


ResultName = Annotated[str, AfterValidator(_check_result)]
InputName = Annotated[str, AfterValidator(_check_input)]

Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$", description="SHA-256")]
InputDigest = Annotated[
    str, Field(pattern="^([0-9a-f]{64}|absent)$", description="SHA-256, or that it was absent")
]

GateState = Literal["passed", "failed", "warned", "absent"]


class Place(Record):
    """The machine and session of the run; no result depends on it."""

    machine: str | None = None
    session: str | None = None


class PipelineUsed(Record):
    """The pipeline as it was at the last run."""

    name: str
    device: str
    effects: Names
    stages: Names
    settings: dict[str, dict[str, Any]]


class StepRecord(Record):
    """Inputs, settings and outputs of one step."""

    key: Digest = Field(description="Hash of everything the step depends on")
    config: dict[str, Any] = Field(description="Every setting, defaults included")
    settings: dict[str, Any] = Field(description="Settings as given")
    declared_inputs: tuple[InputName, ...]
    inputs: dict[InputName, InputDigest]
    outputs: dict[ResultName, Digest]
    code: Digest = Field(description="Of the sources that the stage uses")
    versions: dict[str, str]
    summary: dict[str, Any]


class Timing(Record):
    """Time and duration of a step."""

    started_at: str
    seconds: Size


class Commit(Record):
    """Results of a step that have not been moved yet; ``remove``: obsolete ones."""

    step: str
    record: StepRecord
    timing: Timing
    remove: tuple[ResultName, ...]


class GateVerdict(Record):
    """The verdict of one quality gate."""

    gate: str
    model: str = Field(default="", description='The model that was judged, or ""')
    key: str = Field(description='The key that * matched, or ""')
    state: GateState
    value: float | None
    message: str


class RunResult(Result, file="run.json", stage="run"):
    """Provenance: steps, settings, inputs and outputs of a run."""

    schema_: Literal["bampipe.run/1"] = Field(alias="schema")
    run: str = Field(default="", description="Name of the run folder")
    place: Place = Field(default=Place())
    pipeline: PipelineUsed | None = None
    stages: dict[str, StepRecord] = Field(description="By step: <stage>, or <stage>:<model>")
    timings: dict[str, Timing] = Field(default={})
    failures: dict[str, str] = Field(default={}, description="By step: fault of its last attempt")
    versions: dict[str, str] = Field(default={})
    """Of Python, bampipe and its dependencies, at the last run"""
    gates: tuple[GateVerdict, ...] = ()


class Published(Declaration):
    """Which version of a published run counts, and the SHA-256 of each of its files."""

    schema_: Literal["bampipe.published/1"] = Field(alias="schema")
    session: Text
    version: Annotated[str, Field(pattern="^[0-9a-f]{16}$")]
    files: dict[Annotated[str, AfterValidator(_check_published)], str]
