"""``bampipe status`` and ``bampipe verify``: the state of steps, and files that were changed."""

import typer

from bampipe.cli import places, show
from bampipe.cli.options import RUNS, JsonOption, RunArgument, RunsOption


def status_(run: RunArgument = None, runs: RunsOption = RUNS, json: JsonOption = False) -> None:
    """Show which stages of a run are current, stale or failed.

    Example: bampipe status 2026-10-03_s01
    """
    from bampipe.run import pipeline as pipelines
    from bampipe.run.status import status

    root = places.find_run(run, runs)
    found = status(root, pipelines.recorded(root))
    if json:
        show.print_json({"run": str(root), "steps": [vars(step) for step in found]})
        return
    show.say(str(root))
    show.print_table(
        ["step", "state", "last run", "seconds", ""],
        [[s.step, s.state, s.started_at, s.seconds, s.reason] for s in found],
    )


def verify_(run: RunArgument = None, runs: RunsOption = RUNS, json: JsonOption = False) -> None:
    """Recompute every recorded hash and name the files changed since; exit code 1 if any was.

    Example: bampipe verify 2026-10-03_s01
    """
    from bampipe.run.verify import verify

    root = places.find_run(run, runs)
    found = verify(root)
    if json:
        show.print_json({"run": str(root), "touched": dict(found)})
    elif found:
        show.say(f"{root}: {len(found)} files are not as they were recorded")
        show.print_table(["file", "state"], found)
    else:
        show.say(f"{root}: every file is as it was recorded")
    if found:
        raise typer.Exit(1)
