"""One stage of a run as a command: its settings, its result, what to run next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bampipe.cli import places, show
from bampipe.run import batch, record
from bampipe.run import pipeline as pipelines
from bampipe.run.request import Outcome, Request
from bampipe.run.runner import run_session
from bampipe.run.settings import parse_assignment
from bampipe.stages import base

if TYPE_CHECKING:
    from bampipe.declarations.pipeline import Pipeline

AFTER = {
    "ingest": "filter",
    "filter": "stiffness",
    "stiffness": "identify",
    "identify": "validate",
    "viscous": "report",
    "performance": "report",
    "validate": "diagnose",
    "compare": "report",
}


def assignments(given: Sequence[str] | None) -> dict[str, object]:
    return dict(parse_assignment(text) for text in given or ())


def print_settings(stage: str) -> None:
    module = base.load(stage)
    show.say(f"{stage}: {module.SUMMARY}")
    show.say("")
    show.say((module.Config.__doc__ or "").strip())
    show.say("")
    show.say(f"defaults: {module.Config()}")


def advise(quiet: bool, json: bool, command: str) -> None:
    if not quiet and not json:
        show.say("")
        show.say(f"next: {command}")


def whole_pipeline(root: Path, name: str) -> Pipeline:
    """Return the pipeline whose settings count for single stages, with every stage in it."""
    chosen = pipelines.load(name) if name else pipelines.recorded(record.read(root))
    return chosen.with_every_stage()


def one_stage(
    stage: str,
    root: Path,
    settings: Mapping[str, object],
    *,
    session: Path | None = None,
    pipeline: str = "",
    model: str = "",
    force: bool = False,
    no_wait: bool = False,
    json: bool = False,
    quiet: bool = False,
) -> Outcome:
    """Run one stage on what the earlier ones left, and print what it found."""
    batch.limit_threads(1)
    request = Request(
        root=root,
        pipeline=whole_pipeline(root, pipeline),
        session=session,
        settings={stage: settings} if settings else {},
        first=stage,
        last=stage,
        force=force,
        model=model,
        wait=not no_wait,
    )
    with show.Watcher(quiet or json) as watcher:
        outcome = run_session(request, watcher)
    if json:
        one = len(outcome.steps) == 1
        results = {step.step: step.summary for step in outcome.steps}
        show.as_json(outcome.steps[0].summary if one else results)
        return outcome
    for step in outcome.steps:
        suffix = " (unchanged)" if step.state == "unchanged" else ""
        show.say(f"{root}: {step.step}{suffix}")
        show.summary(step.summary)
    return outcome


def plain_stage(
    stage: str,
    run: str | None,
    list_settings: bool,
    settings: Mapping[str, object],
    runs: Path,
    **options: Any,
) -> None:
    """Run ``stage`` on the run that ``run`` means, or list its settings."""
    if list_settings:
        print_settings(stage)
        return
    root = places.find_run(run, runs)
    one_stage(stage, root, settings, **options)
    name = places.next_to(root, runs)
    if stage == "report":
        command = f"open {root / 'report' / 'report.pdf'}"
    else:
        command = f"bampipe {AFTER[stage]} {name}"
    advise(options["quiet"], options["json"], command)
