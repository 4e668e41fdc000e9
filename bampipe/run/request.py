"""Requests to the runner, and its outcomes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from bampipe.declarations.pipeline import Pipeline
from bampipe.errors import InputError
from bampipe.results.run import GateVerdict
from bampipe.stages import base


@dataclass(frozen=True)
class Step:
    """One stage, for one model if the stage runs once per model."""

    stage: str
    model: str = ""

    @property
    def name(self) -> str:
        """The key of the step in ``run.json``."""
        return f"{self.stage}:{self.model}" if self.model else self.stage


@dataclass(frozen=True)
class Request:
    """A request to the runner.

    Attributes:
        root: the run folder.
        pipeline: the pipeline.
        session: the session folder; None for the one recorded in the run folder.
        settings: settings by stage and field, which override those of the pipeline.
        first: first stage to run, on the present results of earlier ones; "" for the first of all.
        last: last stage to run; "" for the last of all.
        force: run every selected step, changed or not.
        model: the only model to run; "" for the base model and others that have been run.
        judge: whether the gates judge `model` instead of the default model.
        accepted: folder of accepted values; None for ``accepted`` beside the folder of runs.
        processes: number of processes for stages that use several; 0 for all cores.
        publish: URL for fsspec at which to publish the finished run folder; "" for nowhere.
        wait: whether to wait while another process holds the run folder; otherwise refuse.
    """

    root: Path
    pipeline: Pipeline
    session: Path | None = None
    settings: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    first: str = ""
    last: str = ""
    force: bool = False
    model: str = ""
    judge: bool = False
    accepted: Path | None = None
    processes: int = 0
    publish: str = ""
    wait: bool = True


@dataclass(frozen=True)
class StepResult:
    """The outcome of one step: its state is "done" or "unchanged".

    Attributes:
        reason: why it ran; seconds: how long it took; summary: what the stage returned.
    """

    step: str
    state: str
    reason: str
    seconds: float
    summary: dict[str, object]


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run.

    Attributes:
        state: "done", "refused" (bad input) or "crashed" (a fault of bampipe).
        verdicts: of the gates. error: one line on the fault, or "".
        traceback: of a fault of bampipe, or "".
        model: model that the gates judged, or "".
    """

    root: Path
    state: str
    steps: tuple[StepResult, ...] = ()
    verdicts: tuple[GateVerdict, ...] = ()
    error: str = ""
    traceback: str = ""
    model: str = ""

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
            "model": self.model,
            "steps": {
                result.step: {"state": result.state, "summary": result.summary}
                for result in self.steps
            },
            "gates": [verdict.model_dump(mode="json") for verdict in self.verdicts],
        }


def select_stages(request: Request) -> tuple[str, ...]:
    """Return the stages from ``first`` to ``last`` of ``request``, in order.

    Raises:
        InputError: the pipeline has no such stage, or nothing lies between the two.
    """
    stages = request.pipeline.stages
    for name in (request.first, request.last):
        if name:
            base.check_stage_name(name)
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
