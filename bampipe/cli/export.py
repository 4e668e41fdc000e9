"""`bampipe export`: an identified model for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from bampipe.cli import places, show
from bampipe.cli.options import RUNS, BestModelOption, RunArgument, RunsOption
from bampipe.errors import InputError, did_you_mean, located


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
    from bampipe.data.run_folder import RunFolder
    from bampipe.declarations import mcap_file, rerun_file
    from bampipe.declarations.export import FORMS, export_model
    from bampipe.declarations.recording import gather_recording
    from bampipe.files import atomic_writer, write_text
    from bampipe.run import models

    recordings = {"mcap": mcap_file.pack_recording, "rrd": rerun_file.pack_recording}
    if pack := recordings.get(form):
        root = places.find_run(run, runs)
        path = out or Path(f"{root.name}.{form}")
        recording = gather_recording(RunFolder(root))
        with located(f"--as {form}"):
            packed = pack(recording)
        with atomic_writer(path) as stream:
            stream.write(packed)
        show.say(f"{path}: {root.name}, {len(packed) / 1e6:.1f} MB")
        return
    chosen = next((known for known in FORMS if known == form), None)
    if chosen is None:
        every = (*FORMS, *recordings)
        what = f"unknown form {form!r}{did_you_mean(form, every)}"
        raise InputError(what, remedy=f"--as {', '.join(every)}")
    root = places.find_run(run, runs)
    counting = models.choose_model(root, model)
    text = export_model(RunFolder(root), counting, chosen)
    if out is None:
        show.say(text.rstrip())
        show.note(f"model {counting} of {root.name}")
        return
    write_text(out, text)
    show.say(f"{out}: model {counting} of {root.name}")
