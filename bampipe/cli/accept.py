"""`bampipe accept`: accept a session's values as the reference for later ones."""

from pathlib import Path
from typing import Annotated

import typer

from bampipe.cli import places, show
from bampipe.cli.options import RUNS, BestModelOption, QuietOption, RunArgument, RunsOption
from bampipe.data.run_folder import RunFolder


def accept(
    run: RunArgument = None,
    model: BestModelOption = "",
    force: Annotated[bool, typer.Option("--force", help="Accept even if a gate failed.")] = False,
    folder: Annotated[
        Path | None,
        typer.Option("--accepted", help="Folder to write to; accepted/ beside runs if omitted."),
    ] = None,
    runs: RunsOption = RUNS,
    quiet: QuietOption = False,
) -> None:
    """Accept a session's parameters as the device's reference for the gates of later runs.

    Example: bampipe accept 2026-10-03_s01
    """
    from bampipe.run import accepted, models

    root = places.find_run(run, runs)
    chosen = models.choose_model(root, model)
    path = accepted.accept(root, chosen, folder or accepted.accepted_folder(root.parent), force)
    show.say(f"{path}: the values of {root.name}, model {chosen}")
    for doubt in accepted.doubts(RunFolder(root), chosen):
        show.say(f"warning: {doubt}")
    show.print_advice(f"put {path} under version control; later runs are compared with it", quiet)
