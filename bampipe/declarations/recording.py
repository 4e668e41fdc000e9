"""A run as viewers of recordings show it: torques by every model, markers, and the robot."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from bampipe.arrays import Array
from bampipe.data.chain import read_tree
from bampipe.data.robot_tree import MOVING, Tree, identifier
from bampipe.data.run_folder import RunFolder
from bampipe.data.store import read_parquet
from bampipe.errors import InputError
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.ingest import IngestResult

DRAWING = "ingest/robot.xml"
"""The session's own URDF or MJCF."""
_BETWEEN_S = 0.5
"""Pause between the end of a trial and the start of the next."""
_POSES_HZ = 30.0


@dataclass(frozen=True)
class Marker:
    """A remark at an instant, s; ``warns`` if it needs attention."""

    time: float
    text: str
    warns: bool = False


@dataclass(frozen=True)
class Frame:
    """A link in the frame of its parent: places (n, 3), m, and quaternions x, y, z, w (n, 4)."""

    parent: str
    child: str
    places: Array
    turns: Array


@dataclass(frozen=True)
class Recording:
    """The trials of a session, one after another.

    Attributes:
        name: of the session; start: of its first trial, s since 1970, or 0.
        signals: by axis, the times (T,), s after the start, and columns (T,) by name: measured,
            then predicted and residual of each model version, N.m or N.
        units: units of these, by axis.
        markers: trials, worst windows and verdicts, in order of time.
        times: times of the poses, (n,), s; frames: links at these times, parents first; empty
            without a drawing.
        urdf: the drawing if it is a URDF, else "".
    """

    name: str
    start: float
    signals: Mapping[str, tuple[Array, Mapping[str, Array]]]
    units: Mapping[str, str]
    markers: tuple[Marker, ...]
    times: Array
    frames: tuple[Frame, ...]
    urdf: str


def gather_recording(run: RunFolder) -> Recording:
    """Gather the content of a run folder; raise `InputError` if no model has been validated."""
    session = run.read(IngestResult)
    models = run.models("residuals.parquet")
    if not models:
        remedy = f"run `bampipe validate {run.root}` first"
        raise InputError("no model has been validated yet", where=str(run.root), remedy=remedy)
    motion = read_parquet(run.require("filter/kinematics.parquet", "filter"))
    offsets, markers, at = {}, [], 0.0
    for trial, t in motion.groupby("trial_id", sort=False)["t"]:
        offsets[trial] = at - float(t.iloc[0])
        markers.append(Marker(at, f"trial {trial}"))
        at += float(t.iloc[-1] - t.iloc[0]) + _BETWEEN_S
    signals: dict[str, tuple[Array, dict[str, Array]]] = {}
    for model in models:
        rows = read_parquet(run.path(f"models/{model}/residuals.parquet"))
        rows = rows.iloc[np.argsort(_place_rows(rows, offsets), kind="stable")]
        times = _place_rows(rows, offsets)
        for axis in session.axes:
            if f"residual_{axis}" not in rows:
                continue
            kept, found = signals.setdefault(axis, (times, {}))
            measured = rows[f"torque_measured_{axis}"].to_numpy(dtype=float)
            residual = rows[f"residual_{axis}"].to_numpy(dtype=float)
            found.setdefault("measured", measured)
            name = re.sub(r"\W", "_", model)
            for what, values in (("predicted", measured - residual), ("residual", residual)):
                found[f"{what}_{name}"] = np.interp(kept, times, values)
        if run.exists(DiagnoseResult.file(model)):
            markers += _mark(run.read(DiagnoseResult, model), offsets)
    moment = datetime.fromisoformat(session.recorded_at) if session.recorded_at else None
    text, poses, frames = "", np.zeros(0), tuple[Frame, ...]()
    if run.exists(DRAWING):
        text = run.path(DRAWING).read_text(encoding="utf-8")
        poses, frames = _pose_links(read_tree(run.path(DRAWING)), motion, offsets)
    units = {axis: "N.m" if session.axes[axis].unit == "rad" else "N" for axis in signals}
    return Recording(
        name=run.root.name,
        start=max(moment.timestamp(), 0.0) if moment else 0.0,
        signals=signals,
        units=units,
        markers=tuple(sorted(markers, key=lambda one: one.time)),
        times=poses,
        frames=frames,
        urdf=text if "<robot" in text else "",
    )


def _place_rows(rows: pd.DataFrame, offsets: Mapping[str, float]) -> Array:
    return np.asarray(rows["t"] + rows["trial_id"].map(offsets), dtype=float)


def _mark(found: DiagnoseResult, offsets: Mapping[str, float]) -> list[Marker]:
    """Mark the verdicts on a model, and its worst windows."""
    markers = [
        Marker(0.0, f"{found.model}: {entry.sentence}", entry.verdict != "nothing_missing")
        for entry in found.axes.values()
    ]
    for w in found.worst_windows:
        text = f"{found.model}, {w.axis}: RMSE {w.rmse:.3g} {w.unit} for"
        text += f" {w.t_end - w.t_start:.2f} s, {w.doing}"
        markers.append(Marker(w.t_start + offsets.get(w.trial_id, 0.0), text, True))
    return markers


def _pose_links(
    tree: Tree, motion: pd.DataFrame, offsets: Mapping[str, float]
) -> tuple[Array, tuple[Frame, ...]]:
    """Return times, and links in their parents' frames; joints that are not logged stay at zero."""
    times = _place_rows(motion, offsets)
    step = max(1, round(1.0 / (_POSES_HZ * float(np.median(np.diff(times))))))
    times, motion = times[::step], motion.iloc[::step]
    q = {
        joint.name: motion[f"q_{name}"].to_numpy(dtype=float)
        for joint in tree.joints
        if f"q_{(name := identifier(joint.name))}" in motion
    }
    frames: list[Frame] = []
    for joint in sorted(tree.joints, key=lambda joint: len(tree.way(joint.parent))):
        at = q.get(joint.name, np.zeros(len(times)))
        if joint.mimic is not None and joint.mimic[0] in q:
            at = joint.mimic[1] * q[joint.mimic[0]] + joint.mimic[2]
        axis = np.asarray(joint.axis) / max(float(np.linalg.norm(joint.axis)), 1e-12)
        slides, turns = (MOVING.get(joint.kind) == kind for kind in ("prismatic", "revolute"))
        turned = Rotation.from_matrix(joint.turn) * Rotation.from_rotvec(np.outer(turns * at, axis))
        places = joint.offset + np.outer(slides * at, joint.turn @ axis)
        frames.append(Frame(joint.parent, joint.child, places, turned.as_quat()))
    return times, tuple(frames)
