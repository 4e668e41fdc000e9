"""The next command or action, from the results of a run; in a command, ``RUN`` stands for it."""

from pathlib import Path

from bampipe.cli import show
from bampipe.data.run_folder import RunFolder
from bampipe.phrases.forecast_outcome import compare_forecasts, read_forecasts
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.draft import DraftResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.next import NextResult
from bampipe.results.setup import SetupResult
from bampipe.results.validate import ValidateResult


def after_run(root: Path, model: str) -> str:
    """Return the next step after a run; ``model``: that counts."""
    run = RunFolder(root)
    setup, found = run.find(SetupResult), run.find(DiagnoseResult, model)
    if setup is not None and setup.mistakes:
        return "correct the session file as the first line says, and run it again"
    identified = run.find(IdentifyResult, model)
    fitted, diagnosed = ({*one.trials} if one else set() for one in (identified, found))
    if (diagnosed and fitted - diagnosed) or (found is None and _is_above_floor(run, model)):
        return f"bampipe diagnose RUN{run.model_option(model)}"
    if found is not None and found.lacking:
        return _after_diagnosis(run, model, found.next)
    if run.exists("report/report.pdf"):
        return f"open {root / 'report' / 'report.pdf'}"
    return "bampipe status RUN"


def _is_above_floor(run: RunFolder, model: str) -> bool:
    """Whether an axis is known to have an error above its noise floor."""
    validated = run.find(ValidateResult, model)
    axes = validated.axes.values() if validated is not None else ()
    return any(error.standing == "above_floor" for error in axes)


def after_loop(root: Path, model: str) -> str:
    """Return the next step after the loop ended with ``model``."""
    run = RunFolder(root)
    found = run.find(DiagnoseResult, model)
    if found is None:  # stopped after many rounds
        return f"bampipe diagnose RUN{run.model_option(model)}"
    # The loop has tried to add the selected effects: they do not improve the model.
    if found.selected or not found.lacking:
        return "bampipe report RUN --open"
    return _after_diagnosis(run, model, found.next)


def after_proposal(root: Path, model: str) -> str:
    """Return the next step after a trial has been proposed for ``model``.

    Effects that a diagnosis has found come first, unless a trial is to decide about them.
    """
    run = RunFolder(root)
    proposed = run.read(NextResult, model)
    if proposed.purpose != "decision":
        found = run.find(DiagnoseResult, model)
        if found is not None and found.selected and "bampipe next " not in found.next:
            return _after_diagnosis(run, model, found.next)
        if found is None and _is_above_floor(run, model):
            return f"bampipe diagnose RUN{run.model_option(model)}"
    if proposed.plan is not None and proposed.plan.is_enough and not proposed.plan.trials:
        return "bampipe report RUN"
    return "record that trial, add it to session.toml, and run the session again"


def _after_diagnosis(run: RunFolder, model: str, said: str) -> str:
    """Return the advice of a diagnosis, or that of the draft that it asked for."""
    draft = run.find(DraftResult, model) if said.startswith("bampipe draft ") else None
    return said if draft is None else draft.next


def print_forecasts(root: Path, model: str) -> None:
    """Print forecasts beside their outcome, if there are trials that the proposals did not have."""
    run, forecasts = RunFolder(root), read_forecasts(root, model)
    identified = run.find(IdentifyResult, model) if forecasts else None
    if identified is not None:
        diagnosed = run.find(DiagnoseResult, model)
        for line in compare_forecasts(forecasts, identified, diagnosed):
            show.say(f"forecast: {line.replace('RUN', root.name)}")
