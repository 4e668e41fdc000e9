"""``bampipe diagnose``, ``draft``, ``extend`` and ``demo``: the loop as commands."""

from dataclasses import replace
from typing import Annotated

import typer

from bampipe.cli import places, show
from bampipe.cli.one_stage import advise, run_stage, stage_command
from bampipe.cli.options import (
    DEFAULTS,
    RUNS,
    BestModelOption,
    ForceOption,
    JsonOption,
    NoWaitOption,
    QuietOption,
    RunArgument,
    RunsOption,
    StageOptions,
)
from bampipe.data.run_folder import BASE, RunFolder
from bampipe.errors import InputError


@stage_command("diagnose")
def diagnose(
    run: RunArgument = None, model: BestModelOption = "", options: StageOptions = DEFAULTS
) -> None:
    """Find the effects that a model lacks, axis by axis, with their probabilities.

    Example: bampipe diagnose 2026-10-03_s01
    """
    from bampipe.cli.next_step import print_forecasts
    from bampipe.results.diagnose import DiagnoseResult
    from bampipe.run import models

    root = places.find_run(run, options.runs)
    chosen = models.choose_model(root, model)
    run_stage("diagnose", root, options, model=chosen)
    if not options.json:
        print_forecasts(root, chosen)
    advise(RunFolder(root).read(DiagnoseResult, chosen).next, root, options)


@stage_command("draft")
def draft(
    run: RunArgument = None,
    model: BestModelOption = "",
    curve: Annotated[
        bool,
        typer.Option("--curve", help="Draft a curve through points instead, for prediction alone."),
    ] = False,
    options: StageOptions = DEFAULTS,
) -> None:
    """Draft a formula for a residual that no effect explains, as an effect file.

    Example: bampipe draft 2026-10-03_s01
    """
    from bampipe.results.draft import DraftResult
    from bampipe.run import models

    root = places.find_run(run, options.runs)
    chosen = models.choose_model(root, model)
    run_stage("draft", root, options, model=chosen, more={"curve": curve})
    advise(RunFolder(root).read(DraftResult, chosen).next, root, options)


def extend(
    first: Annotated[
        str | None,
        typer.Argument(metavar="[RUN]", help="Run folder; the most recent run if omitted."),
    ] = None,
    others: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="EFFECT...",
            help="Effects to add, name[:target], built in or drafted; or effect files[:target].",
        ),
    ] = None,
    auto: Annotated[
        bool, typer.Option("--auto", help="Diagnose and add effects until nothing is missing.")
    ] = False,
    draft: Annotated[
        bool,
        typer.Option("--draft", help="With --auto: draft a formula for an unexplained residual."),
    ] = False,
    model: BestModelOption = "",
    force: ForceOption = False,
    runs: RunsOption = RUNS,
    no_wait: NoWaitOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Add effects to a model, identify and validate it again, print the ladder.

    Example: bampipe extend 2026-10-03_s01 stribeck:yaw

    Example: bampipe extend 2026-10-03_s01 effects/snag.toml:yaw

    Example: bampipe extend 2026-10-03_s01 --auto --draft
    """
    from bampipe.api import loop
    from bampipe.cli.next_step import after_loop
    from bampipe.phrases.results import describe_unidentified
    from bampipe.results.compare import CompareResult
    from bampipe.results.identify import IdentifyResult
    from bampipe.run import batch, models, record
    from bampipe.run import pipeline as pipelines
    from bampipe.run.request import Request

    batch.limit_threads(1)
    effects = others or []
    if draft and not auto:
        raise InputError("--draft goes with --auto", remedy="or use `bampipe draft RUN`")
    if auto and effects:
        raise InputError("--auto chooses the effects itself", remedy=f"leave out {effects[0]!r}")
    names_run = first is None or auto or bool(record.find_folder(first, runs))
    if first is not None and not names_run and (not effects or _is_effect(first)):
        effects, first = [first, *effects], None
    if not auto and not effects:
        raise InputError("no effect named", remedy="`bampipe effects` lists them; or use --auto")
    root = places.find_run(first, runs)
    request = Request(root, pipelines.whole(root), force=force, wait=not no_wait)
    parent = models.choose_model(root, model)
    with show.Watcher(quiet or json) as watcher:
        options = loop.LoopOptions(request, watcher)
        if auto:
            tell = (lambda line: None) if json else show.say
            last = loop.follow(options, parent, tell, draft)
        else:
            last = loop.extend(options, parent, effects)
    ladder = RunFolder(root).read(CompareResult).model_dump(mode="json")
    if json:
        show.print_json(ladder)
        return
    show.say(f"{root}: {last}")
    show.print_summary(ladder)
    effects_found = RunFolder(root).read(IdentifyResult, last).effects
    for said in filter(None, map(describe_unidentified, effects_found, effects_found.values())):
        show.say(f"note: {said}")
    asked = f"bampipe diagnose RUN{RunFolder(root).model_option(last)}"
    command = after_loop(root, last) if auto else asked
    show.print_advice(command.replace("RUN", places.next_to(root, runs)), quiet, json)


def _is_effect(argument: str) -> bool:
    """Whether ``argument`` names an effect or an effect file, and not a run."""
    from bampipe.physics.registry import effect_names

    name = argument.partition(":")[0]
    return name.endswith(".toml") or name in effect_names()


def demo(runs: RunsOption = RUNS, force: ForceOption = False, quiet: QuietOption = False) -> None:
    """Run the loop on a shipped session with a hidden effect, in minutes.

    Example: bampipe demo
    """
    from bampipe.api.loop import LoopOptions, follow
    from bampipe.results.compare import CompareResult
    from bampipe.results.truth import TruthResult
    from bampipe.results.validate import ValidateResult
    from bampipe.run import batch, models, pipeline
    from bampipe.run.request import Request
    from bampipe.run.runner import run_session
    from bampipe.run.session_name import session_id

    batch.limit_threads(1)
    samples = pipeline.find_shipped("sample_runs")
    if not samples.is_dir():
        raise InputError("this installation has no sample sessions", where=str(samples))
    session = samples / "demo"
    root = runs / session_id(session)
    request = Request(root, pipeline.load(), force=force)
    complete = request.pipeline.with_every_stage()
    run = RunFolder(root)
    with show.Watcher(quiet) as watcher:
        show.say(f"1. {session}: an arm with a fault that its model lacks.")
        run_session(replace(request, session=session, judge=True), watcher)
        for axis, error in run.read(ValidateResult, BASE).axes.items():
            show.say(
                f"   {axis}: error on unseen trials {error.held_out_rmse:.3g} {error.unit}, "
                f"sensor noise alone would leave {error.noise_floor:.3g} {error.unit}"
            )
        show.say(
            "2. Which effect is missing? Diagnose and extend the model until nothing is missing."
        )
        options = LoopOptions(replace(request, pipeline=complete), watcher)
        last = follow(options, BASE, lambda line: show.say(f"   {line}"))
        show.say("3. The error on unseen trials, model by model.")
        for rung in run.read(CompareResult).ladder:
            errors = ", ".join(
                f"{axis} {value:.3g} (floor {rung.noise_floor[axis]:.3g})"
                for axis, value in sorted(rung.held_out_rmse.items())
            )
            show.say(f"   {rung.model}: {errors}")
        options.run("report", "report", "")
        hidden = TruthResult.read(samples / "demo.truth.json").configuration["effects"]
        found = ", ".join(models.read(root, last).effects) or "nothing"
        show.say(f"4. Found: {found}. What was hidden: {', '.join(hidden)}.")
        show.say(f"   In print: {root}/report/report.pdf")
        show.say(f"next: bampipe report {places.next_to(root, runs)} --open")
