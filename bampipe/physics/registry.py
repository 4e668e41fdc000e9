"""The built-in effects and devices: the folders beside this file, nothing else to edit."""

import tomllib
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

from bampipe.errors import InputError, did_you_mean
from bampipe.physics.device import Device, device_from
from bampipe.physics.effect import Effect, effect_from

__all__ = ["device", "device_from", "device_names", "effect", "effect_from", "effect_names"]


@cache
def _list_names(folder: str) -> tuple[str, ...]:
    entries = (files("bampipe.physics") / folder).iterdir()
    return tuple(sorted(e.name.removesuffix(".toml") for e in entries if e.name.endswith(".toml")))


def _read_declaration(folder: str, name: str, remedy: str) -> tuple[Mapping[str, Any], str]:
    """Parsed file of that name, and where it is."""
    known = _list_names(folder)
    if name not in known:
        what = f"unknown {folder.removesuffix('s')} {name!r}{did_you_mean(name, known)}"
        raise InputError(what, remedy=remedy)
    text = (files("bampipe.physics") / folder / f"{name}.toml").read_text(encoding="utf-8")
    return tomllib.loads(text), f"{folder}/{name}.toml"


def effect_names() -> tuple[str, ...]:
    """Names of the built-in effects, sorted."""
    return _list_names("effects")


def device_names() -> tuple[str, ...]:
    """Names of the built-in devices, sorted."""
    return _list_names("devices")


@cache
def effect(name: str) -> Effect:
    """The built-in effect called ``name``.

    Raises:
        InputError: there is none; suggests the closest.
    """
    return effect_from(*_read_declaration("effects", name, "see them all with: bampipe effects"))


@cache
def device(name: str) -> Device:
    """The built-in device called ``name``.

    Raises:
        InputError: there is none; suggests the closest.
    """
    remedy = f"built in: {', '.join(device_names())}; or give the path of a device file"
    return device_from(*_read_declaration("devices", name, remedy))
