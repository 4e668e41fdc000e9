"""JSON: samples that are objects with named values, in a list or one a line; or arrays.

A value inside another is named by its path: ``state.q[0]`` is the first item of ``q`` in ``state``.
Arrays are columns, those of rows a column each, as in MATLAB files: ``data[0]``; where a list of
as many names stands beside them, they have these.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from bampipe.data.readers import moments
from bampipe.data.readers.arrays import join_runs, pick, recorded, split_index
from bampipe.data.readers.nested import MISSING, as_number, find, leaves
from bampipe.data.readers.trial import RawTrial, Wanted, aligned, check_columns
from bampipe.errors import InputError


def read(path: Path, wanted: Wanted, name: str) -> RawTrial:
    """The wanted columns: a list of objects, a list under one key, or one object a line (.jsonl).

    Numbers beside that list are the same at every sample: a column for each of them.

    Raises:
        InputError: not JSON, no such list, a column missing or not of numbers.
    """
    samples, constants, notes = _samples(path, name)
    if isinstance(samples, dict):
        return _from_arrays(samples, constants, wanted, notes, name)
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
    samples, constants, _ = _samples(path, name)
    if isinstance(samples, dict):
        joined = join_runs(samples)[0]
        shapes = {column: values.shape for column, values in joined.items()}
        moment = {column for column, values in joined.items() if values.dtype == object}
        kept = {column: "datetime" if column in moment else "" for column in recorded(shapes)}
        return kept | dict.fromkeys(constants, "")
    found = {}
    for column, cell in leaves(_first(samples, name)):
        if isinstance(cell, int | float):
            found[column] = ""
        elif isinstance(cell, str) and moments.is_moment(cell):
            found[column] = "datetime"
    return found | {c: "" for c in constants if c not in found}


def stated_units(path: Path, name: str) -> dict[str, str]:
    """Units stated beside the samples, such as ``"force units": "kip"``, by quantity."""
    content = _parsed(path.read_text(encoding="utf-8-sig"), name)
    items = content.items() if isinstance(content, dict) else ()
    parts = [(re.split(r"[ _]units?$", str(key), flags=re.I), value) for key, value in items]
    return {key[0]: value for key, value in parts if len(key) > 1 and isinstance(value, str)}


def _first(samples: list[object], name: str) -> dict[str, object]:
    if not isinstance(samples[0], dict):
        raise InputError("not an object with named values", where=f"{name}, sample 1")
    return samples[0]


def _from_arrays(
    arrays: Mapping[str, np.ndarray],
    constants: Mapping[str, object],
    wanted: Wanted,
    notes: tuple[str, ...],
    name: str,
) -> RawTrial:
    """The wanted columns of arrays."""
    values = {}
    arrays, begun = join_runs(arrays)
    for column in wanted.columns:
        where = f"{name}, '{column}'"
        if column in constants:
            values[column] = np.array([as_number(constants[column], where)])
            continue
        label, index = split_index(column, arrays)
        check_columns([*arrays, *constants], [label], name)
        if column in wanted.datetimes:
            stamps = moments.nanoseconds(arrays[label].tolist(), wanted.datetimes[column], where)
            values[column] = moments.seconds(stamps)
        elif arrays[label].dtype == object:
            raise InputError("found text, expected numbers", where=where)
        else:
            values[column] = pick(arrays[label], index, where)
    starts = next((begun[column] for column in wanted.columns if column in begun), ())
    return RawTrial(aligned(values, name, "array"), first_row=1, notes=notes, begun=starts)


def _arrays(value: object, path: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Arrays (T,) or (T, k) of numbers, or (T,) of moments, in a parsed text, by their paths."""
    if isinstance(value, dict):
        for key, item in value.items():
            names = [
                other for other in value.values() if isinstance(other, list) and _are_names(other)
            ]
            inner = f"{path}.{key}" if path else str(key)
            for label, array in _arrays(item, inner):
                width = array.shape[-1] if array.ndim == 2 else 0
                called = next((n for n in names if len(n) == width), None)
                if label == inner and called:
                    yield from zip(called, array.T, strict=True)
                else:
                    yield label, array
    elif isinstance(value, list) and len(value) > 1:
        if isinstance(value[0], dict):
            for k, item in enumerate(value):
                yield from _arrays(item, f"{path}[{k}]")
            return
        if isinstance(value[0], str):
            if moments.is_moment(value[0]) and all(isinstance(x, str | None) for x in value):
                yield path, np.array(value, dtype=object)
            return
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError):  # ragged, or with other things in it
            return
        if array.ndim <= 2 and array.size:
            yield path or "data", array


def _are_names(values: list[object]) -> bool:
    texts = [value for value in values if isinstance(value, str) and value]
    return bool(texts) and len(set(texts)) == len(values)


def _samples(
    path: Path, name: str
) -> tuple[list[object] | dict[str, np.ndarray], Mapping[str, object], tuple[str, ...]]:
    """Samples of a file, or its arrays; the numbers beside them, and what was left out."""
    data = path.read_bytes()
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
        content: object = samples
    else:
        content = _parsed(text, name)
    lists = _lists_of_samples(content)
    single = all(_is_sample(items[0]) for items in lists.values())
    if not (lists and single) and (arrays := dict(_arrays(content))):
        return arrays, _numbers(content), notes
    if path.suffix.lower() not in (".jsonl", ".ndjson"):
        samples, constants = _list_of_samples(content, lists, name), _numbers(content)
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


def _lists_of_samples(content: object) -> dict[str, list[object]]:
    """Lists of objects with named values, by their key; "" for the whole content."""
    items = content.items() if isinstance(content, dict) else [("", content)]
    return {
        str(key): value
        for key, value in items
        if isinstance(value, list) and value and isinstance(value[0], dict)
    }


def _is_sample(value: object) -> bool:
    """Whether an object is a sample rather than a recording, whose values are long lists."""
    return any(isinstance(cell, int | float) for _, cell in leaves(value))


def _numbers(content: object) -> dict[str, object]:
    """The numbers beside the samples of a parsed file."""
    items = content.items() if isinstance(content, dict) else ()
    return {str(key): value for key, value in items if isinstance(value, int | float)}


def _list_of_samples(content: object, lists: Mapping[str, list[object]], name: str) -> list[object]:
    """Samples of a parsed file.

    Raises:
        InputError: no list can be them, or several.
    """
    if isinstance(content, list):
        return content
    if len(lists) != 1:
        raise InputError(
            f"{len(lists)} lists of samples: {', '.join(lists)}"
            if lists
            else "no list of samples, that is of objects with named values, and no array",
            where=name,
            remedy="leave one list in the file, or export the log as CSV",
        )
    return next(iter(lists.values()))
