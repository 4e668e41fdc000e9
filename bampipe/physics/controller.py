"""A controller: how the force of a driven machine was commanded, declared in its device file.

A free run, a simulation of machine and controller together, needs it; nothing else does.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bampipe.errors import InputError
from bampipe.physics import expression

KEYS = ("source", "channels", "rate_hz", "command")


@dataclass(frozen=True)
class Controller:
    """A control law as its device file declares it.

    Attributes:
        channels: recorded references and gains that the law uses, with units.
        command: the law, by force channel, of measured motion, channels and constants.
        rate_hz: how often the controller acts; 0 where that is not known.
        source: where the law comes from.
    """

    channels: Mapping[str, str]
    command: Mapping[str, ast.expr]
    rate_hz: float
    source: str


def controller_from(
    entry: Mapping[str, Any] | None, forces: tuple[str, ...], where: str
) -> Controller | None:
    """Check the table ``[controller]`` of a device file; None where there is none.

    Args:
        entry: the table.
        forces: the device's force channels, all of which the law must command.
        where: file and table, for messages.

    Raises:
        InputError: something is missing, unknown or of the wrong type.
    """
    if entry is None:
        return None
    if not isinstance(entry, Mapping):
        raise InputError("expected a table", where=where)
    for key in entry:
        if key not in KEYS:
            raise InputError(
                f"unknown key {key!r}{expression.did_you_mean(key, KEYS)}", where=where
            )
    channels, law = entry.get("channels", {}), entry.get("command")
    if not isinstance(channels, Mapping) or not all(isinstance(u, str) for u in channels.values()):
        raise InputError("channels must be a table, name = unit", where=where)
    rate = entry.get("rate_hz", 0.0)
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not 0.0 <= rate <= 1e6:
        raise InputError("rate_hz must be a number of times a second", where=where)
    if not isinstance(law, Mapping) or set(law) != set(forces):
        raise InputError(
            f"[controller.command] must have one expression for each of {', '.join(forces)}",
            where=where,
        )
    return Controller(
        channels=dict(channels),
        command={f: expression.parse(law[f], f"{where}.command.{f}") for f in forces},
        rate_hz=float(rate),
        source=str(entry.get("source", "")),
    )
