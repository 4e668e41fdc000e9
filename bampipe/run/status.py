"""The status of each step of a run, without running anything."""

from dataclasses import dataclass
from pathlib import Path

from bampipe.declarations.pipeline import Pipeline
from bampipe.errors import InputError
from bampipe.run.request import Request
from bampipe.run.state import RunState
from bampipe.stages import base


@dataclass(frozen=True)
class StepStatus:
    """The status of one step of a run.

    Attributes:
        state: "current", "stale", "failed" or "not run".
        reason: why it would run again, or its fault.
        started_at: time of its last run, UTC, or "".
        seconds: duration of its last run, or None.
    """

    step: str
    state: str
    reason: str
    started_at: str
    seconds: float | None


def status(root: Path, pipeline: Pipeline) -> list[StepStatus]:
    """Return the status of each step of the run ``root`` by the settings of ``pipeline``."""
    run = RunState(Request(root, pipeline))
    found = []
    shown = [
        stage
        for stage in base.STAGES
        if stage in pipeline.stages or any(name.startswith(stage) for name in run.records)
    ]
    stale = False
    for stage in shown:
        for step in run.steps(stage):
            timing = run.timings.get(step.name)
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
            # A stage outside the pipeline does not run with it, so later results stay valid.
            stale = stale or (state != "current" and stage in pipeline.stages)
            last_run = (timing.started_at, timing.seconds) if timing else ("", None)
            found.append(StepStatus(step.name, state, reason, *last_run))
    return found
