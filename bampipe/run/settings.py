"""From settings in a file or on the command line to the typed configuration of a stage."""

from __future__ import annotations

import dataclasses
import tomllib
import types
import typing
from collections.abc import Mapping
from typing import Any

from bampipe.errors import InputError, choose_from
from bampipe.stages import base


def _describe(kind: Any) -> str:
    origin = typing.get_origin(kind)
    if origin is typing.Literal:
        return "one of " + ", ".join(repr(value) for value in typing.get_args(kind))
    if origin is tuple:
        return f"a list of {_describe(typing.get_args(kind)[0])}"
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_describe(part) for part in typing.get_args(kind))
    names = {
        str: "a text",
        int: "a whole number",
        float: "a number",
        bool: "true or false",
        type(None): "nothing",
    }
    return names.get(kind, "a table" if _is_mapping(kind) else str(kind))


def _is_mapping(kind: Any) -> bool:
    origin = typing.get_origin(kind) or kind
    return isinstance(origin, type) and issubclass(origin, Mapping)


def _convert(value: object, kind: Any) -> object:
    """Return ``value`` as ``kind``; ValueError where it cannot be."""
    origin = typing.get_origin(kind)
    if origin in (typing.Union, types.UnionType):
        for part in typing.get_args(kind):
            try:
                return _convert(value, part)
            except ValueError:
                continue
        raise ValueError
    if origin is typing.Literal:
        if value in typing.get_args(kind):
            return value
        raise ValueError
    if origin is tuple:
        parts = typing.get_args(kind)
        if not isinstance(value, list | tuple):
            raise ValueError
        if len(parts) == 2 and parts[1] is Ellipsis:
            return tuple(_convert(item, parts[0]) for item in value)
        if len(parts) != len(value):
            raise ValueError
        return tuple(_convert(item, part) for item, part in zip(value, parts, strict=True))
    if _is_mapping(kind):
        parts = typing.get_args(kind)
        if not isinstance(value, Mapping):
            raise ValueError
        return {str(k): _convert(v, parts[1]) for k, v in value.items()} if parts else value
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if kind is Any or kind is object:
        return value
    if isinstance(kind, type) and isinstance(value, kind):
        if isinstance(value, bool) and kind is not bool:
            raise ValueError
        return value
    raise ValueError


def configure(stage: str, settings: Mapping[str, object], where: str = "") -> Any:
    """Return the configuration of ``stage`` with ``settings`` in place of the defaults.

    Args:
        stage: name of the stage.
        settings: values by field name, as TOML or the command line gives them.
        where: the file the settings come from, for messages.

    Raises:
        InputError: an unknown field, a value of the wrong type, or one the stage refuses.
    """
    kind = base.load(stage).Config
    fields = {field.name for field in dataclasses.fields(kind)}
    hints = typing.get_type_hints(kind)
    values: dict[str, object] = {}
    for name, value in settings.items():
        if name not in fields:
            raise InputError(
                f"{stage} has no setting {name!r}",
                where=where,
                remedy=choose_from(name, fields),
            )
        try:
            values[name] = _convert(value, hints[name])
        except ValueError as error:
            raise InputError(
                f"setting {name!r} of {stage} must be {_describe(hints[name])}, not {value!r}",
                where=where,
            ) from error
    return kind(**values)


def plain(config: object) -> dict[str, object]:
    """Return a configuration as a table that JSON can hold, tuples as lists."""
    assert dataclasses.is_dataclass(config) and not isinstance(config, type)
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in dataclasses.asdict(config).items()
    }


def parse_assignment(text: str) -> tuple[str, object]:
    """Return name and value of ``name=value``; the value is read as TOML, else taken as text.

    Raises:
        InputError: there is no ``=``.
    """
    name, sign, value = text.partition("=")
    if not sign or not name.strip():
        raise InputError(f"{text!r} is not a setting", remedy="write --set name=value")
    try:
        parsed: object = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value
    return name.strip(), parsed
