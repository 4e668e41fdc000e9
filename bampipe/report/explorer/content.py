"""Content of the page for exploring a run: stored records as plain tables, columns packed."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from bampipe.errors import InputError
from bampipe.files import read_toml
from bampipe.lists import join_names
from bampipe.phrases import diagnosis as phrases
from bampipe.report.document import strip_marks
from bampipe.report.explorer.packing import Packer
from bampipe.report.run_results import R, Results
from bampipe.report.wording import format_prose, format_unit, name_trial_state, split_name
from bampipe.results.compare import CompareResult
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.validate import ValidateResult

_BREAK_S = 0.5
"""Gap between two trials on the axis of time, seconds."""

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


@dataclass(frozen=True)
class _Version:
    """One model of one session; ``label``: its short name on the page."""

    session: _Session
    model: str
    label: str

    def table(self, name: str) -> pd.DataFrame | None:
        """Return a Parquet file of the model, as `_Session.table` does."""
        return self.session.table(self.session.results.model_file(name, self.model))


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
    versions = [
        _Version(one, model, one.prefix + (f"version {k}" if k else model))
        for one in shown
        for k, model in enumerate(one.results.models)
    ]
    spans = _place_trials(shown)
    grids = _Grids(spans, packer)
    _add_residuals(results, versions, grids)
    _add_map_variables(results, versions, grids)
    _add_recorded(shown, grids)
    axes = [
        {"name": a, "noun": results.name_force(a), "unit": format_unit(results.force_unit(a))}
        for a in results.axes
    ]
    tables = [_make_trials(one) for one in shown]
    for number, diagnosis in reversed(_read_all(versions, DiagnoseResult)):
        tables.append(_make_candidates(diagnosis, versions[number].label))
    path = results.root / "ingest/device.toml"
    robot = read_toml(path).get("robot", {}) if path.is_file() else {}
    joints = robot.get("joints", {})
    return {
        "models": [_describe_model(version) for version in versions],
        "shown": results.models.index(results.model) if results.models else 0,
        "axes": axes,
        "trials": spans,
        "grids": grids.described,
        "channels": grids.channels,
        "maps": _list_maps(versions),
        "windows": _list_windows(versions),
        "ladder": _list_errors(results, versions),
        "parameters": _list_parameters(results, versions),
        "correlations": _list_correlations(versions),
        "verdicts": _list_verdicts(versions),
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
    frames = [version.table("residuals.parquet") for version in versions]
    # What was measured is the same in every version of a session.
    first = {v.session.prefix: f for v, f in reversed([*zip(versions, frames, strict=True)])}
    measured = _join(first[prefix] for prefix in dict.fromkeys(v.session.prefix for v in versions))
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
    for version in versions:
        frame = version.table("map_variables.parquet")
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
            about = {"label": f"velocity {axis}", "unit": format_unit(results.rate_unit(axis))}
            grids.add("motion", rows[f"qd_{axis}"], role="motion", **about)


def _describe_model(version: _Version) -> Content:
    results, name = version.session.results, version.model
    compared, validated = results.read(CompareResult), results.read(ValidateResult, name)
    added = [rung.added for rung in (compared.ladder if compared else ()) if rung.model == name]
    axes = validated.axes if validated else {}
    return {
        "name": version.session.prefix + name,
        "label": version.label,
        "added": (added and added[0]) or "",
        "effects": list(results.effects(name)),
        "floors": {axis: entry.noise_floor for axis, entry in axes.items()},
    }


def _read_each(versions: Sequence[_Version], kind: type[R]) -> list[R | None]:
    """Return a result of each model, None where it has none."""
    return [one.session.results.read(kind, one.model) for one in versions]


def _read_all(versions: Sequence[_Version], kind: type[R]) -> list[tuple[int, R]]:
    """Return a result of every model that has it, each with the number of the model."""
    return [(k, one) for k, one in enumerate(_read_each(versions, kind)) if one is not None]


def _list_maps(versions: Sequence[_Version]) -> list[Content]:
    found = []
    for number, diagnosis in _read_all(versions, DiagnoseResult):
        for axis, maps in diagnosis.maps.items():
            for variable, one in maps.items():
                band = one.model_dump(mode="json", include={"center", "mean", "low", "high"})
                about = {"model": number, "axis": axis, "variable": variable, **band}
                unit = format_unit(one.unit)
                found.append({**about, "unit": unit, "share": one.variance_share})
    return found


def _list_windows(versions: Sequence[_Version]) -> list[Content]:
    """Return the worst windows, those of the latest diagnosis first."""
    return [
        {
            **window.model_dump(),
            "model": number,
            "trial_id": versions[number].session.prefix + window.trial_id,
            "unit": format_unit(window.unit),
            "doing": format_prose(window.doing),
        }
        for number, diagnosis in reversed(_read_all(versions, DiagnoseResult))
        for window in diagnosis.worst_windows
    ]


def _list_verdicts(versions: Sequence[_Version]) -> list[Content]:
    """Return, by model and axis, the probability of each effect and what it rests on."""
    found = []
    for number, diagnosis in reversed(_read_all(versions, DiagnoseResult)):
        for axis, verdict in versions[number].session.results.order_axes(diagnosis.axes).items():
            names = {name: share for name, share in verdict.probabilities.items() if share > 0.0}
            effects = [
                _describe_effect(diagnosis, axis, name, share)
                for name, share in sorted(names.items(), key=lambda pair: -pair[1])
            ]
            about = {"model": number, "axis": axis, "sentence": strip_marks(verdict.sentence)}
            found.append({**about, "unknown": verdict.unknown, "effects": effects})
    return found


def _describe_effect(diagnosis: DiagnoseResult, axis: str, name: str, share: float) -> Content:
    ranked = (
        {**one.model_dump(mode="json"), "unit": format_unit(one.unit)}
        for one in diagnosis.ranking
        if (one.effect, one.axis) == (name, axis)
    )
    said = diagnosis.descriptions.get(name.partition(":")[0])
    sets = [
        {"effects": phrases.name_set(one), "probability": one.probability}
        for one in diagnosis.sets
        if name in one.effects
    ]
    about = {"ranked": next(ranked, None), "said": said and said.model_dump(mode="json")}
    return {"name": name, "probability": share, **about, "sets": sets}


def _list_errors(results: Results, versions: Sequence[_Version]) -> Content:
    """Return, by axis, held-out error and noise floor of each version, in their order."""
    ladder: Content = {}
    for axis in results.axes:
        found = [one and one.axes.get(axis) for one in _read_each(versions, ValidateResult)]
        shown = [{"error": e and e.held_out_rmse, "floor": e and e.noise_floor} for e in found]
        ladder |= {axis: shown} if any(found) else {}
    return ladder


def _list_parameters(results: Results, versions: Sequence[_Version]) -> list[Content]:
    identified = _read_each(versions, IdentifyResult)
    names = {name: p.unit for one in identified if one for name, p in one.parameters.items()}
    found = []
    for name in results.order_parameters(names):
        values = [one.parameters.get(name) if one else None for one in identified]
        shown = [
            v.model_dump(include={"estimate", "sd", "at_bound"}) if v else None for v in values
        ]
        found.append({"name": name, "unit": format_unit(names[name]), "values": shown})
    return found


def _list_correlations(versions: Sequence[_Version]) -> list[Content]:
    found = []
    for number, identified in _read_all(versions, IdentifyResult):
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


def _make_candidates(diagnosis: DiagnoseResult, label: str) -> Content:
    rows = [
        [
            *(entry.effect, entry.axis, entry.held_out_rmse_before, entry.held_out_rmse_after),
            *(format_unit(entry.unit), entry.probability, entry.p_value),
            ", ".join(entry.indistinguishable_from),
        ]
        for entry in diagnosis.ranking
    ]
    head = ["Effect", "Axis", "Without", "With", "Unit", "Probability", "p"]
    head.append("Indistinguishable from")
    note = (
        "Held-out error without and with each effect; the one that was not fitted is scaled by the "
        "weighted misfit. p: probability that replicates give any candidate as large a gain."
    )
    return {"title": f"Candidate effects, {label}", "note": note, "head": head, "rows": rows}
