"""The built-in effects and devices: the folders beside this file, nothing else to edit."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

from bampipe.errors import InputError, did_you_mean
from bampipe.physics.device import Device, device_from
from bampipe.physics.effect import Effect, effect_from

__all__ = [
    "device",
    "device_from",
    "device_names",
    "effect",
    "effect_from",
    "effect_names",
]


def _names(folder: str) -> tuple[str, ...]:
    entries = (files("bampipe.physics") / folder).iterdir()
    return tuple(sorted(e.name.removesuffix(".toml") for e in entries if e.name.endswith(".toml")))


@cache
def _declaration(folder: str, name: str) -> Mapping[str, Any]:
    text = (files("bampipe.physics") / folder / f"{name}.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


@cache
def effect_names() -> tuple[str, ...]:
    """Names of the built-in effects, sorted."""
    return _names("effects")


@cache
def device_names() -> tuple[str, ...]:
    """Names of the built-in devices, sorted."""
    return _names("devices")


@cache
def effect(name: str) -> Effect:
    """The built-in effect called ``name``.

    Raises:
        InputError: there is none; suggests the closest.
    """
    if name not in effect_names():
        raise InputError(
            f"unknown effect {name!r}{did_you_mean(name, effect_names())}",
            remedy="see them all with: bampipe effects",
        )
    return effect_from(_declaration("effects", name), f"effects/{name}.toml")


@cache
def device(name: str) -> Device:
    """The built-in device called ``name``.

    Raises:
        InputError: there is none; suggests the closest.
    """
    if name not in device_names():
        raise InputError(
            f"unknown device {name!r}{did_you_mean(name, device_names())}",
            remedy=f"built in: {', '.join(device_names())}; or give the path of a device file",
        )
    return device_from(_declaration("devices", name), f"devices/{name}.toml")
