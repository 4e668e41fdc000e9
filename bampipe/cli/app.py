"""The program: its commands, in the order in which help lists them."""

from collections.abc import Callable
from typing import Annotated

import typer

import bampipe
from bampipe.cli import device, finished_runs, loop, new_session, show, stages
from bampipe.cli.effects import effects
from bampipe.cli.lab import lab
from bampipe.cli.monitor import monitor
from bampipe.cli.run import run

app = typer.Typer(
    name="bampipe",
    help="Identify a mechanical model of a manipulator from raw trial logs, and find the missing"
    " effects.\n\nStart with: bampipe run SESSION. Exit codes: 0 done, 1 a quality gate failed,"
    " 2 bad input.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(asked: bool) -> None:
    if asked:
        version()
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version, and exit."
        ),
    ] = False,
) -> None: ...


def version() -> None:
    """Print the version of bampipe.

    Example: bampipe version
    """
    show.say(bampipe.__version__)


COMMANDS: dict[str, Callable[..., None]] = {
    "init": new_session.init,
    "run": run,
    "ingest": stages.ingest,
    "filter": stages.filter_,
    "stiffness": stages.stiffness,
    "identify": stages.identify,
    "viscous": stages.viscous,
    "performance": stages.performance,
    "validate": stages.validate,
    "diagnose": loop.diagnose,
    "draft": loop.draft,
    "next": stages.next_,
    "extend": loop.extend,
    "compare": stages.compare,
    "report": stages.report,
    "effects": effects,
    "simulate": new_session.simulate,
    "demo": loop.demo,
    "lab": lab,
    "accept": finished_runs.accept,
    "export": finished_runs.export,
    "fetch": finished_runs.fetch,
    "monitor": monitor,
    "status": finished_runs.status_,
    "verify": finished_runs.verify_,
    "version": version,
}
for _name, _command in COMMANDS.items():
    app.command(_name, short_help=device.summary_of(_command))(_command)
app.add_typer(device.app, name="device", short_help=device.SUMMARY)
