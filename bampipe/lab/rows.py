"""Rows of one run folder in the tables of the lab."""

from collections import defaultdict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bampipe.data import lab_tables, store
from bampipe.data.refusals import refusal
from bampipe.data.run_folder import BASE, RunFolder
from bampipe.phrases import diagnosis as phrases
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.rounding import NORMAL_95
from bampipe.results.stiffness import StiffnessResult
from bampipe.results.validate import ValidateResult
from bampipe.run import models, record

_OF_SESSION = ("ingest/session.json", "ingest/trials.parquet", "stiffness/stiffness.json")
_OF_MODELS = ("identify.json", "validate.json", "diagnose.json")
"""Files read from a run, and from each of its models."""


def read_run(root: Path) -> dict[str, list[dict[str, Any]]]:
    """Return rows by table of the run folder ``root``, of all stages that have run.

    Each begins with session_id, recorded_at and device; the table ``sessions`` has one.

    Raises:
        InputError: ingest has not run, or a result is damaged or was changed since it was written.
    """
    run = RunFolder(root)
    made = run.models()
    of_models = [f"models/{model}/{name}" for model in made for name in _OF_MODELS]
    record.require_untouched(root, [*_OF_SESSION, *of_models])
    session = run.read(IngestResult)
    try:
        recorded = lab_tables.moment(session.recorded_at)
    except ValueError as error:
        raise refusal("no_moment_of_run", str(run.path(IngestResult.FILE)), why=error) from error
    key = {"session_id": root.name, "device": session.device, "recorded_at": recorded}
    tables = defaultdict[str, list[dict[str, Any]]](list)

    def add(table: str, **columns: object) -> None:  # a table keeps those columns that it has
        tables[table].append({**key, **columns})

    nis: Mapping[str, float] = {}
    for model in made:
        found = _add_model(run, add, model, tuple(session.axes))
        nis = nis or found
    if run.exists("ingest/trials.parquet"):
        frame = store.read_parquet(run.path("ingest/trials.parquet")).astype(object)
        for trial in frame.where(frame.notna(), None).to_dict("records"):
            add("quality", nis=nis.get(trial["trial_id"]), **trial)
    stiffness = run.find(StiffnessResult)
    for axis, entry in stiffness.axes.items() if stiffness else ():
        interval = _make_interval(entry.stiffness, entry.sd)
        add("stiffness", axis=axis, **entry.model_dump(), **interval)
    run_record = record.read(root)
    states = [trial["status"] for trial in tables["quality"]]
    verdicts = [gate.state for gate in run_record.gates]
    counting = run.default_model()
    had, has = (models.read(root, m).effects if m in made else () for m in (BASE, counting))
    add(
        "sessions",
        sample_rate_hz=session.sample_rate_hz,
        trials=len(states),
        trials_repaired=states.count("repaired"),
        trials_set_aside=states.count("set_aside"),
        models=list(made),
        counting_model=counting,
        effects=[effect for effect in has if effect not in had],
        gates_failed=verdicts.count("failed"),
        gates_warned=verdicts.count("warned"),
        failures=[f"{step}: {text}" for step, text in sorted(run_record.failures.items())],
        bampipe=run_record.versions.get("bampipe"),
    )
    return tables


def _add_model(
    run: RunFolder, add: Callable[..., None], model: str, axes: tuple[str, ...]
) -> Mapping[str, float]:
    """Add the rows of one model; return its consistency (NIS) by trial."""
    nis: Mapping[str, float] = {}
    if identified := run.find(IdentifyResult, model):
        nis = identified.nis.by_trial if identified.nis else {}
        for name, found in identified.parameters.items():
            last = name.rpartition(".")[2]
            inner = name.split(".")[1:2]
            axis = last if last in axes else next((part for part in inner if part in axes), None)
            about = {"model": model, "parameter": name, "axis": axis, "method": identified.method}
            interval = _make_interval(found.estimate, found.sd)
            add("parameters", **about, **found.model_dump(), **interval)
    validated = run.find(ValidateResult, model)
    for axis, error in validated.axes.items() if validated else ():
        over = error.held_out_rmse / error.noise_floor if error.noise_floor else None
        add("errors", model=model, axis=axis, error_over_floor=over, **error.model_dump())
    if diagnosis := run.find(DiagnoseResult, model):
        for axis, said in diagnosis.axes.items():
            plain = said.model_dump(mode="json") | {
                "named": phrases.missing_effects(diagnosis, axis),
                "likely": said.likely,
                "probabilities": [said.probabilities[name] for name in said.likely],
            }
            add("verdicts", model=model, axis=axis, **plain)
    return nis


def _make_interval(value: float, sd: float) -> dict[str, float]:
    """Return the 95 % interval of an estimate."""
    return {"lower": value - NORMAL_95 * sd, "upper": value + NORMAL_95 * sd}
