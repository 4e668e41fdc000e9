"""`bampipe fetch`: published runs back into a folder of runs."""

from typing import Annotated

import typer

from bampipe.cli import show
from bampipe.cli.options import RUNS, QuietOption, RunsOption
from bampipe.errors import InputError, choose_from


def fetch(
    url: Annotated[str, typer.Argument(metavar="URL", help="Place of published runs.")],
    sessions: Annotated[
        list[str] | None,
        typer.Argument(metavar="[SESSION...]", help="Sessions to fetch; all if omitted."),
    ] = None,
    runs: RunsOption = RUNS,
    force: Annotated[bool, typer.Option("--force", help="Replace runs that differ.")] = False,
    quiet: QuietOption = False,
) -> None:
    """Fetch runs that `bampipe run --publish URL` published, every file checked.

    Example: bampipe fetch s3://lab/runs

    Example: bampipe fetch file:///mnt/lab/runs 2026-10-03_s01
    """
    from bampipe.run import publish

    known = publish.published(url)
    if not known:
        raise InputError("nothing is published here", where=url)
    for session in sessions or known:
        if session not in known:
            raise InputError(
                f"no session {session!r} is published",
                where=url,
                remedy=choose_from(session, known),
            )
        show.say(str(publish.fetch(url, session, runs, force)))
    show.print_advice(f"bampipe lab {runs}", quiet)
