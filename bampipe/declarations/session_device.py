"""The device of a session, checked against the session's channels; and its placeholders."""

from collections.abc import Iterator, Mapping
from contextlib import suppress

from bampipe.data.device_file import read_device_file
from bampipe.data.refusals import refusal
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
            known = {"axis": axis, "near": did_you_mean(axis, axes), "axes": ", ".join(axes)}
            yield refusal("no_axis", f"{where}: encoders.{axis}", **known, device=device.name)
    for axis, unit in axes.items():
        if axis not in encoders:
            yield refusal("no_encoder", f"{where}: encoders", axis=axis, device=device.name)
        elif encoders[axis].unit != unit:
            known = {"found": encoders[axis].unit, "expected": unit, "device": device.name}
            yield refusal("axis_unit", f"{where}: encoders.{axis}.unit", **known)
    given = {channel.name for channel in session.channels}
    given |= set(session.force.names) if session.force else set()
    for name in (*device.forces, *device.channels):
        if name not in given:
            known = {"input": name, "device": device.name}
            named = ", ".join(sorted(given)) or "none"
            yield refusal("no_input", f"{where}: force", **known, given=named)
    wanted = {**dict.fromkeys(device.forces, device.force_unit), **device.channels}
    wanted |= device.controller.channels if device.controller else {}
    for channel in session.channels:
        expected = wanted.get(channel.name, channel.unit)
        if device.robot is not None and (channel.unit, expected) == ("N", "N.m"):
            continue  # the drive of a sliding joint: its force along the joint
        if not _is_alike(channel.unit, expected):
            place = f"{where}: channels.{channel.name}.unit"
            found, taken = (unit or "a pure number" for unit in (channel.unit, expected))
            yield refusal("channel_unit", place, found=found, expected=taken, device=device.name)
    if session.force and not session.force.volts and session.force.unit != device.force_unit:
        known = {"found": session.force.unit, "expected": device.force_unit}
        levered = (session.force.unit, device.force_unit) == ("N", "N.m")
        name = "lever_lacks" if levered else "force_unit"
        yield refusal(name, f"{where}: force.unit", **known, device=device.name)


def _is_alike(one: str, other: str) -> bool:
    """Whether two units have the same dimension; unreadable units differ."""
    with suppress(InputError):
        return one == other or parse_unit(one, "") == parse_unit(other, "")
    return False
