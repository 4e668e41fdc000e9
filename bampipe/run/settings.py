"""Configuration of a stage, from settings in a file or on the command line."""

import dataclasses
import tomllib
from collections.abc import Mapping
from typing import Any

from bampipe.errors import InputError
from bampipe.schema import refusal
from bampipe.stages import base

_NEUTRAL = ("session", "jobs")
"""Fields of a configuration that affect no result: a place, and a number of processes."""


def configure(stage: str, settings: Mapping[str, object], where: str = "") -> Any:
    """Return the configuration of ``stage`` with ``settings`` in place of the defaults.

    Settings are as TOML or the command line gives them; ``where`` names their file in messages.

    Raises:
        InputError: an unknown field, a value of the wrong type, or one the stage refuses.
    """
    from pydantic import ValidationError

    kind = base.load_stage(stage).Config
    try:
        return kind(**settings)
    except ValidationError as error:
        inside = ("settings", stage) if where else (stage,)
        raise refusal(error, kind, where, inside) from None


def list_lasting(config: Any) -> dict[str, object]:
    """Return the fields of a configuration that affect a result, as JSON can hold them."""
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in dataclasses.asdict(config).items()
        if name not in _NEUTRAL
    }


def parse_assignment(text: str) -> tuple[str, object]:
    """Return name and value of ``name=value``; the value is read as TOML, or else as text.

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
