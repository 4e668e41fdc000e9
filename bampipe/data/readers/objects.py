"""JSON: samples that are objects with named values, in a list or one a line.

A value inside another is named by its path: ``state.q[0]`` is the first item of ``q`` in ``state``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bampipe.data.readers import moments
from bampipe.data.readers.nested import MISSING, as_number, find, leaves
from bampipe.data.readers.trial import LARGEST_BYTES, RawTrial, Wanted, check_columns
from bampipe.errors import InputError

_COSTS = {b"{": 184, b"[": 96, b",": 40, b"\n": 16}
"""Bytes of memory that each of these characters stands for once parsed (CPython 3.11)."""


def read(path: Path, wanted: Wanted, name: str) -> RawTrial:
    """The wanted columns: a list of objects, a list under one key, or one object a line (.jsonl).

    Numbers beside that list are the same at every sample: a column for each of them.

    Raises:
        InputError: not JSON, no such list, a column missing or not of numbers.
    """
    samples, constants, notes = _samples(path, wanted.largest_bytes, name)
    first = _first(samples, name)
    fixed = {column for column in wanted.columns if find(first, column) is MISSING}
    for column in fixed - set(constants):
        check_columns([path for path, _ in leaves(first)] + list(constants), [column], name)
    values: dict[str, np.ndarray] = {c: np.empty(len(samples)) for c in wanted.columns}
    texts: dict[str, list[str | None]] = {column: [] for column in wanted.datetimes}
    for count, sample in enumerate(samples, 1):
        if not isinstance(sample, dict):
            raise InputError("not an object with named values", where=f"{name}, sample {count}")
        for column in wanted.columns:
            cell = constants[column] if column in fixed else find(sample, column)
            cell = None if cell is MISSING else cell
            where = f"{name}, sample {count}, '{column}'"
            if column in texts:
                if not isinstance(cell, str | None):
                    raise InputError(f"found {cell!r:.40}, expected a date and time", where=where)
                texts[column].append(cell)
            else:
                values[column][count - 1] = as_number(cell, where)
    for column, cells in texts.items():
        where = f"{name}, '{column}'"
        stamps = moments.nanoseconds(cells, wanted.datetimes[column], where)
        values[column] = moments.seconds(stamps)
    return RawTrial(values, first_row=1, notes=notes)


def columns(path: Path, name: str) -> dict[str, str]:
    """Names of the values that are numbers, or moments (unit "datetime"), in the first sample.

    Raises:
        InputError: as :func:`read`.
    """
    samples, constants, _ = _samples(path, LARGEST_BYTES, name)
    found = {}
    for column, cell in leaves(_first(samples, name)):
        if isinstance(cell, int | float):
            found[column] = ""
        elif isinstance(cell, str) and moments.is_moment(cell):
            found[column] = "datetime"
    return found | {c: "" for c in constants if c not in found}


def _first(samples: list[object], name: str) -> dict[str, object]:
    if not isinstance(samples[0], dict):
        raise InputError("not an object with named values", where=f"{name}, sample 1")
    return samples[0]


def _samples(
    path: Path, largest_bytes: int, name: str
) -> tuple[list[object], Mapping[str, object], tuple[str, ...]]:
    """Samples of a file, the numbers beside them, and what was left out."""
    size = 3 * path.stat().st_size
    if size <= largest_bytes:
        data = path.read_bytes()
        size = (3 if data.isascii() else 10) * len(data)
        size += sum(cost * data.count(character) for character, cost in _COSTS.items())
    if size > largest_bytes:
        raise InputError(
            f"a JSON text that unpacks to {size >> 20} MB, where {largest_bytes >> 20} MB are"
            " allowed",
            where=name,
            remedy="log to CSV or Parquet, or allow more (largest_trial_mb)",
        )
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError("not UTF-8 text", where=name, remedy="save it as UTF-8") from error
    del data
    constants: Mapping[str, object] = {}
    notes: tuple[str, ...] = ()
    if path.suffix.lower() in (".jsonl", ".ndjson"):
        lines = [line for line in text.splitlines() if line.strip()]
        samples = [_parsed(x, f"{name}, sample {n}") for n, x in enumerate(lines[:-1], 1)]
        try:
            samples += [_parsed(x, f"{name}, sample {len(lines)}") for x in lines[-1:]]
        except InputError:
            if text.endswith("\n"):
                raise
            notes = ("last line is cut off: 1 row dropped",)
    else:
        samples, constants = _list_of_samples(_parsed(text, name), name)
    if not samples:
        raise InputError("a header but no samples", where=name)
    return samples, constants, notes


def _parsed(text: str, where: str) -> object:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        line = f" at line {error.lineno}" if isinstance(error, json.JSONDecodeError) else ""
        raise InputError(
            f"not sound JSON{line}", where=where, remedy="was the log cut off? copy it again"
        ) from error


def _list_of_samples(content: object, name: str) -> tuple[list[object], dict[str, object]]:
    """Samples of a parsed file, and the numbers beside them."""
    if isinstance(content, list):
        return content, {}
    content = content if isinstance(content, dict) else {}
    lists = {
        key: value
        for key, value in content.items()
        if isinstance(value, list) and value and isinstance(value[0], dict)
    }
    if len(lists) != 1:
        raise InputError(
            f"{len(lists)} lists of samples: {', '.join(lists)}"
            if lists
            else "no list of samples, that is of objects with named values",
            where=name,
        )
    constants: dict[str, object] = {
        key: value for key, value in content.items() if isinstance(value, int | float)
    }
    return next(iter(lists.values())), constants
