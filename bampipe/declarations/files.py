"""Checks of device and effect files that need no data.

They check first each field by itself, then the fields against each other, then units, and finally
the derivation of the equations of motion. Each step requires that the one before found no fault,
and reports all faults that it finds.
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
    """Read the built-in device, or the device file at the path, that ``text`` names.

    Returns its declaration and its name in messages; raises `InputError` if there is neither.
    """
    if text.endswith(".toml") or Path(text).is_file():
        return read_device_file(Path(text)), text
    return registry.device(text).declaration, f"devices/{text}.toml"


def read_effect(text: str) -> Mapping[str, Any]:
    """Read the declaration of a built-in effect, or of the effect file at the path ``text``.

    Raises `InputError` if there is neither.
    """
    if text.endswith(".toml") or Path(text).is_file():
        return read_toml(Path(text))
    return registry.effect(text).declaration


def device_faults(declaration: Mapping[str, Any], where: str) -> tuple[str, list[str]]:
    """Derive the equations of motion of a device file, named ``where`` in messages.

    Returns them as text of several lines, empty if they cannot be derived, and one line per fault.
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
    except InputError as error:  # located in the file, not by the derivation's name for the device
        error.where = ": ".join(filter(None, (where, error.where.partition(": ")[2])))
        return "", [str(error)]


def effect_faults(
    declaration: Mapping[str, Any], where: str, device: Device, target: str = ""
) -> tuple[list[str], list[str]]:
    """Find the targets of an effect file, named ``where`` in messages, on ``device``.

    ``target`` is an axis, force component or pair; "" tries all that make sense. Returns the names
    ``effect[:target]`` that were tried, and one line per fault.
    """
    if faults := schema.faults(Effect, declaration, where):
        return [], [str(fault) for fault in faults]
    effect = registry.effect_from(declaration, where)
    targets = (target,) if target else effect.targets(device)
    if not targets:
        why = f"device '{device.name}' has nothing that it can act on, or lacks a name that it uses"
        if effect.devices and device.name not in effect.devices:
            why = f"made for {', '.join(effect.devices)}, not for device '{device.name}'"
        return [], [f"{where}: {why}"]
    found: dict[str, None] = {}
    for place in targets:
        try:
            lines = check_effect(effect, device, place)
        except InputError as error:
            lines = [str(error)]
        found |= dict.fromkeys(f"{where}: {line}" for line in lines)
    return [f"{effect.name}:{place}" if place else effect.name for place in targets], list(found)
