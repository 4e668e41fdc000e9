"""A run folder as an object, whose results are tables and plain records."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import pandas as pd

from bampipe.errors import InputError
from bampipe.report.run_results import Results
from bampipe.results.compare import CompareResult
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.draft import DraftResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.record import Record, Result
from bampipe.results.stiffness import StiffnessResult
from bampipe.results.validate import ValidateResult
from bampipe.run import record

R = TypeVar("R", bound=Result)
T = TypeVar("T")


@dataclass(frozen=True)
class Picture:
    """A figure of the report, an SVG file that notebooks show."""

    path: Path

    def _repr_svg_(self) -> str:
        return self.path.read_text(encoding="utf-8")


class Run:
    """The results of one session, for reading only; each result is read once, on first use.

    All values are in SI units. Models are named as in the run folder, such as ``base`` or
    ``base+stribeck.yaw``. Methods take the best confirmed model by default.

    Args:
        root: the run folder.

    Raises:
        InputError: there is no run. Every attribute whose stage has not run raises it as well, with
            the command that runs the stage.
    """

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)
        if not (self.root / record.FILE).is_file():
            raise InputError(
                "no run here", where=str(self.root), remedy="make one: bampipe.run_session(SESSION)"
            )
        self._results = Results(self.root)

    def __repr__(self) -> str:
        return f"Run({str(self.root)!r})"

    @property
    def name(self) -> str:
        """The id of the session."""
        return self.root.name

    @property
    def session(self) -> dict[str, Any]:
        """The session as ingest read it: axes, channels, units, sample rate."""
        return self._results.session.model_dump(mode="json")

    @property
    def trials(self) -> pd.DataFrame:
        """One row per trial: kind, duration, state, repairs."""
        return self._results.trials

    @cached_property
    def samples(self) -> pd.DataFrame:
        """All sound samples: trial_id, t (s), positions ``q_<axis>``, inputs."""
        return self._table("ingest/samples.parquet", "ingest")

    @cached_property
    def kinematics(self) -> pd.DataFrame:
        """Positions, velocities and accelerations on a uniform grid, with standard deviations."""
        return self._table("filter/kinematics.parquet", "filter")

    @cached_property
    def stiffness(self) -> pd.DataFrame:
        """One row per axis with a locked trial: stiffness, sd, bandwidth; empty without any."""
        return _make_frame(self._read(StiffnessResult).axes)

    @property
    def models(self) -> tuple[str, ...]:
        """The models that have been identified, parents before children."""
        return self._results.models

    @property
    def model(self) -> str:
        """The best confirmed model."""
        return self._results.model

    def effects(self, model: str = "") -> tuple[str, ...]:
        """The effects of a model."""
        return self._results.effects(self._choose_model(model))

    def parameters(self, model: str = "") -> pd.DataFrame:
        """One row per parameter: estimate, sd, unit, and further results of the identification."""
        frame = _make_frame(self._read(IdentifyResult, model).parameters)
        first = [name for name in ("estimate", "sd", "unit") if name in frame]
        order = self._results.order_parameters(frame.index)
        return frame.loc[list(order), first + [c for c in frame if c not in first]]

    def covariance(self, model: str = "") -> pd.DataFrame:
        """Covariance matrix of the estimates."""
        found = self._read(IdentifyResult, model).covariance
        return pd.DataFrame(found.matrix, list(found.names), list(found.names))

    def states(self, model: str = "") -> pd.DataFrame:
        """The filtered motion with standard deviations."""
        return self._table(f"models/{self._choose_model(model)}/states.parquet", "identify")

    def validation(self, model: str = "") -> pd.DataFrame:
        """One row per axis: error on all and on unseen trials, noise floor, fit, unit."""
        return _make_frame(self._read(ValidateResult, model).axes)

    def free_run(self, model: str = "") -> dict[str, Any]:
        """Error of a free run of the model, or the reason why there is none."""
        found = self._read(ValidateResult, model).free_run
        return {} if found is None else found.model_dump(mode="json")

    def residuals(self, model: str = "") -> pd.DataFrame:
        """Measured torque and force, and their prediction with parameters from other trials."""
        return self._table(f"models/{self._choose_model(model)}/residuals.parquet", "validate")

    def diagnosis(self, model: str = "") -> dict[str, Any]:
        """The diagnosis: verdict of each axis, ranking, residual maps, advice."""
        return self._read(DiagnoseResult, model).model_dump(mode="json")

    def drafts(self, model: str = "") -> dict[str, Any]:
        """Formulas drafted for the unexplained residual: curves, constants, p-values."""
        return self._read(DraftResult, model).model_dump(mode="json")

    def ranking(self, model: str = "") -> pd.DataFrame:
        """The candidate effects, best first: error before and after, probability, p-value."""
        return pd.DataFrame(self.diagnosis(model)["ranking"])

    @property
    def ladder(self) -> pd.DataFrame:
        """One row per model: added effects, and held-out error and noise floor by axis."""
        rows = []
        for rung in self._read(CompareResult).ladder:
            row: dict[str, object] = {"model": rung.model, "added": rung.added or ""}
            for axis in rung.held_out_rmse:
                row[f"held_out_rmse.{axis}"] = rung.held_out_rmse[axis]
                row[f"noise_floor.{axis}"] = rung.noise_floor.get(axis)
            rows.append(row)
        return pd.DataFrame(rows).set_index("model")

    @property
    def figures(self) -> Mapping[str, Picture]:
        """The figures of the report by name; empty if there is no report."""
        paths = sorted((self.root / "report" / "figures").glob("*.svg"))
        return {path.stem: Picture(path) for path in paths}

    def _choose_model(self, model: str) -> str:
        return self._results.require_model(model) if model else self.model

    def _read(self, kind: type[R], model: str = "") -> R:
        name = self._choose_model(model) if "{model}" in kind.FILE else ""
        found = self._results.read(kind, name)
        return self._require(found, kind.file(name), kind.STAGE)

    def _table(self, relative: str, stage: str) -> pd.DataFrame:
        return self._require(self._results.table(relative), relative, stage)

    def _require(self, found: T | None, relative: str, stage: str) -> T:
        if found is None:
            raise InputError(
                f"{relative} does not exist yet",
                where=str(self.root),
                remedy=f"`bampipe {stage} {self.root}` makes it, or bampipe.{stage}(run)",
            )
        return found


def _make_frame(entries: Mapping[str, Record]) -> pd.DataFrame:
    """Return one row per entry, with its fields as columns."""
    plain = {name: entry.model_dump(mode="json") for name, entry in entries.items()}
    return pd.DataFrame.from_dict(plain, orient="index")


def open_run(path: str | Path) -> Run:
    """Open a run by its folder, or by its name in ``runs/``.

    Raises:
        InputError: there is no such run.
    """
    return Run(record.find_folder(path, Path("runs")) or path)
