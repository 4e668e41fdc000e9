"""The device of a session, checked against the session's channels; and its placeholders."""

from collections.abc import Iterator, Mapping
from contextlib import suppress

from bampipe.data.device_file import read_device_file
from bampipe.data.session import Session
from bampipe.errors import InputError, did_you_mean, located
from bampipe.physics import registry
from bampipe.physics.device import Device
from bampipe.physics.units import parse_unit


def session_device(session: Session) -> Device:
    """Return the device that a session names, a built-in one or a file of its own.

    Raises:
        InputError: there is no such device, or channels for its axes and inputs are missing or
            have another name or unit; all faults are listed.
    """
    if session.device_file is not None:
        place = session.device_file
        device = registry.device_from(read_device_file(place), str(place))
    else:
        with located(f"{session.root / 'session.toml'}: device"):
            device = registry.device(session.device)
    found = list(_mismatches(session, device))
    if found:
        first, *others = found
        raise InputError(first.what, where=first.where, remedy=first.remedy, others=others)
    return device


def placeholders(table: object, place: str = "device") -> Iterator[str]:
    """Yield the dotted names of the numbers below ``table`` whose source says ``fill in``."""
    if isinstance(table, Mapping):
        if "value" in table and str(table.get("source", "")).startswith("fill in"):
            yield place
        for name, entry in table.items():
            yield from placeholders(entry, f"{place}.{name}")


def _mismatches(session: Session, device: Device) -> Iterator[InputError]:
    where = f"{session.root / 'session.toml'}"
    encoders = {encoder.name: encoder for encoder in session.encoders}
    axes = {coordinate.name: coordinate.unit for coordinate in device.coordinates}
    for axis in encoders:
        if axis not in axes:
            yield InputError(
                f"device '{device.name}' has no axis '{axis}'{did_you_mean(axis, axes)}",
                where=f"{where}: encoders.{axis}",
                remedy=f"its axes are {', '.join(axes)}",
            )
    for axis, unit in axes.items():
        if axis not in encoders:
            yield InputError(
                f"no encoder for axis '{axis}' of device '{device.name}'",
                where=f"{where}: encoders",
            )
        elif encoders[axis].unit != unit:
            yield InputError(
                f"a unit of {encoders[axis].unit}, but device '{device.name}' has this axis"
                f" in {unit}",
                where=f"{where}: encoders.{axis}.unit",
            )
    given = {channel.name for channel in session.channels}
    given |= set(session.force.names) if session.force else set()
    for name in (*device.forces, *device.channels):
        if name not in given:
            yield InputError(
                f"no channel for input '{name}' of device '{device.name}'",
                where=f"{where}: force",
                remedy=f"these are given: {', '.join(sorted(given)) or 'none'}",
            )
    wanted = {**dict.fromkeys(device.forces, device.force_unit), **device.channels}
    wanted |= device.controller.channels if device.controller else {}
    for channel in session.channels:
        expected = wanted.get(channel.name, channel.unit)
        if device.robot is not None and (channel.unit, expected) == ("N", "N.m"):
            continue  # the drive of a sliding joint: its force along the joint
        if not _is_alike(channel.unit, expected):
            yield InputError(
                f"a unit of {channel.unit or 'a pure number'}, but device '{device.name}' takes"
                f" {expected or 'a pure number'}",
                where=f"{where}: channels.{channel.name}.unit",
            )
    if session.force and not session.force.volts and session.force.unit != device.force_unit:
        yield InputError(
            f"found \"{session.force.unit}\", but device '{device.name}' takes {device.force_unit}",
            where=f"{where}: force.unit",
            remedy="lever_m, its distance from the axis in m, converts a force to a torque"
            if (session.force.unit, device.force_unit) == ("N", "N.m")
            else "",
        )


def _is_alike(one: str, other: str) -> bool:
    """Whether two units have the same dimension; unreadable units differ."""
    with suppress(InputError):
        return one == other or parse_unit(one, "") == parse_unit(other, "")
    return False
