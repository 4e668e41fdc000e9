"""JSON Schemas of the files that people write, and validation in one plain line.

The schemas are ``schemas/*.schema.json`` at the top of the source tree. A wheel carries them as
the folder ``bampipe/_schemas``, which in the source tree is a link to ``schemas``: setuptools
follows it, given ``bampipe*`` in ``packages.find`` and ``"bampipe._schemas" = ["*.json"]`` in
``package-data``.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from bampipe.errors import InputError, did_you_mean

_PACKAGE = Path(__file__).resolve().parent.parent
_FOLDERS = (_PACKAGE / "_schemas", _PACKAGE.parent / "schemas")

_TYPES = {
    "object": "a table",
    "array": "a list",
    "string": "text",
    "number": "a number",
    "integer": "a whole number",
    "boolean": "true or false",
}

_KEYWORDS = {
    "additionalProperties": lambda bound: "no such key",
    "minItems": lambda bound: f"at least {bound} in the list",
    "minProperties": lambda bound: f"at least {bound} entry",
    "minLength": lambda bound: "text that is not empty",
    "maxLength": lambda bound: f"at most {bound} characters",
    "minimum": lambda bound: f"{bound} or more",
    "exclusiveMinimum": lambda bound: f"more than {bound}",
    "maximum": lambda bound: f"{bound} or less",
    "exclusiveMaximum": lambda bound: f"less than {bound}",
    "uniqueItems": lambda bound: "no entry twice",
    "const": lambda bound: _shown(bound),
    "enum": lambda bound: " or ".join(_shown(choice) for choice in bound),
    "type": lambda bound: _TYPES.get(bound, str(bound)),
    "pattern": lambda bound: f"a name that matches {bound}",
}


@cache
def load(name: str) -> Mapping[str, Any]:
    """The JSON Schema ``name``, for example ``"session"``."""
    for folder in _FOLDERS:
        path = folder / f"{name}.schema.json"
        if path.is_file():
            return json.loads(path.read_text(encoding="utf-8"))
    raise FileNotFoundError(f"{name}.schema.json in {' or '.join(map(str, _FOLDERS))}")


def validate(value: object, name: str, where: str) -> None:
    """Check ``value``, made of what JSON can hold, against the schema ``name``.

    Args:
        value: the parsed file.
        name: of the schema.
        where: the file, for the message.

    Raises:
        InputError: names the file, the field (dotted), what was found, what is expected, and
            how many other fields are wrong.
    """
    found = faults(value, name, where)
    if not found:
        return
    first, others = found[0], len(found) - 1
    more = f" (and {others} more)" if others else ""
    raise InputError(first.what + more, where=first.where, remedy=first.remedy)


def faults(value: object, name: str, where: str) -> list[InputError]:
    """Everything that keeps ``value`` from fitting the schema ``name``, as `validate` takes them.

    Returns:
        One error a field, in the order of the fields; none where the value fits.
    """
    from jsonschema import Draft202012Validator  # heavy: only when a file is checked
    from jsonschema.exceptions import best_match

    errors = sorted(Draft202012Validator(load(name)).iter_errors(value), key=_order)
    chosen = (best_match([e]) if e.validator == "anyOf" else e for e in errors)
    return [_fault(error, where) for error in chosen]


def _fault(error: Any, where: str) -> InputError:
    """One error of jsonschema in plain words."""
    place = dotted(error.absolute_path)
    remedy = ""
    if error.validator == "required":
        missing = next(key for key in error.validator_value if key not in error.instance)
        what, remedy = f"'{missing}' is missing", _described(error.schema, missing)
    elif error.validator == "additionalProperties":
        known = error.schema["properties"]
        unknown = next(key for key in error.instance if key not in known)
        what = f"unknown key {_shown(unknown)}{did_you_mean(unknown, known)}"
        remedy = "" if "did you mean" in what else f"known keys: {', '.join(known)}"
    else:
        describe = _KEYWORDS.get(error.validator, lambda bound: error.message)
        expected = describe(error.validator_value)
        if error.validator == "pattern":
            expected = error.schema.get("description", expected)
        what = f"found {_shown(error.instance)}, expected {expected}"
        if error.validator == "enum" and isinstance(error.instance, str):
            what += did_you_mean(error.instance, error.validator_value)
    return InputError(what, where=f"{where}: {place}" if place else where, remedy=remedy)


def dotted(path: Iterable[str | int]) -> str:
    """``encoders.yaw.unit`` or ``trials[2].kind``, for the keys and indices in ``path``."""
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            text += f".{part}" if text else part
    return text


def _order(error: Any) -> tuple[list[tuple[bool, object]], bool, str]:
    path: Sequence[str | int] = list(error.absolute_path)
    places = [(isinstance(part, str), part) for part in path]
    return places, error.validator != "additionalProperties", error.message


def _described(schema: Mapping[str, Any], key: str) -> str:
    return schema.get("properties", {}).get(key, {}).get("description", "")


def _shown(value: object) -> str:
    if isinstance(value, Mapping):
        return "a table" if value else "an empty table"
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "..."
