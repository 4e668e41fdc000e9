"""Export of a recording as an .rrd file for the viewer Rerun."""

import numpy as np
from scipy.spatial.transform import Rotation

from bampipe.arrays import Array
from bampipe.data.readers.trial import need
from bampipe.declarations.recording import Recording


def pack_recording(recording: Recording) -> bytes:
    """Return the file: scalars of every axis, markers as a text log, the robot's links as lines.

    Raises:
        InputError: the library rerun is not installed.
    """
    rr = need("rerun", "rerun")
    stream = rr.RecordingStream("bampipe", recording_id=recording.name, send_properties=False)
    memory = stream.memory_recording()

    def clock(times: object) -> list[object]:
        return [rr.TimeColumn("time", duration=np.asarray(times, dtype=float))]

    for axis, (times, columns) in recording.signals.items():
        for name, values in columns.items():
            path = f"{axis}/residual/{name}" if name.startswith("residual") else f"{axis}/{name}"
            label = f"{name.replace('_', ' ')} ({recording.units[axis]})"
            stream.log(path, rr.SeriesLines(names=label), static=True)
            stream.send_columns(path, clock(times), rr.Scalars.columns(scalars=values))
    texts, levels = [m.text for m in recording.markers], ("INFO", "WARN")
    shown = rr.TextLog.columns(text=texts, level=[levels[m.warns] for m in recording.markers])
    stream.send_columns("markers", clock([m.time for m in recording.markers]), shown)
    if recording.frames:
        lines = _draw_links(recording)
        every = rr.LineStrips3D.columns(strips=list(lines.reshape(-1, 2, 3)))
        count = np.full(len(lines), lines.shape[1])
        stream.send_columns("robot", clock(recording.times), every.partition(count))
    if recording.urdf:
        stream.log("urdf", rr.TextDocument(recording.urdf), static=True)
    stream.flush()
    packed: bytes = memory.drain_as_bytes()
    return packed


def _draw_links(recording: Recording) -> Array:
    """Return lines from each link's frame to the next, in the root's frame, (n, joints, 2, 3)."""
    n = len(recording.times)
    placed: dict[str, tuple[Rotation, Array]] = {}
    lines = []
    for one in recording.frames:
        turn, place = placed.get(one.parent, (Rotation.identity(n), np.zeros((n, 3))))
        end = place + turn.apply(one.places)
        placed[one.child] = (turn * Rotation.from_quat(one.turns), end)
        lines.append(np.stack([place, end], axis=1))
    return np.stack(lines, axis=1)
