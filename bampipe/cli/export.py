"""`bampipe export`: an identified model for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bampipe.cli import places, show
from bampipe.cli.options import RUNS, RunArgument, RunsOption
from bampipe.errors import InputError, did_you_mean
from bampipe.run import models


def export(
    run: RunArgument = None,
    form: Annotated[str, typer.Option("--as", help="json, urdf, mjcf, python or c.")] = "json",
    model: Annotated[
        str, typer.Option(help="Model that is written; the best confirmed one if omitted.")
    ] = "",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="File to write; printed if omitted.")
    ] = None,
    runs: RunsOption = RUNS,
) -> None:
    """Write an identified model for other programs.

    json: the device and its effects, every parameter with its uncertainty. urdf: the robot's own
    URDF, bodies and friction as identified. mjcf: the same with its drives and effects, for MuJoCo.
    python, c: one self-contained function of inverse dynamics.

    Example: bampipe export 2026-10-03_s01 --as c --out inverse_dynamics.c
    """
    from bampipe.data.run_folder import RunFolder
    from bampipe.declarations.export import FORMS, export_model
    from bampipe.files import write_text

    chosen = next((known for known in FORMS if known == form), None)
    if chosen is None:
        raise InputError(
            f"unknown form {form!r}{did_you_mean(form, FORMS)}",
            remedy=f"--as {', '.join(FORMS)}",
        )
    root = places.find_run(run, runs)
    counting = models.choose_model(root, model)
    text = export_model(RunFolder(root), counting, chosen)
    if out is None:
        show.say(text.rstrip())
        show.note(f"model {counting} of {root.name}")
        return
    write_text(out, text)
    show.say(f"{out}: model {counting} of {root.name}")
