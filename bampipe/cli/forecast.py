"""Forecasts of proposed trials compared with their outcome."""

from __future__ import annotations

from pathlib import Path

from bampipe.cli import show
from bampipe.data.run_folder import RunFolder


def print_forecasts(root: Path, model: str) -> None:
    """Print forecasts beside their outcome, if there are trials that the proposals did not have.

    Args:
        root: the run folder; model: of the proposals.
    """
    from bampipe.phrases.forecast import compare_forecasts, read_forecasts
    from bampipe.results.diagnose import DiagnoseResult
    from bampipe.results.identify import IdentifyResult

    run = RunFolder(root)
    forecasts = read_forecasts(root, model)
    if not forecasts or not run.exists(IdentifyResult.file(model)):
        return
    is_diagnosed = run.exists(DiagnoseResult.file(model))
    diagnosed = run.read(DiagnoseResult, model) if is_diagnosed else None
    for line in compare_forecasts(forecasts, run.read(IdentifyResult, model), diagnosed):
        show.say(f"forecast: {line.replace('RUN', root.name)}")
