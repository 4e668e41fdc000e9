"""The values of a device that a lab has accepted: what later sessions are held against.

They stand in ``accepted/<device>.json`` beside the runs, one small file to keep under version
control. `bampipe accept RUN` writes it; gates with ``against = "accepted"`` read it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from bampipe.data.run_folder import RunFolder
from bampipe.errors import InputError
from bampipe.files import read_json, write_json
from bampipe.run import record

if TYPE_CHECKING:
    from bampipe.declarations.accepted import Accepted

SCHEMA = "bampipe.accepted/1"
ACCEPTED = "accepted"
"""Name of the folder, and what a gate's ``against`` says."""

KEPT = ("estimate", "stiffness", "sd", "unit")
RESULTS = {"models/{model}/identify.json": "parameters", "stiffness/stiffness.json": "axes"}
"""Files whose values are accepted, and the table of each that is kept."""


def beside(runs: Path) -> Path:
    """Return the folder of accepted values for a folder of runs."""
    return runs.parent / ACCEPTED


def file_of(folder: Path, device: str) -> Path:
    """Return the file of ``device``."""
    return folder / f"{quote(device, safe='')}.json"


def read(folder: Path, device: str) -> Accepted | None:
    """Return what was accepted for ``device``; None where nothing was.

    Raises:
        InputError: the file is damaged.
    """
    path = file_of(folder, device)
    if not path.is_file():
        return None
    from bampipe.declarations.accepted import Accepted
    from bampipe.schema import read as check

    try:
        return check(Accepted, read_json(path), str(path))
    except InputError as error:
        remedy = error.remedy or "restore it, or accept anew"
        raise InputError(error.what, where=error.where, remedy=remedy) from error


def accept(root: Path, model: str, folder: Path, force: bool = False) -> Path:
    """Keep the values of ``model`` in the run ``root`` as those to hold later sessions against.

    Args:
        root: the run folder.
        model: name of the model.
        folder: the folder of accepted values.
        force: even if a gate failed.

    Returns:
        The file written.

    Raises:
        InputError: the model is not identified, a gate failed, or a result was changed by hand.
    """
    run = RunFolder(root)
    names = [name.replace("{model}", model) for name in RESULTS]
    record.require_untouched(root, [*names, "ingest/session.json"])
    run.require(f"models/{model}/identify.json", "identify")
    failed = [gate["gate"] for gate in record.read(root).get("gates", ()) if _failed(gate)]
    if failed and not force:
        raise InputError(
            f"the gate {failed[0]!r} failed in this run",
            where=str(root),
            remedy="accept it all the same with --force",
        )
    results = {}
    for name, table in RESULTS.items():
        if not run.exists(name.replace("{model}", model)):
            continue
        content = run.read_json(name.replace("{model}", model)).get(table, {})
        results[name] = {
            table: {
                key: {field: entry[field] for field in KEPT if field in entry}
                for key, entry in content.items()
            }
        }
    session = run.read_json("ingest/session.json")
    path = file_of(folder, str(session["device"]))
    draft = path.with_name(f".{path.name}.part")
    write_json(
        draft,
        {
            "schema": SCHEMA,
            "device": session["device"],
            "session": root.name,
            "recorded_at": session.get("recorded_at"),
            "model": model,
            "results": results,
        },
    )
    draft.replace(path)
    return path


def _failed(gate: Mapping[str, object]) -> bool:
    return gate.get("state") == "failed"
