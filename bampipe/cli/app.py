"""The commands. Each parses its arguments, calls the runner and prints what came of it."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

import bampipe
from bampipe.cli import device, init, places, show
from bampipe.cli.accept import accept
from bampipe.cli.fetch import fetch
from bampipe.cli.lab import lab, refresh
from bampipe.cli.monitor import monitor
from bampipe.errors import InputError
from bampipe.run import batch, models, record
from bampipe.run import junit as junit_xml
from bampipe.run import pipeline as pipelines
from bampipe.run.request import Outcome, Request
from bampipe.run.runner import run_session
from bampipe.run.session_name import session_id
from bampipe.run.settings import parse_assignment
from bampipe.run.status import status
from bampipe.run.verify import verify
from bampipe.stages import base

app = typer.Typer(
    name="bampipe",
    help="From raw trial logs of a manipulator to a mechanical model that says what it lacks.\n\n"
    "Start with: bampipe run SESSION. Exit codes: 0 done, 1 a quality gate failed, 2 bad input.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

app.add_typer(device.app, name="device")
app.command("init")(init.init)

Session = Annotated[str, typer.Argument(help="Folder of a session: session.toml and its trials.")]
Run = Annotated[
    str | None,
    typer.Argument(
        metavar="[RUN]", help="Run folder, or its name under runs/; the most recent run if omitted."
    ),
]
Runs = Annotated[
    Path, typer.Option("--runs", envvar="BAMPIPE_RUNS", help="Folder that holds the run folders.")
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no advice.")]
Force = Annotated[bool, typer.Option("--force", help="Run even if nothing changed.")]
NoWait = Annotated[
    bool, typer.Option("--no-wait", help="Refuse, rather than wait, if the run folder is in use.")
]
PipelineName = Annotated[
    str, typer.Option("--pipeline", help="Name of a pipeline, or a file of your own.")
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="A setting of the stage; may be repeated."),
]
ListSettings = Annotated[
    bool, typer.Option("--settings", help="List the settings of this stage, and leave.")
]
ModelName = Annotated[
    str, typer.Option("--model", help="Only this model; else base and what was run of the others.")
]

RUNS = Path("runs")
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


def _assignments(given: Sequence[str] | None) -> dict[str, object]:
    return dict(parse_assignment(text) for text in given or ())


def _list_settings(stage: str) -> None:
    module = base.load(stage)
    show.say(f"{stage}: {module.SUMMARY}")
    show.say("")
    show.say((module.Config.__doc__ or "").strip())
    show.say("")
    show.say(f"defaults: {module.Config()}")


def _advise(quiet: bool, json: bool, command: str) -> None:
    if not quiet and not json:
        show.say("")
        show.say(f"next: {command}")


def _whole(root: Path, name: str) -> pipelines.Pipeline:
    """Return the pipeline whose settings count for single stages, with every stage in it."""
    chosen = pipelines.load(name) if name else pipelines.recorded(record.read(root))
    return replace(chosen, stages=base.STAGES)


def _stage(
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
        pipeline=_whole(root, pipeline),
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


@app.command()
def run(
    sessions: Annotated[
        list[str], typer.Argument(metavar="SESSION...", help="Session folders, or patterns.")
    ],
    pipeline: PipelineName = "default",
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="Sessions at once.")] = 1,
    engine: Annotated[
        str, typer.Option(help="local, or dask: the workers of a Dask cluster.")
    ] = "local",
    scheduler: Annotated[
        str, typer.Option(help="Address of the Dask scheduler, tcp://host:port.")
    ] = "",
    first: Annotated[
        str, typer.Option("--from", metavar="STAGE", help="Take earlier stages as they stand.")
    ] = "",
    last: Annotated[
        str, typer.Option("--until", metavar="STAGE", help="Stop after this stage.")
    ] = "",
    force: Force = False,
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
    runs: Runs = RUNS,
    no_wait: NoWait = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """From raw log to report: all stages of a pipeline, those that changed.

    Example: bampipe run sessions/2026-10-03_s01

    Example: bampipe run 'sessions/*' --jobs 2 --junit gates.xml
    """
    if engine not in ("local", "dask"):
        raise InputError(f"no engine {engine!r}", remedy="choose local or dask")
    if scheduler and engine != "dask":
        raise InputError("--scheduler needs --engine dask")
    folders = places.find_sessions(sessions)
    batch.limit_threads(min(jobs, len(folders)))
    chosen = pipelines.load(pipeline)
    stage_settings = _stage_settings(settings)
    requests: list[Request] = []
    outcomes: list[Outcome] = []
    taken: dict[Path, Path] = {}
    for folder in folders:
        try:
            root = runs / session_id(folder)
            if root in taken:
                raise InputError(
                    f"session_id {root.name!r} is that of {taken[root]} too",
                    where=str(folder),
                    remedy="give each session an id of its own",
                )
        except InputError as error:
            if len(folders) == 1:
                raise
            outcomes.append(Outcome(folder, "refused", error=str(error)))
            continue
        taken[root] = folder
        requests.append(
            Request(
                root=root,
                pipeline=chosen,
                session=folder,
                settings=stage_settings,
                first=first,
                last=last,
                force=force,
                model=model,
                judged=model or models.BASE,
                accepted=accepted,
                publish=publish,
                processes=batch.share(min(jobs, len(folders))),
                wait=not no_wait,
            )
        )
    several = len(folders) > 1
    with show.Watcher(quiet, several) as watcher:
        if engine == "dask":
            from bampipe.run.cluster import run_on_cluster

            outcomes += run_on_cluster(requests, scheduler, watcher)
        elif several:
            outcomes += batch.run_sessions(requests, jobs, watcher)
        else:
            outcomes.append(batch.run_and_publish(requests[0], watcher))
    if junit is not None:
        _write_junit(junit, outcomes)
    if markdown is not None:
        _add_markdown(markdown, outcomes, model or models.BASE)
    _report_runs(outcomes, several, json)
    refresh(runs, several, quiet or json)
    if not several:
        name = places.next_to(requests[0].root, runs)
        _advise(quiet, json, _after_run(outcomes[0], name))
    code = max(outcome.exit_code for outcome in outcomes)
    if code:
        raise typer.Exit(code)


def _stage_settings(given: Sequence[str] | None) -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = {}
    for name, value in _assignments(given).items():
        stage, dot, setting = name.partition(".")
        if not dot:
            raise InputError(
                f"{name!r} does not say which stage", remedy=f"write --set STAGE.{name}=..."
            )
        base.check_name(stage)
        found.setdefault(stage, {})[setting] = value
    return found


def _write_junit(path: Path, outcomes: Sequence[Outcome]) -> None:
    suites = [junit_xml.Suite(item.root.name, item.verdicts, item.error) for item in outcomes]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(junit_xml.junit(suites))
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", where=str(path)) from error


def _add_markdown(path: Path, outcomes: Sequence[Outcome], model: str) -> None:
    from bampipe.run.markdown import summary

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as stream:
            stream.write(summary(outcomes, model))
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", where=str(path)) from error


def _report_runs(outcomes: Sequence[Outcome], several: bool, json: bool) -> None:
    for outcome in outcomes:
        if outcome.traceback:
            show.note(outcome.traceback)
    if json:
        show.as_json({"sessions": [outcome.content() for outcome in outcomes]})
    elif several:
        words = {0: "done", 1: "gate failed", 2: "bad input", 3: "crashed"}
        rows = [
            [
                outcome.root.name,
                words[outcome.exit_code],
                sum(step.seconds for step in outcome.steps),
                outcome.error
                or "; ".join(
                    f"{verdict.gate} {verdict.key}: {verdict.message}".replace(" :", ":")
                    for verdict in outcome.verdicts
                    if verdict.state in ("failed", "warned")
                ),
            ]
            for outcome in outcomes
        ]
        show.table(["session", "state", "seconds", ""], rows)
    else:
        show.outcome(outcomes[0])


def _after_run(outcome: Outcome, name: str) -> str:
    if (outcome.root / "report" / "report.pdf").is_file():
        missing = any(verdict.state in ("failed", "warned") for verdict in outcome.verdicts)
        if missing:
            return f"bampipe diagnose {name}"
        return f"open {outcome.root / 'report' / 'report.pdf'}"
    return f"bampipe status {name}"


@app.command()
def ingest(
    session: Session,
    settings: Settings = None,
    list_settings: ListSettings = False,
    pipeline: PipelineName = "",
    force: Force = False,
    runs: Runs = RUNS,
    no_wait: NoWait = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Read a session's raw logs: SI units, repairs, trials set aside with a reason.

    Example: bampipe ingest sessions/2026-10-03_s01
    """
    if list_settings:
        _list_settings("ingest")
        return
    folder = places.find_sessions([session])[0]
    root = runs / session_id(folder)
    _stage(
        "ingest",
        root,
        _assignments(settings),
        session=folder,
        pipeline=pipeline,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )
    _advise(quiet, json, f"bampipe filter {places.next_to(root, runs)}")


def _plain_stage(
    stage: str,
    run: str | None,
    list_settings: bool,
    settings: Mapping[str, object],
    runs: Path,
    **options: Any,
) -> None:
    """Run ``stage`` on the run that ``run`` means, or list its settings."""
    if list_settings:
        _list_settings(stage)
        return
    root = places.find_run(run, runs)
    _stage(stage, root, settings, **options)
    name = places.next_to(root, runs)
    if stage == "report":
        command = f"open {root / 'report' / 'report.pdf'}"
    else:
        command = f"bampipe {AFTER[stage]} {name}"
    _advise(options["quiet"], options["json"], command)


@app.command("filter")
def filter_(
    run: Run = None,
    method: Annotated[str, typer.Option(help="auto, kalman, butterworth or savitzky_golay.")] = "",
    settings: Settings = None,
    list_settings: ListSettings = False,
    pipeline: PipelineName = "",
    force: Force = False,
    runs: Runs = RUNS,
    no_wait: NoWait = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Velocity and acceleration from the encoders, with error bands.

    Example: bampipe filter 2026-10-03_s01 --method butterworth
    """
    given = _assignments(settings) | ({"method": method} if method else {})
    _plain_stage(
        "filter",
        run,
        list_settings,
        given,
        runs,
        pipeline=pipeline,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )


@app.command()
def stiffness(
    run: Run = None,
    settings: Settings = None,
    list_settings: ListSettings = False,
    pipeline: PipelineName = "",
    force: Force = False,
    runs: Runs = RUNS,
    no_wait: NoWait = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Stiffness of each axis from its hysteresis loops, and the bandwidth that follows.

    Example: bampipe stiffness 2026-10-03_s01
    """
    _plain_stage(
        "stiffness",
        run,
        list_settings,
        _assignments(settings),
        runs,
        pipeline=pipeline,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )


@app.command()
def identify(
    run: Run = None,
    model: ModelName = "",
    method: Annotated[str, typer.Option(help="ukf or least-squares.")] = "",
    engine: Annotated[
        str, typer.Option(help="compiled, or filterpy: slow, the same numbers.")
    ] = "",
    settings: Settings = None,
    list_settings: ListSettings = False,
    pipeline: PipelineName = "",
    force: Force = False,
    runs: Runs = RUNS,
    no_wait: NoWait = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Estimate a model's parameters, with units and uncertainty.

    Example: bampipe identify 2026-10-03_s01 --method least-squares
    """
    given = _assignments(settings)
    given |= {"method": method} if method else {}
    given |= {"engine": engine} if engine else {}
    _plain_stage(
        "identify",
        run,
        list_settings,
        given,
        runs,
        pipeline=pipeline,
        model=model,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )


@app.command()
def viscous(
    run: Run = None,
    model: ModelName = "",
    settings: Settings = None,
    list_settings: ListSettings = False,
    pipeline: PipelineName = "",
    force: Force = False,
    runs: Runs = RUNS,
    no_wait: NoWait = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Damping at the handle that the brakes rendered in viscous trials, against the command.

    Example: bampipe viscous 2026-10-03_s01
    """
    _plain_stage(
        "viscous",
        run,
        list_settings,
        _assignments(settings),
        runs,
        pipeline=pipeline,
        model=model,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )


@app.command()
def performance(
    run: Run = None,
    model: ModelName = "",
    settings: Settings = None,
    list_settings: ListSettings = False,
    pipeline: PipelineName = "",
    force: Force = False,
    runs: Runs = RUNS,
    no_wait: NoWait = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Workspace, stiffness, friction, inertia and force at the handle.

    Example: bampipe performance 2026-10-03_s01
    """
    _plain_stage(
        "performance",
        run,
        list_settings,
        _assignments(settings),
        runs,
        pipeline=pipeline,
        model=model,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )


@app.command()
def validate(
    run: Run = None,
    model: ModelName = "",
    settings: Settings = None,
    list_settings: ListSettings = False,
    pipeline: PipelineName = "",
    force: Force = False,
    runs: Runs = RUNS,
    no_wait: NoWait = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Predicted against measured force, on trials the parameters never saw.

    Example: bampipe validate 2026-10-03_s01
    """
    _plain_stage(
        "validate",
        run,
        list_settings,
        _assignments(settings),
        runs,
        pipeline=pipeline,
        model=model,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )


@app.command()
def diagnose(
    run: Run = None,
    model: Annotated[
        str, typer.Option(help="Model to diagnose; the one extended last if omitted.")
    ] = "",
    settings: Settings = None,
    list_settings: ListSettings = False,
    pipeline: PipelineName = "",
    force: Force = False,
    runs: Runs = RUNS,
    no_wait: NoWait = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Which effect is missing from a model, and why the tool believes so.

    Example: bampipe diagnose 2026-10-03_s01
    """
    if list_settings:
        _list_settings("diagnose")
        return
    from bampipe.api.loop import current_model, next_effect

    root = places.find_run(run, runs)
    chosen = model or current_model(root)
    _stage(
        "diagnose",
        root,
        _assignments(settings),
        pipeline=pipeline,
        model=chosen,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )
    name = places.next_to(root, runs)
    effect = next_effect(root, chosen)
    command = f"bampipe extend {name} {effect}" if effect else f"bampipe report {name}"
    _advise(quiet, json, command)


@app.command()
def extend(
    first: Annotated[
        str | None,
        typer.Argument(metavar="[RUN]", help="Run folder; the most recent run if omitted."),
    ] = None,
    second: Annotated[
        str | None,
        typer.Argument(
            metavar="EFFECT", help="Effect to add, name[:target], or an effect file[:target]."
        ),
    ] = None,
    auto: Annotated[
        bool, typer.Option("--auto", help="Follow the diagnosis until it says stop.")
    ] = False,
    model: Annotated[
        str, typer.Option(help="Model to extend; the one extended last if omitted.")
    ] = "",
    force: Force = False,
    runs: Runs = RUNS,
    no_wait: NoWait = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Add an effect to a model, identify and validate it again, print the ladder.

    Example: bampipe extend 2026-10-03_s01 stribeck:yaw

    Example: bampipe extend 2026-10-03_s01 effects/snag.toml:yaw

    Example: bampipe extend 2026-10-03_s01 --auto
    """
    from bampipe.api import loop

    batch.limit_threads(1)
    if auto and second is not None:
        raise InputError("--auto chooses the effects itself", remedy=f"leave out {second!r}")
    alone = first is None or (second is None and places.is_run(first, runs))
    if not auto and alone:
        raise InputError("no effect named", remedy="`bampipe effects` lists them; or use --auto")
    if not auto and second is None:
        first, second = None, first
    root = places.find_run(first, runs)
    pipeline = _whole(root, "")
    parent = model or loop.current_model(root)
    with show.Watcher(quiet or json) as watcher:
        options = loop.Options(root, pipeline, force, not no_wait, watcher)
        if auto:
            last = loop.follow(options, parent, lambda line: None if json else show.say(line))
        else:
            last = loop.extend(options, parent, second or "")
    ladder = base.RunFolder(root).read_json("compare.json")
    if json:
        show.as_json(ladder)
        return
    show.say(f"{root}: {last}")
    show.summary(ladder)
    _advise(quiet, json, f"bampipe diagnose {places.next_to(root, runs)}")


@app.command()
def compare(
    run: Run = None,
    settings: Settings = None,
    list_settings: ListSettings = False,
    force: Force = False,
    runs: Runs = RUNS,
    no_wait: NoWait = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """The ladder: held-out error of each model version against the noise floor.

    Example: bampipe compare 2026-10-03_s01
    """
    _plain_stage(
        "compare",
        run,
        list_settings,
        _assignments(settings),
        runs,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )


@app.command()
def report(
    run: Run = None,
    settings: Settings = None,
    list_settings: ListSettings = False,
    force: Force = False,
    runs: Runs = RUNS,
    no_wait: NoWait = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """PDF and web page of everything found so far.

    Example: bampipe report 2026-10-03_s01
    """
    _plain_stage(
        "report",
        run,
        list_settings,
        _assignments(settings),
        runs,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )


@app.command()
def effects(
    name: Annotated[
        str | None, typer.Argument(help="An effect, name[:target], or an effect file; or check.")
    ] = None,
    file: Annotated[
        str | None, typer.Argument(metavar="[FILE]", help="After check: the effect file.")
    ] = None,
    device: Annotated[
        str, typer.Option(help="Device the effect is shown or checked on; a name or a file.")
    ] = "bam",
    json: Json = False,
) -> None:
    """The effects a model can have; with a name, one of them in full; or an effect file checked.

    Example: bampipe effects

    Example: bampipe effects stribeck:yaw

    Example: bampipe effects check snag.toml --device rail.toml
    """
    from bampipe.cli.device import check_effect_file
    from bampipe.cli.effects import list_all, show_one

    if name == "check":
        if file is None:
            raise InputError("which effect file?", remedy="bampipe effects check FILE")
        check_effect_file(file, device, json)
    elif file is not None:
        raise InputError(f"{file!r} is one argument too many", remedy="bampipe effects NAME")
    elif name is None:
        list_all(json)
    else:
        show_one(name, device, json)


@app.command()
def simulate(
    out: Annotated[Path, typer.Argument(help="Folder of the session to make.")],
    effect: Annotated[
        list[str] | None,
        typer.Option("--effect", help="Effect to hide, name[:target][=strength]; may be repeated."),
    ] = None,
    strength: Annotated[float, typer.Option(help="Strength of effects that state none.")] = 1.0,
    seed: Annotated[int, typer.Option(help="Seed of every random draw.")] = 0,
    device: Annotated[str, typer.Option(help="A built-in device.")] = "bam",
    effect_file: Annotated[
        list[str] | None, typer.Option("--effect-file", help="An effect file; may be repeated.")
    ] = None,
    trials: Annotated[int, typer.Option(help="Number of free trials.")] = 5,
    viscous_trials: Annotated[int, typer.Option(help="Number of viscous-field trials.")] = 0,
    locked_trials: Annotated[
        bool, typer.Option("--locked-trials", help="Also lock and load each axis.")
    ] = False,
    duration: Annotated[float, typer.Option(help="Of a trial, s.")] = 16.0,
    sample_rate: Annotated[float, typer.Option(help="Hz.")] = 500.0,
    file_format: Annotated[str, typer.Option(help="csv or parquet.")] = "csv",
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="NAME=VALUE", help="A parameter of the plant; may be repeated."
        ),
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Make a session from the model, with known effects hidden in it.

    The truth goes into a file beside the session folder.

    Example: bampipe simulate sessions/trial --effect stribeck:yaw --seed 1
    """
    batch.limit_threads(1)
    from bampipe.run.events import Event
    from bampipe.stages.simulate import Config, simulate_session

    parameters: dict[str, float] = {}
    for key, value in _assignments(settings).items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"--set {key} needs a number, not {value!r}")
        parameters[key] = float(value)
    config = Config(
        effects=tuple(effect or ()),
        strength=strength,
        seed=seed,
        device=device,
        effect_files=tuple(effect_file or ()),
        trials=trials,
        viscous_trials=viscous_trials,
        locked_trials=locked_trials,
        duration=duration,
        sample_rate=sample_rate,
        parameters=parameters,
        file_format=file_format,
    )
    with show.Watcher(quiet or json) as watcher:

        def progress(fraction: float, message: str) -> None:
            watcher(Event(out.name, "simulate", "progress", fraction, message))

        content = simulate_session(out, config, progress)
    if json:
        show.as_json(content)
        return
    show.summary(content)
    _advise(quiet, json, f"bampipe run {out}")


@app.command()
def demo(
    runs: Runs = RUNS,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """A shipped session with a hidden effect: the whole loop, in minutes.

    Example: bampipe demo
    """
    from bampipe.cli.demo import demonstrate

    batch.limit_threads(1)
    with show.Watcher(quiet) as watcher:
        demonstrate(runs, force, watcher, show.say)


app.command("lab")(lab)
app.command("accept")(accept)
app.command("fetch")(fetch)
app.command("monitor")(monitor)


@app.command("status")
def status_(run: Run = None, runs: Runs = RUNS, json: Json = False) -> None:
    """Which stages of a run are current, stale or failed.

    Example: bampipe status 2026-10-03_s01
    """
    root = places.find_run(run, runs)
    found = status(root, pipelines.recorded(record.read(root)))
    if json:
        show.as_json({"run": str(root), "steps": [vars(step) for step in found]})
        return
    show.say(str(root))
    show.table(
        ["step", "state", "last run", "seconds", ""],
        [[s.step, s.state, s.started_at, s.seconds, s.reason] for s in found],
    )


@app.command("verify")
def verify_(run: Run = None, runs: Runs = RUNS, json: Json = False) -> None:
    """Recompute every recorded hash; say what was touched since. Exit 1 if anything was.

    Example: bampipe verify 2026-10-03_s01
    """
    root = places.find_run(run, runs)
    found = verify(root)
    if json:
        show.as_json({"run": str(root), "touched": dict(found)})
    elif found:
        show.say(f"{root}: {len(found)} files are not as they were recorded")
        show.table(["file", "state"], found)
    else:
        show.say(f"{root}: every file is as it was recorded")
    if found:
        raise typer.Exit(1)


@app.command("version")
def version() -> None:
    """The version of bampipe.

    Example: bampipe version
    """
    show.say(bampipe.__version__)


def main() -> None:
    """Entry point: a user's mistake is one line on standard error and exit code 2."""
    try:
        app()
    except InputError as error:
        show.note(f"bampipe: error: {error}")
        sys.exit(2)
    except BrokenPipeError:
        # Whoever read our output has closed it (`bampipe effects | head`): leave without noise.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
