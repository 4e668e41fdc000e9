"""What a stage is, what it may read, and which stages there are.

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

from __future__ import annotations

import importlib
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


STAGES: tuple[str, ...] = (
    "ingest",
    "filter",
    "stiffness",
    "identify",
    "viscous",
    "performance",
    "validate",
    "diagnose",
    "draft",
    "next",
    "compare",
    "report",
)
"""All stages, in the order in which they run."""

READS_SESSION: tuple[str, ...] = ("ingest",)
"""Stages whose ``Config`` has a field ``session``."""

PER_MODEL: tuple[str, ...] = (
    "identify",
    "viscous",
    "performance",
    "validate",
    "diagnose",
    "draft",
    "next",
)
"""Stages whose ``Config`` has a field ``model``: they run once for each model."""


def check_stage_name(name: str) -> None:
    """Raise InputError unless there is a stage ``name``."""
    if name in STAGES:
        return
    raise InputError(f"no stage {name!r}", remedy=choose_from(name, STAGES))


def load_stage(name: str) -> Stage:
    """Import and return the stage ``name``.

    Raises:
        InputError: there is no such stage.
    """
    check_stage_name(name)
    return cast(Stage, importlib.import_module(f"bampipe.stages.{name}"))


def paths_of(model: str, declared: tuple[str, ...]) -> tuple[str, ...]:
    """Return the paths that a stage has ``declared``, for ``model``."""
    return tuple(path.replace("{model}", model) for path in declared)
