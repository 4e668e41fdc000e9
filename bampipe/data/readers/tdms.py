"""LabVIEW TDMS files, by npTDMS (the extra ``bampipe[tdms]``).

A column is ``Group/Channel``; ``Group/Channel@time`` is the time of its samples, s, as its waveform
properties give it, for files without a time channel.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bampipe.data.readers.arrays import TIME, ArrayReader, Opened, Stored
from bampipe.data.readers.trial import Wanted, need


@contextmanager
def _opened(path: Path, _: Wanted | None) -> Iterator[Opened]:
    """The channels of a file, scaled as it says, by npTDMS, which would print pages on damage."""
    library = need("nptdms", "tdms")
    need("nptdms.log", "tdms").log_manager.set_level(logging.CRITICAL)
    found: dict[str, Stored] = {}
    # A stream: by its path, npTDMS would take an index file beside it for the truth.
    with path.open("rb") as stream, library.TdmsFile.open(stream) as file:
        for channel in (channel for group in file.groups() for channel in group.channels()):
            label, shape = f"{channel.group_name}/{channel.name}", (len(channel),)
            unit = str(channel.properties.get("unit_string", "")).strip()
            found[label] = Stored(shape, channel.dtype.kind, partial(_read, channel), unit)
            step = channel.properties.get("wf_increment", 0.0)
            if isinstance(step, int | float) and step > 0.0:
                found[label + TIME] = Stored(shape, "f", channel.time_track, "s")
        yield found, ()


def _read(channel: Any) -> np.ndarray:
    data = np.asarray(channel[:])
    return data.astype(object) if data.dtype.kind == "U" else data


READER = ArrayReader("channel", _opened)
