"""LabVIEW TDMS files, by npTDMS (the extra ``bampipe[tdms]``).

A column is ``Group/Channel``; ``Group/Channel@time`` is the time of its samples, s, as its waveform
properties give it, for files without a time channel.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from bampipe.data.readers import moments
from bampipe.data.readers.trial import RawTrial, Wanted, aligned, check_columns, check_size, need
from bampipe.errors import InputError

TIME = "@time"


def read(path: Path, wanted: Wanted, name: str) -> RawTrial:
    """The wanted channels of a TDMS file, scaled as the file says.

    Raises:
        InputError: npTDMS is not installed, the file is damaged, a channel is missing, not of
            numbers, or not as long as the others.
    """
    values: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    with _channels(path, name) as known:
        timed = [label + TIME for label, channel in known.items() if _increment(channel)]
        check_columns([*known, *timed], wanted.columns, name)
        for column in wanted.columns:
            channel = known[column.removesuffix(TIME)]
            check_size(len(channel), wanted, name)
            if column not in known:
                values[column] = np.asarray(channel.time_track(), dtype=np.float64)
                continue
            where = f"{name}, channel '{column}'"
            values[column] = _values(channel, wanted.datetimes.get(column), where)
            units |= {column: _unit(channel)} if _unit(channel) else {}
    return RawTrial(aligned(values, name, "channel"), first_row=1, units=units)


def columns(path: Path, name: str) -> dict[str, str]:
    """Names and units of the channels of numbers, moments (unit "datetime") and waveform times."""
    found = {}
    with _channels(path, name) as known:
        for label, channel in known.items():
            if channel.dtype.kind == "M":
                found[label] = "datetime"
            elif channel.dtype.kind in "iufb" and len(channel):
                found[label] = _unit(channel)
                if _increment(channel):
                    found[label + TIME] = "s"
    return found


@contextmanager
def _channels(path: Path, name: str) -> Iterator[dict[str, Any]]:
    """The channels of a file, by npTDMS, which would print pages about a damaged one."""
    library = need("nptdms", "tdms", name)
    need("nptdms.log", "tdms", name).log_manager.set_level(logging.CRITICAL)
    # A stream: by its path, npTDMS would take an index file beside it for the truth.
    with path.open("rb") as stream, library.TdmsFile.open(stream) as file:
        yield {f"{g.name}/{c.name}": c for g in file.groups() for c in g.channels()}


def _increment(channel: Any) -> bool:
    """Whether the channel says how far apart its samples are."""
    step = channel.properties.get("wf_increment", 0.0)
    return isinstance(step, int | float) and step > 0.0


def _unit(channel: Any) -> str:
    return str(channel.properties.get("unit_string", "")).strip()


def _values(channel: Any, form: str | None, where: str) -> np.ndarray:
    data = np.asarray(channel[:])
    if form is not None:
        if data.dtype.kind not in "MOU":
            raise InputError("not text, expected dates and times", where=where)
        stamps = data if data.dtype.kind == "M" else [str(x) for x in data]
        return moments.seconds(moments.nanoseconds(stamps, form, where))
    if data.dtype.kind not in "iufb":
        stamped = data.dtype.kind == "M"
        raise InputError(
            "holds dates and times, expected numbers" if stamped else "not numbers",
            where=where,
            remedy='is it the time? then say unit = "datetime" under [time]' if stamped else "",
        )
    return data.astype(np.float64)
