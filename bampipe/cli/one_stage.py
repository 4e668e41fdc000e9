"""One stage of a run as a command: its settings, its result, the next command."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bampipe.cli import places, show
from bampipe.cli.next_step import after_proposal
from bampipe.cli.options import StageOptions
from bampipe.run import batch, record
from bampipe.run import pipeline as pipelines
from bampipe.run.request import Outcome, Request
from bampipe.run.runner import run_session
from bampipe.run.settings import parse_assignment
from bampipe.run.status import status
from bampipe.stages import base

if TYPE_CHECKING:
    from bampipe.declarations.pipeline import Pipeline

_OF_DIAGNOSIS = ("draft", "next")
"""Stages that use a diagnosis."""


def parse_settings(given: Sequence[str] | None) -> dict[str, object]:
    return dict(parse_assignment(text) for text in given or ())


def print_settings(stage: str) -> None:
    module = base.load_stage(stage)
    show.say(f"{stage}: {module.SUMMARY}")
    show.say("")
    for kind in module.Config.__mro__[:-1]:
        show.say((inspect.getdoc(kind) or "").partition("Attributes:\n")[2].rstrip())
    show.say("")
    show.say(f"defaults: {module.Config()}")


def whole_pipeline(root: Path, name: str) -> Pipeline:
    """Return the pipeline whose settings count for single stages, with every stage in it."""
    chosen = pipelines.load(name) if name else pipelines.recorded(record.read(root))
    return chosen.with_every_stage()


def one_stage(
    stage: str,
    root: Path,
    options: StageOptions,
    *,
    session: Path | None = None,
    model: str = "",
    more: Mapping[str, object] | None = None,
) -> Outcome:
    """Run one stage on the results of earlier ones, and print its findings.

    Args:
        stage: its name.
        root: the run folder.
        options: of the command.
        session: the session folder, of a stage that reads it.
        model: the only model to run; all that the pipeline names, if empty.
        more: settings from options that only this stage has.
    """
    batch.limit_threads(1)
    settings = parse_settings(options.settings) | dict(more or {})
    request = Request(
        root=root,
        pipeline=whole_pipeline(root, options.pipeline),
        session=session,
        settings={stage: settings} if settings else {},
        first=stage,
        last=stage,
        force=options.force,
        model=model,
        wait=not options.no_wait,
    )
    with show.Watcher(options.quiet or options.json) as watcher:
        outcome = run_session(request, watcher)
    if options.json:
        one = len(outcome.steps) == 1
        results = {step.step: step.summary for step in outcome.steps}
        show.print_json(outcome.steps[0].summary if one else results)
        return outcome
    for step in outcome.steps:
        suffix = " (unchanged)" if step.state == "unchanged" else ""
        show.say(f"{root}: {step.step}{suffix}")
        show.print_summary(step.summary)
    if stage in _OF_DIAGNOSIS:
        _say_if_outdated(root, request.pipeline, model)
    return outcome


def _say_if_outdated(root: Path, pipeline: Pipeline, model: str) -> None:
    """Print a note if a diagnosis that has just been used was made from other results."""
    for step in status(root, pipeline):
        # Settings that differ from the pipeline's do not make it wrong; other inputs do.
        if step.step == f"diagnose:{model}" and step.state == "stale" and "/" in step.reason:
            show.say(
                f"note: the diagnosis of {model} is older than what it was made from"
                f" ({step.reason}): run `bampipe diagnose {root} --model {model}`, and this again."
            )


def plain_stage(
    stage: str, run: str | None, options: StageOptions, model: str = "", **more: object
) -> None:
    """Run ``stage`` on the run that ``run`` means, or list its settings.

    ``more``: as of `one_stage`; what is empty was not given.
    """
    if options.list_settings:
        print_settings(stage)
        return
    root = places.find_run(run, options.runs)
    given = {name: value for name, value in more.items() if value}
    outcome = one_stage(stage, root, options, model=model, more=given)
    name = places.next_to(root, options.runs)
    if stage == "report":
        command = f"open {root / 'report' / 'report.pdf'}"
    elif stage == "next":
        command = after_proposal(root, outcome.steps[0].step.partition(":")[2], name)
    else:
        command = f"bampipe {base.AFTER[stage]} {name}"
    show.print_advice(command, options.quiet, options.json)
