"""What a stage is, what it may read, and which stages there are.

A stage is a module with

- ``NAME`` and ``SUMMARY``: its command and one sentence on it;
- ``Config``: a frozen dataclass, every field typed, with a default, described in the docstring;
- ``inputs(config)`` and ``outputs(config)``: tuples of paths relative to the run folder;
- ``execute(run, out, config, progress)``: reads below ``run``, writes every output below
  ``out`` and returns a summary that JSON can hold.

A declared path is a file (``"ingest/trials.parquet"``), a file that may be absent
(``"stiffness/stiffness.json?"``, inputs only) or a glob pattern that stands for however many
files match it (``"models/*/validate.json"``, ``"report/figures/*.svg"``, ``"report/**/*"``).

A stage whose ``Config`` has a field ``model`` runs once for each model. The runner writes
``models/<model>/model.toml`` before the first such stage, so those stages only read it
(declare ``models/<model>/model.toml`` and ``models/<model>/effects/*.toml`` as inputs).
A field ``jobs`` of a ``Config`` says how many processes to use and must not change the result.
A stage whose ``Config`` has a field ``session`` reads that session folder, and the runner
hashes the session file and the files it names.

The runner creates the parents of all declared outputs below ``out`` beforehand and moves the
files into the run folder once ``execute`` has returned. No stage calls another.
"""

from __future__ import annotations

import difflib
import importlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

from bampipe.errors import InputError


class Progress(Protocol):
    """Called by a stage to say how far it is."""

    def __call__(self, fraction: float, message: str) -> None:
        """Report that ``fraction`` (0 to 1) is done; ``message`` says what is under way."""


def silent(fraction: float, message: str) -> None:
    """A :class:`Progress` that shows nothing."""


@dataclass(frozen=True)
class RunFolder:
    """Read access to the run folder of one session.

    Attributes:
        root: the run folder.
    """

    root: Path

    def path(self, relative: str) -> Path:
        """Return the path of ``relative``, a path relative to the run folder."""
        return self.root / relative

    def exists(self, relative: str) -> bool:
        """Return whether the file ``relative`` is there."""
        return self.path(relative).is_file()

    def require(self, relative: str, stage: str) -> Path:
        """Return the path of ``relative``.

        Raises:
            InputError: the file is not there yet; the remedy names ``stage``.
        """
        if not self.exists(relative):
            raise InputError(
                f"{relative} is missing",
                where=str(self.root),
                remedy=f"run `bampipe {stage} {self.root}` first",
            )
        return self.path(relative)

    def read_json(self, relative: str) -> dict[str, Any]:
        """Return the contents of the JSON file ``relative``.

        Raises:
            InputError: the file is missing or is not JSON.
        """
        path = self.path(relative)
        try:
            return cast(dict[str, Any], json.loads(path.read_text(encoding="utf-8")))
        except FileNotFoundError as error:
            raise InputError(f"{relative} is missing", where=str(self.root)) from error
        except (json.JSONDecodeError, UnicodeDecodeError) as error:
            raise InputError(
                f"not readable as JSON ({error})", where=str(path), remedy="run with --force"
            ) from error

    def glob(self, pattern: str) -> tuple[str, ...]:
        """Return the files that match ``pattern``, relative to the run folder, sorted."""
        found = (path for path in self.root.glob(pattern) if path.is_file())
        return tuple(sorted(path.relative_to(self.root).as_posix() for path in found))


def write_json(path: Path, content: Mapping[str, object]) -> None:
    """Write ``content`` as JSON with sorted keys: the same content gives the same bytes.

    Raises:
        ValueError: a number is not finite (JSON has none; store None and say why).
    """
    text = json.dumps(content, sort_keys=True, indent=1, ensure_ascii=False, allow_nan=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text + "\n", encoding="utf-8")


MOVING = ("free", "viscous")
"""Kinds of trial in which the arm moves; only with commanded brakes do effects of brakes show."""


class Stage(Protocol):
    """The module of a stage (see the module docstring)."""

    NAME: str
    SUMMARY: str
    Config: type[Any]

    def inputs(self, config: Any) -> tuple[str, ...]:
        """Return the paths the stage reads."""

    def outputs(self, config: Any) -> tuple[str, ...]:
        """Return the paths the stage writes."""

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
)
"""Stages whose ``Config`` has a field ``model``: they run once for each model."""


def check_name(name: str) -> None:
    """Raise InputError unless there is a stage ``name``."""
    if name in STAGES:
        return
    near = difflib.get_close_matches(name, STAGES, n=1, cutoff=0.55)
    choices = f"did you mean {near[0]!r}?" if near else f"choose from {', '.join(STAGES)}"
    raise InputError(f"no stage {name!r}", remedy=choices)


def load(name: str) -> Stage:
    """Import and return the stage ``name``.

    Raises:
        InputError: there is no such stage.
    """
    check_name(name)
    return cast(Stage, importlib.import_module(f"bampipe.stages.{name}"))
