"""The program: its commands, in the order in which help lists them."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

import bampipe
from bampipe.cli import checks, device, loop, show, stages
from bampipe.cli.accept import accept
from bampipe.cli.export import export
from bampipe.cli.fetch import fetch
from bampipe.cli.init import init
from bampipe.cli.lab import lab
from bampipe.cli.monitor import monitor
from bampipe.cli.options import RUNS, JsonOption, RunsOption
from bampipe.cli.run import run
from bampipe.cli.simulate import simulate
from bampipe.errors import InputError

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


def effects(
    name: Annotated[
        str | None,
        typer.Argument(help="An effect, name[:target], or an effect file; or check, or adopt."),
    ] = None,
    file: Annotated[
        str | None, typer.Argument(metavar="[FILE]", help="After check or adopt: the effect file.")
    ] = None,
    device: Annotated[
        str, typer.Option(help="Device the effect is shown or checked on; a name or a file.")
    ] = "bam",
    runs: RunsOption = RUNS,
    json: JsonOption = False,
) -> None:
    """List the effects a model can have; with a name, show one in full; check or adopt a file.

    An adopted file is copied beside the run folders, and every run there weighs it from then on.

    Example: bampipe effects

    Example: bampipe effects stribeck:yaw

    Example: bampipe effects check snag.toml --device rail.toml

    Example: bampipe effects adopt runs/2026-10-03_s01/models/base/drafts/snag_by_position.toml
    """
    from bampipe.cli.device import check_effect_file
    from bampipe.cli.effects import list_all, show_one

    if name in ("check", "adopt") and file is None:
        raise InputError("which effect file?", remedy=f"bampipe effects {name} FILE")
    if name == "check":
        check_effect_file(str(file), device, json)
    elif name == "adopt":
        from bampipe.api.loop import adopt_effect

        copy = adopt_effect(Path(str(file)), runs)
        if json:
            show.print_json({"file": str(copy)})
        else:
            show.say(f"{copy}: every run in {runs} weighs it from its next diagnosis on")
    elif file is not None:
        raise InputError(f"{file!r} is one argument too many", remedy="bampipe effects NAME")
    elif name is None:
        list_all(json)
    else:
        show_one(name, device, json)


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
    "init": init,
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
    "simulate": simulate,
    "demo": loop.demo,
    "lab": lab,
    "accept": accept,
    "export": export,
    "fetch": fetch,
    "monitor": monitor,
    "status": checks.status_,
    "verify": checks.verify_,
    "version": version,
}
for _name, _command in COMMANDS.items():
    app.command(_name, short_help=device.summary_of(_command))(_command)
app.add_typer(device.app, name="device", short_help=device.SUMMARY)
