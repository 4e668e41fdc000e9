"""Commands that make a session: proposed for a folder of logs, or simulated."""

from pathlib import Path
from typing import Annotated

import typer

from bampipe.cli import show
from bampipe.cli.one_stage import parse_settings
from bampipe.cli.options import JsonOption, QuietOption


def init(
    folder: Annotated[Path, typer.Argument(help="Folder of logs, with its sub-folders.")],
    device: Annotated[
        str,
        typer.Option(help="A built-in device, or a device file in the folder; guessed if omitted."),
    ] = "",
    names: Annotated[
        str, typer.Option(help="Column names of text files without a header, such as t,q,tau_nm.")
    ] = "",
    episodes: Annotated[
        str,
        typer.Option(help="Episodes of a LeRobot data set to take as trials, such as 0:20 or 7."),
    ] = "",
    dry: Annotated[
        bool, typer.Option("--dry", help="Print the session file instead of writing it.")
    ] = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Propose a session.toml for a folder of logs, every guess marked; nothing is overwritten.

    Example: bampipe init logs/2026-10-03

    Example: bampipe init logs/2026-10-03 --device slider --dry

    Example: bampipe init logs/2026-10-03 --names time_s,angle_deg,current_mA

    Example: bampipe init datasets/so101_pick --episodes 0:20
    """
    from bampipe.setup.proposal import propose, write_proposal

    columns = [name for name in names.split(",") if name.strip()]
    proposal = propose(folder, device, columns, episodes)
    written = [] if dry else write_proposal(folder, proposal)
    if json:
        kept = ("session", "device", "fill_in", "check")
        content = {name: getattr(proposal, name) for name in kept}
        files = [str(path) for path in written]
        show.print_json({**content, "written": files, "left_out": proposal.passed})
        return
    if dry:
        show.say("\n\n".join(filter(None, (proposal.session.rstrip(), proposal.device.rstrip()))))
    for path in written:
        show.say(f"wrote {path}")
    if quiet:
        return
    for title, lines in (
        ("fill in these entries, or the session is refused:", proposal.fill_in),
        ("check, these are guesses:", proposal.check),
        ("left out:", proposal.passed),
    ):
        if lines:
            show.say("\n  ".join((f"\n{title}", *lines)))
    after = f"bampipe run {folder}" if not proposal.fill_in else f"edit {folder}/session.toml"
    show.print_advice(after)


def simulate(
    out: Annotated[Path, typer.Argument(help="Folder of the session to make.")],
    effect: Annotated[
        list[str] | None,
        typer.Option("--effect", help="Effect to hide, name[:target][=strength]; may be repeated."),
    ] = None,
    strength: Annotated[float, typer.Option(help="Strength of effects that state none.")] = 1.0,
    seed: Annotated[int, typer.Option(help="Seed of every random draw.")] = 0,
    device: Annotated[str, typer.Option(help="A built-in device.")] = "bam",
    effect_file: Annotated[
        list[str] | None, typer.Option("--effect-file", help="An effect file; may be repeated.")
    ] = None,
    trials: Annotated[int, typer.Option(help="Number of free trials.")] = 5,
    viscous_trials: Annotated[int, typer.Option(help="Number of viscous-field trials.")] = 0,
    locked_trials: Annotated[
        bool, typer.Option("--locked-trials", help="Also lock and load each axis.")
    ] = False,
    duration: Annotated[float, typer.Option(help="Of a trial, s.")] = 16.0,
    sample_rate: Annotated[float, typer.Option(help="Hz.")] = 500.0,
    file_format: Annotated[str, typer.Option(help="csv or parquet.")] = "csv",
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="NAME=VALUE", help="A parameter of the plant; may be repeated."
        ),
    ] = None,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Simulate a session with known effects hidden in it.

    The truth goes into a file beside the session folder.

    Example: bampipe simulate sessions/trial --effect stribeck:yaw --seed 1
    """
    from bampipe.run import batch

    batch.limit_threads(1)
    from bampipe.simulator.simulated_session import Config, simulate_session

    given = {
        "effects": effect or (),
        "strength": strength,
        "seed": seed,
        "device": device,
        "effect_files": effect_file or (),
        "trials": trials,
        "viscous_trials": viscous_trials,
        "locked_trials": locked_trials,
        "duration": duration,
        "sample_rate": sample_rate,
        "parameters": parse_settings(settings),
        "file_format": file_format,
    }
    config = Config.read(given)
    with show.Watcher(quiet or json) as watcher:
        content = simulate_session(out, config, watcher.follow(out.name, "simulate"))
    if json:
        show.print_json(content)
        return
    show.print_summary(content)
    show.print_advice(f"bampipe run {out}", quiet, json)
