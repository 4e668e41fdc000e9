"""ROS bags (1 and 2) and MCAP files, by rosbags and mcap (the extra ``bampipe[ros]``).

A column is ``/topic:field``, where the field is a path in the message:
``/joint_states:position[0]``, ``/joint_states:position[elbow]`` (by the message's list ``name``),
``/wrench:wrench.force.x``.
``/topic:@time`` is when the message was recorded, ``/topic:header.stamp`` when it was stamped; both
are returned in s since the first. The topic of the time column gives the samples; columns of other
topics are interpolated linearly at its times.

``/log:q[:]`` are all items of a list one after the other, for messages that hold many samples;
``/log:t[:]`` their times, if there are any, else they are spread evenly over the time to the next
message. Several nodes may publish on a topic: messages with other names, or with other lists left
empty, are a stream of their own, and a column is taken from that with most of what is wanted.
"""

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bampipe.data.readers import moments, trial
from bampipe.data.readers.nested import MISSING, as_number, find, items, leaves, names_in, spread
from bampipe.data.readers.trial import RawTrial, Wanted, check_columns, check_size, need
from bampipe.data.refusals import refusal
from bampipe.errors import InputError

RECORDED = "@time"
STAMP = "header.stamp"
_LISTS = ("position", "velocity", "effort")
"""Lists that may be empty in a message with names of joints."""


class Field(NamedTuple):
    """One number of the messages of a topic, by its path, such as ``position[elbow]``."""

    topic: str
    path: str

    @property
    def is_time(self) -> bool:
        """Whether it says when the message was recorded or stamped."""
        return self.path in (RECORDED, STAMP)


@dataclass(eq=False)
class _Stream:
    """The messages of one kind on a topic.

    Attributes:
        topic: name of the topic.
        recorded, stamped: times of the messages, ns.
        cells: numbers by column, for the columns that these messages have.
        counts: samples in each message.
    """

    topic: str
    recorded: list[int] = field(default_factory=list)
    stamped: list[int | None] = field(default_factory=list)
    cells: dict[str, list[float]] = field(default_factory=dict)
    counts: list[int] = field(default_factory=list)

    def add(self, moment: int, message: Any) -> None:
        self.recorded.append(moment)
        self.stamped.append(_stamp(message))
        found = {column: items(message, column.partition(":")[2]) for column in self.cells}
        count = max(map(len, found.values()), default=1)
        for column, values in found.items():
            where = f"column '{column}', message {len(self.recorded)}"
            if any(value is MISSING for value in values) or len(values) not in (1, count):
                raise InputError("no such field in this message, or a shorter list", where=where)
            numbers = [as_number(value, where) for value in values]
            self.cells[column] += numbers * count if len(numbers) < count else numbers
        self.counts.append(count)

    def times(self, clock: Field, leads: bool) -> np.ndarray:
        """Times of all samples (T,), ns, by the clock that the time column names if it has that."""
        known = [moment for moment in self.stamped if moment is not None]
        lost = len(self.stamped) - len(known)
        if lost and leads and clock.path == STAMP:
            raise refusal("no_stamp", f"topic {clock.topic}", lost=lost, topic=clock.topic)
        stamps = known if clock.path == STAMP and not lost else self.recorded
        times, counts = np.array(stamps, dtype=np.int64), np.array(self.counts)
        if len(counts) < 2 or counts.max() == 1:
            return np.repeat(times, counts)
        step = float(np.median(np.diff(times))) / float(np.median(counts))
        within = np.concatenate([np.arange(count) for count in counts])
        return np.repeat(times, counts) + np.rint(step * within).astype(np.int64)


def read(path: Path, wanted: Wanted) -> RawTrial:
    """The wanted fields at the times of the first column, which is the time.

    Raises:
        InputError: a library is not installed, the file is damaged, a topic or field is missing or
            not a number.
    """
    fields = {column: _field(column) for column in wanted.columns}
    clock_column, clock = next(iter(fields.items()))
    streams = _read_streams(path, fields, wanted)
    if not (clock.is_time or "[:]" in clock.path or "::" in clock.path):
        raise refusal("no_time", f"column '{clock_column}'", topic=clock.topic)
    # The stream that has most of the columns, then most messages, comes first.
    ranked = sorted(streams, key=lambda s: (-len(s.cells), -len(s.recorded)))
    of = {c: next(s for s in ranked if c in s.cells) for c, f in fields.items() if not f.is_time}
    # The stream of most columns on the topic of the time gives the samples.
    here = [of[c] for c, f in fields.items() if f.topic == clock.topic and not f.is_time]
    alike = [stream for stream in streams if stream.topic == clock.topic]
    leading = max(here or alike, key=lambda s: (here.count(s), len(s.recorded)))
    of |= {column: leading for column, field in fields.items() if field.is_time}
    times = {s: s.times(clock, s is leading) for s in dict.fromkeys(of.values())}
    base = times[leading]
    values = {}
    for column, each in fields.items():
        stream = of[column]
        found = moments.seconds(base) if each.is_time else np.array(stream.cells[column], float)
        if stream is not leading:
            at, since = ((x - base[0]) / moments.NANOSECONDS for x in (base, times[stream]))
            found = trial.interpolated(at, since, found)
        values[column] = found
    remarks = [_left_out(topic, streams, times) for topic in {s.topic for s in times}]
    for stream in times:
        if stream is not leading:
            gap = float(np.max(np.diff(times[stream]), initial=0)) / moments.NANOSECONDS
            remarks.append(
                f"{stream.topic} interpolated linearly at the times of {clock.topic}"
                f" (at most {gap:.3g} s between its messages)"
            )
    return RawTrial(values, np.arange(1, 1 + len(base)), remarks=tuple(filter(None, remarks)))


def _read_streams(path: Path, fields: Mapping[str, Field], wanted: Wanted) -> list[_Stream]:
    """The messages by topic and kind, with the fields that each kind has."""
    topics = tuple(dict.fromkeys(field.topic for field in fields.values()))
    streams: dict[tuple[Any, ...], _Stream] = {}
    samples, near = 0, ""
    for topic, moment, message in _messages(path, topics):
        kind = _kind(message)
        stream = streams.get((topic, kind))
        if stream is None:
            stream = streams[topic, kind] = _Stream(topic)
            asked = [c for c, f in fields.items() if f.topic == topic and not f.is_time]
            there = {c: items(message, fields[c].path) for c in asked}
            stream.cells = {c: [] for c, v in there.items() if v and v[0] is not MISSING}
            near = near or ", ".join(path for path in _numbers_in(message) if path != STAMP)
        stream.add(moment, message)
        samples += stream.counts[-1]
        check_size(samples, wanted)
    for column, each in fields.items():
        if not each.is_time and all(column not in s.cells for s in streams.values()):
            raise refusal("field_missing", f"column '{column}'", path=each.path, near=near)
    return list(streams.values())


def _kind(message: Any) -> tuple[Any, ...]:
    """Names and empty lists, which distinguish the messages of one publisher from another's."""
    names = names_in(message)
    lists = {key: find(message, key) for key in _LISTS} if names else {}
    empty = (key for key, found in lists.items() if found is MISSING or len(found) == 0)
    return (*sorted(names), "", *empty)


def _left_out(topic: str, streams: list[_Stream], used: Collection[_Stream]) -> str:
    """Sentence on the messages of a topic that are not used."""
    here = [stream for stream in streams if stream.topic == topic]
    unused = [stream for stream in here if stream not in used]
    count, total = (sum(len(s.recorded) for s in part) for part in (unused, here))
    if not count:
        return ""
    return (
        f"{len(here)} kinds of messages on {topic}, as of several publishers: {count} of {total}"
        f" with other names or empty lists are left out"
    )


def columns(path: Path) -> dict[str, str]:
    """Names of the numbers in the first message of each kind; times have the unit s."""
    found: dict[str, str] = {}
    seen: set[tuple[Any, ...]] = set()
    for topic, _, message in _messages(path, ()):
        key = (topic, _kind(message))
        if key in seen:
            continue
        seen.add(key)
        found[f"{topic}:{RECORDED}"] = "s"
        for leaf in [*_numbers_in(message), *spread(message)]:
            found[f"{topic}:{leaf}"] = "s" if leaf == STAMP else ""
    return found


def _numbers_in(message: Any) -> dict[str, None]:
    """Paths of the numbers in a message, its time stamp as one of them."""
    numbers = (path for path, leaf in leaves(message) if isinstance(leaf, int | float | np.number))
    return {STAMP if path.startswith(f"{STAMP}.") else path: None for path in numbers}


def _stamp(message: Any) -> int | None:
    """Time stamp in a message, ns since 1970; None if it has none."""
    sec, nanosec, nsec = (find(message, f"{STAMP}.{key}") for key in ("sec", "nanosec", "nsec"))
    nanosec = nsec if nanosec is MISSING else nanosec
    if not isinstance(sec, int | np.integer) or not isinstance(nanosec, int | np.integer):
        return None
    return int(sec) * moments.NANOSECONDS + int(nanosec)


def _field(column: str) -> Field:
    topic, colon, path = column.partition(":")
    if not colon or not path:
        raise refusal("no_field", column=column)
    return Field(topic, path)


def _messages(path: Path, topics: Sequence[str]) -> Iterator[tuple[str, int, Any]]:
    """Topic, time of recording (ns) and message, in the order of recording; all if no topics.

    InputError where a library or a topic is missing, or the file is damaged.
    """
    highlevel = need("rosbags.highlevel", "ros")
    if path.suffix.lower() == ".mcap":
        with path.open("rb") as stream:
            source = need("mcap.reader", "ros").make_reader(stream)
            summary = source.get_summary()
            channels = summary.channels.values() if summary else ()
            in_json = {c.topic for c in channels if c.message_encoding == "json"}
            if in_json:
                check_columns(sorted(in_json), topics)
                for _, channel, message in source.iter_messages(topics=list(topics) or None):
                    if channel.topic in in_json:
                        yield channel.topic, message.log_time, json.loads(message.data)
                return
    types = need("rosbags.typesys", "ros")
    standard = types.get_typestore(types.Stores.LATEST)  # ROS 2 did not always record them
    with highlevel.AnyReader([path], default_typestore=standard) as reader:
        check_columns(sorted(reader.topics), topics)
        chosen = [c for c in reader.connections if not topics or c.topic in topics]
        if not chosen:
            raise InputError("holds no messages")
        for connection, moment, raw in reader.messages(connections=chosen):
            yield connection.topic, moment, reader.deserialize(raw, connection.msgtype)
