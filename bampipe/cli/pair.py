"""`bampipe compare A B`: two sessions of one device on the terminal, as JSON, and as a page."""

from __future__ import annotations

from pathlib import Path

from bampipe.cli import show
from bampipe.cli.options import StageOptions


def compare_pair(
    first: Path, second: Path, model: str, out: Path | None, options: StageOptions
) -> None:
    """Print what changed from one session to another; write the page where one is asked for."""
    from bampipe.api.pair import compare_runs
    from bampipe.files import write_text
    from bampipe.report.pair import build_page, tabulate_pair

    name = f"{first.name}, {second.name}"
    with show.Watcher(options.quiet or options.json) as watcher:
        pair = compare_runs(first, second, model, watcher.follow(name, "compare"))
    if out is not None:
        write_text(out, build_page(pair))
    if options.json:
        show.print_json(pair.model_dump(mode="json"))
        return
    for line in (*pair.sentences, *pair.notes):
        show.say(line)
    for table in tabulate_pair(pair):
        show.print_block(table)
    advice = f"open {out}" if out is not None else f"bampipe compare {first} {second} --out FILE"
    show.print_advice(advice, options.quiet)
