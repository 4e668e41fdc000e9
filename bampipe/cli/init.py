"""``bampipe init``: a session file proposed for a folder of logs."""

from pathlib import Path
from typing import Annotated

import typer

from bampipe.cli import show
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

    proposal = propose(
        folder, device, [name for name in names.split(",") if name.strip()], episodes
    )
    written = [] if dry else write_proposal(folder, proposal)
    if json:
        names_kept = ("session", "device", "fill_in", "check")
        content = {name: getattr(proposal, name) for name in names_kept}
        written_names = [str(path) for path in written]
        show.print_json({**content, "written": written_names, "left_out": proposal.passed})
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
