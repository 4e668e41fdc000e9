"""Commands on finished runs: their state, reference values, exports and published copies."""

from pathlib import Path
from typing import Annotated

import typer

from bampipe.cli import places, show
from bampipe.cli.options import (
    RUNS,
    BestModelOption,
    JsonOption,
    QuietOption,
    RunArgument,
    RunsOption,
)
from bampipe.data.run_folder import RunFolder
from bampipe.errors import InputError, did_you_mean, located


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
    from bampipe.run.status import verify

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


def export(
    run: RunArgument = None,
    form: Annotated[
        str, typer.Option("--as", help="json, urdf, mjcf, python, c, mcap or rrd.")
    ] = "json",
    model: BestModelOption = "",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="File to write; printed if omitted.")
    ] = None,
    runs: RunsOption = RUNS,
) -> None:
    """Write an identified model for other programs.

    json: the device and its effects, every parameter with its uncertainty. urdf: the robot's own
    URDF, bodies and friction as identified. mjcf: the same with its drives and effects, for MuJoCo.
    python, c: one self-contained function of inverse dynamics.

    mcap, rrd: a recording for Foxglove or Rerun, of all models: torques measured and predicted,
    residuals, worst windows and verdicts as markers, a robot's pose by its drawing.

    Example: bampipe export 2026-10-03_s01 --as c --out inverse_dynamics.c

    Example: bampipe export 2026-10-03_s01 --as mcap --out s01.mcap
    """
    from bampipe.declarations import mcap_file, rerun_file
    from bampipe.declarations.export import FORMS, export_model
    from bampipe.declarations.recording import gather_recording
    from bampipe.files import atomic_writer, write_text
    from bampipe.run import models

    recordings = {"mcap": mcap_file.pack_recording, "rrd": rerun_file.pack_recording}
    if form not in (every := (*FORMS, *recordings)):
        what = f"unknown form {form!r}{did_you_mean(form, every)}"
        raise InputError(what, remedy=f"--as {', '.join(every)}")
    root = places.find_run(run, runs)
    if pack := recordings.get(form):
        path = out or Path(f"{root.name}.{form}")
        recording = gather_recording(RunFolder(root))
        with located(f"--as {form}"):
            packed = pack(recording)
        with atomic_writer(path) as stream:
            stream.write(packed)
        show.say(f"{path}: {root.name}, {len(packed) / 1e6:.1f} MB")
        return
    chosen = next(known for known in FORMS if known == form)
    counting = models.choose_model(root, model)
    text = export_model(RunFolder(root), counting, chosen)
    if out is None:
        show.say(text.rstrip())
        show.note(f"model {counting} of {root.name}")
        return
    write_text(out, text)
    show.say(f"{out}: model {counting} of {root.name}")


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
        show.say(str(publish.fetch(url, session, runs, force)))
    show.print_advice(f"bampipe lab {runs}", quiet)
