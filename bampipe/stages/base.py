"""The contract of a stage, and the table of stages.

A stage is a module with

- ``SUMMARY``: one sentence on it;
- ``INPUTS`` and ``OUTPUTS``: paths relative to the run folder, in which ``{model}`` stands for the
  name of the model;
- ``Config``: a frozen dataclass, every field typed, with a default, described in the docstring;
- ``execute(run, out, config, progress)``: reads below ``run``, writes every output below
  ``out`` and returns a summary that JSON can hold.

A declared path is a file (``"ingest/trials.parquet"``), a file that may be absent
(``"stiffness/stiffness.json?"``, inputs only) or a glob pattern that stands for however many
files match it (``"models/*/validate.json"``, ``"report/figures/*.svg"``, ``"report/**/*"``).

A stage whose ``Config`` has a field ``model`` runs once for each model. The runner writes
``models/<model>/model.toml`` before the first such stage, so those stages only read it
(`declarations.model_file.MODEL_INPUTS`).
A field ``jobs`` of a ``Config`` says how many processes to use and must not change the result.
A stage whose ``Config`` has a field ``session`` reads that session folder, and the runner
hashes the session file and the files it names.

The runner creates the parents of all declared outputs below ``out`` beforehand and moves the
files into the run folder once ``execute`` has returned. No stage calls another.
"""

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

from bampipe.data.run_folder import RunFolder
from bampipe.errors import InputError, choose_from
from bampipe.progress import Progress


class Stage(Protocol):
    """The module of a stage (see the module docstring)."""

    SUMMARY: str
    INPUTS: tuple[str, ...]
    OUTPUTS: tuple[str, ...]
    Config: type[Any]

    def execute(
        self, run: RunFolder, out: Path, config: Any, progress: Progress
    ) -> dict[str, object]:
        """Do the work; return a summary that JSON can hold."""


@dataclass(frozen=True)
class StageEntry:
    """Data on a stage that need no import of its module.

    Attributes:
        name: of the module and of the command.
        per_model: whether ``Config`` has a field ``model``: it runs once for each model.
        reads_session: whether ``Config`` has a field ``session``.
        prints: whether it calls the report, whose changes then rerun it.
        after: the command that is suggested after it; "" if its own command says more.
    """

    name: str
    per_model: bool = False
    reads_session: bool = False
    prints: bool = False
    after: str = ""


ENTRIES = (
    StageEntry("ingest", reads_session=True, after="filter"),
    StageEntry("filter", after="stiffness"),
    StageEntry("stiffness", after="identify"),
    StageEntry("identify", per_model=True, after="validate"),
    StageEntry("viscous", per_model=True, after="report"),
    StageEntry("performance", per_model=True, after="report"),
    StageEntry("validate", per_model=True, after="diagnose"),
    StageEntry("diagnose", per_model=True),
    StageEntry("draft", per_model=True),
    StageEntry("next", per_model=True, prints=True),
    StageEntry("compare", after="report"),
    StageEntry("report", prints=True),
)
"""All stages, in the order in which they run."""

STAGES = tuple(entry.name for entry in ENTRIES)
READS_SESSION = tuple(entry.name for entry in ENTRIES if entry.reads_session)
PER_MODEL = tuple(entry.name for entry in ENTRIES if entry.per_model)
PRINTING = tuple(entry.name for entry in ENTRIES if entry.prints)
AFTER = {entry.name: entry.after for entry in ENTRIES}


def check_stage_name(name: str) -> str:
    """Return ``name``; raise InputError unless there is such a stage."""
    if name not in STAGES:
        raise InputError(f"no stage {name!r}", remedy=choose_from(name, STAGES))
    return name


def load_stage(name: str) -> Stage:
    """Import and return the stage ``name``; InputError if there is none."""
    return cast(Stage, importlib.import_module(f"bampipe.stages.{check_stage_name(name)}"))


def paths_of(model: str, declared: tuple[str, ...]) -> tuple[str, ...]:
    """Return the paths that a stage has ``declared``, for ``model``."""
    return tuple(path.replace("{model}", model) for path in declared)
