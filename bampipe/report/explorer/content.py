"""Content of the page for exploring a run: stored records as plain tables, columns packed."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from bampipe.errors import InputError
from bampipe.files import read_toml
from bampipe.lists import join_names
from bampipe.report.document import strip_marks
from bampipe.report.explorer.packing import Packer
from bampipe.report.run_results import Results
from bampipe.report.wording import format_unit, name_trial_state, split_name
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.record import Result
from bampipe.results.validate import ValidateResult

_BREAK_S = 0.5
"""Gap between two trials on the axis of time, seconds."""
_SHOWN: Mapping[type[Result], set[str]] = {
    IdentifyResult: {"parameters", "covariance", "blocks"},
    ValidateResult: {"axes"},
    DiagnoseResult: {"axes", "maps", "worst_windows", "ranking", "sets", "descriptions"},
}
"""Records of a model that the page holds, and the fields of each; assets/records.js reads them."""

Cell = str | float | int | None
Content = dict[str, Any]


@dataclass(frozen=True)
class _Session:
    """One of the sessions on the page; ``prefix``: before the names of its trials and models."""

    results: Results
    prefix: str

    def table(self, path: str, columns: Sequence[str] | None = None) -> pd.DataFrame | None:
        """Return a Parquet file with the page's names of trials; None if it is missing or empty."""
        frame = self.results.table(path, columns)
        if frame is None or frame.empty:
            return None
        return frame.assign(trial_id=self.prefix + frame["trial_id"]) if self.prefix else frame


_Version = tuple[_Session, str]
"""One model of one session."""


def gather_content(sessions: Sequence[Results], packer: Packer) -> Content:
    """Return the content of the page for sessions of one device; ``packer`` packs channels.

    Trials and models of a second session follow those of the first.
    """
    results = sessions[0]
    for other in sessions[1:]:
        if other.axes != results.axes:
            raise InputError(
                f"axes {join_names(other.axes)} are not those of {results.root.name}",
                where=str(other.root),
                remedy="show two sessions of one device",
            )
    alone = len(sessions) == 1
    shown = [_Session(one, "" if alone else f"{one.session.session_id} ") for one in sessions]
    versions = [(one, model) for one in shown for model in one.results.models]
    spans = _place_trials(shown)
    grids = _Grids(spans, packer)
    _add_residuals(results, versions, grids)
    _add_map_variables(results, versions, grids)
    _add_recorded(shown, grids)
    axes = [
        {"name": a, "noun": results.name_force(a), "unit": format_unit(results.force_unit(a))}
        for a in results.axes
    ]
    models = [_describe_model(*version) for version in versions]
    names = {name for one in models if one["identify"] for name in one["identify"]["parameters"]}
    tables = map(_make_trials, shown)
    path = results.root / "ingest/device.toml"
    robot = read_toml(path).get("robot", {}) if path.is_file() else {}
    joints = robot.get("joints", {})
    return {
        "models": models,
        "shown": results.models.index(results.model) if results.models else 0,
        "axes": axes,
        "trials": spans,
        "grids": grids.described,
        "channels": grids.channels,
        "parameters": results.order_parameters(names),
        "joints": [{"name": name, **joint} for name, joint in joints.items()],
        "tables": [table for table in tables if table["rows"]],
    }


def _place_trials(sessions: Sequence[_Session]) -> list[Content]:
    """Return the trials that were read, in order, each placed on the common axis of time.

    Time on that axis is ``t`` of the trial plus its ``offset``.
    """
    found: list[Content] = []
    start = 0.0
    for session in sessions:
        for row in session.results.trials.to_dict("records"):
            name = str(row["trial_id"])
            times = session.results.table("ingest/samples.parquet", ["t"], trial=name)
            if times is None:
                continue
            first, last = float(times["t"].iloc[0]), float(times["t"].iloc[-1])
            about = {"id": session.prefix + name, "kind": str(row["kind"]), "start": start}
            stop = start + last - first
            found.append({**about, "stop": stop, "offset": start - first})
            start = stop + _BREAK_S
    return found


def _join(frames: Iterable[pd.DataFrame | None]) -> pd.DataFrame | None:
    """Return the rows of all sessions together; None if there are none."""
    found = [frame for frame in frames if frame is not None]
    return pd.concat(found, ignore_index=True) if len(found) > 1 else next(iter(found), None)


class _Grids:
    """Channels grouped by their common grid of times, each packed when it is added."""

    def __init__(self, spans: Sequence[Content], packer: Packer) -> None:
        self.channels: list[Content] = []
        self.described: Content = {}
        self._offsets = {span["id"]: span["offset"] for span in spans}
        self._packer = packer
        self._rows: dict[str, pd.MultiIndex] = {}

    def start(self, name: str, frame: pd.DataFrame) -> pd.DataFrame:
        """Make a grid of the times in ``frame``; return its rows in the order of the trials."""
        order = {trial: number for number, trial in enumerate(self._offsets)}
        known = frame[frame["trial_id"].isin(order)]
        known = known.sort_values("trial_id", key=lambda ids: ids.map(order), kind="stable")
        offsets = known["trial_id"].map(self._offsets).to_numpy(dtype=float)
        times = known["t"].to_numpy() + offsets
        ids = known["trial_id"].to_numpy()
        bounds = [*(np.flatnonzero(ids[1:] != ids[:-1]) + 1).tolist(), len(ids)]
        block = self._packer.pack_times(times)
        self.described[name] = {"n": len(times), "block": block, "ends": bounds}
        self._rows[name] = pd.MultiIndex.from_frame(known[["trial_id", "t"]])
        return known

    def align(self, name: str, frame: pd.DataFrame) -> pd.DataFrame | None:
        """Return the rows of ``frame`` at the times of a grid; None if they have repeated times."""
        rows = pd.MultiIndex.from_frame(frame[["trial_id", "t"]])
        if not rows.is_unique:
            return None
        return frame.set_index(rows).reindex(self._rows[name])

    def add(self, grid: str, values: object, **meaning: Cell) -> None:
        """Add one channel of ``grid``."""
        packed = self._packer.pack(np.asarray(values, dtype=np.float64))
        self.channels.append({"grid": grid, **packed, **meaning})


def _add_residuals(results: Results, versions: Sequence[_Version], grids: _Grids) -> None:
    frames = [one.table(f"models/{model}/residuals.parquet") for one, model in versions]
    # What was measured is the same in every version of a session.
    first = {v[0].prefix: f for v, f in reversed([*zip(versions, frames, strict=True)])}
    measured = _join(first[prefix] for prefix in dict.fromkeys(one.prefix for one, _ in versions))
    if measured is None:
        return
    rows = grids.start("residuals", measured)
    axes = [axis for axis in results.axes if f"torque_measured_{axis}" in rows]
    about = {axis: {"axis": axis, "unit": format_unit(results.force_unit(axis))} for axis in axes}
    for axis in axes:
        grids.add("residuals", rows[f"torque_measured_{axis}"], role="measured", **about[axis])
        if f"moving_{axis}" in rows:
            grids.add("residuals", rows[f"moving_{axis}"], role="moving", axis=axis, unit="")
    for number, frame in enumerate(frames):
        own = None if frame is None else grids.align("residuals", frame)
        if own is None:
            continue
        for axis in axes:
            for role, column in (("predicted", "torque_predicted"), ("residual", "residual")):
                values = own[f"{column}_{axis}"]
                grids.add("residuals", values, role=role, **about[axis], model=number)


def _add_map_variables(results: Results, versions: Sequence[_Version], grids: _Grids) -> None:
    if "residuals" not in grids.described:
        return
    found: dict[str, pd.Series] = {}
    for session, model in versions:
        frame = session.table(f"models/{model}/map_variables.parquet")
        rows = None if frame is None else grids.align("residuals", frame)
        if rows is None:
            continue
        for column in map(str, rows.columns):
            axis, _, variable = column.partition(".")
            if axis in results.axes and variable:
                # Of the first version of a session that has it.
                known = found.get(column)
                found[column] = rows[column] if known is None else known.fillna(rows[column])
    for column, values in found.items():
        axis, _, variable = column.partition(".")
        grids.add("residuals", values, role="variable", axis=axis, label=variable)


def _add_recorded(sessions: Sequence[_Session], grids: _Grids) -> None:
    results = sessions[0].results
    samples = _join(one.table("ingest/samples.parquet") for one in sessions)
    session = results.session
    if samples is not None:
        rows = grids.start("recorded", samples)
        units = {
            name: session.force.unit for name in (*session.force.columns, *session.force.noise_sd)
        }
        units |= {name: one.unit for name, one in {**session.brakes, **session.channels}.items()}
        labels = {name: split_name(name) for name in units}
        positions = {f"q_{axis}": axis for axis in session.axes}
        units |= {name: results.unit(axis) for name, axis in positions.items()}
        labels |= {name: f"position {axis}" for name, axis in positions.items()}
        for name in (str(column) for column in rows.columns if str(column) in units):
            about = {"label": labels[name], "unit": format_unit(units[name])}
            about |= {"position": positions[name]} if name in positions else {}
            grids.add("recorded", rows[name], role="recorded", **about)
    path, known = "filter/kinematics.parquet", results.columns("filter/kinematics.parquet")
    rates = [axis for axis in results.axes if f"qd_{axis}" in known]
    wanted = ["trial_id", "t", *(f"qd_{axis}" for axis in rates)]
    motion = _join(one.table(path, wanted) for one in sessions) if rates else None
    if motion is not None:
        rows = grids.start("motion", motion)
        for axis in rates:
            about = {"label": f"velocity {axis}", "unit": format_unit(f"{results.unit(axis)}/s")}
            grids.add("motion", rows[f"qd_{axis}"], role="motion", **about)


def _describe_model(session: _Session, name: str) -> Content:
    """Return what the page shows of a model: of its records, the fields that the scripts read."""
    results = session.results
    number = results.models.index(name)
    added = [rung.added for rung in results.ladder if rung.model == name]
    described: Content = {
        "name": session.prefix + name,
        "label": session.prefix + (f"version {number}" if number else name),
        "prefix": session.prefix,
        "added": (added and added[0]) or "",
    }
    for kind, fields in _SHOWN.items():
        found = results.read(kind, name)
        described[kind.STAGE] = found and found.model_dump(mode="json", include=fields)
    diagnosis = described["diagnose"]
    for verdict in diagnosis["axes"].values() if diagnosis else ():
        verdict["sentence"] = strip_marks(verdict["sentence"])
    return described


def _make_trials(session: _Session) -> Content:
    results = session.results
    validated = results.read(ValidateResult)
    trials = validated.trials if validated else {}
    axes = tuple(results.order_axes(validated.axes)) if validated else ()
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
            rows.append([session.prefix + part, kind, state, seconds if whole else None, *errors])
    heads = [f"RMSE {axis} ({format_unit(results.force_unit(axis))})" for axis in axes]
    note = f"Held-out errors of model {results.model}." if axes else ""
    head = ["Trial", "Kind", "State", "Duration (s)", *heads]
    title = f"Trials {session.prefix}".strip()
    return {"title": title, "note": note, "head": head, "rows": rows}
