"""The next command or action, from the results of a run."""

from __future__ import annotations

from pathlib import Path

from bampipe.data.run_folder import RunFolder


def after_run(root: Path, model: str, name: str) -> str:
    """Return the next step after a run.

    Args:
        root: the run folder; model: that counts; name: how to call the run in a command.
    """
    from bampipe.results.diagnose import DiagnoseResult
    from bampipe.results.setup import SetupResult

    run = RunFolder(root)
    if run.exists(SetupResult.FILE) and run.read(SetupResult).mistakes:
        return "correct the session file as the first line says, and run it again"
    if _has_new_trials(run, model):
        return f"bampipe diagnose {name}{run.model_option(model)}"
    if run.exists(DiagnoseResult.file(model)):
        found = run.read(DiagnoseResult, model)
        if found.lacking:
            return _after_diagnosis(run, model, found.next).replace("RUN", name)
    elif _is_above_floor(run, model):
        return f"bampipe diagnose {name}{run.model_option(model)}"
    if run.exists("report/report.pdf"):
        return f"open {root / 'report' / 'report.pdf'}"
    return f"bampipe status {name}"


def _has_new_trials(run: RunFolder, model: str) -> bool:
    """Whether the model is fitted to trials that the last diagnosis did not have."""
    from bampipe.results.diagnose import DiagnoseResult
    from bampipe.results.identify import IdentifyResult

    if not all(run.exists(kind.file(model)) for kind in (DiagnoseResult, IdentifyResult)):
        return False
    weighed = run.read(DiagnoseResult, model).trials
    return bool(weighed) and not set(run.read(IdentifyResult, model).trials) <= set(weighed)


def _is_above_floor(run: RunFolder, model: str) -> bool:
    """Whether an axis is known to have an error above its noise floor."""
    from bampipe.results.validate import ValidateResult

    if not run.exists(ValidateResult.file(model)):
        return False
    errors = run.read(ValidateResult, model).axes.values()
    return any(error.standing == "above_floor" for error in errors)


def after_loop(root: Path, model: str, name: str) -> str:
    """Return the next step after the loop ended with ``model``; arguments as for `after_run`."""
    from bampipe.results.diagnose import DiagnoseResult

    run = RunFolder(root)
    if not run.exists(DiagnoseResult.file(model)):  # stopped after many rounds
        return f"bampipe diagnose {name}{run.model_option(model)}"
    found = run.read(DiagnoseResult, model)
    # The loop has tried to add the selected effects: they do not improve the model.
    if found.selected or not found.lacking:
        return f"bampipe report {name} --open"
    return _after_diagnosis(run, model, found.next).replace("RUN", name)


def after_proposal(root: Path, model: str, name: str) -> str:
    """Return the next step after a trial has been proposed; arguments as for `after_run`.

    Effects that a diagnosis has found come first, unless the trial is to decide about them.
    """
    from bampipe.results.diagnose import DiagnoseResult
    from bampipe.results.next import NextResult

    run = RunFolder(root)
    decides = run.read(NextResult, model).purpose == "decision"
    if not decides and run.exists(DiagnoseResult.file(model)):
        found = run.read(DiagnoseResult, model)
        if found.selected:
            return _after_diagnosis(run, model, found.next).replace("RUN", name)
    elif not decides and _is_above_floor(run, model):
        return f"bampipe diagnose {name}{run.model_option(model)}"
    return "record that trial, add it to session.toml, and run the session again"


def _after_diagnosis(run: RunFolder, model: str, said: str) -> str:
    """Return the advice of a diagnosis, or that of the draft that it asked for."""
    from bampipe.results.draft import DraftResult

    if said.startswith("bampipe draft ") and run.exists(DraftResult.file(model)):
        return run.read(DraftResult, model).next
    return said
