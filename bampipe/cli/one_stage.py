"""One stage of a run as a command: its settings, its result, the next command."""

import inspect
import tomllib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bampipe.cli import places, show
from bampipe.cli.options import StageOptions
from bampipe.errors import InputError
from bampipe.stages import base

if TYPE_CHECKING:
    from bampipe.declarations.pipeline import Pipeline
    from bampipe.run.request import Outcome

_OF_DIAGNOSIS = ("draft", "next")
"""Stages that use a diagnosis."""


def stage_command(stage: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return the decorator of a stage's command: its last argument, `StageOptions`, as options.

    With ``--settings`` these are listed instead, whatever else is given.
    """
    shared = inspect.signature(StageOptions).parameters

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = list(inspect.signature(command, eval_str=True).parameters.values())[:-1]

        @wraps(command)
        def expanded(**given: Any) -> None:
            options = StageOptions(**{name: given.pop(name) for name in shared})
            if options.list_settings:
                module = base.load_stage(stage)
                show.say(f"{stage}: {module.SUMMARY}\n")
                for kind in module.Config.__mro__[:-1]:
                    show.say((inspect.getdoc(kind) or "").partition("Attributes:\n")[2].rstrip())
                show.say(f"\ndefaults: {module.Config()}")
            else:
                command(**given, options=options)

        whole = inspect.Signature([*own, *shared.values()])
        expanded.__signature__ = whole  # type: ignore[attr-defined]
        expanded.__annotations__ = {p.name: p.annotation for p in whole.parameters.values()}
        return expanded

    return decorate


def parse_settings(given: Sequence[str] | None) -> dict[str, object]:
    """Return the settings ``NAME=VALUE`` by name; a value is read as TOML, or else as text.

    Raises:
        InputError: there is no ``=``.
    """
    found: dict[str, object] = {}
    for text in given or ():
        name, sign, value = text.partition("=")
        if not sign or not name.strip():
            raise InputError(f"{text!r} is not a setting", remedy="write --set name=value")
        found[name.strip()] = value
        with suppress(tomllib.TOMLDecodeError):
            found[name.strip()] = tomllib.loads(f"value = {value}")["value"]
    return found


def run_stage(
    stage: str,
    root: Path,
    options: StageOptions,
    *,
    session: Path | None = None,
    model: str = "",
    more: Mapping[str, object] | None = None,
) -> "Outcome":
    """Run one stage on the results of earlier ones, and print its findings.

    Args:
        session: the session folder, of a stage that reads it.
        model: the only model to run; all that the pipeline names, if empty.
        more: settings from options that only this stage has; empty ones were not given.
    """
    from bampipe.run import batch
    from bampipe.run import pipeline as pipelines
    from bampipe.run.request import Request
    from bampipe.run.runner import run_session

    batch.limit_threads(1)
    settings = parse_settings(options.settings)
    settings |= {name: value for name, value in (more or {}).items() if value}
    request = Request(
        root=root,
        pipeline=pipelines.whole(root, options.pipeline),
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
        results = {step.step: step.summary for step in outcome.steps}
        show.print_json(outcome.steps[0].summary if len(results) == 1 else results)
        return outcome
    for step in outcome.steps:
        suffix = " (unchanged)" if step.state == "unchanged" else ""
        show.say(f"{root}: {step.step}{suffix}")
        show.print_summary(step.summary)
    if stage in _OF_DIAGNOSIS:
        _say_if_outdated(root, request.pipeline, model)
    return outcome


def _say_if_outdated(root: Path, pipeline: "Pipeline", model: str) -> None:
    """Print a note if a diagnosis that has just been used was made from other results."""
    from bampipe.run.status import status

    for step in status(root, pipeline):
        # Settings that differ from the pipeline's do not make it wrong; other inputs do.
        if step.step == f"diagnose:{model}" and step.state == "stale" and "/" in step.reason:
            show.say(
                f"note: the diagnosis of {model} is older than its inputs ({step.reason}): run"
                f" `bampipe diagnose {root} --model {model}`, and this again."
            )


def run_stage_of(
    stage: str, run: str | None, options: StageOptions, model: str = "", **more: object
) -> Path:
    """Run ``stage`` on the run that ``run`` means, and advise; return the run folder.

    ``more``: see `run_stage`.
    """
    root = places.find_run(run, options.runs)
    run_stage(stage, root, options, model=model, more=more)
    if base.AFTER[stage]:
        advise(f"bampipe {base.AFTER[stage]} RUN", root, options)
    return root


def advise(command: str, root: Path, options: StageOptions) -> None:
    """Print the command to go on with, in which ``RUN`` stands for the run folder ``root``."""
    command = command.replace("RUN", places.next_to(root, options.runs))
    show.print_advice(command, options.quiet, options.json)
