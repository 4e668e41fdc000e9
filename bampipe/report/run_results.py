"""Read access to the results in a run folder, each file read at most once."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar, cast

import pandas as pd

from bampipe.data.run_folder import RunFolder
from bampipe.data.store import column_names, read_parquet, trial_ids
from bampipe.declarations.model import read_model_file
from bampipe.errors import MissingResultError
from bampipe.files import read_toml
from bampipe.lists import join_names
from bampipe.results.compare import CompareResult, Rung
from bampipe.results.ingest import IngestResult
from bampipe.results.record import Result
from bampipe.results.run import RunResult

R = TypeVar("R", bound=Result)
T = TypeVar("T")


@dataclass
class Results:
    """The results of one session; ``detail_model`` is shown in detail, "" for the best one.

    Raises:
        InputError: from every method that reads, if a required file is missing or damaged.
    """

    root: Path
    detail_model: str = ""
    _results: dict[str, Result | None] = field(default_factory=dict, repr=False)

    def read(self, kind: type[R], model: str = "") -> R | None:
        """Return the result ``kind`` of ``model`` (default: the one in detail), or None."""
        name = model or (self.model if "{model}" in kind.FILE else "")
        relative = kind.file(name)
        if relative not in self._results:
            self._results[relative] = RunFolder(self.root).find(kind, name)
        return cast("R | None", self._results[relative])

    def table(
        self, relative: str, columns: Sequence[str] | None = None, trial: str | None = None
    ) -> pd.DataFrame | None:
        """Return a Parquet file, or the rows of one trial; None without such a file or trial."""
        path = self.root / relative
        if not path.is_file() or (trial is not None and trial not in trial_ids(path)):
            return None
        return read_parquet(path, columns, trial)

    def columns(self, relative: str) -> tuple[str, ...]:
        """Return the names of the columns of a Parquet file; none where there is no file."""
        path = self.root / relative
        return column_names(path) if path.is_file() else ()

    @cached_property
    def outdated(self) -> tuple[str, ...]:
        """Steps whose inputs were remade after they ran, according to ``run.json``, sorted."""
        run = self.read(RunResult)
        stages = run.stages if run else {}
        makers = {name: step for step, made in stages.items() for name in made.outputs}
        # TOML inputs are hashed by content, outputs by bytes: they cannot be compared.
        found = {
            step
            for step, made in stages.items()
            for name, digest in made.inputs.items()
            if name in makers and not name.endswith(".toml")
            if stages[makers[name]].outputs[name] != digest
        }
        for _ in stages:  # no chain of steps is longer
            inputs = {name for name, step in makers.items() if step in found}
            found |= {step for step, made in stages.items() if inputs & made.inputs.keys()}
        return tuple(sorted(found - {"report"}))

    @cached_property
    def session(self) -> IngestResult:
        """The result of ingest."""
        return RunFolder(self.root).read(IngestResult)

    @cached_property
    def trials(self) -> pd.DataFrame:
        """One row per trial."""
        return read_parquet(RunFolder(self.root).require("ingest/trials.parquet", "ingest"))

    @cached_property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes, in the order of the recorded channels (JSON sorts them)."""
        found = list(self.session.axes)
        channels = self.columns("ingest/samples.parquet")
        order = [name.removeprefix("q_") for name in channels if name.startswith("q_")]
        return tuple(sorted(found, key=lambda axis: (order + found).index(axis)))

    def unit(self, axis: str) -> str:
        """Return the unit of the position of ``axis``."""
        return self.session.axes[axis].unit

    def force_unit(self, axis: str) -> str:
        """Return the unit of the generalised force of ``axis``."""
        return "N.m" if self.is_rotary(axis) else "N"

    @property
    def pusher(self) -> str:
        """The source of the measured force: ``hand``, ``motor``, or else ``input``."""
        if self.session.driven:
            return "motor"
        return "hand" if self.session.brakes else "input"

    def is_rotary(self, axis: str) -> bool:
        """Return whether ``axis`` turns."""
        return self.unit(axis) == "rad"

    def name_force(self, axis: str) -> str:
        """Return ``torque`` for an axis that turns, else ``force``."""
        return "torque" if self.is_rotary(axis) else "force"

    @cached_property
    def ladder(self) -> tuple[Rung, ...]:
        """The compared model versions, parents before children; none before they are compared."""
        compared = self.read(CompareResult)
        return compared.ladder if compared else ()

    @cached_property
    def models(self) -> tuple[str, ...]:
        """The models: in the order of the ladder, then all others, parents before children."""
        found = RunFolder(self.root).models("identify.json")
        ranked = [rung.model for rung in self.ladder if rung.model in found]
        return (*ranked, *(name for name in found if name not in ranked))

    @cached_property
    def model(self) -> str:
        """The model shown in detail."""
        if self.detail_model:
            return self.require_model(self.detail_model)
        return RunFolder(self.root).default_model()

    def state_undone(self, said: str, stage: str) -> str:
        """Return the sentence on a stage that has not run, with the command that runs it."""
        return f"{said}: run `bampipe {stage} {self.root.name}`."

    def state_next(self, advice: str) -> str:
        """Return the sentence on what to do next: a command for ``RUN``, or words."""
        advice = advice.replace("RUN", self.root.name)
        return f"Next: `{advice}`" if advice.startswith("bampipe ") else f"Next: {advice}."

    @property
    def diagnose_command(self) -> str:
        """The command that diagnoses the model shown."""
        option = f" --model {self.model}" if len(self.models) > 1 else ""
        return f"bampipe diagnose {self.root.name}{option}"

    def require_model(self, name: str) -> str:
        """Return ``name`` of a model with results."""
        if name in self.models:
            return name
        raise MissingResultError(
            f"no results for model {name!r}",
            where=str(self.root),
            remedy=f"choose from {', '.join(self.models) or 'none: identify first'}",
        )

    def order_axes(self, by_axis: Mapping[str, T]) -> dict[str, T]:
        """Return the entries of ``by_axis`` in the order of the session."""
        return {axis: by_axis[axis] for axis in self.axes if axis in by_axis}

    def order_parameters(self, parameters: Iterable[str]) -> tuple[str, ...]:
        """Return names of parameters: those of every axis first, axis by axis, effects last."""
        kinds = ("viscous", "coulomb")

        def rank(name: str) -> tuple[int, int, str]:
            first, _, axis = name.partition(".")
            if first in kinds and axis in self.axes:
                return kinds.index(first), self.axes.index(axis), ""
            return len(kinds) + ("." in name), 0, name

        return tuple(sorted(parameters, key=rank))

    def model_file(self, name: str, model: str | None = None) -> str:
        """Return the relative path of a file of ``model`` (default: the one in detail)."""
        return f"models/{model or self.model}/{name}"

    def effects(self, model: str) -> tuple[str, ...]:
        """Return the effects that ``model`` has beyond the bare device."""
        path = self.root / "models" / model / "model.toml"
        return read_model_file(path).effects if path.is_file() else ()

    def list_effects(self) -> str:
        """Return " with ..." and the effects of the model shown; "" without effects."""
        names = join_names(f"`{name}`" for name in self.effects(self.model))
        return f" with {names}" if names else ""

    @cached_property
    def paper(self) -> dict[str, Any] | None:
        """The numbers that the device's paper published, or None for a device without one."""
        path = Path(__file__).parent / "templates" / f"paper-{self.session.device}.toml"
        return read_toml(path) if path.is_file() else None

    def cite_paper(self, item: str) -> str:
        """Return " (the paper's <item>)" if the device has a paper, else ""."""
        return f" (the paper's {item})" if self.paper else ""
