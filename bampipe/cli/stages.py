"""The stages as commands of their own: ingest to report."""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from bampipe.cli import places, show
from bampipe.cli.one_stage import advise, run_stage, run_stage_of, stage_command
from bampipe.cli.options import (
    DEFAULTS,
    BestModelOption,
    ModelOption,
    RunArgument,
    SessionArgument,
    StageOptions,
)
from bampipe.data.run_folder import RunFolder
from bampipe.errors import InputError
from bampipe.files import write_text
from bampipe.run.session_name import session_id


@stage_command("ingest")
def ingest(session: SessionArgument, options: StageOptions = DEFAULTS) -> None:
    """Read a session's raw logs: convert to SI units, repair, set bad trials aside.

    Example: bampipe ingest sessions/2026-10-03_s01
    """
    folder = places.find_sessions([session])[0]
    root = options.runs / session_id(folder)
    run_stage("ingest", root, options, session=folder)
    advise("bampipe filter RUN", root, options)


@stage_command("filter")
def filter_(
    run: RunArgument = None,
    method: Annotated[str, typer.Option(help="auto, kalman or butterworth.")] = "",
    options: StageOptions = DEFAULTS,
) -> None:
    """Compute velocity and acceleration from the encoders, with error bands.

    Example: bampipe filter 2026-10-03_s01 --method butterworth
    """
    run_stage_of("filter", run, options, method=method)


@stage_command("stiffness")
def stiffness(run: RunArgument = None, options: StageOptions = DEFAULTS) -> None:
    """Compute the stiffness of each axis from its hysteresis loops, and its bandwidth.

    Example: bampipe stiffness 2026-10-03_s01
    """
    run_stage_of("stiffness", run, options)


@stage_command("identify")
def identify(
    run: RunArgument = None,
    model: ModelOption = "",
    method: Annotated[str, typer.Option(help="auto, ukf or least-squares.")] = "",
    engine: Annotated[str, typer.Option(help="compiled; or filterpy: slow, to compare with.")] = "",
    options: StageOptions = DEFAULTS,
) -> None:
    """Estimate a model's parameters, with units and uncertainty.

    Example: bampipe identify 2026-10-03_s01 --method least-squares
    """
    run_stage_of("identify", run, options, model, method=method, engine=engine)


def _command_of_models(stage: str, about: str) -> Callable[..., None]:
    """Return the command of a stage that runs once a model and has no options of its own."""

    def command(
        run: RunArgument = None, model: ModelOption = "", options: StageOptions = DEFAULTS
    ) -> None:
        run_stage_of(stage, run, options, model)

    command.__doc__ = f"{about}\n\nExample: bampipe {stage} 2026-10-03_s01"
    return stage_command(stage)(command)


viscous = _command_of_models(
    "viscous",
    "Estimate the damping that the brakes rendered in viscous trials, against the command.",
)
performance = _command_of_models(
    "performance", "Compute workspace, stiffness, friction, inertia and force at the handle."
)
validate = _command_of_models(
    "validate", "Compare predicted and measured force on trials that the parameters have not seen."
)


@stage_command("next")
def next_(
    run: RunArgument = None,
    model: BestModelOption = "",
    purpose: Annotated[
        str,
        typer.Option(
            "--for", help="precision, decision, sensitivity, or a parameter; auto if omitted."
        ),
    ] = "",
    seconds: Annotated[
        float, typer.Option(help="Length of the trial; 20 if omitted.", show_default=False)
    ] = 0.0,
    plan: Annotated[
        bool, typer.Option("--plan", help="Also plan a set of trials, with a sheet to print.")
    ] = False,
    sd: Annotated[
        str,
        typer.Option(
            metavar="SHARE",
            help="With --plan: largest sd of each parameter, as a share of it; 5% if omitted.",
        ),
    ] = "",
    form: Annotated[
        str,
        typer.Option("--as", help="trajectory: a file for motors to follow, for robots and axes."),
    ] = "",
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="With --as: file to write, .csv, .json or .yaml."),
    ] = None,
    options: StageOptions = DEFAULTS,
) -> None:
    """Propose the trial to record next, in one sentence, with its expected gain.

    Example: bampipe next 2026-10-03_s01

    Example: bampipe next 2026-10-03_s01 --for coulomb.yaw --seconds 30

    Example: bampipe next 2026-10-03_s01 --plan --sd 2%

    Example: bampipe next robot_arm --as trajectory --out motion.yaml
    """
    from bampipe.cli.next_step import after_proposal, print_forecasts

    suffix = _choose_trajectory(form, out, plan)
    if sd and not plan:
        raise InputError("--sd needs --plan", remedy="give --plan with it")
    root = places.find_run(run, options.runs)
    chosen = model or RunFolder(root).default_model()
    share = _parse_share(sd) if sd else 0.0
    if not options.json:
        # A new proposal closes forecasts that a recorded trial has followed: compare these first.
        print_forecasts(root, chosen)
    asked = {"purpose": purpose, "seconds": seconds, "plan": plan, "trajectory": suffix}
    run_stage("next", root, options, model=chosen, more={**asked, "sd": share})
    quiet = options.json or options.quiet
    if suffix:
        file = root / f"models/{chosen}/trajectory.{suffix}"
        if out is not None:
            write_text(out, file.read_text(encoding="utf-8"))
        if not quiet:
            show.say(f"trajectory: {out or file}")
    if plan and not quiet:
        show.say(f"sheet: {root}/models/{chosen}/protocol.pdf")
    advise(after_proposal(root, chosen), root, options)


def _choose_trajectory(form: str, out: Path | None, plan: bool) -> str:
    """Return the form of the trajectory's file, "" if none is asked for."""
    if form not in ("", "trajectory"):
        raise InputError(f"--as: unknown form {form!r}", remedy="--as trajectory")
    if not form and out is not None:
        raise InputError("--out needs --as", remedy="give --as trajectory with it")
    if not form:
        return ""
    if plan:
        raise InputError(
            "--plan makes a sheet for people, --as trajectory a file for motors",
            remedy="give one of them",
        )
    suffix = "csv" if out is None else out.suffix.lower().removeprefix(".").replace("yml", "yaml")
    if suffix not in ("csv", "json", "yaml"):
        raise InputError(f"--out: {out} is no trajectory file", remedy="name it .csv, .json, .yaml")
    return suffix


def _parse_share(text: str) -> float:
    """Return the number that ``5%`` or ``0.05`` means."""
    with contextlib.suppress(ValueError):
        share = float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)
        if 0.0 < share < 1.0:
            return share
    raise InputError(f"--sd: {text!r} is not a share between 0 and 1", remedy="write 5% or 0.05")


@stage_command("compare")
def compare(
    run: RunArgument = None,
    other: Annotated[
        str | None,
        typer.Argument(metavar="[RUN_B]", help="A second session of the device, to be compared."),
    ] = None,
    model: Annotated[
        str, typer.Option(help="For two runs: the model of both; otherwise the best of each.")
    ] = "",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="For two runs: HTML page to write.")
    ] = None,
    options: StageOptions = DEFAULTS,
) -> None:
    """Print the ladder of a run's models; of two runs, what changed between the sessions.

    Two sessions of one device are compared by parameters, verdicts and residuals, and by the
    predictions of each model for the trials of the other. A model that does not travel is refitted
    in one parameter after another, and else diagnosed on those trials.

    Example: bampipe compare 2026-10-03_s01

    Example: bampipe compare 2026-10-03_s01 2026-11-14_s01 --out changed.html
    """
    if other is None:
        run_stage_of("compare", run, options)
        return
    given = {"--set": options.settings, "--pipeline": options.pipeline, "--force": options.force}
    if useless := [name for name, value in given.items() if value]:
        raise InputError(
            f"{useless[0]} has no effect for two runs, which are compared as they are",
            remedy=f"omit {useless[0]}, or run its stage",
        )
    from bampipe.api.session_pair import compare_runs
    from bampipe.report.pair_page import build_page, tabulate_pair

    first, second = (places.find_run(one, options.runs) for one in (run, other))
    with show.Watcher(options.quiet or options.json) as watcher:
        progress = watcher.follow(f"{first.name}, {second.name}", "compare")
        pair = compare_runs(first, second, model, progress)
    if out is not None:
        write_text(out, build_page(pair))
    if options.json:
        show.print_json(pair.model_dump(mode="json"))
        return
    for line in (*pair.sentences, *pair.notes):
        show.say(line)
    for table in tabulate_pair(pair):
        show.print_block(table)
    advice = f"open {out}" if out is not None else f"bampipe compare {first} {second} --out FILE"
    show.print_advice(advice, options.quiet)


@stage_command("report")
def report(
    run: RunArgument = None,
    model: BestModelOption = "",
    open_: Annotated[
        bool, typer.Option("--open", help="Open the page for exploring in the browser.")
    ] = False,
    beside: Annotated[
        str,
        typer.Option(
            metavar="RUN",
            help="Another run of the device, shown with this one on the page for exploring.",
        ),
    ] = "",
    options: StageOptions = DEFAULTS,
) -> None:
    """Write the report: PDF, web page, and a page for exploring.

    Example: bampipe report 2026-10-03_s01 --open

    Example: bampipe report 2026-10-03_s01 --beside 2026-10-04_s01
    """
    root = run_stage_of("report", run, options, detail_model=model)
    advise(f"open {root / 'report' / 'report.pdf'}", root, options)
    page = root / "report/explore.html"
    if beside:
        from bampipe.stages.report import write_page_of_two

        page = write_page_of_two(root, places.find_run(beside, options.runs))
        if not (options.json or options.quiet):
            show.say(f"both sessions: {page}")
    if open_:
        show.page(page)
