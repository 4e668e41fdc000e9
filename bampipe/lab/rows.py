"""From one run folder to its rows in the tables of the lab."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bampipe.data import lab_tables, store
from bampipe.data.run_folder import RunFolder
from bampipe.errors import InputError
from bampipe.files import refuse_links
from bampipe.run import models, record

NORMAL_95 = 1.959963984540054
"""Half width of a 95 % interval of a normal distribution, in standard deviations."""


_OF_SESSION = ("ingest/session.json", "ingest/trials.parquet", "stiffness/stiffness.json")
_OF_MODELS = ("identify.json", "validate.json", "diagnose.json")
"""What is read of a run, and of each of its models."""


@dataclass
class SessionRows:
    """Rows of one session, by table.

    Attributes:
        key: what every row begins with: session_id, recorded_at, device.
        tables: rows by table.
    """

    key: dict[str, Any]
    tables: dict[str, list[dict[str, Any]]] = field(default_factory=dict)

    def add(self, table: str, **columns: object) -> None:
        """Add a row to ``table``."""
        self.tables.setdefault(table, []).append({**self.key, **columns})


def of_run(root: Path) -> SessionRows:
    """Return the rows of the run folder ``root``: of whatever stages have run.

    Raises:
        InputError: ingest has not run, or a result is damaged or was changed since it was written.
    """
    refuse_links(root)
    made = models.names(root)
    of_models = [f"models/{model}/{name}" for model in made for name in _OF_MODELS]
    record.require_untouched(root, [*_OF_SESSION, *of_models])
    try:
        return _of_sound(RunFolder(root), made)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"a result is not as bampipe writes it ({type(error).__name__}: {error})",
            where=str(root),
            remedy="make it again (--force)",
        ) from error


def _of_sound(run: RunFolder, made: tuple[str, ...]) -> SessionRows:
    root = run.root
    session = run.read_json("ingest/session.json")
    try:
        recorded = lab_tables.moment(session.get("recorded_at"))
        key = {"session_id": root.name, "device": str(session["device"])}
    except (KeyError, ValueError) as error:
        raise InputError(
            f"no description of a session ({error})",
            where=str(root / "ingest/session.json"),
            remedy="make it again (--force)",
        ) from error
    rows = SessionRows({**key, "recorded_at": recorded})
    axes = tuple(str(axis) for axis in session.get("axes", {}))
    nis: Mapping[str, Any] = {}
    for model in made:
        found = _model(run, rows, model, axes)
        nis = nis or found
    _trials(run, rows, nis)
    if run.exists("stiffness/stiffness.json"):
        for axis, entry in run.read_json("stiffness/stiffness.json").get("axes", {}).items():
            _stiffness(rows, axis, entry)
    _session(root, rows, session, made)
    return rows


def _model(
    run: RunFolder, rows: SessionRows, model: str, axes: tuple[str, ...]
) -> Mapping[str, Any]:
    """Add the rows of one model; return its consistency (NIS) by trial."""
    nis: Mapping[str, Any] = {}
    folder = f"models/{model}"
    if run.exists(f"{folder}/identify.json"):
        content = run.read_json(f"{folder}/identify.json")
        nis = content.get("nis", {}).get("by_trial", {}) or {}
        for name, entry in sorted(content["parameters"].items()):
            last = name.rpartition(".")[2]
            inner = name.split(".")[1:2]
            axis = last if last in axes else next((part for part in inner if part in axes), None)
            rows.add(
                "parameters",
                model=model,
                parameter=name,
                axis=axis,
                unit=entry.get("unit"),
                at_bound=entry.get("at_bound"),
                method=content.get("method"),
                **_interval("estimate", entry),
            )
    if run.exists(f"{folder}/validate.json"):
        for axis, entry in sorted(run.read_json(f"{folder}/validate.json")["axes"].items()):
            error, floor = _number(entry.get("held_out_rmse")), _number(entry.get("noise_floor"))
            rows.add(
                "errors",
                model=model,
                axis=axis,
                held_out_rmse=error,
                noise_floor=floor,
                error_over_floor=error / floor if error is not None and floor else None,
                unit=entry.get("unit"),
                **_numbers(entry, "rmse", "rmse_without_friction", "fit_percent"),
            )
    if run.exists(f"{folder}/diagnose.json"):
        for axis, entry in sorted(run.read_json(f"{folder}/diagnose.json")["axes"].items()):
            rows.add(
                "verdicts",
                model=model,
                axis=axis,
                verdict=entry["verdict"],
                effects=[str(effect) for effect in entry.get("effects", ())],
                unit=entry.get("unit"),
                sentence=entry.get("sentence"),
                **_numbers(
                    entry,
                    "explainable_share",
                    "explainable_chance",
                    "rmse_before",
                    "rmse_after",
                    "noise_floor",
                ),
            )
    return nis


def _trials(run: RunFolder, rows: SessionRows, nis: Mapping[str, Any]) -> None:
    if not run.exists("ingest/trials.parquet"):
        return
    frame = store.read_parquet(run.path("ingest/trials.parquet"))
    for trial in frame.to_dict("records"):
        rows.add(
            "quality",
            trial_id=str(trial["trial_id"]),
            n_samples=int(trial["n_samples"]),
            nis=_number(nis.get(str(trial["trial_id"]))),
            **{name: str(trial[name]) for name in ("kind", "status", "reason", "repairs")},
            **_numbers(trial, "duration_s", "sample_rate_hz"),
        )


def _stiffness(rows: SessionRows, axis: str, entry: Mapping[str, Any]) -> None:
    cycles = _number(entry.get("n_cycles"))
    rows.add(
        "stiffness",
        axis=axis,
        unit=entry.get("unit"),
        bandwidth_hz=_number(entry.get("bandwidth_hz")),
        n_cycles=None if cycles is None else int(cycles),
        **_interval("stiffness", entry),
    )


def _session(
    root: Path, rows: SessionRows, session: Mapping[str, Any], made: tuple[str, ...]
) -> None:
    kept = record.read(root)
    states = [trial["status"] for trial in rows.tables.get("quality", ())]
    verdicts = [gate.get("state") for gate in kept.get("gates", ())]
    had = set(models.read(root, models.BASE).effects) if models.BASE in made else set()
    added = [e for name in made for e in models.read(root, name).effects if e not in had]
    rows.add(
        "sessions",
        sample_rate_hz=_number(session.get("sample_rate_hz")),
        trials=len(states),
        trials_repaired=states.count("repaired"),
        trials_set_aside=states.count("set_aside"),
        models=list(made),
        effects=list(dict.fromkeys(added)),
        gates_failed=verdicts.count("failed"),
        gates_warned=verdicts.count("warned"),
        failures=[f"{step}: {text}" for step, text in sorted(kept.get("failures", {}).items())],
        bampipe=kept.get("versions", {}).get("bampipe"),
    )


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) else None


def _numbers(entry: Mapping[str, Any], *names: str) -> dict[str, float | None]:
    return {name: _number(entry.get(name)) for name in names}


def _interval(name: str, entry: Mapping[str, Any]) -> dict[str, float | None]:
    """Return an estimate, its standard deviation and its 95 % interval."""
    value, sd = _number(entry.get(name)), _number(entry.get("sd"))
    half = None if value is None or sd is None else NORMAL_95 * sd
    return {
        name: value,
        "sd": sd,
        "lower": None if half is None else (value or 0.0) - half,
        "upper": None if half is None else (value or 0.0) + half,
    }
