"""Arguments and options that several commands share."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

SessionArgument = Annotated[
    str, typer.Argument(help="Folder of a session: session.toml and its trials.")
]
RunArgument = Annotated[
    str | None,
    typer.Argument(
        metavar="[RUN]",
        help="Name of a run in --runs, or its path or session; the latest if omitted.",
    ),
]
RunsOption = Annotated[
    Path, typer.Option("--runs", envvar="BAMPIPE_RUNS", help="Folder that holds the run folders.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no advice.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Run even if nothing changed.")]
NoWaitOption = Annotated[
    bool, typer.Option("--no-wait", help="Refuse, rather than wait, if the run folder is in use.")
]
PipelineOption = Annotated[
    str, typer.Option("--pipeline", help="Name of a pipeline, or a file of your own.")
]
SettingsOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="A setting of the stage; may be repeated."),
]
ListSettingsOption = Annotated[
    bool, typer.Option("--settings", help="List the settings of this stage, and exit.")
]
ModelOption = Annotated[
    str, typer.Option("--model", help="Only this model; else base, and the others that were run.")
]

BestModelOption = Annotated[
    str, typer.Option("--model", help="A model of the run; the best confirmed one if omitted.")
]

RUNS = Path("runs")


@dataclass(frozen=True)
class StageOptions:
    """The options that every stage takes as a command."""

    settings: SettingsOption = None
    list_settings: ListSettingsOption = False
    pipeline: PipelineOption = ""
    force: ForceOption = False
    runs: RunsOption = RUNS
    no_wait: NoWaitOption = False
    json: JsonOption = False
    quiet: QuietOption = False


DEFAULTS = StageOptions()
