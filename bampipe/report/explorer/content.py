"""What the page for exploring shows of a run: stored records as plain tables, columns packed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd

from bampipe.report import verdicts, wording
from bampipe.report.explorer.packing import Packer
from bampipe.report.results import Results
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
    """Where a trial lies on the session's one axis of time: ``t`` of the trial plus ``offset``."""

    id: str
    kind: str
    start: float
    stop: float
    offset: float


def content_of(results: Results, packer: Packer) -> Content:
    """Return everything that the page shows; channels as blocks of ``packer``."""
    spans = _spans(results)
    grids = _Grids(spans, packer)
    _add_residuals(results, grids)
    _add_map_variables(results, grids)
    _add_recorded(results, grids)
    models = [_model(results, number, name) for number, name in enumerate(results.models)]
    return {
        "models": models,
        "shown": results.models.index(results.model) if models else 0,
        "axes": [_axis(results, axis) for axis in results.axes],
        "trials": [asdict(span) for span in spans],
        "grids": grids.described,
        "channels": grids.channels,
        "maps": _maps(results),
        "windows": _windows(results),
        "ladder": _ladder(results),
        "parameters": _parameters(results),
        "correlations": _correlations(results),
        "tables": [table for table in _tables(results) if table["rows"]],
    }


def _spans(results: Results) -> list[_Span]:
    """Return the trials that were read, one behind the other."""
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
            unit = wording.unit(results.force_unit(axis))
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
    if samples is not None and len(samples):
        rows = grids.start("recorded", samples)
        session = results.session
        others = {**session.brakes, **session.channels}
        for column in rows.columns:
            name = str(column)
            if name.startswith("q_") and name.removeprefix("q_") in session.axes:
                axis = name.removeprefix("q_")
                label, unit = f"position {axis}", results.unit(axis)
            elif name in session.force.noise_sd or name in session.force.columns:
                label, unit = wording.words(name), session.force.unit
            elif name in others:
                label, unit = wording.words(name), others[name].unit
            else:
                continue
            grids.add("recorded", rows[column], role="recorded", label=label,
                      unit=wording.unit(unit))  # fmt: skip
    known = results.columns("filter/kinematics.parquet")
    rates = [axis for axis in results.axes if f"qd_{axis}" in known]
    if not rates:
        return
    columns = ["trial_id", "t", *(f"qd_{axis}" for axis in rates)]
    motion = results.table("filter/kinematics.parquet", columns)
    if motion is not None and len(motion):
        rows = grids.start("motion", motion)
        for axis in rates:
            unit = wording.unit(results.rate_unit(axis))
            grids.add("motion", rows[f"qd_{axis}"], role="motion", label=f"velocity {axis}",
                      unit=unit)  # fmt: skip


def _model(results: Results, number: int, name: str) -> Content:
    compared = results.read(CompareResult)
    rungs = {rung.model: rung for rung in compared.ladder} if compared else {}
    added = rungs[name].added if name in rungs else None
    validated = results.read(ValidateResult, name)
    floors = (
        {axis: entry.noise_floor for axis, entry in validated.axes.items()} if validated else {}
    )
    return {
        "name": name,
        "label": name if number == 0 else f"version {number}",
        "added": added or "",
        "effects": list(results.effects(name)),
        "floors": floors,
    }


def _axis(results: Results, axis: str) -> Content:
    noun = "torque" if results.is_rotary(axis) else "force"
    return {"name": axis, "noun": noun, "unit": wording.unit(results.force_unit(axis))}


def _maps(results: Results) -> list[Content]:
    found = []
    for number, model in enumerate(results.models):
        diagnosis = results.read(DiagnoseResult, model)
        for axis, maps in (diagnosis.maps if diagnosis else {}).items():
            for variable, drawn in maps.items():
                plain = drawn.model_dump(mode="json", include={"center", "mean", "low", "high"})
                about = {"unit": wording.unit(drawn.unit), "share": drawn.variance_share}
                found.append(
                    {"model": number, "axis": axis, "variable": variable, **about, **plain}
                )
    return found


def _windows(results: Results) -> list[Content]:
    """Return the worst windows of the latest diagnosis first."""
    found = []
    for number, model in reversed(list(enumerate(results.models))):
        diagnosis = results.read(DiagnoseResult, model)
        for window in diagnosis.worst_windows if diagnosis else ():
            unit = wording.unit(window.unit)
            found.append({"model": number, **window.model_dump(), "unit": unit})
    return found


def _ladder(results: Results) -> Content:
    """Return, by axis, held-out error and noise floor of each version, in their order."""
    validated = [results.read(ValidateResult, model) for model in results.models]
    return {
        axis: [
            {"error": entry.axes[axis].held_out_rmse, "floor": entry.axes[axis].noise_floor}
            if entry and axis in entry.axes
            else {"error": None, "floor": None}
            for entry in validated
        ]
        for axis in results.axes
        if any(entry and axis in entry.axes for entry in validated)
    }


def _parameters(results: Results) -> list[Content]:
    identified = [results.read(IdentifyResult, model) for model in results.models]
    names = {name: None for entry in identified if entry for name in entry.parameters}
    found = []
    for name in results.in_order(names):
        values = [entry.parameters.get(name) if entry else None for entry in identified]
        unit = next(value.unit for value in values if value)
        found.append(
            {
                "name": name,
                "unit": wording.unit(unit),
                "values": [
                    v.model_dump(include={"estimate", "sd", "at_bound"}) if v else None
                    for v in values
                ],
            }
        )
    return found


def _correlations(results: Results) -> list[Content]:
    found = []
    for number, model in enumerate(results.models):
        identified = results.read(IdentifyResult, model)
        if identified is None or not identified.covariance.names:
            continue
        covariance = np.array(identified.covariance.matrix)
        sd = np.sqrt(np.diag(covariance))
        with np.errstate(divide="ignore", invalid="ignore"):
            matrix = covariance / np.outer(sd, sd)
        rows = [[float(v) if np.isfinite(v) else None for v in row] for row in matrix]
        found.append(
            {
                "model": number,
                "names": list(identified.covariance.names),
                "matrix": rows,
                "blocks": identified.blocks,
            }
        )
    return found


def _tables(results: Results) -> Iterable[Content]:
    yield _trial_errors(results)
    for number, model in reversed(list(enumerate(results.models))):
        diagnosis = results.read(DiagnoseResult, model)
        if diagnosis is not None:
            label = model if number == 0 else f"version {number}"
            yield _candidates(diagnosis, label)


def _trial_errors(results: Results) -> Content:
    validated = results.read(ValidateResult)
    trials = validated.trials if validated else {}
    axes = verdicts.ordered(results, validated.axes) if validated else ()
    rows: list[list[Cell]] = []
    for row in results.trials.to_dict("records"):
        name, kind = str(row["trial_id"]), str(row["kind"])
        state = wording.trial_state(str(row["status"]))
        seconds = float(row["duration_s"])
        # A trial that is alone is held out block by block.
        blocks = [block for block in trials if block.startswith(f"{name}@")]
        for part in [name, *blocks]:
            judged = trials.get(part)
            errors = [
                (judged.axes[axis].held_out_rmse or None)
                if judged and axis in judged.axes
                else None
                for axis in axes
            ]
            whole = part == name and np.isfinite(seconds)
            rows.append([part, kind, state, seconds if whole else None, *errors])
    heads = [f"RMSE {axis} ({wording.unit(results.force_unit(axis))})" for axis in axes]
    return {
        "title": "Trials",
        "note": f"Held-out errors of model {results.model}." if axes else "",
        "head": ["Trial", "Kind", "State", "Duration (s)", *heads],
        "rows": rows,
    }


def _candidates(diagnosis: DiagnoseResult, label: str) -> Content:
    return {
        "title": f"Candidate effects, {label}",
        "note": "Held-out error without and with each effect; p: chance that replays give any "
        "candidate as large a gain.",
        "head": [
            *("Effect", "Axis", "Without", "With", "Unit", "Probability", "p"),
            "Indistinguishable from",
        ],
        "rows": [
            [
                entry.effect,
                entry.axis,
                entry.held_out_rmse_before,
                entry.held_out_rmse_after,
                wording.unit(entry.unit),
                entry.probability,
                entry.p_value,
                ", ".join(entry.indistinguishable_from),
            ]
            for entry in diagnosis.ranking
        ],
    }
