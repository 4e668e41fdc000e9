"""What came of the trial that was proposed, after the session has been run with it."""

from __future__ import annotations

from pathlib import Path

from bampipe.cli import show
from bampipe.data.run_folder import RunFolder


def say_what_came(root: Path, model: str, is_diagnosed: bool) -> None:
    """Print the forecast beside what came, where trials are there that the proposal did not know.

    Args:
        root: the run folder; model: that counts.
        is_diagnosed: whether its diagnosis has been made with them.
    """
    from bampipe.results.diagnose import DiagnoseResult
    from bampipe.results.forecast import compare_forecast
    from bampipe.results.identify import IdentifyResult
    from bampipe.results.next import NextResult

    run = RunFolder(root)
    if not run.exists(NextResult.file(model)) or not run.exists(IdentifyResult.file(model)):
        return
    diagnosed = run.read(DiagnoseResult, model) if is_diagnosed else None
    proposed = run.read(NextResult, model)
    for line in compare_forecast(proposed, run.read(IdentifyResult, model), diagnosed):
        show.say(f"forecast: {line.replace('RUN', root.name)}")
