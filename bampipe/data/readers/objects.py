"""JSON: samples that are objects with named values, in a list or one a line; or arrays.

A value inside another is named by its path: ``state.q[0]`` is the first item of ``q`` in ``state``.
Arrays are columns, those of rows a column each, as in MATLAB files: ``data[0]``; where a list of
as many names stands beside them, they have these.
"""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from bampipe.data.readers import arrays as known_arrays
from bampipe.data.readers import moments
from bampipe.data.readers.arrays import ArrayReader, Opened, Stored, called_signals, stored
from bampipe.data.readers.nested import MISSING, as_number, find, is_number, leaves, reads_as_number
from bampipe.data.readers.trial import Wanted, opened
from bampipe.data.refusals import refusal
from bampipe.data.units import units_beside
from bampipe.errors import InputError

_TRIED = 400
"""Samples whose values become columns; values that only later ones hold do not."""


def _arrays(value: object, path: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Arrays (T,) or (T, k) of numbers, or (T,) of moments, in a parsed text, by their paths."""
    if isinstance(value, dict):
        lists = [item for item in value.values() if isinstance(item, list)]
        named = [[_name_of(x) for x in own] for own in lists]
        texts = [own for own in named if all(isinstance(x, str) and x for x in own)]
        names = [own for own in texts if len(set(own)) == len(own)]
        for key, item in value.items():
            inner = f"{path}.{key}" if path else str(key)
            for label, array in _arrays(item, inner):
                width = array.shape[-1] if array.ndim == 2 else 0
                called = next((n for n in names if len(n) == width), None)
                if label == inner and called:
                    within = f"{path}." if "[" in path else ""  # of a list of recordings
                    yield from zip((f"{within}{x}" for x in called), array.T, strict=True)
                else:
                    yield label, array
    elif isinstance(value, list) and value:
        if isinstance(value[0], dict):
            for place, item in enumerate(value):
                yield from _arrays(item, f"{path or 'data'}[{place}]")
            return
        if isinstance(value[0], str):
            if moments.is_moment(value[0]) and all(isinstance(x, str | None) for x in value):
                yield path, np.array(value, dtype=object)
            return
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError):  # ragged, or with other things in it
            return
        if array.ndim <= 2 and array.size and len(array) > 1:
            yield path or "data", array


def _name_of(item: object) -> object:
    """The name that an object states; anything else unchanged."""
    own = item.items() if isinstance(item, dict) else ()
    return next((text for key, text in own if key.lower() in known_arrays.NAMES), item)


def _with_lists(content: object, depth: int = 2) -> object:
    """Parsed content with lists for objects whose keys are row numbers, as pandas writes."""
    if not isinstance(content, dict) or depth == 0:
        return content
    if len(content) > 1 and all(key == str(n) for n, key in enumerate(content)):
        return list(content.values())
    return {key: _with_lists(item, depth - 1) for key, item in content.items()}


@contextmanager
def _opened(path: Path, wanted: Wanted | None) -> Iterator[Opened]:
    """Content of a file by name, ``wanted`` values by other names too, and notes on omissions.

    It holds a list of objects, a list under one key, or one object a line (.jsonl). Numbers beside
    that list are the same at every sample: a column for each of them.

    Raises:
        InputError: not JSON, or no such list.
    """
    try:
        with opened(path) as stream:
            text = stream.read().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError("not UTF-8 text", remedy="save it as UTF-8") from error
    one_a_line = bool({".jsonl", ".ndjson"} & {suffix.lower() for suffix in path.suffixes[-2:]})
    parsed, notes = _parsed(text, one_a_line)
    content = parsed if one_a_line or len(parsed) > 1 else _with_lists(parsed[0])
    items = content.items() if isinstance(content, dict) else [("", content)]
    lists = {str(k): v for k, v in items if isinstance(v, list) and v and isinstance(v[0], dict)}
    # Objects are samples rather than recordings or channels: lists in or beside these are longer.
    beside_it = content.values() if isinstance(content, dict) else ()
    single = all(
        any(reads_as_number(x) for _, x in leaves(v[0]))
        and not any(isinstance(x, list) and len(x) > len(v) for x in (*v[0].values(), *beside_it))
        for v in lists.values()
    )
    texts = {path: text for path, text in leaves(content) if isinstance(text, str)}
    units = units_beside(texts)
    beside = leaves(content) if isinstance(content, dict) else ()
    numbers = {k: _column([x], "", units) for k, x in beside if is_number(x)}
    alone = {k: held for k, held in numbers.items() if "[" not in k}
    if not (lists and single) and (arrays := dict(_arrays(content))):
        kinds = {label: "M" * (array.dtype.kind == "O") for label, array in arrays.items()}
        called = called_signals({**arrays, **numbers}, texts).items()
        held = {n: stored(arrays[x], unit, kinds[x]) for x, (n, unit) in called if x in arrays}
        held |= {n: numbers[x] for x, (n, _) in called if x in numbers and "[" not in n}
        yield _stating(held, units), notes
        return
    if not isinstance(content, list) and len(lists) != 1:
        name = "several_lists" if lists else "no_list"
        raise refusal(name, count=len(lists), lists=", ".join(lists))
    samples = content if isinstance(content, list) else next(iter(lists.values()))
    if not samples:
        raise InputError("a header but no samples")
    for number, sample in enumerate(samples, 1):
        if not isinstance(sample, dict):
            raise InputError("not an object with named values", where=f"sample {number}")
    # Records of several kinds may stand in turn.
    first = [cell for sample in samples[:_TRIED] for cell in leaves(sample)]
    filled = Counter(x for x, cell in first if cell is not None)
    read = Counter(x for x, cell in first if reads_as_number(cell) or _is_moment(cell))
    named = [x for x, count in read.items() if 2 * count > filled[x]]  # no digits of an identifier
    asked = wanted.columns if wanted else ()
    named += [x for x in asked if any(find(s, x) is not MISSING for s in samples[:_TRIED])]
    found = {name: _column(samples, name, units) for name in dict.fromkeys(named)}
    yield _stating(found | {x: alone[x] for x in alone if x not in found}, units), notes


READER = ArrayReader("value", _opened)


def _stating(found: Mapping[str, Stored], units: Mapping[str, str]) -> dict[str, Stored]:
    """Add the units that are stated of other quantities, such as ``"force units": "kip"``."""
    return {
        **found,
        **{x: stored(None, u, known_arrays.STATED) for x, u in units.items() if x not in found},
    }


def _column(samples: Sequence[object], name: str, units: Mapping[str, str]) -> Stored:
    """The column ``name`` of the samples, or these themselves, read when it is loaded."""
    shape, first = (len(samples),), (x for x in _cells(samples, name) if x is not None)
    if _is_moment(next(first, None)):
        return Stored(shape, "M", lambda: np.array([*_cells(samples, name)], dtype=object))

    def load() -> np.ndarray:
        places = (f"sample {n}, '{name}'" for n, _ in enumerate(samples, 1))
        return np.fromiter(map(as_number, _cells(samples, name), places), float, len(samples))

    return Stored(shape, "f", load, units.get(name, ""))


def _cells(samples: Sequence[object], name: str) -> Iterator[object]:
    found = (find(sample, name) if name else sample for sample in samples)
    return (None if cell is MISSING else cell for cell in found)


def _is_moment(cell: object) -> bool:
    return isinstance(cell, str) and moments.is_moment(cell)


def _parsed(text: str, one_a_line: bool) -> tuple[list[object], tuple[str, ...]]:
    """The values that stand one behind the other in a text, at least one, and a note on the end."""
    decoder, parsed = json.JSONDecoder(object_hook=_plain), list[object]()
    text, at = text.lstrip(), 0
    while not parsed or at < len(text):
        try:
            value, end = decoder.raw_decode(text, at)
        except (ValueError, RecursionError) as error:
            if one_a_line and parsed and "\n" not in text[at:]:
                return parsed, ("last line is cut off: 1 row dropped",)
            where = f"sample {len(parsed) + 1}" if one_a_line else ""
            line = f" at line {error.lineno}" if isinstance(error, json.JSONDecodeError) else ""
            raise refusal("no_json", where, line=line) from error
        parsed.append(value)
        at = next((n for n in range(end, len(text)) if not text[n].isspace()), len(text))
    return parsed, ()


def _plain(found: dict[str, object]) -> object:
    """The value of an object that says its type, as MongoDB writes: ``{"$numberLong": "1"}``."""
    key, value = next(iter(found.items()), ("", None))
    return value if len(found) == 1 and key[:1] == "$" else found
