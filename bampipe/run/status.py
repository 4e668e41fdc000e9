"""The status of each step of a run and of each file, without running anything."""

from dataclasses import dataclass
from pathlib import Path

from bampipe.data.run_folder import RunFolder
from bampipe.declarations.pipeline import Pipeline
from bampipe.errors import InputError
from bampipe.files import digest_file, digest_input
from bampipe.results.run import PRIVATE, SESSION
from bampipe.run import hashing, record
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


def verify(root: Path) -> list[tuple[str, str]]:
    """Recompute every hash that ``run.json`` records.

    Returns:
        Pairs of a file and its state: "changed", "gone", or "unknown" for a file that no stage
        recorded; ``run.json`` itself may be "damaged". Empty if all is as it was written.
    """
    content = record.read(root)
    found: dict[str, str] = {record.FILE: "damaged"} if record.is_damaged(root) else {}
    recorded: set[str] = {record.FILE}
    for made in content.stages.values():
        inputs = {n: d for n, d in made.inputs.items() if not n.startswith(SESSION)}
        for names, digest in ((made.outputs, digest_file), (inputs, digest_input)):
            for name, written in names.items():
                recorded.add(name)
                path = root / name
                # Text inputs of a stage are checked here, all others as outputs of their stage.
                held = names is made.outputs or path.suffix == ".toml"
                if not path.is_file():
                    found.setdefault(name, "gone")
                elif held and digest(path) != written:
                    found.setdefault(name, "changed")
    place = content.place.session
    for stage in {*base.READS_SESSION} & content.stages.keys():
        if place is None or not Path(place).is_dir():
            found["session"] = "gone"
            continue
        noted, now = content.stages[stage].inputs, hashing.digest_session(Path(place))
        for name in noted | now:
            if name.startswith(SESSION) and noted.get(name) != now.get(name):
                gone = now.get(name) in (None, hashing.ABSENT)
                found[name] = "gone" if gone else "changed"
    for name in RunFolder(root).glob("**/*"):
        if name.partition("/")[0] != PRIVATE and name not in recorded:
            found[name] = "unknown"
    return sorted(found.items())
