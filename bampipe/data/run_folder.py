"""Read access to the run folder of one session."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from bampipe.errors import InputError, MissingResultError
from bampipe.files import is_inside

if TYPE_CHECKING:
    from bampipe.results.record import Result

R = TypeVar("R", bound="Result")

BASE = "base"
"""Name of the model that all others extend."""
INGESTED = ("ingest/trials.parquet", "ingest/samples.parquet", "ingest/session.json")
FILTERED = ("filter/kinematics.parquet", "filter/filter.json")
"""Files that the stages ingest and filter leave for others."""
MOVING = ("free", "viscous")
"""Kinds of trial in which the arm moves; only with commanded brakes do effects of brakes show."""


@dataclass(frozen=True)
class RunFolder:
    """Read access to the run folder ``root`` of one session."""

    root: Path

    def path(self, relative: str) -> Path:
        """Return the path of ``relative``, a path relative to the run folder.

        Raises:
            InputError: it leads out of the run folder.
        """
        if not is_inside(self.root, relative):
            raise InputError(f"{relative!r} leads out of the run folder", where=str(self.root))
        return self.root / relative

    def exists(self, relative: str) -> bool:
        """Return whether the file ``relative`` is there."""
        return self.path(relative).is_file()

    def require(self, relative: str, stage: str) -> Path:
        """Return the path of ``relative``.

        Raises:
            MissingResultError: the file is not there yet; the remedy names ``stage``.
        """
        if not self.exists(relative):
            raise self.missing(relative, f"{stage} {'SESSION' if stage == 'ingest' else self.root}")
        return self.path(relative)

    def missing(self, relative: str, maker: str = "") -> MissingResultError:
        """Return the error that ``relative`` is not there yet; ``maker``: the command for it."""
        head, *rest = relative.split("/")
        # A command that names no model takes the best one.
        option = self.model_option(rest[0]) if head == "models" else ""
        remedy = f"run `bampipe {maker}{option}` first" if maker else ""
        return MissingResultError(f"{relative} is missing", where=str(self.root), remedy=remedy)

    def model_option(self, model: str) -> str:
        """Return `` --model`` with a model; "" if the run has no other."""
        return f" --model {model}" if {*self.models()} - {model} else ""

    def read(self, kind: type[R], model: str = "") -> R:
        """Return the result ``kind``, of ``model`` where it is one of a model.

        Raises:
            InputError: its stage has not run, or the file is not as bampipe writes it.
        """
        return kind.read(self.require(kind.file(model), kind.STAGE))

    def find(self, kind: type[R], model: str = "") -> R | None:
        """Return the result as `read` does; None if its stage has not run."""
        return self.read(kind, model) if self.exists(kind.file(model)) else None

    def models(self, file: str = "model.toml") -> tuple[str, ...]:
        """Return the models that have ``file``: parents before children, then by name."""
        found = (path.parent.name for path in self.root.glob(f"models/*/{file}"))
        return tuple(sorted(found, key=lambda name: (name != BASE, name.count("+"), name)))

    def default_model(self) -> str:
        """Return the best confirmed model, as the stage compare stores it, else the base model."""
        from bampipe.results.compare import CompareResult  # its schema is slow to import

        try:
            best = self.read(CompareResult).best
        except InputError:  # it is missing or damaged, and compare will make it again
            return BASE
        return best if best in self.models() else BASE

    def glob(self, pattern: str) -> tuple[str, ...]:
        """Return the files that match ``pattern``, relative to the run folder, sorted."""
        found = (path for path in self.root.glob(pattern) if path.is_file())
        return tuple(sorted(path.relative_to(self.root).as_posix() for path in found))
