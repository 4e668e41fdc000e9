"""The stages as commands of their own: ingest to report."""

from __future__ import annotations

from typing import Annotated

import typer

from bampipe.cli import places
from bampipe.cli.one_stage import (
    advise,
    assignments,
    one_stage,
    plain_stage,
    print_settings,
)
from bampipe.cli.options import (
    RUNS,
    Force,
    Json,
    ListSettings,
    ModelName,
    NoWait,
    PipelineName,
    Quiet,
    Run,
    Runs,
    Session,
    Settings,
)
from bampipe.run.session_name import session_id


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
        print_settings("ingest")
        return
    folder = places.find_sessions([session])[0]
    root = runs / session_id(folder)
    one_stage(
        "ingest",
        root,
        assignments(settings),
        session=folder,
        pipeline=pipeline,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )
    advise(quiet, json, f"bampipe filter {places.next_to(root, runs)}")


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
    given = assignments(settings) | ({"method": method} if method else {})
    plain_stage(
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
    plain_stage(
        "stiffness",
        run,
        list_settings,
        assignments(settings),
        runs,
        pipeline=pipeline,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )


def identify(
    run: Run = None,
    model: ModelName = "",
    method: Annotated[str, typer.Option(help="auto, ukf, least-squares or output-error.")] = "",
    engine: Annotated[
        str,
        typer.Option(help="compiled; or filterpy: slow, to compare with."),
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
    given = assignments(settings)
    given |= {"method": method} if method else {}
    given |= {"engine": engine} if engine else {}
    plain_stage(
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
    plain_stage(
        "viscous",
        run,
        list_settings,
        assignments(settings),
        runs,
        pipeline=pipeline,
        model=model,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )


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
    plain_stage(
        "performance",
        run,
        list_settings,
        assignments(settings),
        runs,
        pipeline=pipeline,
        model=model,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )


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
    plain_stage(
        "validate",
        run,
        list_settings,
        assignments(settings),
        runs,
        pipeline=pipeline,
        model=model,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )


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
    plain_stage(
        "compare",
        run,
        list_settings,
        assignments(settings),
        runs,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )


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
    plain_stage(
        "report",
        run,
        list_settings,
        assignments(settings),
        runs,
        force=force,
        no_wait=no_wait,
        json=json,
        quiet=quiet,
    )
