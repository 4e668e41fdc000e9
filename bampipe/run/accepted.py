"""Accepted values of a device: the reference for later sessions.

They lie in ``accepted/<device>.json`` beside the runs, one small file to keep under version
control. `bampipe accept RUN` writes it; gates with ``against = "accepted"`` read it.
"""

from pathlib import Path
from urllib.parse import quote

from bampipe.data.run_folder import RunFolder
from bampipe.declarations.accepted import Accepted
from bampipe.errors import InputError
from bampipe.files import read_json, write_json
from bampipe.phrases.results import STANDINGS
from bampipe.results.identify import IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.stiffness import StiffnessResult
from bampipe.results.validate import ValidateResult
from bampipe.run import record
from bampipe.schema import read as check

ACCEPTED = "accepted"
"""Name of the folder, and value of a gate's ``against``."""


def accepted_folder(runs: Path) -> Path:
    """Return the folder of accepted values for a folder of runs."""
    return runs.parent / ACCEPTED


def file_of(folder: Path, device: str) -> Path:
    """Return the file of ``device``."""
    return folder / f"{quote(device, safe='')}.json"


def read(folder: Path, device: str) -> Accepted | None:
    """Return the values accepted for ``device``; None if there are none."""
    path = file_of(folder, device)
    if not path.is_file():
        return None
    try:
        return check(Accepted, read_json(path), str(path))
    except InputError as error:
        error.remedy = error.remedy or "restore it, or accept anew"
        raise


def accept(root: Path, model: str, folder: Path, force: bool = False) -> Path:
    """Store the values of ``model`` in the run ``root`` as the reference for later sessions.

    With ``force``, they are accepted even if a gate failed. Returns the file written.

    Raises:
        InputError: the model is not identified, a gate failed, or a result was changed by hand.
    """
    run = RunFolder(root)
    names = (IdentifyResult.file(model), StiffnessResult.FILE, IngestResult.FILE)
    record.require_untouched(root, names)
    run.require(IdentifyResult.file(model), IdentifyResult.STAGE)
    failed = [
        gate.gate
        for gate in record.read(root).gates
        if gate.state == "failed" and gate.model in ("", model)
    ]
    if failed and not force:
        raise InputError(
            f"the gate {failed[0]!r} failed in this run",
            where=str(root),
            remedy="accept it all the same with --force",
        )
    session = run.read(IngestResult)
    shown: set[str] = {"estimate", "sd", "unit"}
    estimates = run.read(IdentifyResult, model).parameters
    kept = {name: found.model_dump(include=shown) for name, found in estimates.items()}
    results = {IdentifyResult.FILE: {"parameters": kept}}
    if stiffness := run.find(StiffnessResult):
        shown = {"stiffness", "sd", "unit"}
        kept = {axis: one.model_dump(include=shown) for axis, one in stiffness.axes.items()}
        results[StiffnessResult.FILE] = {"axes": kept}
    path = file_of(folder, session.device)
    content = Accepted(
        device=session.device,
        session=root.name,
        recorded_at=session.recorded_at,
        model=model,
        results=results,
    )
    write_json(path, content.model_dump(by_alias=True))
    return path


def doubts(run: RunFolder, model: str) -> list[str]:
    """Return reasons, one line each, not to use ``model`` as the reference for later sessions."""
    found = run.find(ValidateResult, model)
    if found is None:
        return [f"model {model} has not been validated: `bampipe validate {run.root}`"]
    lines = list(found.failed_checks)
    for axis, error in found.axes.items():
        if error.standing == "above_floor" and error.noise_floor:
            ratio = error.held_out_rmse / error.noise_floor
            words = STANDINGS[error.standing]
            lines.append(f"{axis}: the error is {words}, {ratio:.2g} times: something is missing")
    return lines
