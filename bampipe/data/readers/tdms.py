"""LabVIEW TDMS files, by npTDMS (the extra ``bampipe[tdms]``).

A column is ``Group/Channel``; ``Group/Channel@time`` is the time of its samples, s, as its waveform
properties give it, for files without a time channel.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bampipe.data.readers.arrays import read_arrays
from bampipe.data.readers.trial import RawTrial, Wanted, check_columns, check_size, need

TIME = "@time"


def read(path: Path, wanted: Wanted, name: str) -> RawTrial:
    """The wanted channels of a TDMS file, scaled as the file says.

    Raises:
        InputError: npTDMS is not installed, the file is damaged, a channel is missing, not of
            numbers, or not as long as the others.
    """
    arrays: dict[str, np.ndarray | None] = {}
    units: dict[str, str] = {}
    with _channels(path, name) as known:
        timed = [label + TIME for label, channel in known.items() if _increment(channel)]
        check_columns([*known, *timed], wanted.columns, name)
        for column in wanted.columns:
            channel = known[column.removesuffix(TIME)]
            check_size(len(channel), wanted, name)
            if column not in known:
                arrays[column] = np.asarray(channel.time_track(), dtype=np.float64)
                continue
            data = np.asarray(channel[:])
            data = data.astype(object) if data.dtype.kind == "U" else data
            arrays[column] = data if data.dtype.kind in "iufbMO" else None
            units |= {column: _unit(channel)} if _unit(channel) else {}
    return replace(read_arrays(arrays, wanted, name, "channel"), units=units)


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
