"""JSON: samples that are objects with named values, in a list or one a line.

A value inside another is named by its path: ``state.q[0]`` is the first item of ``q`` in ``state``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from bampipe.data.readers import moments
from bampipe.data.readers.trial import RawTrial, Wanted, check_columns
from bampipe.errors import InputError

_COSTS = {b"{": 184, b"[": 96, b",": 40, b"\n": 16}
"""Bytes of memory that each of these characters stands for once parsed (CPython 3.11)."""

_MOST_ITEMS = 64
_DEEPEST = 6


def read(path: Path, wanted: Wanted, name: str) -> RawTrial:
    """The wanted columns: a list of objects, a list under one key, or one object a line (.jsonl).

    Numbers beside that list are the same at every sample: a column for each of them.

    Raises:
        InputError: not JSON, no such list, a column missing or not of numbers.
    """
    samples, constants, notes = _samples(path, wanted.largest_bytes, name)
    values: dict[str, np.ndarray] = {c: np.empty(len(samples)) for c in wanted.columns}
    texts: dict[str, list[str | None]] = {column: [] for column in wanted.datetimes}
    for number, sample in enumerate(samples, 1):
        if not isinstance(sample, dict):
            raise InputError("not an object with named values", where=f"{name}, sample {number}")
        if number == 1:
            known = [*_names(sample), *(c for c in constants if c not in sample)]
            check_columns(known, wanted.columns, name)
        for column in wanted.columns:
            found, cell = _cell(sample, column)
            cell = cell if found else constants.get(column)
            where = f"{name}, sample {number}, '{column}'"
            if column in texts:
                if not isinstance(cell, str | None):
                    raise InputError(f"found {cell!r:.40}, expected a date and time", where=where)
                texts[column].append(cell)
            else:
                values[column][number - 1] = _number(cell, where)
    for column, cells in texts.items():
        where = f"{name}, '{column}'"
        stamps = moments.nanoseconds(cells, wanted.datetimes[column], where)
        values[column] = moments.seconds(stamps)
    return RawTrial(values, first_row=1, notes=notes)


def columns(path: Path, largest_bytes: int, name: str) -> dict[str, str]:
    """Names of the values that are numbers, or moments (unit "datetime"), in the first sample.

    Raises:
        InputError: as :func:`read`.
    """
    samples, constants, _ = _samples(path, largest_bytes, name)
    first = samples[0]
    if not isinstance(first, dict):
        raise InputError("not an object with named values", where=f"{name}, sample 1")
    found = {}
    for column in _names(first):
        _, cell = _cell(first, column)
        if isinstance(cell, int | float):
            found[column] = ""
        elif isinstance(cell, str) and re.match(r"\d{4}-\d\d-\d\d[T ]\d\d:", cell):
            found[column] = "datetime"
    return found | {c: "" for c in constants if c not in found}


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
        place = f" at line {error.lineno}" if isinstance(error, json.JSONDecodeError) else ""
        raise InputError(
            f"not sound JSON{place}", where=where, remedy="was the log cut off? copy it again"
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
    constants = {k: v for k, v in content.items() if isinstance(v, int | float)}
    return next(iter(lists.values())), constants


def _names(value: object, prefix: str = "", depth: int = 0) -> Iterator[str]:
    """Every value of a sample by its path, those of lists and objects too."""
    if isinstance(value, dict) and depth < _DEEPEST:
        for key, item in value.items():
            yield from _names(item, f"{prefix}.{key}" if prefix else str(key), depth + 1)
    elif isinstance(value, list) and prefix and len(value) <= _MOST_ITEMS and depth < _DEEPEST:
        for number, item in enumerate(value):
            yield from _names(item, f"{prefix}[{number}]", depth + 1)
    elif prefix:
        yield prefix


def _cell(sample: Mapping[str, object], column: str) -> tuple[bool, object]:
    """Whether the sample has the value ``column``, a key or a path, and the value."""
    if column in sample:
        return True, sample[column]
    value: object = sample
    for key, number in re.findall(r"([^.\[\]]+)|\[(\d+)\]", column):
        if key and isinstance(value, dict) and key in value:
            value = value[key]
        elif number and isinstance(value, list) and int(number) < len(value):
            value = value[int(number)]
        else:
            return False, None
    return True, value


def _number(cell: object, where: str) -> float:
    """A JSON value as a number: null is missing, true is 1."""
    if cell is None:
        return float("nan")
    if not isinstance(cell, int | float):
        raise InputError(f"found {str(cell)[:40]!r}, expected a number", where=where)
    try:
        return float(cell)
    except OverflowError as error:
        raise InputError("found a number beyond all range", where=where) from error
