"""`bampipe lab`: all runs side by side."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bampipe.cli import show
from bampipe.cli.options import RUNS, JsonOption, QuietOption, RunsOption
from bampipe.errors import InputError

if TYPE_CHECKING:
    from bampipe.lab.collect import Lab

MOST_SESSIONS = 60


def lab(
    folder: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FOLDER]", help="Folder that holds the run folders; that of --runs if omitted."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder to write to; lab/ beside the runs if omitted.")
    ] = None,
    json: JsonOption = False,
    runs: RunsOption = RUNS,
    quiet: QuietOption = False,
) -> None:
    """Compare all sessions: one data set, control charts, and which session drifted and why.

    Collects what has been run, and runs nothing itself.

    Example: bampipe lab

    Example: bampipe lab /data/runs --out /data/lab
    """
    folder = folder or runs
    if not folder.is_dir():
        raise InputError("no such folder of runs", where=str(folder))
    found = gather(folder, out, quiet or json)
    if json:
        show.print_json(found.content.model_dump(mode="json"))
        return
    table(found)
    remedies = (one.remedy for one in found.content.sessions if one.remedy)
    show.print_advice(next(remedies, f"open {found.folder / 'report.html'}"), quiet)


def gather(runs: Path, out: Path | None = None, quiet: bool = False) -> "Lab":
    """Write the lab's folder for the runs in ``runs``."""
    from bampipe.lab.collect import collect
    from bampipe.lab.folders import lab_folder

    folder = out or lab_folder(runs)
    with show.Watcher(quiet) as watcher:
        return collect(runs, folder, progress=watcher.follow(str(folder), "lab"))


def refresh(runs: Path, several: bool, quiet: bool) -> None:
    """Bring the lab's folder up to date after a run, if there is one; ``several`` make one."""
    from bampipe.lab.folders import is_current, is_foreign, lab_folder, run_folders
    from bampipe.results.lab import LabResult

    folder = lab_folder(runs)
    wanted = several or (folder / LabResult.FILE).is_file()
    begun = any((root / "ingest" / "session.json").is_file() for root in run_folders(runs))
    if not wanted or not begun or is_current(runs, folder):
        return
    if is_foreign(folder):
        if not quiet:
            show.note(f"bampipe: {folder} holds other files; collect with `bampipe lab --out`")
        return
    found = gather(runs, None, quiet)
    if not quiet and several:
        show.say("")
        table(found)
        show.print_advice(f"open {found.folder / 'report.html'}, which links every session")


def table(found: "Lab") -> None:
    """Print the sessions, and the trends."""
    from bampipe.phrases import lab as phrases

    sessions = found.content.sessions
    odd = [one for one in sessions if one.verdict != "in control"]
    many = "session" if len(sessions) == 1 else "sessions"
    stand = "stands" if len(odd) == 1 else "stand"
    show.say(f"{found.folder}: {len(sessions)} {many}, {len(odd)} {stand} out")
    rows = []
    for one in sessions if len(sessions) <= MOST_SESSIONS else odd:
        when = one.recorded[:16].replace("T", " ")
        worst = f"{one.worst[0]:.3g} {one.worst[1]}" if one.worst else None
        verdict = phrases.verdict(found.content, one)
        rows.append([one.session, when, one.model, worst, verdict, one.sentence])
    if rows:
        show.print_table(["session", "recorded", "model", "error / floor", "verdict", ""], rows)
    for line in phrases.list_trends(found.content.series):
        show.say(line)
    fewest = found.content.fewest_sessions
    if found.content.series and not any(chart.has_limits for chart in found.content.series):
        show.say(f"no control limits yet: they need {fewest} sessions of a device")
    for line in found.skipped:
        show.say(f"left out: {line}")
