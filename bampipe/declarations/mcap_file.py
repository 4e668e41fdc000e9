"""Export of a recording as an MCAP file with JSON messages, for Foxglove.

Source: mcap.dev, specification; docs.foxglove.dev, message schemas Log and FrameTransforms.
"""

import io
import json
from typing import Any

from bampipe.data.readers.trial import need
from bampipe.declarations.recording import Recording

_TIME = {"type": "object", "properties": {k: {"type": "integer"} for k in ("sec", "nsec")}}
_INFO, _WARNING = 2, 3
"""Levels of foxglove.Log."""


def pack_recording(recording: Recording) -> bytes:
    """Return the file: a topic per axis, /markers, and for a robot /tf and /robot_description.

    Raises:
        InputError: the library mcap is not installed.
    """
    stream = io.BytesIO()
    writer = need("mcap.writer", "ros").Writer(stream)
    writer.start(library="bampipe")

    def open_topic(topic: str, schema: str, fields: dict[str, Any], **metadata: str) -> int:
        described = {"type": "object", "properties": {"timestamp": _TIME, **fields}}
        number = writer.register_schema(schema, "jsonschema", json.dumps(described).encode())
        channel: int = writer.register_channel(topic, "json", number, metadata)
        return channel

    def stamp(time: float) -> int:
        return round(recording.start * 1e9) + round(time * 1e9)

    def add(channel: int, time: float, message: dict[str, Any]) -> None:
        at = stamp(time)
        message = {"timestamp": _split(at), **message}
        writer.add_message(channel, at, json.dumps(message, allow_nan=False).encode(), at)

    for axis, (times, columns) in recording.signals.items():
        fields = {name: {"type": "number"} for name in columns}
        channel = open_topic(f"/{axis}", f"bampipe.{axis}", fields, unit=recording.units[axis])
        for row in zip(times, *columns.values(), strict=True):
            values = zip(columns, row[1:], strict=True)
            add(channel, row[0], {name: float(x) for name, x in values if x == x})
    fields = {name: {"type": "string"} for name in ("message", "name", "file")}
    fields |= {name: {"type": "integer"} for name in ("level", "line")}
    channel = open_topic("/markers", "foxglove.Log", fields)
    for marker in recording.markers:
        message = {"level": _WARNING if marker.warns else _INFO, "message": marker.text}
        add(channel, marker.time, {**message, "name": recording.name, "file": "", "line": 0})
    if recording.frames:
        _add_poses(recording, open_topic, add, stamp)
    if recording.urdf:
        text = {"data": {"type": "string"}}
        channel = open_topic("/robot_description", "std_msgs/String", text)
        add(channel, 0.0, {"data": recording.urdf})
        data = recording.urdf.encode()
        writer.add_attachment(stamp(0.0), stamp(0.0), "robot.urdf", "application/xml", data)
    writer.finish()
    return stream.getvalue()


def _split(nanoseconds: int) -> dict[str, int]:
    return dict(zip(("sec", "nsec"), divmod(nanoseconds, 10**9), strict=True))


def _add_poses(recording: Recording, open_topic: Any, add: Any, stamp: Any) -> None:
    number, text = {"type": "number"}, {"type": "string"}
    transform = {
        "timestamp": _TIME, "parent_frame_id": text, "child_frame_id": text,
        "translation": {"type": "object", "properties": dict.fromkeys("xyz", number)},
        "rotation": {"type": "object", "properties": dict.fromkeys("xyzw", number)},
    }  # fmt: skip
    fields = {"transforms": {"type": "array", "items": {"type": "object", "properties": transform}}}
    channel = open_topic("/tf", "foxglove.FrameTransforms", fields)
    for k, time in enumerate(recording.times):
        at = _split(stamp(time))
        transforms = [
            {
                "timestamp": at, "parent_frame_id": one.parent, "child_frame_id": one.child,
                "translation": dict(zip("xyz", one.places[k].tolist(), strict=True)),
                "rotation": dict(zip("xyzw", one.turns[k].tolist(), strict=True)),
            }
            for one in recording.frames
        ]  # fmt: skip
        add(channel, time, {"transforms": transforms})
