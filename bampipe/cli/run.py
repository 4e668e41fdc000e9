"""``bampipe run``: sessions from raw log to report."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bampipe.cli import places, show
from bampipe.cli.lab import refresh
from bampipe.cli.one_stage import parse_settings
from bampipe.cli.options import (
    RUNS,
    ForceOption,
    JsonOption,
    NoWaitOption,
    PipelineOption,
    QuietOption,
    RunsOption,
)
from bampipe.errors import InputError
from bampipe.run.session_name import session_id
from bampipe.stages import base

if TYPE_CHECKING:
    from bampipe.run.request import Outcome, Request

STATES = {0: "done", 1: "gate failed", 2: "bad input", 3: "crashed"}


def run(
    sessions: Annotated[
        list[str], typer.Argument(metavar="SESSION...", help="Session folders, or patterns.")
    ],
    pipeline: PipelineOption = "default",
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="Sessions at once.")] = 1,
    engine: Annotated[
        str, typer.Option(help="local, or dask: the workers of a Dask cluster.")
    ] = "local",
    scheduler: Annotated[
        str, typer.Option(help="Address of the Dask scheduler, tcp://host:port.")
    ] = "",
    first: Annotated[str, typer.Option("--from", metavar="STAGE", help="First stage to run.")] = "",
    last: Annotated[
        str, typer.Option("--until", metavar="STAGE", help="Stop after this stage.")
    ] = "",
    force: ForceOption = False,
    model: Annotated[str, typer.Option(help="Run and judge this model only.")] = "",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="STAGE.NAME=VALUE", help="A setting; may be repeated."),
    ] = None,
    junit: Annotated[
        Path | None, typer.Option(help="Write the gates' verdicts as JUnit XML to this file.")
    ] = None,
    markdown: Annotated[
        Path | None,
        typer.Option(help="Add a summary in Markdown to this file ($GITHUB_STEP_SUMMARY)."),
    ] = None,
    accepted: Annotated[
        Path | None,
        typer.Option(help="Folder of accepted values; accepted/ beside the runs if omitted."),
    ] = None,
    publish: Annotated[
        str,
        typer.Option(
            metavar="URL", help="Also publish finished runs there: s3://bucket/runs, file://..."
        ),
    ] = "",
    runs: RunsOption = RUNS,
    no_wait: NoWaitOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Run a pipeline from raw log to report; only stages that changed run again.

    Example: bampipe run sessions/2026-10-03_s01

    Example: bampipe run 'sessions/*' --jobs 2 --junit gates.xml
    """
    from bampipe.run import batch
    from bampipe.run import pipeline as pipelines
    from bampipe.run.request import Request

    if engine not in ("local", "dask"):
        raise InputError(f"no engine {engine!r}", remedy="choose local or dask")
    if scheduler and engine != "dask":
        raise InputError("--scheduler needs --engine dask")
    folders = places.find_sessions(sessions)
    at_once = min(jobs, len(folders))
    batch.limit_threads(at_once)
    common = Request(
        root=runs,
        pipeline=pipelines.load(pipeline),
        settings=_split_settings(settings),
        first=first,
        last=last,
        force=force,
        model=model,
        judge=True,
        accepted=accepted,
        publish=publish,
        processes=batch.share(at_once),
        wait=not no_wait,
    )
    requests, refused = _make_requests(common, folders)
    several = len(folders) > 1
    with show.Watcher(quiet, several) as watcher:
        if engine == "dask":
            from bampipe.run.cluster import run_on_cluster

            outcomes = run_on_cluster(requests, scheduler, watcher)
        elif several:
            outcomes = batch.run_sessions(requests, jobs, watcher)
        else:
            outcomes = [batch.run_and_publish(requests[0], watcher)]
    outcomes = [*refused, *outcomes]
    _write_summaries(outcomes, junit, markdown)
    _report_runs(outcomes, several, json)
    refresh(runs, several, quiet or json)
    if not several:
        _advise(outcomes[0], runs, quiet, json)
    code = max(outcome.exit_code for outcome in outcomes)
    if code:
        raise typer.Exit(code)


def _advise(outcome: "Outcome", runs: Path, quiet: bool, json: bool) -> None:
    """Print what came of earlier proposals, and the next command."""
    from bampipe.cli.next_step import after_run, print_forecasts

    if not json:
        print_forecasts(outcome.root, outcome.model)
    command = after_run(outcome.root, outcome.model)
    show.print_advice(command.replace("RUN", places.next_to(outcome.root, runs)), quiet, json)


def _make_requests(
    common: "Request", folders: Sequence[Path]
) -> "tuple[list[Request], list[Outcome]]":
    """Return a request for each session folder, and an outcome for each that is refused.

    Args:
        common: what all requests share; its ``root`` is the folder of run folders.

    Raises:
        InputError: the only session is refused.
    """
    from bampipe.run.request import Outcome

    requests: dict[Path, Request] = {}
    refused: list[Outcome] = []
    for folder in folders:
        try:
            root = common.root / session_id(folder)
            if root in requests:
                raise InputError(
                    f"session_id {root.name!r} is also that of {requests[root].session}",
                    where=str(folder),
                    remedy="give each session an id of its own",
                )
        except InputError as error:
            if len(folders) == 1:
                raise
            refused.append(Outcome(folder, "refused", error=str(error)))
            continue
        requests[root] = replace(common, root=root, session=folder)
    return list(requests.values()), refused


def _split_settings(given: Sequence[str] | None) -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = {}
    for name, value in parse_settings(given).items():
        stage, dot, setting = name.partition(".")
        if not dot:
            raise InputError(f"{name!r} names no stage", remedy=f"write --set STAGE.{name}=...")
        base.check_stage_name(stage)
        found.setdefault(stage, {})[setting] = value
    return found


def _write_summaries(
    outcomes: "Sequence[Outcome]", junit: Path | None, markdown: Path | None
) -> None:
    """Write the verdicts of the gates as JUnit XML, and add a summary in Markdown, where asked."""
    from bampipe.run import summaries

    for path, mode in ((junit, "wb"), (markdown, "ab")):
        if path is None:
            continue
        xml = path is junit
        content = summaries.junit(outcomes) if xml else summaries.markdown(outcomes).encode()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open(mode) as stream:
                stream.write(content)
        except OSError as error:
            raise InputError(f"cannot be written: {error.strerror}", where=str(path)) from error


def _report_runs(outcomes: "Sequence[Outcome]", several: bool, json: bool) -> None:
    for outcome in outcomes:
        if outcome.traceback:
            show.note(outcome.traceback)
    if json:
        show.print_json({"sessions": [outcome.content() for outcome in outcomes]})
    elif several:
        rows = []
        for outcome in outcomes:
            gates = "; ".join(
                f"{verdict.gate} {verdict.key}: {verdict.message}".replace(" :", ":")
                for verdict in outcome.verdicts
                if verdict.state in ("failed", "warned")
            )
            seconds = sum(step.seconds for step in outcome.steps)
            state = STATES[outcome.exit_code]
            rows.append([outcome.root.name, state, seconds, outcome.error or gates])
        show.print_table(["session", "state", "seconds", ""], rows)
    else:
        show.print_outcome(outcomes[0])
