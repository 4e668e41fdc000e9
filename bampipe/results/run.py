"""``run.json``: steps, settings, inputs and outputs of a run."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from bampipe.results.record import Names, Record, Result, Size

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
    declared_inputs: Names
    inputs: dict[str, InputDigest]
    outputs: dict[str, Digest]
    code: Digest = Field(description="Of the sources that the stage uses")
    versions: dict[str, str]
    summary: dict[str, Any]


class Timing(Record):
    """When a step ran, and for how long."""

    started_at: str
    seconds: Size


class GateVerdict(Record):
    """The verdict of one quality gate."""

    gate: str
    model: str = Field(default="", description='The model that was judged, or ""')
    key: str = Field(description='What * stood for, or ""')
    state: GateState
    value: float | None
    message: str


class RunResult(Result):
    """Provenance: steps, settings, inputs and outputs of a run."""

    FILE: ClassVar[str] = "run.json"
    STAGE: ClassVar[str] = "run"

    schema_: Literal["bampipe.run/1"] = Field(alias="schema")
    run: str = Field(default="", description="Name of the run folder")
    place: Place = Field(default=Place())
    pipeline: PipelineUsed | None = None
    stages: dict[str, StepRecord] = Field(description="By step: <stage>, or <stage>:<model>")
    timings: dict[str, Timing] = Field(default={})
    failures: dict[str, str] = Field(default={}, description="By step: why its last try failed")
    versions: dict[str, str] = Field(
        default={}, description="Of Python, bampipe and what it rests on, at the last run"
    )
    gates: tuple[GateVerdict, ...] = ()
