"""Data sets of LeRobot (v2.0 to v3.0): which rows are an episode, and what elements are called.

``meta/info.json`` names the elements of the vector columns; ``data/chunk-*/*.parquet`` holds one
episode or many a file, in the order of their rows. Element ``elbow.pos`` of ``observation.state``
is the column ``observation.state.elbow.pos``; element 3 of a vector without names is
``observation.state[3]``, in any other Parquet file, too. Videos are left alone.
Source: huggingface/lerobot, ``src/lerobot/datasets/utils.py``.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow import dataset

from bampipe.data.readers.arrays import LARGEST_WIDTH
from bampipe.data.refusals import refusal
from bampipe.errors import InputError
from bampipe.files import read_json_table

INFO = "meta/info.json"
EPISODE = "episode_index"
NO_READINGS = ("frame_index", EPISODE, "index", "task_index")
"""Columns with the number of a row, an episode or a task."""
STATE = "observation.state"
_LATEST_S = 1.0
"""Longest lag behind a goal that is looked for."""


def find_episodes(folder: Path, episodes: str = "") -> dict[str, list[int]] | None:
    """Find the wanted episodes of the data set in ``folder``; None if it is none of LeRobot.

    Args:
        folder: that holds ``meta`` and ``data``.
        episodes: those that are wanted, as ``0:20``, ``5:`` or ``7``; all where empty.

    Returns:
        By relative path of a file, their places in it, from 1 on; files without any are left out.

    Raises:
        InputError: no such episodes, no data, or a file is damaged; or ``episodes`` of a folder
            that is no data set.
    """
    if not _features(folder):
        if episodes:
            raise refusal("no_lerobot", str(folder), info=INFO)
        return None
    found = {}
    for path in sorted(folder.glob("data/*/*.parquet")):
        try:
            column = pq.read_table(path, columns=[EPISODE]).column(0).to_numpy()
        except (pa.ArrowException, OSError, IndexError) as error:
            raise refusal("no_episodes", str(path), column=EPISODE) from error
        starts = [0, *_changes(column)] if len(column) else []
        found[path.relative_to(folder).as_posix()] = [int(column[at]) for at in starts]
    known = sorted(number for numbers in found.values() for number in numbers)
    match = re.fullmatch(r"(?:(\d*):(\d*)|(\d+))", episodes or ":")
    first, end = 0, 0
    if match is not None:
        first = int(match[3] or match[1] or 0)
        end = first + 1 if match[3] else int(match[2] or 1 + max(known, default=-1))
    places = {
        file: [k for k, number in enumerate(numbers, 1) if first <= number < end]
        for file, numbers in found.items()
    }
    if not any(places.values()):
        what = f"no episode {episodes}" if episodes else "no episode in data/*/*.parquet"
        remedy = f"it has {known[0]} to {known[-1]}: --episodes 0:20" if known else ""
        raise InputError(what, where=str(folder), remedy=remedy)
    return {file: own for file, own in places.items() if own}


def episodes_begin(path: Path) -> tuple[int, ...]:
    """Rows of a file from which on another episode stands; none outside of a data set."""
    if not _features_of(path):
        return ()
    return _changes(pq.read_table(path, columns=[EPISODE]).column(0).to_numpy())


def _changes(numbers: np.ndarray) -> tuple[int, ...]:
    return tuple(int(at) for at in np.flatnonzero(np.diff(numbers)) + 1)


def vector_columns(
    path: Path, schema: pa.Schema, file: dataset.Dataset
) -> dict[str, tuple[str, int]]:
    """The column and the place in it of every element of vectors of numbers, by its name."""
    features = _features_of(path)
    found = {}
    for field in schema:
        kind = field.type
        if not (pa.types.is_fixed_size_list(kind) or pa.types.is_list(kind)):
            continue
        if not (pa.types.is_floating(kind.value_type) or pa.types.is_integer(kind.value_type)):
            continue
        named = _names(features.get(field.name, {}))
        size = kind.list_size if pa.types.is_fixed_size_list(kind) else len(named)
        if not size:
            first = file.head(1, columns=[field.name]).column(0).to_pylist()
            size = len((first or [()])[0] or ())
        names = [f".{name}" for name in named] if len({*named}) == len(named) == size else []
        for place in range(size if size <= LARGEST_WIDTH else 0):  # else a trial in each
            found[field.name + (names[place] if names else f"[{place}]")] = (field.name, place)
    return found


def describe_loops(t: np.ndarray, columns: Mapping[str, np.ndarray]) -> str:
    """Say how late every joint of a data set follows its goal; "" if it has no joints.

    ``t``: time stamps of an episode, (T,), s; ``columns``: of it by name, each (T,).
    """
    said = []
    for name, state in columns.items():
        joint = name.removeprefix(STATE)
        goal = columns.get(f"action{joint}")
        if goal is None or joint == name or np.ptp(goal) == 0.0:
            continue
        late = np.arange(0.0, _LATEST_S, 0.2 * float(np.median(np.diff(t))))
        inner = t > t[0] + _LATEST_S
        left = [np.std((state - np.interp(t - by, t, goal))[inner]) for by in late]
        lag = float(late[int(np.argmin(left))])
        band = f", as a first-order lag of {0.159 / lag:.2g} Hz" if lag else ""
        said.append(f"{joint.strip('.')} {lag:.2f} s{band}")
    return "; ".join(said)


def _features_of(path: Path) -> dict[str, Any]:
    """The features of the data set that a file is of, none where it is of none."""
    return _features(path.parents[2]) if path.parent.parent.name == "data" else {}


def _features(folder: Path) -> dict[str, Any]:
    path = folder / INFO
    info = read_json_table(path) if path.is_file() else {}
    features = info.get("features")
    return features if "codebase_version" in info and isinstance(features, dict) else {}


def _names(feature: Mapping[str, Any]) -> list[str]:
    """Names of the elements: a list, or lists by what they are of, as ``motors``."""
    names = feature.get("names") or ()
    if isinstance(names, dict):
        names = [name for group in names.values() if isinstance(group, list) for name in group]
    return [str(name) for name in names]
