"""`bampipe lab`: all runs side by side."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bampipe.cli import show
from bampipe.cli.options import RUNS, JsonOption, QuietOption, RunsOption
from bampipe.errors import InputError

if TYPE_CHECKING:
    from bampipe.results.lab import LabResult, TrendsResult

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
    from bampipe.lab.folders import lab_folder

    folder = folder or runs
    if not folder.is_dir():
        raise InputError("no such folder of runs", where=str(folder))
    out = out or lab_folder(folder)
    trends, about = gather(folder, out, quiet or json)
    if json:
        show.print_json(trends.model_dump(mode="json"))
        return
    table(out, trends, about)
    remedies = (one.remedy for one in trends.sessions if one.remedy)
    show.print_advice(next(remedies, f"open {out / 'report.html'}"), quiet)


def gather(runs: Path, folder: Path, quiet: bool) -> "tuple[TrendsResult, LabResult]":
    """Write the lab's ``folder`` for the runs in ``runs``."""
    from bampipe.lab.collect import collect

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
    trends, about = gather(runs, folder, quiet)
    if not quiet and several:
        show.say("")
        table(folder, trends, about)
        show.print_advice(f"open {folder / 'report.html'}, which links every session")


def table(folder: Path, trends: "TrendsResult", about: "LabResult") -> None:
    """Print the sessions, and the trends."""
    from bampipe.phrases import lab as phrases

    sessions = trends.sessions
    odd = [one for one in sessions if one.verdict != "in control"]
    many = "session" if len(sessions) == 1 else "sessions"
    stand = "stands" if len(odd) == 1 else "stand"
    show.say(f"{folder}: {len(sessions)} {many}, {len(odd)} {stand} out")
    rows = []
    for one in sessions if len(sessions) <= MOST_SESSIONS else odd:
        when = one.recorded[:16].replace("T", " ")
        worst = f"{one.worst[0]:.3g} {one.worst[1]}" if one.worst else None
        verdict = phrases.verdict(trends, one)
        rows.append([one.session, when, one.model, worst, verdict, one.sentence])
    if rows:
        show.print_table(["session", "recorded", "model", "error / floor", "verdict", ""], rows)
    for line in phrases.list_trends(trends.series):
        show.say(line)
    if trends.series and not any(chart.has_limits for chart in trends.series):
        fewest = trends.fewest_sessions
        show.say(f"no control limits yet: they need {fewest} sessions of a device")
    for line in about.skipped:
        show.say(f"left out: {line}")
