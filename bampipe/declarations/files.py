"""Device and effect files held to everything that can be known before there are data.

First every field by itself, then what fields say of each other, then units, at last the derivation
of the equations of motion: each step is taken only where the one before found nothing, and reports
all that it finds.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bampipe import schema
from bampipe.data.device_file import read_device_file
from bampipe.errors import InputError
from bampipe.files import read_toml
from bampipe.physics import Model, registry
from bampipe.physics.device import Device
from bampipe.physics.effect import Effect
from bampipe.physics.readable import describe_equations
from bampipe.physics.units import check_device, check_effect


def read_device(text: str) -> tuple[Mapping[str, Any], str]:
    """The declaration of a built-in device, or of the device file at the path ``text``.

    Returns:
        The parsed file, and what to call it in messages.

    Raises:
        InputError: there is neither.
    """
    if text.endswith(".toml") or Path(text).is_file():
        return read_device_file(Path(text)), text
    return registry.device(text).declaration, f"devices/{text}.toml"


def read_effect(text: str) -> Mapping[str, Any]:
    """The declaration of the effect file at the path ``text``, or of a built-in effect.

    Raises:
        InputError: there is neither.
    """
    if text.endswith(".toml") or Path(text).is_file():
        return read_toml(Path(text))
    return registry.effect(text).declaration


def device_faults(declaration: Mapping[str, Any], where: str) -> tuple[str, list[str]]:
    """The equations of motion of a device file, and what is wrong with it.

    Args:
        declaration: the parsed file.
        where: its name, for messages.

    Returns:
        Text of several lines, empty where the equations cannot be derived; and one line a fault.
    """
    if found := schema.faults(Device, declaration, where):
        return "", [str(fault) for fault in found]
    device = registry.device_from(declaration, where)
    faults = [f"{where}: {line}" for line in check_device(device)]
    try:
        Model(device, device.default_effects)
    except InputError as error:
        faults.append(str(InputError(error.what, where=f"{where}: default_effects")))
    if faults:
        return "", faults
    try:
        return describe_equations(device), []
    except InputError as error:
        return "", [_named(error, where)]


def effect_faults(
    declaration: Mapping[str, Any], where: str, device: Device, target: str = ""
) -> tuple[list[str], list[str]]:
    """Where an effect file can act on ``device``, and what is wrong with it.

    Args:
        declaration: the parsed file.
        where: its name, for messages.
        device: on which it is tried.
        target: axis, force component or pair; all that make sense where empty.

    Returns:
        Names ``effect[:target]`` that were tried, and one line a fault.
    """
    if faults := schema.faults(Effect, declaration, where):
        return [], [str(fault) for fault in faults]
    effect = registry.effect_from(declaration, where)
    targets = (target,) if target else effect.targets(device)
    if not targets:
        return [], [f"{where}: {_unfit(effect, device)}"]
    found: dict[str, None] = {}
    for place in targets:
        try:
            lines = check_effect(effect, device, place)
        except InputError as error:
            lines = [str(error)]
        found |= dict.fromkeys(f"{where}: {line}" for line in lines)
    return [f"{effect.name}:{place}" if place else effect.name for place in targets], list(found)


def _unfit(effect: Effect, device: Device) -> str:
    if effect.devices and device.name not in effect.devices:
        return f"made for {', '.join(effect.devices)}, not for device '{device.name}'"
    return f"device '{device.name}' has nothing that it can act on, or lacks a name that it uses"


def _named(error: InputError, where: str) -> str:
    """The error with the file in front, in place of what the derivation calls the device."""
    place = error.where.partition(": ")[2]
    return str(InputError(error.what, where=f"{where}: {place}" if place else where,
                          remedy=error.remedy))  # fmt: skip
