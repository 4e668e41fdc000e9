"""Content of the page for exploring a run: stored records as plain tables, columns packed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd

from bampipe.report.explorer.packing import Packer
from bampipe.report.results import R, Results
from bampipe.report.wording import format_unit, name_trial_state, split_name
from bampipe.results.compare import CompareResult
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.validate import ValidateResult

_BREAK_S = 0.5
"""Time drawn between one trial and the next."""

Cell = str | float | int | None
Content = dict[str, Any]


@dataclass(frozen=True)
class _Span:
    """Place of a trial on the session's one axis of time: ``t`` of the trial plus ``offset``."""

    id: str
    kind: str
    start: float
    stop: float
    offset: float


def gather_content(results: Results, packer: Packer) -> Content:
    """Return everything that the page shows; channels as blocks of ``packer``."""
    spans = _place_trials(results)
    grids = _Grids(spans, packer)
    _add_residuals(results, grids)
    _add_map_variables(results, grids)
    _add_recorded(results, grids)
    models = [_describe_model(results, number, name) for number, name in enumerate(results.models)]
    axes = [
        {"name": a, "noun": results.name_force(a), "unit": format_unit(results.force_unit(a))}
        for a in results.axes
    ]
    return {
        "models": models,
        "shown": results.models.index(results.model) if models else 0,
        "axes": axes,
        "trials": [asdict(span) for span in spans],
        "grids": grids.described,
        "channels": grids.channels,
        "maps": _list_maps(results),
        "windows": _list_windows(results),
        "ladder": _list_errors(results),
        "parameters": _list_parameters(results),
        "correlations": _list_correlations(results),
        "tables": [table for table in _make_tables(results) if table["rows"]],
    }


def _place_trials(results: Results) -> list[_Span]:
    """Return the trials that were read, one after the other."""
    found, start = [], 0.0
    for row in results.trials.to_dict("records"):
        name = str(row["trial_id"])
        times = results.table("ingest/samples.parquet", ["t"], trial=name)
        if times is None or times.empty:
            continue
        first, last = float(times["t"].iloc[0]), float(times["t"].iloc[-1])
        stop = start + last - first
        found.append(_Span(name, str(row["kind"]), start, stop, start - first))
        start = stop + _BREAK_S
    return found


class _Grids:
    """Channels by the grid of times that they share, packed as they come."""

    def __init__(self, spans: Sequence[_Span], packer: Packer) -> None:
        self.channels: list[Content] = []
        self.described: Content = {}
        self._spans = {span.id: span for span in spans}
        self._packer = packer
        self._rows: dict[str, pd.MultiIndex] = {}

    def start(self, name: str, frame: pd.DataFrame) -> pd.DataFrame:
        """Make a grid of the times in ``frame``; return its rows in the order of the trials."""
        order = {trial: number for number, trial in enumerate(self._spans)}
        known = frame[frame["trial_id"].isin(order)]
        known = known.sort_values("trial_id", key=lambda ids: ids.map(order), kind="stable")
        offsets = known["trial_id"].map({k: span.offset for k, span in self._spans.items()})
        times = known["t"].to_numpy() + offsets.to_numpy(dtype=float)
        ids = known["trial_id"].to_numpy()
        bounds = [*(np.flatnonzero(ids[1:] != ids[:-1]) + 1).tolist(), len(ids)]
        block = self._packer.pack_times(times)
        self.described[name] = {"n": len(times), "block": block, "ends": bounds}
        self._rows[name] = pd.MultiIndex.from_frame(known[["trial_id", "t"]])
        return known

    def align(self, name: str, frame: pd.DataFrame) -> pd.DataFrame | None:
        """Return the rows of ``frame`` at the times of a grid; None where they are not the same."""
        rows = pd.MultiIndex.from_frame(frame[["trial_id", "t"]])
        if not rows.is_unique:
            return None
        return frame.set_index(rows).reindex(self._rows[name])

    def add(self, grid: str, values: object, **meaning: Cell) -> None:
        """Add one channel of ``grid``."""
        packed = self._packer.pack(np.asarray(values, dtype=np.float64))
        self.channels.append({"grid": grid, **asdict(packed), **meaning})


def _add_residuals(results: Results, grids: _Grids) -> None:
    for number, model in enumerate(results.models):
        frame = results.table(results.model_file("residuals.parquet", model))
        if frame is None or frame.empty:
            continue
        first = "residuals" not in grids.described
        rows = grids.start("residuals", frame) if first else grids.align("residuals", frame)
        if rows is None:
            continue
        for axis in results.axes:
            if f"torque_measured_{axis}" not in rows:
                continue
            unit = format_unit(results.force_unit(axis))
            if first:
                measured = rows[f"torque_measured_{axis}"]
                grids.add("residuals", measured, role="measured", axis=axis, unit=unit)
                if f"moving_{axis}" in rows:
                    moving = rows[f"moving_{axis}"]
                    grids.add("residuals", moving, role="moving", axis=axis, unit="")
            for role, column in (("predicted", "torque_predicted"), ("residual", "residual")):
                values = rows[f"{column}_{axis}"]
                grids.add("residuals", values, role=role, axis=axis, model=number, unit=unit)


def _add_map_variables(results: Results, grids: _Grids) -> None:
    if "residuals" not in grids.described:
        return
    for model in results.models:
        frame = results.table(results.model_file("map_variables.parquet", model))
        rows = None if frame is None else grids.align("residuals", frame)
        if rows is None:
            continue
        for column in rows.columns:
            axis, _, variable = str(column).partition(".")
            known = any(
                c["role"] == "variable" and (c["axis"], c["label"]) == (axis, variable)
                for c in grids.channels
            )
            if axis in results.axes and variable and not known:
                grids.add("residuals", rows[column], role="variable", axis=axis, label=variable)


def _add_recorded(results: Results, grids: _Grids) -> None:
    samples = results.table("ingest/samples.parquet")
    session = results.session
    if samples is not None and len(samples):
        rows = grids.start("recorded", samples)
        units = {
            name: session.force.unit for name in (*session.force.columns, *session.force.noise_sd)
        }
        units |= {name: one.unit for name, one in {**session.brakes, **session.channels}.items()}
        labels = {name: split_name(name) for name in units}
        units |= {f"q_{axis}": results.unit(axis) for axis in session.axes}
        labels |= {f"q_{axis}": f"position {axis}" for axis in session.axes}
        for name in (str(column) for column in rows.columns if str(column) in units):
            about = {"label": labels[name], "unit": format_unit(units[name])}
            grids.add("recorded", rows[name], role="recorded", **about)
    path = "filter/kinematics.parquet"
    rates = [axis for axis in results.axes if f"qd_{axis}" in results.columns(path)]
    motion = results.table(path, ["trial_id", "t", *(f"qd_{axis}" for axis in rates)])
    if rates and motion is not None and len(motion):
        rows = grids.start("motion", motion)
        for axis in rates:
            about = {"label": f"velocity {axis}", "unit": format_unit(results.rate_unit(axis))}
            grids.add("motion", rows[f"qd_{axis}"], role="motion", **about)


def _label_model(number: int, name: str) -> str:
    return name if number == 0 else f"version {number}"


def _describe_model(results: Results, number: int, name: str) -> Content:
    compared, validated = results.read(CompareResult), results.read(ValidateResult, name)
    added = [rung.added for rung in (compared.ladder if compared else ()) if rung.model == name]
    axes = validated.axes if validated else {}
    return {
        "name": name,
        "label": _label_model(number, name),
        "added": (added and added[0]) or "",
        "effects": list(results.effects(name)),
        "floors": {axis: entry.noise_floor for axis, entry in axes.items()},
    }


def _read_all(results: Results, kind: type[R]) -> list[tuple[int, R]]:
    """Return a result of every model that has it, each with the number of the model."""
    found = ((number, results.read(kind, name)) for number, name in enumerate(results.models))
    return [(number, one) for number, one in found if one is not None]


def _list_maps(results: Results) -> list[Content]:
    found = []
    for number, diagnosis in _read_all(results, DiagnoseResult):
        for axis, maps in diagnosis.maps.items():
            for variable, one in maps.items():
                band = one.model_dump(mode="json", include={"center", "mean", "low", "high"})
                about = {"model": number, "axis": axis, "variable": variable, **band}
                unit = format_unit(one.unit)
                found.append({**about, "unit": unit, "share": one.variance_share})
    return found


def _list_windows(results: Results) -> list[Content]:
    """Return the worst windows, those of the latest diagnosis first."""
    return [
        {"model": number, **window.model_dump(), "unit": format_unit(window.unit)}
        for number, diagnosis in reversed(_read_all(results, DiagnoseResult))
        for window in diagnosis.worst_windows
    ]


def _list_errors(results: Results) -> Content:
    """Return, by axis, held-out error and noise floor of each version, in their order."""
    validated = dict(_read_all(results, ValidateResult))
    ladder: Content = {}
    for axis in results.axes:
        errors = {n: one.axes[axis] for n, one in validated.items() if axis in one.axes}
        if errors:
            ladder[axis] = [
                {"error": errors[n].held_out_rmse, "floor": errors[n].noise_floor}
                if n in errors
                else {"error": None, "floor": None}
                for n in range(len(results.models))
            ]
    return ladder


def _list_parameters(results: Results) -> list[Content]:
    identified = [results.read(IdentifyResult, model) for model in results.models]
    names = {name: p.unit for one in identified if one for name, p in one.parameters.items()}
    found = []
    for name in results.order_parameters(names):
        values = [one.parameters.get(name) if one else None for one in identified]
        shown = [
            v.model_dump(include={"estimate", "sd", "at_bound"}) if v else None for v in values
        ]
        found.append({"name": name, "unit": format_unit(names[name]), "values": shown})
    return found


def _list_correlations(results: Results) -> list[Content]:
    found = []
    for number, identified in _read_all(results, IdentifyResult):
        if not identified.covariance.names:
            continue
        covariance = np.array(identified.covariance.matrix)
        sd = np.sqrt(np.diag(covariance))
        with np.errstate(divide="ignore", invalid="ignore"):
            matrix = covariance / np.outer(sd, sd)
        rows = [[float(v) if np.isfinite(v) else None for v in row] for row in matrix]
        names = list(identified.covariance.names)
        blocks = identified.blocks
        found.append({"model": number, "names": names, "matrix": rows, "blocks": blocks})
    return found


def _make_tables(results: Results) -> Iterable[Content]:
    yield _make_trials(results)
    for number, diagnosis in reversed(_read_all(results, DiagnoseResult)):
        yield _make_candidates(diagnosis, _label_model(number, diagnosis.model))


def _make_trials(results: Results) -> Content:
    validated = results.read(ValidateResult)
    trials = validated.trials if validated else {}
    axes = results.order_axes(validated.axes) if validated else ()
    rows: list[list[Cell]] = []
    for row in results.trials.to_dict("records"):
        name, kind = str(row["trial_id"]), str(row["kind"])
        state = name_trial_state(str(row["status"]))
        seconds = float(row["duration_s"])
        # A trial that is alone is held out block by block.
        for part in [name, *(block for block in trials if block.startswith(f"{name}@"))]:
            known = trials[part].axes if part in trials else {}
            errors = [
                (known[axis].held_out_rmse or None) if axis in known else None for axis in axes
            ]
            whole = part == name and np.isfinite(seconds)
            rows.append([part, kind, state, seconds if whole else None, *errors])
    heads = [f"RMSE {axis} ({format_unit(results.force_unit(axis))})" for axis in axes]
    note = f"Held-out errors of model {results.model}." if axes else ""
    head = ["Trial", "Kind", "State", "Duration (s)", *heads]
    return {"title": "Trials", "note": note, "head": head, "rows": rows}


def _make_candidates(diagnosis: DiagnoseResult, label: str) -> Content:
    rows = [
        [
            *(entry.effect, entry.axis, entry.held_out_rmse_before, entry.held_out_rmse_after),
            *(format_unit(entry.unit), entry.probability, entry.p_value),
            ", ".join(entry.indistinguishable_from),
        ]
        for entry in diagnosis.ranking
    ]
    head = [
        "Effect",
        "Axis",
        "Without",
        "With",
        "Unit",
        "Probability",
        "p",
        "Indistinguishable from",
    ]
    note = (
        "Held-out error without and with each effect; p: probability that replicates give any "
        "candidate as large a gain."
    )
    return {"title": f"Candidate effects, {label}", "note": note, "head": head, "rows": rows}
