"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
